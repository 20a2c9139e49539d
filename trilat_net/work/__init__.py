"""Infrastructure for studies of many runs: workers, result folders, confidence intervals.

Sweeps, tunings and benchmarks use this package. `executor` distributes their runs to worker
processes, `study_folder` stores each finished run so that an interrupted study can continue,
and `intervals` computes the uncertainty of the results.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Worker processes
    "MAX_LOSSES",
    "Progress",
    "WorkerPool",
    "Workers",
    "ignore_progress",
    # Folders of studies
    "RunJournal",
    "StudyFolder",
    "encode_csv",
    # Intervals of confidence
    "MeanInterval",
    "wilson_interval",
]

if TYPE_CHECKING:
    from .executor import MAX_LOSSES, Progress, WorkerPool, Workers, ignore_progress
    from .intervals import MeanInterval, wilson_interval
    from .study_folder import RunJournal, StudyFolder, encode_csv
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "executor": "MAX_LOSSES Progress WorkerPool Workers ignore_progress",
            "intervals": "MeanInterval wilson_interval",
            "study_folder": "RunJournal StudyFolder encode_csv",
        },
    )
