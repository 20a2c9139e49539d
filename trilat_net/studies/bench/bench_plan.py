"""The plan of the suite: its cells with their gains, in the order in which they run.

Invariant: a plan is a function of the study, what is chosen of it, and the tuned gains; what cannot be right
is refused before the first run.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import NamedTuple

from ...errors import UsageError
from ...fields import suggest_nearest
from ...scenario.laws import BUILT_IN
from ..tuning.candidate import TuningScenario, load_tuning_scenario
from ..tuning.search_space import SEARCH_SPACES
from .bench_gains import KNOWLEDGE, TunedGains, choose_round_trip, name_settings, read_gains
from .bench_tasks import BASES, LINKS, STUDIES, TASKS, BenchStudy, build_settings

MAX_BENCH_SEEDS = 1000


class BenchCell(NamedTuple):
    """One law in a task over a link; with the gains that it has there."""

    task: str
    law: str
    link: str
    form: str
    tuned: TunedGains
    seeds: tuple[int, ...]

    @property
    def name(self) -> str:
        """Its name in results."""
        return f"{self.task}/{self.law}/{self.link}"

    @property
    def inputs(self) -> str:
        """A digest of what its runs are made of: the scenario, task, link and gains."""
        parts = (_base_text(self.form), build_settings(self.form, self.task, self.link), self.tuned)
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:12]

    @property
    def key(self) -> str:
        """What its runs are called in the journal, see `BenchRun.cell`."""
        return f"{self.name} {self.inputs}"

    def build(self, seed: int) -> TuningScenario:
        """Returns the experiment of one of its runs."""
        settings = name_settings(build_settings(self.form, self.task, self.link, seed))
        return load_tuning_scenario(BASES[self.form], settings).with_gains(
            SEARCH_SPACES[self.law], KNOWLEDGE, self.tuned.gains
        )


class BenchPlan(NamedTuple):
    """The suite, or a part of it, ready to run.

    Attributes:
        study: its name.
        cells: in the order in which they run.
        laws: all that were asked for, with their forms: those without cells have empty rows.
        without: of the gains in question those of which there are none.
    """

    study: str
    cells: list[BenchCell]
    laws: Sequence[tuple[str, str]]
    without: Sequence[TunedGains] = ()

    @property
    def runs(self) -> int:
        """How many runs there are."""
        return sum(len(cell.seeds) for cell in self.cells)

    def cell(self, name: str) -> BenchCell:
        """Returns a cell by its name, as in contact/wave/rtt272.

        Raises:
            UsageError: there is none of that name.
        """
        names = {cell.name: cell for cell in self.cells}
        if name not in names:
            hint = suggest_nearest(name, list(names)) or f"; the first is {next(iter(names))}"
            raise UsageError(f"there is no cell {name!r}{hint}")
        return names[name]


@cache
def _base_text(form: str) -> str:
    return load_tuning_scenario(BASES[form]).scenario.text


def plan_bench(
    study: str = "full",
    *,
    tasks: Sequence[str] = (),
    laws: Sequence[str] = (),
    links: Sequence[str] = (),
    seeds: int | None = None,
) -> BenchPlan:
    """Returns the suite, checked and ready to run.

    Args:
        study: "full", "small" or "round-trips".
        tasks: which of the study's; none: all.
        laws: the same.
        links: the same; one that only the full study has may be named too.
        seeds: of runs in which anything is drawn; None: as many as the study has.

    Raises:
        UsageError: there is no such study, task, law or link, or no gains for a law.
    """
    asked = STUDIES[_choose("study", study, list(STUDIES))]
    if seeds is not None and not 1 <= seeds <= MAX_BENCH_SEEDS:
        raise UsageError(f"--seeds is how many, 1 to {MAX_BENCH_SEEDS}, not {seeds}")
    known = [law for laws_of_form in asked.laws.values() for law in laws_of_form]
    chosen_tasks = [_choose("task", name, list(asked.tasks)) for name in tasks] or list(asked.tasks)
    chosen_laws = [_choose("law", name, known) for name in laws] or known
    chosen_links = [_choose("link", name, list(LINKS)) for name in links] or list(asked.links)
    count = asked.seeds if seeds is None else seeds
    listed = list(_list_cells(asked, chosen_tasks, chosen_laws, chosen_links, count))
    cells = [cell for cell in listed if cell.tuned.gains]
    without = {str(cell.tuned): cell.tuned for cell in listed if not cell.tuned.gains}
    if not cells:
        names = ", ".join(chosen_tasks)
        why = (
            f"no candidate was stable for {', '.join(without)}" if without else f"{names} asks for two users"
        )
        raise UsageError(f"{', '.join(chosen_laws)}: {why}, or hands over; choose another task or link")
    rows = [(law, form) for form, laws in asked.laws.items() for law in laws if law in chosen_laws]
    return BenchPlan(study, cells, rows, list(without.values()))


def explain_no_cell(law: str, form: str, task: str) -> str:
    """Returns why a law does not run in a task, in the word of the tables; "no gains" if only they lack."""
    if TASKS[task].users > 1 and form != "three":
        return "-"
    fixed = "timeline" in TASKS[task].settings and BUILT_IN[law].Settings.fixed_shares
    return "no handover" if fixed else "no gains"


def _list_cells(
    study: BenchStudy, tasks: Sequence[str], laws: Sequence[str], links: Sequence[str], seeds: int
) -> Iterator[BenchCell]:
    gains = read_gains()
    facts = {link: _describe_link(link) for link in links}
    for form, laws_of_form in study.laws.items():
        for law in (law for law in laws_of_form if law in laws):
            for task in (task for task in tasks if explain_no_cell(law, form, task) == "no gains"):
                for link, (random, mean_ms) in facts.items():
                    tuned = _find_gains(gains, form, law, choose_round_trip(2.0 * mean_ms))
                    chosen = tuple(range(1, 1 + (seeds if random else 1)))
                    yield BenchCell(task, law, link, form, tuned, chosen)


def _describe_link(link: str) -> tuple[bool, float]:
    """Returns if anything of a link is drawn, and its mean delay one way, ms."""
    scenario = load_tuning_scenario(BASES["two"], name_settings({"link": dict(LINKS[link])})).scenario
    first = next(iter(scenario.links.values()))
    return scenario.random, first.moments().mean_ms


def _find_gains(
    gains: Mapping[tuple[str, str, int], TunedGains], form: str, law: str, round_trip_ms: int
) -> TunedGains:
    found = gains.get((form, law, round_trip_ms))
    if found is None:
        raise UsageError(
            f"there are no gains of {law} for {round_trip_ms} ms; make them: trilat bench --tune --law {law}"
        )
    return found


def _choose(option: str, name: str, known: Sequence[str]) -> str:
    if name not in known:
        hint = suggest_nearest(name, list(known)) or f"; there are {', '.join(known)}"
        raise UsageError(f"--{option}: there is no {option} {name!r} in it{hint}")
    return name
