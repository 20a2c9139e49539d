"""Builds a stability map, which shows for which parameters a scenario is stable.

The map presents the results of a sweep. Its axes x and y are the first two numeric parameters,
and each combination of the other parameters and the control law gets its own panel. Each grid
point of a panel shows how many of its runs were stable. A column is the set of grid points with
the same x.

Theoretical limits are drawn as lines for comparison with the runs:

- The closed-form line is where a closed-form stability criterion is only just met. It is used
  only if all assumptions of the criterion hold. For the proportional law with damping, P+d, the
  line accounts for sampling.
- The linear line is where the rightmost characteristic root of the linearised loop crosses the
  imaginary axis. It accounts for sampling only with the integration scheme `digital`.

Invariant:
    - The measurements come only from the results, and the lines only from the plan.
    - Every run is counted at exactly one grid point. A grid point is stable if the majority of
      its decided runs is. A tie leaves the point undecided.
    - A measured edge lies between two decided grid points of a column, one of them stable and
      the other not. Undecided grid points between the two make the edge wider.
    - A line crosses a column between two neighbouring grid points if exactly one of them is
      stable according to theory.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilat_net.analysis import GrowthColumn, build_arm_rows
from trilat_net.core import Array, DominanceMatrix
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.laws import COMMON_MOTION_SHARE
from trilat_net.scenario import (
    LinkBase,
    Scenario,
    is_number,
)
from trilat_net.work import Progress, WorkerPool, Workers

from ..run_commands import format_override_value
from .fixed_gains import describe_fixed_gains
from .sweep_axis import label_axis, label_setting
from .sweep_cell import RUN_CLASSES, CellClass
from .sweep_plan import SweepPlan
from .sweep_results import SweepResults

RunCounts = NDArray[np.int64]
PanelSettings = tuple[tuple[str, Any], ...]
"""Values of the axes that are not drawn, as pairs of a key and a value."""

CELL_CLASSES = RUN_CLASSES
"""Classes of a run, in the order of the last dimension of `MapPanel.counts`."""
MAX_PANELS = 12
"""Largest number of panels of a map at which they remain legible."""


class PlaneAxis(NamedTuple):
    """One axis of a stability map: a scenario key, such as a delay, and its swept values.

    Attributes:
        key: Scenario key that varies along the axis, such as "link.delay_ms". Empty for the
            vertical axis of a map with a single numeric axis.
        values: Values of the key in ascending order, in the unit of the key.
        label: Axis label, with the unit.
    """

    key: str
    values: tuple[float, ...]
    label: str

    @property
    def is_evenly_spaced(self) -> bool:
        """True if the values on the axis are equally spaced, up to rounding.

        Also true for fewer than three values.
        """
        steps = np.diff(self.values)
        if len(steps) < 2:
            return True
        tolerance = 1e-6 * np.abs(steps).max()
        return bool(np.ptp(steps) <= tolerance)

    @property
    def positions(self) -> Array:
        """Positions along the axis at which the K swept values are drawn, shape (K,).

        Equally spaced values are drawn to scale. Other values, such as 1, 10, 100, are drawn at
        equal distances, at their indices.
        """
        if self.is_evenly_spaced:
            return np.array(self.values)
        return np.arange(len(self.values), dtype=np.float64)

    def compute_borders(self) -> Array:
        """Returns the borders of the cells along the axis, halfway between the swept values.

        If no value is negative, no border is negative either, because a delay of -100 ms, for
        example, does not exist.

        Returns:
            Positions, shape (n + 1,) for n values.
        """
        positions = self.positions
        first = positions[0]
        if len(positions) == 1:
            return np.array([first - 0.5, first + 0.5])
        outer = positions[[0, -1]]
        inner = positions[[1, -2]]
        ends = 1.5 * outer - 0.5 * inner
        middles = 0.5 * (positions[1:] + positions[:-1])
        borders: Array = np.concatenate([ends[:1], middles, ends[1:]])
        if self.is_evenly_spaced and first >= 0.0:
            return np.maximum(borders, 0.0)
        return borders

    def refine_columns(self) -> "_FineColumns":
        """Returns x values for theoretical lines, spaced more closely than the map's columns.

        The intervals between the columns are subdivided unless there are already many columns.
        If the values are equally spaced, additional values outside the outermost columns extend
        the lines to the borders of the map.
        """
        values = np.array(self.values)
        positions = self.positions
        intervals = len(values) - 1
        steps_per_interval = max(1, round(_FINE_COLUMNS / max(intervals, 1)))
        if intervals < 1 or steps_per_interval == 1:
            return _keep_columns(self)

        indices = np.arange(intervals * steps_per_interval + 1) / steps_per_interval
        fine_values = np.interp(indices, np.arange(len(values)), values)
        fine_positions = np.interp(indices, np.arange(len(values)), positions)

        # Interpolation would round the values of the grid.
        fine_values[::steps_per_interval] = values
        on_grid = np.arange(len(values)) * steps_per_interval

        # The first and last cells extend beyond their values, and so do the lines.
        if self.is_evenly_spaced:
            borders = self.compute_borders()
            # The borders are half a cell away.
            half_cell_steps = max(1, steps_per_interval // 2)
            left_of_map = np.linspace(borders[0], values[0], half_cell_steps, endpoint=False)
            right_of_map = np.linspace(borders[-1], values[-1], half_cell_steps, endpoint=False)
            right_of_map = right_of_map[::-1]
            left_of_map = left_of_map[left_of_map < values[0]]
            fine_values = np.concatenate([left_of_map, fine_values, right_of_map])
            fine_positions = np.concatenate([left_of_map, fine_positions, right_of_map])
            on_grid = on_grid + len(left_of_map)

        return _FineColumns(
            tuple(fine_values.tolist()), tuple(fine_positions.tolist()), tuple(on_grid.tolist())
        )

    def thin_out(self, halvings: int) -> "PlaneAxis":
        """Returns the axis values in the coarse grid with which a refined sweep begins.

        Args:
            halvings: Number of halvings of the refined sweep. If 0, the whole axis is returned.
        """
        stride = 2**halvings
        last = len(self.values) - 1
        # the last value is kept even if no whole number of strides leads to it
        indices = [*range(0, last, stride), last]
        return self._replace(values=tuple(self.values[n] for n in indices))


class MapPanel(NamedTuple):
    """One panel of a stability map: a grid of runs over the two drawn axes.

    Any further swept keys have the same values for all runs of a panel.

    Attributes:
        title: The values of these keys as a string, such as "p d, delay 200 ms". Empty if there
            are no such keys.
        settings: The same as pairs of a key and a value. The key of a swept law is "law".
        counts: Number of runs for each grid point and class, shape (y, x, 4). The classes are
            in the order of `CELL_CLASSES`.
        exponents_per_s: Growth exponent of each grid point (the rate at which a small
            disturbance grows), averaged over its seeds, in 1/s, shape (y, x). NaN if it was not
            measured.
        simulated: Stability edges measured in another, simulated sweep, as pairs of a value of
            x and an interval of y.
    """

    title: str
    settings: PanelSettings
    counts: RunCounts
    exponents_per_s: Array
    simulated: tuple[tuple[float, "StabilityEdge"], ...] = ()

    @property
    def runs(self) -> RunCounts:
        """Number of runs at each grid point, decided or not, shape (y, x).

        The runs at a grid point differ in their random seeds.
        """
        total: RunCounts = self.counts.sum(axis=2)
        return total

    @property
    def stable(self) -> RunCounts:
        """Number of runs at each grid point that were judged stable, shape (y, x)."""
        is_stable = [verdict.stable is True for verdict in CELL_CLASSES]
        stable: RunCounts = self.counts[:, :, is_stable].sum(axis=2)
        return stable

    @property
    def decided(self) -> RunCounts:
        """Number of runs at each grid point that are stable or not stable, shape (y, x).

        All other runs are undecided, for example because they were too short.
        """
        class_index = CELL_CLASSES.index(CellClass.UNDECIDED)
        undecided = self.counts[:, :, class_index]
        return self.runs - undecided

    @property
    def share(self) -> Array:
        """Fraction of decided runs that are stable, at each grid point, shape (y, x).

        NaN if all runs of a grid point are undecided.
        """
        stable = self.stable
        decided = self.decided
        share: Array = np.full(decided.shape, np.nan)
        np.divide(stable, decided, out=share, where=decided > 0)
        return share

    def fill_gaps(self) -> "MapPanel":
        """Fills in the grid points that a refined sweep did not run, for drawing the map.

        Such a point gets the class of the nearest point that was run. Growth exponents are
        interpolated linearly between grid points that have one.
        """
        from scipy.interpolate import griddata
        from scipy.ndimage import distance_transform_edt

        def find_nearest(is_missing: Any) -> Any:
            """Returns, for each grid point, the indices of the nearest point with a result."""
            return distance_transform_edt(
                is_missing, return_distances=False, return_indices=True
            )

        if not self.runs.any():
            return self
        rows, columns = find_nearest(self.runs == 0)
        exponents_per_s = self.exponents_per_s
        if np.isfinite(exponents_per_s).any():
            known_points = np.argwhere(np.isfinite(exponents_per_s))
            all_points = np.indices(exponents_per_s.shape).reshape(2, -1).T
            nearest = find_nearest(np.isnan(exponents_per_s))
            filled = exponents_per_s[tuple(nearest)]
            # Points on one line span no area in which to interpolate.
            has_area = min(np.ptp(known_points, axis=0)) > 0
            if has_area:
                values = exponents_per_s[tuple(known_points.T)]
                interpolated = griddata(known_points, values, all_points).reshape(
                    exponents_per_s.shape
                )
                filled = np.where(np.isfinite(interpolated), interpolated, filled)
            exponents_per_s = filled
        return self._replace(counts=self.counts[rows, columns], exponents_per_s=exponents_per_s)

    def make_loader(self, plan: SweepPlan, x: str, y: str) -> "PanelLoader":
        """Returns a function that loads the scenario at any point of the panel.

        Theoretical lines need scenarios between the grid points of the sweep as well. The
        function can be pickled and called in other processes.

        Args:
            plan: The sweep.
            x: Scenario key of the horizontal axis.
            y: Scenario key of the vertical axis.

        Returns:
            A function that takes the values of x and y and returns the scenario.
        """
        settings = dict(self.settings)
        only_law = next(iter(plan.laws), "")
        law = settings.pop(LAW_AXIS, only_law)
        overrides = [*plan.laws.get(law, ())]
        overrides += [
            f"{key}={format_override_value(value)}" for key, value in settings.items()
        ]
        return partial(_load_grid_scenario, plan, tuple(overrides), x, y)


class MapPlane(NamedTuple):
    """Simulation results of a stability map: panels over the same two parameters.

    If only one swept parameter is numeric, the vertical axis y has an empty key and a single
    value.

    Attributes:
        scenario: Name of the swept scenario.
        x: Horizontal axis.
        y: Vertical axis.
        panels: One panel per setting of the axes that are not drawn.
        halvings: Number of halvings of a sweep that ran only the grid points along the
            stability edge. 0 if all grid points have runs.
        is_linear: True if the exponents are roots of the linearised loop and nothing was
            simulated.
        refused: Number of grid points that are not valid scenarios. They have no runs.
    """

    scenario: str
    x: PlaneAxis
    y: PlaneAxis
    panels: tuple[MapPanel, ...]
    halvings: int = 0
    is_linear: bool = False
    refused: int = 0

    @property
    def has_exponents(self) -> bool:
        """True if the map shows how fast disturbances grow, rather than how each run ended.

        The growth exponent, in 1/s, is the rate at which a small disturbance grows. It is
        measured by repeating a run with a small push, or is a root of the linearised loop.
        """
        return any(np.isfinite(panel.exponents_per_s).any() for panel in self.panels)

    @property
    def seeds(self) -> int:
        """Largest number of runs at any grid point. 1 if the sweep has a single seed."""
        return max(int(panel.runs.max()) for panel in self.panels)

    def find_edges(self, panel: MapPanel) -> "list[tuple[float, StabilityEdge]]":
        """Finds the measured stability edges along the vertical axis of a panel.

        In each column, an edge lies between two consecutive grid points if the majority of the
        runs is stable at one of them and not stable at the other. Grid points with no majority
        are skipped.

        Args:
            panel: Panel of the map with the counts of stable runs at each grid point.

        Returns:
            Pairs of the x value of a column and an interval of y that contains an edge. The
            edges of a column are in ascending order.
        """
        edges = []
        y = self.y.values
        for x, stable_share in zip(self.x.values, panel.share.T, strict=True):
            is_decided = np.isfinite(stable_share) & (stable_share != 0.5)
            decided = np.flatnonzero(is_decided)
            is_stable = stable_share[decided] > 0.5

            # Compare each decided grid point with the next decided one.
            is_change = is_stable[1:] != is_stable[:-1]
            for position in np.flatnonzero(is_change):
                lower_index, upper_index = decided[position : position + 2].tolist()
                # The edge is sharp if no undecided grid point lies between.
                edge = StabilityEdge(
                    low=y[lower_index],
                    high=y[upper_index],
                    stable_below=bool(is_stable[position]),
                    sharp=upper_index == lower_index + 1,
                )
                edges.append((x, edge))
        return edges

    @classmethod
    def arrange_rows(
        cls,
        rows: Sequence[Mapping[str, Any]],
        axes: Sequence[str],
        scenario: Scenario,
        grid: Mapping[str, Sequence[Any]] | None = None,
    ) -> "MapPlane":
        """Arranges the runs of a sweep for a map over two of the swept parameters.

        The first two swept keys with numeric values become the axes. Each combination of the
        other keys gets its own panel. Rows are read one by one, so they need not fit into
        memory.

        Args:
            rows: One mapping per run, with a value for each swept key and the result of the run
                under the key "verdict", such as "converged". It may also contain the rate at
                which a disturbance grows, under "exponent_per_s".
            axes: The swept keys, in the order of the sweep. The key "law" stands for the
                control law, if several laws were swept.
            scenario: The swept scenario, used for labels.
            grid: All values of each swept key. If `None`, they are collected from the rows.

        Returns:
            The axes and the panels.

        Raises:
            UsageError: There are no runs, no key is numeric, or there would be more than
                `MAX_PANELS` panels.
        """
        if not rows:
            raise UsageError("no cell has run: there is nothing to draw")
        if grid is None:
            grid = {key: list(dict.fromkeys(row[key] for row in rows)) for key in axes}
        numeric_keys = [key for key in axes if all(map(is_number, grid[key]))]
        drawn_keys = numeric_keys[:2]
        if not drawn_keys:
            raise UsageError(
                "a map needs a numeric axis, but these axes have values that are not numbers: "
                f"{', '.join(axes)}"
            )

        plane_axes = []
        for key in drawn_keys:
            axis_values = tuple(sorted(grid[key]))
            label = label_axis(key, scenario)
            plane_axes.append(PlaneAxis(key, axis_values, label))
        if len(plane_axes) == 1:
            no_axis = PlaneAxis("", (0.0,), "")
            plane_axes.append(no_axis)
        x, y = plane_axes

        other_keys = [key for key in axes if key not in drawn_keys]
        panel_keys = [key for key in other_keys if len(grid[key]) > 1]
        runs_of_panel: dict[PanelSettings, _PanelRuns] = {}
        refused = 0
        for row in rows:
            settings = tuple((key, row[key]) for key in panel_keys)
            if settings not in runs_of_panel and len(runs_of_panel) == MAX_PANELS:
                count = math.prod(len(grid[key]) for key in panel_keys)
                raise UsageError(
                    f"a map has at most {MAX_PANELS} panels, but {', '.join(panel_keys)} would "
                    f"give {count}: sweep fewer values of the axes that are not drawn"
                )
            if settings not in runs_of_panel:
                runs_of_panel[settings] = _PanelRuns(x, y)
            if row["verdict"] == CellClass.REFUSED:
                refused += 1
            else:
                runs_of_panel[settings].add(row)

        panels = []
        for settings, runs in runs_of_panel.items():
            title = _format_panel_title(settings, scenario)
            panels.append(MapPanel(title, settings, runs.counts, runs.compute_exponents()))
        return cls(scenario.name, x, y, tuple(panels), refused=refused)


class _PanelRuns:
    """Counts the runs of one panel of a map by grid point and by class.

    The growth exponents of each grid point are averaged.

    Args:
        x: Horizontal axis.
        y: Vertical axis. Its key is empty if only one axis is drawn.

    Attributes:
        counts: See `MapPanel`.
    """

    def __init__(self, x: PlaneAxis, y: PlaneAxis) -> None:
        self._x_key = x.key
        self._y_key = y.key
        self._column_of_x = {value: column for column, value in enumerate(x.values)}
        self._row_of_y = {value: row for row, value in enumerate(y.values)}
        shape = (len(y.values), len(x.values))
        self._sums_per_s: Array = np.zeros(shape)
        self.counts: RunCounts = np.zeros((*shape, len(CELL_CLASSES)), dtype=np.int64)

    def add(self, run: Mapping[str, Any]) -> None:
        """Counts a finished run at its grid point of the map.

        Args:
            run: A row for `MapPlane.arrange_rows`.
        """
        row = self._row_of_y[run[self._y_key]] if self._y_key else 0
        column = self._column_of_x[run[self._x_key]]
        run_class = _CLASS_INDEX[run["verdict"]]
        self.counts[row, column, run_class] += 1
        exponent = run.get("exponent_per_s")
        # A run without an exponent makes the mean of its grid point NaN.
        self._sums_per_s[row, column] += np.nan if exponent is None else exponent

    def compute_exponents(self) -> Array:
        """Returns the mean growth rate of small disturbances at each grid point, in 1/s.

        Negative rates mean that disturbances decay, see `MapPanel`.
        """
        runs = self.counts.sum(axis=2)
        exponents_per_s: Array = self._sums_per_s / np.maximum(runs, 1)
        exponents_per_s[runs == 0] = np.nan
        return exponents_per_s


_CLASS_INDEX = {verdict.value: index for index, verdict in enumerate(CELL_CLASSES)}


def _format_panel_title(settings: PanelSettings, scenario: Scenario) -> str:
    """Returns the title of a panel of the stability map, such as "p d, delay 200 ms".

    Numbers are shown with the name and unit of their key. Other values are shown on their own,
    with underscores replaced by spaces except in the name of a law.
    """
    texts = []
    for key, value in settings:
        if not isinstance(value, str):
            texts.append(label_setting(key, value, scenario))
        elif key == "law":
            texts.append(value)
        else:
            texts.append(value.replace("_", " "))
    return ", ".join(texts)


class StabilityEdge(NamedTuple):
    """An edge between stable and unstable values of a parameter, located up to an interval.

    Attributes:
        low: Largest decided value below the edge.
        high: Smallest decided value above the edge.
        stable_below: True if the values below the edge are stable, False if those above it are.
        sharp: True if there is no undecided value between `low` and `high`.
    """

    low: float
    high: float
    stable_below: bool
    sharp: bool = True

    @property
    def middle(self) -> float:
        """Midpoint of the interval that contains the edge, in the unit of the parameter."""
        return 0.5 * (self.low + self.high)


_ROUNDING = 1e-6
"""Tolerance for rounding errors, both for delays in ticks and for relative positions of edges.
"""


class StabilityCriterion(NamedTuple):
    """A closed-form stability condition, evaluated for one scenario.

    The condition is a theoretical inequality between scenario parameters, such as a gain and a
    delay.

    Attributes:
        symbol: Equation of the limit of the condition, in TeX, for the legend of a figure.
        text: The same equation as plain text.
        source: Origin of the condition, and whether it is necessary or sufficient.
        excess: Difference between the two sides of the inequality, in their unit. Positive if
            the condition is met.
    """

    symbol: str
    text: str
    source: str
    excess: float

    @classmethod
    def evaluate(cls, scenario: Scenario) -> "StabilityCriterion | None":
        """Evaluates the closed-form stability condition that applies to a scenario.

        For example, identical arms under the law P+d are stable if the damping exceeds a
        certain multiple of the stiffness times the delay. A map shows the points at which the
        condition is only just met, alongside the measured edge.

        Args:
            scenario: The scenario to which the condition is applied.

        Returns:
            The condition, or `None` if the scenario violates an assumption of every known
            condition. This is the case if, for example, a parameter changes during the run, or
            a site stops following a peer whose samples are too old.
        """
        stops_following = any(spec.on_stale.action != "use" for spec in scenario.sites.values())
        if scenario.timeline or stops_following:
            return None
        if any(arm.shares_pose for arm in scenario.arms.values()):
            return None

        criterion = _evaluate_damping_criterion(scenario)
        if criterion is not None:
            return criterion
        if any(arm.chain is not None for arm in scenario.arms.values()):
            return None  # the other criterion holds only for the planar arm with two joints
        return _evaluate_sampling_criterion(scenario)

    @staticmethod
    def find_edge(
        criterion: "Callable[[float], StabilityCriterion | None]", low: float, high: float
    ) -> float | None:
        """Finds the parameter value at which a stability condition is only just met.

        The value is located with Brent's method.

        Args:
            criterion: Evaluates the criterion at a value. May raise ScenarioError for a value
                that is not valid, such as a fraction where an integer is needed.
            low: Lower end of the searched interval.
            high: Upper end of the searched interval.

        Returns:
            The value, or `None` if the criterion has the same sign at both ends or does not
            apply at a value between them.
        """
        # imported late: SciPy costs half a second, and most commands do not need it
        from scipy.optimize import brentq

        def excess(value: float) -> float:
            """Returns the margin of the condition at a value, negative if it is violated."""
            evaluated = criterion(value)
            if evaluated is None:
                raise ScenarioError("no criterion covers it")
            return evaluated.excess

        tolerance = 1e-8 * (high - low)
        try:
            met_at_low = excess(low) > 0.0
            met_at_high = excess(high) > 0.0
            if met_at_low == met_at_high:
                return None
            edge = brentq(excess, low, high, xtol=tolerance, maxiter=_MAX_ROOT_STEPS)
            return float(edge)
        except ScenarioError:
            return None


def _evaluate_damping_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Evaluates the condition on the damping of the law P+d, which has gains K and d.

    For two sites with delays T1 and T2, the loop is stable if

        4 d1 d2 > (T1 + T2)^2 K1 K2.

    For N identical sites with delay T and a reversible matrix alpha of dominance factors, whose
    smallest eigenvalue is lambda_min, the loop is stable if

        d > max(abs(lambda_min), 0.2172) K T.

    Under these conditions, the loop has no root on the unit circle for any mass above d h,
    where h is the period of a tick. No damping stabilises lighter arms at this tick rate
    (docs/theory/damping-conditions.md, 13).

    Returns:
        The condition, or `None` if it does not cover the scenario.
    """
    if scenario.scheme != "second_order":
        return None
    delays_s = _list_delays_s(scenario)
    rates_hz = {spec.rate_hz for spec in scenario.sites.values()}
    if delays_s is None or len(rates_hz) > 1:
        return None
    rate_hz = rates_hz.pop()
    K = []
    d = []
    for spec in scenario.sites.values():
        # The criteria do not cover different gains, because the arm couples its joints.
        gains = spec.control.find_uniform_spring()
        if gains is None:
            return None
        K.append(gains[0])
        d.append(gains[1])
    arms = [build_arm_rows(scenario, site) for site in scenario.names]
    least_inertia = min(arm.least_inertia_kg_m2 for arm in arms)
    if max(d) / rate_hz >= least_inertia:
        return None  # an arm is lighter than d h

    delays_ticks = []
    for delay_s in delays_s:
        delay_ticks = math.ceil(delay_s * rate_hz - _ROUNDING)
        delays_ticks.append(max(1, delay_ticks))  # used at the next tick at the earliest
    if len(K) == 2:
        mean_delay_ticks = 0.5 * sum(delays_ticks)
        pair_excess = _compute_pair_excess(K, d, mean_delay_ticks, rate_hz)
        return StabilityCriterion(
            symbol=r"$4\,d_1 d_2 = (T_1 + T_2)^2 K_1 K_2$",
            text="4 d1 d2 = (T1 + T2)² K1 K2",
            source=_DAMPING_SOURCE,
            excess=pair_excess,
        )

    are_equal = len({*K}) == len({*d}) == len({*delays_ticks}) == 1
    least_eigenvalue = DominanceMatrix(scenario.alpha).find_least_eigenvalue()
    if not are_equal or least_eigenvalue is None:
        return None
    common_delay_ticks = delays_ticks[0]
    ratio = _compute_required_ratio(least_eigenvalue, common_delay_ticks)
    required_d = K[0] * ratio * common_delay_ticks / rate_hz
    excess = d[0] - required_d
    if -least_eigenvalue < COMMON_MOTION_SHARE:
        return StabilityCriterion(
            symbol=r"$d = 0.2172\,K\,T$",
            text="d = 0.2172 K T",
            source=_DAMPING_SOURCE,
            excess=excess,
        )
    return StabilityCriterion(
        symbol=r"$d = |\lambda_{\min}(\alpha)|\,K\,T$",
        text="d = abs(lambda_min(alpha)) K T",
        source=_DAMPING_SOURCE,
        excess=excess,
    )


