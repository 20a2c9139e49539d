"""The corrected functional V_i of a site, and every term that changes it.

Dissipation, transfer and work, in J.

Invariant: V_i = 1/2 ( r'M r + (theta_hat - theta)' Gamma^-1 (theta_hat - theta) + e' Lambda Kd e + sum_j
alpha_ij int qd_j' Kd qd_j ds ), the integral from the stamp of the sample in use to now: the paper's Eq.
(16) with the integral that its Eq. (22) needs (docs/errata.md). With |x|^2 = x'Kd x, V_i' = -r'Kp r - 1/2
sum_j alpha_ij |qd_i - qd_j(t - T)|^2 - 1/2 |qd_i|^2 + 1/2 sum_j alpha_ij |qd_j|^2: the first two terms
dissipate, the last two are transferred between sites and cancel under beta.

Within a sample period a term is a trapezoid, with an error of second order in the period, followed by an
exact jump at its end; a jump of e is divided among links, changes of dominance and the rule for stale
peers. Operator and environment do work on r = qd + Lambda e, not on qd: the theorem requires passivity
with respect to r. A site has a functional if its control law is the paper's and theta of its arm is
known.
"""

from typing import NamedTuple

import numpy as np

from ...core.vectors import Array
from ...scenario import SiteSpec
from ...scenario.laws import LAWS, Adaptive, AdaptiveBox
from ..aligned import AlignedRecords, Bools, DelayedPeer
from ..arm_rows import inertia_product_rows, regressor_rows
from ..dominance_history import DominanceHistory


class SiteConstants(NamedTuple):
    """A site's constants; vectors per joint have shape (2,), per parameter (5,).

    Attributes:
        theta: the arm's true parameters.
        g: gravitational acceleration, m/s^2.
        Lambda: 1/s.
        Kp: N m s/rad.
        Kd: N m s/rad.
        Gamma: adaptation gain.
        low: least that each estimate may be.
        high: most.
        tau_limit: largest torque of a joint, N m.
        outside: whether the arm is outside of the program: theta is then what its author says of it.
    """

    theta: Array
    g: float
    Lambda: Array
    Kp: Array
    Kd: Array
    Gamma: Array
    low: Array
    high: Array
    tau_limit: float
    outside: bool = False


def derive_site_constants(spec: SiteSpec) -> SiteConstants:
    """Returns the constants of a site whose law is the paper's, with a box or without."""
    gains = spec.control.gains(spec.arm.theta)
    return SiteConstants(
        spec.arm.theta,
        spec.arm.g_m_s2,
        np.array(gains.Lambda),
        np.array(gains.Kp),
        np.array(gains.Kd),
        np.array(gains.Gamma),
        np.array(gains.low),
        np.array(gains.high),
        spec.limits.tau_limit_nm,
        spec.plant == "external",
    )


def explain_missing_functional(spec: SiteSpec) -> str:
    """Says why a site has no functional; "" where it has one."""
    if not spec.arm.known:
        return "nobody knows the arm's theta, and V is made of it"
    if not isinstance(spec.control, Adaptive | AdaptiveBox):
        name = next(name for name, kind in LAWS.items() if isinstance(spec.control, kind))
        return f"law {name}, for which there is no such V"
    return ""


class FunctionalParts(NamedTuple):
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


def sliding_variable(track: AlignedRecords, eq: SiteConstants) -> Array:
    """Returns r = qd + Lambda e, Eq. (10), shape (K, 2), rad/s."""
    r: Array = track.qd + eq.Lambda * track.e
    return r


def evaluate_functional(
    track: AlignedRecords, eq: SiteConstants, shares: DominanceHistory, views: list[DelayedPeer]
) -> FunctionalParts:
    """Returns the functional of a site along its records.

    Args:
        track: the records.
        eq: the site's constants.
        shares: its shares in its peers.
        views: what it sees of them, in the same order.
    """
    r, e = sliding_variable(track, eq), track.e
    learnt = eq.Gamma > 0.0
    off = (track.theta_hat - eq.theta)[:, learnt]
    stored = [energy_in_transit(eq, v) for v in views]
    return FunctionalParts(
        kinetic=0.5 * (r * inertia_product_rows(eq.theta, track.q, r)).sum(axis=1),
        parameter=0.5 * (off**2 / eq.Gamma[learnt]).sum(axis=1),
        position=0.5 * (eq.Lambda * eq.Kd * e**2).sum(axis=1),
        delay=np.sum([shares.alpha[:, j] * energy for j, energy in enumerate(stored)], axis=0),
    )


