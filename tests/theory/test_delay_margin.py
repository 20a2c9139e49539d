"""Delay margins against closed forms, and against roots on both sides of them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.theory.loops import make_loop
from trilat_net.analysis.theory import find_equilibrium
from trilat_net.analysis.theory.characteristic_roots import Spectrum
from trilat_net.analysis.theory.delay_margin import MAX_COMMON_DELAY_S, DelayMargin
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.scenario import load_scenario


@given(a=st.floats(0.2, 5.0))
@settings(max_examples=25)
def test_a_delayed_integrator_tolerates_a_quarter_turn(a: float) -> None:
    """x' = -a x(t - T): stable up to a T = pi/2, crossing at a."""
    (span,) = DelayMargin.of_loop(make_loop(0.0, (1.0, -a))).intervals
    assert (span.low_s, span.low) == (0.0, None)
    assert span.high is not None
    assert span.high_s == pytest.approx(math.pi / 2 / a, rel=1e-9)
    assert span.high.omega_rad_s == pytest.approx(a, rel=1e-9)


def test_sufficient_damping_is_stable_for_every_delay() -> None:
    """x' = -2 x + x(t - T)."""
    margin = DelayMargin.of_loop(make_loop(-2.0, (1.0, 1.0)))
    assert margin.description == "stable for every common delay up to 10 s"
    assert (
        DelayMargin.of_loop(make_loop(1.0, (1.0, 0.5))).description
        == "unstable for every common delay up to 10 s"
    )


def test_oscillators_have_several_stable_delay_windows() -> None:
    """x'' + 0.1 x' + x = -0.4 x(t - T) with its windows; each end is a root on the axis."""
    system = make_loop([[0.0, 1.0], [-4.0, -0.1]], (1.0, [[0.0, 0.0], [-1.0, 0.0]]))
    margin = DelayMargin.of_loop(system)
    assert len(margin.intervals) > 1
    assert margin.intervals[0].low is None
    for span in margin.intervals:
        inside = 0.5 * (span.low_s + span.high_s)
        assert Spectrum.of_loop(system.set_common_delay(inside), 1).verdict == "stable"
        if span.high is not None:
            root = Spectrum.of_loop(system.set_common_delay(span.high_s), 1).roots[0]
            assert abs(root.s - 1j * span.high.omega_rad_s) < 1e-8
            assert (
                Spectrum.of_loop(system.set_common_delay(1.001 * span.high_s), 1).verdict
                == "unstable"
            )


def test_undamped_modes_leave_the_margin_finite() -> None:
    """x'' + 9 x = 2 x(t - T): the response is infinite at 3 rad/s, and roots cross at sqrt(11)."""
    span = DelayMargin.of_loop(
        make_loop([[0.0, 1.0], [-9.0, 0.0]], (1.0, [[0.0, 0.0], [2.0, 0.0]]))
    ).intervals[0]
    assert span.high is not None
    assert span.high_s == pytest.approx(math.pi / math.sqrt(11.0), rel=1e-9)
    assert span.high.omega_rad_s == pytest.approx(math.sqrt(11.0), rel=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=15)
def test_verdicts_over_delay_are_the_roots(seed: int) -> None:
    rng = np.random.default_rng(seed)
    system = make_loop(
        rng.normal(size=(3, 3)) - np.eye(3), (1.0, 0.7 * rng.normal(size=(3, 3)))
    )
    margin = DelayMargin.of_loop(system)
    ends = [end for span in margin.intervals for end in (span.low_s, span.high_s)]
    for T in (0.0, 0.1, 0.4, 1.0, 2.5):
        if all(abs(T - end) > 0.01 for end in ends if 0 < end < MAX_COMMON_DELAY_S):
            inside = any(span.low_s <= T <= span.high_s for span in margin.intervals)
            assert (
                Spectrum.of_loop(system.set_common_delay(T), 1).verdict == "stable"
            ) == inside


def test_roots_at_zero_cross_nothing() -> None:
    scenario = load_scenario("free")
    margin = DelayMargin.of_loop(
        LinearLoop.of_conditions(
            OperatingConditions.derive(scenario), find_equilibrium(scenario, (-0.1236, 0.3373))
        )
    )
    assert margin.description == "stable for every common delay up to 10 s"


def test_force_reflection_in_contact_has_a_margin() -> None:
    """20 ms settles, 200 ms hammers."""
    scenario = load_scenario("contact", {"rate_hz": 500, "link.delay_ms": 20.0})
    margin = DelayMargin.of_loop(
        LinearLoop.of_conditions(
            OperatingConditions.derive(scenario), find_equilibrium(scenario)
        )
    )
    (span,) = margin.intervals
    assert 0.02 < span.high_s < 0.2
    assert "crosses at" in margin.description
