"""Runs a sweep: estimates its duration, runs the cells that are missing, writes the results and sums them up.

Invariant: results are a function of the plan; the number of processes, their order and the number of
interruptions do not enter. A run that is in the journal is never made again. Every command shown works: a
reproduced run has the scenario hash of its row; if the swept scenario has changed since, the row's own text
is written out and named instead.
"""

import math
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ...errors import ScenarioError, UsageError
from ...files import write_whole
from ...net.clock import SystemClock
from ...process import count_cores
from ...scenario.law_consent import list_imported_laws
from ...scenario.scenario_reader import read_source
from .. import executor
from ..commands import format_command
from ..run_journal import RunJournal
from . import cell_result, sweep_results
from .cell_result import CellClass
from .sweep_cell import CellRun, SweepSource, run_cell
from .sweep_folder import SweepFolder, build_resume_hint
from .sweep_plan import SweepPlan

MAX_RUNS = 1_000_000
MAX_SWEEP_S = 86_400.0
"""A sweep of more runs, or one that would take longer, needs a confirmation."""
_PROBES = 7
_PROBING_S = 3.0
"""Runs of an estimate; fewer, once they have taken so long."""
_RESUME_HINT = "; what is done is kept: go on with --resume"


class DurationEstimate(NamedTuple):
    """Duration of the runs that a sweep has left at most, estimated by a few of them, which are done then."""

    runs: int
    seconds: float
    entries: list[CellRun]


class SweepSpeed(NamedTuple):
    """Speed of a sweep, this time: how many runs and how much time of the experiment were simulated."""

    runs: int
    simulated_s: float
    wall_s: float
    jobs: int


class FinishedSweep(NamedTuple):
    """A finished sweep, and the speed of what was run this time."""

    results: sweep_results.SweepResults
    folder: SweepFolder
    speed: SweepSpeed


