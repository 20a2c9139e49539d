"""PD+d under its published bound of the damping; the kernel computes it
(`core.control.damped_torque`).
"""

from collections.abc import Mapping
from typing import Any, ClassVar

from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeCoordinates, NotNegativeJoints, PositiveCoordinates
from .conditions import LawSituation, StabilityCondition, judge_position_exchange
from .interface import DAMPING, ERROR_DAMPING, STIFFNESS, ControlLaw, TuningSite


class LeeSpong(ControlLaw):
    """PD+d under its published bound: d = K T_max + P_e for delays up to T_max.

    Lee and Spong, "Passive bilateral teleoperation with constant time delay", IEEE T-RO 22,
    2006.

    Attributes:
        K: stiffness per joint, N m/rad.
        Kd: damping of the error's velocity, per joint, N m s/rad.
        T_max_ms: half of the longest round trip, ms.
        P_e: damping beyond what the delay needs, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveCoordinates = (10.0,)
    Kd: NotNegativeCoordinates = (3.0,)
    T_max_ms: NotNegative = 200.0
    P_e: NotNegativeJoints = (0.0,)
    gravity: NotNegative = 1.0

    tune: ClassVar = {"K": STIFFNESS, "Kd": ERROR_DAMPING, "d_extra": DAMPING}

    @property
    def damping(self) -> tuple[float, ...]:
        """The damping d per joint, N m s/rad."""
        return tuple(
            stiff * 1e-3 * self.T_max_ms + extra
            for stiff, extra in zip(self.K, self.P_e, strict=True)
        )

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core: those of PD+d."""
        known = (theta * self.gravity).tolist()
        return Gains(Law.KNOWN, K=self.K, Kd=self.Kd, d=self.damping, known=known)

    def condition(self, situation: LawSituation) -> StabilityCondition | None:
        """Returns the condition of P+d on K and d."""
        return judge_position_exchange(situation, "K", "damping")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """T_max is half of the longest mean round trip: for delays that vary its bound is not
        proved.
        """
        told = {"T_max_ms": at.longest_ms, "gravity": at.gravity}
        return {"K": gains["K"], "Kd": gains["Kd"], "P_e": gains["d_extra"], **told}
