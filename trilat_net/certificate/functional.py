"""The corrected functional, V_i of every site in its four parts.

Law: V_i = 1/2 ( r'M r + (theta_hat - theta)' Gamma^-1 (theta_hat - theta) + e' Lambda Kd e
+ sum_j alpha_ij int qd_j' Kd qd_j ds ), the integral from the stamp of the sample in use to now. J each.

The paper's Eq. (16) with the integral that its Eq. (22) needs; docs/errata.md derives the corrections.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .dynamics import inertia_times
from .equations import Equations
from .shares import Shares
from .track import Track
from .views import View


class Parts(NamedTuple):
    """V_i of a site, part by part, each of shape (K,), J.

    Attributes:
        kinetic: 1/2 r' M r.
        parameter: 1/2 (theta_hat - theta)' Gamma^-1 (theta_hat - theta), of the parameters that are learnt.
        position: 1/2 e' Lambda Kd e.
        delay: 1/2 sum_j alpha_ij int qd_j' Kd qd_j ds over the age of the sample in use.
    """

    kinetic: Array
    parameter: Array
    position: Array
    delay: Array

    @property
    def total(self) -> Array:
        """V_i, shape (K,), J."""
        total: Array = self.kinetic + self.parameter + self.position + self.delay
        return total


def sliding(track: Track, eq: Equations) -> Array:
    """Returns r = qd + Lambda e, Eq. (10), shape (K, 2), rad/s."""
    r: Array = track.qd + eq.Lambda * track.e
    return r


def parts(track: Track, eq: Equations, shares: Shares, views: list[View]) -> Parts:
    """Returns the functional of a site along its records.

    Args:
        track: the records.
        eq: the site's constants.
        shares: its shares in its peers.
        views: what it sees of them, in the same order.
    """
    r, e = sliding(track, eq), track.e
    learnt = eq.Gamma > 0.0
    off = (track.theta_hat - eq.theta)[:, learnt]
    stored = [stored_on_the_way(eq, v) for v in views]
    return Parts(
        kinetic=0.5 * (r * inertia_times(eq.theta, track.q, r)).sum(axis=1),
        parameter=0.5 * (off**2 / eq.Gamma[learnt]).sum(axis=1),
        position=0.5 * (eq.Lambda * eq.Kd * e**2).sum(axis=1),
        delay=np.sum([shares.alpha[:, j] * energy for j, energy in enumerate(stored)], axis=0),
    )


def stored_on_the_way(eq: Equations, view: View) -> Array:
    """Returns 1/2 int qd_j' Kd qd_j ds from the stamp of the sample in use to now, shape (K,), J."""
    stored: Array = 0.5 * ((view.now.squares - view.seen.squares) @ eq.Kd)
    return stored
