"""Who gave energy to V: hands, walls, links, shares, and whatever else the proof does not know.

Law: every amount is exact where it is a jump, and of the second order of the period where it is an integral.
Hands and walls count with r = qd + Lambda e, not with qd: that is what the theorem asks passivity for.
"""

import numpy as np

from ..core.arm import Array
from .dynamics import inertia_times, regressor
from .equations import Equations
from .functional import sliding, stored_on_the_way
from .periods import Booked, Periods, jumps, smooth
from .shares import Shares
from .track import Track
from .views import View

ROUNDING = 1e-12
"""rad, and rad/s: a jump that is none."""


def of_torque(track: Track, ends: Periods, now: Array, held: Array) -> Booked:
    """Returns the work int r' tau_h of a torque ON the arm.

    Args:
        track: the site's records.
        ends: its periods.
        now: torque that follows the present, shape (K, 2), N m.
        held: torque that is held over the period, shape (K, 2), N m.
    """
    left = (ends.r_left * (now[:-1] + held[:-1])).sum(axis=1)
    return smooth(track.h_s, left, (ends.r_right * (now[1:] + held[:-1])).sum(axis=1))


def of_link(track: Track, eq: Equations, shares: Shares, ends: Periods, j: int, view: View) -> Booked:
    """Returns the work of a link: the exact change of V where the age of its sample in use changes.

    With s' in place of s + h at the end of a period: (Lambda M r + Lambda Kd e)' de, with r and e half-way
    through the jump and de what this link adds to it, less 1/2 alpha_ij int qd_j' Kd qd_j ds from s + h to
    s'. For an age that varies smoothly this is the integral of the theorem's missing term with dT/dt.
    """
    stored = 0.5 * (view.kept.squares - view.seen.squares[1:]) @ eq.Kd
    return jumps(_of_jump(track, eq, ends, ends.link[j]) + shares.before[:, j] * stored)


def of_shares(track: Track, eq: Equations, shares: Shares, ends: Periods, views: list[View]) -> Booked:
    """Returns the work of a change of shares, without that of beta: what a ramp adds to V_i', a step to V_i.

    1/2 sum_j alpha_ij' int qd_j' Kd qd_j ds + qd_i' Kd sum_j alpha_ij' q_j(t - T_ij): the second because ed,
    and with it the damping, knows of the ramp.
    """
    if shares.constant:
        return jumps(np.zeros(len(ends.shares)))
    left = right = np.zeros(len(ends.shares))
    jump = _of_jump(track, eq, ends, ends.shares)
    for j, view in enumerate(views):
        stored, rate = stored_on_the_way(eq, view), shares.rate[:-1, j]
        kept = 0.5 * (view.now.squares[1:] - view.kept.squares) @ eq.Kd
        left = left + rate * stored[:-1]
        right = right + rate * kept
        known = np.where(ends.following, rate, 0.0)
        left = left + known * (track.qd[:-1] * eq.Kd * view.seen.q[:-1]).sum(axis=1)
        right = right + known * (track.qd[1:] * eq.Kd * view.kept.q).sum(axis=1)
        jump = jump + (shares.alpha[1:, j] - shares.before[:, j]) * stored[1:]
    return Booked(0.5 * track.h_s * left, 0.5 * track.h_s * right, jump)


def of_rule(track: Track, eq: Equations, shares: Shares, ends: Periods, views: list[View]) -> Booked:
    """Returns the work of the rule for stale peers: all that moves the reference while it is not Eq. (6)."""
    alone = ~ends.following
    if not alone.any():
        return jumps(np.zeros(len(alone)))
    seen = np.sum([shares.alpha[:-1, j, None] * v.seen.qd[:-1] for j, v in enumerate(views)], axis=0)
    kept = np.sum([shares.before[:, j, None] * v.kept.qd for j, v in enumerate(views)], axis=0)
    left = (track.qd[:-1] * eq.Kd * (ends.qd_des_left - seen)).sum(axis=1)
    right = (track.qd[1:] * eq.Kd * (ends.qd_des_right - kept)).sum(axis=1)
    jump = _of_jump(track, eq, ends, ends.rule)
    booked = smooth(track.h_s, np.where(alone, left, 0.0), np.where(alone, right, 0.0))
    return booked._replace(jump=np.where(alone, jump, 0.0))


def of_torque_limit(track: Track, eq: Equations) -> Booked:
    """Returns the work of what the limit cut off: int r' (tau - tau of Eq. (13))."""
    cut = np.flatnonzero((np.abs(track.tau) >= eq.tau_limit).any(axis=1))
    power = np.zeros(len(track.known))
    if len(cut):
        r, ed = sliding(track, eq)[cut], (track.qd - track.qd_des)[cut]
        law = np.einsum("kij,kj->ki", _regressor(track, eq)[cut], track.theta_hat[cut])
        law -= eq.Kp * r + eq.Kd * ed
        power[cut] = (r * (track.tau[cut] - law)).sum(axis=1)
    return smooth(track.h_s, power[:-1], power[1:])


