"""The dominance matrix and beta, Eq. (6), (7), (20)."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from trilat_net.core.links.dominance import DominanceMatrix
from trilat_net.scenario.dominance_rows import find_row_problem

Array = NDArray[np.float64]
SMALLEST = 1e-6


@st.composite
def draw_matrix(draw: st.DrawFn, zeros: bool = True) -> Array:
    """Rows that sum to one, zero diagonal, other entries zero or at least 1e-6."""
    size = draw(st.integers(2, 6))
    share = st.one_of(st.floats(-6, 0).map(lambda x: 10**x), *([st.just(0.0)] if zeros else []))
    a = np.array(
        draw(
            st.lists(
                st.lists(share, min_size=size, max_size=size), min_size=size, max_size=size
            )
        )
    )
    np.fill_diagonal(a, 0.0)
    assume((a.sum(1) > 0).all())
    a /= a.sum(1, keepdims=True)
    assume(((a == 0) | (a >= SMALLEST)).all())
    return a


def strongly_connected(a: Array) -> bool:
    """Walks from the first site along the edges and against them."""

    def reached(edges: Array) -> set[int]:
        visited = {0}
        new = [0]
        while new:
            new = [
                j
                for i in new
                for j in np.flatnonzero(edges[i])
                if j not in visited and not visited.add(j)
            ]
        return visited

    return len(reached(a)) == len(reached(a.T)) == len(a)


@given(a=draw_matrix())
def test_beta_is_the_positive_left_null_vector(a: Array) -> None:
    """beta'Upsilon = 0 after Eq. (20), to 1e-12 of each entry, and every entry is positive."""
    assume(strongly_connected(a))
    beta = DominanceMatrix(a).find_beta()
    assert (beta > 0).all()
    assert beta.sum() == pytest.approx(1.0, abs=1e-14)
    assert beta @ a == pytest.approx(beta, rel=1e-12, abs=0.0)


@given(a=draw_matrix())
def test_irreducible_matrices_have_strongly_connected_graphs(a: Array) -> None:
    assert DominanceMatrix(a).is_irreducible == strongly_connected(a)


@given(a=draw_matrix(zeros=False), closed=st.integers(2, 5))
def test_a_reducible_matrix_has_no_beta(a: Array, closed: int) -> None:
    """The first sites follow each other alone: all other sites have no weight."""
    assume(closed < len(a))
    a[:closed, closed:] = 0.0
    a[:closed] /= a[:closed].sum(1, keepdims=True)
    assert not DominanceMatrix(a).is_irreducible
    with pytest.raises(ValueError, match="reducible"):
        DominanceMatrix(a).find_beta()


@given(a=draw_matrix(), off=st.floats(-0.5, 0.5), own=st.integers(0, 1))
def test_rows_sum_to_one_within_1e_9(a: Array, off: float, own: int) -> None:
    """Eq. (7)."""
    row = a[own].copy()
    entry = int(np.argmax(row))
    row[entry] += off
    assume(0 <= row[entry] <= 1)
    fault = find_row_problem(row, own)
    assume(abs(abs(row.sum() - 1) - 1e-9) > 1e-15)
    assert (fault is not None) == (abs(row.sum() - 1.0) > 1e-9)


@pytest.mark.parametrize(
    ("row", "own", "phrase"),
    [
        ([0.2, 0.8, 0.0], 0, "does not follow itself"),
        ([0.0, 1.5, -0.5], 0, "between 0 and 1"),
        ([0.0, 0.5, 0.4], 0, "sum to 1"),
        ([0.0, np.nan, 0.5], 0, "finite"),
        ([0.0, np.inf, 0.5], 0, "finite"),
    ],
)
def test_an_invalid_row_gives_the_reason(row: list[float], own: int, phrase: str) -> None:
    fault = find_row_problem(np.array(row), own)
    assert fault is not None
    assert phrase in fault
