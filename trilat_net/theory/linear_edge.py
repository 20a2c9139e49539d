"""Values of a scenario's key at which the linear loop changes between stable and unstable.

Invariant: a scan brackets each edge, and bisection of the rightmost root's real part closes it: of the
sampled loop for the scheme `digital`, of the continuous loop otherwise. The equilibrium is found once and
followed along the key.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..core.site_setup import Scheme
from ..core.vectors import Array
from ..errors import UsageError
from ..scenario import Scenario, load_scenario
from .characteristic_roots import CharacteristicRoot
from .delay_roots import compute_delay_spectrum
from .equilibrium import (
    MAX_EQUILIBRIUM_RESIDUAL,
    compute_equilibrium_residual,
    find_equilibrium,
    follow_equilibrium,
    holds_any_shared_pose,
    predict_equilibrium,
)
from .linear_loop import linearise_loop
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .tick_map import compute_sampled_spectrum

_NEAR = 4
"""So many continuous roots lead to the sampled ones."""


def is_digital(scenario: Scenario) -> bool:
    """True where the controllers are plain digital ones."""
    return scenario.scheme == Scheme.DIGITAL.name.lower()


def find_rightmost_root(
    now: OperatingConditions, rest: Equilibrium, *, sampled: bool
) -> CharacteristicRoot | None:
    """Returns the rightmost root; None where there is none but those at zero.

    Args:
        now: what holds.
        rest: where it is linearised.
        sampled: whether the loop as it is computed counts; at several rates the continuous one does.
    """
    continuous = compute_delay_spectrum(linearise_loop(now, rest), _NEAR if sampled else 1)
    if not sampled:
        return continuous.rightmost
    near = np.array([root.s for root in continuous.roots], dtype=np.complex128)
    return (compute_sampled_spectrum(now, rest, near, 1) or continuous).rightmost


EDGE_SCAN_POINTS = 24
EDGE_TOLERANCE = 1e-6
_LOGARITHMIC = 20.0
"""A range whose ends are further apart is scanned in equal steps of its logarithm."""
_STEPS = 80
_HALVED = 3
"""Every so many steps a bracket is halved, whatever its ends say."""
_INTEGERS = ("rate_hz", "seed")


class LinearEdge(NamedTuple):
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


def find_linear_edge(
    scenario: Scenario,
    key: str,
    low: float,
    high: float,
    rest: Equilibrium | None = None,
    *,
    points: int = EDGE_SCAN_POINTS,
    sampled: bool | None = None,
) -> LinearEdge | None:
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
    return next(iterate_linear_edges(scenario, key, low, high, rest, points=points, sampled=sampled), None)


def iterate_linear_edges(
    scenario: Scenario,
    key: str,
    low: float,
    high: float,
    rest: Equilibrium | None = None,
    *,
    points: int = EDGE_SCAN_POINTS,
    sampled: bool | None = None,
) -> Iterator[LinearEdge]:
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

    def __init__(self, scenario: Scenario, key: str, rest: Equilibrium | None, sampled: bool | None) -> None:
        self._scenario, self._key = scenario, key
        self._sampled = is_digital(scenario) if sampled is None else sampled
        self._rest = rest or _first_rest(scenario)
        self._root: CharacteristicRoot | None = None

    def at(self, value: float) -> float:
        """Returns the real part at a value; -infinity where no root but those at zero is there."""
        scenario = load_scenario(self._scenario, {self._key: round(value) if _whole(self._key) else value})
        now = derive_operating_conditions(scenario)
        self._rest = _moved(scenario, now, self._rest)
        self._root = find_rightmost_root(now, self._rest, sampled=self._sampled)
        return -np.inf if self._root is None else self._root.s.real

    def closed(self, left: tuple[float, float], right: tuple[float, float]) -> LinearEdge:
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
        return LinearEdge(self._key, 0.5 * (low + high), omega, stable_above)

    def _close(self, low: float, high: float, ends: list[float]) -> tuple[float, float]:
        """Returns a bracket made narrow: by regula falsi, with the end that stays counted half, or halved."""
        smallest = EDGE_TOLERANCE * max(abs(low), abs(high))
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


def _first_rest(scenario: Scenario) -> Equilibrium:
    """Returns where a scenario rests; without a run of it where a pose that all share is an equilibrium."""
    return (
        predict_equilibrium(scenario)
        if holds_any_shared_pose(derive_operating_conditions(scenario))
        else find_equilibrium(scenario)
    )


def _moved(scenario: Scenario, now: OperatingConditions, rest: Equilibrium) -> Equilibrium:
    """Returns the rest next to another one; the same where the key does not move it."""
    if float(np.abs(compute_equilibrium_residual(now, rest)).max()) <= MAX_EQUILIBRIUM_RESIDUAL:
        return rest
    return follow_equilibrium(scenario, rest)
