"""Distributions in place of numbers: drawn by seed, written resolved, drawn again by another seed."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.scenario.distributions import Distribution

EXAMPLE: dict[str, Any] = {
    "sites.m1.q0_rad": {"normal": [0.1, 0.02]},
    "arm.m1_kg": {"uniform": [0.9, 1.1]},
    "control.Kd": {"normal": [3.0, 0.1]},
    "sites.m1.hands": [
        {"kind": "spring", "stiffness_nm_rad": {"uniform": [20.0, 30.0]}, "end_s": 5.0},
        {"kind": "tip_spring", "stiffness_n_m": [30.0, 30.0]},
        {
            "kind": "pulse",
            "start_s": 1.0,
            "end_s": {"uniform": [3.0, 5.0]},
            "peak_nm": [10.0, 0.0],
        },
    ],
}


def draw_scenario(seed: int) -> Scenario:
    return load_scenario("free", {**EXAMPLE, "seed": seed})


def test_each_number_is_drawn_separately() -> None:
    """Joints, sites and seeds differ; the same seed gives the same."""
    first = draw_scenario(1)
    other = draw_scenario(2)
    assert first == draw_scenario(1)
    assert len(set(first.sites["m1"].q0_rad + other.sites["m1"].q0_rad)) == 4
    assert len({spec.arm.m1_kg for spec in (*first.sites.values(), *other.sites.values())}) == 6
    assert first.random
    assert not first.links_random
    assert first.drawn["sites.m1.q0_rad.1"].value == first.sites["m1"].q0_rad[1]


def test_further_drawn_numbers_change_none() -> None:
    more = load_scenario(draw_scenario(1), {"sites.s.q0_rad": {"normal": [0.0, 1.0]}})
    assert more.sites["m1"] == draw_scenario(1).sites["m1"]
    assert more.sites["s"].q0_rad != draw_scenario(1).sites["s"].q0_rad


def test_numbers_follow_their_distribution() -> None:
    """The statistic of Kolmogorov and Smirnov at 1e-4 detects a wrong mean or width of 10 %."""
    from scipy import stats

    keys = [f"sites.m1.q0_rad.{n}" for n in range(2000)]
    normal = [Distribution(normal=(0.1, 0.02), value=0.0).draw(7, key) for key in keys]
    uniform = [Distribution(uniform=(-1.0, 3.0), value=0.0).draw(7, key) for key in keys]
    assert stats.kstest(normal, stats.norm(0.1, 0.02).cdf).pvalue > 1e-4
    assert stats.kstest(uniform, stats.uniform(-1.0, 4.0).cdf).pvalue > 1e-4
    assert abs(np.corrcoef(normal[1:], normal[:-1])[0, 1]) < 0.08


def test_canonical_text_holds_the_drawn_numbers() -> None:
    drawn_scenario = draw_scenario(3)
    again = parse_scenario(drawn_scenario.text)
    assert again == drawn_scenario
    assert again.sha256 == drawn_scenario.sha256
    assert "[drawn" not in load_scenario("free").text


def test_another_seed_draws_again_from_any_source() -> None:
    """The source is a scenario or the text of a log, and hands that hold the start pose are drawn too."""
    for scenario in (
        load_scenario(draw_scenario(1), seed=5),
        load_scenario(parse_scenario(draw_scenario(2).text), seed=5),
    ):
        assert scenario == draw_scenario(5)
        assert scenario.sha256 == draw_scenario(5).sha256
    spring, tip, _ = scenario.sites["m1"].hands
    assert spring.from_rad == spring.to_rad == scenario.sites["m1"].q0_rad
    a, b = scenario.sites["m1"].q0_rad
    assert tip.from_m == pytest.approx((np.cos(a) + np.cos(a + b), np.sin(a) + np.sin(a + b)))


PLACES = (
    "arm.l1_m",
    "control.Lambda",
    "limits.tau_limit_nm",
    "sites.m2.q0_rad",
    "sites.s.control.Gamma",
    "sites.s.qd0_rad_s",
    "sites.m1.hands.0.stiffness_nm_rad",
    "sites.m1.hands.1.to_m",
    "sites.m1.hands.2.peak_nm",
)
ends = st.tuples(st.floats(0.5, 2.0), st.floats(2.0, 9.0)).map(list)


@given(
    drawn_there=st.dictionaries(st.sampled_from(PLACES), ends),
    seeds=st.tuples(*[st.integers(0, 2**63 - 1)] * 2),
)
def test_changing_seeds_back_restores_the_experiment(
    drawn_there: dict[str, list[float]], seeds: tuple[int, int]
) -> None:
    """For any draw the text loads to itself, and the first seed gives the first experiment again."""
    ranges = {
        key: {"uniform": two}
        for key, two in drawn_there.items()
        if key != "sites.m1.hands.1.to_m"
    }
    if "sites.m1.hands.1.to_m" in drawn_there:
        ranges["sites.m1.hands.1.to_m"] = [
            {"uniform": drawn_there["sites.m1.hands.1.to_m"]},
            0.5,
        ]
    first = load_scenario("free", {**EXAMPLE, **ranges, "seed": seeds[0]})
    assert parse_scenario(first.text).text == first.text
    other = load_scenario(first, seed=seeds[1])
    assert parse_scenario(other.text).text == other.text
    assert load_scenario(other, seed=seeds[0]) == first
    for key, number in other.drawn.items():
        if number.uniform:
            assert number.uniform[0] - 1e-8 <= number.value <= number.uniform[1] + 1e-8, key


def test_replaced_numbers_stay() -> None:
    fixed = load_scenario(
        draw_scenario(1), {"sites.m1.q0_rad": [0.3, 0.0], "control.law": "p_d"}
    )
    other = load_scenario(fixed, seed=2)
    assert other.sites["m1"].q0_rad == (0.3, 0.0)
    assert other.sites["m1"].arm == draw_scenario(2).sites["m1"].arm
    assert not any(".control." in key for key in other.drawn)


def test_an_experiment_without_operators_stays_itself() -> None:
    alone = draw_scenario(1).without_hands()
    assert parse_scenario(alone.text) == alone
