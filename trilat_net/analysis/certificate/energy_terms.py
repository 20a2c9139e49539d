"""Evaluates the energy of an arm in the stability proof, and all terms that change it.

Site i follows its peer j with the dominance factor alpha_ij, using delayed samples that the
peer sent. The energy of site i in J is

    V_i = 1/2 ( r'M r + (theta_hat - theta)' Gamma^-1 (theta_hat - theta) + e' Lambda Kd e
                + sum_j alpha_ij int qd_j' Kd qd_j ds )

where ' means transposed. The error e is the difference between the joint angles and their
reference, and ed its derivative. The filtered error is r = qd + Lambda e, with the joint
velocities qd (qd_i for site i). M is the inertia matrix of the arm, theta its dynamic
parameters, and theta_hat their estimates. Gamma, Lambda, Kp and Kd are gains. The integral runs
over the time s, from when the sample in use was sent until now.

With |x|^2 = x'Kd x and the delay T from peer j, the derivative without external torques is

    dV_i/dt = -r'Kp r - 1/2 sum_j alpha_ij |qd_i - qd_j(t - T)|^2
              - 1/2 |qd_i|^2 + 1/2 sum_j alpha_ij |qd_j|^2

The first line dissipates energy. The second line transfers energy between sites, and cancels in
a suitably weighted sum over all sites. In task space, e and qd_j refer to the end effectors.
docs/theory/certificate-energy.md explains the derivation.

Each term is integrated over a tick period with the trapezoidal rule. At the end of the period,
e jumps to the value of the next sample. The energy of this jump is computed exactly.

Invariant:
    - The work of operators and environments is computed with r instead of qd, because the
      theorem requires them to be passive with respect to r.
    - A site has an energy function only if it uses the adaptive law and theta is known.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ...core import Array
from ...log import Ints
from ...scenario import Scenario
from ..aligned import AlignedRecords, Bools, DelayedPeer, hold_torque
from ..arm_rows import ArmRows, build_arm_rows
from ..dominance_history import DominanceHistory
from ..following import Following, build_following
from ..row_reductions import any_in_rows, max_rows, sum_rows
from ..torque_sources import TorqueSplit

RATE_TOLERANCE = 1e-12
"""Largest distance from the rate limit at which a torque counts as limited.

It is a share of the largest torque.
"""
JUMP_TOLERANCE = 1e-12
"""Changes of e (rad) or of its derivative (rad/s) that exceed this value count as jumps."""
_GAIN_NAMES = (
    "Lambda",
    "Kp",
    "Kd",
    "Gamma",
    "low",
    "high",
    "rho",
    "width",
    "friction",
)
"""Names of the gains that `SiteConstants` takes from the settings of the control law."""


class SiteConstants(NamedTuple):
    """Gains, limits and arm parameters of a site that enter the energy function V_i.

    Vectors per joint have the shape (n,), and vectors per arm parameter (P,). In task space,
    vectors per task coordinate have the shape (m,). The docstring of the module defines r, e,
    ed and the gains.

    Attributes:
        arm: The arm with its true parameters.
        Lambda: Gain of the error e, in 1/s. Per coordinate in task space.
        Kp: Gain of the filtered error r, in N m s/rad.
        Kd: Gain of ed, in N m s/rad. In task space per coordinate, in N s/m.
        Gamma: Adaptation gains of the estimates.
        low: Lower limits of the estimates.
        high: Upper limits of the estimates.
        tau_limit: Largest torque of a joint, in N m, shape () or (n,).
        axes: For each coordinate of the task, 1 if the site follows along it, else 0. In the
            latter case, Lambda and Kd are also 0. Empty in joint space.
        rho: Largest robust torque of each joint, an additional torque against r, in N m. 0 if
            the law has none.
        width: Value of r at which the robust torque is 0.71 of the largest, in rad/s.
        friction: Fraction of the joint friction for which the law compensates.
        tau_rate: Largest rate of the torque of a joint, in N m/s, shape () or (n,).
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
        """True dynamic parameters of the arm, shape (P,), which the control law tries to learn.

        They combine masses, inertias and lengths of the links. The stability proof uses the
        difference between the learnt and the true parameters.
        """
        return self.arm.theta

    @property
    def weighing_Kd(self) -> Array:  # noqa: N802 - the paper's symbol
        """Damping gain Kd, which determines the weight of the site in the total energy.

        The shape is (m,) for m coordinates. Kd is NaN along axes that the site does not follow,
        where it has no effect.
        """
        if not self.axes:
            return self.Kd
        is_free = np.array(self.axes) == 0.0
        return np.where(is_free, np.nan, self.Kd)

    def robust_torque(self, r: Array) -> Array:
        """Returns the robust torque, which the control law adds to its damping Kp r.

        It limits the effect of disturbances that the law cannot learn by adaptation, such as
        noise.

        Args:
            r: Filtered errors (velocity errors plus a multiple of the position errors), shape
                (K, n), in rad/s.

        Returns:
            Torque with the sign of r, shape (K, n), in N m.
        """
        root = np.sqrt(r**2 + self.width**2)
        return self.rho * r / root

    @property
    def unknown_friction(self) -> Array:
        """Fraction of each joint's friction for which the law does not compensate, shape (n,).

        The fraction is 0 for a joint without friction. The energy balance must include the work
        of this friction, which an adaptive law cannot learn.
        """
        joints = len(self.Kp)
        unit_speeds = np.ones((1, joints))
        friction_torque = self.arm.friction(unit_speeds)[0]
        has_friction = friction_torque != 0.0
        share: Array = (1.0 - self.friction) * has_friction
        return share

    @property
    def adapts(self) -> Bools:
        """Marks the arm parameters that the law learns during the run, shape (P,).

        These are the parameters with a positive adaptation gain Gamma. The others keep their
        values from the scenario.
        """
        return self.Gamma > 0.0

    @classmethod
    def derive(cls, scenario: Scenario, site: str) -> "SiteConstants":
        """Collects the gains, limits and arm parameters of one site from the scenario.

        The arm must use the adaptive control law, and its parameters must be known.

        Args:
            scenario: The scenario, which defines the gains.
            site: Name of the site.
        """
        arm = build_arm_rows(scenario, site)
        gains = scenario.gains(site)
        limits = scenario.sites[site].limits
        gain_arrays = {}
        for name in _GAIN_NAMES:
            gain = getattr(gains, name)
            gain_arrays[name] = np.array(gain)

        axes: tuple[float, ...] = ()
        if arm.task is not None:
            axes = arm.task.axes
            followed_axes = np.array(axes)
            for name in ("Lambda", "Kd"):
                gain_arrays[name] = followed_axes * gain_arrays[name]
        return cls(
            **gain_arrays,
            arm=arm,
            axes=axes,
            tau_limit=np.asarray(limits.tau_limit_nm, dtype=np.float64),
            tau_rate=np.asarray(limits.motion.tau_rate, dtype=np.float64),
        )


