"""The corrected functional V_i of a site, and every term that changes it, in J.

Invariant: V_i = 1/2 ( r'M r + (theta_hat - theta)' Gamma^-1 (theta_hat - theta) + e' Lambda Kd
e + sum_j alpha_ij int qd_j' Kd qd_j ds ), the integral from the stamp of the sample in use to
now: the paper's Eq. (16) with the integral that its Eq. (22) needs (docs/errata.md). With |x|^2
= x'Kd x, V_i' = -r'Kp r - 1/2 sum_j alpha_ij |qd_i - qd_j(t - T)|^2 - 1/2 |qd_i|^2 + 1/2 sum_j
alpha_ij |qd_j|^2: the first two terms dissipate, the last two are transferred between sites and
cancel under beta. In task space e and qd_j are those of end effectors and r is that of the task
(`following`); docs/certificate.md says what else changes.

Within a sample period a term is a trapezoid, with an error of second order in the period,
followed by an exact jump at its end; a jump of e is divided among links, changes of dominance
and the rule for stale peers. Operator and environment do work on r = qd + Lambda e, not on qd:
the theorem requires passivity with respect to r. A site has a functional if its control law is
the paper's and theta of its arm is known.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...core.site_setup import Scheme
from ...core.vectors import Array
from ...log.record_columns import Ints
from ...scenario import Scenario
from ..aligned import AlignedRecords, Bools, DelayedPeer, hold_torque
from ..arm_rows import ArmRows, build_arm_rows
from ..dominance_history import DominanceHistory
from ..following import Following, build_following
from ..torque_sources import TorqueSplit

RATE_TOLERANCE = 1e-12
"""A torque this near to what its rate allows is at that limit, as a share of its largest."""
JUMP_TOLERANCE = 1e-12
"""A smaller change of e, rad, and of its derivative, rad/s, is no jump."""


class SiteConstants(NamedTuple):
    """Constants of a site; vectors per joint have shape (n,), per parameter (P,).

    Attributes:
        arm: the arm, of true parameters. Lambda, Kp, Kd: gains, 1/s and N m s/rad; in task
        space Lambda and Kd (N s/m) have shape (m,).
        Gamma: adaptation gain.
        low, high: limits of the estimates.
        tau_limit: largest torque of a joint, N m, shape () or (n,).
        axes: per coordinate of the task 1 if the site follows along it, else 0, and Lambda and
            Kd are 0; () in joint space.
        rho, width: largest robust torque of each joint, N m, and the r at which it is 0.71 of
        that, rad/s.
        friction: share of the joints' friction that the law compensates.
        tau_rate: largest rate of the torque of a joint, N m/s, shape () or (n,).
    """

    arm: ArmRows
    Lambda: Array
    Kp: Array
    Kd: Array
    Gamma: Array
    low: Array
    high: Array
    tau_limit: Array
    axes: tuple[float, ...] = ()
    rho: Array | float = 0.0
    width: Array | float = 1.0
    friction: Array | float = 1.0
    tau_rate: Array | float = np.inf

    @property
    def theta(self) -> Array:
        """The arm's true parameters, shape (P,)."""
        return self.arm.theta

    @property
    def weighing_Kd(self) -> Array:  # noqa: N802 - the paper's symbol
        """Kd as the weights of V see it: NaN along an axis that the site does not follow, shape
        (m,).
        """
        return np.where(np.array(self.axes) == 0.0, np.nan, self.Kd) if self.axes else self.Kd

    def robust_torque(self, r: Array) -> Array:
        """Returns the torque that opposes r besides Kp r, shape (K, n), N m."""
        return self.rho * r / np.sqrt(r**2 + self.width**2)

    @property
    def unknown_friction(self) -> Array:
        """The share of friction that the law does not compensate, of joints that have any,
        shape (n,).
        """
        share: Array = (1.0 - self.friction) * (
            self.arm.friction(np.ones((1, len(self.Kp))))[0] != 0.0
        )
        return share

    @property
    def adapts(self) -> Bools:
        """True for each parameter that the law adapts, shape (P,)."""
        return self.Gamma > 0.0


