"""What every law is told of the arms before the search: gravity, rightly or wrongly, and nothing else.

Law: all laws are told the same. The two gravity parameters are the truth times one share; those of inertia
are not told, and a law that estimates them begins at zero.
"""

from typing import NamedTuple

from ..core.arm import PARAMETERS
from ..errors import UsageError
from ..scenario import Scenario
from ..scenario.quantities import LARGEST

GRAVITY = slice(3, PARAMETERS)
"""Where the gravity parameters stand in theta, Eq. (24)."""
LEAST_BOX = 0.1
"""A box of estimates is at least so wide to either side of what is told, as a share of it."""


class Knowledge(NamedTuple):
    """What is told.

    Attributes:
        gravity: what is told of gravity, as a share of the truth; 1: exactly.
    """

    gravity: float = 1.0

    @property
    def box(self) -> float:
        """Half the width of a box of estimates, as a share of what is told: twice the error, or 10 %."""
        return max(LEAST_BOX, 2.0 * abs(1.0 / self.gravity - 1.0))

    def prior(self, scenario: Scenario, site: str) -> list[float]:
        """Returns the first estimate of theta, shape (5,): gravity as told, inertia unknown."""
        told = scenario.sites[site].arm.theta * self.gravity
        told[: GRAVITY.start] = 0.0
        return [float(f"{value:.12g}") for value in told]

    def low(self, scenario: Scenario, site: str) -> list[float]:
        """Returns the lower sides of the box, shape (5,)."""
        return self._side(scenario, site, -1.0)

    def high(self, scenario: Scenario, site: str) -> list[float]:
        """Returns the upper sides of the box, shape (5,)."""
        return self._side(scenario, site, 1.0)

    def _side(self, scenario: Scenario, site: str, sign: float) -> list[float]:
        gravity = self.prior(scenario, site)[GRAVITY]
        return [sign * LARGEST] * GRAVITY.start + [
            float(f"{value * (1.0 + sign * self.box):.12g}") for value in gravity
        ]

    @property
    def text(self) -> str:
        """The same in words."""
        how = "exactly" if self.gravity == 1.0 else f"as {100.0 * self.gravity:g} % of what it is"
        return f"every law is told gravity {how}, and nothing of inertia"


def told(gravity_percent: float) -> Knowledge:
    """Returns what a person says all laws are to be told.

    Args:
        gravity_percent: of the true gravity.

    Raises:
        UsageError: it is none that an arm could be built with.
    """
    if not 50.0 <= gravity_percent <= 150.0:
        raise UsageError(f"--gravity is from 50 to 150 % of the truth, not {gravity_percent:g}")
    return Knowledge(gravity_percent / 100.0)