def energy_in_transit(eq: SiteConstants, view: DelayedPeer) -> Array:
    """Returns 1/2 int qd_j' Kd qd_j ds from the stamp of the sample in use to now, shape (K,), J."""
    stored: Array = 0.5 * ((view.now.squares - view.seen.squares) @ eq.Kd)
    return stored


class Increment(NamedTuple):
    """An amount of energy per period, J: what its two ends give to an integral, and a jump at its end.

    Attributes:
        left: of the trapezoid rule, at the beginning, shape (K - 1,).
        right: of the trapezoid rule, before the jump, shape (K - 1,).
        jump: at the end, shape (K - 1,).
    """

    left: Array
    right: Array
    jump: Array

    @property
    def total(self) -> Array:
        """The amount of every period, shape (K - 1,), J."""
        total: Array = self.left + self.right + self.jump
        return total


def integrate_trapezoid(h_s: float, left: Array, right: Array) -> Increment:
    """Returns the integral of a power, W, over every period by the trapezoid rule."""
    return Increment(0.5 * h_s * left, 0.5 * h_s * right, np.zeros(len(left)))


def integrate_jump(amount: Array) -> Increment:
    """Returns amounts that come at once."""
    nothing = np.zeros(len(amount))
    return Increment(nothing, nothing, amount)


class PeriodEnds(NamedTuple):
    """The ends of every period, K - 1 rows; `right` is before the jump.

    Attributes:
        following: whether the site followed its peers at both ends.
        link: per peer the jump of e by the age of its sample, shape (P, K - 1, 2), rad.
        shares: the jump of e by a sudden change of shares, shape (K - 1, 2), rad.
        rule: the jump of e by the rule for stale peers, shape (K - 1, 2), rad.
        r_left: r = qd + Lambda e, shape (K - 1, 2), rad/s.
        r_right: shape (K - 1, 2), rad/s.
        r_middle: half-way through the jump, shape (K - 1, 2), rad/s.
        e_middle: half-way through the jump, shape (K - 1, 2), rad.
        qd_des_left: shape (K - 1, 2), rad/s.
        qd_des_right: shape (K - 1, 2), rad/s.
    """

    following: Bools
    link: Array
    shares: Array
    rule: Array
    r_left: Array
    r_right: Array
    r_middle: Array
    e_middle: Array
    qd_des_left: Array
    qd_des_right: Array


def split_periods(
    track: AlignedRecords, eq: SiteConstants, shares: DominanceHistory, views: list[DelayedPeer]
) -> PeriodEnds:
    """Returns the periods of a site.

    While it follows its peers, the smooth way of its reference is Eq. (6) with every stamp moving at rate
    one. Otherwise that is a matter of the rule: the trapezoid rule on the recorded derivative.

    Args:
        track: the site's records.
        eq: its constants.
        shares: its shares in its peers.
        views: what it sees of them, in the same order.
    """
    following = track.follows[:-1] & track.follows[1:]
    here = following[:, np.newaxis]
    before, after, rate = (x[:, :, np.newaxis] for x in (shares.before, shares.alpha[1:], shares.rate[:-1]))
    link = np.array(
        [np.where(here, before[:, j] * (v.kept.q - v.seen.q[1:]), 0.0) for j, v in enumerate(views)]
    )
    sudden = np.sum([(before[:, j] - after[:, j]) * v.seen.q[1:] for j, v in enumerate(views)], axis=0)
    follow = track.follows[:-1, np.newaxis]
    kept_qd = np.sum([before[:, j] * v.kept.qd + rate[:, j] * v.kept.q for j, v in enumerate(views)], axis=0)
    kept_q = np.sum([before[:, j] * v.kept.q for j, v in enumerate(views)], axis=0)
    qd_des_left, qd_des_right = track.qd_des[:-1], np.where(follow, kept_qd, track.qd_des[1:])
    way = track.q_des[:-1] + 0.5 * track.h_s * (qd_des_left + qd_des_right)
    rule = np.where(here, 0.0, np.where(follow, kept_q, way) - track.q_des[1:])
    sudden = np.where(here, sudden, 0.0)
    jump = link.sum(axis=0) + sudden + rule
    r, e_middle = track.qd + eq.Lambda * track.e, track.e[1:] - 0.5 * jump
    r_right, r_middle = r[1:] - eq.Lambda * jump, r[1:] - 0.5 * eq.Lambda * jump
    moved = (link, sudden, rule)
    return PeriodEnds(following, *moved, r[:-1], r_right, r_middle, e_middle, qd_des_left, qd_des_right)


