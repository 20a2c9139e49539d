"""Builds a stability map, which shows for which parameters a scenario is stable.

The map presents the results of a sweep in panels (see `map_plane`). Theoretical limits are
drawn as lines for comparison with the runs:

- The closed-form line is where a closed-form stability criterion is only just met. It is used
  only if all assumptions of the criterion hold. For the proportional law with damping, P+d, the
  line accounts for sampling.
- The linear line is where the rightmost characteristic root of the linearised loop crosses the
  imaginary axis. It accounts for sampling only with the integration scheme `digital`.

Invariant:
    - The measurements come only from the results, and the lines only from the plan.
    - A line crosses a column between two neighbouring grid points if exactly one of them is
      stable according to theory.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from trilat_net.analysis import GrowthColumn
from trilat_net.core import Array
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.work import Progress, WorkerPool, Workers

from .fixed_gains import describe_fixed_gains
from .map_plane import LAW_AXIS, FineColumns, MapPanel, MapPlane, PanelLoader, PlaneAxis
from .stability_criteria import StabilityCriterion
from .sweep_results import SweepResults

_ROUNDING = 1e-6
"""Tolerance for rounding errors of relative positions of edges."""
LINEAR_ANALYSIS = "linear analysis"
"""Name of the line from the linear analysis, in the legend."""
_ABOUT_ROOTS = "where the rightmost root of the linearised loop crosses the imaginary axis"
"""Explanation of the line from the linear analysis, on the page of the map."""


_NO_COLUMNS: Array = np.zeros((0, 0))


class MapLine(NamedTuple):
    """A line on a stability map that separates stable from unstable parameters.

    The line is the zero contour of a quantity that is known at the grid points and interpolated
    linearly between neighbouring grid points with the same x.

    Attributes:
        label: Name of the line for a legend, possibly with TeX.
        text: The same name as plain text.
        about: Explanation of the origin of the line.
        excess: The quantity at the grid points, shape (number of y values, number of x values).
            Positive on the stable side, NaN where it is unknown.
        rank: Index of the line style. -1 is the style of measured lines.
        fine_positions: Positions along x of all columns at which the line was computed. Empty
            if the line was computed only at the columns of the map.
        fine_excess: The quantity at these positions, shape (number of y values, number of
            positions).
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
        """Values of the quantity whose zero contour is drawn as the line.

        These are `fine_excess` if the line was computed between the columns of the map, and
        `excess` otherwise.
        """
        return self.fine_excess if self.fine_positions else self.excess

    def thin_out(self, columns: FineColumns) -> "MapLine":
        """Returns the line with its values at the map's columns separated from all its values.

        `excess` of the result contains only the values at the map's columns, and `fine_excess`
        contains the values at all columns at which the line was computed.

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

        This requires four neighbouring grid points at which the quantity is known. It must be
        positive at some of these points, but not at all of them.
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
        decay rate of the motions in 1/s, that is, the growth rate with the opposite sign. The
        decay rate is positive on the stable side.

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
    line: MapLine | None, x: PlaneAxis, y: PlaneAxis, fine: FineColumns, plane: MapPlane
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


def _choose_columns(loaders: Sequence[PanelLoader], x: PlaneAxis, y: PlaneAxis) -> FineColumns:
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
        return x.keep_columns()
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
