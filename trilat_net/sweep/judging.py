"""Runs one cell and judges it, and goes on with it where the time was too short to tell.

Law: the word is that of the certificate, on the same numbers: a log of the same run gets the same one.
"""

import math

from ..analysis.quantities import SETTLED_RAD
from ..certificate.ending import Motion, ending
from ..scenario import Scenario, parse
from ..sim.fused import FusedRun, check_fuses
from .outcome import VERDICT_OF, Outcome


def check_sweepable(scenario: Scenario) -> None:
    """Refuses what cannot be run without a network, or not fast.

    Raises:
        ScenarioError: see `sim.fused.check_fuses`.
    """
    check_fuses(scenario)


def judge(text: str, longest_s: float) -> Outcome:
    """Runs a cell in virtual time and returns what became of it.

    A run that is undecided when its time is over goes on for as long again, and so on; its numbers are those
    of one run.

    Args:
        text: the canonical text of the cell's scenario, whose `duration_s` is the time it has.
        longest_s: how long it may run in the end, s; not more than its own time: it is never extended.
    """
    scenario = parse(text)
    run = FusedRun(scenario, SETTLED_RAD)
    ends_s = scenario.duration_s
    run.advance(ends_s)
    extended = 0
    while (outcome := _outcome(run, extended)).motion is Motion.UNDECIDED and ends_s < longest_s:
        ends_s = min(2.0 * ends_s, longest_s)
        extended += 1
        run.advance(ends_s)
    return outcome


def _outcome(run: FusedRun, extended: int) -> Outcome:
    maxima = run.maxima
    end = ending(maxima, run.ran_s)
    diverged_s = run.diverged_s
    motion = end.motion if diverged_s is None else Motion.DIVERGED
    return Outcome(
        verdict=VERDICT_OF[motion],
        motion=motion,
        ran_s=run.ran_s,
        extended=extended,
        end_error_rad=end.end_error_rad,
        end_speed_rad_s=end.end_speed_rad_s,
        error_rate_per_s=_finite(end.error.rate_per_s),
        speed_rate_per_s=_finite(end.speed.rate_per_s),
        peak_error_rad=max(float(values[:, 0].max()) for values in maxima),
        settled_s=run.settled_s,
        diverged_s=diverged_s,
    )


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
