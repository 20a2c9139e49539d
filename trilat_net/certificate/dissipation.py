"""What the corrected proof takes out of V_i, and what it passes from site to site.

Law: V_i' = -r'Kp r - 1/2 sum_j alpha_ij |qd_i - qd_j(t - T)|^2 - 1/2 |qd_i|^2 + 1/2 sum_j alpha_ij |qd_j|^2,
|x|^2 = x'Kd x: the first two are taken, the last two are passed on, and weighted with beta they cancel.
"""

import numpy as np

from ..core.arm import Array
from .equations import Equations
from .periods import Booked, Periods, smooth
from .shares import Shares
from .track import Track
from .views import View


def damping(track: Track, eq: Equations, ends: Periods) -> Booked:
    """Returns int r' Kp r."""
    left, right = (eq.Kp * ends.r_left**2).sum(axis=1), (eq.Kp * ends.r_right**2).sum(axis=1)
    return smooth(track.h_s, left, right)


def disagreement(track: Track, eq: Equations, shares: Shares, views: list[View]) -> Booked:
    """Returns 1/2 int sum_j alpha_ij |qd_i - qd_j(t - T_ij)|^2."""
    left = right = np.zeros(len(track.known) - 1)
    for j, view in enumerate(views):
        left = left + 0.5 * shares.alpha[:-1, j] * _norm(eq, track.qd[:-1] - view.seen.qd[:-1])
        right = right + 0.5 * shares.before[:, j] * _norm(eq, track.qd[1:] - view.kept.qd)
    return smooth(track.h_s, left, right)


def passed_on(track: Track, eq: Equations, shares: Shares, views: list[View]) -> Booked:
    """Returns int 1/2 |qd_i|^2 - 1/2 sum_j alpha_ij |qd_j|^2: what a site gives to those that follow it."""
    own = 0.5 * _norm(eq, track.qd)
    left, right = own[:-1], own[1:]
    for j, view in enumerate(views):
        peer = 0.5 * _norm(eq, view.now.qd)
        left = left - shares.alpha[:-1, j] * peer[:-1]
        right = right - shares.before[:, j] * peer[1:]
    return smooth(track.h_s, left, right)


def _norm(eq: Equations, x: Array) -> Array:
    norm: Array = (eq.Kd * x**2).sum(axis=1)
    return norm
