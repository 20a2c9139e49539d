"""Runs a sweep in its folder.

The folder holds the plan, the journal of finished runs, and, once the sweep has finished, its
results.

Invariant:
    - A folder belongs to one sweep on one arithmetic; any other sweep is refused.
    - The results are a function of the plan: they do not depend on the number of processes, on
      the order of the runs, or on interruptions.
    - A run in the journal is not repeated.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ...analysis.metrics.log_metrics import measure_run
from ...errors import ScenarioError, UsageError, count_nouns
from ...execution.virtual import simulate_scenario
from ...files import make_results_folder, write_whole
from ...net.clock import SystemClock
from ...process import count_cores
from ...scenario.code_consent import list_imported_code
from ...scenario.laws import identify_law
from .. import executor
from ..study_folder import RunJournal, StudyFolder, build_resume_hint, describe_program
from . import sweep_cell
from .sweep_cell import CellResult, CellRun
from .sweep_plan import JUDGES, SweepCell, SweepPlan, plan_from_json
from .sweep_results import (
    GRID_POINTS_FILE,
    PLAN_FILE,
    RESULTS_FILE,
    SweepResults,
    build_result_rows,
    collect_grid_points,
    encode_grid_points,
    encode_results,
)

JOURNAL_FILE = "cells.journal"
_DIFFERENCES = {
    "text": "another text of the scenario",
    "scenario_sha256": "another scenario",
    "overrides": "other settings",
    "over": "other axes",
    "laws": "other laws",
    "seeds": "other seeds",
    "longest_s": "another longest time",
    "judge": "another judge",
    "metrics": "other metrics",
    "arithmetic": "another kind of arithmetic",
    "versions": "another version of the program",
}
"""Keys of the plan in which two sweeps may differ, in words, in the order of messages."""


SweepFolder = StudyFolder[SweepPlan, CellRun]


def _build_folder(path: Path, plan: SweepPlan, facts: Mapping[str, Any]) -> SweepFolder:
    """Returns the sweep folder at a path, whose journal is tied to the digest of the plan."""
    study = hashlib.sha256(_encode_plan(facts).encode()).hexdigest()
    remedy = build_resume_hint("sweep", "--resume", str(path))

    def open_journal() -> RunJournal[CellRun]:
        return RunJournal(path / JOURNAL_FILE, study, CellRun, remedy)

    return SweepFolder(path, plan, facts, remedy, open_journal)


def prepare_sweep_folder(plan: SweepPlan, path: Path | None) -> SweepFolder:
    """Returns the folder of a sweep: a new one, or the existing folder with its finished runs.

    Args:
        plan: the sweep.
        path: the path of the folder; None: a new folder with a default name.

    Raises:
        UsageError: the folder holds other files or another sweep, or cannot be made.
    """
    if path is not None and (path / PLAN_FILE).exists():
        return open_sweep_folder(path, plan)
    facts = _list_facts(plan)
    folder_path = make_results_folder(path, f"sweep-{plan.base.name}", force=None)
    folder = _build_folder(folder_path, plan, facts)
    write_whole(folder_path / PLAN_FILE, _encode_plan(facts), remedy=folder.remedy)
    return folder


def open_sweep_folder(path: Path, expected: SweepPlan | None = None) -> SweepFolder:
    """Returns the folder of a sweep that was started before.

    Args:
        path: the path of the folder.
        expected: the sweep that the folder must hold; None: any sweep that was started with
            the arithmetic and program versions of this process.

    Raises:
        UsageError: the folder holds no sweep, or another sweep.
        ScenarioError: the scenario of the sweep cannot run here.
    """
    stored = _read_facts(path)
    current = _list_facts(expected or plan_from_json(stored))
    for key, difference in _DIFFERENCES.items():
        if stored.get(key) != current.get(key):
            stored_text = _format_fact(key, stored)
            current_text = _format_fact(key, current)
            raise UsageError(
                f"{path}: holds a sweep of {difference}: there {stored_text}, "
                f"here {current_text}; results are not mixed: choose another folder"
            )
    return _build_folder(path, plan_from_json(stored), stored)


def _format_fact(key: str, facts: Mapping[str, Any]) -> str:
    """Returns the value of a key of the plan, as messages show it."""
    value = facts.get(key, JUDGES[0] if key == "judge" else [])
    if key in ("text", "scenario_sha256"):
        digest = str(value)
        if key == "text":
            digest = hashlib.sha256(digest.encode()).hexdigest()
        return f"{facts.get('name')} (sha256 {digest[:12]})"
    if isinstance(value, dict):
        versions = [
            f"{name.removeprefix('version_')} {version}" for name, version in value.items()
        ]
        return ", ".join(versions)
    if key == "seeds" and isinstance(value, list):
        first = value[0]
        last = value[-1]
        if value == list(range(first, last + 1)):
            return f"{first}..{last}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g} s" if isinstance(value, float) else str(value)


def _read_facts(path: Path) -> dict[str, Any]:
    """Returns the stored facts of the plan in a folder.

    Raises:
        UsageError: the folder has no plan, or the plan cannot be read.
    """
    file = path / PLAN_FILE
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"{path}: no sweep was begun there: it has no {PLAN_FILE}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "is not JSON"
        raise UsageError(f"{file}: cannot be read: {reason}") from None
    # a plan at the default judge without metrics does not store these keys
    optional = {"judge", "metrics"}
    required = {"source", "folder", "name", *_DIFFERENCES} - optional
    if not isinstance(facts, dict) or not required <= facts.keys():
        raise UsageError(f"{file}: is no plan of a sweep")
    return facts


def _list_facts(plan: SweepPlan) -> dict[str, Any]:
    """Returns the facts of the plan, with the arithmetic and versions of this program."""
    arithmetic, versions = describe_program()
    return {**plan.facts(), "arithmetic": arithmetic, "versions": versions}


def _encode_plan(facts: Mapping[str, Any]) -> str:
    """Returns the text of the plan file."""
    return json.dumps(facts, indent=2, ensure_ascii=False, sort_keys=True) + "\n"


MAX_RUNS = 1_000_000
"""Number of runs above which a sweep needs a confirmation."""
MAX_SWEEP_S = 86_400.0
"""Wall time above which a sweep needs a confirmation, in s."""
_PROBES = 7
"""Largest number of runs from which the duration of a sweep is estimated."""
_PROBING_S = 3.0
"""Wall time after which an estimate starts no further run, in s."""
_RESUME_HINT = "; what is done is kept: go on with --resume"


class DurationEstimate(NamedTuple):
    """Estimated duration of the remaining runs of a sweep.

    Attributes:
        runs: the largest number of runs that remain.
        seconds: their estimated wall time, in s.
        entries: the runs that were made for the estimate; the sweep does not repeat them.
    """

    runs: int
    seconds: float
    entries: list[CellRun]


class FinishedSweep(NamedTuple):
    """A finished sweep, with the effort since it was last started or resumed.

    Attributes:
        results: the results of all runs of the sweep.
        folder: the folder of the sweep.
        runs: number of runs since the start.
        simulated_s: simulated time of these runs, in s.
        wall_s: wall time of these runs, in s.
        jobs: number of worker processes.
    """

    results: SweepResults
    folder: SweepFolder
    runs: int
    simulated_s: float
    wall_s: float
    jobs: int


class CellItem(NamedTuple):
    """Task of a worker: one run of a cell. Picklable and self-contained."""

    plan: SweepPlan
    cell: SweepCell
    seed: int

    def __str__(self) -> str:
        return f"cell {self.cell.number} ({', '.join(self.cell.overrides)}), seed {self.seed}"


def run_cell(task: CellItem) -> CellRun:
    """Runs one cell with one seed; any process can do it.

    Raises:
        ScenarioError: the scenario is not valid or cannot run; the message names the cell.
    """
    plan = task.plan
    cell = task.cell
    try:
        scenario = plan.scenario(*cell.overrides, f"seed={task.seed}")
        sweep_cell.check_sweepable(scenario)
    except ScenarioError as error:
        overrides = ", ".join(cell.overrides)
        raise ScenarioError(f"cell {cell.number} ({overrides}): {error}") from None
    longest_s = max(plan.longest_s, scenario.duration_s)
    outcome = sweep_cell.classify_cell(scenario.text, longest_s)
    if plan.judge == "twins":
        exponent_per_s = sweep_cell.measure_exponent(scenario)
        outcome = msgspec.structs.replace(outcome, exponent_per_s=exponent_per_s)
    metrics: dict[str, float | None] = {}
    # the outcome has the other metrics already: only further metrics need a run with a log
    log_metrics = [key for key in plan.metrics if key not in CellResult.__struct_fields__]
    if log_metrics:
        measured = measure_run(simulate_scenario(scenario), log_metrics)
        metrics = {key: measured[key].value for key in log_metrics}
    laws = dict.fromkeys(identify_law(site.control) for site in scenario.sites.values())
    return CellRun(
        cell=cell.number,
        seed=task.seed,
        random=scenario.random,
        law=", ".join(laws),
        sha256=scenario.sha256,
        scenario=sweep_cell.diff_lines(scenario.text, plan.base.text),
        outcome=outcome,
        metrics=metrics,
    )


def estimate_sweep(
    plan: SweepPlan, done: Iterable[tuple[int, int]] = (), jobs: int | None = None
) -> DurationEstimate:
    """Estimates the duration of a sweep from its first and last cells and some between them.

    Args:
        plan: the sweep.
        done: the finished runs, as pairs of cell number and seed; they are left out.
        jobs: number of worker processes; None: as many as there are cores.
    """
    finished = set(done)
    numbers = dict.fromkeys(n * (plan.cells - 1) // (_PROBES - 1) for n in range(_PROBES))
    seed = plan.seeds[0]
    probes = [
        CellItem(plan, plan.cell(number), seed)
        for number in numbers
        if (number, seed) not in finished
    ]
    if not probes:
        return DurationEstimate(plan.cells * len(plan.seeds) - len(finished), 0.0, [])
    brief_s = min(1.0, plan.base.duration_s)
    brief = plan.scenario(*probes[0].cell.overrides, f"duration_s={brief_s!r}")
    sweep_cell.classify_cell(brief.text, brief_s)  # compiles, once for all processes
    clock = SystemClock()
    started_ns = clock.monotonic_ns()
    entries: list[CellRun] = []
    elapsed_s = 0.0
    for probe in probes:
        entries.append(run_cell(probe))
        elapsed_s = (clock.monotonic_ns() - started_ns) * 1e-9
        if elapsed_s >= _PROBING_S:
            break
    seeds = len(plan.seeds) if any(entry.random for entry in entries) else 1
    runs = max(len(entries), plan.cells * seeds - len(finished))
    workers = min(jobs or count_cores(), runs)
    seconds = elapsed_s / len(entries) * runs / workers
    return DurationEstimate(runs, seconds, entries)


def refuse_oversized_sweep(
    plan: SweepPlan, expected: DurationEstimate, jobs: int | None = None
) -> None:
    """Refuses a sweep of more than `MAX_RUNS` runs or `MAX_SWEEP_S` seconds.

    Raises:
        UsageError: the sweep is too large; the message has its size and estimated duration.
    """
    if expected.runs <= MAX_RUNS and expected.seconds <= MAX_SWEEP_S:
        return
    sizes = " x ".join(str(count) for count in plan.shape if count > 1)
    seeds = f", {count_nouns(len(plan.seeds), 'seed')} each" if len(plan.seeds) > 1 else ""
    cells = count_nouns(plan.cells, "cell")
    cores = count_nouns(jobs or count_cores(), "core")
    raise UsageError(
        f"{cells} ({sizes}{seeds}) would take about {format_wall_time(expected.seconds)} "
        f"on {cores}; larger steps make it fewer, --yes runs it all the same"
    )


def format_wall_time(seconds: float) -> str:
    """Returns a duration as a text with a readable unit, as in "2.5 h"."""
    units = (("days", 86_400.0, 172_800.0), ("h", 3600.0, 5400.0), ("min", 60.0, 90.0))
    for unit, unit_s, smallest_s in units:
        if seconds >= smallest_s:
            return f"{seconds / unit_s:.3g} {unit}"
    return f"{max(1, round(seconds))} s"


def run_sweep(
    folder: SweepFolder,
    jobs: int | None = None,
    progress: executor.Progress = executor.ignore_progress,
    known: Iterable[CellRun] = (),
    on: executor.Workers = None,
) -> FinishedSweep:
    """Runs the remaining runs of a sweep, writes its results, and returns them.

    Args:
        folder: the folder of the sweep; the runs in its journal are not repeated.
        jobs: number of worker processes; None: as many as there are cores.
        progress: called with the number of finished runs and the number of runs known so far.
        known: finished runs, as from an estimate; they enter the journal and are not repeated.
        on: the workers to use; None: processes of this computer.

    Raises:
        ScenarioError: a cell cannot run; the message names it. Finished runs are kept.
        RunFailed: a cell ended its workers, or the cluster is gone. Finished runs are kept.
    """
    plan = folder.plan
    clock = SystemClock()
    with folder.journal() as journal:
        for entry in known:
            journal.add(entry)
        finished_before = set(journal.done)
        started_ns = clock.monotonic_ns()
        left = plan.cells * len(plan.seeds) - len(finished_before)
        laws = list_imported_code([plan.base])
        workers = on if left else None
        with executor.open_worker_pool(
            jobs, workers, most=left, laws=laws, hint=_RESUME_HINT
        ) as pool:
            count = pool.workers
            _run_cells(plan, journal, pool, progress)
        wall_s = (clock.monotonic_ns() - started_ns) * 1e-9
        new_runs = [run for key, run in journal.done.items() if key not in finished_before]
        rows = build_result_rows(plan, list(journal.done.values()))
    results = SweepResults(plan, rows)
    if len(plan.seeds) > 1:
        points = encode_grid_points(plan, collect_grid_points(results))
        write_whole(folder.path / GRID_POINTS_FILE, points, remedy=folder.remedy)
    table = encode_results(plan, rows)
    write_whole(folder.path / RESULTS_FILE, table, remedy=folder.remedy)
    simulated_s = sum(run.outcome.ran_s for run in new_runs)
    return FinishedSweep(
        results=results,
        folder=folder,
        runs=len(new_runs),
        simulated_s=simulated_s,
        wall_s=wall_s,
        jobs=count,
    )


def _run_cells(
    plan: SweepPlan,
    journal: RunJournal[CellRun],
    pool: executor.WorkerPool,
    progress: executor.Progress,
) -> None:
    """Runs all cells with the first seed, then those that draw random numbers with the others.

    Only the first run of a cell tells whether the cell is random.
    """
    first_seed, *other_seeds = plan.seeds

    def run_pending(runs: Iterable[tuple[int, int]], count: int) -> None:
        tasks = (
            CellItem(plan, plan.cell(number), seed)
            for number, seed in runs
            if (number, seed) not in journal.done
        )
        journal.run_pending(pool, run_cell, tasks, len(journal.done), count, progress)

    run_pending(((number, first_seed) for number in range(plan.cells)), plan.cells)
    random_cells = list[int]()
    if other_seeds:
        random_cells = [
            number for number in range(plan.cells) if journal.done[number, first_seed].random
        ]
    repetitions = ((number, seed) for number in random_cells for seed in other_seeds)
    run_pending(repetitions, plan.cells + len(random_cells) * len(other_seeds))


def describe_sweep_speed(speed: FinishedSweep) -> str:
    """Returns the speed of a sweep as a sentence."""
    processes = count_nouns(speed.jobs, "process")
    wall_time = format_wall_time(speed.wall_s)
    ratio = speed.simulated_s / (speed.wall_s * speed.jobs) if speed.wall_s else math.nan
    effort = f"{speed.simulated_s:.4g} s simulated in {wall_time} by {processes}"
    return f"speed: {ratio:.3g} times real time per process; {effort}"
