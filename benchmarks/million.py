"""Measures the memory of a sweep of a million cells, and its rate from the first cells to the last.

The judge is replaced with one that answers at once, because a million runs take a day. The
measurement covers the overhead of the sweep: the plan of each cell, the journal, the table and
the summary.
"""

import itertools
import tempfile
import time
from pathlib import Path

import msgspec
from trilat_studies.sweep import prepare_sweep_folder, run_sweep, sweep_run
from trilat_studies.sweep.sweep_cell import CellRun
from trilat_studies.sweep.sweep_plan import plan_sweep
from trilat_studies.sweep.sweep_run import CellItem, open_sweep_folder

SIDE = 1000
"""Number of values of each of the two axes."""
PARTS = 10
"""Number of parts whose rates are compared."""
MEMORY_BAR_MB = 1000


def run() -> list[str]:
    """Runs the sweep to its middle, and then continues it."""
    plan = plan_sweep(
        "free",
        ["duration_s=0.05"],
        over=[f"control.Kd=2:{2 + (SIDE - 1) / 1000}:0.001", f"control.Kp=1:{SIDE}:1"],
        longest_s=0.05,
    )
    real = CellItem(plan, plan.cell(0), 1).run()
    before_mb = _read_mb("VmRSS")
    times_s = [time.process_time()]
    part = plan.cells // PARTS

    def answer(task: CellItem) -> CellRun:
        return msgspec.structs.replace(real, cell=task.cell.number, seed=task.seed)

    def note(done: int, _total: int) -> None:
        if done % part == 0:
            times_s.append(time.process_time())
        if done == plan.cells // 2 and len(times_s) == PARTS // 2 + 1:
            raise KeyboardInterrupt

    lane_site_ticks = sweep_run.LANE_SITE_TICKS
    sweep_run.LANE_SITE_TICKS = 10**12  # the judge answers for one cell at a time
    run_cell = CellItem.run
    CellItem.run = answer  # type: ignore[method-assign]
    try:
        with tempfile.TemporaryDirectory() as scratch:
            folder = prepare_sweep_folder(plan, Path(scratch) / "sweep")
            try:
                run_sweep(folder, 1, note)
            except KeyboardInterrupt:
                folder = open_sweep_folder(folder.path)
            resumed_s = time.process_time()
            finished = run_sweep(folder, 1, note)
            swept_s = time.process_time()
            lines = list(finished.results.summarize())
            summary_s = time.process_time() - swept_s
            count = len(finished.results.rows)
    finally:
        CellItem.run = run_cell  # type: ignore[method-assign]
        sweep_run.LANE_SITE_TICKS = lane_site_ticks
    # The first part after the interruption begins with reading the journal.
    steps_s = [after - at for at, after in itertools.pairwise(times_s)]
    parts = ", ".join(f"{1e6 * step_s / part:.0f}" for step_s in steps_s)
    written_s = swept_s - times_s[-1]
    peak_mb = _read_mb("VmHWM")
    return [
        f"a sweep of {count} cells, interrupted in the middle and continued: {lines[0]}",
        f"  us of processor time for each cell, in {PARTS} parts: {parts} (the part after the "
        "interruption reads the journal)",
        f"  last part / first part: {steps_s[-1] / steps_s[0]:.2f} (bar: <= 1.1)",
        f"  peak memory {peak_mb:.0f} MB, {before_mb:.0f} MB before the first cell "
        f"(bar: <= {MEMORY_BAR_MB} MB)",
        f"  runs after the interruption {finished.runs}, in {swept_s - resumed_s:.0f} s; table "
        f"{written_s:.0f} s, summary {summary_s:.0f} s",
    ]


def _read_mb(name: str) -> float:
    """Returns the memory of this process, in MB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return float(line.split()[1]) / 1000.0
    raise LookupError(name)
