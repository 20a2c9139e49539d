"""The adaptive law with bounds, which keep each estimated parameter within an interval.

The adaptive law estimates the dynamic parameters theta of its arm, such as masses and inertias.
Without bounds, an estimate may drift as long as the errors are not zero. With this law, the
user specifies a lower and an upper bound for each parameter (together a box), and a projection
keeps the estimate within them. The torque is computed as in `Adaptive`, by Eq. (13) of the
paper.

The compiled control loop computes this law (`core.step.control.project_estimate`).
`AdaptiveBox.advance_estimate` implements the projection in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same results.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from ..core import Array, Gains
from ..errors import ScenarioError
from ..fields import MAX_QUANTITY, Parameters
from .adaptive import Adaptive
from .interface import TuningSite


class AdaptiveBox(Adaptive):
    """Adaptive law that keeps each parameter estimate between a lower and an upper bound.

    This is `Adaptive` with a projection of the estimates. If the true parameters lie within or
    on the bounds, the projection preserves the stability proof: the energy function V of the
    proof never increases (V' <= 0).

    Without bounds, learning the gravity torque acts like a spring that pulls each arm towards
    one pose. This effect disappears if the true parameters lie strictly between the bounds.

    Source: Ioannou and Sun, "Robust Adaptive Control" (1996), 4.4, for the projection.

    Attributes:
        Lambda, Kp, Kd, Gamma, theta_hat0: Gains and initial estimate, as in `Adaptive`.
        theta_low: Lower bound of each estimate.
        theta_high: Upper bound of each estimate.
    """

    theta_low: Parameters = (-MAX_QUANTITY,)
    theta_high: Parameters = (MAX_QUANTITY,)

    known_facts: ClassVar = "gravity, as its first estimate; the box is around it"

    def find_sampling_excess(self, g_m_s2: float, tick_s: float) -> None:  # noqa: ARG002
        """Returns None, because no rule about the tick rate is known for bounded estimates."""
        return

    def advance_estimate(self, theta_hat: Array, Yr: Array, gain_s: float) -> Array:
        """Returns the estimate after one time step of Eq. (15), clipped to its bounds.

            min(max(theta_hat - gain_s Gamma Y' r, theta_low), theta_high)

        Here Gamma is the adaptation gain, Y the regressor and r the filtered error.

        Args:
            theta_hat: Estimate of the arm's parameters before the step, shape (P,).
            Yr: Product Y' r, shape (P,).
            gain_s: Duration of the step, s.
        """
        estimate = Adaptive.advance_estimate(self, theta_hat, Yr, gain_s)
        above_low = np.maximum(estimate, self.theta_low)
        return np.minimum(above_low, self.theta_high)

    def gains(self, theta: Array) -> Gains:
        """Converts the gains and bounds of this law to the form that the control loop reads.

        Args:
            theta: True parameters of the arm, unused because this law learns them.
        """
        gains = Adaptive.gains(self, theta)
        return gains._replace(low=self.theta_low, high=self.theta_high)

    def check(self, path: str, sites: int) -> None:  # noqa: ARG002 - used by other laws
        """Raises ScenarioError if settings of the law contradict each other.

        A lower bound must not exceed its upper bound, and the initial estimate must lie within
        the bounds.

        Args:
            path: Path of the law's table in the scenario, for error messages.
            sites: Number of sites, unused by this law.

        Raises:
            ScenarioError: A bound or an estimate is invalid. The message contains the key.
        """
        parameters = zip(self.theta_low, self.theta_hat0, self.theta_high, strict=True)
        for n, (low, first, high) in enumerate(parameters):
            if low > high:
                problem = f"must be at least theta_low = {low:g}, not {high:g}"
                raise ScenarioError(problem, path=f"{path}.theta_high[{n}]")
            if not low <= first <= high:
                bounds = f"theta_low = {low:g} and theta_high = {high:g}"
                problem = f"must be between {bounds}, but is {first:g}"
                raise ScenarioError(problem, path=f"{path}.theta_hat0[{n}]")

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of this law for one arm, with tuned gains.

        The table contains the tuned gains, the initial estimate of the arm's parameters, and
        the bounds of the estimate.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        control = Adaptive.write_control(gains, site)
        low, high = site.box
        return {**control, "theta_low": low, "theta_high": high}