def derive_site_constants(scenario: Scenario, site: str) -> SiteConstants:
    """Returns the constants of a site whose law is the paper's, with a box or without."""
    spec = scenario.sites[site]
    arm = build_arm_rows(scenario, site)
    gains = scenario.gains(site)
    names = ("Lambda", "Kp", "Kd", "Gamma", "low", "high", "rho", "width", "friction")
    of_law = {name: np.array(getattr(gains, name)) for name in names}
    task = arm.task
    if task is not None:
        of_law |= {name: np.array(task.axes) * of_law[name] for name in ("Lambda", "Kd")}
    return SiteConstants(
        **of_law,
        arm=arm,
        axes=() if task is None else task.axes,
        tau_limit=np.asarray(spec.limits.tau_limit_nm, dtype=np.float64),
        tau_rate=np.asarray(spec.limits.motion.tau_rate, dtype=np.float64),
    )


class PeriodEnds(NamedTuple):
    """The ends of every period, shape (K - 1, n); `right` is before the jump, `middle` half-way
    through it.

    Attributes:
        following: True if the site followed its peers at both ends, shape (K - 1,).
        link: per peer the jump of e by the age of its sample, shape (peers, K - 1, n), rad; in
            task space, as all of e, (peers, K - 1, m), m.
        dominance: the jump of e by a step of dominance factors, rad.
        rule: the jump of e by the rule for stale peers, rad.
        r_left, r_right, r_middle: r = qd + Lambda e, rad/s.
        e_middle: rad.
        qd_des_left, qd_des_right: rad/s.
    """

    following: Bools
    link: Array
    dominance: Array
    rule: Array
    r_left: Array
    r_right: Array
    r_middle: Array
    e_middle: Array
    qd_des_left: Array
    qd_des_right: Array