def damping_dissipation(track: AlignedRecords, eq: SiteConstants, ends: PeriodEnds) -> Increment:
    """Returns int r' Kp r."""
    left, right = (eq.Kp * ends.r_left**2).sum(axis=1), (eq.Kp * ends.r_right**2).sum(axis=1)
    return integrate_trapezoid(track.h_s, left, right)


def disagreement_dissipation(
    track: AlignedRecords, eq: SiteConstants, shares: DominanceHistory, views: list[DelayedPeer]
) -> Increment:
    """Returns 1/2 int sum_j alpha_ij |qd_i - qd_j(t - T_ij)|^2."""
    left = right = np.zeros(len(track.known) - 1)
    for j, view in enumerate(views):
        left = left + 0.5 * shares.alpha[:-1, j] * _norm(eq, track.qd[:-1] - view.seen.qd[:-1])
        right = right + 0.5 * shares.before[:, j] * _norm(eq, track.qd[1:] - view.kept.qd)
    return integrate_trapezoid(track.h_s, left, right)


def transferred_energy(
    track: AlignedRecords, eq: SiteConstants, shares: DominanceHistory, views: list[DelayedPeer]
) -> Increment:
    """Returns int 1/2 |qd_i|^2 - 1/2 sum_j alpha_ij |qd_j|^2: what a site gives to those that follow it."""
    own = 0.5 * _norm(eq, track.qd)
    left, right = own[:-1], own[1:]
    for j, view in enumerate(views):
        peer = 0.5 * _norm(eq, view.now.qd)
        left = left - shares.alpha[:-1, j] * peer[:-1]
        right = right - shares.before[:, j] * peer[1:]
    return integrate_trapezoid(track.h_s, left, right)


def _norm(eq: SiteConstants, x: Array) -> Array:
    norm: Array = (eq.Kd * x**2).sum(axis=1)
    return norm


JUMP_TOLERANCE = 1e-12
"""rad, and rad/s: a jump that is none."""


def torque_work(track: AlignedRecords, ends: PeriodEnds, now: Array, held: Array) -> Increment:
    """Returns the work int r' tau_h of a torque ON the arm.

    Args:
        track: the site's records.
        ends: its periods.
        now: torque that follows the present, shape (K, 2), N m.
        held: torque that is held over the period, shape (K, 2), N m.
    """
    left = (ends.r_left * (now[:-1] + held[:-1])).sum(axis=1)
    return integrate_trapezoid(track.h_s, left, (ends.r_right * (now[1:] + held[:-1])).sum(axis=1))


def link_work(
    track: AlignedRecords,
    eq: SiteConstants,
    shares: DominanceHistory,
    ends: PeriodEnds,
    j: int,
    view: DelayedPeer,
) -> Increment:
    """Returns the work of a link: the exact change of V where the age of its sample in use changes.

    With s' in place of s + h at the end of a period: (Lambda M r + Lambda Kd e)' de, with r and e half-way
    through the jump and de what this link adds to it, less 1/2 alpha_ij int qd_j' Kd qd_j ds from s + h to
    s'. For an age that varies smoothly this is the integral of the theorem's missing term with dT/dt.
    """
    stored = 0.5 * (view.kept.squares - view.seen.squares[1:]) @ eq.Kd
    return integrate_jump(_of_jump(track, eq, ends, ends.link[j]) + shares.before[:, j] * stored)


