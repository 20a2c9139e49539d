"""Runs a sweep in its folder, which has the plan, the journal of finished runs, and at the end
the results.

Invariant: a folder belongs to one sweep on one arithmetic; any other is refused and never mixed
in. Results are a function of the plan; the number of processes, their order and the number of
interruptions do not enter. A run that is in the journal is never made again.
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
"""What two sweeps may differ in, in words, in the order of messages."""


SweepFolder = StudyFolder[SweepPlan, CellRun]


def _folder(path: Path, plan: SweepPlan, facts: Mapping[str, Any]) -> SweepFolder:
    study = hashlib.sha256(_text(facts).encode()).hexdigest()
    remedy = build_resume_hint("sweep", "--resume", str(path))
    return SweepFolder(
        path,
        plan,
        facts,
        remedy,
        lambda: RunJournal(path / JOURNAL_FILE, study, CellRun, remedy),
    )


def prepare_sweep_folder(plan: SweepPlan, path: Path | None) -> SweepFolder:
    """Returns the folder of a sweep, made, or as it was left.

    Raises:
        UsageError: it holds something else, or another sweep, or cannot be made.
    """
    if path is not None and (path / PLAN_FILE).exists():
        return open_sweep_folder(path, plan)
    facts = _describe(plan)
    chosen = make_results_folder(path, f"sweep-{plan.base.name}", force=None)
    folder = _folder(chosen, plan, facts)
    write_whole(chosen / PLAN_FILE, _text(facts), remedy=folder.remedy)
    return folder


def open_sweep_folder(path: Path, asked: SweepPlan | None = None) -> SweepFolder:
    """Returns the folder of a sweep that was begun.

    Args:
        path: of the folder.
        asked: the sweep that it must hold; None: any that this arithmetic and program began.

    Raises:
        UsageError: there is none, or it is another one.
        ScenarioError: its scenario cannot run here.
    """
    before = _read(path)
    now = _describe(asked or plan_from_json(before))
    for key, words in _DIFFERENCES.items():
        if before.get(key) != now.get(key):
            there, here = (_shown(key, facts) for facts in (before, now))
            raise UsageError(
                f"{path}: holds a sweep of {words}: there {there}, here {here}; results are not mixed: "
                "choose another folder"
            )
    return _folder(path, plan_from_json(before), before)


def _shown(key: str, facts: Mapping[str, Any]) -> str:
    value = facts.get(key, JUDGES[0] if key == "judge" else [])
    if key in ("text", "scenario_sha256"):
        digest = (
            hashlib.sha256(str(value).encode()).hexdigest() if key == "text" else str(value)
        )
        return f"{facts.get('name')} (sha256 {digest[:12]})"
    if isinstance(value, dict):
        return ", ".join(
            f"{name.removeprefix('version_')} {one}" for name, one in value.items()
        )
    if (
        key == "seeds"
        and isinstance(value, list)
        and value == list(range(value[0], value[-1] + 1))
    ):
        return f"{value[0]}..{value[-1]}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g} s" if isinstance(value, float) else str(value)


def _read(path: Path) -> dict[str, Any]:
    file = path / PLAN_FILE
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(f"{path}: no sweep was begun there: it has no {PLAN_FILE}") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "is not JSON"
        raise UsageError(f"{file}: cannot be read: {reason}") from None
    # older plans name none
    needed = {"source", "folder", "name", *_DIFFERENCES} - {
        "judge",
        "metrics",
    }
    if not isinstance(facts, dict) or not needed <= facts.keys():
        raise UsageError(f"{file}: is no plan of a sweep")
    return facts


def _describe(plan: SweepPlan) -> dict[str, Any]:
    arithmetic, versions = describe_program()
    return {**plan.facts(), "arithmetic": arithmetic, "versions": versions}


def _text(facts: Mapping[str, Any]) -> str:
    return json.dumps(facts, indent=2, ensure_ascii=False, sort_keys=True) + "\n"


MAX_RUNS = 1_000_000
MAX_SWEEP_S = 86_400.0
"""A sweep of more runs, or one that would take longer, needs a confirmation."""
_PROBES = 7
_PROBING_S = 3.0
"""Runs of an estimate; fewer, once they have taken so long."""
_RESUME_HINT = "; what is done is kept: go on with --resume"


class DurationEstimate(NamedTuple):
    """Duration of the runs that a sweep has left at most, estimated by a few of them, which are
    done then.
    """

    runs: int
    seconds: float
    entries: list[CellRun]


class FinishedSweep(NamedTuple):
    """A finished sweep, and what was run of it this time.

    Attributes:
        results: of all its runs.
        folder: where they are.
        runs, simulated_s: how many runs and how much time of the experiment were simulated, in
        wall_s, jobs: so long by so many processes.
    """

    results: SweepResults
    folder: SweepFolder
    runs: int
    simulated_s: float
    wall_s: float
    jobs: int


class CellItem(NamedTuple):
    """One run of a cell, to be made: picklable, with all that a worker needs."""

    plan: SweepPlan
    cell: SweepCell
    seed: int

    def __str__(self) -> str:
        return f"cell {self.cell.number} ({', '.join(self.cell.overrides)}), seed {self.seed}"


def run_cell(task: CellItem) -> CellRun:
    """Runs one task, in whatever process.

    Raises:
        ScenarioError: there is no such experiment; says of which cell.
    """
    plan = task.plan
    cell = task.cell
    try:
        scenario = plan.scenario(*cell.overrides, f"seed={task.seed}")
        sweep_cell.check_sweepable(scenario)
    except ScenarioError as error:
        raise ScenarioError(
            f"cell {cell.number} ({', '.join(cell.overrides)}): {error}"
        ) from None
    outcome = sweep_cell.classify_cell(scenario.text, max(plan.longest_s, scenario.duration_s))
    if plan.judge == "twins":
        outcome = msgspec.structs.replace(
            outcome, exponent_per_s=sweep_cell.measure_exponent(scenario)
        )
    metrics: dict[str, float | None] = {}
    if further := [key for key in plan.metrics if key not in CellResult.__struct_fields__]:
        measured = measure_run(simulate_scenario(scenario), further)
        metrics = {key: measured[key].value for key in further}
    laws = ", ".join(
        dict.fromkeys(identify_law(site.control) for site in scenario.sites.values())
    )
    text = sweep_cell.diff_lines(scenario.text, plan.base.text)
    return CellRun(
        cell.number, task.seed, scenario.random, laws, scenario.sha256, text, outcome, metrics
    )


def estimate_sweep(
    plan: SweepPlan, done: Iterable[tuple[int, int]] = (), jobs: int | None = None
) -> DurationEstimate:
    """Returns how long a sweep will take, by its first and last run and some between.

    The runs of cells and seeds that are `done` already are left out.
    """
    known = set(done)
    places = dict.fromkeys(n * (plan.cells - 1) // (_PROBES - 1) for n in range(_PROBES))
    seed = plan.seeds[0]
    probes = [CellItem(plan, plan.cell(n), seed) for n in places if (n, seed) not in known]
    if not probes:
        return DurationEstimate(plan.cells * len(plan.seeds) - len(known), 0.0, [])
    brief_s = min(1.0, plan.base.duration_s)
    warm = plan.scenario(*probes[0].cell.overrides, f"duration_s={brief_s!r}")
    sweep_cell.classify_cell(warm.text, brief_s)  # compiles, once for all processes
    clock = SystemClock()
    began_ns = clock.monotonic_ns()
    entries: list[CellRun] = []
    took_s = 0.0
    while len(entries) < len(probes) and took_s < _PROBING_S:
        entries.append(run_cell(probes[len(entries)]))
        took_s = (clock.monotonic_ns() - began_ns) * 1e-9
    seeds = len(plan.seeds) if any(entry.random for entry in entries) else 1
    left = max(len(entries), plan.cells * seeds - len(known))
    return DurationEstimate(
        left, took_s / len(entries) * left / min(jobs or count_cores(), left), entries
    )


def refuse_oversized_sweep(
    plan: SweepPlan, expected: DurationEstimate, jobs: int | None = None
) -> None:
    """Refuses a sweep of very many runs, or of more than a day.

    Raises:
        UsageError: it is one; says how many runs, and how long they would take.
    """
    if expected.runs <= MAX_RUNS and expected.seconds <= MAX_SWEEP_S:
        return
    sizes = " x ".join(str(count) for count in plan.shape if count > 1)
    seeds = f", {count_nouns(len(plan.seeds), 'seed')} each" if len(plan.seeds) > 1 else ""
    raise UsageError(
        f"{count_nouns(plan.cells, 'cell')} ({sizes}{seeds}) would take about "
        f"{format_wall_time(expected.seconds)} on "
        ""
        f"{count_nouns(jobs or count_cores(), 'core')}; larger steps make it fewer, --yes "
        "runs it all the same"
    )


def format_wall_time(seconds: float) -> str:
    """Returns a duration for people."""
    for unit, size, from_s in (
        ("days", 86_400.0, 172_800.0),
        ("h", 3600.0, 5400.0),
        ("min", 60.0, 90.0),
    ):
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

    What the journal of the folder has, and the runs that are `known` from an estimate, are not
    made again; `progress` gets the runs that are done, and their number as far as it is known.

    Raises:
        ScenarioError: a cell cannot run; says which. What is done is kept.
        RunFailed: a cell ended its workers, or the cluster is gone. What is done is kept.
    """
    plan = folder.plan
    clock = SystemClock()
    with folder.journal() as journal:
        for entry in known:
            journal.add(entry)
        before = set(journal.done)
        began_ns = clock.monotonic_ns()
        left = plan.cells * len(plan.seeds) - len(before)
        laws = list_imported_code([plan.base])
        workers = on if left else None
        with executor.open_worker_pool(
            jobs, workers, most=left, laws=laws, hint=_RESUME_HINT
        ) as pool:
            count = pool.workers
            _run_cells(plan, journal, pool, progress)
        wall_s = (clock.monotonic_ns() - began_ns) * 1e-9
        made = [entry for key, entry in journal.done.items() if key not in before]
        rows = build_result_rows(plan, list(journal.done.values()))
    results = SweepResults(plan, rows)
    if len(plan.seeds) > 1:
        points = encode_grid_points(plan, collect_grid_points(results))
        write_whole(folder.path / GRID_POINTS_FILE, points, remedy=folder.remedy)
    table = encode_results(plan, rows)
    write_whole(folder.path / RESULTS_FILE, table, remedy=folder.remedy)
    simulated_s = sum(entry.outcome.ran_s for entry in made)
    return FinishedSweep(
        results=results,
        folder=folder,
        runs=len(made),
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
    first, *others = plan.seeds

    def make(runs: Iterable[tuple[int, int]], count: int) -> None:
        tasks = (
            CellItem(plan, plan.cell(n), seed)
            for n, seed in runs
            if (n, seed) not in journal.done
        )
        journal.run_pending(pool, run_cell, tasks, len(journal.done), count, progress)

    make(((number, first) for number in range(plan.cells)), plan.cells)
    again = [
        number for number in range(plan.cells) if others and journal.done[number, first].random
    ]
    make(
        ((number, seed) for number in again for seed in others),
        plan.cells + len(again) * len(others),
    )


def describe_sweep_speed(speed: FinishedSweep) -> str:
    """Returns the speed in words."""
    on = count_nouns(speed.jobs, "process")
    times = speed.simulated_s / (speed.wall_s * speed.jobs) if speed.wall_s else math.nan
    took = f"{speed.simulated_s:.4g} s simulated in {format_wall_time(speed.wall_s)} by {on}"
    return f"speed: {times:.3g} times real time per process; {took}"
