"""Stability maps: one scenario over a plane of its keys, in virtual time, on all cores; docs/sweep.md."""

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
