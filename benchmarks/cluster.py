"""A sweep on a Dask cluster of two workers on loopback, and by loky on the same two cores."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trilat_net.studies.executor import open_worker_pool
from trilat_net.studies.sweep import plan_sweep
from trilat_net.studies.sweep.sweep_cell import CellTask, run_cell

WORKERS = 2
CELLS = 2000
REPEATS = 3
WARMED = 40
"""Cells before the clock runs: processes start and load the compiled core."""
OVER = f"control.Kd=2:{2 + 0.001 * (CELLS - 1):g}:0.001"


@contextmanager
def started_cluster(folder: Path) -> Iterator[str]:
    """Yields the address of a scheduler with workers of one thread each."""
    file = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": {**os.environ}}
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    processes = [
        subprocess.Popen([*dask, "scheduler", *local, "--port", "0", "--scheduler-file", str(file)], **quiet)  # type: ignore[call-overload]
    ]
    try:
        while not (file.exists() and file.read_text()):
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        worker = [*dask, "worker", address, *local, "--nthreads", "1", "--no-nanny"]
        processes += [subprocess.Popen(worker, **quiet) for _ in range(WORKERS)]  # type: ignore[call-overload]
        yield address
    finally:
        for process in processes:
            process.kill()
            process.wait()


def cells_per_s(tasks: list[CellTask], on: str | None) -> float:
    with open_worker_pool(None if on else WORKERS, on) as pool:
        while pool.workers < WORKERS:
            time.sleep(0.1)
        pool.map(run_cell, tasks[:WARMED])
        begun = time.perf_counter()
        pool.map(run_cell, tasks)
        return len(tasks) / (time.perf_counter() - begun)


def run() -> list[str]:
    sweep = plan_sweep("free", ["duration_s=20.0"], over=[OVER], longest_s=20.0)
    tasks = [sweep.task(n, sweep.seeds[0]) for n in range(sweep.cells)]
    for task in tasks[:3]:
        run_cell(task)
    begun = time.perf_counter()
    for task in tasks[:WARMED]:
        run_cell(task)
    cell_s = (time.perf_counter() - begun) / WARMED
    with tempfile.TemporaryDirectory() as folder, started_cluster(Path(folder)) as address:
        while True:
            with open_worker_pool(None, address) as pool:
                if pool.workers == WORKERS:
                    break
        rates = [(cells_per_s(tasks, None), cells_per_s(tasks, address)) for _ in range(REPEATS)]
    ratios = sorted(dask / loky for loky, dask in rates)
    loky, dask = (max(one) for one in zip(*rates, strict=True))
    return [
        f"{len(tasks)} cells of free, {1e3 * cell_s:.0f} ms each alone, by {WORKERS} processes; "
        f"best of {REPEATS}, in turn:",
        f"  loky: {loky:.1f} cells/s, overhead {100.0 * (1.0 - loky * cell_s / WORKERS):.1f} %",
        f"  Dask on loopback: {dask:.1f} cells/s; median of Dask over loky {ratios[REPEATS // 2]:.3f} "
        "(bar: >= 0.9)",
    ]
