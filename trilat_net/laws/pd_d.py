"""PD+d with known gravity; the kernel computes it (`core.control.damped_torque`)."""

from typing import ClassVar

from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeCoordinates, NotNegativeJoints, PositiveCoordinates
from .interface import DAMPING, ERROR_DAMPING, STIFFNESS, ControlLaw


class PdD(ControlLaw):
    """PD+d with known gravity: tau = G(q) - K e - Kd ed - d qd.

    For constant delays, and Kd / K alike at all sites, the condition of P+d on K and d is
    sufficient.

    Attributes:
        K: stiffness per joint, N m/rad.
        Kd: damping of the error's velocity, per joint, N m s/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveCoordinates = (10.0,)
    Kd: NotNegativeCoordinates = (3.0,)
    d: NotNegativeJoints = (5.0,)
    gravity: NotNegative = 1.0

    tune: ClassVar = {"K": STIFFNESS, "Kd": ERROR_DAMPING, "d": DAMPING}

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core, for an arm of parameters theta."""
        return Gains(
            Law.KNOWN, K=self.K, Kd=self.Kd, d=self.d, known=(theta * self.gravity).tolist()
        )

    def exchanges_positions(self) -> bool:
        """True if it knows gravity exactly."""
        return self.gravity == 1.0