_DAMPING_SOURCE = "P+d: sufficient for arms of any mass, and necessary for the worst masses"


_CIRCLE_POINTS = 400
"""Number of points in each of the two parts of the sampled half circle."""


def _sample_unit_circle(delay_ticks: float) -> tuple[Array, Array, Array]:
    """Returns the frequencies at which the stability criteria of P+d are evaluated.

    The loop is sampled with the tick period h. At its stability limit, a root lies at z = exp(i
    phi) on the unit circle, where phi = w h for the frequency w. For the integration scheme
    "second_order", the equation of such a root contains two functions of t = tan(phi/2)
    (docs/theory/damping-conditions.md, 13):

    - the discrete frequency v = 2 t, in units of 1/h, which equals phi for small phi;
    - the lag 2 t^3 / (1 + 3 t^2), by which the scheme reduces the damping.

    The criteria take an extreme value over all phi, so the angles need not be sorted. The first
    angle approximates the limit phi -> 0. A dense set of angles covers the first turn of the
    delay, where phi * `delay_ticks` goes from 0 to 2 pi. The remaining angles lie between 0 and
    pi.

    Args:
        delay_ticks: Delay of the loop, in ticks.

    Returns:
        The angles phi in rad, the discrete frequencies v, and the lags, all of the same shape.
    """
    almost_zero = 1e-7 / delay_ticks
    first_turn_end = min(2.0 * np.pi / delay_ticks, 3.0)  # below pi, where t is infinite
    first_turn = np.linspace(0.0, first_turn_end, _CIRCLE_POINTS)[1:]
    half_circle = np.linspace(0.0, np.pi, _CIRCLE_POINTS)[1:-1]
    phi = np.concatenate([[almost_zero], first_turn, half_circle])
    t = np.tan(0.5 * phi)
    denominator = 1.0 + 3.0 * t**2
    lag = 2.0 * t**3 / denominator
    discrete_frequency = 2.0 * t
    return phi, discrete_frequency, lag