@dataclass(frozen=True)
class SiteMotion:
    """Motion of a site and all that acts on it, over K rows: what its energies are computed
    from.

    Attributes:
        dominance, peers: its factors for its peers, and these as the site sees them, in the
        same order.
        torque: ON its arm.
        scheme: whether it holds tau_k, or extrapolates the torque.
        common: per coordinate 1 if all sites follow along it, else 0; () if they follow along
            all.
    """

    records: AlignedRecords
    constants: SiteConstants
    dominance: DominanceHistory
    peers: Mapping[str, DelayedPeer]
    torque: TorqueSplit
    scheme: Scheme = Scheme.SECOND_ORDER
    common: tuple[float, ...] = ()

    @cached_property
    def following(self) -> Following:
        """How an error of the reference becomes motion and torque of the joints."""
        at = self.records
        c = self.constants
        return build_following(c.arm, at.q, at.qd, c.Lambda)

    @cached_property
    def r(self) -> Array:
        """The sliding variable qd + Lambda e, Eq. (10), shape (K, n), rad/s; in task space qd -
        v.
        """
        return (
            self.records.qd
            - self.following.compute_reference(slice(None), self.records.e, self.records.ed)[0]
        )

    @cached_property
    def Yr(self) -> Array:  # noqa: N802 - the paper's symbol
        """Y'r of Eq. (15), shape (K, P)."""
        at = self.records
        v, a = self.following.compute_reference(slice(None), at.e, at.ed)
        return self.constants.arm.gradient(q=at.q, qd=at.qd, v=v, a=a, r=self.r)

    @cached_property
    def mean_Yr(self) -> Array:  # noqa: N802 - the paper's symbol
        """Y'r with which the scheme advances the estimate over a period, shape (K - 1, P)."""
        return (
            self.Yr[:-1]
            if self.scheme is Scheme.DIGITAL
            else 0.5 * (self.Yr[:-1] + self.Yr[1:])
        )

    def law_torque(self, rows: Ints) -> Array:
        """Returns tau of Eq. (13), without its limit, in some rows, shape (K, n), N m."""
        return self.control_torque(
            rows, self.records.e[rows], self.records.ed[rows], self.r[rows]
        )

    def control_torque(self, rows: Ints, e: Array, ed: Array, r: Array) -> Array:
        """Returns tau of Eq. (13) with these errors in place of the recorded ones, without its
        limit.
        """
        at = self.records
        c = self.constants
        v, a = self.following.compute_reference(rows, e, ed)
        model = c.arm.law_torque(at.theta_hat[rows], at.q[rows], at.qd[rows], v, a)
        found: Array = (
            model
            - c.Kp * r
            - self.following.compute_joint_torque(rows, c.Kd * ed)
            - c.robust_torque(r)
        )
        return found - (1.0 - c.friction) * c.arm.friction(v)

    @property
    def rests(self) -> Bools:
        """True if the torque may not be that of the law alone, shape (K,)."""
        at = self.records
        return at.rests if at.rests.size else np.zeros(len(at.known), dtype=np.bool_)

    @cached_property
    def nearest_torques(self) -> tuple[Array, Array]:
        """The least and the largest torque that a row may have, by its limit and its rate, (K,
        n), N m.
        """
        at = self.records
        c = self.constants
        low = np.broadcast_to(-c.tau_limit, at.tau.shape).copy()
        high = -low
        if np.any(np.isfinite(c.tau_rate)):
            # the first tick has none before it
            before = np.vstack([np.zeros(at.tau.shape[1]), at.tau[:-1]])
            most = np.broadcast_to(at.h_s * c.tau_rate, at.tau.shape).copy()
            most[0] = most[0] if at.first == 0 else np.inf
            low = np.maximum(low, before - most)
            high = np.minimum(high, before + most)
        return low, high

    @cached_property
    def limited(self) -> Bools:
        """True for each torque at its limit, or as far from the one before as it may be, shape
        (K, n).
        """
        low, high = self.nearest_torques
        c = self.constants
        tau = self.records.tau
        near = RATE_TOLERANCE * c.tau_limit if np.any(np.isfinite(c.tau_rate)) else 0.0
        found: Bools = (tau <= low + near) | (tau >= high - near)
        return found & ~self.rests[:, np.newaxis]

    @cached_property
    def ends(self) -> PeriodEnds:
        """The ends of its periods.

        While the site follows its peers, the smooth course of its reference is Eq. (6) with
        every stamp moving at rate one. Otherwise the rule decides: the trapezoid rule on the
        recorded derivative.
        """
        at = self.records
        views = list(self.peers.values())
        alpha = self.dominance
        following = at.follows[:-1] & at.follows[1:]
        here = following[:, np.newaxis]
        left = at.follows[:-1, np.newaxis]
        before, after, rate = (
            x[:, :, np.newaxis] for x in (alpha.before, alpha.alpha[1:], alpha.rate[:-1])
        )
        kept_q = np.sum([before[:, j] * v.delayed_end.q for j, v in enumerate(views)], axis=0)
        rates = [
            before[:, j] * v.delayed_end.qd + rate[:, j] * v.delayed_end.q
            for j, v in enumerate(views)
        ]
        qd_des_left = at.qd_des[:-1]
        qd_des_right = np.where(left, np.sum(rates, axis=0), at.qd_des[1:])
        ruled_q = at.q_des[:-1] + 0.5 * at.h_s * (qd_des_left + qd_des_right)
        jumps = [
            before[:, j] * (v.delayed_end.q - v.delayed.q[1:]) for j, v in enumerate(views)
        ]
        link = np.where(here, jumps, 0.0)
        steps = [(before[:, j] - after[:, j]) * v.delayed.q[1:] for j, v in enumerate(views)]
        dominance = np.where(here, np.sum(steps, axis=0), 0.0)
        rule = np.where(here, 0.0, np.where(left, kept_q, ruled_q) - at.q_des[1:])
        jump = link.sum(axis=0) + dominance + rule
        moved = self.following.compute_jump_of_r(slice(1, None), jump)
        return PeriodEnds(
            following,
            link,
            dominance,
            rule,
            r_left=self.r[:-1],
            r_right=self.r[1:] - moved,
            r_middle=self.r[1:] - 0.5 * moved,
            e_middle=at.e[1:] - 0.5 * jump,
            qd_des_left=qd_des_left,
            qd_des_right=qd_des_right,
        )


