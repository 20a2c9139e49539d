"""Runs one cell and judges it, and goes on with it where the time was too short to tell.

Law: the word is that of the certificate, on the same numbers: a log of the same run gets the same one.
"""

import math

import msgspec

from ..analysis.quantities import SETTLED_RAD
from ..certificate.ending import Motion, ending
from ..errors import ScenarioError
from ..scenario import Scenario, parse
from ..sim.fused import FusedRun, check_fuses
from .outcome import VERDICT_OF, Outcome, Verdict

FLAT = 0.02
"""An envelope whose logarithm changes by no more over half a run is that of a limit cycle."""


def check_sweepable(scenario: Scenario) -> None:
    """Refuses what cannot be run without a network, or not fast.

    Raises:
        ScenarioError: a link has the delay of a real network, which here would be one tick; or see
            `sim.fused.check_fuses`.
    """
    if scenario.measured:
        raise ScenarioError(
            "a measured link has the delay of a real network, and a sweep runs without one: give it a model, "
            "as in link.model=constant and link.delay_ms=50",
            path="link.model",
        )
    check_fuses(scenario)


def judge(text: str, longest_s: float) -> Outcome:
    """Runs a cell in virtual time and returns what became of it.

    A run that has not made itself plain when its time is over (see `plain`) goes on for as long again, and so
    on; its numbers are those of one run. Where that never comes, the certificate's word stands, except for a
    trend of a run in which anything is drawn: such errors wander, and a slow trend is chance.

    Args:
        text: the canonical text of the cell's scenario, whose `duration_s` is the time it has.
        longest_s: how long it may run in the end, s; not more than its own time: it is never extended.
    """
    scenario = parse(text)
    run = FusedRun(scenario, SETTLED_RAD)
    ends_s = scenario.duration_s
    run.advance(ends_s)
    extended = 0
    while not plain(outcome := _outcome(run, extended)) and ends_s < longest_s:
        ends_s = min(2.0 * ends_s, longest_s)
        extended += 1
        run.advance(ends_s)
    wanders = scenario.random and outcome.motion in (Motion.GROWS, Motion.DECAYS) and not _pronounced(outcome)
    return msgspec.structs.replace(outcome, verdict=Verdict.UNDECIDED) if wanders else outcome


def plain(outcome: Outcome) -> bool:
    """True where a longer run would hardly be called something else.

    That is: it left its limits; or it came to rest; or it grows, and the largest speed at least doubled over
    the second half; or neither that nor the largest error changed by more than `FLAT`. Near the edge of
    stability a finite run looks steady whatever it does later, and what decays may hide what grows slowly
    until it is gone.
    """
    if outcome.motion is Motion.BOUNDED:
        return max(map(abs, _changes(outcome))) <= FLAT
    if outcome.motion is Motion.GROWS:
        return _pronounced(outcome)
    return outcome.motion in (Motion.DIVERGED, Motion.CONVERGED)


def _pronounced(outcome: Outcome) -> bool:
    """True where over the second half the largest speed doubled, or that and the largest error halved."""
    error, speed = _changes(outcome)
    return speed >= math.log(2.0) or max(error, speed) <= -math.log(2.0)


def _changes(outcome: Outcome) -> tuple[float, float]:
    """Returns by how much the logarithms of the largest |e| and |qd| change over the second half."""
    half_s = 0.5 * outcome.ran_s
    return half_s * (outcome.error_rate_per_s or 0.0), half_s * (outcome.speed_rate_per_s or 0.0)


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