def _compute_required_ratio(least_eigenvalue: float, delay_ticks: int) -> float:
    """Returns the damping that identical sites with the law P+d need, relative to K T.

    K is the stiffness, d the damping, and T = n h the delay, where h is the tick period. Let a
    be a number between the smallest eigenvalue of the matrix of dominance factors and its
    largest eigenvalue, 1. A root on the unit circle at the angle phi, with the discrete
    frequency v and the lag of `_sample_unit_circle`, requires
    (docs/theory/damping-conditions.md, 13):

        d / (K T) = (lag (1 - a cos(n phi)) - a sin(n phi)) / (v n)

    If d / (K T) exceeds the largest value of the right-hand side, there is no such root, and
    the loop is stable. Since the right-hand side is linear in a, only the two extreme values of
    a matter.

    Args:
        least_eigenvalue: Smallest eigenvalue of the matrix of dominance factors, which must be
            reversible.
        delay_ticks: Delay n, in ticks.

    Returns:
        The largest value of the right-hand side, dimensionless.
    """
    phi, discrete_frequency, lag = _sample_unit_circle(delay_ticks)
    cosine = np.cos(delay_ticks * phi)
    sine = np.sin(delay_ticks * phi)
    ratios = []
    for eigenvalue in (least_eigenvalue, 1.0):
        lag_part = lag * (1.0 - eigenvalue * cosine)
        numerator = lag_part - eigenvalue * sine
        ratio = numerator / (discrete_frequency * delay_ticks)
        ratios.append(ratio)
    return float(np.max(ratios))


