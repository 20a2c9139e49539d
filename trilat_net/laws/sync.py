"""Adaptive synchronisation of outputs r = qd + Lambda q, with its defect under gravity.

r has the absolute pose in it. With gravity every equilibrium has Y_G' r = 0, so the arms end at
q = 0.

Invariant: the estimate advances by the trapezoid rule, as that of the adaptive law.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core.compiled_law import compiled
from ..core.site_setup import Gains, Law
from ..core.two_link_arm import regressor
from ..core.user_law import LawContext, LawInput
from ..core.vectors import Array
from ..fields import NotNegativeParameters, Parameters, PositiveJoints
from .conditions import LawSituation, StabilityCondition
from .interface import ADAPTATION, CONVERGENCE, DAMPING, ControlLaw, TuningSite


@compiled
class Sync(ControlLaw):
    """Adaptive synchronisation of r = qd + Lambda q: under gravity all arms end at q = 0.

    tau = Y(q, qd, -Lambda q, -Lambda qd) theta_hat + K (sum alpha_ij r_j - r), theta_hat' =
    -Gamma Y' r. For planar arms. Chopra, Spong and Lozano, "Synchronization of bilateral
    teleoperators with time delay", Automatica 44, 2008; the defect: Nuno, Ortega and Basanez,
    Automatica 46, 2010.

    Attributes:
        Lambda: per joint, 1/s.
        K: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
    """

    Lambda: PositiveJoints = (1.0,)
    K: PositiveJoints = (3.0,)
    Gamma: NotNegativeParameters = (1.0,)
    theta_hat0: Parameters = (0.0,)

    planar: ClassVar = True
    remembers: ClassVar = ("theta_hat", "Yr")
    tune: ClassVar = {"Lambda": CONVERGENCE, "Kp": DAMPING, "Gamma": ADAPTATION}
    known_facts: ClassVar = "gravity, as its first estimate"

    def begin(self, facts: LawContext) -> None:
        """Makes the estimate and its rate."""
        self.theta_hat = list(self.theta_hat0)
        self.Yr = [0.0] * len(self.theta_hat)
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Writes the torque and the estimate."""
        q0 = now.q[0]
        q1 = now.q[1]
        w0 = now.qd[0]
        w1 = now.qd[1]
        v = (-self.Lambda[0] * q0, -self.Lambda[1] * q1)
        a = (-self.Lambda[0] * w0, -self.Lambda[1] * w1)
        first, second = regressor(g=self.g_m_s2, q=(q0, q1), qd=(w0, w1), v=v, a=a)
        r0 = w0 - v[0]
        r1 = w1 - v[1]
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

    def linear_gains(self, theta: Array) -> Gains | None:  # noqa: ARG002
        """Returns the adaptive law whose r is that of the absolute pose."""
        gains = Gains(
            Law.ADAPTIVE, self.Lambda, self.K, Gamma=self.Gamma, theta_hat0=self.theta_hat0
        )
        return gains._replace(absolute=True)

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns that every constant delay is allowed, and what it then does."""
        if np.isnan(situation.longest_s):
            return StabilityCondition(
                None, "proved for constant delays, and a delay here varies"
            )
        text = "r of all sites agree for every constant delay, any Lambda, K and Gamma > 0 (sufficient)"
        return StabilityCondition(
            True, f"{text}; but under gravity the arms end at q = 0, wherever they are led"
        )

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns tuned gains, of which K is called as that of the other adaptive laws, Kp."""
        told = {"Lambda": gains["Lambda"], "K": gains["Kp"], "Gamma": gains["Gamma"]}
        return {**told, "theta_hat0": at.estimate}
