"""beta: the left null vector, scaled by Kd; groups of sites that follow nobody outside."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.analysis.dominance_history import (
    compute_lyapunov_weights,
    find_closed_groups,
    find_kd_scales,
    left_perron_vector,
)

EXPERT = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 0.5], [1.0, 0.0, 0.0]])
"""Sites 0 and 2 are locked to each other, 1 follows them."""
PAIRS = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]])
THREE = np.full((3, 3), 0.5) - 0.5 * np.eye(3)


@given(st.integers(2, 6), st.integers(0, 2**32 - 1))
def test_pi_is_the_eigenvector_that_numpy_finds(n: int, seed: int) -> None:
    alpha = np.random.default_rng(seed).random((n, n)) * (1.0 - np.eye(n))
    alpha /= alpha.sum(axis=1, keepdims=True)
    values, vectors = np.linalg.eig(alpha.T)
    expected = np.real(vectors[:, np.argmax(np.real(values))])
    assert left_perron_vector(alpha) == pytest.approx(expected / expected.sum(), abs=1e-9)


@given(st.lists(st.floats(0.01, 100.0), min_size=3, max_size=3))
def test_scaled_kd_cancels_what_sites_pass_on(scales: list[float]) -> None:
    """sum_i beta_i ( |x_i|^2_Kd_i - sum_j alpha_ij |x_j|^2_Kd_i ) = 0 for all x, Eq. (20)."""
    Kd = np.outer(scales, [3.0, 0.4])
    found = compute_lyapunov_weights(THREE, Kd)
    norms = np.random.default_rng(1).random((3, 2))
    passed = [Kd[i] @ (norms[i] - THREE[i] @ norms) for i in range(3)]
    assert found.beta @ passed == pytest.approx(0.0, abs=1e-9 * max(scales) * found.beta.max())
    assert found.beta.sum() == pytest.approx(3.0)


def test_equal_shares_and_kd_give_the_ones_of_the_paper() -> None:
    assert compute_lyapunov_weights(THREE, np.full((3, 2), 3.0)).beta == pytest.approx(np.ones(3))


def test_kd_of_different_shape_have_no_scalar() -> None:
    assert find_kd_scales(np.array([[0.1, 30.0], [30.0, 0.1], [3.0, 3.0]])) is None
    assert find_kd_scales(np.array([[1.0, 1.0], [0.0, 0.0]])) is None
    assert find_kd_scales(np.zeros((3, 2))) == pytest.approx(np.ones(3))


def test_a_site_that_nobody_follows_has_no_weight() -> None:
    found = compute_lyapunov_weights(EXPERT, np.ones((3, 2)))
    assert found.groups == ((0, 2),)
    assert found.beta == pytest.approx([1.5, 0.0, 1.5])


def test_two_groups_that_follow_nobody_outside_are_named() -> None:
    assert find_closed_groups(PAIRS) == ((0, 1), (2, 3))
