"""Runs the suite: the folder with its journal, the missing runs, and the results by place.

Invariant: results are a function of the plan; the number of processes, their order and the number of
interruptions do not enter. A run that is in the journal is never made again; one with other gains is another
run. A folder belongs to one version of the program on one arithmetic.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ...analysis.run_end import Stability
from ...core.fingerprint import compute_fingerprint
from ...errors import UsageError
from ...files import make_results_folder, write_whole
from ...log.log_layout import collect_provenance
from ...results import Result
from ..commands import format_command
from ..executor import Progress, Workers, ignore_progress, open_worker_pool
from ..intervals import MeanInterval, mean_interval, wilson_interval
from ..run_journal import RunJournal
from .bench_cell import BenchRun, BenchRunTask, run_bench_task
from .bench_plan import BenchCell, BenchPlan

ORIGIN_NAME = "origin.json"
JOURNAL_NAME = "runs.journal"


_VERSIONS = ("version_trilat-net", "version_numba", "version_numpy")


class BenchFolder(NamedTuple):
    """A folder of the suite: what is asked of it, and where its runs come from."""

    path: Path
    plan: BenchPlan
    origin: str

    def journal(self) -> RunJournal[BenchRun]:
        """Opens the journal."""
        command = format_command("bench", "--study", self.plan.study, "--out", str(self.path))
        remedy = f"what is done is kept: make room, and go on with: {command}"
        return RunJournal(self.path / JOURNAL_NAME, self.origin, BenchRun, remedy)


def prepare_bench_folder(plan: BenchPlan, path: Path | None = None) -> BenchFolder:
    """Returns the folder of a suite, made, or as it was left; by default `runs/bench-STUDY`.

    Raises:
        UsageError: it holds something else, or runs from elsewhere, or cannot be made.
    """
    chosen = path or Path("runs") / f"bench-{plan.study}"
    known = collect_provenance()
    facts = {"arithmetic": compute_fingerprint(), **{name: known[name] for name in _VERSIONS}}
    file, origin = chosen / ORIGIN_NAME, json.dumps(facts, indent=2) + "\n"
    if not file.exists():
        make_results_folder(chosen, "", force=None)
        write_whole(file, origin)
    elif (before := file.read_text(encoding="utf-8")) != origin:
        there, here = (" ".join(text.split()) for text in (before, origin))
        raise UsageError(
            f"{chosen}: holds runs of {there}, and this is {here}; results are not mixed: choose another "
            "folder with --out"
        )
    return BenchFolder(chosen, plan, origin)


QUANTITIES_OF_RUNS = ("error_rad", "effort_nm", "hand_nm", "reflected", "force_peak_n")
"""The numbers of a run that are averaged over its seeds."""


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
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the share of stable runs."""
        return wilson_interval(self.stable, len(self.runs))

    def mean(self, quantity: str) -> float | MeanInterval | None:
        """Returns a number's mean over the seeds, with its interval; of one run the number itself."""
        values = [getattr(run, quantity) for run in self.runs]
        if None in values:
            return None
        return values[0] if len(values) == 1 else mean_interval(values)


class BenchResults(Result):
    """The results of a suite.

    Attributes:
        plan: of what.
        places: every cell with its runs, in the order of the plan.
        runs: all of them, in that order.
    """

    def __init__(self, plan: BenchPlan, runs: dict[tuple[str, int], BenchRun]) -> None:
        self.plan = plan
        self.places = [BenchPlace(cell, [runs[cell.key, seed] for seed in cell.seeds]) for cell in plan.cells]
        self.runs = [run for place in self.places for run in place.runs]

    def blocks(self) -> Iterator[Any]:
        """Yields its text."""
        from .bench_tables import compose_bench

        return compose_bench(self)

    def headline(self) -> str:
        """Returns which study, and how many runs."""
        return f"{self.plan.study}: {len(self.places)} cells, {len(self.runs)} runs"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat bench --json`."""
        from .bench_tables import bench_to_json

        return bench_to_json(self)

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per cell."""
        return list(self.to_dict()["places"])

    def of(self, task: str, law: str = "", link: str = "") -> Iterator[BenchPlace]:
        """Yields the places of a task, and of a law and a link if they are named."""
        for place in self.places:
            cell = place.cell
            if cell.task == task and law in ("", cell.law) and link in ("", cell.link):
                yield place


def run_bench(
    folder: BenchFolder, jobs: int | None = None, on: Workers = None, progress: Progress = ignore_progress
) -> BenchResults:
    """Runs what is left of a suite, and returns all of it.

    Args:
        folder: what its journal has is not run again.
        jobs: in how many processes; None for one per core.
        on: what runs them instead: a Dask scheduler's address or an executor.
        progress: called with the runs that are done, and their number.

    Raises:
        RunFailed: a run ended its workers, or the cluster is gone. What is done is kept.
    """
    plan = folder.plan
    with folder.journal() as journal:
        tasks = [
            BenchRunTask(cell, seed)
            for cell in plan.cells
            for seed in cell.seeds
            if (cell.key, seed) not in journal.done
        ]
        if tasks:
            hint = "; what is done is kept: the same command goes on"
            with open_worker_pool(jobs, on, most=len(tasks), hint=hint) as pool:
                for number, (_, run) in enumerate(pool.each(run_bench_task, tasks, count=len(tasks)), 1):
                    journal.add(run)
                    progress(plan.runs - len(tasks) + number, plan.runs)
        return BenchResults(plan, journal.done)