class _PeriodEnds(NamedTuple):
    """The state of a site at both ends of all K - 1 tick periods, shape (K - 1, n) each.

    At the end of a period a new sample of a peer comes into use, and the error e jumps. In the
    names of the attributes, `left` means the start of the period, `right` its end before the
    jump, and `middle` half-way through the jump. In task space, e and its jumps have m
    coordinates, in m.

    Attributes:
        following: True if the site followed its peers at both ends, shape (K - 1,).
        link: For each peer, the jump of e because the age of its sample changes, shape (peers,
            K - 1, n), in rad.
        dominance: Jump of e because dominance factors change in a step, in rad.
        rule: Jump of e because of the rule for silent peers, which replaces the reference when
            samples stop arriving, in rad.
        r_left: Filtered error r = qd + Lambda e at the start, in rad/s.
        r_right: r before the jump, in rad/s.
        r_middle: r half-way through the jump, in rad/s.
        e_middle: e half-way through the jump, in rad.
        qd_des_left: Velocity of the reference at the start, in rad/s.
        qd_des_right: Velocity of the reference before the jump, in rad/s.
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
    """The recorded motion of a site over K records, and everything that acts on it.

    All energies of the site are computed from this object.

    Attributes:
        records: Records of the site.
        constants: Gains and limits of the site, and its arm.
        dominance: Dominance factors of the site.
        peers: Motion of the peers as received by the site, in the order of the dominance
            factors.
        torque: External torque on the arm, split into that of operators and that of
            environments.
        scheme: "digital" if the controller holds the torque of a tick until the next tick,
            "second_order" if the controller extrapolates the torque.
        common: 1 for each coordinate that all sites follow, and 0 for the others. Empty if all
            sites follow all coordinates.
    """

    records: AlignedRecords
    constants: SiteConstants
    dominance: DominanceHistory
    peers: Mapping[str, DelayedPeer]
    torque: TorqueSplit
    scheme: str = "second_order"
    common: tuple[float, ...] = ()

    @cached_property
    def following(self) -> Following:
        """Converts errors between the arms to motion and torque of this arm's joints.

        The conversion differs between arms that follow joint by joint and arms that follow with
        their end effectors.
        """
        records = self.records
        c = self.constants
        return build_following(c.arm, records.q, records.qd, c.Lambda)

    @cached_property
    def r(self) -> Array:
        """Filtered error r (sliding variable) of the site, shape (K, n), in rad/s.

        This is the joint velocity minus the reference velocity. In joint space r = qd + Lambda
        e, with the joint velocity qd, the synchronisation error e and the gain Lambda in 1/s.
        """
        records = self.records
        all_rows = slice(None)
        v, _ = self.following.compute_reference(all_rows, records.e, records.ed)
        return records.qd - v

    @cached_property
    def Yr(self) -> Array:  # noqa: N802 - the paper's symbol
        """Direction Y'r in which the adaptive law changes its estimates, shape (K, P).

        Y is the regressor, which yields torques when multiplied by the P dynamic parameters,
        and Y' its transpose. The filtered error r is the joint velocity minus the reference
        velocity.
        """
        records = self.records
        all_rows = slice(None)
        v, a = self.following.compute_reference(all_rows, records.e, records.ed)
        return self.constants.arm.gradient(
            q=records.q,
            qd=records.qd,
            v=v,
            a=a,
            r=self.r,
        )

    @cached_property
    def mean_Yr(self) -> Array:  # noqa: N802 - the paper's symbol
        """Direction Y'r in which the law changed its estimates in each tick period.

        Y is the regressor of the arm's dynamics, Y' its transpose, and r the filtered error. As
        in the law, Y'r is evaluated at the start of the period under the scheme `digital`, and
        averaged over both ends of the period under `second_order`. The shape is (K - 1, P).
        """
        if self.scheme == "digital":
            return self.Yr[:-1]
        Yr_left = self.Yr[:-1]
        Yr_right = self.Yr[1:]
        return 0.5 * (Yr_left + Yr_right)

    def law_torque(self, rows: Ints) -> Array:
        """Returns the torque that the control law demands, before limits are applied.

        The torque is recomputed from the records. If it differs from the recorded torque, the
        records are false or the torque was limited.

        Args:
            rows: Rows of the records at which the law is evaluated, shape (K,).

        Returns:
            Torque, shape (K, n), in N m.
        """
        return self.control_torque(
            rows,
            e=self.records.e[rows],
            ed=self.records.ed[rows],
            r=self.r[rows],
        )

    def control_torque(
        self,
        rows: Ints,
        e: Array,
        ed: Array,
        r: Array,
    ) -> Array:
        """Returns the torque that the control law would demand for given errors.

        Pose and parameter estimates are taken from the records, but the errors may differ from
        the recorded ones. This gives, for example, the torque just before a new sample of a
        peer was used.

        Args:
            rows: Rows of the records whose pose and estimates are used, shape (K,).
            e: Synchronisation errors, shape (K, n), in rad.
            ed: Derivatives of the synchronisation errors, shape (K, n), in rad/s.
            r: Filtered errors, shape (K, n), in rad/s.

        Returns:
            Torque before limits are applied, shape (K, n), in N m.
        """
        records = self.records
        c = self.constants
        v, a = self.following.compute_reference(rows, e, ed)
        model = c.arm.law_torque(
            theta_hat=records.theta_hat[rows],
            q=records.q[rows],
            qd=records.qd[rows],
            v=v,
            a=a,
        )

        damping = self.following.compute_joint_torque(rows, c.Kd * ed)
        robust = c.robust_torque(r)
        tau: Array = model - c.Kp * r - damping - robust
        # `model` compensates all of the friction
        uncompensated_share = 1.0 - c.friction
        uncompensated = uncompensated_share * c.arm.friction(v)
        return tau - uncompensated

    @property
    def rests(self) -> Bools:
        """Marks the records in which the arm is coming to rest, or did so shortly before.

        While the arm comes to rest, for example because no samples of a peer arrive, the site
        adds a braking torque. The recorded torque may therefore differ from the torque of the
        control law and must not be compared with it. The shape is (K,).
        """
        records = self.records
        if records.rests.size:
            return records.rests
        return np.zeros(len(records.known), dtype=np.bool_)

    @cached_property
    def torque_bounds(self) -> tuple[Array, Array]:
        """Smallest and largest torque that the limits permit in each record, in N m.

        The torque limit applies to every record. The rate limit also bounds the change from the
        torque of the previous record.

        Returns:
            Lower and upper bounds, each of shape (K, n).
        """
        records = self.records
        limits = self.constants
        shape = records.tau.shape
        lower = np.broadcast_to(-limits.tau_limit, shape).copy()
        upper = -lower
        if not np.any(np.isfinite(limits.tau_rate)):
            return lower, upper

        torque_before_start = np.zeros(shape[1])
        earlier_torques = records.tau[:-1]
        previous_torque = np.vstack([torque_before_start, earlier_torques])
        change_limit = records.h_s * limits.tau_rate
        largest_change = np.broadcast_to(change_limit, shape).copy()
        if records.first != 0:
            # The records start in the middle of the run: the torque before them is unknown.
            largest_change[0] = np.inf
        lower_with_rate = np.maximum(lower, previous_torque - largest_change)
        upper_with_rate = np.minimum(upper, previous_torque + largest_change)
        return lower_with_rate, upper_with_rate

    @cached_property
    def limited(self) -> Bools:
        """Marks each recorded torque that reaches a limit of its joint, shape (K, n).

        The limit is either the largest torque or the largest change of torque per tick. At a
        limit, the arm may have received less torque than the control law demanded, which
        violates a premise of the stability theorem.
        """
        low, high = self.torque_bounds
        c = self.constants
        tau = self.records.tau
        tolerance: Array | float = 0.0
        if np.any(np.isfinite(c.tau_rate)):
            tolerance = RATE_TOLERANCE * c.tau_limit
        is_low = tau <= low + tolerance
        is_high = tau >= high - tolerance
        limited: Bools = is_low | is_high
        return limited & ~self.rests[:, np.newaxis]

    @cached_property
    def ends(self) -> _PeriodEnds:
        """State of the site at the start and end of every tick period.

        The reference is the mean of the delayed peer motions, weighted by the dominance
        factors. Within a period, the delays are assumed constant, and the reference moves
        smoothly. At the end of the period it jumps to its next recorded value. If samples of a
        peer stop arriving, the rule for silent peers determines the reference instead. The
        recorded velocity of the reference is then integrated with the trapezoidal rule.
        """
        records = self.records
        dominance = self.dominance
        is_following_left = records.follows[:-1]
        is_following_right = records.follows[1:]
        following = is_following_left & is_following_right
        # for all joints
        follows_at_both = following[:, np.newaxis]
        follows_at_left = is_following_left[:, np.newaxis]

        # the reference of Eq. (6) and its derivative at the end of the period, before any jump
        q_terms = []
        qd_terms = []
        link_jumps = []
        dominance_jumps = []
        for j, peer_motion in enumerate(self.peers.values()):
            alpha_right = dominance.before[:, j, np.newaxis]
            alpha_next = dominance.alpha[1:, j, np.newaxis]
            alpha_rate = dominance.rate[:-1, j, np.newaxis]
            q_end = peer_motion.delayed_end.q
            qd_end = peer_motion.delayed_end.qd
            q_next = peer_motion.delayed.q[1:]
            q_terms.append(alpha_right * q_end)
            qd_terms.append(alpha_right * qd_end + alpha_rate * q_end)
            link_jumps.append(alpha_right * (q_end - q_next))
            dominance_jumps.append((alpha_right - alpha_next) * q_next)
        q_des_followed = np.sum(q_terms, axis=0)
        qd_des_followed = np.sum(qd_terms, axis=0)

        qd_des_left = records.qd_des[:-1]
        qd_des_next = records.qd_des[1:]
        qd_des_right = np.where(follows_at_left, qd_des_followed, qd_des_next)
        half_s = 0.5 * records.h_s
        rise_of_q_des = half_s * (qd_des_left + qd_des_right)
        q_des_ruled = records.q_des[:-1] + rise_of_q_des
        q_des_right = np.where(follows_at_left, q_des_followed, q_des_ruled)

        # the jump of e by its causes
        link = np.where(follows_at_both, link_jumps, 0.0)
        all_dominance_jumps = np.sum(dominance_jumps, axis=0)
        dominance_jump = np.where(follows_at_both, all_dominance_jumps, 0.0)
        jump_of_q_des = q_des_right - records.q_des[1:]
        rule = np.where(follows_at_both, 0.0, jump_of_q_des)
        jump_of_e = link.sum(axis=0) + dominance_jump + rule

        rows_after_jumps = slice(1, None)
        jump_of_r = self.following.compute_jump_of_r(rows_after_jumps, jump_of_e)
        r_next = self.r[1:]
        e_next = records.e[1:]
        return _PeriodEnds(
            following=following,
            link=link,
            dominance=dominance_jump,
            rule=rule,
            r_left=self.r[:-1],
            r_right=r_next - jump_of_r,
            r_middle=r_next - 0.5 * jump_of_r,
            e_middle=e_next - 0.5 * jump_of_e,
            qd_des_left=qd_des_left,
            qd_des_right=qd_des_right,
        )

    def evaluate_functional(self) -> "FunctionalParts":
        """Computes the energy V_i of a site in the stability proof at each of its K records.

        See the docstring of the module for the equation.

        Returns:
            The four parts of the energy (filtered error, parameter estimates, synchronisation
            error and delay), which figures and the certificate show separately.
        """
        records = self.records
        c = self.constants
        r = self.r
        momentum = c.arm.multiply_inertia(records.q, r)
        r_M_r = _dot_rows(r, momentum)

        parameter_error = records.theta_hat - c.theta
        adapted_error = parameter_error[:, c.adapts]
        adapted_Gamma = c.Gamma[c.adapts]
        scaled_squares = adapted_error**2 / adapted_Gamma
        stiffness = c.Lambda * c.Kd
        squared_e = records.e**2
        e_K_e = _dot_rows(stiffness, squared_e)

        delay_terms = []
        for j, peer_motion in enumerate(self.peers.values()):
            alpha = self.dominance.alpha[:, j]
            delay_terms.append(alpha * _energy_in_transit(c, peer_motion))
        return FunctionalParts(
            kinetic=0.5 * r_M_r,
            parameter=0.5 * sum_rows(scaled_squares),
            position=0.5 * e_K_e,
            delay=np.sum(delay_terms, axis=0),
        )

    def compute_dissipation(self) -> "dict[str, Increment]":
        """Computes the energy that the controller of a site dissipates in each tick period.

        The kinds of energy are:

        - damping: the work of the damping and of the robust torque, which both oppose the
          filtered error r.
        - disagreement: half the squared difference between the velocity of the site and the
          delayed velocity of each peer, weighted with the dominance factor of the peer and the
          gain Kd.
        - friction, if the joints have any: the work r'(friction(qd) - friction(qd - r)), with
          the joint velocities qd.
        - open axes: the energy that the site passes to others along axes that not all sites
          follow. This kind is left out if all sites follow all axes.

        Returns:
            A mapping from kind to energy.
        """
        records = self.records
        c = self.constants
        ends = self.ends
        dominance = self.dominance
        rate = records.shared_rate
        rate_left = rate[:-1]
        rate_right = rate[1:]
        periods = len(records.known) - 1
        left = np.zeros(periods)
        right = left
        for j, peer_motion in enumerate(self.peers.values()):
            difference_left = rate_left - peer_motion.delayed.qd[:-1]
            difference_right = rate_right - peer_motion.delayed_end.qd
            squared_left = _weighted_square(c, difference_left)
            squared_right = _weighted_square(c, difference_right)
            half_alpha_left = 0.5 * dominance.alpha[:-1, j]
            half_alpha_right = 0.5 * dominance.before[:, j]
            left = left + half_alpha_left * squared_left
            right = right + half_alpha_right * squared_right

        def damping_power(r: Array) -> Array:
            """Returns the power dissipated by the damping of the control law, in W."""
            torque = c.Kp * r + c.robust_torque(r)
            return _dot_rows(r, torque)

        def friction_power(r: Array, qd: Array) -> Array:
            """Returns the power dissipated by uncompensated friction, in W."""
            friction = c.arm.friction(qd)
            torque = friction - c.arm.friction(qd - r)
            return _dot_rows(r, torque)

        damping_left = damping_power(ends.r_left)
        damping_right = damping_power(ends.r_right)
        dissipation = {
            "damping": _trapezoid(self, damping_left, damping_right),
            "disagreement": _trapezoid(self, left, right),
        }
        if not all(self.common):
            open_axes = 1.0 - np.array(self.common)
            dissipation["open axes"] = self.compute_transfer(open_axes)

        qd_left = records.qd[:-1]
        qd_right = records.qd[1:]
        friction_left = friction_power(ends.r_left, qd_left)
        friction_right = friction_power(ends.r_right, qd_right)
        if friction_left.any() or friction_right.any():
            dissipation["friction"] = _trapezoid(self, friction_left, friction_right)
        return dissipation

    def compute_transfer(self, axes: Array) -> "Increment":
        """Computes the energy that a site passes to its followers, minus what it receives.

        In each tick period this is the integral of 1/2 qd_i'Kd qd_i - 1/2 sum_j alpha_ij
        qd_j'Kd qd_j, where qd_i is the velocity of the site, qd_j that of its peer j, Kd the
        damping gain, and alpha_ij the dominance factor. These energies cancel in the weighted
        sum over all sites.

        Args:
            axes: 1 for each of the m coordinates to include, and 0 for the others, shape (m,).
                A scalar, shape (), applies to all coordinates.
        """
        dominance = self.dominance
        Kd_of_axes = axes * self.constants.Kd
        c = self.constants._replace(Kd=Kd_of_axes)

        site_power = 0.5 * _weighted_square(c, self.records.shared_rate)
        left = site_power[:-1]
        right = site_power[1:]
        for j, peer_motion in enumerate(self.peers.values()):
            alpha_left = dominance.alpha[:-1, j]
            alpha_right = dominance.before[:, j]
            peer_power = 0.5 * _weighted_square(c, peer_motion.now.qd)
            left = left - alpha_left * peer_power[:-1]
            right = right - alpha_right * peer_power[1:]
        return _trapezoid(self, left, right)

    def compute_work(self) -> "dict[str, Increment]":
        """Computes the work on a site in each tick period, by source.

        The sources are operators, environments, links, changes of settings, and limits:
        everything that can raise the site's energy function V_i except the transfer between
        sites.
        """
        torque = self.torque
        records = self.records
        c = self.constants
        stops = c.arm.stop_torque(records.q, records.qd)
        work = {
            "hands": self.compute_torque_work(torque.operator_now, torque.operator_held),
            "walls": self.compute_torque_work(torque.environment_now, torque.environment_held),
        }
        if stops.any():
            no_torque = np.zeros_like(stops)
            work["stops"] = self.compute_torque_work(stops, no_torque)

        for j, peer in enumerate(self.peers):
            work[f"{peer}->{records.site}"] = self.compute_link_work(j)
        work["shares"] = self.compute_dominance_work()
        work["rule"] = _stale_rule_work(self)
        work["torque limit"] = _torque_limit_work(self)
        work["estimates"] = _estimate_work(self)

        if c.unknown_friction.any():
            work["friction"] = _unknown_friction_work(self)
        if c.axes:
            work["singular poses"] = _singular_pose_work(self)
        return work

    def compute_torque_work(self, now: Array, held: Array) -> "Increment":
        """Computes the work of an external torque on the arm in each tick period.

        As in the stability proof, the work is the integral of r' times the torque: the filtered
        error r takes the place of the joint velocity.

        Args:
            now: Component of the torque that follows the motion continuously, shape (K, n), in
                N m.
            held: Component of the torque that is computed once per tick and held, shape (K, n),
                in N m.
        """
        torque_left = now[:-1] + held[:-1]
        torque_right = now[1:] + held[:-1]
        power_left = _dot_rows(self.ends.r_left, torque_left)
        power_right = _dot_rows(self.ends.r_right, torque_right)
        return _trapezoid(self, power_left, power_right)

    def compute_link_work(self, j: int) -> "Increment":
        """Returns the work of the link from peer j: the change of V_i at each new sample.

        At the end of a period of length h, a new sample, sent at s', replaces the old sample,
        sent at s. Within the period, the age of the sample in use is treated as constant, so
        the state of the peer at s + h is used just before the change. With r and e half-way
        through the jump, and de the jump of e caused by this link, the work is exactly

            (Lambda M r + Lambda Kd e)' de - 1/2 alpha_ij int qd_j' Kd qd_j ds from s + h to s'.

        If the delay T varies smoothly, this work is the integral of the term with dT/dt that
        the theorem omits.

        Args:
            j: Index of the peer.
        """
        peer_motion = list(self.peers.values())[j]
        squares_before_jump = peer_motion.delayed_end.squares
        squares_after_jump = peer_motion.delayed.squares[1:]
        integral_of_squares = squares_before_jump - squares_after_jump
        energy_in_transit = 0.5 * integral_of_squares @ self.constants.Kd
        jump = _energy_of_jump(self, self.ends.link[j])
        alpha = self.dominance.before[:, j]
        return _jump_alone(jump + alpha * energy_in_transit)

    def compute_dominance_work(self) -> "Increment":
        """Computes the energy that a change of the dominance factors adds to V_i of a site.

        Along a ramp of the dominance factors alpha_ij, the power of the change is

            1/2 sum_j w_j int qd_j' Kd qd_j ds + qd_i' Kd sum_j w_j q_j(t - T_ij)

        where w_j is the time derivative of alpha_ij, T_ij the delay, Kd the damping gain, q a
        position and qd a velocity. The integral covers the last T_ij seconds. The second term
        arises because the velocity error of the site contains w_j. A sudden change adds the
        energy of the jump. The effect on the weights of the sites in the total energy is not
        included.
        """
        records = self.records
        c = self.constants
        dominance = self.dominance
        ends = self.ends
        if dominance.constant:
            return _zero_increment(self)
        periods = len(records.known) - 1
        left = np.zeros(periods)
        right = left
        jump = _energy_of_jump(self, ends.dominance)
        qd_left = records.shared_rate[:-1]
        qd_right = records.shared_rate[1:]

        for j, peer_motion in enumerate(self.peers.values()):
            energy_in_transit = _energy_in_transit(c, peer_motion)
            squares_at_end = peer_motion.now.squares[1:]
            integral_at_end = squares_at_end - peer_motion.delayed_end.squares
            energy_in_transit_at_end = 0.5 * integral_at_end @ c.Kd
            alpha_rate = dominance.rate[:-1, j]
            followed_rate = np.where(ends.following, alpha_rate, 0.0)
            q_left = peer_motion.delayed.q[:-1]
            q_right = peer_motion.delayed_end.q
            ramp_left = _dot_rows(qd_left * c.Kd, q_left)
            ramp_right = _dot_rows(qd_right * c.Kd, q_right)
            # the two terms of the power in the docstring, at both ends of every period
            left = left + alpha_rate * energy_in_transit[:-1]
            left = left + followed_rate * ramp_left
            right = right + alpha_rate * energy_in_transit_at_end
            right = right + followed_rate * ramp_right
            alpha_next = dominance.alpha[1:, j]
            alpha_right = dominance.before[:, j]
            alpha_step = alpha_next - alpha_right
            jump = jump + alpha_step * energy_in_transit[1:]
        return _trapezoid(self, left, right, jump)

    def measure_torque_error(self) -> Array:
        """Computes how far the recorded torques deviate from those that the law demands.

        The law is evaluated again from the recorded motion. A large error means that the log
        was modified, or that the arm ran a different law than the scenario states.

        Returns:
            The largest difference over all joints, shape (K,), in N m. It is 0 for interpolated
            records, and while the arm comes to rest.
        """
        records = self.records
        low, high = self.torque_bounds
        all_rows = np.arange(len(records.known))
        law_torque = self.law_torque(all_rows)
        limited_torque = np.clip(law_torque, low, high)
        errors = np.abs(records.tau - limited_torque)
        largest = max_rows(errors)
        is_comparable = records.known & ~self.rests
        return np.where(is_comparable, largest, 0.0)

    def compute_sampling_work(self) -> "Increment":
        """Returns the work caused by executing the continuous control law in ticks.

        With the filtered error r, the work has two parts:

        - Torque: the integral of r'(u - tau). The torque u is constant within a period, while
          the torque tau of the continuous law changes linearly until the end of the period.
        - Parameter estimates: the difference between their recorded step and the trapezoidal
          rule applied to the adaptive law.

        This work is not part of the energy balance, but explains part of its residual.
        """
        records = self.records
        c = self.constants
        ends = self.ends
        digital = self.scheme == "digital"
        held_torque = hold_torque(records.tau, c.tau_limit, digital=digital)
        applied_torque = held_torque[:-1]
        tau_right, Yr_right = _evaluate_before_jump(self)

        # torque: what acted minus the linear course that the trapezoid rule assumes
        tau_left = records.tau[:-1]
        mean_tau = 0.5 * (tau_left + tau_right)
        torque_error = applied_torque - mean_tau
        mean_r = 0.5 * (ends.r_left + ends.r_right)
        torque_power = _dot_rows(mean_r, torque_error)
        torque_part = records.h_s * torque_power

        # estimates: the trapezoid rule of the adaptive law minus its recorded step
        parameter_error = (records.theta_hat - c.theta) * c.adapts
        error_sum = parameter_error[1:] + parameter_error[:-1]
        trapezoid_Yr = 0.5 * (self.Yr[:-1] + Yr_right)
        Yr_error = trapezoid_Yr - self.mean_Yr
        half_s = 0.5 * records.h_s
        estimate_part = half_s * _dot_rows(error_sum, Yr_error)
        return _jump_alone(torque_part + estimate_part)


class FunctionalParts(NamedTuple):
    """The four parts of an arm's energy in the stability proof, in J.

    Each part has shape (K,) for K records. Their sum is V_i in the docstring of the module.

    Attributes:
        kinetic: Kinetic energy of the filtered error r, 1/2 r'M r with the inertia matrix M.
        parameter: Energy of the parameter estimation errors.
        position: Energy of the synchronisation error, which acts like a stretched spring.
        delay: Energy of the peer motion that has not yet reached the site.
    """

    kinetic: Array
    parameter: Array
    position: Array
    delay: Array

    @property
    def total(self) -> Array:
        """Energy V_i of one arm in the stability proof, shape (K,), in J.

        The sum of the four parts.
        """
        return self.kinetic + self.parameter + self.position + self.delay


def _dot_rows(x: Array, y: Array) -> Array:
    """Returns the scalar product of two vectors in each of K rows, shape (K,).

    An example is the power, joint torque times joint velocity. Both arguments have the shape
    (K, n), or one of them (n,) if it is the same in all rows.
    """
    return sum_rows(x * y)


def _energy_in_transit(constants: SiteConstants, peer_motion: DelayedPeer) -> Array:
    """Returns the energy of the peer's motion that has not yet reached the site, in J.

    It is 1/2 int qd_j' Kd qd_j ds, from the time at which the sample in use was sent until now,
    at each of K records.

    Args:
        constants: Gains of the site.
        peer_motion: Motion of peer j as it is and as the site receives it.
    """
    integral_of_squares = peer_motion.now.squares - peer_motion.delayed.squares
    return 0.5 * (integral_of_squares @ constants.Kd)


class Increment(NamedTuple):
    """An energy, such as dissipated energy or work, in each of K - 1 tick periods, in J.

    The energy in a period is the integral of a power, computed with the trapezoidal rule, plus
    a sudden change: at the end of each period a new sample of a peer comes into use, so the
    error of the site jumps, and some energies change with it. Each attribute has one value per
    period, shape (K - 1,).

    Attributes:
        left: Contribution of the power at the start of the period.
        right: Contribution of the power at the end of the period, before the sudden change.
        jump: The sudden change of the energy.
    """

    left: Array
    right: Array
    jump: Array

    @property
    def total(self) -> Array:
        """The energy in each tick period, in J.

        The sum of `left`, `right` and `jump`, shape (K - 1,).
        """
        return self.left + self.right + self.jump


def _trapezoid(
    site: SiteMotion,
    left: Array,
    right: Array,
    jump: Array | None = None,
) -> Increment:
    """Integrates a power over every tick period by the trapezoid rule.

    The energy function jumps at the end of a period, when the next sample comes into use. The
    power is therefore given at both ends of each of the K - 1 periods.

    Args:
        site: Motion of the site, which gives the length of a period.
        left: Power at the start of every period, shape (K - 1,), in W.
        right: Power at the end of every period, before the jump, in W.
        jump: Energy of the jump after each period, in J. `None` for no energy.
    """
    half_s = 0.5 * site.records.h_s
    if jump is None:
        jump = np.zeros(len(left))
    return Increment(half_s * left, half_s * right, jump)


def _integrate_power(site: SiteMotion, power: Array, jump: Array | None = None) -> Increment:
    """Integrates a power over each control period (tick), to obtain the energy in the period.

    Args:
        site: Motion of the site, with K records.
        power: The power, shape (K,), in W.
        jump: Energy of the jump after each period, shape (K - 1,), in J. `None` for no energy.
    """
    left = power[:-1]
    right = power[1:]
    return _trapezoid(site, left, right, jump)


def _jump_alone(amount: Array) -> Increment:
    """Returns the changes of an energy that is constant between ticks and changes by jumps.

    Such a jump occurs when a new message of another arm comes into use.

    Args:
        amount: The jump at the end of each period, shape (K - 1,), in J.
    """
    zero = np.zeros(len(amount))
    return Increment(zero, zero, amount)


def _zero_increment(site: SiteMotion) -> Increment:
    """Returns an energy of zero in every period, for terms that a site does not have."""
    periods = len(site.records.known) - 1
    return _jump_alone(np.zeros(periods))


def _weighted_square(c: SiteConstants, x: Array) -> Array:
    """Returns |x|^2 = x'Kd x, weighted by the damping gain, of every row, shape (K,)."""
    weighted_squares = c.Kd * x**2
    return sum_rows(weighted_squares)


