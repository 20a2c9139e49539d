"""What linear analysis says of the places of a map: the rightmost root of each, and where it crosses.

Law: it is asked about scenarios alone, and knows nothing of any run of the map. Where the scheme is `digital`
the loop counts as it is computed, tick by tick, else the continuous one.
"""

from collections.abc import Sequence

import numpy as np

from ..core.setup import Scheme
from ..errors import ScenarioError
from ..linear import Rest, edge, rest_of
from ..linear.conditions import conditions
from ..linear.loop import loop_of
from ..linear.rest import knows_gravity, predicted_rest, rest_near
from ..linear.roots import spectrum
from ..linear.sampled import sampled_spectrum
from ..scenario import Scenario


def growths(scenarios: Sequence[Scenario]) -> tuple[list[float], list[str]]:
    """Returns the real part of the rightmost root of some scenarios beside each other, 1/s.

    Where the first rests is found once, and moved along.

    Args:
        scenarios: each a small step from the one before.

    Returns:
        The real parts, NaN where there is no linear loop, and why that is, each reason once.
    """
    rest: Rest | None = None
    found: list[float] = []
    reasons: dict[str, None] = {}
    for scenario in scenarios:
        try:
            if rest is None:
                known = knows_gravity(conditions(scenario))
                rest = predicted_rest(scenario) if known else rest_of(scenario)
            else:
                rest = rest_near(scenario, rest)
            found.append(_growth(scenario, rest))
        except ScenarioError as error:
            reasons[error.problem] = None
            found.append(float("nan"))
    return found, list(reasons)


def _growth(scenario: Scenario, rest: Rest) -> float:
    """Returns the real part of the rightmost root about a rest, 1/s; -infinity where nothing moves."""
    now = conditions(scenario)
    digital = scenario.scheme == Scheme.DIGITAL.name.lower()
    found = spectrum(loop_of(now, rest), 4 if digital else 1)
    if digital:
        near = np.array([root.s for root in found.roots], dtype=np.complex128)
        found = sampled_spectrum(now, rest, near, 1) or found
    return -np.inf if found.rightmost is None else found.rightmost.s.real


def crossing(scenario: Scenario, key: str, low: float, high: float) -> float | None:
    """Returns the lowest value of a key at which the rightmost root crosses the imaginary axis, or None.

    Args:
        scenario: the experiment; the key's own value does not count.
        key: dotted, of a number.
        low: from.
        high: to.

    Raises:
        ScenarioError: it has no linear loop; says why.
    """
    found = edge(scenario, key, low, high)
    return None if found is None else found.value
