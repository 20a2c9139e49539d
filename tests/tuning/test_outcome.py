import pytest

from trilat_net.analysis.envelope import Trend
from trilat_net.tuning.outcome import MEANINGS, Ending, Outcome, judged

CALM = Ending(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("ending", "trend", "outcome"),
    [
        (CALM, Trend.DECAYS, Outcome.SETTLED),
        (CALM, Trend.UNDECIDED, Outcome.SETTLED),
        (CALM, Trend.GROWS, Outcome.OSCILLATED),
        (CALM._replace(swing_rad=0.03), Trend.STEADY, Outcome.OSCILLATED),
        (CALM._replace(swing_rad=0.03), Trend.DECAYS, Outcome.SETTLED),
        (CALM._replace(fall_rad=1.6), Trend.DECAYS, Outcome.STRAYED),
        (CALM._replace(fall_rad=1.6, spread_rad=0.5), Trend.DECAYS, Outcome.STRAYED),
        (CALM._replace(fall_rad=0.1, ahead_rad=0.3), Trend.DECAYS, Outcome.STRAYED),
        (CALM._replace(spread_rad=0.5), Trend.DECAYS, Outcome.APART),
    ],
)
def test_the_first_that_holds_is_the_outcome(ending: Ending, trend: Trend, outcome: Outcome) -> None:
    assert judged(False, trend, ending, ending) is outcome
    assert judged(True, trend, ending, ending) is Outcome.DIVERGED


def test_pose_is_judged_on_the_twin_and_swinging_on_both() -> None:
    pushed = Ending(spread_rad=0.5, fall_rad=1.0, ahead_rad=1.0, swing_rad=0.0)
    assert judged(False, Trend.STEADY, pushed, CALM) is Outcome.SETTLED
    hammering = CALM._replace(swing_rad=0.2)
    assert judged(False, Trend.STEADY, hammering, CALM) is Outcome.OSCILLATED
    assert judged(False, Trend.STEADY, CALM, hammering) is Outcome.OSCILLATED


def test_every_outcome_has_a_meaning() -> None:
    assert list(MEANINGS) == list(Outcome)
