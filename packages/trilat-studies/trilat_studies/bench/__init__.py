"""The benchmark suite, which compares control laws in the same tasks and over the same links.

To treat all laws alike, every law runs with the same random seeds, and its gains are tuned by
the same procedure. `plan_bench` selects the runs, `run_bench` executes them and stores their
results in a folder, and `BenchResults` turns the results into tables.
"""

from .bench_plan import BenchPlan, plan_bench
from .bench_results import BenchResults
from .bench_run import prepare_bench_folder, run_bench

__all__ = ["BenchPlan", "BenchResults", "plan_bench", "prepare_bench_folder", "run_bench"]
