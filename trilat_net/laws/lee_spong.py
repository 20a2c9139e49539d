"""PD+d whose damping follows from a published bound on the delay.

The kernel computes this law (`core.control.damped_torque`). `LeeSpong.compute_torque` states
the same law in plain Python, and `tests/control_laws/test_plain_torques.py` compares the two.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeCoordinates, NotNegativeJoints, PositiveCoordinates
from .conditions import LawSituation, StabilityCondition, judge_position_exchange
from .interface import DAMPING, ERROR_DAMPING, STIFFNESS, ControlLaw, TuningSite


class LeeSpong(ControlLaw):
    """PD+d with the damping d = K T_max + P_e, for delays up to T_max.

    Source: Lee and Spong, "Passive bilateral teleoperation with constant time delay", IEEE T-RO
    22, 2006.

    Attributes:
        K: stiffness per joint, N m/rad.
        Kd: damping of the error's velocity, per joint, N m s/rad.
        T_max_ms: half of the longest round trip, ms.
        P_e: damping beyond the amount that the delay needs, per joint, N m s/rad.
        gravity: share of the true gravity that the law compensates; 1 is exact.
    """

    K: PositiveCoordinates = (10.0,)
    Kd: NotNegativeCoordinates = (3.0,)
    T_max_ms: NotNegative = 200.0
    P_e: NotNegativeJoints = (0.0,)
    gravity: NotNegative = 1.0

    tune: ClassVar = {"K": STIFFNESS, "Kd": ERROR_DAMPING, "d_extra": DAMPING}

    @property
    def damping(self) -> tuple[float, ...]:
        """The damping d = K T_max + P_e per joint, N m s/rad."""
        damping = []
        for K, P_e in zip(self.K, self.P_e, strict=True):
            needed = K * 1e-3 * self.T_max_ms
            damping.append(needed + P_e)
        return tuple(damping)

    def compute_torque(self, G: Array, e: Array, ed: Array, qd: Array) -> Array:
        """Returns the torque of each joint before the torque limits, N m.

            tau = G(q) - K e - (K T_max + P_e) qd - Kd ed

        Args:
            G: torque of the known gravity, shape (n,), N m.
            e: position error q - q_des, Eq. (9), shape (n,), rad.
            ed: derivative of the error, shape (n,), rad/s.
            qd: joint velocities, shape (n,), rad/s.
        """
        spring = np.array(self.K) * e
        damper = np.array(self.damping) * qd
        error_damper = np.array(self.Kd) * ed
        # The order of the terms is the kernel's for the planar arm: the last bit depends on it.
        return G - spring - damper - error_damper

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the kernel, those of PD+d, for an arm with parameters theta."""
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=self.K, Kd=self.Kd, d=self.damping, known=known)

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition of P+d on K and d."""
        return judge_position_exchange(situation, "K", "damping")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns the [control] table of a site for tuned gains.

        T_max is half of the longest mean round trip. For delays that vary, the bound is not
        proved.
        """
        return {
            "K": gains["K"],
            "Kd": gains["Kd"],
            "P_e": gains["d_extra"],
            "T_max_ms": at.longest_ms,
            "gravity": at.gravity,
        }
