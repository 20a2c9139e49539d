"""Finds stability margins: the values of a scenario key at which stability begins or ends.

At each grid point of a sweep, this module finds the edges of stability along one further key,
such as "control.d". It first runs the scenario at evenly spaced values of the key (the scan),
and then uses bisection to narrow each interval in which stability changes. The edges are
reported next to those predicted by theory, as a table, a Markdown page and plain values.

Invariant:
    - An edge lies between two values that were run, one of them stable and the other not.
    - Undecided values widen an edge, and count as neither stable nor unstable.
    - All edges that the scan detects are kept.
    - The margin of a grid point depends only on its scenario, its seed and the range.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from trilat_net.analysis import GrowthColumn
from trilat_net.errors import ScenarioError, UsageError, count_nouns
from trilat_net.files import write_whole
from trilat_net.presentation import TextTable
from trilat_net.results import Result
from trilat_net.scenario import Scenario
from trilat_net.work import Progress, WorkerPool, Workers

from ..run_commands import format_override, format_override_value
from . import sweep_cell
from .fixed_gains import FAIR_COMPARISON, describe_fixed_gains
from .map_plane import StabilityEdge
from .stability_criteria import StabilityCriterion
from .sweep_axis import label_axis
from .sweep_plan import SweepCell, SweepPlan

SCAN_POINTS = 9
"""Number of values of the scan. It detects islands of stability wider than an eighth of the
range.
"""
MARGIN_TOLERANCE = 0.005
"""Default for the largest width of the interval that contains an edge, as a fraction of the
value.
"""
_MAX_HALVINGS = 60
"""Maximum number of bisection steps."""

StabilityTest = Callable[[float], bool | None]
"""Runs the scenario at a value of the key. Returns True if the run is stable, False if it is
not, and `None` if it is undecided.
"""


class KeyMargin(NamedTuple):
    """Stability edges along one scenario key, found by runs at selected values.

    At an edge, runs at neighbouring values change from stable to not stable or back.

    Attributes:
        spans: The edges in ascending order. There may be several, for example if stability is
            lost at one value and regained at a larger value.
        stable: If there are no edges, True if all runs with a verdict are stable, and False if
            none of them is. `None` if there are edges, or if no run has a verdict.
        undecided: Number of values at which the stability of the run remained undecided.
        runs: Number of values at which the scenario was run.
    """

    spans: tuple[StabilityEdge, ...]
    stable: bool | None
    undecided: int
    runs: int

    @classmethod
    def search(
        cls,
        stable: StabilityTest,
        low: float,
        high: float,
        tolerance: float = MARGIN_TOLERANCE,
        *,
        whole: bool = False,
    ) -> "KeyMargin":
        """Finds the stability edges between two values of a scenario key.

        Runs the scenario at evenly spaced values, and then uses bisection to narrow each
        interval in which stability changes.

        Args:
            stable: Runs the scenario at a value of the key. Returns True if the run is stable,
                False if it is not, and `None` if it is undecided.
            low: Lower end of the range.
            high: Upper end of the range.
            tolerance: Interval width, as a fraction of the value, at which the bisection stops.
            whole: True if the key accepts only integers.

        Returns:
            The intervals that contain the edges. If there are none, the result states whether
            all values are stable.
        """
        results: dict[float, bool | None] = {}

        def classify(value: float) -> bool | None:
            """Returns whether the run at a value is stable, or `None` if it is undecided.

            A value that both the scan and the bisection reach is simulated only once.
            """
            if value not in results:
                results[value] = stable(value)
            return results[value]

        scanned_values = np.linspace(low, high, SCAN_POINTS)
        if whole:
            scanned_values = np.round(scanned_values)
        values = list(dict.fromkeys(scanned_values.tolist()))
        decided = [value for value in values if classify(value) is not None]

        spans = list[StabilityEdge]()
        for below, above in pairwise(decided):
            if results[below] != results[above]:
                spans.append(
                    _narrow_edge(classify, below, above, tolerance=tolerance, whole=whole)
                )

        stable_everywhere = results[decided[0]] if decided and not spans else None
        undecided = sum(result is None for result in results.values())
        return cls(tuple(spans), stable_everywhere, undecided, len(results))


def _narrow_edge(
    classify: StabilityTest, low: float, high: float, *, tolerance: float, whole: bool
) -> StabilityEdge:
    """Narrows the interval between a stable value and one that is not stable, by bisection.

    If undecided values lie between the two sides, both ends of this zone are located.

    Args:
        classify: Returns whether a value is stable.
        low: Decided value below the edge.
        high: Decided value above the edge, with the opposite result.
        tolerance: Largest width of the interval, as a fraction of the value.
        whole: True if only integers can be run.
    """
    low_stable = classify(low)
    high_stable = classify(high)

    def is_low_side(value: float) -> bool:
        return classify(value) is low_stable

    def is_not_high_side(value: float) -> bool:
        return classify(value) is not high_stable

    low, first_above = _bisect(is_low_side, low, high, tolerance=tolerance, whole=whole)
    is_sharp = classify(first_above) is not None
    if is_sharp:
        high = first_above
    else:
        # This value lies in an undecided zone, whose upper end is searched separately.
        _, high = _bisect(is_not_high_side, first_above, high, tolerance=tolerance, whole=whole)
    return StabilityEdge(low, high, low_stable is True, is_sharp)


def _bisect(
    holds: Callable[[float], bool], low: float, high: float, *, tolerance: float, whole: bool
) -> tuple[float, float]:
    """Narrows the interval between a value where a condition holds and one where it fails.

    Args:
        holds: The condition. It holds at `low` and fails at `high`.
        low: Lower end of the interval.
        high: Upper end of the interval.
        tolerance: Largest width of the result, as a fraction of its larger end.
        whole: True to use only integers, down to a width of 1.

    Returns:
        A value at which the condition holds, and a larger value at which it fails.
    """
    for _ in range(_MAX_HALVINGS):
        largest_width = 1.0 if whole else tolerance * max(abs(low), abs(high))
        if high - low <= largest_width:
            break
        middle = 0.5 * (low + high)
        middle = float(np.floor(middle)) if whole else middle
        if holds(middle):
            low = middle
        else:
            high = middle
    return low, high


class SearchRange(NamedTuple):
    """A scenario key and the range in which its stability edges are searched for.

    Attributes:
        key: Scenario key along which edges are searched for.
        low: Lower end of the range.
        high: Upper end of the range.
        tolerance: Largest width of the interval that contains an edge, as a fraction of the
            value.
    """

    key: str
    low: float
    high: float
    tolerance: float

    def format_axis(self) -> str:
        """Returns a sweep axis with both ends of the range as values, such as "control.d=1,20".

        Planning a sweep with this axis checks the scenario at both ends before any run.
        """
        low = format_override_value(self.low)
        high = format_override_value(self.high)
        return f"{self.key}={low},{high}"

    @classmethod
    def parse(cls, text: str, tolerance: float = MARGIN_TOLERANCE) -> "SearchRange":
        """Parses the key and range of a search for stability edges, such as "control.d=0.2:3".

        Args:
            text: String of the form KEY=FROM:TO.
            tolerance: Largest width of the interval that contains an edge, as a fraction of the
                value.

        Raises:
            UsageError: The text does not have this form, or the tolerance is not within (0, 1).
        """
        key, _, ends = text.partition("=")
        low, colon, high = ends.partition(":")
        try:
            search_range = cls(key.strip(), float(low), float(high), tolerance)
        except ValueError:
            raise UsageError(
                f"--margin must have the form KEY=FROM:TO, as in control.d=0.2:3, not {text!r}"
            ) from None

        if not 0.0 < tolerance < 1.0:
            raise UsageError(
                f"--tolerance must be a fraction of the value at the edge, as in 0.005, "
                f"not {tolerance:g}"
            )

        is_rising = -float("inf") < search_range.low < search_range.high < float("inf")
        if not colon or not search_range.key or not is_rising:
            form = "KEY=FROM:TO with FROM below TO, as in control.d=0.2:3"
            raise UsageError(f"--margin must have the form {form}, not {text!r}")
        return search_range


class _MarginItem(NamedTuple):
    """Task for a worker process: find the stability edges at one grid point of a sweep.

    The object can be pickled and sent to the process.

    Attributes:
        plan: The sweep.
        cell: The grid point, a combination of the values of the other swept parameters.
        seed: Random seed of the runs.
        range: Scenario key along which edges are searched for, and its range.
    """

    plan: SweepPlan
    cell: SweepCell
    seed: int
    range: SearchRange

    def __str__(self) -> str:
        position = ", ".join(self.cell.overrides) or "the scenario"
        return f"the search at {position}, seed {self.seed}"


class GridPointMargin(NamedTuple):
    """Stability edges along one scenario key, at one grid point of a sweep.

    A grid point is a combination of values of the other swept parameters.

    Attributes:
        cell: The grid point.
        seed: Random seed of its runs.
        margin: The edges found by running the scenario.
        linear: The values within the range at which the linearised loop becomes unstable, in
            ascending order.
        remark: Remark on the linear analysis. May be empty.
        closed: The edge within the range according to a closed-form stability criterion. `None`
            if no criterion applies, or if its edge lies outside the range.
    """

    cell: SweepCell
    seed: int
    margin: KeyMargin
    linear: tuple[float, ...]
    remark: str
    closed: float | None


def _search_margin_task(task: _MarginItem) -> GridPointMargin:
    """Finds the stability edges at one grid point of a sweep, from runs and from theory.

    The result depends only on the argument, so any worker process can compute it.

    Args:
        task: The grid point, the seed of the runs, and the searched key with its range.

    Returns:
        The edges from runs, from the linear analysis, and from a closed-form criterion.

    Raises:
        ScenarioError: The scenario is not valid at a value in the range.
    """
    key, low, high, tolerance = task.range

    def load(value: float) -> Scenario:
        """Loads the scenario of the grid point with a given value of the searched key.

        Args:
            value: Value of the searched key.
        """
        override = format_override(key, value)
        return task.plan.scenario(*task.cell.overrides, override, f"seed={task.seed}")

    def is_stable(value: float) -> bool | None:
        """Simulates the scenario with a given value of the searched key and judges the run.

        Args:
            value: Value of the searched key.

        Returns:
            True if the run is stable, False if it is not, and `None` if it is undecided.
        """
        scenario = load(value)
        longest_s = max(task.plan.longest_s, scenario.duration_s)
        return sweep_cell.classify_cell(scenario.text, longest_s).verdict.stable

    whole = False
    try:
        load(low + (high - low) / 3.0**0.5)  # an irrational number, never a whole number
    except ScenarioError:
        whole = True  # the key takes whole numbers only
    margin = KeyMargin.search(is_stable, low, high, tolerance, whole=whole)
    closed = StabilityCriterion.find_edge(
        lambda value: StabilityCriterion.evaluate(load(value)), low, high
    )
    linear, remark = GrowthColumn.find_crossings(load(high), key, low, high)
    return GridPointMargin(
        cell=task.cell,
        seed=task.seed,
        margin=margin,
        linear=linear,
        remark=remark,
        closed=closed,
    )


def _find_nearest(value: float, edges: Sequence[float]) -> float | None:
    """Returns the predicted edge nearest to a measured edge, or `None` if there are none."""
    return min(edges, key=lambda edge: abs(edge - value), default=None)


@dataclass(frozen=True, repr=False)
class SweepMargins(Result):
    """Stability edges along one scenario key, for each grid point and random seed of a sweep.

    A grid point is a combination of values of the other swept parameters.

    Attributes:
        plan: The sweep. Its last axis is the searched key with two values, the ends of the
            range.
        within: The searched key and its range.
        found: The edges at each grid point and for each seed, in the order of the grid.
    """

    plan: SweepPlan
    within: SearchRange
    found: list[GridPointMargin]

    @classmethod
    def search(
        cls,
        plan: SweepPlan,
        within: SearchRange,
        jobs: int | None = None,
        progress: Progress | None = None,
        on: Workers = None,
    ) -> "SweepMargins":
        """Finds the stability edges along one scenario key, at each grid point of a sweep.

        A grid point is a combination of values of the other swept parameters. An edge is a
        value of the searched key at which runs change from stable to not stable or back.

        Args:
            plan: The sweep. Its last axis must be the searched key with two values, the ends of
                the range, as returned by `SearchRange.format_axis`.
            within: The searched key and its range.
            jobs: Number of worker processes. If `None`, one per core.
            progress: Called with the number of completed grid points and the total number of
                grid points.
            on: Workers to use instead of processes on this computer.

        Raises:
            ScenarioError: The scenario is not valid at a value in the range.
            RunFailed: A worker process died.
        """
        searches = []
        # The last axis changes fastest from cell to cell. It is the searched key with two
        # values, the ends of the range, so each grid point of the other axes has two
        # neighbouring cells.
        for number in range(0, plan.cells, 2):
            cell_at_low_end = plan.cell(number)
            grid_point = cell_at_low_end._replace(
                values=cell_at_low_end.values[:-1],  # without the value of the searched key
                overrides=cell_at_low_end.overrides[:-1],
            )
            # If nothing is random, all seeds give the same result.
            is_random = plan.scenario(*cell_at_low_end.overrides).random
            seeds = plan.seeds if is_random else plan.seeds[:1]
            searches += [_MarginItem(plan, grid_point, seed, within) for seed in seeds]

        # The workers need the files of control laws that users wrote.
        laws = plan.base.imported_code
        with WorkerPool.open(jobs, on, most=len(searches), laws=laws) as pool:
            points = pool.map(_search_margin_task, searches, progress)
        return cls(plan, within, points)

    @property
    def command(self) -> str:
        """Shell command that repeats this search, shown on the results page for copying."""
        low = format_override_value(self.within.low)
        high = format_override_value(self.within.high)
        tolerance = format_override_value(self.within.tolerance)
        search_range = f"{self.within.key}={low}:{high}"
        plan = self.plan._replace(axes=self.plan.axes[:-1])
        return plan.build_command("--margin", search_range, "--tolerance", tolerance)

    def table(self) -> TextTable:
        """Returns a table with one row per stability edge.

        The columns are the values of the other swept parameters, the edges found by simulated
        runs, by the linear analysis and by a closed-form criterion, and the deviation of each
        theoretical edge from the simulated one. A grid point without an edge also has one row.
        """
        plan = self.plan
        several_seeds = len({point.seed for point in self.found}) > 1
        has_closed_form = any(point.closed is not None for point in self.found)

        heads = [label_axis(axis.key, plan.base) for axis in plan.axes[:-1]]
        if plan.laws:
            heads.append("law")
        if several_seeds:
            heads.append("seed")
        heads.append(f"edge of {label_axis(self.within.key, plan.base)}")
        heads += ["stable is", "linear", "difference"]
        if has_closed_form:
            heads += ["closed form", "difference"]
        heads.append("runs")

        rows = []
        for point in self.found:
            position = [
                value if isinstance(value, str) else f"{value:g}" for value in point.cell.values
            ]
            if plan.laws:
                position.append(point.cell.law)
            if several_seeds:
                position.append(str(point.seed))
            for span in point.margin.spans or (None,):
                value = self.within.low if span is None else span.middle
                linear = _find_nearest(value, point.linear)
                row = [*position, *_format_edge(point.margin, span)]
                row += _format_theory(span, linear)
                if has_closed_form:
                    row += _format_theory(span, point.closed)
                row.append(str(point.margin.runs))
                rows.append(tuple(row))
        return TextTable(tuple(heads), rows)

    def blocks(self) -> Iterator[TextTable]:
        """Yields a table of the simulated and the predicted stability edges."""
        yield self.table()

    def headline(self) -> str:
        """Returns a sentence with the number of stability edges and the searched range.

        Example: "paper: 2 edges of control.d from 0 to 40".
        """
        edges = sum(len(point.margin.spans) for point in self.found)
        low = self.within.low
        high = self.within.high
        return (
            f"{self.plan.base.name}: {count_nouns(edges, 'edge')} of {self.within.key} "
            f"from {low:g} to {high:g}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Converts the result to the plain values that `trilat sweep --margin --json` prints.

        The key "places" has one entry per grid point, and "command" is the command that repeats
        the search.
        """
        return {
            "command": self.command,
            "scenario_sha256": self.plan.base.sha256,
            **self.within._asdict(),
            "places": [self._describe_point(point) for point in self.found],
        }

    def _describe_point(self, point: GridPointMargin) -> dict[str, Any]:
        """Converts the result at one grid point to plain values for JSON.

        They contain its position in the grid, its random seed and its stability edges.

        Args:
            point: Margin of the grid point.
        """
        margin = point.margin
        position: dict[str, Any] = {}
        for axis, value in zip(self.plan.axes[:-1], point.cell.values, strict=True):
            position[axis.key] = value
        if self.plan.laws:
            position["law"] = point.cell.law
        return position | {
            "seed": point.seed,
            "edges": [span._asdict() for span in margin.spans],
            "stable_everywhere": margin.stable,
            "undecided": margin.undecided,
            "runs": margin.runs,
            "linear": list(point.linear),
            "closed_form": point.closed,
            "remark": point.remark,
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a table of plain values, with one row per stability edge.

        A grid point without an edge also has one row.
        """
        rows = list[dict[str, Any]]()
        for point in self.to_dict()["places"]:
            columns = {
                key: value for key, value in point.items() if not isinstance(value, list)
            }
            edges = point["edges"] or [{}]
            rows.extend({**columns, **edge} for edge in edges)
        return rows

    def page(self) -> str:
        """Returns a Markdown page that reports the stability edges along the searched key.

        The page contains the command that repeats the search, a table of the edges, remarks on
        the linear analysis, and the gains that all runs have in common.
        """
        base = self.plan.base
        parts = [f"# {base.title or base.name}: margin", f"```sh\n{self.command}\n```"]
        parts.append(self.table().markdown())

        remarks = dict.fromkeys(point.remark for point in self.found if point.remark)
        parts += [f"{remark[0].upper()}{remark[1:]}." for remark in remarks]
        islands = sum(len(point.margin.spans) > 1 for point in self.found)
        if islands:
            points = count_nouns(len(self.found), "grid point")
            parts.append(
                f"Stability is not monotone at {islands} of {points}: several edges each."
            )

        fixed = "; ".join(describe_fixed_gains(self.plan))
        advice = FAIR_COMPARISON.replace("trilat compare --tune", "`trilat compare --tune`")
        parts.append(f"Gains that were not swept: {fixed}. {advice[0].upper()}{advice[1:]}.")
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> list[Path]:
        """Writes the stability edges into an existing folder, as margin.json and margin.md.

        Args:
            folder: The folder.

        Returns:
            The paths of both files.
        """
        json_path = folder / "margin.json"
        page_path = folder / "margin.md"
        write_whole(json_path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")
        write_whole(page_path, self.page())
        return [json_path, page_path]


def _format_edge(margin: KeyMargin, span: StabilityEdge | None) -> list[str]:
    """Returns two table cells: a stability edge, such as "40 to 41", and its stable side.

    Args:
        margin: The edges of the grid point.
        span: The edge. If `None`, the grid point has no edges, and the cell states whether all
            values or no values were stable.
    """
    if span is None:
        texts = {
            True: "none: all stable",
            False: "none: nothing stable",
            None: "none: nothing decided",
        }
        return [texts[margin.stable], "-"]
    if span.sharp:
        interval = f"{span.low:.5g} to {span.high:.5g}"
    else:
        interval = f"{span.low:.4g} to {span.high:.4g} (undecided between)"
    return [interval, "below" if span.stable_below else "above"]


def _format_theory(span: StabilityEdge | None, value: float | None) -> list[str]:
    """Returns two table cells: a theoretical edge, and its difference from the measured edge.

    Args:
        span: The measured edge. If `None`, there is no difference to show.
        value: The theoretical edge. If `None`, both cells are "-".
    """
    if value is None:
        return ["-", "-"]
    difference = "-" if span is None else f"{100.0 * (value / span.middle - 1.0):+.2f} %"
    return [f"{value:.5g}", difference]
