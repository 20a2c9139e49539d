"""The results of the suite: its runs by place, as tables, as Markdown, as CSV and as JSON.

Invariant: a function of the runs alone, without a clock: equal results give equal bytes. A
number over seeds has its 95 % interval, and every run that is not stable shows. No law is
ranked.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ...analysis.run_end import EndBehaviour, Stability
from ...errors import count_nouns
from ...reporting.result_text import Block, TextTable, format_number
from ...results import Result
from ..intervals import MeanInterval, mean_interval, wilson_interval
from ..study_folder import encode_csv
from .bench_plan import STUDIES, TASKS, BenchCell, BenchPlan, explain_no_cell

LEAST_CONTACT_N = 1.0
"""A mean force of the wall below this, at the end, is no contact, N."""
PASSIVE_J = -1e-3
"""What hands, friction and wall have put into a passive run is never less, J."""
LONGEST_S = 100.0
"""No run is made longer; so long, too, is the one that refutes or confirms one that is not
stable, s.
"""


def name_run(key: str, to_s: float) -> str:
    """Returns what the runs of a cell are called in the journal; those that were made again, of
    their own.
    """
    return f"{key} to {to_s:g} s" if to_s else key


class BenchRun(msgspec.Struct, frozen=True):
    """One finished run of the suite.

    Attributes:
        name: of its cell, task/law/link.
        inputs: a digest of what the cell is made of.
        random: whether another seed would be another run.
        sha256: of its scenario.
        stability, behaviour: its judgement (docs/definitions.md), by its end and its twins.
        text: the judgement in words.
        length_s: how long the run was that is judged, s.
        to_s: it was made again for so long because it was not stable, s; 0: it was not.
        confirmed: whether that run was not stable either; None: there was none.
        bounded: no joint passed `BOUND_RAD_S`, or left its start by more than `THROWN_RAD`.
        energy_j: the least that hands, friction and wall had put in until any instant, J.
        settled_s: since when all arms stay where they end, s; None: not within the run.
        error_rad: RMS distance of the slave from its users, undelayed, weighted by dominance,
            over the time of the task; None where the run diverged, as the numbers below.
        effort_nm: RMS of tau - G(q) over sites and joints.
        hand_nm: RMS torque of the operators over joints, of the sites that have one.
        wall_n: mean force of the wall in the last quarter, N; None without a wall.
        force_peak_n: largest force of the wall, N.
        stiffness_n_m: what the user feels of the wall, by two reaches, N/m; None unless both
            come to rest.
    """

    name: str
    inputs: str
    seed: int
    random: bool
    sha256: str
    stability: Stability
    behaviour: EndBehaviour
    text: str
    length_s: float = 0.0
    to_s: float = 0.0
    confirmed: bool | None = None
    bounded: bool = False
    energy_j: float | None = None
    settled_s: float | None = None
    error_rad: float | None = None
    effort_nm: float | None = None
    hand_nm: float | None = None
    wall_n: float | None = None
    force_peak_n: float | None = None
    stiffness_n_m: float | None = None

    @property
    def cell(self) -> str:
        """Its cell, told apart from one of the same name with other gains, and from a longer
        run of it.
        """
        return name_run(f"{self.name} {self.inputs}", self.to_s)

    @property
    def doubtful(self) -> bool:
        """True if it is not stable, did not diverge, and is not as long as one that would
        confirm it.
        """
        diverged = self.behaviour is EndBehaviour.DIVERGED
        return (
            self.stability is Stability.NOT_STABLE
            and not diverged
            and self.length_s < LONGEST_S
        )

    @property
    def masked(self) -> bool:
        """True if it was to touch a wall, and did not: its numbers are those of free motion."""
        return self.wall_n is not None and self.wall_n < LEAST_CONTACT_N


QUANTITIES = {
    "error_rad": "RMS distance of the slave from its users, rad",
    "effort_nm": "effort, RMS of tau - G(q), N m",
    "hand_nm": "RMS torque of the hands, N m",
    "force_peak_n": "largest force of the wall, N",
    "stiffness_n_m": "stiffness at the user's hand, by two reaches, N/m",
    "settled_s": "since when all arms stay where they end, s",
}
"""The numbers of a run that are averaged over its seeds; those of runs without contact are
masked.
"""
LEAST_SEEDS = 20
"""Of fewer runs there is no interval."""


class BenchPlace(NamedTuple):
    """A cell with the runs of all its seeds."""

    cell: BenchCell
    runs: Sequence[BenchRun]

    @property
    def stable(self) -> int:
        """How many of its runs are stable."""
        return self.count(Stability.STABLE)

    def count(self, stability: Stability) -> int:
        """Returns how many of its runs have a judgement."""
        return sum(run.stability is stability for run in self.runs)

    @property
    def judgement(self) -> Stability:
        """Stable if all of its runs are, not stable if one is."""
        found = {run.stability for run in self.runs}
        return next(
            one
            for one in (Stability.NOT_STABLE, Stability.OPEN, Stability.STABLE)
            if one in found
        )

    @property
    def masked(self) -> bool:
        """True if a run was to touch a wall, and did not."""
        return any(run.masked for run in self.runs)

    @property
    def energy_j(self) -> float | None:
        """The least energy of its runs, J; None if one diverged."""
        values = [run.energy_j for run in self.runs if run.energy_j is not None]
        return min(values) if len(values) == len(self.runs) else None

    @property
    def interval(self) -> tuple[float, float] | None:
        """The 95 % interval of the share of stable runs; None of too few."""
        return (
            wilson_interval(self.stable, len(self.runs))
            if len(self.runs) >= LEAST_SEEDS
            else None
        )

    def mean(self, quantity: str) -> float | MeanInterval | None:
        """Returns a number's mean over the seeds, with its interval if they are enough."""
        values = [getattr(run, quantity) for run in self.runs]
        if None in values or self.masked:
            return None
        return mean_interval(values) if len(values) >= LEAST_SEEDS else float(np.mean(values))


