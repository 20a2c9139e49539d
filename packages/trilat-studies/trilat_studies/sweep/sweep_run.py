"""Runs a sweep and stores its results in a folder.

A sweep runs one scenario over a grid of parameters, and each cell of the grid is run once per
random seed. The folder contains the plan, a journal to which every finished run is appended,
and finally the results. An interrupted sweep continues after the last finished run.

Invariant:
    - A folder belongs to one sweep and one kind of floating-point arithmetic. Any other
      combination is rejected, because its results might differ.
    - The results depend only on the plan, not on the number of processes, the order of the runs
      or interruptions.
    - A run in the journal is not repeated.
"""

import hashlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trilat_net.analysis import SETTLED_ERROR_RAD, LogMetrics, RunEnd, TwinGrowth
from trilat_net.errors import (
    CodeFailed,
    CodeWithheld,
    LogRefused,
    ScenarioError,
    UsageError,
    count_nouns,
    format_wall_time,
)
from trilat_net.execution import FusedRun, SimulatedLog
from trilat_net.files import make_results_folder, write_whole
from trilat_net.net import SystemClock
from trilat_net.scenario import Scenario
from trilat_net.work import Progress, RunJournal, WorkerPool, Workers

from ..measure_run import describe_program
from ..side_by_side import LANE_SITE_TICKS
from ..study_folder import StudyFolder
from . import sweep_cell
from .cell_groups import CellGroups
from .edge_refinement import NOT_KNOWN, EdgeRefinement
from .result_table import ResultRow, ResultTable
from .sweep_cell import CellClass, CellResult, CellRun
from .sweep_plan import JUDGES, SweepCell, SweepPlan
from .sweep_results import GRID_POINTS_FILE, PLAN_FILE, RESULTS_FILE, SweepResults

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
    "refine": "another refinement",
    "arithmetic": "another kind of arithmetic",
    "versions": "another version of the program",
}
"""Keys of a plan in which two sweeps may differ, each with a phrase for an error message. The
first key that differs is reported.
"""


SweepFolder = StudyFolder[SweepPlan, RunJournal[CellRun]]
"""Folder of a sweep, with its plan and its journal."""


def _build_folder(path: Path, plan: SweepPlan, facts: Mapping[str, Any]) -> SweepFolder:
    """Returns the object that reads and continues the folder of a sweep.

    Its journal is tied to the digest of the plan, so runs of another plan are ignored.

    Args:
        path: Path of the folder.
        plan: The sweep.
        facts: The plan as plain values, with the arithmetic and the versions of the program.
    """
    plan_digest = hashlib.sha256(_encode_plan(facts).encode()).hexdigest()
    remedy = RunJournal.build_resume_hint("sweep", "--resume", str(path))

    def open_journal() -> RunJournal[CellRun]:
        return RunJournal(path / JOURNAL_FILE, plan_digest, CellRun, remedy)

    return SweepFolder(path, plan, facts, remedy, open_journal)


