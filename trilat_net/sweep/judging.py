"""Runs one cell and judges it."""

from ..certificate.growth import Motion
from ..scenario import Scenario, parse
from ..sim import virtual
from .outcome import Outcome, Verdict


def check_sweepable(scenario: Scenario) -> None:
    virtual.check_runs(scenario)


def judge(text: str, longest_s: float) -> Outcome:
    """A slow stand-in, to be replaced."""
    scenario = parse(text)
    error = 0.0
    for _, _, output in virtual.run(scenario):
        error = max(abs(a - b) for a, b in zip(output.q, output.q_des, strict=True))
    return Outcome(
        Verdict.CONVERGED if error < 0.01 else Verdict.DIVERGED,
        Motion.CONVERGED,
        scenario.duration_s,
        0,
        error,
        0.0,
        None,
        None,
        error,
        None,
        None,
    )