def _compute_pair_excess(
    K: list[float], d: list[float], mean_delay_ticks: float, rate_hz: float
) -> float:
    """Returns the margin of two P+d sites' damping over the required damping, in N m s/rad.

    In continuous time, the loop is stable if 2 sqrt(d1 d2) > (T1 + T2) sqrt(K1 K2), with
    stiffnesses K, dampings d and delays T. In the sampled loop, two quantities depend on the
    frequency (docs/theory/damping-conditions.md, 13). With the angle phi, the discrete
    frequency v in 1/s, the lag of `_sample_unit_circle` and a mean delay of n ticks, they are:

        effective damping of a site = d - K lag / v, at least 0
        effective mean delay = abs(sin(n phi) + lag cos(n phi)) / v

    The difference between the two sides of the condition is computed with these quantities, and
    its minimum over all frequencies is returned. For phi -> 0, the effective quantities are d
    and (T1 + T2) / 2.

    Args:
        K: Stiffnesses of the two sites, in N m/rad.
        d: Dampings of the two sites, in N m s/rad.
        mean_delay_ticks: The mean delay n, half of T1 + T2, in ticks.
        rate_hz: Tick rate of both sites.

    Returns:
        The minimum difference. Positive if the loop is stable.
    """
    phi, discrete_frequency, lag = _sample_unit_circle(mean_delay_ticks)
    frequency_per_s = discrete_frequency * rate_hz
    K_1, K_2 = K
    d_1, d_2 = d
    damping_1 = np.maximum(d_1 - K_1 * lag / frequency_per_s, 0.0)
    damping_2 = np.maximum(d_2 - K_2 * lag / frequency_per_s, 0.0)

    delay_angle = mean_delay_ticks * phi
    coupling = np.sin(delay_angle) + lag * np.cos(delay_angle)
    mean_delay_s = np.abs(coupling) / frequency_per_s

    mean_stiffness = math.sqrt(K_1 * K_2)
    half_excess = np.sqrt(damping_1 * damping_2) - mean_stiffness * mean_delay_s
    return float(2.0 * np.min(half_excess))  # doubled, because the delay is the mean of two


