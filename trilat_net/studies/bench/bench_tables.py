"""The results of the suite as tables, as Markdown, as CSV and as JSON.

Invariant: a function of the results alone, without a clock: equal results give equal bytes. A number over
seeds has its 95 % interval, and every run that is not stable shows. No law is ranked.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import msgspec

from ...analysis.certificate.observed_energy import ObservedFinding
from ...analysis.json_values import JsonObject
from ...analysis.run_end import Stability
from ...reporting.result_text import Block
from ...reporting.text_table import TextTable
from ..intervals import MeanInterval, wilson_interval
from .bench_cell import BenchRun, declares_energies
from .bench_plan import BenchCell
from .bench_run import QUANTITIES_OF_RUNS, BenchPlace, BenchResults
from .bench_tasks import STUDIES, TASKS

_SHOWN_LINKS = ("rtt8", "rtt136", "rtt544", "rtt1088", "rtt136-loss50", "4g", "5g", "geo", "trace")
"""Links of a table for people, if they are among those that ran; else all that ran."""
OPEN_MARK, UNSTABLE_MARK = "?", "!"


class BenchQuantity(NamedTuple):
    """A number of the runs of a task, as it is shown."""

    task: str
    key: str
    words: str


def list_quantities(results: BenchResults) -> list[BenchQuantity]:
    """Returns what is shown of the tasks that ran."""
    tasks = list(dict.fromkeys(cell.task for cell in results.plan.cells))
    found = [
        BenchQuantity(task, "error_rad", "RMS distance of the slave from its users, rad") for task in tasks
    ]
    found += [BenchQuantity(task, "effort_nm", "effort, RMS of tau - G(q), N m") for task in tasks]
    for task in tasks:
        if task in ("free", "disagree"):
            found.append(BenchQuantity(task, "hand_nm", "transparency: RMS torque of the hands, N m"))
    if "contact" in tasks:
        words = "transparency: share of the wall's torque that the user feels at rest"
        found.append(BenchQuantity("contact", "reflected", words))
        found.append(BenchQuantity("contact", "force_peak_n", "largest force of the wall, N"))
    return found


def list_laws(results: BenchResults) -> list[tuple[str, str]]:
    """Returns the laws that ran, with their forms, in the order of the plan."""
    return list(dict.fromkeys((cell.law, cell.form) for cell in results.plan.cells))


def name_law(law: str, form: str) -> str:
    """Returns a law's name, with its sites if they are not three."""
    return law if form == "three" else f"{law} (two sites)"


def tabulate_verdicts(results: BenchResults) -> TextTable:
    """Returns a row per law: of each task its stable runs of all, and the 95 % interval of that share."""
    tasks = list(dict.fromkeys(cell.task for cell in results.plan.cells))

    def cell(law: str, task: str) -> str:
        places = list(results.of(task, law))
        runs = sum(len(place.runs) for place in places)
        if not runs:
            return "-"
        stable, unstable = (
            sum(place.stable for place in places),
            sum(place.count(Stability.NOT_STABLE) for place in places),
        )
        low, high = (100.0 * end for end in wilson_interval(stable, runs))
        return f"{stable}/{runs} ({low:.0f}-{high:.0f} %), {unstable} not"

    rows = [(name_law(*one), *(cell(one[0], task) for task in tasks)) for one in list_laws(results)]
    return TextTable(("stable runs of all, not stable", *tasks), rows, align="lr")


def tabulate_quantity(results: BenchResults, asked: BenchQuantity) -> TextTable:
    """Returns a row per law and a column per link: means over seeds; marks say what is not stable."""
    links = list(dict.fromkeys(cell.link for cell in results.plan.cells))
    if len(links) > len(_SHOWN_LINKS):
        links = [link for link in links if link in _SHOWN_LINKS]
    rows = []
    for law, form in list_laws(results):
        cells = []
        for link in links:
            place = next(results.of(asked.task, law, link), None)
            cells.append("-" if place is None else _describe_place(place, asked.key))
        if any(cell != "-" for cell in cells):
            rows.append((name_law(law, form), *cells))
    return TextTable((asked.task, *links), rows, align="lr")


def _describe_place(place: BenchPlace, quantity: str) -> str:
    value, unstable = place.mean(quantity), place.count(Stability.NOT_STABLE)
    mark = UNSTABLE_MARK if unstable else OPEN_MARK if place.stable < len(place.runs) else ""
    if value is None:
        return mark or "none"
    return (str(value) if isinstance(value, MeanInterval) else f"{value:.4g}") + mark


def tabulate_energies(results: BenchResults) -> TextTable:
    """Returns a row per law that declares energies: the runs in which none is below zero, of those seen."""
    tasks = list(dict.fromkeys(cell.task for cell in results.plan.cells))

    def cell(law: str, task: str) -> str:
        seen = [run for place in results.of(task, law) for run in place.runs if run.observed]
        passive = sum(run.observed == ObservedFinding.PASSIVE for run in seen)
        least = min((run.least_j for run in seen if run.least_j is not None), default=0.0)
        return f"{passive}/{len(seen)}, least {least:.2g} J" if seen else "-"

    laws = [one for one in list_laws(results) if declares_energies(one[0])]
    rows = [(name_law(*one), *(cell(one[0], task) for task in tasks)) for one in laws]
    return TextTable(("observed energy never below zero", *tasks), rows, align="lr")