def of_estimates(track: Track, eq: Equations, *, digital: bool) -> Booked:
    """Returns the work of estimates that do not follow Eq. (15): held in their box, or not learnt and wrong.

    The box lessens 1/2 (theta_hat - theta)' Gamma^-1 (theta_hat - theta) where it holds the truth; a
    parameter that is not learnt leaves r' Y (theta_hat - theta) without its counterpart.
    """
    off = track.theta_hat - eq.theta
    learnt = eq.Gamma > 0.0
    at_edge = ((track.theta_hat <= eq.low) | (track.theta_hat >= eq.high))[1:] & learnt
    wrong = (off != 0.0) & ~learnt
    if not (at_edge.any() or wrong.any()):
        return jumps(np.zeros(len(off) - 1))
    Yr = _regressed(track, eq)
    mean = Yr[:-1] if digital else 0.5 * (Yr[:-1] + Yr[1:])
    held = np.diff(off, axis=0) + track.h_s * eq.Gamma * mean  # what the box kept the estimate from
    with np.errstate(divide="ignore", invalid="ignore"):
        amount = np.where(at_edge, 0.5 * (off[:-1] + off[1:]) * held / eq.Gamma, 0.0).sum(axis=1)
    power = np.where(wrong, Yr * off, 0.0).sum(axis=1)
    return smooth(track.h_s, power[:-1], power[1:])._replace(jump=amount)


def of_sampling(track: Track, eq: Equations, ends: Periods, *, digital: bool) -> Booked:
    """Returns the work of the scheme: of the torque that is held in place of Eq. (13), of its step of (15).

    int r' (u - tau), with u = tau_k of `digital` or the extrapolated one of `second_order`, and tau straight
    to where it is before the jump; and what the scheme makes of the estimate in place of the trapezoid rule
    up to there. No part of the balance: what that leaves without this, nobody accounts for.
    """
    tau = track.tau
    u = tau[:-1].copy()
    if not digital:
        u[1:] = np.clip(1.5 * tau[1:-1] - 0.5 * tau[:-2], -eq.tau_limit, eq.tau_limit)
    Yr = _regressed(track, eq)
    tau_right, Yr_right = _before_jump(track, eq, ends, Yr)
    off_law = u - 0.5 * (tau[:-1] + tau_right)
    amount = track.h_s * (0.5 * (ends.r_left + ends.r_right) * off_law).sum(axis=1)
    off = (track.theta_hat - eq.theta) * (eq.Gamma > 0.0)
    step = Yr[:-1] if digital else 0.5 * (Yr[:-1] + Yr[1:])
    missed = 0.5 * (Yr[:-1] + Yr_right) - step
    return jumps(amount + 0.5 * track.h_s * ((off[1:] + off[:-1]) * missed).sum(axis=1))


def _before_jump(track: Track, eq: Equations, ends: Periods, Yr: Array) -> tuple[Array, Array]:
    """Returns tau of Eq. (13) and Y'r at the end of every period, before its jump, K - 1 rows each."""
    tau, Yr = track.tau[1:].copy(), Yr[1:].copy()
    q, qd, e = track.q[1:], track.qd[1:], 2.0 * ends.e_middle - track.e[1:]
    moved = np.abs(e - track.e[1:]) + np.abs(ends.qd_des_right - track.qd_des[1:]) > ROUNDING
    rows = np.flatnonzero(moved.any(axis=1))
    e, ed, r = e[rows], (qd - ends.qd_des_right)[rows], ends.r_right[rows]
    Y = regressor(eq.g, q[rows], qd[rows], -eq.Lambda * e, -eq.Lambda * ed)
    Yr[rows] = np.einsum("kij,ki->kj", Y, r)
    law = np.einsum("kij,kj->ki", Y, track.theta_hat[1:][rows]) - eq.Kp * r - eq.Kd * ed
    tau[rows] = np.clip(law, -eq.tau_limit, eq.tau_limit)
    return tau, Yr


def _regressed(track: Track, eq: Equations) -> Array:
    """Returns Y'r, shape (K, 5)."""
    Yr: Array = np.einsum("kij,ki->kj", _regressor(track, eq), sliding(track, eq))
    return Yr


def _regressor(track: Track, eq: Equations) -> Array:
    ed = track.qd - track.qd_des
    return regressor(eq.g, track.q, track.qd, -eq.Lambda * track.e, -eq.Lambda * ed)


def _of_jump(track: Track, eq: Equations, ends: Periods, de: Array) -> Array:
    """Returns the exact part that `de` has in the change of 1/2 (r'M r + e' Lambda Kd e), shape (K - 1,), J.

    Both are quadratic in e, so that the gradient half-way through the whole jump gives it, linear in `de`.
    """
    gradient = inertia_times(eq.theta, track.q[1:], ends.r_middle) + eq.Kd * ends.e_middle
    change: Array = (gradient * eq.Lambda * de).sum(axis=1)
    return change
