"""The end of a run by its posture.

The class of a candidate, and warnings on a log whose small errors mislead.

Invariant: a run has exactly one class, and only a settled one may stand on a front; arms that hang,
however well together, have strayed. An arm hangs if both links point down at the end and did not at the
start; arms fell if their mean ends more than 0.2 rad from the consensus pose in a log without a push that
could explain it.
"""

import math
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from ...analysis.run_end import EnvelopeTrend
from ...core.vectors import Array
from ...errors import ScenarioError
from ...log.log_reader import Log
from ...scenario.expect import END_WINDOW_S
from .consensus_pose import build_twin, check_comparable, compute_consensus_pose

STRAYED_RAD = 0.2
"""Arms whose mean is further than this from where they ought to be fell, hang, or were thrown there."""
TOGETHER_RAD = 0.02
"""Arms no further than this from their mean are together."""
SWING_RAD = 0.02
"""An error that goes up and down by more than this within the last second still swings."""


class CandidateClass(StrEnum):
    """What became of a run, in the order in which it is asked; the text is the word for people."""

    DIVERGED = "diverged"
    OSCILLATED = "oscillated"
    STRAYED = "strayed"
    APART = "apart"
    SETTLED = "settled"


CLASS_MEANINGS = {
    CandidateClass.DIVERGED: "a joint left the speed limit",
    CandidateClass.OSCILLATED: f"the envelope of |e| grows, or e still swings by more than {SWING_RAD} rad",
    CandidateClass.STRAYED: f"the mean pose ends more than {STRAYED_RAD} rad from where a weightless "
    "consensus stands, or would after as long again: the arms fell, hang, sink, or were thrown there",
    CandidateClass.APART: f"an arm ends more than {TOGETHER_RAD} rad from the mean of all",
    CandidateClass.SETTLED: "none of these",
}
"""What the outcomes mean; they speak of the last second."""


class CandidateEnd(NamedTuple):
    """The last second of a run.

    Attributes:
        spread_rad: largest distance of a joint from the mean of the sites.
        fall_rad: largest distance, over joints, of the mean pose from where it ought to be.
        ahead_rad: the same after as long again, at the pace at which it grew in the second half of the run.
        swing_rad: largest e less the smallest e, of the worst site and joint.
    """

    spread_rad: float
    fall_rad: float
    ahead_rad: float
    swing_rad: float


def classify_candidate(
    diverged: bool, trend: EnvelopeTrend, ending: CandidateEnd, alone: CandidateEnd
) -> CandidateClass:
    """Returns the outcome of a run.

    Args:
        diverged: whether it, or its twin, left its limits.
        trend: of the envelope of its largest |e|.
        ending: how it ended.
        alone: how its twin ended; where it has none, the same.
    """
    if diverged:
        return CandidateClass.DIVERGED
    swings = max(ending.swing_rad, alone.swing_rad) > SWING_RAD and trend is not EnvelopeTrend.DECAYS
    if trend is EnvelopeTrend.GROWS or swings:
        return CandidateClass.OSCILLATED
    if max(alone.fall_rad, alone.ahead_rad) > STRAYED_RAD:
        return CandidateClass.STRAYED
    if alone.spread_rad > TOGETHER_RAD:
        return CandidateClass.APART
    return CandidateClass.SETTLED


_SHORT_S = 0.5
_LOOKS = 2000
HANGING_RAD = 0.3
"""A link within this of straight down hangs."""


def check_final_posture(log: Log) -> list[str]:
    """Returns what to say of how a log ended, a sentence each; nothing where its arms stand at its end.

    Raises:
        LogError: a record cannot be read.
    """
    diverged = [s for s in log.sites if len(log[s]) and log[s].record(-1).mode == "diverged"]
    if diverged:
        return [f"{', '.join(diverged)} diverged: its figures end there"]
    parts = {site: log[site] for site in log.sites if len(log[site])}
    ends = {site: part.q[part.t_s > part.t_s[-1] - END_WINDOW_S].mean(axis=0) for site, part in parts.items()}
    warnings = []
    last_s = min((float(part.t_s[-1]) for part in parts.values()), default=0.0)
    wanted_s = log.scenario.duration_s
    if last_s <= wanted_s - _SHORT_S:
        warnings.append(f"ends at {last_s:.4g} s of {wanted_s:g} s: its figures are of a shorter run")
    hanging = [site for site, q in ends.items() if _points_down(q) and not _points_down(log[site].q[0])]
    if not hanging:
        return [*warnings, *_warn_fallen(log, ends)]
    verb = "hangs" if len(hanging) == 1 else "hang"
    why = "small errors and torques of arms that hang say nothing of a law"
    return [*warnings, f"{', '.join(hanging)} {verb} at the end: {why}"]


def _warn_fallen(log: Log, ends: dict[str, Array]) -> list[str]:
    """Warns if the mean pose left the consensus, and no operator or environment can be the cause."""
    scenario = log.scenario
    try:
        check_comparable(scenario)
    except ScenarioError:  # there is no one pose to speak of
        return []
    if build_twin(scenario) is not None or len(ends) < len(scenario.names):
        return []
    t_s = np.linspace(0.0, min(float(log[site].t_s[-1]) for site in ends), _LOOKS)
    away = np.mean(list(ends.values()), axis=0) - compute_consensus_pose(scenario, t_s)[-1]
    joint = int(np.abs(away).argmax())
    if abs(away[joint]) <= STRAYED_RAD:
        return []
    return [
        f"the arms end {abs(away[joint]):.2g} rad (joint {joint + 1}) from where a weightless consensus "
        "would stand: they sank, or drifted"
    ]


def _points_down(q: Array) -> bool:
    return all(abs(math.remainder(angle + math.pi / 2.0, math.tau)) < HANGING_RAD for angle in np.cumsum(q))
