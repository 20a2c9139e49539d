"""Implements the paper's law for end-effector positions, with unknown masses and link lengths.

The position x of the end effector and its velocity are measured. The Jacobian J is computed
from estimated link lengths l_hat, J_hat = J + J~. With the dominance factors alpha_ij, the
weights with which site i follows its peers j, and the delay T, let

    e = x - sum_j alpha_ij x_j(t - T),    v = -J_hat^-1 Lambda e,    a = v',    r = qd - v

where e is the error, v the reference velocity of the joints, a its derivative and r the
filtered error. With the regressor Y, for which Y theta is the torque of the arm's dynamics, the
law and its estimates are

    tau        = Y(q, qd, v, a) theta_hat - Kp r - J_hat' Kd ed
    theta_hat' = -Gamma Y' r
    l_hat'     = Gamma_l Y_k' Kd ed,    where Y_k l_hat = J_hat qd

Here tau is the torque of the joints, theta_hat the estimate of the dynamic parameters theta
(such as masses), ed the derivative of e, and Y_k the matrix of the kinematics. Lambda, Kp, Kd,
Gamma and Gamma_l are gains. A prime at a matrix means its transpose, and at a vector its
derivative.

Stability: J_hat r = x' + Y_k (l_hat - l) + Lambda e. The wrong lengths add a term to
-r' J_hat' Kd ed. The derivative of 1/2 (l_hat - l)' Gamma_l^-1 (l_hat - l) cancels this term,
so the derivative of V, the energy function of the stability proof, is the same as with known
lengths (docs/laws.md). The adaptive Jacobian is due to C. C.
Cheah, C. Liu and J.-J. E. Slotine, Int. J. Robotics Research 25 (2006).

Invariant:
    - Both estimates advance by the trapezoid rule, like the estimate of the adaptive law.
    - The estimated lengths stay in their box, an interval per length. The projection into the
      box can only lower the additional term of V further.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.elementary import sincos
from ..core.jit import leaf
from ..core.two_link_arm import regressor
from ..core.user_law import LawContext, LawInput
from ..core.vectors import Pair
from ..fields import NotNegative, NotNegativeParameters, Parameters, Positive, PositiveJoints
from .conditions import LawSituation, StabilityCondition
from .interface import ADAPTATION, CONVERGENCE, DAMPING, ERROR_DAMPING, ControlLaw, TuningSite

LEAST_SINE = 0.1
"""Smallest abs(sin q2) with which J_hat is inverted; a more stretched elbow uses this value."""


@leaf
def _solve_jacobian(lengths: Pair, q: Pair, b: Pair) -> Pair:
    """Returns the solution y of J y = b, where J is the Jacobian of the planar arm.

    A stretched elbow makes J singular. Then the sine of the elbow's angle is replaced by
    `LEAST_SINE`.

    Args:
        lengths: Lengths of the two links, m.
        q: Joint angles, rad.
        b: The right-hand side, along x and y.
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
    """Returns x, y, x' and y' of the end effector, m and m/s.

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
def _jacobian_rate_times(lengths: Pair, length_rates: Pair, q: Pair, qd: Pair, v: Pair) -> Pair:
    """Returns the derivative of the Jacobian times v.

    Args:
        lengths: Estimated lengths of the links, m.
        length_rates: Derivatives of these estimates, m/s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        v: The vector to multiply.
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
    """The paper's law for end-effector positions of planar arms with unknown lengths.

    The position and the velocity of each end effector are measured, and compared in a frame
    that all bases share. Masses and lengths are learnt.

    Source: C. C. Cheah, C. Liu and J.-J. E. Slotine, "Adaptive tracking control for robots with
    unknown kinematic and dynamic properties", Int. J. Robotics Research 25(3), 283-296, 2006.

    Attributes:
        Lambda: Rate at which errors decay, per coordinate x and y, 1/s.
        Kp: Damping of r, per joint, N m s/rad.
        Kd: Damping of the error's velocity, per coordinate, N s/m.
        Gamma: Adaptation gain per parameter.
        theta_hat0: First estimate of theta, Eq. (24).
        length_gain_m_n: Adaptation gain of the lengths, m/N.
        lengths0_m: First estimate of the two lengths.
        least_m: Lower bound of both lengths, m.
        most_m: Upper bound of both lengths, m.
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
        """Creates the memory of the law for a site: its two estimates and their rates.

        The estimates of the lengths and of theta, the parameters of the arm's dynamics, start
        at the first estimates of the settings.
        """
        self.theta_hat = list(self.theta_hat0)
        self.lengths_m = list(self.lengths0_m)
        self.Yr = [0.0] * len(self.theta_hat)
        self.rate_m_s = [0.0, 0.0]
        # The true lengths stand for the instrument that measures the end effector.
        self.true_lengths_m = list(facts.lengths_m)
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Computes torque and estimates in one tick, and sends the end effector's motion.

        The steps are: measure the end effector; compute the error e and its derivative; advance
        the estimate of the lengths; compute v, a and r; compute the torque and advance
        theta_hat. All symbols are defined at the top of this module.

        Args:
            now: Inputs and outputs of the law in this tick.
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
                e_x += peer.alpha * (x - received.x[0])
                e_y += peer.alpha * (y - received.x[1])
                ed_x -= peer.alpha * received.xd[0]
                ed_y -= peer.alpha * received.xd[1]

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
                length = self.lengths_m[i] + half_h * (self.rate_m_s[i] + rate)
                self.lengths_m[i] = min(max(length, self.least_m), self.most_m)
            self.rate_m_s[i] = rate
        l1 = self.lengths_m[0]
        l2 = self.lengths_m[1]
        lengths = (l1, l2)
        # An estimate at an edge of its box does not move.
        l1_rate = self.rate_m_s[0] if self.least_m < l1 < self.most_m else 0.0
        l2_rate = self.rate_m_s[1] if self.least_m < l2 < self.most_m else 0.0
        length_rates = (l1_rate, l2_rate)

        x_rate = -self.Lambda[0] * e_x
        y_rate = -self.Lambda[1] * e_y
        v = _solve_jacobian(lengths, q, (x_rate, y_rate))
        bias = _jacobian_rate_times(lengths=lengths, length_rates=length_rates, q=q, qd=qd, v=v)
        a_x = -self.Lambda[0] * ed_x - bias[0]
        a_y = -self.Lambda[1] * ed_y - bias[1]
        a = _solve_jacobian(lengths, q, (a_x, a_y))
        r = (qd[0] - v[0], qd[1] - v[1])

        now.tau[0] = -self.Kp[0] * r[0] - (l1 * across_1 + l2 * across_2)
        now.tau[1] = -self.Kp[1] * r[1] - l2 * across_2
        first, second = regressor(g=self.g_m_s2, q=q, qd=qd, v=v, a=a)
        for p in range(len(self.Yr)):
            Yr = first[p] * r[0] + second[p] * r[1]
            if now.k > 0:
                gain_s = half_h * self.Gamma[p]
                self.theta_hat[p] -= gain_s * (self.Yr[p] + Yr)
            self.Yr[p] = Yr
            estimate = self.theta_hat[p]
            now.theta_hat[p] = estimate
            now.tau[0] += first[p] * estimate
            now.tau[1] += second[p] * estimate

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the stability condition of this law at a site of a scenario.

        The delays must be constant, the elbows must stay bent, and the true lengths must lie
        within the law's bounds. The condition stays undecided, because only the run shows
        whether the elbows stay bent.

        Args:
            situation: The site, its peers and the delays between them.
        """
        if np.isnan(situation.longest_s):
            return StabilityCondition(
                None, "proved for constant delays, and a delay here varies"
            )
        text = (
            f"for every constant delay, while abs(sin q2) > {LEAST_SINE:g} and the lengths are "
            f"between {self.least_m:g} and {self.most_m:g} m (sufficient); the run shows if "
            "elbows stay bent"
        )
        return StabilityCondition(None, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the [control] table of a site: tuned gains and the first estimate.

        The lengths are learnt, starting from the law's default.

        Args:
            gains: The tuned gains by name.
            site: The site whose table is written.
        """
        return {**gains, "theta_hat0": site.estimate}
