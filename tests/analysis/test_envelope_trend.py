"""The trend of an envelope, for signals whose trend is known by construction and for signals
without trend.
"""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from trilat_net.analysis.twins.envelope_trend import FLOOR_RAD, EnvelopeFit, EnvelopeTrend

Array = NDArray[np.float64]

STEP_S = 0.05
T_S = np.arange(800) * STEP_S

rates = st.floats(0.02, 0.6)
scales = st.floats(1e-3, 1e3)
quick = st.floats(3.0, 40.0)  # rad/s: a peak in every window
phases = st.floats(0.0, 2.0 * math.pi)


def fit_envelope(t_s: np.ndarray, envelope: np.ndarray) -> EnvelopeFit:
    return EnvelopeFit.fit_columns(t_s, envelope[:, np.newaxis])[0]


def make_oscillation(
    rate_per_s: float, omega: float, phase: float, scale: float = 1.0
) -> Array:
    """Returns the largest |scale exp(rate t) cos(omega t + phase)| of every step, as a run keeps it."""
    t_s = np.arange(len(T_S) * 25) * (STEP_S / 25)
    error = scale * np.exp(rate_per_s * (t_s - 20.0)) * np.abs(np.cos(omega * t_s + phase))
    largest: Array = error.reshape(len(T_S), -1).max(axis=1)
    return largest


@settings(max_examples=40)
@given(rate=rates, omega=quick, phase=phases)
def test_exponential_growth_has_its_rate(rate: float, omega: float, phase: float) -> None:
    envelope_fit = fit_envelope(T_S, make_oscillation(rate, omega, phase))
    assert envelope_fit.trend is EnvelopeTrend.GROWS
    assert envelope_fit.rate_per_s == pytest.approx(rate, rel=0.1, abs=0.005)


@settings(max_examples=40)
@given(rate=rates, omega=quick, phase=phases)
def test_decay_counts_from_a_factor_of_two(rate: float, omega: float, phase: float) -> None:
    """Half of the run is 20 s: ln 2 / 20 s is 0.035 /s."""
    trend = fit_envelope(T_S, make_oscillation(-rate, omega, phase)).trend
    if not 0.03 < rate < 0.045:  # there, which points the windows see decides
        assert trend is (EnvelopeTrend.DECAYS if rate > 0.035 else EnvelopeTrend.HARDLY)


@settings(max_examples=40)
@given(omega=quick, phase=phases, scale=scales)
def test_a_sustained_oscillation_of_any_size_is_steady(
    omega: float, phase: float, scale: float
) -> None:
    assert (
        fit_envelope(T_S, make_oscillation(0.0, omega, phase, scale)).trend
        is EnvelopeTrend.STEADY
    )


@settings(max_examples=40)
@given(rate=st.floats(-0.3, 0.3), omega=st.floats(0.0, 40.0), phase=phases, scale=scales)
def test_the_trend_is_independent_of_units(
    rate: float, omega: float, phase: float, scale: float
) -> None:
    error = np.maximum(make_oscillation(rate, omega, phase), 1e-3)
    envelope_fit = fit_envelope(T_S, error)
    larger = fit_envelope(T_S, scale * error)
    slower = fit_envelope(60.0 * T_S, error)
    assert larger.trend is slower.trend is envelope_fit.trend
    assert larger.rate_per_s == pytest.approx(envelope_fit.rate_per_s, rel=1e-6, abs=1e-9)
    assert slower.rate_per_s == pytest.approx(
        envelope_fit.rate_per_s / 60.0, rel=1e-6, abs=1e-9
    )


@settings(max_examples=40)
@given(rate=st.floats(-1.0, 1.0), omega=st.floats(0.0, 40.0), phase=phases)
@example(rate=0.0, omega=0.015625, phase=1.3125)
def test_a_signal_and_its_reverse_never_both_grow(
    rate: float, omega: float, phase: float
) -> None:
    error = make_oscillation(rate, omega, phase)
    assert EnvelopeTrend.GROWS not in {fit_envelope(T_S, error).trend} & {
        fit_envelope(T_S, error[::-1]).trend
    }


@settings(max_examples=40)
@given(turn_s=st.floats(16.5, 23.5), power=st.floats(0.3, 3.0), scale=scales)
def test_v_shaped_signals_are_undecided_in_both_directions(
    turn_s: float, power: float, scale: float
) -> None:
    """A quarter of a swing before the middle of a run and one behind it: the further motion is unknown."""
    trend = fit_envelope(T_S, scale * np.abs(T_S - turn_s) ** power).trend
    assert trend in (EnvelopeTrend.UNDECIDED, EnvelopeTrend.STEADY)


@settings(max_examples=40)
@given(decay=st.floats(0.05, 2.0), rate=st.floats(0.03, 0.3), share=st.floats(0.01, 1.0))
def test_growth_under_a_decaying_start_is_found(
    decay: float, rate: float, share: float
) -> None:
    """At the middle of the longer run the growing part is ten times the decaying part."""
    t_s = np.linspace(0.0, 2.0 * max(4.0 / rate, math.log(10.0 / share) / (decay + rate)), 800)
    error = np.exp(-decay * t_s) + share * np.exp(rate * t_s)
    assert fit_envelope(t_s, error).trend is EnvelopeTrend.GROWS


@settings(max_examples=40)
@given(at_s=st.floats(20.0, 39.0), height=st.floats(10.0, 1e4), decay=st.floats(0.1, 5.0))
def test_a_late_disturbance_is_not_growth(at_s: float, height: float, decay: float) -> None:
    since_s = np.maximum(0.0, T_S - at_s)
    kick = np.where(since_s > 0.0, height * np.exp(-decay * since_s), 0.0)
    assert fit_envelope(T_S, 1e-3 * (1.0 + kick)).trend is not EnvelopeTrend.GROWS


@settings(max_examples=40)
@given(time_constant_s=st.floats(0.5, 1e3))
def test_a_response_that_settles_is_not_growth(time_constant_s: float) -> None:
    assert (
        fit_envelope(T_S, 1.0 - np.exp(-T_S / time_constant_s)).trend is not EnvelopeTrend.GROWS
    )


def test_a_converged_signal_decays_despite_noise() -> None:
    noise = np.random.default_rng(1).uniform(0.0, FLOOR_RAD, len(T_S))
    assert fit_envelope(T_S, noise).trend is EnvelopeTrend.DECAYS
    assert fit_envelope(T_S, np.where(T_S < 10.0, 1.0, noise)).trend is EnvelopeTrend.DECAYS


def test_stationary_noise_is_hardly_ever_growth() -> None:
    trends = [
        fit_envelope(
            T_S, np.exp(0.3 * np.random.default_rng(seed).standard_normal(len(T_S)))
        ).trend
        for seed in range(300)
    ]
    assert trends.count(EnvelopeTrend.GROWS) <= 3
    assert trends.count(EnvelopeTrend.STEADY) + trends.count(EnvelopeTrend.DECAYS) >= 270


@pytest.mark.parametrize("points", [0, 1, 2, 15, 30])
def test_a_short_run_is_undecided(points: int) -> None:
    envelope_fit = fit_envelope(T_S[:points], np.exp(T_S[:points]))
    assert envelope_fit.trend is EnvelopeTrend.UNDECIDED
    assert math.isnan(envelope_fit.rate_per_s)