class FunctionalParts(NamedTuple):
    """V_i of a site by its four parts in the order of the module's docstring, each of shape
    (K,), J.
    """

    kinetic: Array
    parameter: Array
    position: Array
    delay: Array

    @property
    def total(self) -> Array:
        """V_i, shape (K,), J."""
        return self.kinetic + self.parameter + self.position + self.delay


def evaluate_functional(site: SiteMotion) -> FunctionalParts:
    """Returns the functional of a site along its records."""
    at = site.records
    c = site.constants
    r = site.r
    off = (at.theta_hat - c.theta)[:, c.adapts]
    in_transit = [_energy_in_transit(c, view) for view in site.peers.values()]
    return FunctionalParts(
        kinetic=0.5 * (r * c.arm.multiply_inertia(at.q, r)).sum(axis=1),
        parameter=0.5 * (off**2 / c.Gamma[c.adapts]).sum(axis=1),
        position=0.5 * (c.Lambda * c.Kd * at.e**2).sum(axis=1),
        delay=np.sum(
            [a * x for a, x in zip(site.dominance.alpha.T, in_transit, strict=True)], axis=0
        ),
    )


def _energy_in_transit(c: SiteConstants, view: DelayedPeer) -> Array:
    """Returns 1/2 int qd_j' Kd qd_j ds from the stamp of the sample in use to now, shape (K,),
    J.
    """
    return 0.5 * ((view.now.squares - view.delayed.squares) @ c.Kd)


class Increment(NamedTuple):
    """An amount of energy per period, shape (K - 1,), J: the two ends of a trapezoid, and a
    jump after it.
    """

    left: Array
    right: Array
    jump: Array

    @property
    def total(self) -> Array:
        """The amount of every period, shape (K - 1,), J."""
        return self.left + self.right + self.jump


def _trapezoid(
    site: SiteMotion, left: Array, right: Array, jump: Array | None = None
) -> Increment:
    half_s = 0.5 * site.records.h_s
    return Increment(
        half_s * left, half_s * right, np.zeros(len(left)) if jump is None else jump
    )


def _jump(amount: Array) -> Increment:
    return Increment(np.zeros(len(amount)), np.zeros(len(amount)), amount)


def _nothing(site: SiteMotion) -> Increment:
    return _jump(np.zeros(len(site.records.known) - 1))


def compute_dissipation(site: SiteMotion) -> dict[str, Increment]:
    """Returns what a site dissipates: r'Kp r, and 1/2 sum_j alpha_ij |qd_i - qd_j(t - T_ij)|^2.

    And r'(friction(qd) - friction(qd - r)) of joints with friction; r times a robust torque;
    and along axes that not all sites follow what they do not give back to each other.
    """
    at = site.records
    c = site.constants
    ends = site.ends
    alpha = site.dominance
    rate = at.shared_rate
    left = right = np.zeros(len(at.known) - 1)
    for j, view in enumerate(site.peers.values()):
        left = left + 0.5 * alpha.alpha[:-1, j] * _norm(c, rate[:-1] - view.delayed.qd[:-1])
        right = right + 0.5 * alpha.before[:, j] * _norm(c, rate[1:] - view.delayed_end.qd)
    damping = (
        (r * (c.Kp * r + c.robust_torque(r))).sum(axis=1) for r in (ends.r_left, ends.r_right)
    )
    found = {
        "damping": _trapezoid(site, *damping),
        "disagreement": _trapezoid(site, left, right),
    }
    if not all(site.common):
        found["open axes"] = compute_transfer(site, 1.0 - np.array(site.common))
    friction = [
        (r * (c.arm.friction(qd) - c.arm.friction(qd - r))).sum(axis=1)
        for r, qd in ((ends.r_left, at.qd[:-1]), (ends.r_right, at.qd[1:]))
    ]
    return {**found, "friction": _trapezoid(site, *friction)} if np.any(friction) else found