def _stale_rule_work(site: SiteMotion) -> Increment:
    """Computes the work on a site that is caused by missing samples of its peers.

    When samples of a peer stop arriving, a rule of the scenario determines the reference, the
    motion that the site follows. The result is the work of the difference from the reference
    that the site would have had with all samples.

    Args:
        site: Motion of the site.
    """
    dominance = site.dominance
    ends = site.ends
    rule_acts = ~ends.following
    if not rule_acts.any():
        return _zero_increment(site)

    left_terms = []
    right_terms = []
    for j, peer_motion in enumerate(site.peers.values()):
        alpha_left = dominance.alpha[:-1, j, np.newaxis]
        alpha_right = dominance.before[:, j, np.newaxis]
        delayed_qd_left = peer_motion.delayed.qd[:-1]
        left_terms.append(alpha_left * delayed_qd_left)
        right_terms.append(alpha_right * peer_motion.delayed_end.qd)
    # difference from the reference velocity of Eq. (6), with all samples
    difference_left = ends.qd_des_left - np.sum(left_terms, axis=0)
    difference_right = ends.qd_des_right - np.sum(right_terms, axis=0)

    rate = site.records.shared_rate
    Kd = site.constants.Kd
    rate_left = rate[:-1]
    rate_right = rate[1:]
    left = _dot_rows(rate_left * Kd, difference_left)
    right = _dot_rows(rate_right * Kd, difference_right)
    jump = _energy_of_jump(site, ends.rule)
    return _trapezoid(
        site,
        left=np.where(rule_acts, left, 0.0),
        right=np.where(rule_acts, right, 0.0),
        jump=np.where(rule_acts, jump, 0.0),
    )


