"""Computes stability maps, which show for which scenario parameters the arms are stable.

A sweep runs a scenario over a grid of its keys, in virtual time and on all cores.
docs/studies/sweep.md describes the commands.
"""

from .sweep_plan import plan_sweep
from .sweep_results import read_results
from .sweep_run import FinishedSweep, prepare_sweep_folder, run_sweep

__all__ = ["FinishedSweep", "plan_sweep", "prepare_sweep_folder", "read_results", "run_sweep"]
