"""What linear analysis says of the places of a map: the rightmost root of each, and where it crosses.

Law: it is asked about scenarios alone, and knows nothing of any run of the map. Where the scheme is `digital`
the loop counts as it is computed, tick by tick, else the continuous one.
"""

from collections.abc import Sequence

import numpy as np

from ..errors import ScenarioError
from ..linear import Rest, edges, rest_of
from ..linear.conditions import conditions
from ..linear.field import adapts
from ..linear.rest import knows_gravity, predicted_rest, rest_near
from ..linear.rightmost import digital, rightmost
from ..scenario import Scenario

LEARNING = (
    "the linear analysis of a law that learns is about the mean start pose, with estimates that are the "
    "truth: where a run rests follows from all that happened before"
)


def growths(scenarios: Sequence[Scenario]) -> tuple[list[float], list[str]]:
    """Returns the real part of the rightmost root of some scenarios beside each other, 1/s.

    Args:
        scenarios: each a small step from the one before.

    Returns:
        The real parts, NaN where there is no linear loop; and what is to be known of them, once each.
    """
    rest: Rest | None = None
    found: list[float] = []
    remarks: dict[str, None] = {}
    for scenario in scenarios:
        try:
            rest, remark = _rest(scenario, rest)
            found.append(_growth(scenario, rest))
        except ScenarioError as error:
            remark = f"no linear analysis: {error.problem}"
            found.append(float("nan"))
        if remark:
            remarks[remark] = None
    return found, list(remarks)


def _rest(scenario: Scenario, before: Rest | None) -> tuple[Rest, str]:
    """Returns what a scenario is linearised about, and what is to be known of it.

    The first of some scenarios: where it comes to rest by its linear loop, or where a run of it ends if
    somebody is at the arms. The others: at the equilibrium next to that of the one before.
    """
    now = conditions(scenario)
    if any(map(adapts, now.sites)) and not any(site.actors for site in now.sites):
        first, second = np.mean([spec.q0_rad for spec in scenario.sites.values()], axis=0).tolist()
        return rest_of(scenario, (first, second)), LEARNING
    if before is not None:
        return rest_near(scenario, before), ""
    return (predicted_rest(scenario) if knows_gravity(now) else rest_of(scenario)), ""


def _growth(scenario: Scenario, rest: Rest) -> float:
    """Returns the real part of the rightmost root about a rest, 1/s; -infinity where nothing moves."""
    found = rightmost(conditions(scenario), rest, sampled=digital(scenario))
    return -np.inf if found is None else found.s.real


def crossings(scenario: Scenario, key: str, low: float, high: float) -> tuple[tuple[float, ...], str]:
    """Returns the values of a key at which the rightmost root crosses the imaginary axis, from below.

    Args:
        scenario: the experiment; the key's own value says what is linearised about.
        key: dotted, of a number.
        low: from.
        high: to.

    Returns:
        The values, none where the linear analysis says nothing; and what is to be known of them, or "".
    """
    try:
        rest, remark = _rest(scenario, None)
        return tuple(one.value for one in edges(scenario, key, low, high, rest)), remark
    except ScenarioError as error:
        return (), f"no linear analysis: {error.problem}"