def tabulate_round_trips(results: BenchResults) -> TextTable:
    """Returns what the published study speaks of: how much delay and loss make of the errors of each law."""

    def error(law: str, task: str, link: str) -> float | None:
        place = next(results.of(task, law, link), None)
        value = None if place is None else place.mean("error_rad")
        return value.mean if isinstance(value, MeanInterval) else value

    def ratio(above: float | None, below: float | None) -> str:
        return f"{above / below:.3g}" if above is not None and below else "-"

    rows = []
    for task in dict.fromkeys(cell.task for cell in results.plan.cells):
        for law, _ in list_laws(results):
            first, later = error(law, task, "rtt8"), error(law, task, "rtt272")
            times = ratio(error(law, task, "rtt1088"), first), ratio(error(law, task, "rtt272-loss50"), later)
            rows.append((task, law, "-" if first is None else f"{first:.4g}", *times))
    heads = ("task", "law", "error at 8 ms, rad", "1088 ms: times that", "272 ms: half lost, times none lost")
    return TextTable(heads, rows, align="llr")


def describe_bench(results: BenchResults) -> Iterator[str]:
    """Yields what ran, in lines."""
    plan = results.plan
    seeds = max(len(cell.seeds) for cell in plan.cells)
    yield f"{plan.study}: {STUDIES[plan.study].about}"
    yield f"{len(plan.cells)} cells, {len(results.runs)} runs: one per cell without randomness, else {seeds}"
    for task in dict.fromkeys(cell.task for cell in plan.cells):
        yield f"{task}: {TASKS[task].about}"
    for law, form in list_laws(results):
        if form == "two":
            yield f"{law} is for two sites: it runs in the tasks of one user, without the second"
    unsettled = dict.fromkeys(str(cell.tuned) for cell in plan.cells if not cell.tuned.settled)
    if unsettled:
        names = ", ".join(unsettled)
        yield f"no candidate was stable at the pose; the gains with the least error are used: {names}"


def tabulate_gains(results: BenchResults) -> TextTable:
    """Returns a row per law, form and delay: the gains in use."""
    used = {str(cell.tuned): cell.tuned for cell in results.plan.cells}
    rows = [
        (
            name_law(one.law, one.form),
            str(one.round_trip_ms),
            ", ".join(f"{key} {value:g}" for key, value in one.gains.items()),
            f"{one.settled}/{one.tried}",
            one.outcome.word,
        )
        for one in used.values()
    ]
    return TextTable(("law", "tuned at, ms", "gains", "stable", "taken"), rows, align="lrlrl")


def build_bench_page(results: BenchResults, command: str) -> str:
    """Returns the results in Markdown, under the command that makes them."""
    parts = [
        f"# The suite: {results.plan.study}",
        f"    {command}",
        "\n".join(f"- {line}" for line in describe_bench(results)),
        tabulate_verdicts(results).markdown(),
        f"{OPEN_MARK}: a run is open, {UNSTABLE_MARK}: one is not stable; +-: 95 % over seeds.",
    ]
    for asked in list_quantities(results):
        parts += [f"## {asked.task}: {asked.words}", tabulate_quantity(results, asked).markdown()]
    if any(run.observed for run in results.runs):
        parts += ["## Energies", tabulate_energies(results).markdown()]
    if results.plan.study == "round-trips":
        parts += ["## Delay against loss", tabulate_round_trips(results).markdown()]
    parts += ["## Gains", tabulate_gains(results).markdown()]
    return "\n\n".join(parts) + "\n"


def encode_runs(results: BenchResults) -> str:
    """Returns a row per run as CSV."""
    cells = {cell.name: cell for cell in results.plan.cells}
    rows = [_place_columns(cells[run.name]) | msgspec.to_builtins(run) for run in results.runs]
    return _encode_csv([*_PLACE, *BenchRun.__struct_fields__], rows)


def encode_places(results: BenchResults) -> str:
    """Returns a row per cell as CSV: counts, the share of stable runs, and means with their intervals."""
    rows = list(map(_place_row, results.places))
    return _encode_csv(list(rows[0]), rows)


_PLACE = ("task", "law", "link", "form")


def _place_columns(cell: BenchCell) -> dict[str, Any]:
    return {name: getattr(cell, name) for name in _PLACE}


def _place_row(place: BenchPlace) -> dict[str, Any]:
    low, high = place.interval
    counts = {one.value.replace(" ", "_"): place.count(one) for one in Stability}
    row = {
        **_place_columns(place.cell),
        "runs": len(place.runs),
        **counts,
        "share_low": low,
        "share_high": high,
    }
    for key in QUANTITIES_OF_RUNS:
        value = place.mean(key)
        row[key], row[f"{key}_half"] = value if isinstance(value, MeanInterval) else (value, None)
    first = place.runs[0]
    return {**row, "observed": first.observed, "least_j": first.least_j}


def _encode_csv(columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: "" if value is None else value for key, value in row.items()} for row in rows)
    return text.getvalue()


def compose_bench(results: BenchResults) -> Iterator[Block]:
    """Yields verdicts, each quantity of each task, the energies that laws declare, and round trips."""
    yield from (*describe_bench(results), "")
    yield tabulate_verdicts(results)
    for asked in list_quantities(results):
        if asked.key != "effort_nm":
            yield from ("", f"{asked.task}: {asked.words}")
            yield tabulate_quantity(results, asked)
    if any(run.observed for run in results.runs):
        yield tabulate_energies(results)
    if results.plan.study == "round-trips":
        yield tabulate_round_trips(results)


def bench_to_json(results: BenchResults) -> JsonObject:
    """Returns all that there is to say, as plain values."""
    return {
        "study": results.plan.study,
        "gains": [
            msgspec.to_builtins(one) for one in {str(c.tuned): c.tuned for c in results.plan.cells}.values()
        ],
        "places": list(map(_place_row, results.places)),
    }
