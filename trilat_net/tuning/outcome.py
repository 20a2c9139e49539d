"""What became of a candidate's run, in one word.

Law: every run has exactly one outcome, and only a run that settled may stand on a front: arms that hang,
however well together and however little they labour, have strayed.
"""

from enum import StrEnum
from typing import NamedTuple

from ..analysis.envelope import Trend

END_S = 1.0
"""The end of a run is its last second."""
STRAYED_RAD = 0.2
"""Arms whose mean is further than this from where they ought to be fell, hang, or were thrown there."""
TOGETHER_RAD = 0.02
"""Arms no further than this from their mean are together."""
SWING_RAD = 0.02
"""An error that goes up and down by more than this within the last second still swings."""


class Outcome(StrEnum):
    """What became of a run, in the order in which it is asked; the text is the word for people."""

    DIVERGED = "diverged"
    OSCILLATED = "oscillated"
    STRAYED = "strayed"
    APART = "apart"
    SETTLED = "settled"


MEANINGS = {
    Outcome.DIVERGED: "a joint left the speed limit",
    Outcome.OSCILLATED: f"the envelope of |e| grows, or e still swings by more than {SWING_RAD} rad",
    Outcome.STRAYED: f"the mean pose ends more than {STRAYED_RAD} rad from where a weightless consensus "
    "stands, or would after as long again: the arms fell, hang, sink, or were thrown there",
    Outcome.APART: f"an arm ends more than {TOGETHER_RAD} rad from the mean of all",
    Outcome.SETTLED: "none of these",
}
"""What the outcomes mean; they speak of the last second."""


class Ending(NamedTuple):
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


def judged(diverged: bool, trend: Trend, ending: Ending, alone: Ending) -> Outcome:
    """Returns the outcome of a run.

    Args:
        diverged: whether it, or its twin, left its limits.
        trend: of the envelope of its largest |e|.
        ending: how it ended.
        alone: how its twin ended; where it has none, the same.
    """
    if diverged:
        return Outcome.DIVERGED
    swings = max(ending.swing_rad, alone.swing_rad) > SWING_RAD and trend is not Trend.DECAYS
    if trend is Trend.GROWS or swings:
        return Outcome.OSCILLATED
    if max(alone.fall_rad, alone.ahead_rad) > STRAYED_RAD:
        return Outcome.STRAYED
    if alone.spread_rad > TOGETHER_RAD:
        return Outcome.APART
    return Outcome.SETTLED
