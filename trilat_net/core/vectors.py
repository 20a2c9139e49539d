"""Types of the core's numbers: arrays, rows of structured arrays, and vectors of fixed length
as tuples.

Invariant: a leaf takes vectors (tuples or rows of arrays, read by index) and returns tuples,
which stay in registers while a tick is computed; only `put` writes.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .jit import leaf

Pair = tuple[float, float]
"""One number per joint, or per axis of the plane."""
Five = tuple[float, float, float, float, float]
"""One number per parameter."""
Vector = Sequence[float] | Any
"""A vector to read by index: a tuple, or a row of an array."""


@leaf
def pair(a: Vector) -> Pair:
    """Returns the two numbers of a row."""
    return a[0], a[1]


@leaf
def five(a: Vector) -> Five:
    """Returns the five numbers of a row."""
    return a[0], a[1], a[2], a[3], a[4]


@leaf
def put(a: Any, values: Any) -> None:
    """Writes one row into another of the same length."""
    for i in range(a.shape[0]):
        a[i] = values[i]


@leaf
def count_started(table: Any, first: int, count: int, now: float) -> int:
    """Returns how many of so many rows, in the order of their times, begin at a time or before
    it.
    """
    low = first
    high = first + count
    while low < high:
        half = (low + high) // 2
        if table[half, 0] <= now:
            low = half + 1
        else:
            high = half
    return low - first


Array = NDArray[np.float64]

Row = Any
"""A row of a structured array; NumPy's types cannot name its fields."""

Points = NDArray[np.int64]
"""A table of pairs, shape (n, 2): traces (time since their first point and delay, us; a delay
of -1 is a sample lost) and outages (first and last stamp, ns), one after the other.
"""

RowArray = NDArray[np.void]
IntArray = NDArray[np.int64]
