"""The paper's law for end-effector positions, with unknown masses and link lengths.

The position x of the end effector and its velocity are measured. The Jacobian is computed from
estimated lengths, J_hat = J + J~. With

    e = x - sum_j alpha_ij x_j(t - T),    v = -J_hat^-1 Lambda e,    a = v',    r = qd - v

the law and its estimates are

    tau        = Y(q, qd, v, a) theta_hat - Kp r - J_hat' Kd ed
    theta_hat' = -Gamma Y' r
    l_hat'     = Gamma_l Y_k' Kd ed,    where Y_k l_hat = J_hat qd

Stability: J_hat r = x' + Y_k (l_hat - l) + Lambda e. The wrong lengths add a term to
-r' J_hat' Kd ed. The derivative of 1/2 (l_hat - l)' Gamma_l^-1 (l_hat - l) cancels this term,
so V' is the same as with known lengths (docs/laws.md). The adaptive Jacobian is due to C. C.
Cheah, C. Liu and J.-J. E. Slotine, Int. J. Robotics Research 25 (2006).

Invariant:
    - Both estimates advance by the trapezoid rule, like the estimate of the adaptive law.
    - The estimated lengths stay in their box. The projection can only lower the additional term
      of V further.
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
    """Returns the solution of J y = b for the planar arm with these link lengths, m."""
    l1, l2 = lengths
    s1, c1 = sincos(q[0])
    s12, c12 = sincos(q[0] + q[1])
    s2, _ = sincos(q[1])
    if abs(s2) < LEAST_SINE:
        s2 = LEAST_SINE if s2 >= 0.0 else -LEAST_SINE
    x = l1 * c1 + l2 * c12
    y = l1 * s1 + l2 * s12
    determinant = l1 * l2 * s2
    first = l2 * (c12 * b[0] + s12 * b[1]) / determinant
    second = -(x * b[0] + y * b[1]) / determinant
    return first, second


@leaf
def _end_effector_motion(lengths: Pair, q: Pair, qd: Pair) -> tuple[float, float, float, float]:
    """Returns x, y, x' and y' of the end effector, m and m/s."""
    s1, c1 = sincos(q[0])
    s12, c12 = sincos(q[0] + q[1])
    inner = lengths[0] * qd[0]
    outer = lengths[1] * (qd[0] + qd[1])
    x = lengths[0] * c1 + lengths[1] * c12
    y = lengths[0] * s1 + lengths[1] * s12
    xd = -s1 * inner - s12 * outer
    yd = c1 * inner + c12 * outer
    return x, y, xd, yd


@leaf
def _jacobian_rate_times(lengths: Pair, length_rates: Pair, q: Pair, qd: Pair, v: Pair) -> Pair:
    """Returns the derivative of the Jacobian times v.

    Args:
        lengths: estimated lengths of the links, m.
        length_rates: derivatives of these estimates, m/s.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        v: the vector to multiply.
    """
    s1, c1 = sincos(q[0])
    s12, c12 = sincos(q[0] + q[1])
    inner = lengths[0] * qd[0]
    outer = lengths[1] * (qd[0] + qd[1])
    v12 = v[0] + v[1]
    row_x = -(inner * c1 + length_rates[0] * s1) * v[0]
    row_x -= (outer * c12 + length_rates[1] * s12) * v12
    row_y = (length_rates[0] * c1 - inner * s1) * v[0]
    row_y += (length_rates[1] * c12 - outer * s12) * v12
    return row_x, row_y


@compiled
class AdaptiveKinematics(ControlLaw):
    """The paper's law for end-effector positions of planar arms with unknown lengths.

    The end effector's position and velocity are measured and compared in the frame of the
    bases. Masses and lengths are learnt. C. C. Cheah, C. Liu and J.-J. E. Slotine, "Adaptive
    tracking control for robots with unknown kinematic and dynamic properties", Int. J. Robotics
    Research 25(3), 283-296, 2006.

    Attributes:
        Lambda: rate at which errors decay, per coordinate x and y, 1/s.
        Kp: damping of r, per joint, N m s/rad.
        Kd: damping of the error's velocity, per coordinate, N s/m.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
        length_gain_m_n: adaptation gain of the lengths, m/N.
        lengths0_m: first estimate of the two lengths.
        least_m: lower bound of both lengths, m.
        most_m: upper bound of both lengths, m.
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
        """Creates both estimates and their rates."""
        self.theta_hat = list(self.theta_hat0)
        self.lengths_m = list(self.lengths0_m)
        self.Yr = [0.0] * len(self.theta_hat)
        self.rate_m_s = [0.0, 0.0]
        # The true lengths stand for the instrument that measures the end effector.
        self.true_lengths_m = list(facts.lengths_m)
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Writes the torque and the estimate, and sends the end effector's motion."""
        q = (now.q[0], now.q[1])
        qd = (now.qd[0], now.qd[1])
        true_lengths = (self.true_lengths_m[0], self.true_lengths_m[1])
        x, y, xd, yd = _end_effector_motion(true_lengths, q, qd)
        now.to_all.x[0] = x
        now.to_all.x[1] = y
        now.to_all.xd[0] = xd
        now.to_all.xd[1] = yd
        e0 = 0.0
        e1 = 0.0
        ed0 = xd
        ed1 = yd
        for j in range(len(now.peers)):
            peer = now.peers[j]
            received = now.received[j]
            # Before its first sample, a peer counts as being at this arm's position, at rest.
            if peer.tick >= 0:
                e0 += peer.alpha * (x - received.x[0])
                e1 += peer.alpha * (y - received.x[1])
                ed0 -= peer.alpha * received.xd[0]
                ed1 -= peer.alpha * received.xd[1]
        s1, c1 = sincos(q[0])
        s12, c12 = sincos(q[0] + q[1])
        f0 = self.Kd[0] * ed0
        f1 = self.Kd[1] * ed1
        # Kd ed across each link: J_hat' Kd ed sums these forces times the lengths.
        across = (c1 * f1 - s1 * f0, c12 * f1 - s12 * f0)
        for i in range(2):
            # Gamma_l Y_k' Kd ed
            rate = self.length_gain_m_n * across[i] * (qd[0] + i * qd[1])
            if now.k > 0:
                length = self.lengths_m[i] + 0.5 * now.h_s * (self.rate_m_s[i] + rate)
                self.lengths_m[i] = min(max(length, self.least_m), self.most_m)
            self.rate_m_s[i] = rate
        l1 = self.lengths_m[0]
        l2 = self.lengths_m[1]
        # An estimate at an edge of its box does not move.
        l1_rate = self.rate_m_s[0] if self.least_m < l1 < self.most_m else 0.0
        l2_rate = self.rate_m_s[1] if self.least_m < l2 < self.most_m else 0.0
        v = _solve_jacobian((l1, l2), q, (-self.Lambda[0] * e0, -self.Lambda[1] * e1))
        bias = _jacobian_rate_times(
            lengths=(l1, l2), length_rates=(l1_rate, l2_rate), q=q, qd=qd, v=v
        )
        a0 = -self.Lambda[0] * ed0 - bias[0]
        a1 = -self.Lambda[1] * ed1 - bias[1]
        a = _solve_jacobian((l1, l2), q, (a0, a1))
        r = (qd[0] - v[0], qd[1] - v[1])
        now.tau[0] = -self.Kp[0] * r[0] - (l1 * across[0] + l2 * across[1])
        now.tau[1] = -self.Kp[1] * r[1] - l2 * across[1]
        first, second = regressor(g=self.g_m_s2, q=q, qd=qd, v=v, a=a)
        for p in range(len(self.Yr)):
            Yr = first[p] * r[0] + second[p] * r[1]
            if now.k > 0:
                self.theta_hat[p] -= 0.5 * now.h_s * self.Gamma[p] * (self.Yr[p] + Yr)
            self.Yr[p] = Yr
            now.theta_hat[p] = self.theta_hat[p]
            now.tau[0] += first[p] * self.theta_hat[p]
            now.tau[1] += second[p] * self.theta_hat[p]

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the premises: constant delays, bent elbows, lengths within their bounds."""
        if np.isnan(situation.longest_s):
            return StabilityCondition(
                None, "proved for constant delays, and a delay here varies"
            )
        text = (
            f"for every constant delay, while abs(sin q2) > {LEAST_SINE:g} and the lengths are "
            f"within {self.least_m:g} and {self.most_m:g} m (sufficient); the run shows if "
            "elbows stay bent"
        )
        return StabilityCondition(None, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns the [control] table of a site: tuned gains and the first estimate.

        The lengths are learnt, starting from the law's default.
        """
        return {**gains, "theta_hat0": at.estimate}
