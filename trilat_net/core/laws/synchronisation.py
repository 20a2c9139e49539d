"""Adaptive synchronisation of outputs r = qd + Lambda q, with its defect under gravity.

    tau_i = Y(q, qd, -Lambda q, -Lambda qd) theta_hat + K (sum_j alpha_ij r_j(t - T) - r_i)
    theta_hat' = -Gamma Y' r_i

r has the absolute pose in it. With gravity every equilibrium has Y_G' r = 0, so the arms end at q = 0.

Invariant: the estimate advances by the trapezoid rule, as that of the adaptive law.
"""

from collections.abc import Sequence
from typing import ClassVar

from ..compiled_law import compiled
from ..two_link_arm import regressor
from ..user_law import LawContext, LawInput


@compiled
class Synchronisation:
    """The law of a site with a planar arm of two joints; its gains are per joint, Gamma per parameter."""

    remembers: ClassVar[tuple[str, ...]] = ("theta_hat", "Yr")

    def __init__(
        self,
        facts: LawContext,
        Lambda: Sequence[float],
        K: Sequence[float],
        Gamma: Sequence[float],
        theta_hat0: Sequence[float],
    ) -> None:
        if not any(facts.lengths_m):
            raise ValueError("it has the regressor of the planar arm of two links, and this is a chain")
        self.Lambda, self.K, self.Gamma = Lambda, K, Gamma
        self.theta_hat = list(theta_hat0)
        self.Yr = [0.0] * len(self.theta_hat)
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Writes the torque and the estimate."""
        q0, q1, w0, w1 = now.q[0], now.q[1], now.qd[0], now.qd[1]
        v = (-self.Lambda[0] * q0, -self.Lambda[1] * q1)
        a = (-self.Lambda[0] * w0, -self.Lambda[1] * w1)
        first, second = regressor(self.g_m_s2, (q0, q1), (w0, w1), v, a)
        r0, r1 = w0 - v[0], w1 - v[1]
        now.tau[0] = self.K[0] * (now.qd_des[0] + self.Lambda[0] * now.q_des[0] - r0)
        now.tau[1] = self.K[1] * (now.qd_des[1] + self.Lambda[1] * now.q_des[1] - r1)
        for p in range(len(self.Yr)):
            Yr = first[p] * r0 + second[p] * r1
            if now.k > 0:
                self.theta_hat[p] -= 0.5 * now.h_s * self.Gamma[p] * (self.Yr[p] + Yr)
            self.Yr[p] = Yr
            now.theta_hat[p] = self.theta_hat[p]
            now.tau[0] += first[p] * self.theta_hat[p]
            now.tau[1] += second[p] * self.theta_hat[p]
