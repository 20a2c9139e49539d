"""Roots against closed forms, and against the number of turns of det Delta, which misses no root."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import lambertw

from tests.theory.loops import compute_residual, make_loop, roots_within
from trilat_net.analysis.theory import characteristic_roots
from trilat_net.analysis.theory.characteristic_roots import ChebyshevGrid, Spectrum


@pytest.mark.parametrize("E", [None, np.array([1.0, 0.0])])
def test_guesses_beyond_exps_range_are_dropped(E: np.ndarray | None) -> None:
    """exp(-s T) of a root far to the left is no number; the root near -1 /s is found all the same."""
    A = np.array([[-1.0, 0.0], [1.0, -2.0]])
    late = np.array([[[0.0, 0.0], [1e-3, 0.0]]])
    pencil = characteristic_roots.Pencil(A, np.array([0.5]), late, E)
    with np.errstate(all="ignore"):
        roots, dropped = pencil.refine_roots(np.array([-1.1 + 0j, -1e4 + 0j]), "ab", 4)
    assert dropped == 1
    assert roots[0].s == pytest.approx(-1.0, abs=1e-6)


@given(a=st.floats(-3, 3).filter(lambda a: abs(a) > 0.05), T=st.floats(0.02, 3))
def test_one_delay_gives_lamberts_function(a: float, T: float) -> None:
    """x' = -a x(t - T) has the roots W_k(-a T) / T."""
    roots = Spectrum.of_loop(make_loop(0.0, (T, -a)), 3).roots
    exact = np.array([lambertw(-a * T, k) / T for k in range(-6, 7)])
    exact = exact[exact.imag >= -1e-9]
    exact = exact[np.argsort(-exact.real)]
    assert len(roots) == 3
    # two roots meet: they are known to the root of rounding only
    if abs(a * T - 1 / math.e) < 1e-3:
        return
    for root, wanted in zip(roots, exact, strict=False):
        assert abs(root.s - wanted) <= 1e-9 * (1 + abs(wanted))


def test_the_textbook_case() -> None:
    """x' = -x(t - 1): the omega constant's neighbour, -0.3181 + 1.3372 j."""
    (root,) = Spectrum.of_loop(make_loop(0.0, (1.0, -1.0)), 1).roots
    assert root.s == pytest.approx(-0.31813150520476 + 1.33723570143069j, abs=1e-12)


@given(a=st.floats(0.1, 0.9))
def test_two_delays_with_a_root_on_the_axis(a: float) -> None:
    """x' = -a x(t - pi/2) - (1 - a) x(t - 5 pi/2) has the root j, since both terms turn by a quarter."""
    spectrum = Spectrum.of_loop(make_loop(0.0, (math.pi / 2, -a), (5 * math.pi / 2, a - 1)), 8)
    assert min(abs(root.s - 1j) for root in spectrum.roots) <= 1e-9


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25)
def test_no_root_is_missed(seed: int) -> None:
    """The count equals the zeros of det Delta to the right of the last requested root."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    delays = np.sort(rng.uniform(0.05, 1.5, 2))
    system = make_loop(
        rng.normal(size=(n, n)), *((float(T), rng.normal(size=(n, n))) for T in delays)
    )
    spectrum = Spectrum.of_loop(system, 5)
    assert all(compute_residual(system, root.s) <= 1e-12 for root in spectrum.roots)
    reals = [root.s.real for root in spectrum.roots]
    assert reals == sorted(reals, reverse=True)
    for after, before in zip(spectrum.roots[1:], spectrum.roots, strict=False):
        gap = before.s.real - after.s.real
        if gap > 0.05:
            left = before.s.real - 0.5 * gap
            right = [root for root in spectrum.roots if root.s.real > left]
            count = sum(root.multiplicity * (2 if root.s.imag else 1) for root in right)
            far = sum(
                np.linalg.norm(d.A) * math.exp(max(0.0, -left) * d.delay_s)
                for d in system.delayed
            )
            size = 1.0 + np.linalg.norm(system.A) + far
            assert (
                roots_within(system, complex(left, -size), complex(size, size), 6000) == count
            )


def test_several_modes_sharing_a_root_count_once() -> None:
    system = make_loop(-np.eye(3), (0.5, -2.0 * np.eye(3)))
    (root,) = Spectrum.of_loop(system, 1).roots
    assert root.multiplicity == 3


def test_roots_at_zero_are_never_the_rightmost() -> None:
    """Two masses that agree on any place, one estimate that nothing moves, and one that moves nothing."""
    A = np.zeros((4, 4))
    A[0, 0] = A[1, 1] = -1.0
    A[3, 0] = 1.0
    late = np.zeros((4, 4))
    late[0, 1] = late[1, 0] = 1.0
    spectrum = Spectrum.of_loop(make_loop(A, (0.3, late)), 3)
    assert (spectrum.zeros, spectrum.drifting) == (3, 0)
    assert spectrum.rightmost is not None
    assert spectrum.rightmost.s.real < -0.1
    assert spectrum.verdict == "stable"


def test_an_unheld_mass_drifts() -> None:
    spectrum = Spectrum.of_loop(make_loop([[0.0, 1.0], [0.0, 0.0]]), 1)
    assert (spectrum.zeros, spectrum.roots) == (2, ())
    chain = np.zeros((3, 3))
    chain[0, 1] = chain[2, 0] = 1.0
    chain[2, 2] = -1.0
    chain[1, 1] = -1.0
    late = np.zeros((3, 3))
    late[1, 1] = 1.0
    held = Spectrum.of_loop(make_loop(chain, (0.2, late)), 1)
    assert (held.zeros, held.drifting, held.verdict) == (2, 1, "at the edge")


@given(order=st.integers(3, 30), at=st.floats(-1, 1))
def test_polynomials_are_differentiated_and_interpolated_exactly(order: int, at: float) -> None:
    grid = ChebyshevGrid(order)
    nodes = grid.nodes
    assert grid.build_differentiation() @ nodes**3 == pytest.approx(3 * nodes**2, abs=1e-10)
    assert grid.build_interpolation(np.array([at])) @ nodes**3 == pytest.approx(
        at**3, abs=1e-12
    )
