"""The benchmark suite: compares control laws in the same tasks, over the same network links.

All laws run with the same random seeds, and one procedure tunes their gains, so that no law has
an advantage. `plan_bench` selects the runs, `run_bench` executes them and stores them in a
folder, and `BenchResults` composes tables of their results.
"""

from .bench_plan import BenchPlan, plan_bench
from .bench_results import BenchResults
from .bench_run import prepare_bench_folder, run_bench

__all__ = ["BenchPlan", "BenchResults", "plan_bench", "prepare_bench_folder", "run_bench"]
