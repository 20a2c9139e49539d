"""Conditions in closed form: what they ask for, and where they do not speak."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.scenario import Scenario, load_scenario
from trilat_net.studies.sweep.stability_map import evaluate_criterion

GAIN = st.floats(0.1, 50.0)
DELAY_MS = st.integers(1, 5000)


def excess(scenario: Scenario) -> float:
    found = evaluate_criterion(scenario)
    assert found is not None
    return found.excess


@given(GAIN, GAIN, DELAY_MS)
def test_equal_sites_ask_for_half_of_stiffness_times_delay(K: float, d: float, delay_ms: int) -> None:
    """Three sites with equal shares: the least eigenvalue of alpha is -1/2."""
    one = load_scenario("p_d_margin", {"control.K": K, "control.d": d, "link.delay_ms": delay_ms})
    assert excess(one) == pytest.approx(d - 0.5 * K * delay_ms / 1e3, abs=1e-9)


@given(GAIN, GAIN, GAIN, GAIN, DELAY_MS, DELAY_MS)
def test_two_sites_are_judged_by_the_sign_of_the_general_condition(
    K1: float, K2: float, d1: float, d2: float, there_ms: int, back_ms: int
) -> None:
    names = load_scenario("p_d_margin_two").names
    settings: dict[str, Any] = {}
    for name, K, d in zip(names, (K1, K2), (d1, d2), strict=True):
        settings |= {
            f"sites.{name}.control.{key}": value for key, value in (("law", "p_d"), ("K", K), ("d", d))
        }
    settings |= {f"links.{names[0]}->{names[1]}.delay_ms": there_ms}
    settings |= {f"links.{names[1]}->{names[0]}.delay_ms": back_ms}
    margin = 4.0 * d1 * d2 - ((there_ms + back_ms) / 1e3) ** 2 * K1 * K2
    if abs(margin) > 1e-6:
        assert np.sign(excess(load_scenario("p_d_margin_two", settings))) == np.sign(margin)


def test_of_two_equal_sites_both_conditions_are_one() -> None:
    """N = 2: abs(lambda_min) = 1, d = K T."""
    one = load_scenario("p_d_margin_two", {"control.d": 2.0, "control.K": 10.0, "link.delay_ms": 200.0})
    assert excess(one) == pytest.approx(0.0, abs=1e-12)


def test_the_digital_scheme_rests_on_gravity_learnt_slower_than_a_tick_allows() -> None:
    settings = {"scheme": "digital", "link.delay_ms": 0.0, "rate_hz": 100, "control.Gamma": 1.0}
    assert excess(load_scenario("paper", settings)) == pytest.approx(1.0 - 9.81**2 / 100)
    gravity = {**settings, "control.Gamma": [9.0, 9.0, 9.0, 1.0, 1.0]}
    assert excess(load_scenario("paper", gravity)) == pytest.approx(excess(load_scenario("paper", settings)))


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("free", {}),  # the theorem: stable for every constant delay, no line
        ("free", {"scheme": "digital"}),  # with a delay of many ticks the rule says nothing
        ("p_d_margin", {"control.gravity": 0.9}),
        ("p_d_margin", {"control.K": [10.0, 5.0]}),
        ("p_d_margin", {"sites.s.control.law": "p_d", "sites.s.control.K": 5.0}),
        ("p_d_margin", {"links.m1->s.delay_ms": 100.0}),
        ("p_d_margin", {"link.model": "uniform", "link.delay_ms": 200.0, "link.half_width_ms": 50.0}),
        ("p_d_margin", {"link.loss": 0.5}),
        ("p_d_margin", {"on_stale.action": "hold"}),
        ("p_d_margin", {"control.law": "pd_d"}),
        ("jitter", {}),
        ("contact", {}),
    ],
)
def test_where_its_premises_do_not_hold_a_condition_says_nothing(name: str, settings: dict[str, Any]) -> None:
    assert evaluate_criterion(load_scenario(name, settings)) is None


def test_play_out_counts_as_delay() -> None:
    assert excess(load_scenario("p_d_margin", {"link.playout_ms": 400.0})) == pytest.approx(1.1 - 2.0)


def test_of_shares_that_turn_in_a_circle_the_roots_are_complex_and_nothing_is_said() -> None:
    circle = {f"dominance.{a}": {b: 1.0} for a, b in (("m1", "m2"), ("m2", "s"), ("s", "m1"))}
    assert evaluate_criterion(load_scenario("p_d_margin", circle)) is None
