"""The benchmark suite: control laws on the same tasks, links and seeds.

One procedure tunes the gains of all laws.
"""

from .bench_plan import BenchPlan, plan_bench
from .bench_results import BenchResults
from .bench_run import prepare_bench_folder, run_bench

__all__ = ["BenchPlan", "BenchResults", "plan_bench", "prepare_bench_folder", "run_bench"]
