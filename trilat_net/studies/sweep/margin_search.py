"""Searches stability margins: the edges of stability along one key.

Each grid point is scanned along the key, and each edge narrowed by bisection. The edges are
reported beside those of theory, as a table, a Markdown page and plain values.

Invariant:
    - An edge lies between two values that were run, one stable and one not.
    - Undecided values widen an edge and count for neither side.
    - All edges that the scan detects are kept.
    - The margin of a grid point is a function of its scenario, its seed and the range.
"""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ...errors import ScenarioError, UsageError, count_nouns
from ...files import write_whole
from ...reporting.result_text import TextTable
from ...results import Result
from ...scenario import Scenario
from ...scenario.code_consent import list_imported_code
from ...theory.linear_edge import find_root_crossings
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from . import sweep_cell
from .fixed_gains import FAIR_COMPARISON, describe_fixed_gains
from .stability_map import StabilityEdge, evaluate_criterion, find_criterion_edge
from .sweep_plan import (
    SweepCell,
    SweepPlan,
    build_sweep_command,
    format_override,
    format_override_value,
    label_axis,
)

SCAN_POINTS = 9
"""Number of values of the scan: it detects islands wider than an eighth of the range."""
MARGIN_TOLERANCE = 0.005
"""Default largest width of an edge, as a share of its value."""
_MAX_HALVINGS = 60

StabilityTest = Callable[[float], bool | None]
"""Returns True if the run at a value is stable, False if it is not, None if it is undecided."""


class KeyMargin(NamedTuple):
    """The edges of stability along one key.

    Attributes:
        spans: the edges, in rising order: several if the scan detected islands.
        stable: without edges, True if the decided values are stable, False if they are not;
            None with edges, or if no value was decided.
        undecided: number of undecided values.
        runs: number of values that were run.
    """

    spans: tuple[StabilityEdge, ...]
    stable: bool | None
    undecided: int
    runs: int


def search_key_margin(
    stable: StabilityTest,
    low: float,
    high: float,
    tolerance: float = MARGIN_TOLERANCE,
    *,
    whole: bool = False,
) -> KeyMargin:
    """Returns the edges between two values.

    Args:
        stable: runs and classifies one value.
        low: the first value of the range.
        high: the last value of the range.
        tolerance: largest width of an edge, as a share of its value.
        whole: True if only whole numbers can be run.
    """
    results: dict[float, bool | None] = {}

    def classify(value: float) -> bool | None:
        if value not in results:
            results[value] = stable(value)
        return results[value]

    scan = np.linspace(low, high, SCAN_POINTS)
    if whole:
        scan = np.round(scan)
    values = list(dict.fromkeys(scan.tolist()))
    decided = [value for value in values if classify(value) is not None]
    spans = list[StabilityEdge]()
    for below, above in pairwise(decided):
        if results[below] != results[above]:
            spans.append(_narrow_edge(classify, below, above, tolerance=tolerance, whole=whole))
    stable_everywhere = results[decided[0]] if decided and not spans else None
    undecided = sum(result is None for result in results.values())
    return KeyMargin(tuple(spans), stable_everywhere, undecided, len(results))


def _narrow_edge(
    classify: StabilityTest, low: float, high: float, *, tolerance: float, whole: bool
) -> StabilityEdge:
    """Returns the edge between two values that were decided differently."""
    low_stable = classify(low)
    high_stable = classify(high)

    def is_low_side(value: float) -> bool:
        return classify(value) is low_stable

    def is_not_high_side(value: float) -> bool:
        return classify(value) is not high_stable

    low, above = _bisect(is_low_side, low, high, tolerance=tolerance, whole=whole)
    sharp = classify(above) is not None
    if sharp:
        high = above
    else:  # an undecided zone: its upper end is searched by itself
        _, high = _bisect(is_not_high_side, above, high, tolerance=tolerance, whole=whole)
    return StabilityEdge(low, high, low_stable is True, sharp)