def compute_transfer(site: SiteMotion, axes: Array) -> Increment:
    """Returns int 1/2 |qd_i|^2 - 1/2 sum_j alpha_ij |qd_j|^2: what a site gives to those that
    follow it.

    That is along the axes of weight 1, and not along those of weight 0.
    """
    c = site.constants._replace(Kd=axes * site.constants.Kd)
    own = 0.5 * _norm(c, site.records.shared_rate)
    left = own[:-1]
    right = own[1:]
    for j, view in enumerate(site.peers.values()):
        peer = 0.5 * _norm(c, view.now.qd)
        left = left - site.dominance.alpha[:-1, j] * peer[:-1]
        right = right - site.dominance.before[:, j] * peer[1:]
    return _trapezoid(site, left, right)


def _norm(c: SiteConstants, x: Array) -> Array:
    norm: Array = (c.Kd * x**2).sum(axis=1)
    return norm


def compute_work(site: SiteMotion) -> dict[str, Increment]:
    """Returns the work done on a site, by its source: all that may raise V_i besides transfer."""
    torque = site.torque
    at = site.records
    stops = site.constants.arm.stop_torque(at.q, at.qd)
    return {
        "hands": torque_work(site, torque.operator_now, torque.operator_held),
        "walls": torque_work(site, torque.environment_now, torque.environment_held),
        **({"stops": torque_work(site, stops, np.zeros_like(stops))} if stops.any() else {}),
        **{
            f"{peer}->{site.records.site}": link_work(site, j)
            for j, peer in enumerate(site.peers)
        },
        "shares": dominance_change_work(site),
        "rule": stale_rule_work(site),
        "torque limit": torque_limit_work(site),
        "estimates": estimate_work(site),
        **(
            {"friction": unknown_friction_work(site)}
            if site.constants.unknown_friction.any()
            else {}
        ),
        **({"singular poses": singular_pose_work(site)} if site.constants.axes else {}),
    }


def torque_work(site: SiteMotion, now: Array, held: Array) -> Increment:
    """Returns the work int r' tau_h of a torque ON the arm, one of the present and one held,
    (K, n), N m.
    """
    left = (site.ends.r_left * (now[:-1] + held[:-1])).sum(axis=1)
    return _trapezoid(site, left, (site.ends.r_right * (now[1:] + held[:-1])).sum(axis=1))


def link_work(site: SiteMotion, j: int) -> Increment:
    """Returns the work of the link from peer j: the exact change of V where the age of its
    sample changes.

    With s' in place of s + h at the end of a period: (Lambda M r + Lambda Kd e)' de, with r and
    e half-way through the jump and de what this link adds to it, less 1/2 alpha_ij int qd_j' Kd
    qd_j ds from s + h to s'. For an age that varies smoothly this is the integral of the
    theorem's missing term with dT/dt.
    """
    view = list(site.peers.values())[j]
    stored = 0.5 * (view.delayed_end.squares - view.delayed.squares[1:]) @ site.constants.Kd
    return _jump(
        _energy_of_jump(site, site.ends.link[j]) + site.dominance.before[:, j] * stored
    )


def dominance_change_work(site: SiteMotion) -> Increment:
    """Returns the work of a change of dominance, without that of beta: what a ramp or a step
    adds to V_i.

    1/2 sum_j alpha_ij' int qd_j' Kd qd_j ds + qd_i' Kd sum_j alpha_ij' q_j(t - T_ij): the
    second because ed, and with it the damping, contains the ramp.
    """
    at = site.records
    c = site.constants
    alpha = site.dominance
    ends = site.ends
    if alpha.constant:
        return _nothing(site)
    left = right = np.zeros(len(at.known) - 1)
    jump = _energy_of_jump(site, ends.dominance)
    for j, view in enumerate(site.peers.values()):
        stored = _energy_in_transit(c, view)
        rate = alpha.rate[:-1, j]
        kept = 0.5 * (view.now.squares[1:] - view.delayed_end.squares) @ c.Kd
        followed_rate = np.where(ends.following, rate, 0.0)
        left = left + rate * stored[:-1]
        left = left + followed_rate * (at.shared_rate[:-1] * c.Kd * view.delayed.q[:-1]).sum(
            axis=1
        )
        right = right + rate * kept
        right = right + followed_rate * (at.shared_rate[1:] * c.Kd * view.delayed_end.q).sum(
            axis=1
        )
        jump = jump + (alpha.alpha[1:, j] - alpha.before[:, j]) * stored[1:]
    return _trapezoid(site, left, right, jump)


