"""The suite: control laws on the same tasks, links and seeds, with gains that one procedure tuned.

From Python:

    from pathlib import Path
    from trilat_net.studies.bench import plan_bench, prepare_bench_folder, run_bench

    results = run_bench(prepare_bench_folder(plan_bench("small"), Path("runs/bench-small")))
    results.places[0].error_rad

In a folder that holds the same suite, `run_bench` goes on from its journal.
"""

from .bench_plan import BenchPlan, plan_bench
from .bench_results import BenchResults
from .bench_run import prepare_bench_folder, run_bench

__all__ = ["BenchPlan", "BenchResults", "plan_bench", "prepare_bench_folder", "run_bench"]
