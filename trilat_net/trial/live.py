"""A trial that ran over a network, judged by its log.

Law: it is held against the same [expect] by the same code as a virtual run; besides, its session must have
ended in order, and its records must be what executing them again gives.
"""

from collections.abc import Sequence
from pathlib import Path

from ..errors import LogError
from ..log.reader import open_log
from ..replay.verify import verify
from .collection import measure_log
from .judgement import Outcome
from .trial import Result, Trial


def judged_log(trial: Trial, log_file: Path, problems: Sequence[str], wall_s: float) -> Result:
    """Returns the result of a live trial.

    Args:
        trial: what ran.
        log_file: its log.
        problems: what went wrong in the session.
        wall_s: how long it took.
    """
    kept = log_file if log_file.exists() else None
    try:
        log = open_log(log_file)
        if not any(len(log[name]) for name in log.sites):
            raise LogError(f"{log_file}: no records")
        result = trial.judged(measure_log(log, trial.scenario.expect), wall_s)
        verdict = verify(log)
    except LogError as error:
        return Result(trial, [], 0.0, wall_s, "; ".join([*problems, str(error)]), kept)
    outcomes = [
        *result.outcomes,
        Outcome("session", not problems, "; ".join(problems) or "ended in order", "ends in order"),
        Outcome(
            "executed again", verdict.passed, f"{verdict.identical} identical", f"{verdict.records} records"
        ),
    ]
    return result._replace(outcomes=outcomes, log=kept)
