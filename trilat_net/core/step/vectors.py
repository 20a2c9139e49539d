"""Defines the types of vectors and arrays that compiled functions use.

A compiled function must not allocate memory for its results, because this takes longer than the
computation. Therefore short vectors are tuples of numbers, which stay in the registers of the
processor.

Invariant:
    - A compiled function reads a vector only by index. Therefore its argument may be a tuple or
      an array.
    - A compiled function returns a vector as a tuple. The functions `put_pair` and `put_five`
      copy a tuple into an array, and `put` copies an array.
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
    """Returns the two numbers of an array as a tuple.

    Compiled code handles a tuple without allocating memory.
    """
    return a[0], a[1]


@leaf
def five(a: Vector) -> Five:
    """Returns the five numbers of an array as a tuple.

    Compiled code handles a tuple without allocating memory.
    """
    return a[0], a[1], a[2], a[3], a[4]


@leaf
def put(a: Any, values: Any) -> None:
    """Copies numbers into an array, one by one, because compiled code must not allocate memory.

    Args:
        a: The array, which is changed.
        values: At least as many numbers as `a` has entries.
    """
    for i in range(a.shape[0]):
        a[i] = values[i]


# A tuple is not indexed by the variable of a loop: the compiled code would branch on it.
@leaf
def put_pair(a: Any, values: Pair) -> None:
    """Copies two numbers into an array, whose length is 2."""
    a[0] = values[0]
    a[1] = values[1]


@leaf
def put_five(a: Any, values: Five) -> None:
    """Copies five numbers into an array, whose length is 5."""
    a[0] = values[0]
    a[1] = values[1]
    a[2] = values[2]
    a[3] = values[3]
    a[4] = values[4]


@leaf
def choose(condition: bool, if_true: float, if_false: float) -> float:
    """Returns one of two numbers, without a branch in the compiled code.

    Both numbers are computed. Functions with `choose` in place of `if` can also be compiled for
    the numbers of several runs side by side, see `execution/lanes`.

    Args:
        condition: The condition.
        if_true: Result if the condition is true.
        if_false: Result if the condition is false.
    """
    return if_true if condition else if_false


@leaf
def holds_anywhere(condition: bool) -> bool:
    """Returns the condition. With the numbers of several runs, it must hold in one of them.

    Compiled code may skip an operation if no run needs it, see `choose`.
    """
    return condition


@leaf
def round_down(number: float) -> float:
    """Returns the largest whole number that is not above a number."""
    return float(np.floor(number))


@leaf
def whole(number: float) -> int:
    """Returns a number without a fractional part as an integer."""
    return int(number)


@leaf
def count_started(table: Any, first: int, count: int, now: float) -> int:
    """Returns how many rows of a time table start at a given time or before.

    For example, this finds the row of a recorded torque that applies now. The rows are sorted
    by time, their first column, so that bisection finds the count.

    Args:
        table: The table.
        first: Index of the first row to search. Rows before it have another purpose.
        count: Number of rows to search.
        now: The time, in the unit of the first column.

    Returns:
        The count, from 0 to `count`.
    """
    low = first
    high = first + count
    while low < high:
        middle = (low + high) // 2
        if table[middle, 0] <= now:
            low = middle + 1
        else:
            high = middle
    return low - first


Array = NDArray[np.float64]

Row = Any
"""A row of a structured array without named fields; `row_fields` has types of most rows."""

Points = NDArray[np.int64]
"""A table of pairs, shape (n, 2), of traces and then of outages.

The points of a trace are the time since its first point, us, and the delay, us; -1: the sample
is lost. An outage is its first stamp and its end, ns.
"""

RowArray = NDArray[np.void]
IntArray = NDArray[np.int64]
