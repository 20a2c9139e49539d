"""A sweep that was asked for: which experiment, over which values, with which laws and seeds.

Law: what cannot run is refused before anything does; cells are numbered row by row, and a cell is a function
of the plan and its number.
"""

import math
import tomllib
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ScenarioError, UsageError
from ..scenario import Scenario, override
from ..scenario.laws import LAWS
from ..scenario.reader import written_text
from ..scenario.tables import nearest
from . import judging
from .axis import Axis, axis
from .cell import Cell, Task, Written

MOST_SEEDS = 100_000
LONGEST = 8.0
"""A cell that is undecided runs at most so many times as long as the scenario does, unless told otherwise."""
MOST_S = 86_400.0
"""No scenario is longer, s."""
_LOOKED_AT = 32
"""So many values of an axis are tried before anything runs."""


class Plan(NamedTuple):
    """A sweep.

    Attributes:
        written: the experiment, as its author wrote it.
        base: the same, resolved.
        axes: what is swept; the last changes fastest.
        laws: swept around the axes, slowest; none: the experiment's own.
        law_overrides: per law what puts it into force.
        seeds: of the runs of a cell in which anything is random; in others the first alone is run.
        longest_s: how long a cell may be extended, s.
    """

    written: Written
    base: Scenario
    axes: tuple[Axis, ...]
    laws: tuple[str, ...]
    law_overrides: tuple[tuple[str, ...], ...]
    seeds: tuple[int, ...]
    longest_s: float

    @property
    def shape(self) -> tuple[int, ...]:
        """How many laws (1 where none is swept), and how many values along every axis."""
        return (max(1, len(self.laws)), *(len(one.texts) for one in self.axes))

    @property
    def cells(self) -> int:
        """How many cells there are."""
        return math.prod(self.shape)

    def cell(self, number: int) -> Cell:
        """Returns a cell by its number.

        Raises:
            UsageError: there is none of that number.
        """
        if not 0 <= number < self.cells:
            raise UsageError(f"there is no cell {number}: they are numbered from 0 to {self.cells - 1}")
        places = []
        rest = number
        for count in reversed(self.shape):
            rest, place = divmod(rest, count)
            places.append(place)
        return self.cell_at(places[::-1])

    def cell_at(self, places: Sequence[int]) -> Cell:
        """Returns a cell by its place: number of the law (0 where none is swept), then along every axis."""
        number = 0
        for count, place in zip(self.shape, places, strict=True):
            number = number * count + place
        law, *others = places
        return Cell(
            number,
            self.laws[law] if self.laws else "",
            tuple(one.value(n) for one, n in zip(self.axes, others, strict=True)),
            (
                *(self.law_overrides[law] if self.laws else ()),
                *(one.override(n) for one, n in zip(self.axes, others, strict=True)),
            ),
        )

    def task(self, number: int, seed: int) -> Task:
        """Returns one run of a cell, to be made."""
        return Task(self.written, number, self.cell(number).overrides, seed, self.longest_s)

    def facts(self) -> dict[str, Any]:
        """Returns all that names it, as plain values; `plan_of` reads them."""
        return {
            "source": self.written.source,
            "folder": self.written.folder,
            "overrides": list(self.written.overrides),
            "over": [one.asked for one in self.axes],
            "laws": list(self.laws),
            "seeds": list(self.seeds),
            "longest_s": self.longest_s,
            "name": self.base.name,
            "scenario_sha256": self.base.sha256,
            "text": self.written.text,
        }


def plan(
    source: str | Path,
    overrides: Sequence[str] = (),
    *,
    over: Sequence[str] = (),
    seeds: int | Sequence[int] = 1,
    laws: Sequence[str] = (),
    longest_s: float | None = None,
) -> Plan:
    """Returns a sweep, checked and ready to run.

    Args:
        source: the name of a shipped scenario, or a path.
        overrides: what is to be changed of it everywhere, as texts KEY=VALUE.
        over: the axes, as "link.delay_ms=0:1600:50" or "link.order=newest,in_order".
        seeds: how many, from the scenario's own on; or which.
        laws: names of laws, swept besides the axes. One that all sites have stays with the gains of the
            scenario; another one replaces the law of every site, with its default gains. Overrides of gains
            count for either.
        longest_s: how long an undecided cell may be extended, s; by default eight times its duration.

    Raises:
        ScenarioError: the scenario, an axis or one of its values cannot be right, or cannot run.
        UsageError: another argument cannot be right.
    """
    text, folder = written_text(source)
    written = Written(str(source), text, str(folder), tuple(overrides))
    base = written.scenario()
    axes = tuple(map(axis, over))
    _refuse_twice(axes, laws)
    chosen = tuple(dict.fromkeys(laws))
    found = Plan(
        written,
        base,
        axes,
        chosen,
        tuple(_law_overrides(written, base, law) for law in chosen),
        _seeds(seeds, base.seed),
        _longest_s(longest_s, base),
    )
    for law in range(found.shape[0]):
        _refuse_unfit(found, law)
    return found


