"""The value of a key at which a loop turns stable or unstable: the line that theory draws in a map.

Law: brackets come from a scan and are closed by bisection of the rightmost root's real part, of the loop as
it is computed where the scheme is `digital`, of the continuous loop otherwise. A rest is found once and
moved along.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..errors import UsageError
from ..scenario import Scenario, load
from .conditions import Conditions, conditions
from .equilibrium import residual_of
from .loop import Rest
from .rest import RESTS, knows_gravity, predicted_rest, rest_near, rest_of
from .rightmost import digital, rightmost
from .spectrum import Root

POINTS = 24
TOLERANCE = 1e-6
_LOGARITHMIC = 20.0
"""A range whose ends are further apart is scanned in equal steps of its logarithm."""
_STEPS = 80
_HALVED = 3
"""Every so many steps a bracket is halved, whatever its ends say."""
_INTEGERS = ("rate_hz", "seed")


class Edge(NamedTuple):
    """Where a loop changes between stable and unstable.

    Attributes:
        key: what is changed.
        value: its value there, in its own unit.
        omega_rad_s: the frequency of the root that crosses, rad/s.
        stable_above: whether it is stable above and not below; else the other way round.
    """

    key: str
    value: float
    omega_rad_s: float
    stable_above: bool


def edge(
    scenario: Scenario,
    key: str,
    low: float,
    high: float,
    rest: Rest | None = None,
    *,
    points: int = POINTS,
    sampled: bool | None = None,
) -> Edge | None:
    """Returns the lowest value of a key at which the loop changes between stable and unstable.

    Args:
        scenario: the experiment.
        key: what is changed, as in "control.d" or "link.delay_ms".
        low: the least value.
        high: the largest value.
        rest: where it rests, if that is known; it is moved to the nearest equilibrium of each value.
        points: values that are scanned.
        sampled: whether the loop as it is computed counts; None: where the scheme is `digital`.

    Returns:
        The edge; None where the scan sees none.

    Raises:
        ScenarioError: a value is none for that key, or the scenario has no linear loop.
        UsageError: the range is none.
    """
    return next(edges(scenario, key, low, high, rest, points=points, sampled=sampled), None)


def edges(
    scenario: Scenario,
    key: str,
    low: float,
    high: float,
    rest: Rest | None = None,
    *,
    points: int = POINTS,
    sampled: bool | None = None,
) -> Iterator[Edge]:
    """Yields all edges that a scan of a key sees, by rising value; see `edge`."""
    if not (np.isfinite([low, high]).all() and low < high and points >= 2):
        raise UsageError(f"{key} is scanned from a value to a larger one, not {low:g} to {high:g}")
    line = _Line(scenario, key, rest, sampled)
    before: tuple[float, float] | None = None
    for value in _scan(key, low, high, points):
        now = (float(value), line.at(float(value)))
        if before is not None and (before[1] > 0.0) != (now[1] > 0.0):
            yield line.closed(before, now)
        before = now


def _scan(key: str, low: float, high: float, points: int) -> Array:
    apart = low > 0.0 and high / low > _LOGARITHMIC
    values = np.geomspace(low, high, points) if apart else np.linspace(low, high, points)
    return np.unique(np.round(values)) if _whole(key) else values


def _whole(key: str) -> bool:
    """True for a key that takes whole numbers."""
    return key.rpartition(".")[2] in _INTEGERS


class _Line:
    """The real part of the rightmost root over the values of a key, 1/s."""

    def __init__(self, scenario: Scenario, key: str, rest: Rest | None, sampled: bool | None) -> None:
        self._scenario, self._key = scenario, key
        self._sampled = digital(scenario) if sampled is None else sampled
        self._rest = rest or _first_rest(scenario)
        self._root: Root | None = None

    def at(self, value: float) -> float:
        """Returns the real part at a value; -infinity where no root but those at zero is there."""
        scenario = load(self._scenario, {self._key: round(value) if _whole(self._key) else value})
        now = conditions(scenario)
        self._rest = _moved(scenario, now, self._rest)
        self._root = rightmost(now, self._rest, sampled=self._sampled)
        return -np.inf if self._root is None else self._root.s.real

    def closed(self, left: tuple[float, float], right: tuple[float, float]) -> Edge:
        """Returns the edge between two values on its two sides: regula falsi, halved where it stalls."""
        (low, at_low), (high, at_high) = left, right
        stable_above = at_low > 0.0
        if _whole(self._key):
            while high - low > 1.0:
                middle = float((low + high) // 2.0)
                low, high = (middle, high) if (self.at(middle) > 0.0) == (at_low > 0.0) else (low, middle)
        else:
            low, high = self._close(low, high, [at_low, at_high])
        self.at(high)
        omega = 0.0 if self._root is None else self._root.s.imag
        return Edge(self._key, 0.5 * (low + high), omega, stable_above)

    def _close(self, low: float, high: float, ends: list[float]) -> tuple[float, float]:
        """Returns a bracket made narrow: by regula falsi, with the end that stays counted half, or halved."""
        smallest = TOLERANCE * max(abs(low), abs(high))
        sign, weights = ends[0] > 0.0, ends
        for step in range(_STEPS):
            if high - low <= smallest:
                break
            middle = 0.5 * (low + high)
            if step % _HALVED and np.isfinite(weights).all():
                middle = (low * weights[1] - high * weights[0]) / (weights[1] - weights[0])
                middle = min(max(middle, low + 0.4 * smallest), high - 0.4 * smallest)
            value = self.at(middle)
            if (value > 0.0) == sign:
                low, weights = middle, [value, 0.5 * weights[1]]
            else:
                high, weights = middle, [0.5 * weights[0], value]
        return low, high


def _first_rest(scenario: Scenario) -> Rest:
    """Returns where a scenario rests; without a run of it where a pose that all share is an equilibrium."""
    return predicted_rest(scenario) if knows_gravity(conditions(scenario)) else rest_of(scenario)


def _moved(scenario: Scenario, now: Conditions, rest: Rest) -> Rest:
    """Returns the rest next to another one; the same where the key does not move it."""
    if float(np.abs(residual_of(now, rest)).max()) <= RESTS:
        return rest
    return rest_near(scenario, rest)
