"""Implements adaptive synchronisation of outputs, including its known weakness under gravity.

Each site, a process that runs one arm, compares its output r = qd + Lambda q with the outputs
of its peers. Here q and qd are the positions and velocities of the joints, and Lambda is a
gain. While it controls the arm, the law learns the dynamic parameters of the arm, such as
masses.

The output contains the pose itself instead of the difference between two poses. Under gravity
every equilibrium satisfies Y_G' r = 0, where Y_G, the regressor of gravity, is the matrix whose
product with the parameters is the gravity torque. Therefore all arms end at q = 0.

Invariant:
    - The estimate of the parameters advances by the trapezoid rule, as in the adaptive law.
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

        tau = Y(q, qd, -Lambda q, -Lambda qd) theta_hat + K (sum_j alpha_ij r_j - r)
        theta_hat' = -Gamma Y' r

    The law is for planar arms.

    Source: Chopra, Spong and Lozano, "Synchronization of bilateral teleoperators with time
    delay", Automatica 44, 2008; the defect is described in Nuno, Ortega and Basanez, Automatica
    46, 2010.

    Attributes:
        Lambda: Weight of the pose in r, per joint, 1/s.
        K: Gain towards the peers' outputs, per joint, N m s/rad.
        Gamma: Adaptation gain per parameter.
        theta_hat0: First estimate of theta, Eq. (24).
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
        """Creates the memory of the law: the estimate of the parameters and its last rate.

        The rate is Y' r of the tick before, the product of the regressor and the filtered
        error.
        """
        self.theta_hat = list(self.theta_hat0)
        self.Yr = [0.0] * len(self.theta_hat)
        self.g_m_s2 = facts.g_m_s2

    def torque(self, now: LawInput) -> None:
        """Computes the torque and the new estimate of the parameters in one tick.

        The regressor Y of the planar arm is evaluated once for both.

        Args:
            now: Inputs and outputs of the law in this tick.
        """
        half_h = 0.5 * now.h_s
        Lambda_1 = self.Lambda[0]
        Lambda_2 = self.Lambda[1]
        q = (now.q[0], now.q[1])
        qd = (now.qd[0], now.qd[1])
        v = (-Lambda_1 * q[0], -Lambda_2 * q[1])
        a = (-Lambda_1 * qd[0], -Lambda_2 * qd[1])
        r = (qd[0] - v[0], qd[1] - v[1])
        for i in range(2):
            peer_output = now.qd_des[i] + self.Lambda[i] * now.q_des[i]
            now.tau[i] = self.K[i] * (peer_output - r[i])
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

    def linear_gains(self, theta: Array) -> Gains | None:  # noqa: ARG002
        """Returns gains for the linear analysis: those of the adaptive law of the kernel.

        The filtered error is r = qd + Lambda q here, instead of qd + Lambda e.

        Args:
            theta: Parameters of the arm, which this law does not use.
        """
        return Gains(
            law=Law.ADAPTIVE,
            Lambda=self.Lambda,
            Kp=self.K,
            Gamma=self.Gamma,
            theta_hat0=self.theta_hat0,
            absolute=True,
        )

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the stability condition of this law: the delays must be constant.

        Its text also names the pose at which all arms end under gravity.

        Args:
            situation: The site, its peers and the delays between them.
        """
        if np.isnan(situation.longest_s):
            text = "proved for constant delays, and a delay here varies"
            return StabilityCondition(None, text)
        text = (
            "r of all sites agree for every constant delay, any Lambda, K and Gamma > 0 "
            "(sufficient); but under gravity the arms end at q = 0, wherever users move them"
        )
        return StabilityCondition(True, text)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the [control] table of a site for tuned gains.

        The tuned gain is called Kp, as in the other adaptive laws, and is this law's K.

        Args:
            gains: The tuned gains by name.
            site: The site whose table is written.
        """
        return {
            "Lambda": gains["Lambda"],
            "K": gains["Kp"],
            "Gamma": gains["Gamma"],
            "theta_hat0": site.estimate,
        }
