"""Stability margins.

Per grid point the edges along one key by a scan and bisection, with the edges of theory, as a
table, a Markdown page and plain values.

Invariant: an edge lies between two values that were run, one stable and one not. Undecided
values widen it and count for neither side; every edge that the scan sees is kept. The margin of
a grid point is a function of its scenario, its seed and the range.
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
from .stability_map import StableInterval, evaluate_criterion, find_criterion_edge
from .sweep_plan import (
    SweepCell,
    SweepPlan,
    build_sweep_command,
    format_override,
    format_override_value,
    label_axis,
)

SCAN_POINTS = 9
"""Values of the scan: islands that are wider than an eighth of the range are seen."""
MARGIN_TOLERANCE = 0.005
_MOST = 60

StabilityTest = Callable[[float], bool | None]
"""Returns True if a run at a value is stable, None if undecided."""


class KeyMargin(NamedTuple):
    """Edges along one key.

    Attributes:
        spans: the edges, from below; none where nothing changes, more than one where the scan
            saw islands.
        stable: where there is no edge, whether all that was decided is stable; None where
            nothing was.
        undecided: how many values stayed undecided.
        runs: how many values were run.
    """

    spans: tuple[StableInterval, ...]
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
        high: the last one.
        tolerance: how wide an edge may be, over its value.
        whole: whether only whole numbers can be run.
    """
    known: dict[float, bool | None] = {}

    def ask(value: float) -> bool | None:
        if value not in known:
            known[value] = stable(value)
        return known[value]

    scan = np.linspace(low, high, SCAN_POINTS)
    values = list(dict.fromkeys((np.round(scan) if whole else scan).tolist()))
    decided = [value for value in values if ask(value) is not None]
    spans = tuple(
        _narrowed(ask=ask, low=a, high=b, tolerance=tolerance, whole=whole)
        for a, b in pairwise(decided)
        if known[a] != known[b]
    )
    everywhere = known[decided[0]] if decided and not spans else None
    return KeyMargin(spans, everywhere, sum(one is None for one in known.values()), len(known))


def _narrowed(
    ask: StabilityTest, low: float, high: float, tolerance: float, whole: bool
) -> StableInterval:
    first = ask(low)
    last = ask(high)
    low, above = _halved(
        holds=lambda value: ask(value) is first,
        low=low,
        high=high,
        tolerance=tolerance,
        whole=whole,
    )
    sharp = ask(above) is not None
    if sharp:
        high = above
    else:
        _, high = _halved(
            holds=lambda value: ask(value) is not last,
            low=above,
            high=high,
            tolerance=tolerance,
            whole=whole,
        )
    return StableInterval(low, high, first is True, sharp)


def _halved(
    holds: Callable[[float], bool], low: float, high: float, tolerance: float, whole: bool
) -> tuple[float, float]:
    for _ in range(_MOST):
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
    """Where edges are looked for; `tolerance`: how wide an edge may be, over its value."""

    key: str
    low: float
    high: float
    tolerance: float


class MarginItem(NamedTuple):
    """A grid point to be searched: picklable, and all that a process needs."""

    plan: SweepPlan
    cell: SweepCell
    seed: int
    range: SearchRange

    def __str__(self) -> str:
        return f"the search at {', '.join(self.cell.overrides) or 'the scenario'}, seed {self.seed}"


class GridPointMargin(NamedTuple):
    """A grid point that was searched.

    Attributes:
        cell: the grid point; its values lie along the axes.
        seed: of its runs.
        margin: what the runs show.
        linear: where the linear analysis has edges in the range, from below.
        remark: what is to be known of those, or "".
        closed: where the criterion in closed form has its edge; None where it has none in the
            range.
    """

    cell: SweepCell
    seed: int
    margin: KeyMargin
    linear: tuple[float, ...]
    remark: str
    closed: float | None