def dominance_change_work(
    track: AlignedRecords,
    eq: SiteConstants,
    shares: DominanceHistory,
    ends: PeriodEnds,
    views: list[DelayedPeer],
) -> Increment:
    """Returns the work of a change of shares, without that of beta: what a ramp adds to V_i', a step to V_i.

    1/2 sum_j alpha_ij' int qd_j' Kd qd_j ds + qd_i' Kd sum_j alpha_ij' q_j(t - T_ij): the second because ed,
    and with it the damping, knows of the ramp.
    """
    if shares.constant:
        return integrate_jump(np.zeros(len(ends.shares)))
    left = right = np.zeros(len(ends.shares))
    jump = _of_jump(track, eq, ends, ends.shares)
    for j, view in enumerate(views):
        stored, rate = energy_in_transit(eq, view), shares.rate[:-1, j]
        kept = 0.5 * (view.now.squares[1:] - view.kept.squares) @ eq.Kd
        left = left + rate * stored[:-1]
        right = right + rate * kept
        known = np.where(ends.following, rate, 0.0)
        left = left + known * (track.qd[:-1] * eq.Kd * view.seen.q[:-1]).sum(axis=1)
        right = right + known * (track.qd[1:] * eq.Kd * view.kept.q).sum(axis=1)
        jump = jump + (shares.alpha[1:, j] - shares.before[:, j]) * stored[1:]
    return Increment(0.5 * track.h_s * left, 0.5 * track.h_s * right, jump)


def stale_rule_work(
    track: AlignedRecords,
    eq: SiteConstants,
    shares: DominanceHistory,
    ends: PeriodEnds,
    views: list[DelayedPeer],
) -> Increment:
    """Returns the work of the rule for stale peers: all that moves the reference while it is not Eq. (6)."""
    alone = ~ends.following
    if not alone.any():
        return integrate_jump(np.zeros(len(alone)))
    seen = np.sum([shares.alpha[:-1, j, None] * v.seen.qd[:-1] for j, v in enumerate(views)], axis=0)
    kept = np.sum([shares.before[:, j, None] * v.kept.qd for j, v in enumerate(views)], axis=0)
    left = (track.qd[:-1] * eq.Kd * (ends.qd_des_left - seen)).sum(axis=1)
    right = (track.qd[1:] * eq.Kd * (ends.qd_des_right - kept)).sum(axis=1)
    jump = _of_jump(track, eq, ends, ends.rule)
    booked = integrate_trapezoid(track.h_s, np.where(alone, left, 0.0), np.where(alone, right, 0.0))
    return booked._replace(jump=np.where(alone, jump, 0.0))


def torque_limit_work(track: AlignedRecords, eq: SiteConstants) -> Increment:
    """Returns the work of what the limit cut off: int r' (tau - tau of Eq. (13))."""
    cut = np.flatnonzero((np.abs(track.tau) >= eq.tau_limit).any(axis=1))
    power = np.zeros(len(track.known))
    if len(cut):
        r, ed = sliding_variable(track, eq)[cut], (track.qd - track.qd_des)[cut]
        law = np.einsum("kij,kj->ki", _regressor(track, eq)[cut], track.theta_hat[cut])
        law -= eq.Kp * r + eq.Kd * ed
        power[cut] = (r * (track.tau[cut] - law)).sum(axis=1)
    return integrate_trapezoid(track.h_s, power[:-1], power[1:])


def estimate_work(track: AlignedRecords, eq: SiteConstants, *, digital: bool) -> Increment:
    """Returns the work of estimates that do not follow Eq. (15): held in their box, or not learnt and wrong.

    The box lessens 1/2 (theta_hat - theta)' Gamma^-1 (theta_hat - theta) where it holds the truth; a
    parameter that is not learnt leaves r' Y (theta_hat - theta) without its counterpart.
    """
    off = track.theta_hat - eq.theta
    learnt = eq.Gamma > 0.0
    at_edge = ((track.theta_hat <= eq.low) | (track.theta_hat >= eq.high))[1:] & learnt
    wrong = (off != 0.0) & ~learnt
    if not (at_edge.any() or wrong.any()):
        return integrate_jump(np.zeros(len(off) - 1))
    Yr = _regressor_transpose_r(track, eq)
    mean = Yr[:-1] if digital else 0.5 * (Yr[:-1] + Yr[1:])
    held = np.diff(off, axis=0) + track.h_s * eq.Gamma * mean  # what the box kept the estimate from
    with np.errstate(divide="ignore", invalid="ignore"):
        amount = np.where(at_edge, 0.5 * (off[:-1] + off[1:]) * held / eq.Gamma, 0.0).sum(axis=1)
    power = np.where(wrong, Yr * off, 0.0).sum(axis=1)
    return integrate_trapezoid(track.h_s, power[:-1], power[1:])._replace(jump=amount)


