import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from trilat_net.theory.tick_map import discretise_zero_order_hold, matrix_exponential


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(1e-6, 60.0))
def test_it_is_the_exponential(seed: int, size: float) -> None:
    matrix = np.random.default_rng(seed).normal(size=(4, 4))
    matrix *= size / np.linalg.norm(matrix, 1)
    wanted = expm(matrix)
    assert np.abs(matrix_exponential(matrix) - wanted).max() <= 1e-12 * max(1.0, size) * np.abs(wanted).max()


def test_a_held_push_moves_a_mass_by_half_h_squared() -> None:
    Phi, Gamma = discretise_zero_order_hold(np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [2.0]]), 0.1)
    assert Phi == pytest.approx(np.array([[1.0, 0.1], [0.0, 1.0]]), abs=1e-15)
    assert Gamma == pytest.approx(np.array([[0.01], [0.2]]), abs=1e-15)
