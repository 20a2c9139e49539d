"""Infrastructure for studies of many runs: workers, result folders, confidence intervals.

Sweeps, tunings and benchmarks use this package. `executor` distributes their runs to worker
processes, `run_journal` stores each finished run so that an interrupted study can continue, and
`intervals` computes the uncertainty of the results.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Worker processes
    "MAX_LOSSES",
    "Progress",
    "WorkerPool",
    "Workers",
    # Results of the runs
    "RunJournal",
    "encode_csv",
    # Intervals of confidence
    "MeanInterval",
    "wilson_interval",
]

if TYPE_CHECKING:
    from .executor import MAX_LOSSES, Progress, WorkerPool, Workers
    from .intervals import MeanInterval, wilson_interval
    from .run_journal import RunJournal, encode_csv
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "executor": "MAX_LOSSES Progress WorkerPool Workers",
            "intervals": "MeanInterval wilson_interval",
            "run_journal": "RunJournal encode_csv",
        },
    )