def _torque_limit_work(site: SiteMotion) -> Increment:
    """Computes the work of the part of the torque that the control law did not demand.

    It is the integral of r'(tau - tau_law) over time. Here r is the filtered error and r' its
    transpose, tau the recorded torque, and tau_law the torque that the law demanded. The two
    torques differ where a torque is limited, and while the arm comes to rest.

    Args:
        site: Motion of the site.
    """
    records = site.records
    power = np.zeros(len(records.known))
    is_limited = any_in_rows(site.limited)
    rows = np.flatnonzero(is_limited | site.rests)
    if len(rows):
        difference = records.tau[rows] - site.law_torque(rows)
        r = site.r[rows]
        power[rows] = _dot_rows(r, difference)
    return _integrate_power(site, power)


def _unknown_friction_work(site: SiteMotion) -> Increment:
    """Computes the work of the part of the friction that the control law does not compensate.

    The power of this work is minus the filtered error r, times the uncompensated part of the
    friction torque. The friction torque is evaluated at the reference velocity qd - r, with the
    joint velocity qd.

    Args:
        site: Recorded motion of the site.
    """
    records = site.records
    c = site.constants
    ends = site.ends

    uncompensated_share = 1.0 - c.friction

    def power(r: Array, qd: Array) -> Array:
        """Returns the power of the uncompensated friction, shape (rows,), in W."""
        friction = c.arm.friction(qd - r)
        return -_dot_rows(r * uncompensated_share, friction)

    qd_left = records.qd[:-1]
    qd_right = records.qd[1:]
    left = power(ends.r_left, qd_left)
    right = power(ends.r_right, qd_right)
    return _trapezoid(site, left, right)