def prepare_sweep_folder(plan: SweepPlan, path: Path | None) -> SweepFolder:
    """Creates the folder of a sweep, or reopens one that already has finished runs.

    Args:
        plan: The sweep.
        path: Path of the folder. If `None`, a new folder with a default name is created.

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
    """Opens the folder of a sweep that was started earlier.

    Args:
        path: Path of the folder.
        expected: Sweep that the folder must contain. If `None`, any sweep is accepted that was
            started with the same program versions, on a machine with the same floating-point
            arithmetic.

    Raises:
        UsageError: The folder contains no sweep, or another sweep.
        ScenarioError: The scenario of the sweep cannot run on this machine.
    """
    stored = _read_facts(path)
    current = _list_facts(expected or SweepPlan.from_facts(stored))
    for key, difference in _DIFFERENCES.items():
        if stored.get(key) != current.get(key):
            stored_text = _format_fact(key, stored)
            current_text = _format_fact(key, current)
            raise UsageError(
                f"{path} contains a sweep with {difference}: {stored_text} in the folder, "
                f"{current_text} now; results cannot be mixed: choose another folder"
            )
    return _build_folder(path, SweepPlan.from_facts(stored), stored)


def _format_fact(key: str, facts: Mapping[str, Any]) -> str:
    """Formats one property of a sweep for messages about how two sweeps differ.

    Examples: "wall (sha256 0123456789ab)" for the scenario, "1..20" for the seeds, "60 s" for
    the longest duration, "numpy 2.1, numba 0.60" for the versions.

    Args:
        key: Key of the property in the plan, one of `_DIFFERENCES`. A missing key stands for
            the default: the first judge, no refinement, or an empty list.
        facts: The plan as plain values.
    """
    defaults: dict[str, Any] = {"judge": JUDGES[0], "refine": 0}
    value = facts.get(key, defaults.get(key, []))

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
        raise UsageError(f"{path} contains no sweep: {PLAN_FILE} is missing") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "is not JSON"
        raise UsageError(f"{file} cannot be read: {reason}") from None
    # A plan does not store these keys if they have their defaults.
    optional = {"judge", "metrics", "refine"}
    required = {"source", "folder", "name", *_DIFFERENCES} - optional
    if not isinstance(facts, dict) or not required <= facts.keys():
        raise UsageError(f"{file} is not the plan of a sweep")
    return facts


def _list_facts(plan: SweepPlan) -> dict[str, Any]:
    """Returns a plan as plain values, with the arithmetic and versions of this program."""
    arithmetic, versions = describe_program()
    return {**plan.facts(), "arithmetic": arithmetic, "versions": versions}


def _encode_plan(facts: Mapping[str, Any]) -> str:
    """Encodes the plan of a sweep for its file. Equal plans give identical bytes."""
    return json.dumps(facts, indent=2, ensure_ascii=False, sort_keys=True) + "\n"


MAX_RUNS = 1_000_000
"""Number of runs above which the user must confirm a sweep."""
MAX_SWEEP_S = 86_400.0
"""Estimated duration above which the user must confirm a sweep, in s of real time."""
_PROBES = 7
"""Largest number of runs used to estimate the duration of a sweep."""
_PROBING_S = 3.0
"""Time after which no further run is started for the estimate, in s of real time."""
_RESUME_HINT = "; finished runs are kept: continue with --resume"
"""Advice for the user after a worker died."""


class DurationEstimate(NamedTuple):
    """Estimated duration of the remaining runs of a sweep.

    Attributes:
        runs: Largest possible number of remaining runs.
        seconds: Estimated duration of these runs, in s of real time.
        entries: Runs that were executed for the estimate. The sweep does not repeat them.
    """

    runs: int
    seconds: float
    entries: list[CellRun]

    @classmethod
    def of_sweep(
        cls, plan: SweepPlan, done: Iterable[tuple[int, int]] = (), jobs: int | None = None
    ) -> "DurationEstimate":
        """Estimates the duration of a sweep from a few runs spread over its parameters.

        Args:
            plan: The sweep.
            done: Finished runs, as pairs of cell number and seed. These runs are not repeated.
            jobs: Number of worker processes of the sweep. If `None`, one per core.
        """
        finished_runs = set(done)
        refinement = EdgeRefinement(plan) if plan.refine else None
        # A refined sweep must run only the cells that it chooses.
        cells = refinement.list_coarse_cells() if refinement else range(plan.cells)
        cell_count = refinement.count_most_cells() if refinement else plan.cells
        last_cell = len(cells) - 1
        # evenly spread cells without repetitions
        probe_cells = dict.fromkeys(
            cells[n * last_cell // (_PROBES - 1)] for n in range(_PROBES)
        )
        seed = plan.seeds[0]
        probes = [
            CellItem(plan, plan.cell(number), seed)
            for number in probe_cells
            if (number, seed) not in finished_runs
        ]
        if not probes:
            runs = max(0, cell_count * len(plan.seeds) - len(finished_runs))
            return cls(runs, 0.0, [])

        # A short run first compiles the simulation kernel, once for all processes.
        warm_up_s = min(1.0, plan.base.duration_s)
        if plan.judge != "linear":
            with suppress(ScenarioError):
                warm_up = plan.scenario(*probes[0].cell.overrides, f"duration_s={warm_up_s!r}")
                sweep_cell.classify_cell(warm_up.text, warm_up_s)

        clock = SystemClock()
        started_ns = clock.monotonic_ns()
        entries: list[CellRun] = []
        elapsed_s = 0.0
        for probe in probes:
            entries.append(probe.run())
            elapsed_s = (clock.monotonic_ns() - started_ns) * 1e-9
            if elapsed_s >= _PROBING_S:
                break

        # If nothing is random, a cell is run with one seed only.
        seeds = len(plan.seeds) if any(entry.random for entry in entries) else 1
        runs = max(len(entries), cell_count * seeds - len(finished_runs))
        workers = min(WorkerPool.count_workers(jobs), runs)
        seconds = elapsed_s / len(entries) * runs / workers
        return cls(runs, seconds, entries)

    def refuse_oversized_sweep(self, plan: SweepPlan, jobs: int | None = None) -> None:
        """Raises UsageError if a sweep exceeds `MAX_RUNS` runs or `MAX_SWEEP_S` seconds.

        Args:
            plan: The sweep.
            jobs: Number of worker processes. If `None`, one per core.

        Raises:
            UsageError: The sweep is too large. The message states its size and duration.
        """
        if self.runs <= MAX_RUNS and self.seconds <= MAX_SWEEP_S:
            return
        sizes = " x ".join(str(count) for count in plan.shape if count > 1)
        seeds = f", {count_nouns(len(plan.seeds), 'seed')} each" if len(plan.seeds) > 1 else ""
        cells = count_nouns(plan.cells, "cell")
        cores = count_nouns(WorkerPool.count_workers(jobs), "core")
        raise UsageError(
            f"{cells} ({sizes}{seeds}) would take about {format_wall_time(self.seconds)} "
            f"on {cores}; use larger steps for fewer cells, or run the sweep anyway with --yes"
        )


class FinishedSweep(NamedTuple):
    """Results of a finished sweep, with the number of runs and the time that they took.

    `runs`, `simulated_s` and `wall_s` count from when the sweep was last started or resumed.

    Attributes:
        results: Results of all runs of the sweep.
        folder: Folder of the sweep.
        runs: Number of runs since the last start.
        simulated_s: Total simulated time of these runs, in s.
        wall_s: Real time that these runs took, in s.
        jobs: Number of worker processes.
        alone: Number of runs that were not computed side by side with others, for each reason.
            Empty if the sweep computes all runs one at a time.
    """

    results: SweepResults
    folder: SweepFolder
    runs: int
    simulated_s: float
    wall_s: float
    jobs: int
    alone: Mapping[str, int] = {}

    def describe_speed(self) -> str:
        """Returns a sentence on how fast the runs were computed, relative to real time."""
        processes = count_nouns(self.jobs, "process")
        wall_time = format_wall_time(self.wall_s)
        ratio = self.simulated_s / (self.wall_s * self.jobs) if self.wall_s else math.nan
        effort = f"{self.simulated_s:.4g} s simulated in {wall_time} by {processes}"
        return f"speed: {ratio:.3g} times real time per process; {effort}"


class CellItem(NamedTuple):
    """Everything that a worker process needs to execute one run of a sweep.

    The object is pickled and sent to the process.

    Attributes:
        plan: The sweep.
        cell: The values of all axes and the control law of the run.
        seed: Random seed of the run.
    """

    plan: SweepPlan
    cell: SweepCell
    seed: int

    def __str__(self) -> str:
        return f"cell {self.cell.number} ({', '.join(self.cell.overrides)}), seed {self.seed}"

    def run(self) -> CellRun:
        """Executes one run of a sweep.

        The result depends only on this object, so any worker process can compute it.

        Returns:
            The finished run with its result, ready for the journal of the sweep.
        """
        try:
            scenario = _build_scenario(self)
            if self.plan.judge == "linear":
                outcome = CellResult.judge_linearly(scenario)
            else:
                outcome = sweep_cell.classify_cell(scenario.text, self.plan.longest_s)
        except CodeWithheld:
            raise
        except ScenarioError as error:
            return _refuse_cell(self, error)
        return _complete_run(self, scenario, outcome)


def _refuse_cell(task: CellItem, error: ScenarioError) -> CellRun:
    """Creates the result of a rejected run, which has a reason but no values.

    Args:
        task: The run.
        error: The reason: the cell is not a valid scenario, or cannot run.
    """
    cell = task.cell
    setting = ", ".join(cell.overrides)
    reason = f"cell {cell.number} ({setting}): {error}"
    return CellRun(
        cell=cell.number,
        seed=task.seed,
        random=False,
        law=cell.law,
        sha256="",
        scenario=sweep_cell.diff_lines("", task.plan.base.text),
        outcome=CellResult.unsimulated(CellClass.REFUSED, reason),
        metrics=dict.fromkeys(task.plan.metrics),
    )


def _run_cells(tasks: Sequence[CellItem]) -> Iterator[CellRun]:
    """Executes several runs of a sweep, side by side where possible.

    Args:
        tasks: The runs, of one sweep.

    Yields:
        The finished runs in the order of the tasks, equal to those of `CellItem.run`.
    """
    scenarios: dict[int, Scenario] = {}
    refused_runs: dict[int, CellRun] = {}
    for index, task in enumerate(tasks):
        try:
            scenarios[index] = _build_scenario(task)
        except CodeWithheld:
            raise
        except ScenarioError as error:
            refused_runs[index] = _refuse_cell(task, error)
    longest_s = tasks[0].plan.longest_s
    try:
        judged_cells = iter(list(sweep_cell.classify_cells(scenarios.values(), longest_s)))
    except (CodeFailed, ScenarioError):
        # One by one, so that runs before a run whose code fails are kept.
        yield from map(CellItem.run, tasks)
        return
    for index, task in enumerate(tasks):
        if index in refused_runs:
            yield refused_runs[index]
            continue
        judged_cell = next(judged_cells)
        run = _complete_run(task, scenarios[index], judged_cell.result)
        yield msgspec.structs.replace(run, alone=judged_cell.obstacle)


def _build_scenario(task: CellItem) -> Scenario:
    """Returns the scenario of one run of a sweep, with its parameters and seed.

    Raises:
        ScenarioError: The scenario is not valid or cannot run.
    """
    scenario = task.plan.scenario(*task.cell.overrides, f"seed={task.seed}")
    sweep_cell.check_sweepable(scenario)
    return scenario


TWINS_OF_A_CELL = 4
"""Number of twins of a run, which are repetitions with a small push.

