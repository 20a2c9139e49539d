"""Runs a sweep and stores its results in a folder.

A sweep runs one scenario on a grid of parameters. A cell is one combination of these
parameters; it is run once per seed of the random numbers. The folder of a sweep contains the
plan, a journal to which every finished run is appended, and in the end the results. A sweep
that was interrupted continues after the last finished run.

Invariant:
    - A folder belongs to one sweep on one kind of arithmetic. Any other sweep is refused,
      because its results might differ.
    - The results are a function of the plan. They do not depend on the number of processes, on
      the order of the runs, or on interruptions.
    - A run in the journal is not repeated.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trilat_net.analysis.metrics.log_metrics import measure_run
from trilat_net.errors import (
    CodeFailed,
    ScenarioError,
    UsageError,
    count_nouns,
    format_wall_time,
)
from trilat_net.execution.virtual import simulate_scenario
from trilat_net.files import make_results_folder, write_whole
from trilat_net.net.clock import SystemClock
from trilat_net.own_code.code_consent import list_imported_code
from trilat_net.scenario import Scenario
from trilat_net.scenario.laws import identify_law
from trilat_net.work import executor
from trilat_net.work.study_folder import (
    RunJournal,
    StudyFolder,
    build_resume_hint,
    describe_program,
)
from trilat_net.workers import count_cores

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
"""Name of the journal in the folder of a sweep."""
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
"""Keys of a plan in which two sweeps may differ, with the words for a message. The first key
that differs is reported.
"""


SweepFolder = StudyFolder[SweepPlan, CellRun]
"""Folder of a sweep, with its plan and its journal."""


def _build_folder(path: Path, plan: SweepPlan, facts: Mapping[str, Any]) -> SweepFolder:
    """Returns the object for the folder of a sweep.

    The journal is tied to the digest of the plan, so that runs of another plan are ignored.

    Args:
        path: Path of the folder.
        plan: The sweep: its scenario, axes, control laws and seeds.
        facts: The plan as plain values, with the arithmetic and the versions of the program.
    """
    study = hashlib.sha256(_encode_plan(facts).encode()).hexdigest()
    remedy = build_resume_hint("sweep", "--resume", str(path))

    def open_journal() -> RunJournal[CellRun]:
        return RunJournal(path / JOURNAL_FILE, study, CellRun, remedy)

    return SweepFolder(path, plan, facts, remedy, open_journal)


def prepare_sweep_folder(plan: SweepPlan, path: Path | None) -> SweepFolder:
    """Prepares the folder of a sweep: a new one, or an existing one with finished runs.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        path: Path of the folder. None creates a new folder with a default name.

    Raises:
        UsageError: The folder contains other files or another sweep, or cannot be created.
    """
    if path is not None and (path / PLAN_FILE).exists():
        return open_sweep_folder(path, plan)
    facts = _list_facts(plan)
    folder_path = make_results_folder(path, f"sweep-{plan.base.name}", force=None)
    folder = _build_folder(folder_path, plan, facts)
    write_whole(folder_path / PLAN_FILE, _encode_plan(facts), remedy=folder.remedy)
    return folder


def open_sweep_folder(path: Path, expected: SweepPlan | None = None) -> SweepFolder:
    """Opens the folder of a sweep that was started before.

    Args:
        path: Path of the folder.
        expected: Sweep that the folder must contain. None accepts any sweep that was started
            with the arithmetic and program versions of this process.

    Raises:
        UsageError: The folder contains no sweep, or another sweep.
        ScenarioError: The scenario of the sweep cannot run on this machine.
    """
    stored = _read_facts(path)
    current = _list_facts(expected or plan_from_json(stored))
    for key, difference in _DIFFERENCES.items():
        if stored.get(key) != current.get(key):
            stored_text = _format_fact(key, stored)
            current_text = _format_fact(key, current)
            raise UsageError(
                f"{path}: contains a sweep with {difference}: {stored_text} in the folder, "
                f"{current_text} now; results cannot be mixed: choose another folder"
            )
    return _build_folder(path, plan_from_json(stored), stored)


def _format_fact(key: str, facts: Mapping[str, Any]) -> str:
    """Describes one property of a sweep, so that a message can name how two sweeps differ.

    Examples: "wall (sha256 0123456789ab)" for the scenario, "1..20" for the seeds, "60 s" for
    the longest time, "numpy 2.1, numba 0.60" for the versions.

    Args:
        key: Key of the property in the plan, one of `_DIFFERENCES`. A plan without the key has
            its default: the first judge, or an empty list.
        facts: The plan as plain values.
    """
    default: Any = JUDGES[0] if key == "judge" else []
    value = facts.get(key, default)

    # The text of a scenario is too long for a message. Its name and hash identify it.
    if key in ("text", "scenario_sha256"):
        digest = str(value)
        if key == "text":
            digest = hashlib.sha256(digest.encode()).hexdigest()
        scenario_name = facts.get("name")
        return f"{scenario_name} (sha256 {digest[:12]})"

    is_version_table = isinstance(value, dict)
    if is_version_table:
        versions = [
            f"{name.removeprefix('version_')} {version}" for name, version in value.items()
        ]
        return ", ".join(versions)

    if isinstance(value, list):
        if key == "seeds" and value:
            first_seed = value[0]
            last_seed = value[-1]
            is_range = value == list(range(first_seed, last_seed + 1))
            if is_range:
                return f"{first_seed}..{last_seed}"
        return ", ".join(map(str, value)) or "none"

    is_duration = isinstance(value, float)
    return f"{value:g} s" if is_duration else str(value)


def _read_facts(path: Path) -> dict[str, Any]:
    """Reads the plan in the folder of a sweep as plain values.

    Raises:
        UsageError: The folder has no plan, or the plan cannot be read.
    """
    file = path / PLAN_FILE
    try:
        facts = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise UsageError(
            f"{path}: this folder contains no sweep: {PLAN_FILE} is missing"
        ) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "is not JSON"
        raise UsageError(f"{file}: cannot be read: {reason}") from None
    # A plan with the default judge and without metrics does not store these keys.
    optional = {"judge", "metrics"}
    required = {"source", "folder", "name", *_DIFFERENCES} - optional
    if not isinstance(facts, dict) or not required <= facts.keys():
        raise UsageError(f"{file}: is not the plan of a sweep")
    return facts


def _list_facts(plan: SweepPlan) -> dict[str, Any]:
    """Returns a plan as plain values, with the arithmetic and versions of this program."""
    arithmetic, versions = describe_program()
    return {**plan.facts(), "arithmetic": arithmetic, "versions": versions}


def _encode_plan(facts: Mapping[str, Any]) -> str:
    """Returns the text of the plan file. Equal plans have equal bytes."""
    return json.dumps(facts, indent=2, ensure_ascii=False, sort_keys=True) + "\n"


MAX_RUNS = 1_000_000
"""Number of runs above which the user must confirm a sweep."""
MAX_SWEEP_S = 86_400.0
"""Estimated duration above which the user must confirm a sweep, in s of real time."""
_PROBES = 7
"""Largest number of runs from which the duration of a sweep is estimated."""
_PROBING_S = 3.0
"""Time after which the estimate starts no further run, in s of real time."""
_RESUME_HINT = "; finished runs are kept: continue with --resume"
"""Advice for the user after a worker died."""


class DurationEstimate(NamedTuple):
    """Estimated duration of the runs of a sweep that remain.

    Attributes:
        runs: Largest possible number of runs that remain.
        seconds: Estimated duration of these runs, in s of real time.
        entries: Runs that were made for the estimate. The sweep does not repeat them.
    """

    runs: int
    seconds: float
    entries: list[CellRun]


class FinishedSweep(NamedTuple):
    """Results of a finished sweep, with the time and the number of runs that it took.

    The numbers of runs and times count from the last start or resumption of the sweep.

    Attributes:
        results: Results of all runs of the sweep.
        folder: Folder of the sweep.
        runs: Number of runs since the last start.
        simulated_s: Simulated time of these runs together, in s.
        wall_s: Real time that these runs took, in s.
        jobs: Number of worker processes.
        alone: Reasons why runs were not computed side by side with others, with the number of
            these runs. Runs of a sweep that computes all runs one by one are not counted.
    """

    results: SweepResults
    folder: SweepFolder
    runs: int
    simulated_s: float
    wall_s: float
    jobs: int
    alone: Mapping[str, int] = {}


class CellItem(NamedTuple):
    """One run of a sweep as an item for a worker process. It can be pickled.

    Attributes:
        plan: The sweep: its scenario, axes, control laws and seeds.
        cell: The values of all axes and the control law of the run.
        seed: Seed of the run.
    """

    plan: SweepPlan
    cell: SweepCell
    seed: int

    def __str__(self) -> str:
        return f"cell {self.cell.number} ({', '.join(self.cell.overrides)}), seed {self.seed}"


def run_cell(task: CellItem) -> CellRun:
    """Executes one run of a sweep.

    The function needs nothing but its argument. Therefore any worker process can call it.

    Args:
        task: The run.

    Returns:
        The finished run with its result, ready for the journal of the sweep.

    Raises:
        ScenarioError: The scenario is not valid or cannot run. The message names the cell.
    """
    scenario = _build_scenario(task)
    outcome = sweep_cell.classify_cell(scenario.text, task.plan.longest_s)
    return _complete_run(task, scenario, outcome)


def run_cells(tasks: Sequence[CellItem]) -> Iterator[CellRun]:
    """Executes several runs of a sweep, side by side where that is possible.

    Args:
        tasks: The runs, of one sweep.

    Yields:
        The finished runs in the order of the tasks, equal to those of `run_cell`.

    Raises:
        ScenarioError: The scenario of a run is not valid or cannot run. The runs before it are
            yielded first.
    """
    scenarios = []
    problem = None
    for task in tasks:
        try:
            scenarios.append(_build_scenario(task))
        except ScenarioError as error:
            problem = error
            break
    texts = [scenario.text for scenario in scenarios]
    try:
        judged_cells = list(sweep_cell.classify_cells(texts, tasks[0].plan.longest_s))
    except CodeFailed:
        # One by one, the runs before the one whose code fails are kept.
        for task in tasks:
            yield run_cell(task)
        return
    for task, scenario, judged in zip(tasks, scenarios, judged_cells, strict=False):
        run = _complete_run(task, scenario, judged.result)
        yield msgspec.structs.replace(run, alone=judged.obstacle)
    if problem is not None:
        raise problem


def _build_scenario(task: CellItem) -> Scenario:
    """Returns the scenario of a run of a sweep.

    Raises:
        ScenarioError: The scenario is not valid or cannot run. The message names the cell.
    """
    cell = task.cell
    try:
        scenario = task.plan.scenario(*cell.overrides, f"seed={task.seed}")
        sweep_cell.check_sweepable(scenario)
    except ScenarioError as error:
        overrides = ", ".join(cell.overrides)
        raise ScenarioError(f"cell {cell.number} ({overrides}): {error}") from None
    return scenario


def _complete_run(task: CellItem, scenario: Scenario, outcome: CellResult) -> CellRun:
    """Measures what the sweep needs besides the class of a cell, and returns the whole result.

    Args:
        task: The run.
        scenario: Its scenario.
        outcome: Its class.
    """
    plan = task.plan
    if plan.judge == "twins":
        exponent_per_s = sweep_cell.measure_exponent(scenario)
        outcome = msgspec.structs.replace(outcome, exponent_per_s=exponent_per_s)

    # Metrics that are not fields of the result require a second run, which records a log.
    metrics: dict[str, float | None] = {}
    log_metrics = [key for key in plan.metrics if key not in CellResult.__struct_fields__]
    if log_metrics:
        measured = measure_run(simulate_scenario(scenario), log_metrics)
        metrics = {key: measured[key].value for key in log_metrics}

    laws = dict.fromkeys(identify_law(site.control) for site in scenario.sites.values())
    return CellRun(
        cell=task.cell.number,
        seed=task.seed,
        random=scenario.random,
        law=", ".join(laws),
        sha256=scenario.sha256,
        scenario=sweep_cell.diff_lines(scenario.text, plan.base.text),
        outcome=outcome,
        metrics=metrics,
    )


LANE_RUNS = 32
"""Number of runs that a worker gets at once, to compute them side by side."""
LANE_SITE_TICKS = 100_000_000
"""Number of site ticks from which a sweep compiles the code for several runs side by side.