def _evaluate_sampling_criterion(scenario: Scenario) -> StabilityCriterion | None:
    """Evaluates the condition on the tick period of the adaptive law.

    The adaptive law estimates the parameters of its arm while it runs, with the adaptation gain
    Gamma. If gravity is estimated too fast for the tick rate, the arm keeps swinging. The arms
    come to rest if, for each site, approximately

        Gamma g^2 h < Kp,

    where g is the gravitational acceleration, h the period of a tick and Kp the damping gain of
    the law, see `Adaptive.find_sampling_excess`. The rule holds for the integration scheme
    `digital`, and for delays of at most one tick.

    Returns:
        The condition for the site with the smallest excess, Kp - Gamma g^2 h, which is positive
        if the condition is met. `None` if a site has another law, or if the condition does not
        cover the scenario for another reason.
    """
    delays_s = _list_delays_s(scenario)
    if scenario.scheme != "digital" or delays_s is None:
        return None

    site_excess = []
    for spec in scenario.sites.values():
        tick_s = 1.0 / spec.rate_hz
        excess = spec.control.find_sampling_excess(spec.arm.g_m_s2, tick_s)
        if excess is None or max(delays_s) > tick_s:
            return None
        site_excess.append(excess)
    return StabilityCriterion(
        symbol=r"$\Gamma g^2 h = K_p$",
        text="Gamma g² h = Kp",
        source=(
            "a rule of thumb for arms of about 1 m and no delay: "
            "gravity must not be estimated too fast for the tick rate"
        ),
        excess=min(site_excess),
    )


def _list_delays_s(scenario: Scenario) -> list[float] | None:
    """Returns the constant delays of all links whose samples influence an arm, in s.

    Links with a dominance factor of 0 are excluded, because their samples have no effect.

    Returns:
        The delays, or `None` if a delay is not constant or a link loses messages.
    """
    delays_s = []
    for site in scenario.names:
        dominance_factors = scenario.dominance[site]
        for peer in scenario.peers(site):
            if dominance_factors.get(peer, 0.0) == 0.0:
                continue
            link: LinkBase = scenario.links[f"{peer}->{site}"]
            if link.constant_delay_ms is None:
                return None
            if link.random or link.loss or link.outages_s:
                return None
            moments = link.moments()
            delay_ms = max(moments.mean_ms, link.playout_ms)
            delays_s.append(delay_ms / 1e3)
    return delays_s


