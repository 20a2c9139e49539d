"""The paper's adaptive law with every estimate held in a box; the kernel computes it."""

from collections.abc import Mapping
from typing import Any, ClassVar

from ..core.site_setup import Gains
from ..core.vectors import Array
from ..errors import ScenarioError
from ..fields import MAX_QUANTITY, Parameters
from .adaptive import Adaptive
from .interface import TuningSite


class AdaptiveBox(Adaptive):
    """The paper's law with every estimate held in a box.

    A box that holds the truth, at its edge too, keeps V' <= 0; one that holds it strictly
    inside also removes the spring by which learning gravity ties the arms to a pose. Projection
    after Ioannou and Sun, "Robust Adaptive Control" (1996), 4.4.

    Attributes:
        Lambda, Kp, Kd, Gamma, theta_hat0: as of `Adaptive`.
        theta_low: lower bound of each estimate.
        theta_high: upper bound.
    """

    theta_low: Parameters = (-MAX_QUANTITY,)
    theta_high: Parameters = (MAX_QUANTITY,)

    told: ClassVar = "gravity, as its first estimate; the box is around it"

    def gains(self, theta: Array) -> Gains:
        """Returns the gains for the core."""
        return Adaptive.gains(self, theta)._replace(low=self.theta_low, high=self.theta_high)

    def check(self, path: str, sites: int) -> None:  # noqa: ARG002 - as the other laws
        """Refuses a box without an inside, and a first estimate outside of it."""
        bounds = zip(self.theta_low, self.theta_hat0, self.theta_high, strict=True)
        for n, (low, first, high) in enumerate(bounds):
            if low > high:
                problem = f"must be at least theta_low = {low:g}, is {high:g}"
                raise ScenarioError(problem, path=f"{path}.theta_high[{n}]")
            if not low <= first <= high:
                problem = f"must lie in its box from {low:g} to {high:g}, is {first:g}"
                raise ScenarioError(problem, path=f"{path}.theta_hat0[{n}]")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns tuned gains with the first estimate and the box around it."""
        low, high = at.box
        return {**Adaptive.write_control(gains, at), "theta_low": low, "theta_high": high}
