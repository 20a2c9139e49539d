"""The adaptive law in a box, with a term against torque that no estimate explains; the kernel
computes it.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core.control import ROBUST_RESIDUE
from ..core.site_setup import Gains
from ..core.vectors import Array
from ..fields import NotNegative, NotNegativeJoints, PositiveJoints
from .adaptive_box import AdaptiveBox
from .conditions import LawSituation, StabilityCondition
from .interface import TuningSite


class AdaptiveRobust(AdaptiveBox):
    """The law with a box, and a term against torque that no estimate explains: - rho r /
    sqrt(r^2 + width^2).

    For constant delays, no operator, theta in its box and a disturbance of at most rho at every
    joint, the mean over time of what V dissipates is at most 0.3003 sum_i beta_i sum rho width;
    no more is claimed. Smoothed after Slotine and Li, "Applied Nonlinear Control" (1991), 7.1;
    docs/laws.md derives the bound.

    Attributes:
        Lambda, Kp, Kd, Gamma, theta_hat0, theta_low, theta_high: as of `AdaptiveBox`.
        rho_nm: bound of the disturbance per joint, N m (of a sliding joint N).
        width_rad_s: r at which 0.71 of it opposes, per joint, rad/s (m/s).
        friction: share of the joints' own friction that the law knows, 0: nothing.
    """

    rho_nm: NotNegativeJoints = (1.0,)
    width_rad_s: PositiveJoints = (0.1,)
    friction: NotNegative = 0.0

    tune: ClassVar = {**AdaptiveBox.tune, "rho_nm": (0.05, 5.0, "N m")}

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core."""
        return AdaptiveBox.gains(self, theta)._replace(
            rho=self.rho_nm, width=self.width_rad_s, friction=(self.friction,)
        )

    def condition(self, situation: LawSituation) -> StabilityCondition:
        """Returns the bound in the mean square, W, of this site's part of what V dissipates."""
        pairs = zip(self.rho_nm, self.width_rad_s, strict=True)
        bound_w = ROBUST_RESIDUE * sum(rho * width for rho, width in pairs)
        constant = not np.isnan(situation.longest_s)
        return StabilityCondition(
            True if constant else None,
            f"delays are {'constant' if constant else 'to be constant, and vary here'}, theta is in its box: "
            f"with torque of at most rho_nm that no estimate explains the mean of beta times r'Kp r and the "
            f"disagreement is at most beta times {bound_w:.3g} W here; sufficient",
        )

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Where r = 0 the robust term damps by a tenth of Kp, which the joints can take
        besides.
        """
        return {
            **AdaptiveBox.write_control(gains, at),
            "width_rad_s": 10.0 * gains["rho_nm"] / gains["Kp"],
        }