PanelLoader = Callable[[float, float], Scenario]
"""Returns the scenario of a panel at any values of x and y."""

_MAX_ROOT_STEPS = 500
"""Maximum number of iterations of Brent's method."""
LINEAR_ANALYSIS = "linear analysis"
"""Name of the line from the linear analysis, in the legend."""
_ABOUT_ROOTS = "where the rightmost root of the linearised loop crosses the imaginary axis"
"""Explanation of the line from the linear analysis, on the page of the map."""


_NO_COLUMNS: Array = np.zeros((0, 0))
_FINE_COLUMNS = 24
"""Minimum number of steps along x with which a theoretical line is drawn."""


class _FineColumns(NamedTuple):
    """Columns at which a theoretical line is computed, between and beside the map's columns.

    Theoretical lines are curved, so straight connections between the few columns of a coarse
    map would be wrong.

    Attributes:
        values: Values of x, in ascending order.
        positions: Positions along the axis at which they are drawn.
        on_grid: Indices of those columns that are also columns of the map.
    """

    values: tuple[float, ...]
    positions: tuple[float, ...]
    on_grid: tuple[int, ...]


def _keep_columns(axis: PlaneAxis) -> _FineColumns:
    """Returns only the columns of the map, for theoretical lines with no points in between.

    Args:
        axis: Horizontal axis of the map.
    """
    count = len(axis.values)
    return _FineColumns(axis.values, tuple(axis.positions.tolist()), tuple(range(count)))


class MapLine(NamedTuple):
    """A line on a stability map that separates stable from unstable parameters.

    The line is the zero of a quantity that is known at the grid points and interpolated
    linearly between neighbouring grid points with the same x.

    Attributes:
        label: Name of the line for a legend, possibly with TeX.
        text: The same name as plain text.
        about: Explanation of the origin of the line.
        excess: The quantity at the grid points, shape (number of y values, number of x values).
            Positive on the stable side, NaN where it is unknown.
        rank: Index of the line style. -1 is the style of measured lines.
        fine_positions: Positions along x of the columns between which the line is drawn. Empty
            if these are the columns of the map.
        fine_excess: The quantity at these columns, shape (number of y values, number of
            columns).
    """

    label: str
    text: str
    about: str
    excess: Array
    rank: int
    fine_positions: tuple[float, ...] = ()
    fine_excess: Array = _NO_COLUMNS

    @property
    def drawn_excess(self) -> Array:
        """Values, at each column, of the function whose zero crossing is the line.

        The columns are the fine ones if the line was computed there, and the columns of the map
        otherwise.
        """
        return self.fine_excess if self.fine_positions else self.excess

    def thin_out(self, columns: _FineColumns) -> "MapLine":
        """Splits a theoretical line into the map's columns and the fine columns in between.

        Args:
            columns: The columns at which the line was computed.
        """
        if len(columns.on_grid) == len(columns.values):
            return self
        return self._replace(
            excess=self.excess[:, columns.on_grid],
            fine_positions=columns.positions,
            fine_excess=self.excess,
        )

    @property
    def crosses_map(self) -> bool:
        """True if the line passes between grid points of the map and is therefore visible.

        This requires four neighbouring grid points at which the quantity is known and positive
        at some but not all of them.
        """
        excess = self.drawn_excess
        lower = excess[:-1]
        upper = excess[1:]
        lower_left = lower[:, :-1]
        lower_right = lower[:, 1:]
        upper_left = upper[:, :-1]
        upper_right = upper[:, 1:]
        corners = np.array([lower_left, lower_right, upper_left, upper_right])

        has_values = np.isfinite(corners).all(axis=0)
        stable = (corners > 0.0).sum(axis=0)
        some_are_stable = (stable > 0) & (stable < len(corners))
        crossed = has_values & some_are_stable
        return bool(crossed.any())

    def crossings(self, column: int, y: PlaneAxis) -> list[float]:
        """Finds the values of y at which the line crosses a column of the map.

        Args:
            column: Index of the column, from 0.
            y: Vertical axis of the map.

        Returns:
            The values in ascending order. Empty if the line does not cross the column.
        """
        values = y.values
        excess = self.excess[:, column].tolist()
        crossings = list[float]()
        for n in _find_sign_changes(excess):
            step = values[n + 1] - values[n]
            change = excess[n] - excess[n + 1]
            crossing = values[n] + step * excess[n] / change
            crossings.append(crossing)
        return crossings

    @classmethod
    def trace_closed_form(
        cls, load: PanelLoader, x: PlaneAxis, y: PlaneAxis
    ) -> "MapLine | None":
        """Traces the line on which a closed-form stability condition is only just met.

        See `StabilityCriterion` for the condition. If its sign changes between two grid points
        with the same x, the crossing in y is located with Brent's method, because the condition
        may be nonlinear.

        Args:
            load: Returns the scenario at given values of x and y.
            x: Horizontal axis of the map.
            y: Vertical axis of the map.

        Returns:
            The line, or `None` if no condition is known for the scenario or the line does not
            cross the map.
        """
        first_criterion: StabilityCriterion | None = None
        columns = []
        for x_value in x.values:

            def evaluate(y_value: float, x_value: float = x_value) -> StabilityCriterion | None:
                scenario = load(x_value, y_value)
                return StabilityCriterion.evaluate(scenario)

            criteria = [evaluate(y_value) for y_value in y.values]
            applicable = [criterion for criterion in criteria if criterion is not None]
            if first_criterion is None and applicable:
                first_criterion = applicable[0]
            excess = []
            for criterion in criteria:
                value = np.nan if criterion is None else criterion.excess
                excess.append(value)
            edges: dict[int, float] = {}
            for n in _find_sign_changes(excess):
                edge = StabilityCriterion.find_edge(evaluate, y.values[n], y.values[n + 1])
                if edge is not None:
                    edges[n] = edge
            column = _place_zeros(y.values, excess, edges)
            columns.append(column)
        if first_criterion is None:
            return None

        # Labels and source are the same in the whole panel; take those of the first criterion.
        line = cls(
            label=first_criterion.symbol,
            text=first_criterion.text,
            about=first_criterion.source,
            excess=np.array(columns).T,
            rank=0,
        )
        return line if line.crosses_map else None

    @classmethod
    def trace_linear_analysis(
        cls, columns: Sequence[GrowthColumn], y: PlaneAxis
    ) -> "tuple[MapLine | None, list[str]]":
        """Traces the stability limit of the linearised control loop.

        On this line, small motions neither grow nor decay: the real part of the rightmost
        characteristic root is zero. The quantity of the line (see `MapLine.excess`) is the
        decay rate of the motions in 1/s, the negative of the growth rate, which is positive on
        the stable side.

        Args:
            columns: Linear analysis of each column of the panel, in the order of x, with growth
                rates and precise positions of the limit.
            y: Vertical axis.

        Returns:
            The line, or `None` if it does not cross the panel; and remarks on the analysis for
            the reader of the map, without duplicates.
        """
        decay_columns = []
        all_remarks = list[str]()
        for column in columns:
            # A growth rate of -infinity means that nothing moves. The grid point is then on
            # neither side.
            decay_per_s = [np.nan if np.isinf(rate) else -rate for rate in column.growth_per_s]
            # The drawn line must pass through the precise positions of the limit.
            placed_decay_per_s = _place_zeros(y.values, decay_per_s, column.edges)
            decay_columns.append(placed_decay_per_s)
            all_remarks.extend(column.remarks)
        distinct_remarks = list(dict.fromkeys(all_remarks))  # in their order
        line = MapLine(
            label=LINEAR_ANALYSIS,
            text=LINEAR_ANALYSIS,
            about=_ABOUT_ROOTS,
            excess=np.array(decay_columns).T,
            rank=1,  # line style; 0 is that of the closed form
        )
        return line if line.crosses_map else None, distinct_remarks


