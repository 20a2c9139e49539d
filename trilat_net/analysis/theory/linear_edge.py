"""Finds the values of a setting at which coupled arms become stable or unstable.

For example, an edge of the damping gain of a slave is the gain at which its oscillations
neither grow nor decay. The setting is a number in the scenario, named by its key. The growth
rate of small motions is the real part of the rightmost characteristic root of the linearised
control loop, and the loop is unstable if this rate is positive. The rate is evaluated for some
values of the setting. Between two values at which the rate has different signs, Brent's method
finds the zero of the rate, which is the edge.

The sampled loop, whose controllers act once per tick, is analysed if the tick matters. This is
the case for the integration scheme `digital` (zero-order hold, as in a plain digital
controller), and for walls or operators that act once per tick. Otherwise the continuous loop is
analysed.

Invariant:
    - The equilibrium about which the arms are linearised is determined once. For every further
      value of the setting, the nearest equilibrium is used, which prevents the results from
      jumping between different poses.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from ...core import Array, TorqueKind
from ...errors import ScenarioError, UsageError
from ...scenario import Scenario, load_scenario
from ..blas_threads import limit_blas_threads
from .characteristic_roots import CharacteristicRoot, Spectrum
from .equilibrium import (
    choose_equilibrium,
    find_equilibrium,
    find_mean_pose,
    follow_equilibrium,
)
from .floquet import SampledLoop
from .linear_loop import LinearLoop
from .operating_point import Equilibrium, OperatingConditions
from .site_dynamics import place_arm

EDGE_SCAN_POINTS = 24
"""Default number of values of the key that a scan evaluates."""
EDGE_TOLERANCE = 1e-6
"""Largest error of an edge, relative to the key's value."""
_LOGARITHMIC = 20.0
"""Largest ratio of the ends of a range that is scanned in equal steps.

A larger range is scanned in equal steps of the logarithm.
"""
_LEAST_PER_S = -1e3
"""Smallest growth rate in Brent's method, in 1/s.

It replaces -infinity, the growth rate if all roots are zero.
"""
_INTEGER_KEYS = ("rate_hz", "seed")

ASSUMED_EQUILIBRIUM_REMARK = (
    "for a law that learns, the linear analysis is about the mean start pose with true "
    "estimates, because the equilibrium of a run depends on its whole history"
)
MEAN_POSE_REMARK = (
    "the linear analysis is about the pose of rest nearest to the mean start pose: only a run "
    "shows where estimates, operators and walls move the arms"
)


@limit_blas_threads()
def find_rightmost_root(
    conditions: OperatingConditions,
    rest: Equilibrium,
    *,
    sampled: bool,
) -> CharacteristicRoot | None:
    """Returns the fastest growing (rightmost) root of the control loop about an equilibrium.

    The real part of this root is the growth rate of small motions. If it is negative, the
    motions decay.

    Args:
        conditions: The gains, delays and dominance factors of the loop.
        rest: The equilibrium.
        sampled: True to analyse the sampled loop. The continuous loop is analysed anyway if a
            law can only be linearised in continuous time.

    Returns:
        The root, or `None` if all roots are zero.
    """
    if sampled and not conditions.has_forms:
        return SampledLoop(conditions).compute_spectrum(rest, 1).rightmost
    return Spectrum.of_loop(LinearLoop.of_conditions(conditions, rest), 1).rightmost


def find_deepest_contact(scenario: Scenario, q: Array) -> int | None:
    """Finds the state of a run in which an end effector has penetrated a wall most deeply.

    The linear analysis then includes the stiffness of the wall. Only sampled walls, which
    compute their force once per tick, are considered.

    Args:
        scenario: The scenario.
        q: Joint angles in K states of the run, for N arms with up to n joints, shape (K, N, n),
            in rad.

    Returns:
        Index of the state, or `None` if no wall is touched.
    """
    depth_m = np.full(len(q), -np.inf)
    for site_index, name in enumerate(scenario.names):
        site = scenario.setup(name)
        joint_angles = q[:, site_index, : site.layout.joints].T
        for wall in site.actors:
            if wall.kind is TorqueKind.WALL and wall.sampled:
                tip = place_arm(site, joint_angles).end_effector_position()
                from_surface = np.array(wall.a) - tip.T
                wall_depth_m = from_surface @ np.array(wall.b)
                depth_m = np.maximum(depth_m, wall_depth_m)
    deepest_state = int(depth_m.argmax())
    return deepest_state if depth_m[deepest_state] > 0.0 else None


