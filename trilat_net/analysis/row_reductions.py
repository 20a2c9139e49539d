"""Computes sums, maxima and truth tests over the few entries in each row of a long array.

The records of a run are arrays with tens of thousands of rows and one column per joint. NumPy
reduces each row of such an array in a separate loop, which takes about ten times as long as
combining entire columns.

Invariant:
    - The results are bitwise equal to those of NumPy's reductions along the last axis.
"""

import numpy as np
from numpy.typing import NDArray

from ..core import Array

_SEQUENTIAL_COLUMNS = 7
"""Largest number of columns that NumPy adds one after the other. NumPy adds more columns in
pairs.
"""


def sum_rows(values: Array) -> Array:
    """Returns the sum of each row of an array, shape (K,).

    Args:
        values: The array, shape (K, n).
    """
    columns = values.shape[1]
    if not 1 <= columns <= _SEQUENTIAL_COLUMNS:
        sums: Array = values.sum(axis=1)
        return sums
    total = values[:, 0].copy()
    for column in range(1, columns):
        total += values[:, column]
    return total


def max_rows(values: Array) -> Array:
    """Returns the maximum of each row of an array, shape (K,). NaN makes the result NaN.

    Args:
        values: The array, shape (K, n), with at least one column.
    """
    largest = values[:, 0].copy()
    for column in range(1, values.shape[1]):
        np.maximum(largest, values[:, column], out=largest)
    return largest


def any_in_rows(values: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Returns True for each row of an array that contains any entry that is true or nonzero.

    Args:
        values: Numeric or boolean array, shape (K, n).
    """
    is_any = np.zeros(len(values), dtype=np.bool_)
    for column in range(values.shape[1]):
        is_any |= values[:, column].astype(np.bool_)
    return is_any