def stale_rule_work(site: SiteMotion) -> Increment:
    """Returns the work of the rule for stale peers: all that moves the reference while it is
    not Eq. (6).
    """
    at = site.records
    alpha = site.dominance
    ends = site.ends
    ruled = ~ends.following
    if not ruled.any():
        return _nothing(site)
    views = list(enumerate(site.peers.values()))
    seen = np.sum(
        [alpha.alpha[:-1, j, None] * view.delayed.qd[:-1] for j, view in views], axis=0
    )
    kept = np.sum([alpha.before[:, j, None] * view.delayed_end.qd for j, view in views], axis=0)
    rate = at.shared_rate
    left = (rate[:-1] * site.constants.Kd * (ends.qd_des_left - seen)).sum(axis=1)
    right = (rate[1:] * site.constants.Kd * (ends.qd_des_right - kept)).sum(axis=1)
    return _trapezoid(
        site,
        *(np.where(ruled, x, 0.0) for x in (left, right, _energy_of_jump(site, ends.rule))),
    )


def torque_limit_work(site: SiteMotion) -> Increment:
    """Returns the work of what limits, or a rest, kept from the arm: int r' (tau - tau of Eq.
    (13)).
    """
    at = site.records
    cut = np.flatnonzero(site.limited.any(axis=1) | site.rests)
    power = np.zeros(len(at.known))
    if len(cut):
        power[cut] = (site.r[cut] * (at.tau[cut] - site.law_torque(cut))).sum(axis=1)
    return _trapezoid(site, power[:-1], power[1:])


def unknown_friction_work(site: SiteMotion) -> Increment:
    """Returns the work -int r' friction(v) of the share of friction that the law does not
    compensate.
    """
    at = site.records
    c = site.constants
    ends = site.ends
    left, right = (
        -(r * (1.0 - c.friction) * c.arm.friction(qd - r)).sum(axis=1)
        for r, qd in ((ends.r_left, at.qd[:-1]), (ends.r_right, at.qd[1:]))
    )
    return _trapezoid(site, left, right)


def singular_pose_work(site: SiteMotion) -> Increment:
    """Returns the work of the damping near singular poses: int r'M(a - v') - (J r - x' - Lambda
    e)'Kd ed.

    Both are zero where J J+ = I.
    """
    at = site.records
    c = site.constants
    ends = site.ends
    powers = []
    for e, rows, qd_des, r in (
        (at.e[:-1], slice(0, -1), ends.qd_des_left, ends.r_left),
        (2.0 * ends.e_middle - at.e[1:], slice(1, None), ends.qd_des_right, ends.r_right),
    ):
        missed, a_missed = site.following.compute_damping_deviation(rows, e)
        ed = at.shared_rate[rows] - qd_des
        power = -(missed * c.Kd * ed).sum(axis=1)
        if a_missed.any():
            power = power + (c.arm.multiply_inertia(at.q[rows], r) * a_missed).sum(axis=1)
        powers.append(power)
    return _trapezoid(site, *powers)


def measure_torque_error(site: SiteMotion) -> Array:
    """Returns by how much recorded torques differ from Eq. (13) within its limits, shape (K,),
    N m.

    The largest of all joints; 0 where there is no record, or where the site rests.
    """
    at = site.records
    law = site.law_torque(np.arange(len(at.known)))
    error: Array = np.abs(at.tau - np.clip(law, *site.nearest_torques)).max(axis=1)
    return np.where(at.known & ~site.rests, error, 0.0)


