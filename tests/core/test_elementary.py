"""Sine and cosine, against the platform's."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.core.arms.elementary import LARGEST_RAD, sincos


@given(st.floats(-1e5, 1e5))
def test_results_are_right_to_one_last_place(x: float) -> None:
    s, c = sincos(x)
    assert abs(s - math.sin(x)) <= 2.3e-16
    assert abs(c - math.cos(x)) <= 2.3e-16


@given(st.floats(-LARGEST_RAD, LARGEST_RAD))
def test_large_angles_lose_only_their_own_precision(x: float) -> None:
    s, c = sincos(x)
    assert abs(s - math.sin(x)) <= 2.3e-16 + math.ulp(x)
    assert abs(c - math.cos(x)) <= 2.3e-16 + math.ulp(x)
    assert s * s + c * c == pytest.approx(1.0, abs=1e-15)


@given(st.floats(0, 1e5))
def test_sine_is_odd_and_cosine_even(x: float) -> None:
    """The odd multiples of an eighth of a turn are left out, because rounding to a quarter is one-sided there."""
    if abs((x * 2 / math.pi) % 1.0 - 0.5) < 1e-9:
        return
    sine, cosine = sincos(x)
    assert sincos(-x) == (-sine, cosine)


@pytest.mark.parametrize("x", [math.nan, math.inf, -math.inf, 2.0**31])
def test_an_infinite_angle_has_no_sine(x: float) -> None:
    s, c = sincos(x)
    assert math.isnan(s)
    assert math.isnan(c)
