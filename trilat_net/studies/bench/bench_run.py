"""Runs the suite: the folder with its journal, the missing runs, and the results by place.

Invariant: results are a function of the plan; the number of processes, their order and the number of
interruptions do not enter. A run that is in the journal is never made again; one with other gains is another
run. A folder belongs to one version of the program on one arithmetic.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

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
from .bench_cell import LONGEST_S, BenchRun, BenchRunTask, name_run, run_bench_task
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


QUANTITIES_OF_RUNS = ("error_rad", "effort_nm", "hand_nm", "force_peak_n", "stiffness_n_m", "settled_s")
"""The numbers of a run that are averaged over its seeds; those of runs without contact are masked."""
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
        return next(one for one in (Stability.NOT_STABLE, Stability.OPEN, Stability.STABLE) if one in found)

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
        return wilson_interval(self.stable, len(self.runs)) if len(self.runs) >= LEAST_SEEDS else None

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
            BenchPlace(cell, [_confirm(runs, cell, seed) for seed in cell.seeds]) for cell in plan.cells
        ]
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


def _confirm(runs: dict[tuple[str, int], BenchRun], cell: BenchCell, seed: int) -> BenchRun:
    """Returns a run, with the judgement of the longer one if there is one."""
    run = runs[cell.key, seed]
    longer = runs.get((name_run(cell.key, LONGEST_S), seed))
    if run.stability is Stability.NOT_STABLE and run.length_s >= LONGEST_S:
        return msgspec.structs.replace(run, confirmed=True)
    if run.stability is not Stability.NOT_STABLE or longer is None:
        return run
    confirmed, words = longer.stability is Stability.NOT_STABLE, f"of {LONGEST_S:g} s: {longer.text}"
    return msgspec.structs.replace(run, stability=longer.stability, text=words, confirmed=confirmed)


def run_bench(
    folder: BenchFolder,
    jobs: int | None = None,
    on: Workers = None,
    progress: Progress = ignore_progress,
    *,
    confirm: bool = False,
) -> BenchResults:
    """Runs what is left of a suite, and returns all of it.

    Args:
        folder: what its journal has is not run again.
        jobs: in how many processes; None for one per core.
        on: what runs them instead: a Dask scheduler's address or an executor.
        progress: called with the runs that are done, and their number.
        confirm: every run that is not stable, and did not diverge, is made again for 100 s.

    Raises:
        RunFailed: a run ended its workers, or the cluster is gone. What is done is kept.
    """
    plan = folder.plan
    with folder.journal() as journal:
        asked = [BenchRunTask(cell, seed) for cell in plan.cells for seed in cell.seeds]
        for again in (False, True)[: 1 + confirm]:
            if again:
                found = [(one, journal.done[one.cell.key, one.seed]) for one in asked]
                asked = [one._replace(to_s=LONGEST_S) for one, run in found if run.doubtful]
            keys = [(name_run(one.cell.key, one.to_s), one.seed) for one in asked]
            tasks = [one for key, one in zip(keys, asked, strict=True) if key not in journal.done]
            if tasks:
                hint = "; what is done is kept: the same command goes on"
                with open_worker_pool(jobs, on, most=len(tasks), hint=hint) as pool:
                    for number, (_, run) in enumerate(pool.each(run_bench_task, tasks, count=len(tasks)), 1):
                        journal.add(run)
                        progress(len(asked) - len(tasks) + number, len(asked))
        return BenchResults(plan, journal.done)