def _singular_pose_work(site: SiteMotion) -> Increment:
    """Computes the work that arises because motion is damped near singular poses of the arm.

    In a singular pose the end effector cannot move in some direction. Near it, the controller
    uses a damped inverse of the Jacobian J. The energy then changes by the integral of

        r'M(a - dv/dt) - (J r - xd - Lambda e)'Kd ed

    Here r is the filtered error, M the inertia matrix, v the reference velocity of the joints,
    a the acceleration that the law uses for dv/dt, xd the velocity of the end effector, e its
    error, ed the derivative of e, and Lambda and Kd are gains. Both terms are zero without
    damping.

    Args:
        site: Motion of the site.
    """
    ends = site.ends
    e_left = site.records.e[:-1]
    e_next = site.records.e[1:]
    e_right = 2.0 * ends.e_middle - e_next
    left = _singular_pose_power(
        site=site,
        rows=slice(0, -1),
        e=e_left,
        qd_des=ends.qd_des_left,
        r=ends.r_left,
    )

    right = _singular_pose_power(
        site=site,
        rows=slice(1, None),
        e=e_right,
        qd_des=ends.qd_des_right,
        r=ends.r_right,
    )
    return _trapezoid(site, left, right)


def _singular_pose_power(
    site: SiteMotion,
    rows: slice,
    e: Array,
    qd_des: Array,
    r: Array,
) -> Array:
    """Returns the power of the damping near singular poses, at one end of every period, in W.

    In a singular pose, such as a stretched arm, the end effector cannot move in every
    direction. `_singular_pose_work` has the equation and integrates this power, whose shape is
    (K - 1,).

    Args:
        site: Motion of the site.
        rows: Rows of this end of the periods in the records.
        e: Errors, shape (K - 1, m).
        qd_des: Velocity of the reference, shape (K - 1, m).
        r: Filtered errors, shape (K - 1, n).
    """
    records = site.records
    c = site.constants
    velocity_error, acceleration_error = site.following.compute_damping_deviation(rows, e)
    ed = records.shared_rate[rows] - qd_des
    power = -_dot_rows(velocity_error * c.Kd, ed)
    if acceleration_error.any():
        q = records.q[rows]
        momentum = c.arm.multiply_inertia(q, r)
        power = power + _dot_rows(momentum, acceleration_error)
    return power