class BenchResults(Result):
    """The results of a suite.

    Attributes:
        plan: of what.
        places: every cell with its runs, in the order of the plan.
        runs: all of them, in that order.
    """

    def __init__(self, plan: BenchPlan, runs: dict[tuple[str, int], BenchRun]) -> None:
        self.plan = plan
        self.places = [
            BenchPlace(cell, [_confirm(runs, cell, seed) for seed in cell.seeds])
            for cell in plan.cells
        ]
        self.runs = [run for place in self.places for run in place.runs]

    def blocks(self) -> Iterator[Block]:
        """Yields verdicts, properties, each quantity of each task, and round trips."""
        yield from (*describe_bench(self), "")
        yield tabulate_verdicts(self)
        for task in self.plan.tasks:
            yield tabulate_properties(self, task)
        for task, key in list_quantities(self):
            if key != "effort_nm":
                yield from ("", f"{task}: {QUANTITIES[key]}")
                yield tabulate_quantity(self, task, key)
        if self.plan.study == "round-trips":
            yield tabulate_round_trips(self)

    def headline(self) -> str:
        """Returns which study, and how many runs."""
        return (
            f"{self.plan.study}: {count_nouns(len(self.places), 'cell')}, "
            f"{count_nouns(len(self.runs), 'run')}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat bench --json`."""
        return {
            "study": self.plan.study,
            "gains": [
                msgspec.to_builtins(one) | {"outcome": "settled"}
                for one in {str(c.tuned): c.tuned for c in self.plan.cells}.values()
            ],
            "places": self.to_rows(),
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per cell."""
        return list(map(_place_row, self.places))

    def of(self, task: str, law: str = "", link: str = "") -> Iterator[BenchPlace]:
        """Yields the places of a task, and of a law and a link if they are named."""
        for place in self.places:
            cell = place.cell
            if cell.task == task and law in ("", cell.law) and link in ("", cell.link):
                yield place


def _confirm(runs: dict[tuple[str, int], BenchRun], cell: BenchCell, seed: int) -> BenchRun:
    """Returns a run, with the judgement of the longer one if there is one."""
    run = runs[cell.key, seed]
    longer = runs.get((name_run(cell.key, LONGEST_S), seed))
    if run.stability is Stability.NOT_STABLE and run.length_s >= LONGEST_S:
        return msgspec.structs.replace(run, confirmed=True)
    if run.stability is not Stability.NOT_STABLE or longer is None:
        return run
    confirmed = longer.stability is Stability.NOT_STABLE
    words = f"of {LONGEST_S:g} s: {longer.text}"
    return msgspec.structs.replace(
        run, stability=longer.stability, text=words, confirmed=confirmed
    )


_SHOWN_LINKS = (
    "rtt8",
    "rtt136",
    "rtt544",
    "rtt1088",
    "rtt136-loss50",
    "4g",
    "5g",
    "geo",
    "trace",
)
"""Links of a table for people, if they are among those that ran; else all that ran."""
OPEN_MARK = "?"
UNSTABLE_MARK = "!"


def list_quantities(results: BenchResults) -> list[tuple[str, str]]:
    """Returns what is shown of the tasks that ran: each with a key of `QUANTITIES`."""
    more = {
        "free": ["hand_nm"],
        "disagree": ["hand_nm"],
        "contact": ["stiffness_n_m", "force_peak_n"],
    }
    tasks = results.plan.tasks
    found = [(task, key) for key in ("error_rad", "effort_nm", "settled_s") for task in tasks]
    return found + [(task, key) for task in tasks for key in more.get(task, [])]


def name_law(law: str, form: str) -> str:
    """Returns a law's name, with its sites if they are not three."""
    return law if form == "three" else f"{law} (two sites)"


def tabulate_verdicts(results: BenchResults) -> TextTable:
    """Returns a row per law: of each task over how many links it is stable, open, and not
    stable.
    """
    tasks = results.plan.tasks

    def cell(law: str, form: str, task: str) -> str:
        found = [place.judgement for place in results.of(task, law)]
        counts = " / ".join(str(found.count(one)) for one in _JUDGEMENTS)
        return counts if found else explain_no_cell(law, form, task)

    rows = [
        (name_law(*one), *(cell(*one, task) for task in tasks)) for one in results.plan.laws
    ]
    return TextTable(("links: stable / open / not stable", *tasks), rows, align="lr")


_JUDGEMENTS = (Stability.STABLE, Stability.OPEN, Stability.NOT_STABLE)


def tabulate_properties(results: BenchResults, task: str) -> TextTable:
    """Returns a row per law: over how many links each property holds of all runs, and the least
    energy.
    """
    rows = []
    for law, form in results.plan.laws:
        places = list(results.of(task, law))
        if not places:
            rows.append((name_law(law, form), explain_no_cell(law, form, task), *[""] * 5))
            continue
        energies = [place.energy_j for place in places]
        least = min((one for one in energies if one is not None), default=None)
        kept = (
            sum(all(run.bounded for run in place.runs) for place in places),
            sum(one is not None and one >= PASSIVE_J for one in energies),
            sum(all(run.settled_s is not None for run in place.runs) for place in places),
            sum(place.judgement is Stability.STABLE for place in places),
        )
        energy = "-" if least is None else f"{least if least < -1e-9 else 0.0:.2g}"
        shown = [f"{count}/{len(places)}" for count in kept]
        masked = str(sum(place.masked for place in places))
        rows.append(
            (name_law(law, form), shown[0], shown[1], energy, shown[2], shown[3], masked)
        )
    heads = ("bounded", "passive", "least energy, J", "converged", "stable", "no contact")
    return TextTable((task, *heads), rows, align="lr")


def tabulate_quantity(results: BenchResults, task: str, quantity: str) -> TextTable:
    """Returns a row per law and a column per link: means over seeds; marks say what is not
    stable.
    """
    links = results.plan.links
    if len(links) > len(_SHOWN_LINKS):
        links = [link for link in links if link in _SHOWN_LINKS]
    rows = []
    for law, form in results.plan.laws:
        missing = explain_no_cell(law, form, task)
        cells = []
        for link in links:
            place = next(results.of(task, law, link), None)
            cells.append(missing if place is None else _describe_place(place, quantity))
        if missing != "-":
            rows.append((name_law(law, form), *cells))
    return TextTable((task, *links), rows, align="lr")


def _describe_place(place: BenchPlace, quantity: str) -> str:
    value = place.mean(quantity)
    found = place.judgement
    mark = {Stability.NOT_STABLE: UNSTABLE_MARK, Stability.OPEN: OPEN_MARK}.get(found, "")
    if place.masked:
        return f"no contact{mark}"
    if any(run.behaviour is EndBehaviour.DIVERGED for run in place.runs):
        return f"diverged{mark}"
    if value is None and quantity == "settled_s":
        return f"not within {max(run.length_s for run in place.runs):g}{mark}"
    if value is None:
        return mark or "none"
    return (str(value) if isinstance(value, MeanInterval) else f"{value:.4g}") + mark


def tabulate_round_trips(results: BenchResults) -> TextTable:
    """Returns what the published study speaks of: how much delay and loss make of the errors of
    each law.
    """

    def error(law: str, task: str, link: str) -> float | None:
        place = next(results.of(task, law, link), None)
        value = None if place is None else place.mean("error_rad")
        return value.mean if isinstance(value, MeanInterval) else value

    def ratio(above: float | None, below: float | None) -> str:
        return f"{above / below:.3g}" if above is not None and below else "-"

    rows = []
    for task in results.plan.tasks:
        for law, _ in results.plan.laws:
            first = error(law, task, "rtt8")
            later = error(law, task, "rtt272")
            times = (
                ratio(error(law, task, "rtt1088"), first),
                ratio(error(law, task, "rtt272-loss50"), later),
            )
            rows.append((task, law, format_number(first, 4), *times))
    heads = (
        "task",
        "law",
        "error at 8 ms, rad",
        "1088 ms: times that",
        "272 ms: half lost, times none lost",
    )
    return TextTable(heads, rows, align="llr")


def describe_bench(results: BenchResults) -> Iterator[str]:
    """Yields what ran, in lines."""
    plan = results.plan
    seeds = max(len(cell.seeds) for cell in plan.cells)
    yield f"{plan.study}: {STUDIES[plan.study].about}"
    yield (
        f"{count_nouns(len(plan.cells), 'cell')}, "
        f"{count_nouns(len(results.runs), 'run')}: one per cell without randomness, else {seeds}"
    )
    unstable = [run for run in results.runs if run.stability is Stability.NOT_STABLE]
    refuted = sum(run.confirmed is False for run in results.runs)
    confirmed = sum(bool(run.confirmed) for run in unstable)
    yield (
        f"not stable: {count_nouns(len(unstable), 'run')}, {confirmed} confirmed by one "
        f"of 100 s; {refuted} refuted by it"
    )
    for task in dict.fromkeys(cell.task for cell in plan.cells):
        yield f"{task}: {TASKS[task].about}"
    for law, form in results.plan.laws:
        if form == "two":
            yield f"{law} is for two sites: it runs in the tasks of one user, without the second"
    if plan.without:
        names = ", ".join(map(str, plan.without))
        yield f"no candidate was stable at the pose with the margin, so nothing runs: {names}"


def tabulate_gains(results: BenchResults) -> TextTable:
    """Returns a row per law, form and delay: the gains in use."""
    used = {str(cell.tuned): cell.tuned for cell in results.plan.cells}
    used |= {str(one): one for one in results.plan.without}
    rows = [
        (
            name_law(one.law, one.form),
            str(one.round_trip_ms),
            ", ".join(f"{key} {value:g}" for key, value in one.gains.items()) or "none",
            f"{one.settled}/{one.tried}",
            str(one.passed),
        )
        for one in used.values()
    ]
    return TextTable(
        ("law", "tuned at, ms", "gains", "stable", "without margin"), rows, align="lrlrr"
    )


def build_bench_page(
    results: BenchResults, command: str, pictures: Mapping[str, str] = {}
) -> str:
    """Returns the results in Markdown, under the command that makes them.

    Args:
        results: the results.
        command: the command that makes them.
        pictures: by the name of a picture's file beside the page, what the picture shows.
    """
    parts = [
        f"# The suite: {results.plan.study}",
        f"    {command}",
        "\n".join(f"- {line}" for line in describe_bench(results)),
        tabulate_verdicts(results).markdown(),
        f"{OPEN_MARK}: a run is open, {UNSTABLE_MARK}: one is not stable; +-: 95 % over seeds of one link.",
    ]
    parts += [f"![{text}]({name})" for name, text in pictures.items()]
    for task in results.plan.tasks:
        parts += [f"## {task}: properties", tabulate_properties(results, task).markdown()]
    for task, key in list_quantities(results):
        parts += [
            f"## {task}: {QUANTITIES[key]}",
            tabulate_quantity(results, task, key).markdown(),
        ]
    if results.plan.study == "round-trips":
        parts += ["## Delay against loss", tabulate_round_trips(results).markdown()]
    parts += ["## Gains", tabulate_gains(results).markdown()]
    return "\n\n".join(parts) + "\n"


def encode_runs(results: BenchResults) -> str:
    """Returns a row per run as CSV."""
    cells = {cell.name: cell for cell in results.plan.cells}
    rows = [_place_columns(cells[run.name]) | msgspec.to_builtins(run) for run in results.runs]
    return encode_csv(rows, [*_PLACE, *BenchRun.__struct_fields__])


_GONE = ("reflected", "reflected_half", "observed", "least_j")
"""Keys that had numbers once: no key is taken away (docs/json.md)."""
_PLACE = ("task", "law", "link", "form")


def _place_columns(cell: BenchCell) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in _PLACE}


def _place_row(place: BenchPlace) -> dict[str, Any]:
    low, high = place.interval or (None, None)
    counts = {one.value.replace(" ", "_"): place.count(one) for one in Stability}
    row = {
        **_place_columns(place.cell),
        "runs": len(place.runs),
        **counts,
        "share_low": low,
        "share_high": high,
    }
    for key in QUANTITIES:
        value = place.mean(key)
        row[key], row[f"{key}_half"] = (
            value if isinstance(value, MeanInterval) else (value, None)
        )
    row |= dict.fromkeys(_GONE)
    row |= {
        "judgement": place.judgement.value,
        "bounded": all(run.bounded for run in place.runs),
        "energy_j": place.energy_j,
        "length_s": max(run.length_s for run in place.runs),
        "contact": not place.masked,
        "confirmed": sum(run.confirmed is True for run in place.runs),
        "refuted": sum(run.confirmed is False for run in place.runs),
    }
    return row
