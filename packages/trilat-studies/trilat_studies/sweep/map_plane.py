"""Arranges the results of a sweep in panels over two swept parameters.

The axes x and y are the first two numeric parameters, and each combination of the other
parameters and the control law gets its own panel. Each grid point of a panel shows how many of
its runs were stable. A column is the set of grid points with the same x.

Invariant:
    - Every run is counted at exactly one grid point. A grid point is stable if the majority of
      its decided runs is. A tie leaves the point undecided.
    - A measured edge lies between two decided grid points of a column, one of them stable and
      the other not. Undecided grid points between the two make the edge wider.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from trilat_net.core import Array
from trilat_net.errors import UsageError
from trilat_net.scenario import Scenario, is_number

from ..run_commands import format_override
from .sweep_axis import label_axis, label_setting
from .sweep_cell import RUN_CLASSES, CellClass
from .sweep_plan import SweepPlan

RunCounts = NDArray[np.int64]
PanelSettings = tuple[tuple[str, Any], ...]
"""Values of the axes that are not drawn, as pairs of a key and a value."""

CELL_CLASSES = RUN_CLASSES
"""Classes of a run, in the order of the last dimension of `MapPanel.counts`."""
PanelLoader = Callable[[float, float], Scenario]
"""Returns the scenario of a panel at any values of x and y."""
LAW_AXIS = "law"
"""Key of the axis for control laws."""
_FINE_COLUMNS = 24
"""Minimum number of steps along x with which a theoretical line is drawn."""
MAX_PANELS = 12
"""Largest number of panels of a map at which they remain legible."""


class FineColumns(NamedTuple):
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

        If no value is negative, no border is negative either, because a delay, for example,
        cannot be -100 ms.

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

    def keep_columns(self) -> FineColumns:
        """Returns only the map's own columns, for lines that are not computed elsewhere."""
        count = len(self.values)
        return FineColumns(self.values, tuple(self.positions.tolist()), tuple(range(count)))

    def refine_columns(self) -> FineColumns:
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
            return self.keep_columns()

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

        return FineColumns(
            tuple(fine_values.tolist()), tuple(fine_positions.tolist()), tuple(on_grid.tolist())
        )

    def thin_out(self, halvings: int) -> "PlaneAxis":
        """Returns the axis with only the values of the coarse grid that a sweep refines.

        Args:
            halvings: Number of times that the refined sweep halves its grid. If 0, the whole
                axis is returned.
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
        title: The values of the further swept keys as a string, such as "p d, delay 200 ms".
            Empty if there are no further keys.
        settings: The further swept keys with their values, as pairs. The key of a swept law is
            "law".
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
        """Number of runs at each grid point judged either stable or not stable, shape (y, x).

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

        Each of these points gets the class of the nearest point that was run. Growth exponents
        are interpolated linearly between grid points that have one.
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

    def make_loader(self, plan: SweepPlan, x: str, y: str) -> PanelLoader:
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
        overrides += [format_override(key, value) for key, value in settings.items()]
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
        halvings: For a refined sweep, the number of times that the grid was halved along the
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
    """An edge between stable and unstable values of a parameter, located to within an interval.

    Attributes:
        low: Largest value below the edge at which stability was decided.
        high: Smallest value above the edge at which stability was decided.
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
    return plan.scenario(*fixed, format_override(x, x_value), format_override(y, y_value))
