"""P+d with known gravity; the kernel computes it (`core.control.damped_torque`)."""

from typing import ClassVar

from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeJoints, PositiveCoordinates
from .interface import DAMPING, STIFFNESS, ControlLaw


class PD(ControlLaw):
    """P+d with known gravity: tau = G(q) - K e - d qd.

    For reversible shares, equal gains and one constant delay T the linearised loop of N sites
    is stable whatever the masses if d > max(abs(lambda_min(alpha)), 0.2172) K T, and for some
    masses only then; two sites need 4 d_1 d_2 > (T_1 + T_2)^2 K_1 K_2. For other shares some
    heavy arms are unstable at any d. That is in continuous time: held torques need more
    (docs/laws.md).

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveCoordinates = (10.0,)
    d: NotNegativeJoints = (3.0,)
    gravity: NotNegative = 1.0

    tune: ClassVar = {"K": STIFFNESS, "d": DAMPING}

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core, for an arm of parameters theta."""
        return Gains(Law.KNOWN, K=self.K, d=self.d, known=(theta * self.gravity).tolist())

    def exchanges_positions(self) -> bool:
        """True if it knows gravity exactly."""
        return self.gravity == 1.0
