"""Values of a scenario's key at which the linear loop changes between stable and unstable.

Invariant: a scan brackets each edge, and Brent's method on the rightmost root's real part
closes it: of the sampled loop for the scheme `digital` and for sampled actors, of the
continuous loop otherwise. The equilibrium is found once and followed along the key.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from ..core.exogenous import TorqueKind
from ..core.site_setup import Law
from ..core.vectors import Array
from ..errors import ScenarioError, UsageError
from ..scenario import Scenario, load_scenario
from .characteristic_roots import CharacteristicRoot, compute_delay_spectrum
from .equilibrium import (
    choose_equilibrium,
    find_equilibrium,
    find_mean_pose,
    follow_equilibrium,
)
from .floquet import compute_sampled_spectrum
from .linear_loop import linearise_loop
from .operating_point import Equilibrium, OperatingConditions, derive_operating_conditions
from .site_dynamics import place_arm

EDGE_SCAN_POINTS = 24
EDGE_TOLERANCE = 1e-6
_LOGARITHMIC = 20.0
"""A range with a larger ratio of its ends is scanned in equal steps of the logarithm."""
_LEAST_PER_S = -1e3
"""The real part that stands for that of a loop in which nothing moves, 1/s."""
_INTEGER_KEYS = ("rate_hz", "seed")

ASSUMED_EQUILIBRIUM_REMARK = (
    "the linear analysis of a law that learns is about the mean start pose, with true estimates: the "
    "equilibrium of a run depends on its whole history"
)


def find_rightmost_root(
    conditions: OperatingConditions, rest: Equilibrium, *, sampled: bool
) -> CharacteristicRoot | None:
    """Returns the rightmost root about an equilibrium; None if there are only those at zero.

    It is of the sampled loop if asked for, and unless a law is linearised in continuous time
    alone.
    """
    spectrum = compute_sampled_spectrum(conditions, rest, 1) if sampled else None
    return (spectrum or compute_delay_spectrum(linearise_loop(conditions, rest), 1)).rightmost


def find_deepest_contact(scenario: Scenario, q: Array) -> int | None:
    """Returns which of some states, shape (K, N, n), rad, is deepest in a sampled wall; None if
    none is.
    """
    depth_m = np.full(len(q), -np.inf)
    for n, name in enumerate(scenario.names):
        site = scenario.setup(name)
        for wall in site.actors:
            if wall.kind is TorqueKind.WALL and wall.sampled:
                at = place_arm(site, q[:, n, : site.layout.joints].T).end_effector_position()
                depth_m = np.maximum(depth_m, (np.array(wall.a) - at.T) @ np.array(wall.b))
    deepest = int(depth_m.argmax())
    return deepest if depth_m[deepest] > 0.0 else None


def find_contact_growth(scenario: Scenario, q: Array, theta_hat: Array) -> float:
    """Returns how fast small motions grow in contact with sampled walls, 1/s; NaN if none is
    pressed.

    That is the real part of the sampled loop's rightmost root at the rest next to the state, of
    those given, that is deepest in a wall: angles, shape (K, N, n), rad, and estimates, shape
    (K, N, P). Chatter leaves the wall in between, and its mean may be no contact.
    """
    deepest = find_deepest_contact(scenario, q)
    if deepest is None:
        return np.nan
    try:
        # the memory of such a law is not given
        derive_operating_conditions(scenario, own_laws=False)
        rest = follow_equilibrium(
            scenario, Equilibrium(q[deepest], theta_hat[deepest], "", 0.0)
        )
        root = find_rightmost_root(derive_operating_conditions(scenario), rest, sampled=True)
    except ScenarioError:
        return np.nan
    return -np.inf if root is None else root.s.real


class LinearEdge(NamedTuple):
    """A value at which a loop changes between stable and unstable.

    Attributes:
        key: the scenario's key.
        value: its value there, in its own unit.
        omega_rad_s: the frequency of the root that crosses, rad/s.
        stable_above: True if it is stable above and unstable below.
    """

    key: str
    value: float
    omega_rad_s: float
    stable_above: bool


class EdgeScan(NamedTuple):
    """The edges along a key from `low` to `high`, by rising value."""

    key: str
    low: float
    high: float
    edges: tuple[LinearEdge, ...]


def parse_edge_range(text: str) -> tuple[str, float, float]:
    """Returns key and ends of a text such as control.d=0.1:3.

    Raises:
        UsageError: it names none.
    """
    key, _, ends = text.partition("=")
    low, colon, high = ends.partition(":")
    try:
        if not key.strip() or not colon:
            raise ValueError
        return key.strip(), float(low), float(high)
    except ValueError:
        raise UsageError(
            f"--over reads KEY=LOW:HIGH, as in control.d=0.1:3, not {text!r}"
        ) from None


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
    """Yields all edges that a scan of a key such as "control.d" finds, by rising value.

    The equilibrium `rest` is that of the scenario, if known; it is followed along the key. The
    loop is the sampled one if asked for, by default if the scheme is `digital`, or an actor in
    force is sampled.

    Raises:
        ScenarioError: a value is not valid for that key, or the scenario has no linear loop.
        UsageError: the range is empty.
    """
    if not (np.isfinite([low, high]).all() and low < high and points >= 2):
        raise UsageError(
            f"{key} is scanned from a value to a larger one, not {low:g} to {high:g}"
        )
    rate = _GrowthRate(scenario, key, rest, sampled)
    spaced = np.geomspace if low > 0.0 and high / low > _LOGARITHMIC else np.linspace
    values = spaced(low, high, points)
    before: tuple[float, float] | None = None
    for value in np.unique(np.round(values)) if rate.integer else values:
        now = (float(value), rate.at(float(value)))
        if before is not None and (before[1] > 0.0) != (now[1] > 0.0):
            yield rate.close_edge(before, now)
        before = now


class _GrowthRate:
    """The real part of the rightmost root over the values of a key, 1/s.

    Attributes:
        integer: True if the key takes whole numbers.
    """

    def __init__(
        self, scenario: Scenario, key: str, rest: Equilibrium | None, sampled: bool | None
    ) -> None:
        self.integer = key.rpartition(".")[2] in _INTEGER_KEYS
        self._scenario = scenario
        self._key = key
        self._sampled = sampled
        self._rest = rest or choose_equilibrium(scenario)
        self._root: CharacteristicRoot | None = None

    def at(self, value: float) -> float:
        """Returns the real part at a value; -infinity if there are only roots at zero."""
        scenario = load_scenario(
            self._scenario, {self._key: round(value) if self.integer else value}
        )
        conditions = derive_operating_conditions(scenario)
        self._rest = follow_equilibrium(scenario, self._rest)
        sampled = conditions.needs_sampled_loop if self._sampled is None else self._sampled
        self._root = find_rightmost_root(conditions, self._rest, sampled=sampled)
        return -np.inf if self._root is None else self._root.s.real

    def close_edge(self, left: tuple[float, float], right: tuple[float, float]) -> LinearEdge:
        (low, at_low) = left
        (high, _) = right
        if self.integer:
            while high - low > 1.0:
                middle = float((low + high) // 2.0)
                low, high = (
                    (middle, high)
                    if (self.at(middle) > 0.0) == (at_low > 0.0)
                    else (low, middle)
                )
        else:
            reach = 0.25 * EDGE_TOLERANCE * max(abs(low), abs(high))
            low = high = float(
                brentq(lambda value: max(self.at(value), _LEAST_PER_S), low, high, xtol=reach)
            )
        self.at(high)
        omega = 0.0 if self._root is None else self._root.s.imag
        return LinearEdge(self._key, 0.5 * (low + high), omega, at_low > 0.0)


class GrowthColumn(NamedTuple):
    """How fast a loop grows over the values of a key.

    Attributes:
        growth_per_s: per value the real part of the rightmost root; NaN if there is no linear
            loop, and -infinity if nothing moves.
        edges: by the place of the value below it, each value at which the loop becomes stable
            or unstable.
        remarks: what is to be known of it, each once.
    """

    growth_per_s: list[float]
    edges: dict[int, float]
    remarks: list[str]


def compute_growth_column(
    scenarios: Sequence[Scenario], key: str, values: Sequence[float]
) -> GrowthColumn:
    """Returns the growth of scenarios that differ in a key alone, by its rising values.

    The equilibrium is followed from one scenario to the next. An edge is missing where that
    next to it is none of the values in between.
    """
    rest: Equilibrium | None = None
    found = GrowthColumn([], {}, [])
    for n, scenario in enumerate(scenarios):
        try:
            rest, remark = _assume_equilibrium(scenario, rest)
            conditions = derive_operating_conditions(scenario)
            root = find_rightmost_root(conditions, rest, sampled=conditions.needs_sampled_loop)
            found.growth_per_s.append(-np.inf if root is None else root.s.real)
            before, now = found.growth_per_s[-2:] if n else [np.nan, np.nan]
            if np.isfinite([before, now]).all() and (before > 0.0) != (now > 0.0):
                with suppress(ScenarioError, ValueError):  # of both ends the same sign
                    ends = (values[n - 1], before), (values[n], now)
                    found.edges[n - 1] = (
                        _GrowthRate(scenario, key, rest, None).close_edge(*ends).value
                    )
        except ScenarioError as error:
            remark = f"no linear analysis: {error.problem}"
            found.growth_per_s.append(float("nan"))
        if remark and remark not in found.remarks:
            found.remarks.append(remark)
    return found


def find_root_crossings(
    scenario: Scenario, key: str, low: float, high: float
) -> tuple[tuple[float, ...], str]:
    """Returns the values of a key at which the rightmost root crosses the axis, rising, and a
    remark or "".

    There are no values if the scenario has no linear loop; its own value of the key gives the
    equilibrium.
    """
    try:
        rest, remark = _assume_equilibrium(scenario, None)
        return tuple(
            one.value
            for one in iterate_linear_edges(
                scenario=scenario, key=key, low=low, high=high, rest=rest
            )
        ), remark
    except ScenarioError as error:
        return (), f"no linear analysis: {error.problem}"


def _assume_equilibrium(
    scenario: Scenario, before: Equilibrium | None
) -> tuple[Equilibrium, str]:
    """Returns an equilibrium without a run if possible: at the mean start pose, or near that
    before.
    """
    sites = derive_operating_conditions(scenario).sites
    if any(site.gains.law is Law.ADAPTIVE for site in sites) and not any(
        site.actors for site in sites
    ):
        return find_equilibrium(scenario, find_mean_pose(scenario)), ASSUMED_EQUILIBRIUM_REMARK
    return choose_equilibrium(scenario) if before is None else follow_equilibrium(
        scenario, before
    ), ""
