import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.theory.networks import Array, Network, make_pair
from trilat_net.analysis.theory.frequency_search import (
    Minima,
    build_frequency_grid,
    find_resolved_hz,
    refine_response,
)
from trilat_net.analysis.theory.port_response import build_admittance

HZ = 2.0 * np.pi


@given(low_hz=st.floats(1e-4, 1.0), decades=st.floats(0.1, 5.0), delay_s=st.floats(0.0, 3.0))
def test_grids_span_bands_and_follow_delays(
    low_hz: float, decades: float, delay_s: float
) -> None:
    high_hz = low_hz * 10.0**decades
    w = build_frequency_grid(low_hz, high_hz, delay_s)
    assert w[0] == pytest.approx(HZ * low_hz)
    assert w[-1] == pytest.approx(HZ * high_hz)
    assert (np.diff(w) > 0.0).all()
    followed = w[w <= HZ * find_resolved_hz(low_hz, high_hz, delay_s)]
    assert (2.0 * delay_s * np.diff(followed) <= HZ / 4.0 * 1.03).all()


@given(at_hz=st.floats(0.01, 10.0), width=st.floats(0.002, 1.0))
def test_dips_between_grid_points_are_found(at_hz: float, width: float) -> None:
    """A Lorentzian whose half width is down to a thirtieth of the grid's steps."""

    def curve(w: Array) -> Array:
        return np.asarray(0.1 - 1.0 / (1.0 + (np.log(w / (HZ * at_hz)) / width) ** 2))

    minima = Minima.find(curve, build_frequency_grid(1e-3, 100.0, 0.0))
    assert minima.least == pytest.approx(-0.9, rel=0.02)
    assert minima.least_hz == pytest.approx(at_hz, rel=0.2 * width)
    (span,) = minima.below
    assert span.from_hz == pytest.approx(max(1e-3, at_hz * np.exp(-3.0 * width)), rel=1e-6)
    assert span.to_hz == pytest.approx(min(100.0, at_hz * np.exp(3.0 * width)), rel=1e-6)


def test_ranges_below_levels_have_exact_edges() -> None:
    curve_minima = Minima.find(np.cos, HZ * np.linspace(0.01, 2.0, 200), level=0.5)
    expected = [(1 / 6, 5 / 6), (7 / 6, 11 / 6)]
    np.testing.assert_allclose(curve_minima.below, np.array(expected), rtol=1e-6)
    minima = Minima.find(np.sin, HZ * np.linspace(0.6, 1.3, 200), level=0.0)
    np.testing.assert_allclose(minima.below, [(0.6, 1.0)], rtol=1e-6)
    ended = Minima.find(np.sin, HZ * np.linspace(0.1, 0.9, 200), level=0.0)
    np.testing.assert_allclose(ended.below, [(0.5, 0.9)], rtol=1e-6)


def test_deviations_within_tolerance_are_not_below() -> None:
    def shallow(w: Array) -> Array:
        return np.full(len(w), -1e-9)

    w = build_frequency_grid(0.1, 1.0, 0.0)
    assert not Minima.find(shallow, w, tolerance=lambda at: np.full(len(at), 1e-8)).below
    assert Minima.find(shallow, w).below


def test_bands_too_wide_are_followed_partly() -> None:
    assert find_resolved_hz(1e-3, 100.0, 0.2) == 100.0
    assert find_resolved_hz(1e-3, 100.0, 1.6) == 100.0
    assert find_resolved_hz(1e-3, 1000.0, 1.6) == pytest.approx(1.3, rel=0.05)


def test_flat_and_rising_curves_have_no_dip() -> None:
    w = build_frequency_grid(0.1, 1.0, 0.0)
    assert Minima.find(lambda at: np.asarray(at), w).least == w[0]
    assert not Minima.find(lambda at: np.asarray(at), w).below


def test_a_sharp_resonance_is_resolved() -> None:
    """Quality 1000: the peak is a thousandth wide, the grid's steps are sixty times wider."""
    network = Network((1.0,), (1e-3,), (1.0,))
    Y = build_admittance(network.loop)
    w, _ = refine_response(Y, build_frequency_grid(1e-2, 10.0, 0.0))
    assert np.abs(Y(w)).max() == pytest.approx(1000.0, rel=0.01)
    size = np.abs(Y(w))[:, 0, 0]
    assert (np.abs(np.diff(Y(w)[:, 0, 0])) <= 0.1 * np.maximum(size[1:], size[:-1])).all()


def test_an_undamped_resonance_ends_the_refinement() -> None:
    Y = build_admittance(Network((1.0,), (0.0,), (1.0,)).loop)
    w, _ = refine_response(Y, build_frequency_grid(1e-2, 10.0, 0.0))
    assert np.isfinite(Y(w)).all()
    assert len(w) < 6000


def test_remembered_answers_are_asked_once() -> None:
    questions: list[int] = []
    Y = build_admittance(make_pair().loop)

    def counted(w: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.complex128]]:
        questions.append(len(w))
        return Y(w)

    grid = build_frequency_grid(0.1, 1.0, 0.2)
    w, remembered = refine_response(counted, grid)
    assert sum(questions) == len(w) > len(grid)
    np.testing.assert_array_equal(remembered(w), Y(w))
    np.testing.assert_array_equal(remembered(w[:3]), Y(w[:3]))
    assert sum(questions) == len(w) + 3