def sampling_work(track: AlignedRecords, eq: SiteConstants, ends: PeriodEnds, *, digital: bool) -> Increment:
    """Returns the work of the scheme: of the torque that is held in place of Eq. (13), of its step of (15).

    int r' (u - tau), with u = tau_k of `digital` or the extrapolated one of `second_order`, and tau straight
    to where it is before the jump; and what the scheme makes of the estimate in place of the trapezoid rule
    up to there. No part of the balance: what that leaves without this, nobody accounts for.
    """
    tau = track.tau
    u = tau[:-1].copy()
    if not digital:
        u[1:] = np.clip(1.5 * tau[1:-1] - 0.5 * tau[:-2], -eq.tau_limit, eq.tau_limit)
    Yr = _regressor_transpose_r(track, eq)
    tau_right, Yr_right = _before_jump(track, eq, ends, Yr)
    off_law = u - 0.5 * (tau[:-1] + tau_right)
    amount = track.h_s * (0.5 * (ends.r_left + ends.r_right) * off_law).sum(axis=1)
    off = (track.theta_hat - eq.theta) * (eq.Gamma > 0.0)
    step = Yr[:-1] if digital else 0.5 * (Yr[:-1] + Yr[1:])
    missed = 0.5 * (Yr[:-1] + Yr_right) - step
    return integrate_jump(amount + 0.5 * track.h_s * ((off[1:] + off[:-1]) * missed).sum(axis=1))


def _before_jump(
    track: AlignedRecords, eq: SiteConstants, ends: PeriodEnds, Yr: Array
) -> tuple[Array, Array]:
    """Returns tau of Eq. (13) and Y'r at the end of every period, before its jump, K - 1 rows each."""
    tau, Yr = track.tau[1:].copy(), Yr[1:].copy()
    q, qd, e = track.q[1:], track.qd[1:], 2.0 * ends.e_middle - track.e[1:]
    moved = np.abs(e - track.e[1:]) + np.abs(ends.qd_des_right - track.qd_des[1:]) > JUMP_TOLERANCE
    rows = np.flatnonzero(moved.any(axis=1))
    e, ed, r = e[rows], (qd - ends.qd_des_right)[rows], ends.r_right[rows]
    Y = regressor_rows(eq.g, q[rows], qd[rows], -eq.Lambda * e, -eq.Lambda * ed)
    Yr[rows] = np.einsum("kij,ki->kj", Y, r)
    law = np.einsum("kij,kj->ki", Y, track.theta_hat[1:][rows]) - eq.Kp * r - eq.Kd * ed
    tau[rows] = np.clip(law, -eq.tau_limit, eq.tau_limit)
    return tau, Yr


def _regressor_transpose_r(track: AlignedRecords, eq: SiteConstants) -> Array:
    """Returns Y'r, shape (K, 5)."""
    Yr: Array = np.einsum("kij,ki->kj", _regressor(track, eq), sliding_variable(track, eq))
    return Yr


def _regressor(track: AlignedRecords, eq: SiteConstants) -> Array:
    ed = track.qd - track.qd_des
    return regressor_rows(eq.g, track.q, track.qd, -eq.Lambda * track.e, -eq.Lambda * ed)


def _of_jump(track: AlignedRecords, eq: SiteConstants, ends: PeriodEnds, de: Array) -> Array:
    """Returns the exact part that `de` has in the change of 1/2 (r'M r + e' Lambda Kd e), shape (K - 1,), J.

    Both are quadratic in e, so that the gradient half-way through the whole jump gives it, linear in `de`.
    """
    gradient = inertia_product_rows(eq.theta, track.q[1:], ends.r_middle) + eq.Kd * ends.e_middle
    change: Array = (gradient * eq.Lambda * de).sum(axis=1)
    return change