def _estimate_work(site: SiteMotion) -> Increment:
    """Computes the work of parameter estimates that do not follow the adaptive law.

    There are two cases:

    - An estimate is held at a limit of its permitted range. If the range contains the true
      parameter, this only reduces the energy of the estimation errors.
    - A parameter is never adapted, or not while the arm comes to rest. Its estimation error
      then causes a torque error, which does work: the integral of r'Y(theta_hat - theta). Here
      r is the filtered error, Y the regressor, theta_hat the estimates and theta the true
      parameters.

    Args:
        site: Motion of the site.
    """
    records = site.records
    c = site.constants
    theta_hat = records.theta_hat
    parameter_error = theta_hat - c.theta

    # while a site rests, it keeps its estimates
    change = np.diff(parameter_error, axis=0)
    is_unchanged = ~any_in_rows(change)
    keeps_estimates = np.concatenate([[False], is_unchanged])
    is_frozen_row = keeps_estimates & site.rests
    is_frozen = is_frozen_row[:, np.newaxis]

    is_at_low = theta_hat <= c.low
    is_at_high = theta_hat >= c.high
    is_at_limit = is_at_low | is_at_high
    is_adapting = c.adapts & ~is_frozen
    is_held = is_at_limit[1:] & is_adapting[1:]
    is_wrong = parameter_error != 0.0
    is_fixed = is_wrong & ~is_adapting
    if not (is_held.any() or is_fixed.any()):
        return _zero_increment(site)
    # Eq. (15) demands the step -h Gamma Y'r; the limits changed it by `correction`
    correction = change + records.h_s * c.Gamma * site.mean_Yr
    error_left = parameter_error[:-1]
    error_right = parameter_error[1:]
    mean_error = 0.5 * (error_left + error_right)
    with np.errstate(divide="ignore", invalid="ignore"):
        correction_work = mean_error * correction / c.Gamma
    held_work = np.where(is_held, correction_work, 0.0)
    jump = sum_rows(held_work)

    error_power = site.Yr * parameter_error
    fixed_power = np.where(is_fixed, error_power, 0.0)
    power = sum_rows(fixed_power)
    return _integrate_power(site, power, jump)


