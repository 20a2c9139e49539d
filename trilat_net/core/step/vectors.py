"""Defines the types of vectors and arrays that compiled functions use.

A compiled function must not allocate memory for its results, because this would take longer
than the computation itself. Short vectors are therefore tuples of floats, which stay in the
registers of the processor.

Invariant:
    - A compiled function accesses a vector argument only by index. The argument may therefore
      be a tuple or an array.
    - A compiled function returns a vector as a tuple. The functions `put_pair` and `put_five`
      copy a tuple to an array, and `put` copies an array.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .jit import leaf

Pair = tuple[float, float]
"""One value per joint, or per axis of the plane."""
Five = tuple[float, float, float, float, float]
"""One value per parameter."""
Vector = Sequence[float] | Any
"""A vector that is accessed by index: a tuple, or a row of an array."""


@leaf
def read_pair(a: Vector) -> Pair:
    """Returns the first two elements of an array as a tuple.

    Compiled code keeps a tuple in registers, whereas a new array would allocate memory in the
    control loop.
    """
    return a[0], a[1]


@leaf
def read_five(a: Vector) -> Five:
    """Returns the first five elements of an array as a tuple.

    Compiled code keeps a tuple in registers, whereas a new array would allocate memory in the
    control loop.
    """
    return a[0], a[1], a[2], a[3], a[4]


@leaf
def put(a: Any, values: Any) -> None:
    """Copies values into an array, element by element, without allocating memory.

    Args:
        a: Array to overwrite.
        values: At least as many values as `a` has elements.
    """
    for i in range(a.shape[0]):
        a[i] = values[i]


# No loop is used: indexing a tuple by a loop variable would compile to branches.
@leaf
def put_pair(a: Any, values: Pair) -> None:
    """Overwrites an array of length 2 without allocating memory."""
    a[0] = values[0]
    a[1] = values[1]


@leaf
def put_five(a: Any, values: Five) -> None:
    """Overwrites an array of length 5 without allocating memory."""
    a[0] = values[0]
    a[1] = values[1]
    a[2] = values[2]
    a[3] = values[3]
    a[4] = values[4]


@leaf
def choose(condition: bool, if_true: float, if_false: float) -> float:
    """Returns one of two values, without a branch in the compiled code.

    Both values are always computed. Unlike `if`, `choose` can also be compiled for several
    simulations side by side (SIMD), each of which may need a different choice. See
    `core/lanes`.

    Args:
        condition: The condition.
        if_true: Result if the condition is true.
        if_false: Result if the condition is false.
    """
    return if_true if condition else if_false


@leaf
def holds_anywhere(condition: bool) -> bool:
    """Returns True if a condition holds, or if it holds in any of several simulations.

    Code that is compiled for several simulations side by side may skip an operation only if
    none of them needs it; see `choose`.
    """
    return condition


@leaf
def round_down(number: float) -> float:
    """Rounds a number down to the nearest integer, returned as a float: -2.0 for -1.5."""
    return float(np.floor(number))


@leaf
def whole(number: float) -> int:
    """Converts a float without a fractional part to an integer: 3 for 3.0."""
    return int(number)


@leaf
def count_started(table: Any, first: int, count: int, now: float) -> int:
    """Counts the rows of a time-sorted table that start at or before a given time.

    The count is used, for example, to find the row of a recorded torque that applies now. The
    first column contains the times, and the count is found by bisection.

    Args:
        table: The table.
        first: Index of the first row to search. Earlier rows of the table are ignored.
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
"""Row of a structured array without named fields; `row_fields` has types for most rows."""

Points = NDArray[np.int64]
"""A table of pairs, shape (n, 2), for traces followed by outages.

A point of a trace consists of the time since the first point, us, and the delay, us, which is
-1 if the sample is lost. An outage consists of its first stamp and its end, ns.
"""

RowArray = NDArray[np.void]
IntArray = NDArray[np.int64]
