"""Reductions of rows have the bits of NumPy's, for any number of columns and any memory order."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trilat_net.analysis.row_reductions import any_in_rows, max_rows, sum_rows

FLOATS = hnp.arrays(
    np.float64,
    st.tuples(st.integers(0, 40), st.integers(1, 12)),
    elements=st.floats(allow_nan=True, allow_infinity=True, width=64),
)


@given(FLOATS)
def test_sums_have_the_bits_of_numpy(values: np.ndarray) -> None:
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(sum_rows(values), values.sum(axis=1))


@pytest.mark.parametrize("columns", range(1, 30))
def test_sums_of_mixed_sizes_are_numpys(columns: int) -> None:
    random = np.random.default_rng(columns)
    values = random.standard_normal((5_000, columns)) * 10.0 ** random.integers(
        -9, 9, (5_000, columns)
    )
    np.testing.assert_array_equal(sum_rows(values), values.sum(axis=1))


@given(FLOATS)
def test_maxima_are_those_of_numpy(values: np.ndarray) -> None:
    np.testing.assert_array_equal(max_rows(values), values.max(axis=1))


@given(FLOATS)
def test_any_is_that_of_numpy(values: np.ndarray) -> None:
    np.testing.assert_array_equal(any_in_rows(values), values.any(axis=1))
    np.testing.assert_array_equal(any_in_rows(values > 0.0), (values > 0.0).any(axis=1))


def test_rows_without_columns_are_zero() -> None:
    assert sum_rows(np.zeros((3, 0))).tolist() == [0.0, 0.0, 0.0]
    assert any_in_rows(np.zeros((3, 0))).tolist() == [False, False, False]