def parse_search_range(text: str, tolerance: float = MARGIN_TOLERANCE) -> SearchRange:
    """Returns the range that a text such as "control.d=0.2:3" names.

    Raises:
        UsageError: it names none.
    """
    key, _, ends = text.partition("=")
    low, colon, high = ends.partition(":")
    try:
        found = SearchRange(key.strip(), float(low), float(high), tolerance)
    except ValueError:
        raise UsageError(
            f"--margin reads KEY=FROM:TO, as in control.d=0.2:3, not {text!r}"
        ) from None
    if not 0.0 < tolerance < 1.0:
        raise UsageError(
            f"--tolerance is a share of the edge's value, as in 0.005, not {tolerance:g}"
        )
    if not colon or not found.key or not -float("inf") < found.low < found.high < float("inf"):
        form = "KEY=FROM:TO with FROM below TO, as in control.d=0.2:3"
        raise UsageError(f"--margin reads {form}, not {text!r}")
    return found


def format_range_axis(found: SearchRange) -> str:
    """Returns a range as an axis of its two ends: a plan with it has been checked at both."""
    return f"{found.key}={format_override_value(found.low)},{format_override_value(found.high)}"


def search_margins(
    plan: SweepPlan,
    within: SearchRange,
    jobs: int | None = None,
    progress: Progress = ignore_progress,
    on: Workers = None,
) -> list[GridPointMargin]:
    """Returns the edges of every place of a plan and every seed.

    Raises:
        ScenarioError: some value makes no scenario.
        RunFailed: a process was ended.
    """
    searches = []
    for number in range(0, plan.cells, 2):  # the last axis has the two ends of the range
        end = plan.cell(number)
        cell = end._replace(values=end.values[:-1], overrides=end.overrides[:-1])
        seeds = plan.seeds if plan.scenario(*end.overrides).random else plan.seeds[:1]
        searches += [MarginItem(plan, cell, seed, within) for seed in seeds]
    laws = list_imported_code([plan.base])
    with open_worker_pool(jobs, on, most=len(searches), laws=laws) as pool:
        return pool.map(search_margin_task, searches, progress)