The compilation takes some ten seconds per kind of site. The code then saves about 0.4 us per
site tick.
"""


def _uses_lanes(plan: SweepPlan, runs: int) -> bool:
    """Returns True if the runs of a sweep are to be computed side by side.

    Args:
        plan: The sweep.
        runs: Number of runs that remain.
    """
    rates_hz = [spec.rate_hz for spec in plan.base.sites.values()]
    site_ticks = runs * plan.base.duration_s * sum(rates_hz)
    return site_ticks >= LANE_SITE_TICKS


def _compile_lanes(plan: SweepPlan) -> None:
    """Compiles the code for several runs side by side, once for all worker processes.

    Args:
        plan: The sweep. The code is that of its first cell.
    """
    from trilat_net.execution.lanes import prepare_lanes

    scenario = _build_scenario(CellItem(plan, plan.cell(0), plan.seeds[0]))
    prepare_lanes(scenario, LANE_RUNS, least_site_ticks=0)


def describe_runs_alone(finished: FinishedSweep) -> str:
    """Returns a sentence on runs that were not computed side by side, and why.

    Args:
        finished: The finished sweep.

    Returns:
        The numbers of these runs and of all runs, and the reasons. Empty if there are none.
    """
    if not finished.alone:
        return ""
    all_runs = count_nouns(len(finished.results.rows), "run")
    reasons = ", ".join(f"{reason} ({count})" for reason, count in finished.alone.items())
    count = sum(finished.alone.values())
    return f"{count} of {all_runs} were computed one by one: {reasons}"


def estimate_sweep(
    plan: SweepPlan, done: Iterable[tuple[int, int]] = (), jobs: int | None = None
) -> DurationEstimate:
    """Estimates the duration of a sweep by running a few cells that are spread over the grid.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        done: Finished runs, as pairs of cell number and seed. They need not be run any more.
        jobs: Number of worker processes of the sweep. None stands for all cores.
    """
    finished = set(done)
    last_cell = plan.cells - 1
    numbers = dict.fromkeys(n * last_cell // (_PROBES - 1) for n in range(_PROBES))
    seed = plan.seeds[0]
    probes = [
        CellItem(plan, plan.cell(number), seed)
        for number in numbers
        if (number, seed) not in finished
    ]
    if not probes:
        return DurationEstimate(plan.cells * len(plan.seeds) - len(finished), 0.0, [])

    # A short run first: it compiles the simulation kernel, once for all processes.
    brief_s = min(1.0, plan.base.duration_s)
    brief = plan.scenario(*probes[0].cell.overrides, f"duration_s={brief_s!r}")
    sweep_cell.classify_cell(brief.text, brief_s)

    clock = SystemClock()
    started_ns = clock.monotonic_ns()
    entries: list[CellRun] = []
    elapsed_s = 0.0
    for probe in probes:
        entries.append(run_cell(probe))
        elapsed_s = (clock.monotonic_ns() - started_ns) * 1e-9
        if elapsed_s >= _PROBING_S:
            break

    # If nothing is random, a cell is run with one seed only.
    seeds = len(plan.seeds) if any(entry.random for entry in entries) else 1
    runs = max(len(entries), plan.cells * seeds - len(finished))
    workers = min(jobs or count_cores(), runs)
    seconds = elapsed_s / len(entries) * runs / workers
    return DurationEstimate(runs, seconds, entries)


def refuse_oversized_sweep(
    plan: SweepPlan, expected: DurationEstimate, jobs: int | None = None
) -> None:
    """Refuses a sweep of more than `MAX_RUNS` runs or `MAX_SWEEP_S` seconds.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        expected: Estimated duration of the sweep.
        jobs: Number of worker processes. None stands for all cores.

    Raises:
        UsageError: The sweep is too large. The message states its size and duration.
    """
    if expected.runs <= MAX_RUNS and expected.seconds <= MAX_SWEEP_S:
        return
    sizes = " x ".join(str(count) for count in plan.shape if count > 1)
    seeds = f", {count_nouns(len(plan.seeds), 'seed')} each" if len(plan.seeds) > 1 else ""
    cells = count_nouns(plan.cells, "cell")
    cores = count_nouns(jobs or count_cores(), "core")
    raise UsageError(
        f"{cells} ({sizes}{seeds}) would take about {format_wall_time(expected.seconds)} "
        f"on {cores}; use larger steps for fewer cells, or run the sweep anyway with --yes"
    )


def run_sweep(
    folder: SweepFolder,
    jobs: int | None = None,
    progress: executor.Progress = executor.ignore_progress,
    known: Iterable[CellRun] = (),
    on: executor.Workers = None,
) -> FinishedSweep:
    """Runs the remaining runs of a sweep, and writes the results into its folder.

    Args:
        folder: Folder of the sweep. The runs in its journal are not repeated.
        jobs: Number of worker processes. None uses all cores.
        progress: Function that is called with the number of finished runs and the number of
            runs that are known to be necessary.
        known: Finished runs, for example from an estimate. They enter the journal and are not
            repeated.
        on: Workers to use instead of processes of this computer.

    Raises:
        ScenarioError: A cell cannot run. The message names the cell. Finished runs are kept.
        RunFailed: A cell killed its workers, or the cluster is gone. Finished runs are kept.
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
        workers = on if left else None  # no cluster is needed if nothing is left to run
        with executor.open_worker_pool(
            jobs, workers, most=left, laws=laws, hint=_RESUME_HINT
        ) as pool:
            count = pool.workers
            _run_cells(plan, journal, pool, progress)
        wall_s = (clock.monotonic_ns() - started_ns) * 1e-9
        new_runs = [run for key, run in journal.done.items() if key not in finished_before]
        rows = build_result_rows(plan, list(journal.done.values()))
        reasons = [run.alone for run in journal.done.values() if run.alone]

    results = SweepResults(plan, rows)
    if len(plan.seeds) > 1:
        points = encode_grid_points(plan, collect_grid_points(results))
        write_whole(folder.path / GRID_POINTS_FILE, points, remedy=folder.remedy)
    table = encode_results(plan, rows)
    write_whole(folder.path / RESULTS_FILE, table, remedy=folder.remedy)
    return FinishedSweep(
        results=results,
        folder=folder,
        runs=len(new_runs),
        simulated_s=sum(run.outcome.ran_s for run in new_runs),
        wall_s=wall_s,
        jobs=count,
        alone=Counter(reasons),
    )


