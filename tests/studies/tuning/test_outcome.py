import pytest

from trilat_net.analysis.run_end import EnvelopeTrend
from trilat_net.studies.tuning.final_posture import (
    CLASS_MEANINGS,
    CandidateClass,
    CandidateEnd,
    classify_candidate,
)

CALM = CandidateEnd(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("ending", "trend", "outcome"),
    [
        (CALM, EnvelopeTrend.DECAYS, CandidateClass.SETTLED),
        (CALM, EnvelopeTrend.UNDECIDED, CandidateClass.SETTLED),
        (CALM, EnvelopeTrend.GROWS, CandidateClass.OSCILLATED),
        (CALM._replace(swing_rad=0.03), EnvelopeTrend.STEADY, CandidateClass.OSCILLATED),
        (CALM._replace(swing_rad=0.03), EnvelopeTrend.DECAYS, CandidateClass.SETTLED),
        (CALM._replace(fall_rad=1.6), EnvelopeTrend.DECAYS, CandidateClass.STRAYED),
        (CALM._replace(fall_rad=1.6, spread_rad=0.5), EnvelopeTrend.DECAYS, CandidateClass.STRAYED),
        (CALM._replace(fall_rad=0.1, ahead_rad=0.3), EnvelopeTrend.DECAYS, CandidateClass.STRAYED),
        (CALM._replace(spread_rad=0.5), EnvelopeTrend.DECAYS, CandidateClass.APART),
    ],
)
def test_the_first_that_holds_is_the_outcome(
    ending: CandidateEnd, trend: EnvelopeTrend, outcome: CandidateClass
) -> None:
    assert classify_candidate(False, trend, ending, ending) is outcome
    assert classify_candidate(True, trend, ending, ending) is CandidateClass.DIVERGED


def test_pose_is_judged_on_the_twin_and_swinging_on_both() -> None:
    pushed = CandidateEnd(spread_rad=0.5, fall_rad=1.0, ahead_rad=1.0, swing_rad=0.0)
    assert classify_candidate(False, EnvelopeTrend.STEADY, pushed, CALM) is CandidateClass.SETTLED
    hammering = CALM._replace(swing_rad=0.2)
    assert classify_candidate(False, EnvelopeTrend.STEADY, hammering, CALM) is CandidateClass.OSCILLATED
    assert classify_candidate(False, EnvelopeTrend.STEADY, CALM, hammering) is CandidateClass.OSCILLATED


def test_every_outcome_has_a_meaning() -> None:
    assert list(CLASS_MEANINGS) == list(CandidateClass)
