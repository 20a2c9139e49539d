"""Computes several runs of one structure side by side, in the lanes of vector registers."""

from .lane_rows import LANES
from .lane_structure import describe_structure, find_obstacle
from .run_groups import LEAST_RUNS, RunGroup, group_runs

__all__ = [
    "LANES",
    "LEAST_RUNS",
    "RunGroup",
    "describe_structure",
    "find_obstacle",
    "group_runs",
]
