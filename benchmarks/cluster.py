"""Compares a sweep on a Dask cluster of two workers on loopback with loky, and with two processes without a pool.

The three methods take turns, and each runs alone, because an idle cluster slows down the others
by a few per cent.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trilat_studies.sweep import plan_sweep
from trilat_studies.sweep.sweep_run import CellItem

from trilat_net.work.executor import WorkerPool, run_batch
from trilat_net.workers import worker_pool

WORKERS = 2
CELLS = 2000
REPEATS = 3
WARMED = 40
"""Number of cells before the measurement, in which processes start and load the compiled core."""
SETTINGS = {
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "DASK_DISTRIBUTED__ADMIN__TICK__INTERVAL": "1s",
}
"""Settings of Dask that docs/studies/sweep.md recommends."""
OVER = f"control.Kd=2:{2 + 0.001 * (CELLS - 1):g}:0.001"


@contextmanager
def started_cluster(folder: Path) -> Iterator[str]:
    """Yields the address of a scheduler with workers of one thread each."""
    file = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    quiet = {
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "env": {**os.environ, **SETTINGS},
    }
    local = ["--host", "127.0.0.1", "--no-dashboard"]
    processes = [
        subprocess.Popen(
            [*dask, "scheduler", *local, "--port", "0", "--scheduler-file", str(file)], **quiet
        )  # type: ignore[call-overload]
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


def pool_cells_per_s(tasks: list[CellItem], on: str | None) -> float:
    with WorkerPool.open(None if on else WORKERS, on) as pool:
        pool.map(CellItem.run, tasks[:WARMED])
        begun = time.perf_counter()
        pool.map(CellItem.run, tasks)
        return len(tasks) / (time.perf_counter() - begun)


def cluster_cells_per_s(tasks: list[CellItem]) -> float:
    with tempfile.TemporaryDirectory() as folder, started_cluster(Path(folder)) as address:
        while True:
            with WorkerPool.open(None, address) as pool:
                if pool.workers == WORKERS:
                    break
        return pool_cells_per_s(tasks, address)


def plain_cells_per_s(tasks: list[CellItem]) -> float:
    """Returns the speed of processes that receive all of their cells at the start."""
    with worker_pool(WORKERS) as executor:
        for share in (tasks[:WARMED], tasks):
            began = time.perf_counter()
            parts = [
                executor.submit(run_batch, CellItem.run, share[n::WORKERS], None, {})
                for n in range(WORKERS)
            ]
            for part in parts:
                part.result()
        return len(tasks) / (time.perf_counter() - began)


def run() -> list[str]:
    sweep = plan_sweep("free", ["duration_s=20.0"], over=[OVER], longest_s=20.0)
    tasks = [CellItem(sweep, sweep.cell(n), sweep.seeds[0]) for n in range(sweep.cells)]
    for task in tasks[:3]:
        task.run()
    rounds = [
        (plain_cells_per_s(tasks), pool_cells_per_s(tasks, None), cluster_cells_per_s(tasks))
        for _ in range(REPEATS)
    ]

    def median(above: int, below: int) -> float:
        return sorted(rates[above] / rates[below] for rates in rounds)[REPEATS // 2]

    plain, loky, dask = (max(rates) for rates in zip(*rounds, strict=True))
    return [
        f"{len(tasks)} cells of free by {WORKERS} processes, best of {REPEATS}, in turn; ratios: medians:",
        f"  without a pool: {plain:.1f} cells/s, {1e3 * WORKERS / plain:.1f} ms each",
        f"  loky: {loky:.1f} cells/s, overhead {100.0 * (1.0 - median(1, 0)):.1f} % (bar: < 5 %)",
        f"  Dask on loopback: {dask:.1f} cells/s, overhead {100.0 * (1.0 - median(2, 0)):.1f} %; "
        f"over loky {median(2, 1):.3f} (bar: >= 0.9)",
    ]
