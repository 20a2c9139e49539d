"""What is said of a difference is what it does: its rate, its factor, and where."""

import math

import numpy as np
import pytest

import trilat_net as tn
from trilat_net.analysis.envelope_trend import EnvelopeTrend
from trilat_net.analysis.run_end import EndBehaviour, Stability, classify_log_end
from trilat_net.analysis.twin_growth import (
    PushedTwins,
    TwinGrowth,
    judge_end_by_twins,
    judge_twins,
)
from trilat_net.execution.twins import Push, TwinPath, Twins
from trilat_net.scenario import load_scenario

TWO = load_scenario("two_sites")
JOINTS = ("m joint 1", "m joint 2", "s joint 1", "s joint 2")


def difference(rate_per_s: float, omega_rad_s: float = 7.0, seconds: float = 20.0) -> Twins:
    """One mode of a difference, largest at s joint 1, which is made small again all the time."""
    t_s = np.arange(int(20 * seconds)) / 20.0 + 0.05
    shape = np.array([0.2, 0.1, 1.0, 0.5])
    last, scale = 1e-6 * np.cos(omega_rad_s * t_s)[:, np.newaxis] * shape, rate_per_s * t_s
    push = Push("1e-06 rad at m joint 1", "q", np.eye(2) * 1e-6, again=False)
    path = TwinPath(push, t_s, np.log(np.abs(last)) + scale[:, np.newaxis], last, scale, (0,))
    return Twins([path], JOINTS, np.full((len(t_s), 4), 1e-3), True)


def grown(rate_per_s: float) -> TwinGrowth:
    return judge_twins(TWO, difference(rate_per_s), 0.0, math.inf)


@pytest.mark.parametrize("rate_per_s", [-0.55, -0.02, 0.0, 0.02, 0.55])
def test_the_rate_of_a_mode_is_found_without_its_swing(rate_per_s: float) -> None:
    found = grown(rate_per_s).pushes[0]
    assert found.rate_per_s == pytest.approx(rate_per_s, abs=2e-3)
    assert found.factor == pytest.approx(math.exp(10.0 * rate_per_s), rel=0.05)
    assert found.joint == "s joint 1"


def test_the_words_follow_the_trend() -> None:
    trends = {rate: grown(rate).trend for rate in (-0.55, 0.0, 0.2)}
    assert list(trends.values()) == [
        EnvelopeTrend.DECAYS,
        EnvelopeTrend.STEADY,
        EnvelopeTrend.GROWS,
    ]
    log = tn.simulate("two_sites", duration_s=0.1)
    texts = [PushedTwins(log, 0.0, grown(rate)).headline() for rate in trends]
    rates = [grown(rate).pushes[0].rate_per_s for rate in trends]
    push = "a push of 1e-06 rad at m joint 1 at 0 s"
    assert texts[0].startswith(f"{push} becomes ")
    assert texts[0].endswith(f"rad/s in 20 s ({rates[0]:+.3g} /s), most at s joint 1")
    assert texts[1].endswith("; it shows no clear trend")
    assert texts[2].startswith(f"{push} grows x 7.")
    assert texts[2].endswith(f"({rates[2]:+.3g} /s), most at s joint 1")


def test_a_number_beyond_all_numbers_is_null() -> None:
    row = grown(80.0).to_json()["pushes"][0]
    assert (row["becomes_rad_s"], row["factor"]) == (None, None)
    assert row["rate_per_s"] == pytest.approx(80.0, rel=0.05)


def test_a_run_is_not_stable_where_its_twins_grow() -> None:
    end = classify_log_end(tn.simulate("two_sites"))
    assert end.stability is Stability.STABLE
    slow = end._replace(speed=end.speed._replace(trend=EnvelopeTrend.STEADY))
    judged = {
        rate: judge_end_by_twins(slow, grown(rate), settles=None, rises=False).stability
        for rate in (-0.55, 0.0, 0.2)
    }
    assert judged == {-0.55: Stability.STABLE, 0.0: Stability.OPEN, 0.2: Stability.NOT_STABLE}


@pytest.mark.parametrize(
    ("speed_rad_s", "rate_per_s"),
    [
        (1e-4, -0.55),
        *(pytest.param(*one, marks=pytest.mark.long) for one in ((5e-3, -0.55), (1e-4, 0.0))),
    ],
)
def test_a_slow_end_needs_no_trend_where_pushes_die(
    speed_rad_s: float, rate_per_s: float
) -> None:
    """1e-4 rad/s are 1 mrad in 10 s; 5e-3 rad/s may be a drift, and what keeps a push may keep going."""
    end = classify_log_end(tn.simulate("two_sites"))
    slow = end._replace(behaviour=EndBehaviour.UNDECIDED, end_speed_rad_s=speed_rad_s)
    judged = judge_end_by_twins(slow, grown(rate_per_s), settles=None, rises=False).stability
    settled = speed_rad_s < 1e-3 and rate_per_s < 0.0
    assert judged is (Stability.STABLE if settled else Stability.OPEN)


@pytest.mark.long
def test_twins_tell_what_is_linear_from_what_is_not() -> None:
    """A pendulum's swing of 1 rad is another motion than a thousand of 1 mrad."""
    log = tn.simulate("p_d_margin", duration_s=8.0)
    found = tn.twin(log, 2.0, {"m1.q1": 1e-6}, "1e-8:1")
    assert found.linear is not None
    assert found.linear.smallest == 1e-8
    assert 1e-4 <= found.linear.largest <= 0.1
    assert (
        f"; a push of {10 * found.linear.largest:g} goes another way: x " in found.linear.text
    )
    assert len(found.to_frame()) == 9