def estimate_work(site: SiteMotion) -> Increment:
    """Returns the work of estimates that do not follow Eq. (15): held in their box, fixed, or
    at rest.

    The box lessens 1/2 (theta_hat - theta)' Gamma^-1 (theta_hat - theta) where it holds the
    truth; a parameter that is not adapted leaves r' Y (theta_hat - theta) without its
    counterpart.
    """
    at = site.records
    c = site.constants
    off = at.theta_hat - c.theta
    still = np.concatenate([[False], (np.diff(off, axis=0) == 0.0).all(axis=1)]) & site.rests
    at_edge = (
        ((at.theta_hat <= c.low) | (at.theta_hat >= c.high))[1:]
        & c.adapts
        & ~still[1:, np.newaxis]
    )
    wrong = (off != 0.0) & (~c.adapts | still[:, np.newaxis])
    if not (at_edge.any() or wrong.any()):
        return _nothing(site)
    # what the box kept the estimate from
    held = np.diff(off, axis=0) + at.h_s * c.Gamma * site.mean_Yr
    with np.errstate(divide="ignore", invalid="ignore"):
        amount = np.where(at_edge, 0.5 * (off[:-1] + off[1:]) * held / c.Gamma, 0.0).sum(axis=1)
    power = np.where(wrong, site.Yr * off, 0.0).sum(axis=1)
    return _trapezoid(site, power[:-1], power[1:], amount)


def compute_sampling_work(site: SiteMotion) -> Increment:
    """Returns the work of the scheme: of the torque that is held in place of Eq. (13), of its
    step of (15).

    int r' (u - tau), with u = tau_k of `digital` or the extrapolated one of `second_order`, and
    tau straight to its value before the jump; and the scheme's step of the estimate in place of
    the trapezoid rule up to there. It is no part of the balance: what that leaves without this
    is unexplained.
    """
    at = site.records
    c = site.constants
    ends = site.ends
    u = hold_torque(at.tau, c.tau_limit, digital=site.scheme is Scheme.DIGITAL)[:-1]
    tau_right, Yr_right = _evaluate_before_jump(site)
    off_law = u - 0.5 * (at.tau[:-1] + tau_right)
    amount = at.h_s * (0.5 * (ends.r_left + ends.r_right) * off_law).sum(axis=1)
    off = (at.theta_hat - c.theta) * c.adapts
    missed = 0.5 * (site.Yr[:-1] + Yr_right) - site.mean_Yr
    return _jump(amount + 0.5 * at.h_s * ((off[1:] + off[:-1]) * missed).sum(axis=1))


def _evaluate_before_jump(site: SiteMotion) -> tuple[Array, Array]:
    at = site.records
    c = site.constants
    ends = site.ends
    tau = at.tau[1:].copy()
    Yr = site.Yr[1:].copy()
    e = 2.0 * ends.e_middle - at.e[1:]
    moved = np.abs(e - at.e[1:]) + np.abs(ends.qd_des_right - at.qd_des[1:]) > JUMP_TOLERANCE
    rows = np.flatnonzero(moved.any(axis=1))
    e = e[rows]
    ed = (at.shared_rate[1:] - ends.qd_des_right)[rows]
    r = ends.r_right[rows]
    later = rows + 1
    v, a = site.following.compute_reference(later, e, ed)
    Yr[rows] = c.arm.gradient(q=at.q[later], qd=at.qd[later], v=v, a=a, r=r)
    found = np.clip(site.control_torque(later, e, ed, r), -c.tau_limit, c.tau_limit)
    bound = site.rests | (site.limited.any(axis=1) & np.any(np.isfinite(c.tau_rate)))
    # then no jump of e moves it
    tau[rows] = np.where(bound[later, np.newaxis], tau[rows], found)
    return tau, Yr


def _energy_of_jump(site: SiteMotion, de: Array) -> Array:
    """Returns the exact part that `de` has in the change of 1/2 (r'M r + e' Lambda Kd e), shape
    (K - 1,), J.

    Both are quadratic in e, so that the gradient half-way through the whole jump gives it,
    linear in `de`.
    """
    c = site.constants
    ends = site.ends
    if not de.any():
        return np.zeros(len(de))
    momentum = c.arm.multiply_inertia(site.records.q[1:], ends.r_middle)
    change: Array = (momentum * site.following.compute_jump_of_r(slice(1, None), de)).sum(
        axis=1
    )
    change += (c.Kd * ends.e_middle * c.Lambda * de).sum(axis=1)
    return change