@limit_blas_threads()
def find_contact_growth(scenario: Scenario, q: Array, theta_hat: Array) -> float:
    """Returns the growth rate of small motions while an arm touches a wall, in 1/s.

    Only sampled walls, which compute their force once per tick, are considered. The arms are
    linearised at the equilibrium nearest to the state in which an end effector has penetrated a
    wall most deeply. The mean of all states is not suitable, because a chattering arm leaves
    the wall again and again.

    Args:
        scenario: The scenario.
        q: Joint angles in K states of the run, for N arms with up to n joints, shape (K, N, n),
            in rad.
        theta_hat: Estimates of the arms' P parameters in these states, shape (K, N, P).

    Returns:
        The growth rate, -infinity if all roots are zero, or NaN if no wall is touched or the
        scenario cannot be linearised.
    """
    deepest = find_deepest_contact(scenario, q)
    if deepest is None:
        return np.nan

    try:
        # refuses imported laws, because their memory is not among the arguments
        OperatingConditions.derive(scenario, own_laws=False)
        state = Equilibrium(q[deepest], theta_hat[deepest], "", 0.0)
        rest = follow_equilibrium(scenario, state)
        root = find_rightmost_root(OperatingConditions.derive(scenario), rest, sampled=True)
    except ScenarioError:
        return np.nan
    return -np.inf if root is None else root.s.real


class LinearEdge(NamedTuple):
    """A value of one setting at which coupled arms become stable or unstable.

    At this value a characteristic root crosses the imaginary axis, and small motions oscillate
    at the frequency of the root.

    Attributes:
        key: Key of the scenario, such as "control.d".
        value: Value of the key at the edge, in the unit of the key.
        omega_rad_s: Frequency of the root that crosses the imaginary axis, in rad/s.
        stable_above: True if the loop is stable above the value and unstable below.
    """

    key: str
    value: float
    omega_rad_s: float
    stable_above: bool


class EdgeScan(NamedTuple):
    """Values of one setting, within a range, at which coupled arms become stable or unstable.

    If there is no such value, the arms are either stable or unstable throughout the range.

    Attributes:
        key: Key of the scenario, such as "control.d".
        low: Lower end of the scanned range.
        high: Upper end of the scanned range.
        edges: The values in ascending order, with the roots that cross there. Empty until the
            range has been scanned.
    """

    key: str
    low: float
    high: float
    edges: tuple[LinearEdge, ...] = ()

    @classmethod
    def parse(cls, text: str) -> "EdgeScan":
        """Parses a setting and the range of values in which to search for a stability limit.

        Args:
            text: The string to parse, for example "control.d=0.1:3".
        """
        key, _, ends = text.partition("=")
        low, colon, high = ends.partition(":")
        try:
            if not key.strip() or not colon:
                raise ValueError
            return cls(key.strip(), float(low), float(high))
        except ValueError:
            raise UsageError(
                f"--over must have the form KEY=LOW:HIGH, as in control.d=0.1:3, not {text!r}"
            ) from None

    def scan(self, scenario: Scenario, rest: Equilibrium) -> "EdgeScan":
        """Returns a copy that contains the values at which the arms become stable or unstable.

        Args:
            scenario: The scenario.
            rest: Equilibrium of the scenario.
        """
        edges = iterate_linear_edges(scenario, self.key, self.low, self.high, rest)
        return self._replace(edges=tuple(edges))


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
    """Yields the values of one setting at which coupled arms become stable or unstable.

    The range of values is scanned, and each change of stability is then located. The values are
    in ascending order.

    Args:
        scenario: The scenario.
        key: Key of the scenario, such as "control.d".
        low: Lower end of the range.
        high: Upper end of the range.
        rest: Equilibrium of the scenario, if known. The equilibrium is tracked as the key
            varies.
        points: Number of values that the scan evaluates.
        sampled: True to analyse the loop with its ticks, False to analyse the continuous loop.
            If `None`, this is chosen as described in the docstring of the module.

    Raises:
        ScenarioError: A value is invalid for that key, or the scenario cannot be linearised.
        UsageError: The range is empty.
    """
    is_valid_range = np.isfinite([low, high]).all() and low < high and points >= 2
    if not is_valid_range:
        raise UsageError(
            f"{key} must be scanned from a lower to a higher value, "
            f"not from {low:g} to {high:g}"
        )
    growth = _GrowthRate(scenario, key, rest, sampled)
    is_logarithmic = low > 0.0 and high / low > _LOGARITHMIC
    choose_values = np.geomspace if is_logarithmic else np.linspace
    values = choose_values(low, high, points)
    if growth.takes_integers:
        values = np.unique(np.round(values))

    previous: _GrowthPoint | None = None
    for value in values.tolist():
        point = _GrowthPoint(value, growth.evaluate(value))
        if previous is not None and previous.is_unstable != point.is_unstable:
            yield growth.close_edge(previous, point)
        previous = point