def plan_of(facts: dict[str, Any]) -> Plan:
    """Returns the plan that was kept as facts, from its own text; files that it names are read again.

    Raises:
        ScenarioError: it cannot run here.
    """
    written = Written(facts["source"], facts["text"], facts["folder"], tuple(facts["overrides"]))
    base = written.scenario()
    return Plan(
        written,
        base,
        tuple(map(axis, facts["over"])),
        tuple(facts["laws"]),
        tuple(_law_overrides(written, base, law) for law in facts["laws"]),
        tuple(facts["seeds"]),
        facts["longest_s"],
    )


def _refuse_twice(axes: Sequence[Axis], laws: Sequence[str]) -> None:
    keys = [one.key for one in axes]
    for n, key in enumerate(keys):
        if key in keys[:n]:
            raise ScenarioError("is swept twice: give one --over with all its values", path=key)
    if laws and "control.law" in keys:
        raise ScenarioError("is swept twice: give either --law or --over control.law", path="control.law")


def _seeds(asked: int | Sequence[int], own: int) -> tuple[int, ...]:
    if isinstance(asked, int):
        if not 1 <= asked <= MOST_SEEDS:
            raise UsageError(f"--seeds is how many, 1 to {MOST_SEEDS}, or which, as in 1..20; not {asked}")
        asked = range(own, own + asked)
    if len(asked) > MOST_SEEDS:
        raise UsageError(f"{len(asked)} seeds are more than {MOST_SEEDS}")
    for seed in asked:
        if not 0 <= seed < 2**63:
            raise UsageError(f"a seed is from 0 to 2^63 - 1, not {seed}")
    return tuple(dict.fromkeys(asked)) or (own,)


def _longest_s(asked: float | None, base: Scenario) -> float:
    if asked is None:
        return min(MOST_S, LONGEST * base.duration_s)
    if not base.duration_s <= asked <= MOST_S:
        raise UsageError(
            f"--longest is how long an undecided cell may run, from its {base.duration_s:g} s to "
            f"{MOST_S:g} s, not {asked:g}"
        )
    return asked


def _law_overrides(written: Written, base: Scenario, law: str) -> tuple[str, ...]:
    """Returns what puts a law into force at every site."""
    ours = [name for name in LAWS if name != "own"]
    if law not in ours:
        outside = ":" in law or law == "own"
        why = "laws from outside are not swept" if outside else f"there is no law {law!r}"
        hint = nearest(law, ours) or f"; laws are {', '.join(ours)}"
        raise UsageError(f"--law: {why}{hint}")
    if all(spec.control.__struct_config__.tag == law for spec in base.sites.values()):
        return ()
    tables = tomllib.loads(written.text)
    override(tables, written.overrides)
    own = [name for name, site in tables["sites"].items() if "control" in site]
    return (f"control.law={law}", *(f"sites.{name}.control.law={law}" for name in own))


def _refuse_unfit(asked: Plan, law: int) -> None:
    """Refuses an axis with a value that makes no scenario or no difference, and corners that cannot run."""
    origin = [law] + [0] * len(asked.axes)
    for n, one in enumerate(asked.axes, 1):
        seen: dict[str, str] = {}
        for place in _some(len(one.texts)):
            scenario = _checked(asked, [*origin[:n], place, *origin[n + 1 :]])
            text = one.texts[place]
            if scenario.sha256 in seen:
                raise ScenarioError(
                    f"{seen[scenario.sha256]} and {text} are the same experiment: nothing here follows this "
                    "key; a site or link may have one of its own, as in sites.NAME.control or links.A->B",
                    path=one.key,
                    source=asked.written.source,
                )
            seen[scenario.sha256] = text
    ends = [(law,), *(sorted({0, len(one.texts) - 1}) for one in asked.axes)]
    for places in product(*ends):
        _checked(asked, places)


def _checked(asked: Plan, places: Sequence[int]) -> Scenario:
    """Returns the scenario of a cell.

    Raises:
        ScenarioError: there is none, or it cannot run here; says with which law where several are swept.
    """
    cell = asked.cell_at(places)
    try:
        scenario = asked.written.scenario(*cell.overrides)
        judging.check_sweepable(scenario)
    except ScenarioError as error:
        problem = f"with law {cell.law}: {error.problem}" if cell.law else error.problem
        raise ScenarioError(problem, path=error.path, source=asked.written.source) from None
    return scenario


def _some(count: int) -> Iterator[int]:
    """Yields the first, the last, and some between them."""
    few = min(count, _LOOKED_AT)
    return (n * (count - 1) // max(1, few - 1) for n in range(few))
