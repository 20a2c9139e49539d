"""Who gave energy to V: hands, walls, links, shares, and whatever else the proof does not know.

Law: every amount is exact where it is a jump, and of the second order of the period where it is an integral.
Hands and walls count with r = qd + Lambda e, not with qd: that is what the theorem asks passivity for.
"""

import numpy as np

from ..core.arm import Array
from ..core.exogenous import Actor, rows_of, torque_of
from ..scenario import SiteSpec
from .dynamics import inertia_times, regressor
from .equations import Equations
from .functional import sliding, stored_on_the_way
from .periods import Booked, Periods, jumps, smooth
from .shares import Shares
from .track import Track
from .views import View


class Pushed:
    """The torque ON an arm over its rows, parted into hands and environment, held and not.

    Args:
        track: the site's records.
        spec: the site: who pushes, and what it meets.

    Attributes:
        hands: torque of the hands that is a function of the present, shape (K, 2), N m.
        hands_held: of those that are computed once a tick and held, shape (K, 2), N m.
        walls: of the environment, a function of the present, shape (K, 2), N m.
        walls_held: of what in it is held, shape (K, 2), N m.
    """

    def __init__(self, track: Track, spec: SiteSpec) -> None:
        self._track = track
        self._lengths = np.array([spec.arm.l1_m, spec.arm.l2_m])
        walls = [one.actor for one in spec.environment]
        held = [one.actor for one in spec.hands if one.actor.sampled]
        self.walls = self._torque([actor for actor in walls if not actor.sampled])
        self.walls_held = self._torque([actor for actor in walls if actor.sampled])
        self.hands_held = self._torque(held)
        # what is left of the record is the hands', also where nobody has written down whose it was
        self.hands: Array = -track.tau_x - self.walls - self.walls_held - self.hands_held

    def _torque(self, actors: list[Actor]) -> Array:
        """Returns what actors do at the logged states, shape (K, 2), N m."""
        torque = np.zeros_like(self._track.q)
        rows, table = rows_of(tuple(actors))
        for row in rows:
            states = zip(self._track.t_s.tolist(), self._track.q, self._track.qd, torque, strict=True)
            for t_s, q, qd, total in states:
                total += torque_of(t_s, q, qd, self._lengths, row, table)
        return torque


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
    Yr = np.einsum("kij,ki->kj", _regressor(track, eq), sliding(track, eq))
    mean = Yr[:-1] if digital else 0.5 * (Yr[:-1] + Yr[1:])
    held = np.diff(off, axis=0) + track.h_s * eq.Gamma * mean  # what the box kept the estimate from
    with np.errstate(divide="ignore", invalid="ignore"):
        amount = np.where(at_edge, 0.5 * (off[:-1] + off[1:]) * held / eq.Gamma, 0.0).sum(axis=1)
    power = np.where(wrong, Yr * off, 0.0).sum(axis=1)
    return smooth(track.h_s, power[:-1], power[1:])._replace(jump=amount)


def of_sampling(track: Track, eq: Equations, ends: Periods, *, digital: bool) -> Booked:
    """Returns the work of the scheme: of the torque that is held in place of Eq. (13), of its step of (15).

    int r' (u - tau), with u = tau_k of `digital` or the extrapolated one of `second_order`, tau straight
    from tick to tick, and for `digital` what forward Euler makes of the estimate in place of the trapezoid
    rule. No part of the balance: what that leaves without this, nobody accounts for.
    """
    tau = track.tau
    u = tau[:-1].copy()
    if not digital:
        u[1:] = np.clip(1.5 * tau[1:-1] - 0.5 * tau[:-2], -eq.tau_limit, eq.tau_limit)
    off_law = u - 0.5 * (tau[:-1] + tau[1:])
    amount = track.h_s * (0.5 * (ends.r_left + ends.r_right) * off_law).sum(axis=1)
    if digital:
        Yr = np.einsum("kij,ki->kj", _regressor(track, eq), sliding(track, eq))
        off = (track.theta_hat - eq.theta) * (eq.Gamma > 0.0)
        amount = amount + 0.25 * track.h_s * ((off[1:] + off[:-1]) * np.diff(Yr, axis=0)).sum(axis=1)
    return jumps(amount)


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