def _evaluate_before_jump(site: SiteMotion) -> tuple[Array, Array]:
    """Evaluates the control law at the end of every control period, before its error jumps.

    The error e jumps when the next message of another arm comes into use. Records contain only
    the values after the jump.

    Returns:
        Torque of the law, Eq. (13), within its limit, shape (K - 1, n), in N m.
        Direction Y'r of the adaptation, Eq. (15), shape (K - 1, P).
    """
    records = site.records
    c = site.constants
    ends = site.ends
    tau = records.tau[1:].copy()
    Yr = site.Yr[1:].copy()
    e_next = records.e[1:]
    e_right = 2.0 * ends.e_middle - e_next
    ed_right = records.shared_rate[1:] - ends.qd_des_right
    jump_of_e = np.abs(e_right - e_next)
    qd_des_next = records.qd_des[1:]
    jump_of_rate = np.abs(ends.qd_des_right - qd_des_next)
    jumps = jump_of_e + jump_of_rate > JUMP_TOLERANCE
    periods_with_jump = np.flatnonzero(any_in_rows(jumps))

    e = e_right[periods_with_jump]
    ed = ed_right[periods_with_jump]
    r = ends.r_right[periods_with_jump]
    rows = periods_with_jump + 1
    v, a = site.following.compute_reference(rows, e, ed)
    Yr[periods_with_jump] = c.arm.gradient(
        q=records.q[rows],
        qd=records.qd[rows],
        v=v,
        a=a,
        r=r,
    )

    law_torque = site.control_torque(rows, e, ed, r)
    limited_torque = np.clip(law_torque, -c.tau_limit, c.tau_limit)
    # a torque at its rate limit, or of a resting site, does not move with a jump of e
    is_finite = np.isfinite(c.tau_rate)
    has_rate_limit = np.any(is_finite)
    is_rate_limited = any_in_rows(site.limited) & has_rate_limit
    is_unaffected = site.rests | is_rate_limited
    keeps_torque = is_unaffected[rows, np.newaxis]
    tau[periods_with_jump] = np.where(keeps_torque, tau[periods_with_jump], limited_torque)
    return tau, Yr


def _energy_of_jump(site: SiteMotion, de: Array) -> Array:
    """Returns the energy that a jump of the error e by `de` adds at the end of every period.

    It is the change of 1/2 (r'M r + e' Lambda Kd e), with the filtered error r and the inertia
    matrix M. Both terms are quadratic in e. Their change is therefore exactly the gradient
    half-way through the whole jump, times the jump, and the energies of several causes of a
    jump add up.

    Args:
        site: Motion of the site.
        de: Part of the jump of e that has one cause, shape (K - 1, n).

    Returns:
        The change, shape (K - 1,), in J.
    """
    constants = site.constants
    ends = site.ends
    if not de.any():
        return np.zeros(len(de))
    q_next = site.records.q[1:]
    momentum = constants.arm.multiply_inertia(q_next, ends.r_middle)
    rows_after_jumps = slice(1, None)
    dr = site.following.compute_jump_of_r(rows_after_jumps, de)
    change = _dot_rows(momentum, dr)
    restoring_force = constants.Kd * ends.e_middle * constants.Lambda
    change += _dot_rows(restoring_force, de)
    return change