The pushes act on all joints at once, on single joints and, under the adaptive law, on the
estimates.
"""


def _measure_exponent(scenario: Scenario) -> float | None:
    """Measures the growth exponent of a run, the rate at which small disturbances grow, in 1/s.

    A twin is a repetition of the run with a small push. The difference between the twin and the
    run changes as exp(exponent t), where t is the time, see `analysis.twin_growth`. Several
    twins are run. The result is the largest of their rates over the later part of the run, the
    part over which runs are judged.

    Args:
        scenario: Scenario of the run.

    Returns:
        The exponent, negative if disturbances decay. `None` if no push had an effect.
    """
    run = FusedRun(scenario, SETTLED_ERROR_RAD)
    run.advance_to(scenario.duration_s)
    end = RunEnd.of_run(run, scenario)
    twins = TwinGrowth.of_scenario(scenario, end, run.ran_s, TWINS_OF_A_CELL)
    rates_per_s = [push.rate_per_s for push in twins.pushes]
    return max(filter(math.isfinite, rates_per_s), default=None)


def _complete_run(task: CellItem, scenario: Scenario, outcome: CellResult) -> CellRun:
    """Measures the further metrics of a run, and returns all of its results.

    Args:
        task: The run.
        scenario: Its scenario.
        outcome: How the run ended.
    """
    plan = task.plan
    if plan.judge == "twins":
        exponent_per_s = _measure_exponent(scenario)
        outcome = msgspec.structs.replace(outcome, exponent_per_s=exponent_per_s)

    # Metrics that are not fields of the result require a second run, which records a log.
    metrics: dict[str, float | None] = {}
    log_metrics = [key for key in plan.metrics if key not in CellResult.__struct_fields__]
    if log_metrics:
        measured = LogMetrics.measure_run(SimulatedLog(scenario), log_metrics)
        metrics = {key: measured[key].value for key in log_metrics}

    laws = dict.fromkeys(site.law_name for site in scenario.sites.values())
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


def _uses_lanes(plan: SweepPlan, runs: int) -> bool:
    """Returns True if a sweep is large enough to benefit from simulating several runs at once.

    The code for these SIMD lanes must be compiled first, which takes about ten seconds.

    Args:
        plan: The sweep.
        runs: Number of runs that remain.
    """
    if plan.judge == "linear":
        return False
    rates_hz = [spec.rate_hz for spec in plan.base.sites.values()]
    site_ticks = runs * plan.base.duration_s * sum(rates_hz)
    return site_ticks >= LANE_SITE_TICKS


def _prepare_lanes(plan: SweepPlan, runs: int) -> bool:
    """Decides whether a sweep simulates several runs at once, and compiles their code.

    For a large sweep, the code is compiled once for all workers. A small sweep, for which
    compilation would take too long, uses only code that an earlier study has compiled.

    Args:
        plan: The sweep. The code for its first cell is compiled.
        runs: Number of runs that remain.
    """
    is_large = _uses_lanes(plan, runs)
    if plan.judge == "linear" or (runs < 2 and not is_large):
        return False
    # A sweep of single runs must not load the code of lanes.
    from trilat_net.core import RunGroup

    try:
        scenario = _build_scenario(CellItem(plan, plan.cell(0), plan.seeds[0]))
    except ScenarioError:
        return is_large  # the workers compile the code of other cells
    make_run = partial(FusedRun, scenario)
    if is_large:
        RunGroup.prepare_lanes(make_run, LANE_RUNS, least_site_ticks=0)
        return True
    return RunGroup.prepare_lanes(make_run, runs, least_site_ticks=math.inf)


def run_sweep(
    folder: SweepFolder,
    jobs: int | None = None,
    progress: Progress | None = None,
    known: Iterable[CellRun] = (),
    on: Workers = None,
) -> FinishedSweep:
    """Executes the remaining runs of a sweep and writes all results.

    Args:
        folder: Folder of the sweep. The runs in its journal are not repeated.
        jobs: Number of worker processes. If `None`, one per core.
        progress: Called with the number of finished runs and the number of runs known to be
            necessary.
        known: Finished runs, for example from an estimate. They are added to the journal and
            not repeated.
        on: Workers to use instead of processes on this computer.

    Raises:
        ScenarioError: A cell cannot run. The message names the cell. Finished runs are kept.
        RunFailed: A cell crashed the workers that ran it, or the cluster is no longer
            available. Finished runs are kept.
    """
    plan = folder.plan
    clock = SystemClock()
    with folder.journal() as journal:
        tally = _NewRuns()
        for entry in known:
            if (entry.cell, entry.seed) not in journal.done:
                journal.add(entry)
                tally.note(entry)
        started_ns = clock.monotonic_ns()
        left = plan.cells * len(plan.seeds) - len(journal.done)
        laws = plan.base.imported_code
        workers = on if left else None  # no cluster is needed if nothing is left to run
        with WorkerPool.open(jobs, workers, most=left, laws=laws, hint=_RESUME_HINT) as pool:
            count = pool.workers
            _SweepWork(plan, journal, pool, progress, tally).execute()
        wall_s = (clock.monotonic_ns() - started_ns) * 1e-9
        alone = _write_table(folder, journal.done)

    results = SweepResults(plan, ResultTable(plan).read_rows(folder.path / RESULTS_FILE))
    if len(plan.seeds) > 1:
        _write_lines(folder, GRID_POINTS_FILE, results.encode_grid_points())
    return FinishedSweep(
        results=results,
        folder=folder,
        runs=tally.runs,
        simulated_s=tally.simulated_s,
        wall_s=wall_s,
        jobs=count,
        alone=alone,
    )


class _NewRuns:
    """Counts the runs since the last start of a sweep.

    Attributes:
        runs: Number of these runs.
        simulated_s: Total simulated time of these runs, in s.
    """

    def __init__(self) -> None:
        self.runs = 0
        self.simulated_s = 0.0

    def note(self, run: CellRun) -> None:
        """Adds a finished run to the totals that are reported at the end of the sweep."""
        self.runs += 1
        self.simulated_s += run.outcome.ran_s


def _write_table(folder: SweepFolder, done: Mapping[tuple[int, int], CellRun]) -> Counter[str]:
    """Writes the results of a sweep to a CSV table, one cell at a time.

    Args:
        folder: Folder of the sweep.
        done: The finished runs, by cell and seed.

    Returns:
        The reasons why runs were computed alone, with the number of these runs.
    """
    table = ResultTable(folder.plan)
    reasons: Counter[str] = Counter()

    def iterate_rows() -> Iterator[ResultRow]:
        """Yields the result rows of all cells for the CSV table.

        Also counts the reasons why some runs could not be computed side by side with others.
        """
        for runs in table.iterate_cells(done):
            reasons.update(run.alone for run in runs if run.alone)
            yield from table.build_rows(runs)

    _write_lines(folder, RESULTS_FILE, table.encode(iterate_rows()))
    return reasons


def _write_lines(folder: SweepFolder, name: str, lines: Iterable[str]) -> None:
    """Writes a file of a finished sweep from lines that need not fit into memory.

    Args:
        folder: Folder of the sweep.
        name: Name of the file.
        lines: The lines.

    Raises:
        LogRefused: The disk is full. The message states that all runs had finished.
    """
    try:
        write_whole(folder.path / name, lines, remedy=folder.remedy)
    except LogRefused as error:
        raise LogRefused(f"{error}; all runs had finished") from None


class _SweepWork:
    """Executes the runs of a sweep that are not yet in its journal.

    Args:
        plan: The sweep.
        journal: Journal to which the runs are added.
        pool: Workers that execute the runs.
        progress: Called with the progress, see `run_sweep`.
        tally: Counts the runs.
    """

    def __init__(
        self,
        plan: SweepPlan,
        journal: RunJournal[CellRun],
        pool: WorkerPool,
        progress: Progress | None,
        tally: _NewRuns,
    ) -> None:
        self._plan = plan
        self._journal = journal
        self._pool = pool
        self._progress = progress
        self._tally = tally

    def execute(self) -> None:
        """Runs all cells or, in a refined sweep, the cells near a stability edge.

        A refined sweep proceeds in rounds. The runs of a round show on which side of the edge
        their cells lie, which determines the cells of the next round.
        """
        plan = self._plan
        if not plan.refine:
            is_side_by_side = self._choose_lanes(plan.cells)
            cells: Iterable[int] = range(plan.cells)
            if is_side_by_side:
                groups = CellGroups.of_plan(plan)
                cells = groups.iterate_cells(plan.shape) if groups.keys else cells
            self._execute_cells(cells, plan.cells, 0, is_side_by_side=is_side_by_side)
            return

        refinement = EdgeRefinement(plan)
        is_side_by_side = self._choose_lanes(refinement.count_most_cells())
        runs_before = 0
        sides: dict[int, int] = {}
        while cells := refinement.find_next_cells(sides):
            self._execute_cells(cells, len(cells), runs_before, is_side_by_side=is_side_by_side)
            sides = {}
            for cell in cells:
                runs = self._list_runs(cell)
                runs_before += len(runs)
                sides[cell] = _find_side(plan, runs)

    def _choose_lanes(self, cells: int) -> bool:
        """Returns True if runs are to be computed side by side, and compiles their code.

        Args:
            cells: Number of cells that have to run.
        """
        runs = cells - len(self._journal.done)
        return _prepare_lanes(self._plan, runs)

    def _list_runs(self, cell: int) -> list[CellRun]:
        """Returns the finished runs of a cell, in the order of the seeds."""
        finished_runs = self._journal.done
        return [
            finished_runs[cell, seed]
            for seed in self._plan.seeds
            if (cell, seed) in finished_runs
        ]

    def _execute_cells(
        self, cells: Iterable[int], count: int, runs_before: int, *, is_side_by_side: bool
    ) -> None:
        """Executes all runs of some cells: one seed each, then further seeds of random cells.

        The first run of a cell shows whether anything in the cell is random. If not, other
        seeds would give the same run and are skipped.

        Args:
            cells: Numbers of the cells, which can be iterated once.
            count: Number of the cells.
            runs_before: Number of runs of earlier cells, for the progress.
            is_side_by_side: True to compute several runs side by side.
        """
        first_seed, *other_seeds = self._plan.seeds
        numbers: Iterable[int] = list(cells) if other_seeds else cells
        self._execute_runs(
            ((number, first_seed) for number in numbers),
            runs_before + count,
            is_side_by_side=is_side_by_side,
        )

        if not other_seeds:
            return
        random_cells = [
            number for number in numbers if self._journal.done[number, first_seed].random
        ]
        self._execute_runs(
            ((number, seed) for number in random_cells for seed in other_seeds),
            runs_before + count + len(random_cells) * len(other_seeds),
            is_side_by_side=is_side_by_side,
        )

    def _execute_runs(
        self, runs: Iterable[tuple[int, int]], run_count: int, *, is_side_by_side: bool
    ) -> None:
        """Executes runs of the sweep, skipping those that are already in the journal.

        The journal sends the runs to the workers and stores the results.

        Args:
            runs: Pairs of a cell number and a seed.
            run_count: Number of all runs of the sweep so far, including those in the journal,
                for the progress.
            is_side_by_side: True to compute several runs side by side.
        """
        plan = self._plan
        done = self._journal.done
        missing_runs = (
            CellItem(plan, plan.cell(number), seed)
            for number, seed in runs
            if (number, seed) not in done
        )
        # Runs of an estimate may belong to cells that come later.
        total = max(run_count, len(done))
        self._journal.run_pending(
            pool=self._pool,
            run=CellItem.run,
            tasks=missing_runs,
            done=len(done),
            total=total,
            show=self._progress,
            together=_run_cells if is_side_by_side else None,
            together_count=LANE_RUNS if is_side_by_side else 1,
            note=self._tally.note,
        )


def _find_side(plan: SweepPlan, runs: Sequence[CellRun]) -> int:
    """Returns on which side of the stability edge a cell lies: stable, unstable or undecided.

    The majority of the cell's runs decides. The side is unknown if every run was rejected. If
    the sweep measures growth exponents, a run with an exponent of at most 0 is stable.

    Args:
        plan: The sweep. If it measures growth exponents, their sign decides.
        runs: The runs of the cell.
    """
    outcomes = [run.outcome for run in runs]
    if all(outcome.verdict is CellClass.REFUSED for outcome in outcomes):
        return NOT_KNOWN
    stable = [outcome.verdict.stable for outcome in outcomes]
    if plan.judge != "verdict":
        exponents_per_s = [outcome.exponent_per_s for outcome in outcomes]
        stable = [None if rate is None else rate <= 0.0 for rate in exponents_per_s]
    decided = [is_stable for is_stable in stable if is_stable is not None]
    return EdgeRefinement.choose_side(stable=sum(decided), decided=len(decided))