def _bisect(
    holds: Callable[[float], bool], low: float, high: float, *, tolerance: float, whole: bool
) -> tuple[float, float]:
    """Returns a narrow interval from a value where a condition holds to one where it does not.

    Args:
        holds: the condition; it holds at `low` and not at `high`.
        low: the first value.
        high: the last value.
        tolerance: largest width of the interval, as a share of its larger end.
        whole: True to bisect whole numbers, down to a width of 1.
    """
    for _ in range(_MAX_HALVINGS):
        if high - low <= (1.0 if whole else tolerance * max(abs(low), abs(high))):
            break
        middle = 0.5 * (low + high)
        middle = float(np.floor(middle)) if whole else middle
        if holds(middle):
            low = middle
        else:
            high = middle
    return low, high


class SearchRange(NamedTuple):
    """The range of a search for edges.

    Attributes:
        key: the scenario key along which edges are searched.
        low: the first value.
        high: the last value.
        tolerance: largest width of an edge, as a share of its value.
    """

    key: str
    low: float
    high: float
    tolerance: float


class MarginItem(NamedTuple):
    """Task of a worker: the search at one grid point. Picklable and self-contained."""

    plan: SweepPlan
    cell: SweepCell
    seed: int
    range: SearchRange

    def __str__(self) -> str:
        position = ", ".join(self.cell.overrides) or "the scenario"
        return f"the search at {position}, seed {self.seed}"


class GridPointMargin(NamedTuple):
    """The edges of stability at one grid point.

    Attributes:
        cell: the grid point, with its values along the axes.
        seed: the seed of its runs.
        margin: the edges from the runs.
        linear: the edges of the linear analysis in the range, in rising order.
        remark: a remark on the linear analysis, or "".
        closed: the edge of the closed-form criterion in the range, or None.
    """

    cell: SweepCell
    seed: int
    margin: KeyMargin
    linear: tuple[float, ...]
    remark: str
    closed: float | None


def parse_search_range(text: str, tolerance: float = MARGIN_TOLERANCE) -> SearchRange:
    """Returns the range that a text such as "control.d=0.2:3" describes.

    Raises:
        UsageError: the text describes no range, or the tolerance is not within (0, 1).
    """
    key, _, ends = text.partition("=")
    low, colon, high = ends.partition(":")
    try:
        search_range = SearchRange(key.strip(), float(low), float(high), tolerance)
    except ValueError:
        raise UsageError(
            f"--margin reads KEY=FROM:TO, as in control.d=0.2:3, not {text!r}"
        ) from None
    if not 0.0 < tolerance < 1.0:
        raise UsageError(
            f"--tolerance is a share of the edge's value, as in 0.005, not {tolerance:g}"
        )
    rising = -float("inf") < search_range.low < search_range.high < float("inf")
    if not colon or not search_range.key or not rising:
        form = "KEY=FROM:TO with FROM below TO, as in control.d=0.2:3"
        raise UsageError(f"--margin reads {form}, not {text!r}")
    return search_range


def format_range_axis(search_range: SearchRange) -> str:
    """Returns the description of an axis with the two ends of a range.

    Planning a sweep with this axis checks the scenario at both ends.
    """
    low = format_override_value(search_range.low)
    high = format_override_value(search_range.high)
    return f"{search_range.key}={low},{high}"


def search_margins(
    plan: SweepPlan,
    within: SearchRange,
    jobs: int | None = None,
    progress: Progress = ignore_progress,
    on: Workers = None,
) -> list[GridPointMargin]:
    """Returns the edges at each grid point of a plan and each seed.

    Args:
        plan: the plan; its last axis has the two ends of the range.
        within: the range.
        jobs: number of worker processes; None: as many as there are cores.
        progress: called with the number of finished and of all searches.
        on: the workers to use; None: processes of this computer.

    Raises:
        ScenarioError: the scenario is not valid at a value of the range.
        RunFailed: a worker process ended.
    """
    searches = []
    for number in range(0, plan.cells, 2):  # each grid point has two cells, one per end
        end = plan.cell(number)
        cell = end._replace(values=end.values[:-1], overrides=end.overrides[:-1])
        seeds = plan.seeds if plan.scenario(*end.overrides).random else plan.seeds[:1]
        searches += [MarginItem(plan, cell, seed, within) for seed in seeds]
    laws = list_imported_code([plan.base])
    with open_worker_pool(jobs, on, most=len(searches), laws=laws) as pool:
        return pool.map(search_margin_task, searches, progress)


