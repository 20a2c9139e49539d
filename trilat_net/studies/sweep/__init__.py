"""Stability maps: one scenario over a plane of its keys, in virtual time, on all cores.

From Python:

    from pathlib import Path
    from trilat_net.studies.sweep import plan_sweep, prepare_sweep_folder, run_sweep

    plan = plan_sweep("p_d_margin", over=["link.delay_ms=0:400:50", "control.d=0.2:3:0.2"])
    results = run_sweep(prepare_sweep_folder(plan, Path("runs/mine"))).results
    [row["verdict"] for row in results.of_cell(17)]

In a folder that holds the same sweep, `run_sweep` continues from its journal; `read_results` reads a finished
one. `on="tcp://SCHEDULER:8786"` runs the cells on a Dask cluster.
"""

from .sweep_plan import SweepPlan, plan_sweep
from .sweep_results import SweepResults, read_results
from .sweep_run import FinishedSweep, open_sweep_folder, prepare_sweep_folder, run_sweep

__all__ = [
    "FinishedSweep",
    "SweepPlan",
    "SweepResults",
    "open_sweep_folder",
    "plan_sweep",
    "prepare_sweep_folder",
    "read_results",
    "run_sweep",
]
