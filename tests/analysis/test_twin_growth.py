"""The description of a difference matches its construction: rate, factor and place."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

import trilat_net as tn
from trilat_net.analysis.twins.envelope_trend import EnvelopeTrend
from trilat_net.analysis.twins.twin_growth import (
    CLEAR_GROWTH,
    PushedTwins,
    PushGrowth,
    TwinGrowth,
)
from trilat_net.analysis.twins.twin_runs import Push, TwinPath, Twins
from trilat_net.scenario import load_scenario

TWO = load_scenario("two_sites")
WITHOUT_ESTIMATES = load_scenario("p_d_margin_two")
JOINTS = ("m joint 1", "m joint 2", "s joint 1", "s joint 2")


def make_twins(rate_per_s: float, omega_rad_s: float = 7.0, seconds: float = 20.0) -> Twins:
    """Returns one mode of a difference, largest at s joint 1, which is rescaled again and again."""
    t_s = np.arange(int(20 * seconds)) / 20.0 + 0.05
    shape = np.array([0.2, 0.1, 1.0, 0.5])
    last = 1e-6 * np.cos(omega_rad_s * t_s)[:, np.newaxis] * shape
    scale = rate_per_s * t_s
    push = Push("1e-06 rad at m joint 1", "q", np.eye(2) * 1e-6, again=False)
    path = TwinPath(push, t_s, np.log(np.abs(last)) + scale[:, np.newaxis], last, scale, (0,))
    return Twins([path], JOINTS, np.full((len(t_s), 4), 1e-3), True)


def judge_difference(rate_per_s: float) -> TwinGrowth:
    return TwinGrowth.of_twins(TWO, make_twins(rate_per_s), 0.0, math.inf)


@pytest.mark.parametrize("rate_per_s", [-0.55, -0.02, 0.0, 0.02, 0.55])
def test_rate_of_modes_is_found_without_swing(rate_per_s: float) -> None:
    growth = judge_difference(rate_per_s).pushes[0]
    assert growth.rate_per_s == pytest.approx(rate_per_s, abs=2e-3)
    assert growth.factor == pytest.approx(math.exp(10.0 * rate_per_s), rel=0.05)
    assert growth.joint == "s joint 1"


def test_the_words_follow_the_trend() -> None:
    trends = {rate: judge_difference(rate).trend for rate in (-0.55, 0.0, 0.2)}
    assert list(trends.values()) == [
        EnvelopeTrend.DECAYS,
        EnvelopeTrend.STEADY,
        EnvelopeTrend.GROWS,
    ]
    log = tn.simulate("two_sites", duration_s=0.1)
    texts = [PushedTwins(log, 0.0, judge_difference(rate)).headline() for rate in trends]
    rates = [judge_difference(rate).pushes[0].rate_per_s for rate in trends]
    push = "a push of 1e-06 rad at m joint 1 at 0 s"
    assert texts[0].startswith(f"{push} becomes ")
    assert texts[0].endswith(f"rad/s in 20 s ({rates[0]:+.3g} /s), most at s joint 1")
    assert texts[1].endswith("; it shows no clear trend")
    assert texts[2].startswith(f"{push} grows x 7.")
    assert texts[2].endswith(f"({rates[2]:+.3g} /s), most at s joint 1")


def test_infinite_numbers_are_null() -> None:
    row = judge_difference(80.0).to_json()["pushes"][0]
    assert (row["becomes_rad_s"], row["factor"]) == (None, None)
    assert row["rate_per_s"] == pytest.approx(80.0, rel=0.05)


def of_joints(*rates_per_s: float, sizes: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)) -> Twins:
    """Returns two twins in which every joint has a mode of its own, with its own rate and size."""
    t_s = np.arange(400) / 20.0 + 0.05
    log_sizes = np.log(1e-6 * np.array(sizes)) + np.outer(t_s, rates_per_s)
    last = np.exp(log_sizes) * np.cos(7.0 * t_s)[:, np.newaxis]
    largest = np.log(np.abs(last))
    paths = []
    for name in ("1e-06 rad at all joints", "1e-06 rad at m joint 1"):
        push = Push(name, "q", np.full((2, 2), 1e-6), again=False)
        paths.append(TwinPath(push, t_s, largest.copy(), last, np.zeros(len(t_s)), (0,)))
    return Twins(paths, JOINTS, np.full((len(t_s), 4), 1e-3), True)


def test_slow_growth_shows_beside_faster_decay() -> None:
    """m joint 1 grows by 0.02 /s from a thousandth of the size of the others, which decay."""
    sizes = (1e-3, 1.0, 1.0, 1.0)
    growth = TwinGrowth.of_twins(
        TWO, of_joints(0.02, -0.3, -0.3, -0.3, sizes=sizes), 0.0, math.inf
    )
    assert growth.trend is EnvelopeTrend.GROWS
    assert growth.worst is not None
    assert growth.worst.joint == "m joint 1"
    assert growth.worst.rate_per_s == pytest.approx(0.02, abs=2e-3)
    assert growth.grows is growth.worst.leads


def test_one_growing_joint_makes_pushes_grow() -> None:
    growth = TwinGrowth.of_twins(TWO, of_joints(0.02, -2.0, -2.0, -2.0), 0.0, math.inf)
    assert growth.grows
    still = TwinGrowth.of_twins(TWO, of_joints(-0.3, -2.0, -2.0, -2.0), 0.0, math.inf)
    assert still.trend is EnvelopeTrend.DECAYS
    assert not still.grows


def test_part_of_a_period_has_no_trend() -> None:
    """The delays of this scenario repeat after 145.2 s: 1.20 s and 1.21 s."""
    sines = {
        "links.m->s": {
            "model": "sine",
            "delay_ms": 50.0,
            "amplitude_ms": 20.0,
            "period_s": 1.2,
        },
        "links.s->m": {
            "model": "sine",
            "delay_ms": 50.0,
            "amplitude_ms": 20.0,
            "period_s": 1.21,
        },
    }
    growth = TwinGrowth.of_twins(
        load_scenario("two_sites", sines), make_twins(-0.5), 0.0, math.inf
    )
    assert growth.delay_period_s == pytest.approx(145.2)
    assert growth.hides_period


def with_pushes(pushes: Sequence[Push]) -> TwinGrowth:
    decays = [
        PushGrowth(push, EnvelopeTrend.DECAYS, -1.0, 0.1, "m joint 1", 0, 0.0)
        for push in pushes
    ]
    return TwinGrowth("", pushes=tuple(decays))


def miss_probability(directions: int) -> float:
    chance = with_pushes(Push.choose(WITHOUT_ESTIMATES, directions)).miss_chance
    assert chance is not None
    assert chance.directions == directions
    return chance.probability


def test_random_directions_rarely_miss_a_growing_mode() -> None:
    """A mode with less than a hundredth of its usual share in each of n directions."""
    generator = np.random.default_rng(1)
    mode = generator.standard_normal(30)
    directions = generator.uniform(-1.0, 1.0, (200_000, 30))
    shares = np.abs(directions @ mode) / (np.linalg.norm(mode) / math.sqrt(3.0))
    missed = float(np.mean(shares < 1.0 / CLEAR_GROWTH))
    assert miss_probability(1) == pytest.approx(missed, rel=0.1)
    assert miss_probability(3) == pytest.approx(miss_probability(1) ** 3)
    single_joints = with_pushes(Push.choose(TWO))
    assert single_joints.miss_chance is None


@pytest.mark.long
def test_twins_separate_linear_and_nonlinear_motion() -> None:
    """The difference of a pendulum's swing for 1 rad is not a thousand times that for 1 mrad."""
    log = tn.simulate("p_d_margin", duration_s=8.0)
    twin_report = tn.twin(log, 2.0, {"m1.q1": 1e-6}, "1e-8:1")
    assert twin_report.linear is not None
    assert twin_report.linear.smallest == 1e-8
    assert 1e-4 <= twin_report.linear.largest <= 0.1
    assert (
        f"; a push of {10 * twin_report.linear.largest:g} develops differently: x "
        in twin_report.headline()
    )
    assert len(twin_report.to_frame()) == 9
