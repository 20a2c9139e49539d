"""The benchmark suite: compares control laws in the same tasks, over the same links.

Every law is run with the same random seeds, and one procedure tunes the gains of all laws. A
plan (`plan_bench`) selects the runs, `run_bench` executes them in a folder, and `BenchResults`
has their tables.
"""

from .bench_plan import BenchPlan, plan_bench
from .bench_results import BenchResults
from .bench_run import prepare_bench_folder, run_bench

__all__ = ["BenchPlan", "BenchResults", "plan_bench", "prepare_bench_folder", "run_bench"]