class _GrowthPoint(NamedTuple):
    """Growth rate of small motions for one value of the examined setting.

    A positive rate means that the arms are not stable.

    Attributes:
        value: Value of the key.
        growth_per_s: Real part of the rightmost root, in 1/s.
    """

    value: float
    growth_per_s: float

    @property
    def is_unstable(self) -> bool:
        """True if small motions of the arms grow at this value of the setting.

        A stability limit lies between two neighbouring values if the arms are stable at one of
        them and unstable at the other.
        """
        return self.growth_per_s > 0.0


class _GrowthRate:
    """Function that computes the growth rate of small motions for a value of one setting.

    Each evaluation starts from the pose of rest of the previous one, because the pose may
    depend on the setting.

    Args:
        scenario: The experiment.
        key: Key of the scenario.
        rest: Equilibrium of the scenario. `None` to determine it.
        sampled: Whether to analyse the sampled loop, see `iterate_linear_edges`.

    Attributes:
        takes_integers: True if the values of the key are whole numbers.
    """

    def __init__(
        self,
        scenario: Scenario,
        key: str,
        rest: Equilibrium | None,
        sampled: bool | None,
    ) -> None:
        self.takes_integers = key.rpartition(".")[2] in _INTEGER_KEYS
        self._scenario = scenario
        self._key = key
        self._sampled = sampled
        self._rest = rest or choose_equilibrium(scenario)
        self._root: CharacteristicRoot | None = None

    def evaluate(self, value: float) -> float:
        """Computes the growth rate of small motions for a given value of the examined setting.

        The setting is a number in the scenario, such as a gain.

        Args:
            value: Value of the setting, in its own unit.

        Returns:
            The growth rate, in 1/s, which is negative if motions decay, and -infinity if all
            roots are zero.
        """
        typed_value = round(value) if self.takes_integers else value
        scenario = load_scenario(self._scenario, {self._key: typed_value})
        conditions = OperatingConditions.derive(scenario)
        self._rest = follow_equilibrium(scenario, self._rest)
        sampled = self._sampled
        if sampled is None:
            sampled = conditions.needs_sampled_loop
        self._root = find_rightmost_root(conditions, self._rest, sampled=sampled)
        return -np.inf if self._root is None else self._root.s.real

    def close_edge(self, left: _GrowthPoint, right: _GrowthPoint) -> LinearEdge:
        """Locates the value of a setting at which the arms become stable or unstable.

        The arms must be unstable at exactly one of the two values `left` and `right`. Integer
        settings are searched by bisection, all others with Brent's method.

        Args:
            left: The smaller value, with its growth rate.
            right: The larger value, with its growth rate.

        Returns:
            The value at which stability changes, with the frequency of the motion.

        Raises:
            ScenarioError: The scenario cannot be linearised for a value in between.
            ValueError: The arms turn out to be stable at both values, or unstable at both, when
                their stability is evaluated again.
        """
        low = left.value
        high = right.value
        if self.takes_integers:
            while high - low > 1.0:
                middle = float((low + high) // 2.0)
                if (self.evaluate(middle) > 0.0) == left.is_unstable:
                    low = middle
                else:
                    high = middle
        else:
            tolerance = 0.25 * EDGE_TOLERANCE * max(abs(low), abs(high))
            edge = brentq(self._evaluate_finite, low, high, xtol=tolerance)
            low = high = float(edge)

        self.evaluate(high)
        omega = 0.0 if self._root is None else self._root.s.imag
        return LinearEdge(self._key, 0.5 * (low + high), omega, left.is_unstable)

    def _evaluate_finite(self, value: float) -> float:
        """Returns the growth rate at a value, limited from below for Brent's method."""
        return max(self.evaluate(value), _LEAST_PER_S)


class GrowthColumn(NamedTuple):
    """Growth rate of small motions of coupled arms, for several values of one setting.

    Where the rate is positive, the arms are unstable.

    Attributes:
        growth_per_s: Growth rate for each value, in 1/s: the real part of the rightmost
            characteristic root. It is NaN if the scenario cannot be linearised, and -infinity
            if all roots are zero.
        edges: Values at which stability changes. The key n belongs to the change between the
            evaluated values with the indices n and n + 1.
        remarks: Remarks for the user on the analysis, without repetition.
        is_sampled: True if the roots were computed from Floquet multipliers of the loop with
            its ticks, False if the loops were analysed in continuous time.
    """

    growth_per_s: list[float]
    edges: dict[int, float]
    remarks: list[str]
    is_sampled: bool = False

    @classmethod
    def compute(
        cls,
        scenarios: Sequence[Scenario],
        key: str,
        values: Sequence[float],
        *,
        at_mean_pose: bool = False,
    ) -> "GrowthColumn":
        """Computes how the growth of small motions depends on one setting of a scenario.

        For each value of the setting, the coupled arms are linearised about an equilibrium,
        which is tracked from one value to the next. Wherever stability changes between
        neighbouring values, the exact value at which it changes is located.

        Args:
            scenarios: Scenarios that differ only in the setting, in ascending order of its
                value.
            key: Name of the setting, such as "control.d".
            values: Values of the setting, one per scenario.
            at_mean_pose: True to linearise each scenario about the equilibrium nearest to the
                mean of its start poses, with correct estimates. No run is simulated in this
                case.

        Returns:
            The growth rates, and the values at which stability changes. A value at which
            stability changes is left out if the search for it fails, for example because the
            setting does not permit the intermediate values.
        """
        rest: Equilibrium | None = None
        column = GrowthColumn([], {}, [])
        for n, scenario in enumerate(scenarios):
            try:
                if at_mean_pose:
                    rest, remark = _find_mean_equilibrium(scenario)
                else:
                    rest, remark = _assume_equilibrium(scenario, rest)
                conditions = OperatingConditions.derive(scenario)
                is_sampled = conditions.needs_sampled_loop and not conditions.has_forms
                column = column._replace(is_sampled=column.is_sampled or is_sampled)
                root = find_rightmost_root(conditions, rest, sampled=is_sampled)
                column.growth_per_s.append(-np.inf if root is None else root.s.real)
                if n > 0:
                    left = _GrowthPoint(values[n - 1], column.growth_per_s[-2])
                    right = _GrowthPoint(values[n], column.growth_per_s[-1])
                    is_finite = np.isfinite([left.growth_per_s, right.growth_per_s]).all()
                    if is_finite and left.is_unstable != right.is_unstable:
                        # evaluated again from one equilibrium, both ends may have the same sign
                        with suppress(ScenarioError, ValueError):
                            edge = _GrowthRate(scenario, key, rest, None).close_edge(
                                left, right
                            )
                            column.edges[n - 1] = edge.value
            except ScenarioError as error:
                remark = f"no linear analysis: {error.problem}"
                column.growth_per_s.append(float("nan"))
            if remark and remark not in column.remarks:
                column.remarks.append(remark)

        return column

    @staticmethod
    def find_crossings(
        scenario: Scenario,
        key: str,
        low: float,
        high: float,
    ) -> tuple[tuple[float, ...], str]:
        """Finds the values of one setting at which coupled arms become stable or unstable.

        An example is the smallest damping gain with which the arms are stable.

        Args:
            scenario: The scenario. The equilibrium is determined for the value that the setting
                has in this scenario.
            key: Name of the setting, such as "control.d".
            low: Smallest value to examine.
            high: Largest value to examine.

        Returns:
            The values at which stability changes, in ascending order. Empty if the scenario
            cannot be linearised.
            A remark for the user on the analysis. Empty if there is none.
        """
        try:
            rest, remark = _assume_equilibrium(scenario, None)
            edges = iterate_linear_edges(scenario, key, low=low, high=high, rest=rest)
            return tuple(edge.value for edge in edges), remark
        except ScenarioError as error:
            return (), f"no linear analysis: {error.problem}"


def _assume_equilibrium(
    scenario: Scenario, previous: Equilibrium | None
) -> tuple[Equilibrium, str]:
    """Returns an equilibrium of a scenario, without a simulation if possible.

    Adaptive sites without operators and environments have the mean start pose as their
    equilibrium. Otherwise the equilibrium nearest to the previous one is found.

    Args:
        scenario: The experiment.
        previous: Equilibrium of a similar scenario, or `None`.

    Returns:
        The equilibrium.
        A remark on the assumption. Empty if none was made.
    """
    sites = OperatingConditions.derive(scenario).sites
    is_adaptive = any(site.gains.is_adaptive for site in sites)
    has_actors = any(site.actors for site in sites)
    if is_adaptive and not has_actors:
        rest = find_equilibrium(scenario, find_mean_pose(scenario))
        return rest, ASSUMED_EQUILIBRIUM_REMARK
    if previous is None:
        return choose_equilibrium(scenario), ""
    return follow_equilibrium(scenario, previous), ""


def _find_mean_equilibrium(scenario: Scenario) -> tuple[Equilibrium, str]:
    """Returns the pose of rest that is nearest to the mean of the arms' start poses.

    Args:
        scenario: The experiment.

    Returns:
        The equilibrium.
        A remark on the assumption. Empty if the pose of rest depends on the arms alone.
    """
    mean = find_equilibrium(scenario, find_mean_pose(scenario))
    rest = follow_equilibrium(scenario, mean)
    sites = OperatingConditions.derive(scenario).sites
    is_moved = any(site.gains.is_adaptive or site.actors for site in sites)
    return rest, MEAN_POSE_REMARK if is_moved else ""
