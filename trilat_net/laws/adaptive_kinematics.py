"""Control law for end-effector positions of planar arms with unknown masses and lengths.

The law learns the dynamic parameters theta of an arm and its two link lengths l. It uses
measurements of the position x and the velocity xd of the end effector.

Equations:

    e   = x - sum_j alpha_ij x_j(t - T)     ed: derivative of e
    v   = -inv(J_hat) Lambda e              a: derivative of v
    r   = qd - v
    tau = Y theta_hat - Kp r - J_hat^T Kd ed
    rate of theta_hat = -Gamma Y^T r
    rate of l_hat     = Gamma_l Y_k^T Kd ed

Symbols:
    - x_j: position of peer j; alpha_ij: weight that this arm gives to it; T: delay of the link.
    - q, qd: joint angles and velocities; tau: joint torques.
    - e: position error; v: reference velocity of the joints; r: filtered error.
    - theta_hat, l_hat: estimates of theta and l; J_hat: Jacobian computed from l_hat.
    - Y: matrix with Y theta = torque of the arm's dynamics for qd, v and a.
    - Y_k: matrix with Y_k l_hat = J_hat qd.
    - Lambda, Kp, Kd, Gamma, Gamma_l: gains.

The functional V of the law `adaptive` never increases, because the adaptation of l_hat cancels
the term introduced by wrong lengths. The last step of the proof for `adaptive` does not apply
here. Instead, docs/theory/laws-lengths.md proves that e and qd converge to zero, because an end
effector with finite reach cannot move at a constant velocity forever. Source of the adaptive
Jacobian: Cheah, Liu and Slotine, Int. J. Robotics Research 25 (2006).

Invariant:
    - Both estimates are integrated with the trapezoid rule, like the estimate of `adaptive`.
    - The estimated lengths are clipped to their bounds, which does not affect the stability
      proof.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import LawContext, LawInput, Pair, compiled, leaf, regressor, sincos
from ..fields import NotNegative, NotNegativeParameters, Parameters, Positive, PositiveJoints
from .conditions import LawSituation, StabilityCondition
from .interface import ADAPTATION, CONVERGENCE, DAMPING, ERROR_DAMPING, ControlLaw, TuningSite

LEAST_SINE = 0.1
"""Lower bound of abs(sin q2) used when inverting J_hat; replaces smaller values near a
stretched elbow.
"""


@leaf
def _solve_jacobian(lengths: Pair, q: Pair, b: Pair) -> Pair:
    """Returns the joint rates for a given velocity of the planar arm's end effector.

    The rates solve J rates = b, where J is the Jacobian of the end effector. J is singular for
    a stretched elbow; near this pose, the sine of the elbow angle is replaced by `LEAST_SINE`.

    Args:
        lengths: Lengths of the two links, m.
        q: Joint angles, rad.
        b: Velocity (or acceleration) of the end effector along x and y.
    """
    l1, l2 = lengths
    q1, q2 = q
    b_x, b_y = b
    s1, c1 = sincos(q1)
    s12, c12 = sincos(q1 + q2)
    s2, _ = sincos(q2)
    if abs(s2) < LEAST_SINE:
        s2 = LEAST_SINE if s2 >= 0.0 else -LEAST_SINE
    x = l1 * c1 + l2 * c12
    y = l1 * s1 + l2 * s12
    # Cramer's rule
    determinant = l1 * l2 * s2
    first = l2 * (c12 * b_x + s12 * b_y) / determinant
    second = -(x * b_x + y * b_y) / determinant
    return first, second


@leaf
def _end_effector_motion(lengths: Pair, q: Pair, qd: Pair) -> tuple[float, float, float, float]:
    """Returns the position (x, y) of the planar arm's end effector, m, and its velocity, m/s.

    Args:
        lengths: Lengths of the two links, m.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
    """
    l1, l2 = lengths
    q1, q2 = q
    qd1, qd2 = qd
    s1, c1 = sincos(q1)
    s12, c12 = sincos(q1 + q2)
    inner_speed = l1 * qd1
    outer_speed = l2 * (qd1 + qd2)
    x = l1 * c1 + l2 * c12
    y = l1 * s1 + l2 * s12
    xd = -s1 * inner_speed - s12 * outer_speed
    yd = c1 * inner_speed + c12 * outer_speed
    return x, y, xd, yd


@leaf
def _jacobian_rate_times(
    lengths: Pair,
    length_rates: Pair,
    q: Pair,
    qd: Pair,
    v: Pair,
) -> Pair:
    """Returns the product of the Jacobian's time derivative and the joint velocities v.

    This is the acceleration of the end effector for constant v. The Jacobian also changes
    because the estimated link lengths change.

    Args:
        lengths: Estimated lengths of the links, m.
        length_rates: Derivatives of these estimates, m/s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        v: Reference velocities of the joints, rad/s.
    """
    l1, l2 = lengths
    l1_rate, l2_rate = length_rates
    q1, q2 = q
    qd1, qd2 = qd
    v1, v2 = v
    s1, c1 = sincos(q1)
    s12, c12 = sincos(q1 + q2)
    inner_speed = l1 * qd1
    outer_speed = l2 * (qd1 + qd2)
    v12 = v1 + v2
    row_x = -(inner_speed * c1 + l1_rate * s1) * v1
    row_x -= (outer_speed * c12 + l2_rate * s12) * v12
    row_y = (l1_rate * c1 - inner_speed * s1) * v1
    row_y += (l2_rate * c12 - outer_speed * s12) * v12
    return row_x, row_y


@compiled
class AdaptiveKinematics(ControlLaw):
    """Adaptive law that couples the end effectors of planar arms with unknown link lengths.

    The positions and velocities of the end effectors are measured and compared in a common
    frame. Masses and link lengths are learnt.

    Source: C. C. Cheah, C. Liu and J.-J. E. Slotine, "Adaptive tracking control for robots with
    unknown kinematic and dynamic properties", Int. J. Robotics Research 25(3), 283-296, 2006.

    Attributes:
        Lambda: Rate at which errors decay, per coordinate x and y, 1/s.
        Kp: Damping gain of the filtered error r, per joint, N m s/rad.
        Kd: Damping of the error, per coordinate, N s/m.
        Gamma: Adaptation gain per parameter.
        theta_hat0: Initial estimate of theta, Eq. (24).
        length_gain_m_n: Adaptation gain of the link lengths, m/N.
        lengths0_m: Initial estimates of the two link lengths, m.
        least_m: Lower bound on the estimate of each link length, m.
        most_m: Upper bound on the estimate of each link length, m.
    """

    Lambda: PositiveJoints = (1.0,)
    Kp: PositiveJoints = (1.0,)
    Kd: PositiveJoints = (3.0,)
    Gamma: NotNegativeParameters = (1.0,)
    theta_hat0: Parameters = (0.0,)
    length_gain_m_n: NotNegative = 0.01
    lengths0_m: PositiveJoints = (1.0,)
    least_m: Positive = 0.2
    most_m: Positive = 3.0

    planar: ClassVar = True
    compares_positions: ClassVar = True
    sends: ClassVar[dict[str, Any]] = {
        "x": {"unit": "m", "length": 2},
        "xd": {"unit": "m/s", "length": 2},
    }
    remembers: ClassVar = ("theta_hat", "Yr", "lengths_m", "rate_m_s")
    tune: ClassVar = {
        "Lambda": CONVERGENCE,
        "Kp": DAMPING,
        "Kd": (*ERROR_DAMPING[:2], "N s/m"),
        "Gamma": ADAPTATION,
    }
    known_facts: ClassVar = "gravity, as its first estimate, and no length"

    def begin(self, facts: LawContext) -> None:
        """Prepares the law of a site before a run, initialising its estimates and their rates.

        The law estimates the link lengths and the dynamic parameters of the arm. The initial
        estimates are taken from the settings.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """
        self.theta_hat = list(self.theta_hat0)
        self.lengths_m = list(self.lengths0_m)
        self.Yr = [0.0] * len(self.theta_hat)
        self.rate_m_s = [0.0, 0.0]
        # The true lengths take the place of an instrument that measures the end effector.
        self.true_lengths_m = list(facts.lengths_m)
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Computes the joint torques of one tick, and updates the estimates.

        The link lengths and the dynamic parameters of the arm are estimated. The steps are:

        1. Measure the position and velocity of the end effector, and send them to the other
           sites.
        2. Compute the error from the weighted mean position of the other end effectors.
        3. Update the estimate of the link lengths.
        4. Compute the joint reference velocity and the filtered error.
        5. Compute the torque, and update the estimate of the dynamic parameters.

        See the module docstring for the equations.

        Args:
            now: Inputs and outputs of the law in this tick. The torque is written into
                `now.tau`.
        """
        q = (now.q[0], now.q[1])
        qd = (now.qd[0], now.qd[1])
        true_lengths = (self.true_lengths_m[0], self.true_lengths_m[1])
        x, y, xd, yd = _end_effector_motion(true_lengths, q, qd)
        now.to_all.x[0] = x
        now.to_all.x[1] = y
        now.to_all.xd[0] = xd
        now.to_all.xd[1] = yd

        e_x = 0.0
        e_y = 0.0
        ed_x = xd
        ed_y = yd
        for j in range(len(now.peers)):
            peer = now.peers[j]
            received = now.received[j]
            # Before its first sample, a peer counts as being at this arm's position, at rest.
            if peer.tick >= 0:
                alpha = peer.alpha
                distance_x = x - received.x[0]
                distance_y = y - received.x[1]
                e_x += alpha * distance_x
                e_y += alpha * distance_y
                ed_x -= alpha * received.xd[0]
                ed_y -= alpha * received.xd[1]

        # The components of Kd ed across the links. J_hat' Kd ed sums them times the lengths.
        s1, c1 = sincos(q[0])
        s12, c12 = sincos(q[0] + q[1])
        force_x = self.Kd[0] * ed_x
        force_y = self.Kd[1] * ed_y
        across_1 = c1 * force_y - s1 * force_x
        across_2 = c12 * force_y - s12 * force_x
        across = (across_1, across_2)

        half_h = 0.5 * now.h_s
        for i in range(2):
            # Gamma_l Y_k' Kd ed
            link_rate = qd[0] + i * qd[1]
            rate = self.length_gain_m_n * across[i] * link_rate
            if now.k > 0:
                rate_sum = self.rate_m_s[i] + rate
                length = self.lengths_m[i] + half_h * rate_sum
                bounded_below = max(length, self.least_m)
                self.lengths_m[i] = min(bounded_below, self.most_m)
            self.rate_m_s[i] = rate
        l1 = self.lengths_m[0]
        l2 = self.lengths_m[1]
        lengths = (l1, l2)
        # An estimate at one of its bounds does not move.
        l1_rate = self.rate_m_s[0] if self.least_m < l1 < self.most_m else 0.0
        l2_rate = self.rate_m_s[1] if self.least_m < l2 < self.most_m else 0.0
        length_rates = (l1_rate, l2_rate)

        x_rate = -self.Lambda[0] * e_x
        y_rate = -self.Lambda[1] * e_y
        v = _solve_jacobian(lengths, q, (x_rate, y_rate))
        bias = _jacobian_rate_times(
            lengths=lengths,
            length_rates=length_rates,
            q=q,
            qd=qd,
            v=v,
        )
        a_x = -self.Lambda[0] * ed_x - bias[0]
        a_y = -self.Lambda[1] * ed_y - bias[1]
        a = _solve_jacobian(lengths, q, (a_x, a_y))
        r = (qd[0] - v[0], qd[1] - v[1])

        # J_hat' Kd ed
        error_torque_2 = l2 * across_2
        error_torque_1 = l1 * across_1 + error_torque_2
        now.tau[0] = -self.Kp[0] * r[0] - error_torque_1
        now.tau[1] = -self.Kp[1] * r[1] - error_torque_2
        first, second = regressor(
            g=self.g_m_s2,
            q=q,
            qd=qd,
            v=v,
            a=a,
        )
        for p in range(len(self.Yr)):
            Yr = first[p] * r[0] + second[p] * r[1]
            if now.k > 0:
                gain_s = half_h * self.Gamma[p]
                Yr_sum = self.Yr[p] + Yr
                self.theta_hat[p] -= gain_s * Yr_sum
            self.Yr[p] = Yr
            estimate = self.theta_hat[p]
            now.theta_hat[p] = estimate
            now.tau[0] += first[p] * estimate
            now.tau[1] += second[p] * estimate

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition under which this law is proved to be stable.

        docs/theory/laws-lengths.md proves that the errors e and the velocities qd converge to
        zero. The proof requires constant delays, an irreducible matrix of weights (each arm
        follows every other arm, directly or through others), elbows that stay bent, and true
        link lengths between the bounds `least_m` and `most_m`.

        Args:
            situation: This arm, the other arms, their laws, and the delays between them.

        Returns:
            The condition, as text. Its `holds` is always None, because only a run shows whether
            the elbows stay bent.
        """
        if np.isnan(situation.longest_s):
            return StabilityCondition(
                None, "proved for constant delays, and a delay here varies"
            )
        text = (
            "e and qd go to zero for every constant delay and irreducible alpha, while "
            f"abs(sin q2) > {LEAST_SINE:g} and the lengths are between {self.least_m:g} and "
            f"{self.most_m:g} m (sufficient); the run shows whether the elbows stay bent"
        )
        return StabilityCondition(None, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The table contains the tuned gains and the initial estimate of the arm's dynamic
        parameters. The initial estimate of the link lengths keeps its default value.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        return {**gains, "theta_hat0": site.estimate}