ZERO_EXPONENT = "exponent = 0"
"""Name of the measured line of zero growth exponents."""
_ABOUT_TWINS = (
    "where a small push neither grows nor dies away, interpolated linearly between cells"
)
"""Explanation of the line of zero growth exponents, on the page of the map."""


ZERO_RATE = "growth rate = 0"
"""Name of the line of zero growth rates in a sweep that is judged linearly."""


def _trace_zero_exponent(plane: MapPlane, panel: MapPanel) -> MapLine | None:
    """Traces the measured line on which the growth exponent is zero.

    The exponent is the rate, in 1/s, at which a small disturbance grows. On this line,
    disturbances neither grow nor decay.

    Args:
        plane: The map.
        panel: Panel of the map with the exponent at each grid point.

    Returns:
        The line, or `None` if it does not cross this panel.
    """
    name = ZERO_RATE if plane.is_linear else ZERO_EXPONENT
    line = MapLine(
        label=name,
        text=name,
        about=_ABOUT_ROOTS if plane.is_linear else _ABOUT_TWINS,
        excess=-panel.exponents_per_s,
        rank=-1,
    )
    return line if line.crosses_map else None


def _find_sign_changes(values: Sequence[float]) -> list[int]:
    """Returns the indices n at which the values n and n + 1 have different signs.

    Such values enclose an edge of stability, for example where a growth rate becomes positive.
    Zero counts as negative. Values that are not finite are never part of a change of sign.
    """
    indices = list[int]()
    for n, (value, following) in enumerate(pairwise(values)):
        finite = np.isfinite([value, following]).all()
        sign_changes = (value > 0.0) != (following > 0.0)
        if finite and sign_changes:
            indices.append(n)
    return indices


def _place_zeros(
    values: Sequence[float], excess: Sequence[float], edges: Mapping[int, float]
) -> Array:
    """Adjusts a quantity along a column so that its linear interpolation is zero at the edges.

    The lines of a map are drawn where the linear interpolation between grid points is zero. If
    the quantity is nonlinear between two grid points, this zero differs from the true zero,
    which is the edge. The value above each edge is therefore adjusted. Let v be the value below
    the edge, u the value above it, and f the position of the edge in the interval, from 0 to 1.
    The linear interpolation is zero at the edge if

        v + f (u - v) = 0,   that is,   u = v (1 - 1/f).

    u keeps its sign, which is opposite to that of v. The values are adjusted from bottom to
    top, so v may itself have been adjusted for an edge below it.

    All other values remain unchanged. They determine where a line that is too steep to cross
    this column or the next one passes between them.

    Args:
        values: Values of the axis along the column, in ascending order, shape (y,).
        excess: The quantity at these values, shape (y,).
        edges: Position of each edge, by the index n of the interval from value n to n + 1. An
            edge that is missing is placed at the zero of the linear interpolation.

    Returns:
        The adjusted quantity, a column of `MapLine.excess`.
    """
    placed: Array = np.where(np.isfinite(excess), excess, np.nan)
    placed[placed == 0.0] = -_ROUNDING  # zero counts as negative
    for n in _find_sign_changes(excess):
        if n in edges:
            low = values[n]
            width = values[n + 1] - low
            fraction = (edges[n] - low) / width
        else:
            change = excess[n] - excess[n + 1]
            fraction = excess[n] / change
        # An edge exactly at a grid point would make a value 0 or infinite.
        fraction = max(fraction, _ROUNDING)
        fraction = min(fraction, 1.0 - _ROUNDING)
        scale = 1.0 - 1.0 / fraction
        placed[n + 1] = placed[n] * scale
    return placed


LAW_AXIS = "law"
"""Key of the axis for control laws."""


class StabilityMap(NamedTuple):
    """Map of stable and unstable parameters: simulation results and theoretical lines.

    Attributes:
        plane: The measurements, as panels.
        lines: Lines of each panel, in the order of the panels.
        remarks: Remarks on the lines for the reader of the map.
        commands: Commands that recreate the map.
        title: Title of the map's page.
        fixed: Gains that were not swept, one string per control law.
    """

    plane: MapPlane
    lines: tuple[tuple[MapLine, ...], ...]
    remarks: tuple[str, ...]
    commands: tuple[str, ...]
    title: str
    fixed: tuple[str, ...] = ()

    @classmethod
    def of_sweep(
        cls,
        results: SweepResults,
        commands: tuple[str, ...],
        jobs: int | None = None,
        progress: Progress | None = None,
        *,
        linearly: bool = True,
        on: Workers = None,
        simulated: SweepResults | None = None,
    ) -> "StabilityMap":
        """Builds the stability map of a sweep from its runs and from theoretical limits.

        Theoretical limits are drawn as lines. They are computed only if the map has two numeric
        axes.

        Args:
            results: Results of the sweep: its plan and one row per run.
            commands: Commands that create the map, quoted on the page of the map.
            jobs: Number of worker processes for the linear analysis. If `None`, one per core.
            progress: Called while the linear analysis runs.
            linearly: True to add the line on which the linearised loop becomes unstable.
                Computing this line takes most of the time.
            on: Workers that compute the linear analysis. If `None`, processes on this computer
                are started.
            simulated: Another sweep over the same axes, whose measured edges are drawn as well.

        Returns:
            The map.

        Raises:
            UsageError: There is nothing to draw, there would be too many panels, or the other
                sweep has other axes.
        """
        plan = results.plan
        plane = _build_plane_of_sweep(results)
        if simulated is not None:
            plane = _add_simulated_edges(plane, _build_plane_of_sweep(simulated))
        stability_map = cls(
            plane=plane,
            lines=((),) * len(plane.panels),
            remarks=(),
            commands=commands,
            title=plan.base.title or plan.base.name,
            fixed=tuple(describe_fixed_gains(plan)),
        )
        x = plane.x.thin_out(plan.refine)
        y = plane.y.thin_out(plan.refine)
        if not y.key or len(y.values) < 2:
            return stability_map

        loaders = [panel.make_loader(plan, x.key, y.key) for panel in plane.panels]
        fine = _choose_columns(loaders, x, y)
        panel_lines = []
        for panel, load in zip(plane.panels, loaders, strict=True):
            measured_line = _trace_zero_exponent(plane, panel)
            closed_form_line = MapLine.trace_closed_form(
                load, x._replace(values=fine.values), y
            )
            if closed_form_line is not None:
                closed_form_line = closed_form_line.thin_out(fine)
            panel_lines.append([measured_line, closed_form_line])
        remarks = list[str]()
        # The cells of a sweep that is judged linearly have the growth rates already.
        if linearly and not plane.is_linear:
            tasks = [(load, x_value, y) for load in loaders for x_value in fine.values]
            with WorkerPool.open(jobs, on, most=len(tasks)) as pool:
                columns = iter(pool.map(_analyse_column, tasks, progress))
            # The results come in the order of the tasks, panel by panel and column by column.
            for lines in panel_lines:
                panel_columns = [next(columns) for _ in fine.values]
                line, line_remarks = MapLine.trace_linear_analysis(panel_columns, y)
                lines.append(None if line is None else line.thin_out(fine))
                remarks += line_remarks

        if plan.refine:
            panel_lines = [
                [lines[0], *(_spread_line(line, x, y, fine, plane) for line in lines[1:])]
                for lines in panel_lines
            ]
        crossing_lines = [tuple(filter(None, lines)) for lines in panel_lines]
        distinct_remarks = tuple(dict.fromkeys(remarks))
        return stability_map._replace(lines=tuple(crossing_lines), remarks=distinct_remarks)


