"""Margins over a plane: per place of the other axes the edge along one key, and what theory says of it.

Law: a place is a function of its scenario, its seed and the range; places are searched each by itself, in
whatever process, and come back in their order.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..errors import ScenarioError, UsageError
from ..scenario import Scenario
from ..workers import cores
from . import judging
from .cell import Cell, Written
from .chart import number, override
from .crew import crew
from .criterion import criterion
from .line import met
from .margin import TOLERANCE, Margin, margin
from .plan import Plan
from .root import crossings


class Range(NamedTuple):
    """Where edges are looked for.

    Attributes:
        key: along which key, dotted.
        low: from.
        high: to.
        tolerance: how wide an edge may be, over its value.
    """

    key: str
    low: float
    high: float
    tolerance: float


class Search(NamedTuple):
    """One place to be searched: picklable, and all that a process needs."""

    written: Written
    overrides: tuple[str, ...]
    seed: int
    longest_s: float
    range: Range


Told = tuple[Margin, tuple[float, ...], str, float | None]
"""Margin, linear edges, what is to be known of them, edge in closed form."""


class Found(NamedTuple):
    """One place that was searched.

    Attributes:
        cell: the place; its values lie along the axes.
        seed: of its runs.
        margin: what the runs show.
        linear: where the linear analysis has edges in the range, from below.
        remark: what is to be known of those, or "".
        closed: where the condition in closed form has its edge; None where it has none in the range.
    """

    cell: Cell
    seed: int
    margin: Margin
    linear: tuple[float, ...]
    remark: str
    closed: float | None


def search_range(asked: str, tolerance: float = TOLERANCE) -> Range:
    """Returns the range that a text such as "control.d=0.2:3" names.

    Raises:
        UsageError: it names none.
    """
    key, _, text = asked.partition("=")
    low, colon, high = text.partition(":")
    try:
        found = Range(key.strip(), float(low), float(high), tolerance)
    except ValueError:
        raise UsageError(f"--margin reads KEY=FROM:TO, as in control.d=0.2:3, not {asked!r}") from None
    if not 0.0 < tolerance < 1.0:
        raise UsageError(f"--tolerance is a share of the edge's value, as in 0.005, not {tolerance:g}")
    if not colon or not found.key or not -float("inf") < found.low < found.high < float("inf"):
        raise UsageError(
            f"--margin reads KEY=FROM:TO with FROM below TO, as in control.d=0.2:3, not {asked!r}"
        )
    return found


def range_axis(found: Range) -> str:
    """Returns a range as an axis of its two ends: a plan with it has been checked at both."""
    return f"{found.key}={number(found.low)},{number(found.high)}"


def margins(
    asked: Plan,
    within: Range,
    jobs: int | None = None,
    progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[Found]:
    """Returns the edges of every place of a plan and every seed.

    Args:
        asked: the plan; its last axis is the two ends of the range.
        within: the range.
        jobs: in how many processes; None for one per core.
        progress: told how many places are done, and how many there are.

    Raises:
        ScenarioError: some value makes no scenario.
        RunFailed: a process was ended.
    """
    cells = [asked.cell(first) for first in range(0, asked.cells, 2)]
    places = [(cell, seed) for cell in cells for seed in _seeds(asked, cell)]
    searches = [
        Search(asked.written, cell.overrides[:-1], seed, asked.longest_s, within) for cell, seed in places
    ]
    found: dict[int, Found] = {}
    with crew(min(jobs or cores(), len(searches))) as hands:
        for n, told in hands.each(search, searches):
            cell, seed = places[n]
            found[n] = Found(cell._replace(values=cell.values[:-1]), seed, *told)
            progress(len(found), len(searches))
    return [found[n] for n in range(len(searches))]


def _seeds(asked: Plan, cell: Cell) -> Sequence[int]:
    """Returns the seeds of a place: one alone where nothing is random."""
    return asked.seeds if asked.written.scenario(*cell.overrides).random else asked.seeds[:1]


def search(one: Search) -> Told:
    """Searches one place, and asks theory for the same.

    Raises:
        ScenarioError: some value makes no scenario.
    """
    within = one.range

    def at(value: float) -> Scenario:
        return one.written.scenario(*one.overrides, override(within.key, value), f"seed={one.seed}")

    def stable(value: float) -> bool | None:
        return judging.judge(at(value).text, max(one.longest_s, at(value).duration_s)).verdict.stable

    whole = not _fractions(at, within)
    found = margin(stable, within.low, within.high, within.tolerance, whole=whole)
    closed = met(lambda value: criterion(at(value)), within.low, within.high)
    return found, *crossings(at(within.high), within.key, within.low, within.high), closed


def _fractions(at: Callable[[float], Scenario], within: Range) -> bool:
    """Whether a key can have values between whole numbers."""
    try:
        at(within.low + (within.high - within.low) / 3.0**0.5)
    except ScenarioError:
        return False
    return True