def search_margin_task(task: MarginItem) -> GridPointMargin:
    """Returns the edges at one grid point, from runs and from theory.

    Raises:
        ScenarioError: the scenario is not valid at a value of the range.
    """
    key, low, high, tolerance = task.range

    def load(value: float) -> Scenario:
        override = format_override(key, value)
        return task.plan.scenario(*task.cell.overrides, override, f"seed={task.seed}")

    def stable(value: float) -> bool | None:
        scenario = load(value)
        longest_s = max(task.plan.longest_s, scenario.duration_s)
        return sweep_cell.classify_cell(scenario.text, longest_s).verdict.stable

    whole = False
    try:
        load(low + (high - low) / 3.0**0.5)  # not a whole number
    except ScenarioError:  # the key takes whole numbers only
        whole = True
    margin = search_key_margin(stable, low, high, tolerance, whole=whole)
    closed = find_criterion_edge(lambda value: evaluate_criterion(load(value)), low, high)
    linear, remark = find_root_crossings(load(high), key, low, high)
    return GridPointMargin(
        cell=task.cell,
        seed=task.seed,
        margin=margin,
        linear=linear,
        remark=remark,
        closed=closed,
    )


def _find_nearest(value: float, edges: Sequence[float]) -> float | None:
    """Returns the edge that is nearest to a value; None if there are no edges."""
    return min(edges, key=lambda edge: abs(edge - value), default=None)


@dataclass(frozen=True, repr=False)
class SweepMargins(Result):
    """The edges along one key, at each grid point of a plan and for each seed.

    Attributes:
        plan: the plan; its last axis has the two ends of the range.
        within: the range of the search.
        found: the edges of each grid point and seed.
    """

    plan: SweepPlan
    within: SearchRange
    found: list[GridPointMargin]

    @property
    def command(self) -> str:
        """The command that repeats the search."""
        low = format_override_value(self.within.low)
        high = format_override_value(self.within.high)
        tolerance = format_override_value(self.within.tolerance)
        search_range = f"{self.within.key}={low}:{high}"
        plan = self.plan._replace(axes=self.plan.axes[:-1])
        return build_sweep_command(plan, "--margin", search_range, "--tolerance", tolerance)

    def table(self) -> TextTable:
        """Returns a table with a row per edge, and a row per grid point without edges."""
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
        """Yields the table of the edges."""
        yield self.table()

    def headline(self) -> str:
        """Returns the number of edges and the range of the search, as a sentence."""
        edges = sum(len(point.margin.spans) for point in self.found)
        low = self.within.low
        high = self.within.high
        return (
            f"{self.plan.base.name}: {count_nouns(edges, 'edge')} of {self.within.key} "
            f"from {low:g} to {high:g}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat sweep --margin --json`."""
        return {
            "command": self.command,
            "scenario_sha256": self.plan.base.sha256,
            **self.within._asdict(),
            "places": [self._describe_point(point) for point in self.found],
        }

    def _describe_point(self, point: GridPointMargin) -> dict[str, Any]:
        """Returns the entry of a grid point in `to_dict`."""
        margin = point.margin
        facts: dict[str, Any] = {}
        for axis, value in zip(self.plan.axes[:-1], point.cell.values, strict=True):
            facts[axis.key] = value
        if self.plan.laws:
            facts["law"] = point.cell.law
        return facts | {
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
        """Returns a row per edge, and a row per grid point without edges."""
        rows = list[dict[str, Any]]()
        for point in self.to_dict()["places"]:
            columns = {
                key: value for key, value in point.items() if not isinstance(value, list)
            }
            edges = point["edges"] or [{}]
            rows.extend({**columns, **edge} for edge in edges)
        return rows

    def page(self) -> str:
        """Returns the margins as a page in Markdown."""
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
        """Writes margin.json and margin.md, and returns their paths."""
        json_path = folder / "margin.json"
        page_path = folder / "margin.md"
        write_whole(json_path, json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")
        write_whole(page_path, self.page())
        return [json_path, page_path]


def _format_edge(margin: KeyMargin, span: StabilityEdge | None) -> list[str]:
    """Returns the table cells of an edge and of its stable side."""
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
    """Returns the table cells of an edge of theory and of its relative difference."""
    if value is None:
        return ["-", "-"]
    difference = "-" if span is None else f"{100.0 * (value / span.middle - 1.0):+.2f} %"
    return [f"{value:.5g}", difference]