def _build_plane_of_sweep(results: SweepResults) -> MapPlane:
    """Arranges the runs of a sweep in a grid for a map.

    Args:
        results: The sweep.
    """
    plan = results.plan
    grid: dict[str, Sequence[Any]] = {}
    if len(plan.laws) > 1:
        grid[LAW_AXIS] = list(plan.laws)
    for axis in plan.axes:
        value_count = len(axis.texts)
        grid[axis.key] = [axis.value(n) for n in range(value_count)]
    plane = MapPlane.arrange_rows(results.rows, list(grid), plan.base, grid)
    return plane._replace(halvings=plan.refine, is_linear=plan.judge == "linear")


def _add_simulated_edges(plane: MapPlane, simulated: MapPlane) -> MapPlane:
    """Adds the measured edges of another sweep to a map, for comparison.

    Args:
        plane: The map.
        simulated: Map of the other sweep. Its axes may have other values.

    Raises:
        UsageError: The other map has other axes or panels.
    """
    edges_of = {
        panel.settings: tuple(simulated.find_edges(panel)) for panel in simulated.panels
    }
    has_panels = all(panel.settings in edges_of for panel in plane.panels)
    has_axes = (plane.x.key, plane.y.key) == (simulated.x.key, simulated.y.key)
    if not (has_axes and has_panels):
        raise UsageError(
            f"the other sweep has the axes {simulated.x.key}, {simulated.y.key}: a map shows "
            f"its edge only over the same axes, {plane.x.key}, {plane.y.key}"
        )
    panels = []
    for panel in plane.panels:
        edges = edges_of[panel.settings]
        panels.append(panel._replace(simulated=edges))
    return plane._replace(panels=tuple(panels))


def _spread_line(
    line: MapLine | None, x: PlaneAxis, y: PlaneAxis, fine: _FineColumns, plane: MapPlane
) -> MapLine | None:
    """Interpolates a line from the coarse grid of a refined sweep to all grid points of a map.

    Theoretical lines are smooth, and their position in each column of the coarse grid is exact.

    Args:
        line: The line over the coarse grid. `None` is returned as `None`.
        x: Horizontal axis of the coarse grid.
        y: Vertical axis of the coarse grid.
        fine: Columns at which the line was computed.
        plane: The map.
    """
    if line is None:
        return None

    def spread_rows(excess: Array) -> Array:
        """Interpolates each column of the array at the y values of the map."""
        columns = [np.interp(plane.y.values, y.values, column) for column in excess.T]
        return np.array(columns).T

    # first along y, then along x
    at_coarse_columns = spread_rows(line.excess)
    excess = np.array([np.interp(plane.x.values, x.values, row) for row in at_coarse_columns])
    drawn_excess = spread_rows(line.drawn_excess)
    values = np.array(fine.values)
    positions = values
    if not plane.x.is_evenly_spaced:
        positions = np.interp(values, plane.x.values, plane.x.positions)
    return line._replace(
        excess=excess, fine_positions=tuple(positions.tolist()), fine_excess=drawn_excess
    )


def _choose_columns(loaders: Sequence[PanelLoader], x: PlaneAxis, y: PlaneAxis) -> _FineColumns:
    """Returns the columns at which theoretical lines are computed.

    If the scenario is not valid between the columns of the map, for example because its key
    accepts only integers, only the columns of the map are returned.
    """
    fine = x.refine_columns()
    try:
        for load in loaders:
            for value in fine.values:
                load(value, y.values[0])
    except ScenarioError:
        return _keep_columns(x)
    return fine


def _analyse_column(task: tuple[PanelLoader, float, PlaneAxis]) -> GrowthColumn:
    """Computes the linear analysis of one column of a panel: growth rates along y.

    Worker processes call this function, so several columns can be computed at the same time.

    Args:
        task: Function that loads scenarios of the panel, the column's value of x, and the
            vertical axis.
    """
    load, x, y = task
    scenarios = [load(x, y_value) for y_value in y.values]
    return GrowthColumn.compute(scenarios, y.key, y.values)


def _load_grid_scenario(
    plan: SweepPlan, fixed: Sequence[str], x: str, y: str, x_value: float, y_value: float
) -> Scenario:
    """Loads the scenario of a sweep with given values of the two parameters on a map's axes.

    The values may lie between those that were swept, to locate a stability edge more precisely.

    Args:
        plan: The sweep.
        fixed: Overrides KEY=VALUE of all other parameters.
        x: Scenario key of the horizontal axis.
        y: Scenario key of the vertical axis.
        x_value: Value of the key `x`.
        y_value: Value of the key `y`.

    Raises:
        ScenarioError: The scenario is not valid with these values.
    """
    x_override = f"{x}={format_override_value(x_value)}"
    y_override = f"{y}={format_override_value(y_value)}"
    return plan.scenario(*fixed, x_override, y_override)
