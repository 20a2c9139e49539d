"""The paper's law between the places of end effectors, with unknown masses and unknown lengths
of the links.

The place x and its velocity are measured; the Jacobian is that of estimated lengths, J_hat = J
+ J~. With e = x - sum_j alpha_ij x_j(t - T), v = -J_hat^-1 Lambda e, a = v' and r = qd - v

    tau = Y(q, qd, v, a) theta_hat - Kp r - J_hat' Kd ed
    theta_hat' = -Gamma Y' r,    l_hat' = Gamma_l Y_k' Kd ed,    Y_k l_hat = J_hat qd

J_hat r = x' + Y_k (l_hat - l) + Lambda e: what the wrong lengths add to -r'J_hat' Kd ed the
derivative of 1/2 (l_hat - l)' Gamma_l^-1 (l_hat - l) takes away, and V' is that of known
lengths (docs/laws.md).

Invariant: both estimates advance by the trapezoid rule, as that of the adaptive law; lengths
stay in their box, which lets that term fall no less. Adaptive Jacobian after C. C. Cheah, C.
Liu and J.-J. E. Slotine, Int. J. Robotics Research 25 (2006).
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.elementary import sincos
from ..core.jit import leaf
from ..core.two_link_arm import regressor
from ..core.user_law import LawContext, LawInput
from ..fields import NotNegative, NotNegativeParameters, Parameters, Positive, PositiveJoints
from .conditions import LawSituation, StabilityCondition
from .interface import ADAPTATION, CONVERGENCE, DAMPING, ERROR_DAMPING, ControlLaw, TuningSite

LEAST_SINE = 0.1
"""A stretched elbow: where abs(sin q2) is below this, J_hat is inverted as if it were this."""


@leaf
def _solve(
    l1: float, l2: float, q0: float, q1: float, b0: float, b1: float
) -> tuple[float, float]:
    """Returns J^-1 b of the planar arm with these lengths."""
    (s0, c0) = sincos(q0)
    (s01, c01) = sincos(q0 + q1)
    (bend, _) = sincos(q1)
    if abs(bend) < LEAST_SINE:
        bend = LEAST_SINE if bend >= 0.0 else -LEAST_SINE
    x = l1 * c0 + l2 * c01
    y = l1 * s0 + l2 * s01
    determinant = l1 * l2 * bend
    return l2 * (c01 * b0 + s01 * b1) / determinant, -(x * b0 + y * b1) / determinant


@leaf
def _move(
    lengths: tuple[float, float], q: tuple[float, float], qd: tuple[float, float]
) -> tuple[float, float, float, float]:
    """Returns place and velocity of the end effector."""
    (s0, c0) = sincos(q[0])
    (s01, c01) = sincos(q[0] + q[1])
    inner = lengths[0] * qd[0]
    outer = lengths[1] * (qd[0] + qd[1])
    x = lengths[0] * c0 + lengths[1] * c01
    y = lengths[0] * s0 + lengths[1] * s01
    return x, y, -s0 * inner - s01 * outer, c0 * inner + c01 * outer


@leaf
def _turn(
    lengths: tuple[float, float],
    rates: tuple[float, float],
    q: tuple[float, float],
    qd: tuple[float, float],
    v: tuple[float, float],
) -> tuple[float, float]:
    """Returns the derivative of the Jacobian, with the joints and the lengths at these rates,
    times v.
    """
    (s0, c0) = sincos(q[0])
    (s01, c01) = sincos(q[0] + q[1])
    inner = lengths[0] * qd[0]
    outer = lengths[1] * (qd[0] + qd[1])
    v01 = v[0] + v[1]
    return (
        -(inner * c0 + rates[0] * s0) * v[0] - (outer * c01 + rates[1] * s01) * v01,
        (rates[0] * c0 - inner * s0) * v[0] + (rates[1] * c01 - outer * s01) * v01,
    )


@compiled
class AdaptiveKinematics(ControlLaw):
    """The paper's law between the places of end effectors, of planar arms whose lengths nobody
    knows.

    The place and velocity of the end effector are measured, and compared in the frame of the
    bases; masses and lengths are learnt. C. C. Cheah, C. Liu and J.-J. E. Slotine, "Adaptive
    tracking control for robots with unknown kinematic and dynamic properties", Int. J. Robotics
    Research 25(3), 283-296, 2006.

    Attributes:
        Lambda: per coordinate x and y, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per coordinate, N s/m.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
        length_gain_m_n: adaptation gain of the lengths, m/N.
        lengths0_m: first estimate of the two lengths.
        least_m: lower bound of both.
        most_m: upper bound.
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
        """Makes both estimates and their rates."""
        self.theta_hat = list(self.theta_hat0)
        self.lengths_m = list(self.lengths0_m)
        self.Yr = [0.0] * len(self.theta_hat)
        self.rate_m_s = [0.0, 0.0]
        self.measured = list(facts.lengths_m)  # what an instrument at the end effector goes by
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Writes the torque, the estimate, and what peers get of the end effector."""
        q = (now.q[0], now.q[1])
        qd = (now.qd[0], now.qd[1])
        x, y, xd, yd = _move((self.measured[0], self.measured[1]), q, qd)
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
            came = now.received[j]
            # a peer of whom nothing came yet is where the arm itself is, and stands
            if peer.tick >= 0:
                e0 += peer.alpha * (x - came.x[0])
                e1 += peer.alpha * (y - came.x[1])
                ed0 -= peer.alpha * came.xd[0]
                ed1 -= peer.alpha * came.xd[1]
        (s0, c0) = sincos(q[0])
        (s01, c01) = sincos(q[0] + q[1])
        f0 = self.Kd[0] * ed0
        f1 = self.Kd[1] * ed1
        pull = (c0 * f1 - s0 * f0, c01 * f1 - s01 * f0)
        for i in range(2):
            rate = self.length_gain_m_n * pull[i] * (qd[0] + i * qd[1])  # Y_k' Kd ed
            if now.k > 0:
                length = self.lengths_m[i] + 0.5 * now.h_s * (self.rate_m_s[i] + rate)
                self.lengths_m[i] = min(max(length, self.least_m), self.most_m)
            self.rate_m_s[i] = rate
        l1 = self.lengths_m[0]
        l2 = self.lengths_m[1]
        g1 = self.rate_m_s[0] if self.least_m < l1 < self.most_m else 0.0
        g2 = self.rate_m_s[1] if self.least_m < l2 < self.most_m else 0.0
        v = _solve(
            l1=l1, l2=l2, q0=q[0], q1=q[1], b0=-self.Lambda[0] * e0, b1=-self.Lambda[1] * e1
        )
        turned = _turn(lengths=(l1, l2), rates=(g1, g2), q=q, qd=qd, v=v)
        a = _solve(
            l1=l1,
            l2=l2,
            q0=q[0],
            q1=q[1],
            b0=-self.Lambda[0] * ed0 - turned[0],
            b1=-self.Lambda[1] * ed1 - turned[1],
        )
        r = (qd[0] - v[0], qd[1] - v[1])
        now.tau[0] = -self.Kp[0] * r[0] - (l1 * pull[0] + l2 * pull[1])
        now.tau[1] = -self.Kp[1] * r[1] - l2 * pull[1]
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
        """Returns the premises: constant delays, elbows that stay bent, lengths within their
        bounds.
        """
        if np.isnan(situation.longest_s):
            return StabilityCondition(
                None, "proved for constant delays, and a delay here varies"
            )
        return StabilityCondition(
            None,
            f"for every constant delay, while abs(sin q2) > {LEAST_SINE:g} and the lengths are within "
            f"{self.least_m:g} and {self.most_m:g} m (sufficient); the run shows if elbows stay bent",
        )

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns tuned gains with the first estimate; lengths are learnt from those that the
        law assumes.
        """
        return {**gains, "theta_hat0": at.estimate}