def search_margin_task(task: MarginItem) -> GridPointMargin:
    """Searches one grid point, and asks theory for the same.

    Raises:
        ScenarioError: some value makes no scenario.
    """
    key, low, high, tolerance = task.range

    def at(value: float) -> Scenario:
        more = format_override(key, value), f"seed={task.seed}"
        return task.plan.scenario(*task.cell.overrides, *more)

    def stable(value: float) -> bool | None:
        scenario = at(value)
        longest_s = max(task.plan.longest_s, scenario.duration_s)
        return sweep_cell.classify_cell(scenario.text, longest_s).verdict.stable

    try:
        at(low + (high - low) / 3.0**0.5)
        whole = False
    except ScenarioError:  # the key takes whole numbers only
        whole = True
    margin = search_key_margin(stable, low, high, tolerance, whole=whole)
    closed = find_criterion_edge(lambda value: evaluate_criterion(at(value)), low, high)
    linear, remark = find_root_crossings(at(high), key, low, high)
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
    """The edges of every place of a plan and every seed, in a range along one key."""

    plan: SweepPlan
    within: SearchRange
    found: list[GridPointMargin]

    @property
    def command(self) -> str:
        """The command that searches them."""
        key, *numbers = self.within
        low, high, tolerance = map(format_override_value, numbers)
        words = ["--margin", f"{key}={low}:{high}", "--tolerance", tolerance]
        return build_sweep_command(self.plan._replace(axes=self.plan.axes[:-1]), *words)

    def table(self) -> TextTable:
        """Returns a row per edge, or per place that has none."""
        plan = self.plan
        axes = self.plan.axes[:-1]
        seeds = len({one.seed for one in self.found}) > 1
        closed = any(one.closed is not None for one in self.found)
        heads = [
            *(label_axis(axis.key, plan.base) for axis in axes),
            *(["law"] if plan.laws else []),
        ]
        heads += [
            *(["seed"] if seeds else []),
            f"edge of {label_axis(self.within.key, plan.base)}",
        ]
        heads += ["stable is", "linear", "difference"]
        heads += [*(["closed form", "difference"] if closed else []), "runs"]
        rows = []
        for one in self.found:
            place = [
                value if isinstance(value, str) else f"{value:g}" for value in one.cell.values
            ]
            place += [
                *([one.cell.law] if plan.laws else []),
                *([str(one.seed)] if seeds else []),
            ]
            for span in one.margin.spans or (None,):
                near = self.within.low if span is None else span.middle
                linear = _find_nearest(near, one.linear)
                cells = [*place, *_edge_cells(one.margin, span), *_theory_cells(span, linear)]
                cells += _theory_cells(span, one.closed) if closed else []
                rows.append((*cells, str(one.margin.runs)))
        return TextTable(tuple(heads), rows)

    def blocks(self) -> Iterator[TextTable]:
        """Yields its text."""
        yield self.table()

    def headline(self) -> str:
        """Returns how many edges were found where."""
        edges = sum(len(one.margin.spans) for one in self.found)
        low = self.within.low
        high = self.within.high
        return (
            f"{self.plan.base.name}: {count_nouns(edges, 'edge')} of {self.within.key} "
            f"from {low:g} to {high:g}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat sweep --margin --json`."""
        keys = [axis.key for axis in self.plan.axes[:-1]]
        return {
            "command": self.command,
            "scenario_sha256": self.plan.base.sha256,
            **self.within._asdict(),
            "places": [
                {
                    **dict(zip(keys, one.cell.values, strict=True)),
                    **({"law": one.cell.law} if self.plan.laws else {}),
                    "seed": one.seed,
                    "edges": [span._asdict() for span in one.margin.spans],
                    "stable_everywhere": one.margin.stable,
                    "undecided": one.margin.undecided,
                    "runs": one.margin.runs,
                    "linear": list(one.linear),
                    "closed_form": one.closed,
                    "remark": one.remark,
                }
                for one in self.found
            ],
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per edge, or per place that has none."""
        return [
            {**{key: one for key, one in place.items() if not isinstance(one, list)}, **edge}
            for place in self.to_dict()["places"]
            for edge in place["edges"] or [{}]
        ]

    def page(self) -> str:
        """Returns them as a page in Markdown."""
        base = self.plan.base
        parts = [f"# {base.title or base.name}: margin", f"```sh\n{self.command}\n```"]
        parts.append(self.table().markdown())
        remarks = dict.fromkeys(one.remark for one in self.found if one.remark)
        parts += [f"{remark[0].upper()}{remark[1:]}." for remark in remarks]
        if islands := sum(len(one.margin.spans) > 1 for one in self.found):
            where = f"in {islands} of {count_nouns(len(self.found), 'place')}"
            parts.append(f"Stability is not monotone {where}: they have several edges.")
        fixed = "; ".join(describe_fixed_gains(self.plan))
        advice = FAIR_COMPARISON.replace("trilat compare --tune", "`trilat compare --tune`")
        parts.append(f"Gains that were not swept: {fixed}. {advice[0].upper()}{advice[1:]}.")
        return "\n\n".join(parts) + "\n"

    def write(self, folder: Path) -> list[Path]:
        """Writes margin.json and margin.md, and returns their paths."""
        paths = [folder / "margin.json", folder / "margin.md"]
        write_whole(paths[0], json.dumps(self.to_dict(), indent=2, allow_nan=False) + "\n")
        write_whole(paths[1], self.page())
        return paths


def _edge_cells(margin: KeyMargin, span: StableInterval | None) -> list[str]:
    if span is None:
        words = {
            True: "none: all stable",
            False: "none: nothing stable",
            None: "none: nothing decided",
        }
        return [words[margin.stable], "-"]
    digits, blur = (5, "") if span.sharp else (4, " (undecided between)")
    place = f"{span.low:.{digits}g} to {span.high:.{digits}g}{blur}"
    return [place, "below" if span.stable_below else "above"]


def _theory_cells(span: StableInterval | None, value: float | None) -> list[str]:
    if value is None:
        return ["-", "-"]
    difference = "-" if span is None else f"{100.0 * (value / span.middle - 1.0):+.2f} %"
    return [f"{value:.5g}", difference]
