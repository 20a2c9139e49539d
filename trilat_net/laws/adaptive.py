"""The paper's adaptive law, Eq. (13) and (15); the kernel computes it (`core.control`)."""

from collections.abc import Mapping
from typing import Any, ClassVar

from ..core.site_setup import Gains, Law
from ..core.vectors import Array
from ..fields import (
    NotNegativeCoordinates,
    NotNegativeParameters,
    Parameters,
    PositiveCoordinates,
    PositiveJoints,
)
from .interface import ADAPTATION, CONVERGENCE, DAMPING, ERROR_DAMPING, ControlLaw, TuningSite


class Adaptive(ControlLaw):
    """The paper's adaptive law, Eq. (13) and (15).

    Stable for any constant delays without external torque, if the dominance matrix is
    irreducible and the Kd of all sites are one matrix but for a scalar each (the paper's
    theorem, weights of docs/errata.md). This is sufficient; it does not cover delays that vary.

    Gamma = 0 and theta_hat0 = theta make the law of known parameters; Kd = 0 removes the
    error's damping.

    Attributes:
        Lambda: per joint, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
    """

    Lambda: PositiveCoordinates = (1.0,)
    Kp: PositiveJoints = (1.0,)
    Kd: NotNegativeCoordinates = (3.0,)
    Gamma: NotNegativeParameters = (1.0,)
    theta_hat0: Parameters = (0.0,)

    has_functional: ClassVar = True
    tune: ClassVar = {
        "Lambda": CONVERGENCE,
        "Kp": DAMPING,
        "Kd": ERROR_DAMPING,
        "Gamma": ADAPTATION,
    }
    told: ClassVar = "gravity, as its first estimate"

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the gains for the core, for an arm of parameters theta."""
        return Gains(
            law=Law.ADAPTIVE,
            Lambda=self.Lambda,
            Kp=self.Kp,
            Kd=self.Kd,
            Gamma=self.Gamma,
            theta_hat0=self.theta_hat0,
        )

    def exchanges_positions(self) -> bool:
        """True if it does not learn."""
        return not any(self.Gamma)

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns tuned gains with the first estimate."""
        return {**gains, "theta_hat0": at.estimate}
