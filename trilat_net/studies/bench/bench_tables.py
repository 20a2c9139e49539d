"""The results of the suite as tables, as Markdown, as CSV and as JSON.

Invariant: a function of the results alone, without a clock: equal results give equal bytes. A number over
seeds has its 95 % interval, and every run that is not stable shows. No law is ranked.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import msgspec

from ...analysis.json_values import JsonObject
from ...analysis.run_end import EndBehaviour, Stability
from ...reporting.result_text import Block
from ...reporting.text_table import TextTable
from ..intervals import MeanInterval
from .bench_cell import PASSIVE_J, BenchRun
from .bench_plan import BenchCell, explain_no_cell
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


_WORDS = {
    "error_rad": "RMS distance of the slave from its users, rad",
    "effort_nm": "effort, RMS of tau - G(q), N m",
    "settled_s": "since when all arms stay where they end, s",
    "hand_nm": "RMS torque of the hands, N m",
    "stiffness_n_m": "stiffness at the user's hand, by two reaches, N/m",
    "force_peak_n": "largest force of the wall, N",
}
_ALWAYS = ("error_rad", "effort_nm", "settled_s")


def list_quantities(results: BenchResults) -> list[BenchQuantity]:
    """Returns what is shown of the tasks that ran."""
    tasks = list(dict.fromkeys(cell.task for cell in results.plan.cells))
    found = [BenchQuantity(task, key, _WORDS[key]) for key in _ALWAYS for task in tasks]
    more = {"free": ["hand_nm"], "disagree": ["hand_nm"], "contact": ["stiffness_n_m", "force_peak_n"]}
    return found + [BenchQuantity(task, key, _WORDS[key]) for task in tasks for key in more.get(task, [])]


def list_laws(results: BenchResults) -> list[tuple[str, str]]:
    """Returns the laws that were asked for, with their forms, in the order of the plan."""
    return list(results.plan.laws)


def name_law(law: str, form: str) -> str:
    """Returns a law's name, with its sites if they are not three."""
    return law if form == "three" else f"{law} (two sites)"


def tabulate_verdicts(results: BenchResults) -> TextTable:
    """Returns a row per law: of each task over how many links it is stable, open, and not stable."""
    tasks = list(dict.fromkeys(cell.task for cell in results.plan.cells))

    def cell(law: str, form: str, task: str) -> str:
        found = [place.judgement for place in results.of(task, law)]
        counts = " / ".join(str(found.count(one)) for one in _JUDGEMENTS)
        return counts if found else explain_no_cell(law, form, task)

    rows = [(name_law(*one), *(cell(*one, task) for task in tasks)) for one in list_laws(results)]
    return TextTable(("links: stable / open / not stable", *tasks), rows, align="lr")


_JUDGEMENTS = (Stability.STABLE, Stability.OPEN, Stability.NOT_STABLE)


def tabulate_properties(results: BenchResults, task: str) -> TextTable:
    """Returns a row per law: over how many links each property holds of all runs, and the least energy."""
    rows = []
    for law, form in list_laws(results):
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
        rows.append((name_law(law, form), shown[0], shown[1], energy, shown[2], shown[3], masked))
    heads = ("bounded", "passive", "least energy, J", "converged", "stable", "no contact")
    return TextTable((task, *heads), rows, align="lr")


def tabulate_quantity(results: BenchResults, asked: BenchQuantity) -> TextTable:
    """Returns a row per law and a column per link: means over seeds; marks say what is not stable."""
    links = list(dict.fromkeys(cell.link for cell in results.plan.cells))
    if len(links) > len(_SHOWN_LINKS):
        links = [link for link in links if link in _SHOWN_LINKS]
    rows = []
    for law, form in list_laws(results):
        missing = explain_no_cell(law, form, asked.task)
        cells = []
        for link in links:
            place = next(results.of(asked.task, law, link), None)
            cells.append(missing if place is None else _describe_place(place, asked.key))
        if missing != "-":
            rows.append((name_law(law, form), *cells))
    return TextTable((asked.task, *links), rows, align="lr")


def _describe_place(place: BenchPlace, quantity: str) -> str:
    value, found = place.mean(quantity), place.judgement
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
    unstable = [run for run in results.runs if run.stability is Stability.NOT_STABLE]
    refuted = sum(run.confirmed is False for run in results.runs)
    confirmed = sum(bool(run.confirmed) for run in unstable)
    yield f"not stable: {len(unstable)} runs, {confirmed} confirmed by one of 100 s; {refuted} refuted by it"
    for task in dict.fromkeys(cell.task for cell in plan.cells):
        yield f"{task}: {TASKS[task].about}"
    for law, form in list_laws(results):
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
    return TextTable(("law", "tuned at, ms", "gains", "stable", "without margin"), rows, align="lrlrr")


def build_bench_page(results: BenchResults, command: str) -> str:
    """Returns the results in Markdown, under the command that makes them."""
    parts = [
        f"# The suite: {results.plan.study}",
        f"    {command}",
        "\n".join(f"- {line}" for line in describe_bench(results)),
        tabulate_verdicts(results).markdown(),
        f"{OPEN_MARK}: a run is open, {UNSTABLE_MARK}: one is not stable; +-: 95 % over seeds of one link.",
    ]
    for task in dict.fromkeys(cell.task for cell in results.plan.cells):
        parts += [f"## {task}: properties", tabulate_properties(results, task).markdown()]
    for asked in list_quantities(results):
        parts += [f"## {asked.task}: {asked.words}", tabulate_quantity(results, asked).markdown()]
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
    for key in QUANTITIES_OF_RUNS:
        value = place.mean(key)
        row[key], row[f"{key}_half"] = value if isinstance(value, MeanInterval) else (value, None)
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


def _encode_csv(columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: "" if value is None else value for key, value in row.items()} for row in rows)
    return text.getvalue()


def compose_bench(results: BenchResults) -> Iterator[Block]:
    """Yields verdicts, properties, each quantity of each task, and round trips."""
    yield from (*describe_bench(results), "")
    yield tabulate_verdicts(results)
    for task in dict.fromkeys(cell.task for cell in results.plan.cells):
        yield tabulate_properties(results, task)
    for asked in list_quantities(results):
        if asked.key != "effort_nm":
            yield from ("", f"{asked.task}: {asked.words}")
            yield tabulate_quantity(results, asked)
    if results.plan.study == "round-trips":
        yield tabulate_round_trips(results)


def bench_to_json(results: BenchResults) -> JsonObject:
    """Returns all that there is to say, as plain values."""
    return {
        "study": results.plan.study,
        "gains": [
            msgspec.to_builtins(one) | {"outcome": "settled"}
            for one in {str(c.tuned): c.tuned for c in results.plan.cells}.values()
        ],
        "places": list(map(_place_row, results.places)),
    }