def _run_cells(
    plan: SweepPlan,
    journal: RunJournal[CellRun],
    pool: executor.WorkerPool,
    progress: executor.Progress,
) -> None:
    """Runs all cells with the first seed, and then the random cells with the other seeds.

    Only the first run of a cell shows whether anything in the cell is random.

    Args:
        plan: The sweep: its scenario, axes, control laws and seeds.
        journal: Journal, to which the runs are added.
        pool: Workers that execute the runs.
        progress: Function that is called as for `run_sweep`.
    """
    first_seed, *other_seeds = plan.seeds

    def execute_missing_runs(runs: Iterable[tuple[int, int]], run_count: int) -> None:
        """Executes runs of the sweep, except runs that the journal contains already.

        The plan, the journal, the workers and the progress function are those of `_run_cells`.
        The journal sends the runs to the workers, and stores the results.

        Args:
            runs: Pairs of the number of a cell, a combination of parameters, and a seed.
            run_count: Number of all runs of the sweep so far, with those in the journal, for
                the progress.
        """
        missing_runs = (
            CellItem(plan, plan.cell(number), seed)
            for number, seed in runs
            if (number, seed) not in journal.done
        )
        runs_side_by_side = _uses_lanes(plan, run_count - len(journal.done))
        if runs_side_by_side:
            _compile_lanes(plan)
        journal.run_pending(
            pool=pool,
            run=run_cell,
            tasks=missing_runs,
            done=len(journal.done),
            total=run_count,
            show=progress,
            together=run_cells if runs_side_by_side else None,
            together_count=LANE_RUNS if runs_side_by_side else 1,
        )

    first_runs = ((number, first_seed) for number in range(plan.cells))
    execute_missing_runs(first_runs, plan.cells)

    random_cells = list[int]()
    if other_seeds:
        random_cells = [
            number for number in range(plan.cells) if journal.done[number, first_seed].random
        ]
    repetitions = ((number, seed) for number in random_cells for seed in other_seeds)
    run_count = plan.cells + len(random_cells) * len(other_seeds)
    execute_missing_runs(repetitions, run_count)


def describe_sweep_speed(speed: FinishedSweep) -> str:
    """Returns a sentence on how fast the runs were computed in relation to real time.

    Args:
        speed: The finished sweep, with the simulated and the real time of its runs.
    """
    processes = count_nouns(speed.jobs, "process")
    wall_time = format_wall_time(speed.wall_s)
    ratio = speed.simulated_s / (speed.wall_s * speed.jobs) if speed.wall_s else math.nan
    effort = f"{speed.simulated_s:.4g} s simulated in {wall_time} by {processes}"
    return f"speed: {ratio:.3g} times real time per process; {effort}"
