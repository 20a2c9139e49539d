"""Implements the adaptive law with bounds: each estimated parameter is kept in an interval.

The adaptive law estimates the dynamic parameters theta of its arm, such as masses and inertias.
Without bounds, an estimate may drift as long as the errors are not zero. With this law, the
user states a lowest and a highest value for each parameter (together a box), and a projection
keeps the estimate between them. The torque is computed as in `Adaptive`, by Eq. (13) of the
paper.

The compiled control loop computes this law (`core.step.control.project_estimate`).
`AdaptiveBox.advance_estimate` states the projection in plain Python, and
`tests/control_laws/test_plain_torques.py` checks that both give the same numbers.
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
    """Adaptive law that keeps the estimate of each parameter of the arm between two bounds.

    The law is `Adaptive` with a projection of the estimates. If the true parameters lie within
    the bounds, or on them, the projection preserves the stability proof: the energy function V
    of the proof still never increases (V' <= 0).

    Without bounds, an estimate that learns gravity acts like a spring that pulls the arms back
    to a pose. If the true parameters lie strictly between the bounds, this effect disappears.

    Source: Ioannou and Sun, "Robust Adaptive Control" (1996), 4.4, for the projection.

    Attributes:
        Lambda, Kp, Kd, Gamma, theta_hat0: Gains and first estimate, as in `Adaptive`.
        theta_low: Lower bound of each estimate.
        theta_high: Upper bound of each estimate.
    """

    theta_low: Parameters = (-MAX_QUANTITY,)
    theta_high: Parameters = (MAX_QUANTITY,)

    known_facts: ClassVar = "gravity, as its first estimate; the box is around it"

    def advance_estimate(self, theta_hat: Array, Yr: Array, gain_s: float) -> Array:
        """Returns the estimate after a step of Eq. (15), limited to its bounds.

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
        """Converts gains and bounds of this law to the form that the control loop reads.

        Args:
            theta: True parameters of the arm. This law does not use them, because it learns
                them.
        """
        gains = Adaptive.gains(self, theta)
        return gains._replace(low=self.theta_low, high=self.theta_high)

    def check(self, path: str, sites: int) -> None:  # noqa: ARG002 - used by other laws
        """Rejects settings of the law that contradict each other.

        A lower bound must not exceed its upper bound, and the first estimate must lie within
        the bounds.

        Args:
            path: Path of the law's table in the scenario, for errors.
            sites: Number of sites, which this law does not use.

        Raises:
            ScenarioError: A bound or an estimate is invalid. The error names the key.
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
        """Returns the settings of this law for one arm, after its gains were tuned.

        The settings form the table [control] of a scenario, the description of an experiment.
        They contain the tuned gains, the estimate of the arm's parameters with which the law
        starts, and the bounds within which the estimate must stay.

        Args:
            gains: Tuned gains by name.
            site: Facts about the arm for which the table is written.
        """
        control = Adaptive.write_control(gains, site)
        low, high = site.box
        return {**control, "theta_low": low, "theta_high": high}
