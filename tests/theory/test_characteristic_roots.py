"""Threads of the linear algebra: as they were, and no number changed."""

import numpy as np
import pytest

from trilat_net.theory import characteristic_roots
from trilat_net.theory.characteristic_roots import limit_blas_threads


def test_the_number_of_threads_is_put_back_whatever_happens() -> None:
    found = characteristic_roots._find_blas_functions()
    if found is None:
        pytest.skip("this NumPy has no OpenBLAS that can be asked")
    get, _ = found
    before = get()
    with limit_blas_threads():
        assert get() == 1
    assert get() == before
    with pytest.raises(ValueError, match="within"), limit_blas_threads():
        raise ValueError("within")
    assert get() == before


def test_where_nobody_can_be_asked_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(characteristic_roots, "_find_blas_functions", lambda: None)
    with limit_blas_threads():
        assert np.linalg.eigvals(np.eye(2)).tolist() == [1.0, 1.0]


@pytest.mark.parametrize("E", [None, np.array([1.0, 0.0])])
def test_a_guess_beyond_the_range_of_exp_is_dropped(E: np.ndarray | None) -> None:
    """exp(-s T) of a root far to the left is no number; the root near -1 /s is found all the same."""
    A, late = np.array([[-1.0, 0.0], [1.0, -2.0]]), np.array([[[0.0, 0.0], [1e-3, 0.0]]])
    pencil = characteristic_roots.Pencil(A, np.array([0.5]), late, E)
    with np.errstate(all="ignore"):
        roots, dropped = characteristic_roots.refine_roots(pencil, np.array([-1.1 + 0j, -1e4 + 0j]), "ab", 4)
    assert dropped == 1
    assert roots[0].s == pytest.approx(-1.0, abs=1e-6)