def estimate_sweep(
    plan: SweepPlan, done: Iterable[tuple[int, int]] = (), jobs: int | None = None
) -> DurationEstimate:
    """Returns how long a sweep will take, by its first and last run and some between.

    The runs of cells and seeds that are `done` already are left out.
    """
    known = set(done)
    places = dict.fromkeys(n * (plan.cells - 1) // (_PROBES - 1) for n in range(_PROBES))
    probes = [plan.task(n, plan.seeds[0]) for n in places if (n, plan.seeds[0]) not in known]
    if not probes:
        return DurationEstimate(plan.cells * len(plan.seeds) - len(known), 0.0, [])
    first = probes[0]
    brief_s = min(1.0, plan.base.duration_s)
    warm = plan.written.scenario(*first.overrides, f"duration_s={brief_s!r}")
    cell_result.classify_cell(warm.text, brief_s)  # compiles, once for all processes
    clock = SystemClock()
    began_ns = clock.monotonic_ns()
    entries: list[CellRun] = []
    took_s = 0.0
    while len(entries) < len(probes) and took_s < _PROBING_S:
        entries.append(run_cell(probes[len(entries)]))
        took_s = (clock.monotonic_ns() - began_ns) * 1e-9
    seeds = len(plan.seeds) if any(entry.random for entry in entries) else 1
    left = max(len(entries), plan.cells * seeds - len(known))
    return DurationEstimate(left, took_s / len(entries) * left / min(jobs or count_cores(), left), entries)


def refuse_oversized_sweep(plan: SweepPlan, expected: DurationEstimate, jobs: int | None = None) -> None:
    """Refuses a sweep of very many runs, or of more than a day.

    Raises:
        UsageError: it is one; says how many runs, and how long they would take.
    """
    if expected.runs <= MAX_RUNS and expected.seconds <= MAX_SWEEP_S:
        return
    sizes = " x ".join(str(count) for count in plan.shape if count > 1)
    seeds = f", {len(plan.seeds)} seeds each" if len(plan.seeds) > 1 else ""
    raise UsageError(
        f"{plan.cells} cells ({sizes}{seeds}) would take about {format_wall_time(expected.seconds)} on "
        f"{jobs or count_cores()} cores; larger steps make it fewer, --yes runs it all the same"
    )


def format_wall_time(seconds: float) -> str:
    """Returns a duration for people."""
    for unit, size, from_s in (("days", 86_400.0, 172_800.0), ("h", 3600.0, 5400.0), ("min", 60.0, 90.0)):
        if seconds >= from_s:
            return f"{seconds / size:.3g} {unit}"
    return f"{max(1, round(seconds))} s"


def run_sweep(
    folder: SweepFolder,
    jobs: int | None = None,
    progress: executor.Progress = executor.ignore_progress,
    known: Iterable[CellRun] = (),
    on: executor.Workers = None,
) -> FinishedSweep:
    """Runs what is left of a sweep, writes its results, and returns them.

    Args:
        folder: of the sweep; what its journal has is not run again.
        jobs: in how many processes; None for one per core.
        progress: called with the runs that are done, and their number as far as it is known.
        known: runs that were made already, for an estimate.
        on: what runs the cells instead: a Dask scheduler's address or an executor.

    Raises:
        ScenarioError: a cell cannot run; says which. What is done is kept.
        RunFailed: a cell ended its workers, or the cluster is gone. What is done is kept.
        UsageError: polars is not installed.
    """
    sweep_results.require_polars()
    plan = folder.plan
    clock = SystemClock()
    with folder.journal() as journal:
        for entry in known:
            journal.add(entry)
        before, began_ns = set(journal.done), clock.monotonic_ns()
        left = plan.cells * len(plan.seeds) - len(before)
        laws = list_imported_laws([plan.base])
        workers = on if left else None
        with executor.open_worker_pool(jobs, workers, most=left, laws=laws, hint=_RESUME_HINT) as pool:
            count = pool.workers
            _run_cells(plan, journal, pool, progress)
        wall_s = (clock.monotonic_ns() - began_ns) * 1e-9
        made = [entry for key, entry in journal.done.items() if key not in before]
        rows = sweep_results.build_result_rows(plan, list(journal.done.values()))
    results = sweep_results.SweepResults(plan, rows)
    if len(plan.seeds) > 1:
        points = sweep_results.encode_grid_points(plan, sweep_results.collect_grid_points(results))
        write_whole(
            folder.path / sweep_results.GRID_POINTS_FILE, points, remedy=build_resume_hint(folder.path)
        )
    table = sweep_results.encode_results(plan, rows, folder.facts)
    write_whole(folder.results, table, remedy=build_resume_hint(folder.path))
    speed = SweepSpeed(len(made), sum(entry.outcome.ran_s for entry in made), wall_s, count)
    return FinishedSweep(results, folder, speed)


def _run_cells(
    plan: SweepPlan, journal: RunJournal[CellRun], pool: executor.WorkerPool, progress: executor.Progress
) -> None:
    """Runs the first seed of every cell, then the others of those in which anything is random."""
    first, *others = plan.seeds

    def make(runs: Iterable[tuple[int, int]], count: int) -> None:
        before = len(journal.done)
        tasks = (plan.task(*key) for key in runs if key not in journal.done)
        for _, entry in pool.each(run_cell, tasks, count=count - before):
            journal.add(entry)
            progress(len(journal.done), count)

    make(((number, first) for number in range(plan.cells)), plan.cells)
    again = [number for number in range(plan.cells) if others and journal.done[number, first].random]
    make(((number, seed) for number in again for seed in others), plan.cells + len(again) * len(others))


_TOTALS = {
    "rms_error_rad": ("RMS e", "rad"),
    "effort_nm": ("effort", "N m"),
    "force_peak_n": ("peak force", "N"),
    "walls_j": ("work of the walls", "J"),
}
_MAX_DOUBTFUL_SHOWN = 8
"""Most doubtful grid points printed; all stand in the file."""


def describe_sweep_plan(plan: SweepPlan) -> list[str]:
    """Returns the plan in lines, before it runs."""
    sizes = " x ".join(str(len(one.texts)) for one in plan.axes) or "1"
    laws = f" x laws {', '.join(plan.laws)}" if plan.laws else ""
    count = len(plan.seeds)
    seeds = f"seed {plan.seeds[0]}" if count == 1 else f"{count} seeds each where anything is random"
    lines = [f"{plan.base.name}: {plan.cells} cells ({sizes}{laws}), {seeds}"]
    for one in plan.axes:
        texts = one.texts
        count = len(texts)
        shown = [texts[0], texts[1], "...", texts[-1]] if count > 4 else [texts[n] for n in range(count)]
        lines.append(f"  over {one.asked}: {', '.join(shown)}")
    first_s, longest_s = plan.base.duration_s, plan.longest_s
    extended = f", an undecided one up to {longest_s:g} s" if longest_s > first_s else ""
    twins = ", judged by twins" if plan.judge == "twins" else ""
    return [*lines, f"  {first_s:g} s each{extended}{twins}"]


def summarize_sweep(results: sweep_results.SweepResults) -> Iterator[str]:
    """Yields a summary: verdicts, extensions, seeds."""
    rows = results.rows
    counts = Counter(row["verdict"] for row in rows)
    words = ", ".join(f"{counts[verdict.value]} {verdict.value}" for verdict in CellClass)
    yield f"{len(rows)} runs of {results.plan.cells} cells: {words}"
    extended = [row for row in rows if row["extended"]]
    if extended:
        longest_s = max(row["ran_s"] for row in extended)
        first_s = results.plan.base.duration_s
        continued = f"and continued, the longest to {longest_s:g} s"
        yield f"{len(extended)} were undecided after {first_s:g} s {continued}"
    yield from _describe_totals(rows)
    found = [row["exponent_per_s"] for row in rows if row.get("exponent_per_s") is not None]
    if found:
        grow = f"{sum(one > 0.0 for one in found)} of {len(found)} grow"
        yield f"growth exponents of small pushes {min(found):+.3g} to {max(found):+.3g} /s: {grow}"
    if len(results.plan.seeds) > 1:
        yield from _of_seeds(results)


def _describe_totals(rows: Sequence[sweep_results.ResultRow]) -> Iterator[str]:
    """Yields the ranges of the numbers of all runs that stayed within their limits."""
    kept = [row for row in rows if row["diverged_s"] is None]
    words = []
    for key, (name, unit) in _TOTALS.items():
        values = [row[key] for row in kept if row.get(key) is not None]
        if values:
            words.append(f"{name} {min(values):.3g} to {max(values):.3g} {unit}")
    if words:
        yield f"within their limits {len(kept)}: {', '.join(words)}"


def _of_seeds(results: sweep_results.SweepResults) -> Iterator[str]:
    fixed = sum(not row["random"] for row in results.rows)
    if fixed:
        yield f"in {_cells(fixed)} nothing is random: one seed was run there, for all"
    doubtful = [place for place in sweep_results.collect_grid_points(results) if place.doubtful]
    if doubtful:
        yield f"stable with some seeds and not with others, {_cells(len(doubtful))}:"
    for place in doubtful[:_MAX_DOUBTFUL_SHOWN]:
        yield f"  {_describe_grid_point(results.plan, place)}"
    if len(doubtful) > _MAX_DOUBTFUL_SHOWN:
        yield f"  and {len(doubtful) - _MAX_DOUBTFUL_SHOWN} more, all in places.parquet"


def _cells(count: int) -> str:
    return "1 cell" if count == 1 else f"{count} cells"


def _describe_grid_point(plan: SweepPlan, place: sweep_results.GridPoint) -> str:
    where = [f"{one.key} {value}" for one, value in zip(plan.axes, place.values, strict=True)]
    law = [place.law] if plan.laws else []
    low, high = (100.0 * end for end in place.interval)
    return (
        f"cell {place.cell} ({', '.join([*law, *where])}): {place.stable} of {place.decided} stable, "
        f"95 % interval {low:.0f} to {high:.0f} %"
    )


def describe_sweep_speed(speed: SweepSpeed) -> str:
    """Returns the speed in words."""
    on = "1 process" if speed.jobs == 1 else f"{speed.jobs} processes"
    times = speed.simulated_s / (speed.wall_s * speed.jobs) if speed.wall_s else math.nan
    took = f"{speed.simulated_s:.4g} s simulated in {format_wall_time(speed.wall_s)} by {on}"
    return f"speed: {times:.3g} times real time per process; {took}"


def list_next_commands(folder: Path) -> list[str]:
    """Returns commands that use the results."""
    where = shlex.quote(str(folder))
    return [
        f"trilat sweep {where} --cell 0      # the command that makes a log of a cell",
        f"trilat sweep {where} --map         # its map, with the lines of theory",
    ]


def build_reproduce_command(
    results: sweep_results.SweepResults, row: sweep_results.ResultRow, folder: Path
) -> tuple[str, str]:
    """Returns the command that repeats a row, and a note on it or ""."""
    source = results.plan.written.source
    if _source_unchanged(results.plan.written, results.plan.cell(row["cell"]).overrides, row):
        return row["command"], ""
    name = f"cell-{row['cell']}-seed-{row['seed']}"
    file = folder / f"{name}.toml"
    write_whole(file, row["scenario"])
    lasts_s = sweep_results.reproduction_duration_s(results.plan, results.outcome(row))
    command = format_command("sim", str(file), "--duration", f"{lasts_s:.12g}", "-o", f"{name}.mcap")
    return command, f"{source} is not what was swept any more, or not here; as it ran: {file}"


def _source_unchanged(written: SweepSource, overrides: tuple[str, ...], row: sweep_results.ResultRow) -> bool:
    """Returns True if the source that the row's command names is still the swept one."""
    try:
        text, folder = read_source(written.source)
        now = written._replace(text=text, folder=str(folder))
        return bool(now.scenario(*overrides, f"seed={row['seed']}").sha256 == row["scenario_sha256"])
    except ScenarioError:
        return False
