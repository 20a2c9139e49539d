"""Vectors of fixed length as tuples: in registers while a tick is computed, in tables between ticks.

Law: a leaf takes vectors (tuples or rows of arrays, by index) and returns tuples; it writes nothing.
"""

from collections.abc import Sequence
from typing import Any

from .jit import leaf

Pair = tuple[float, float]
"""One number per joint, or per axis of the plane."""
Five = tuple[float, float, float, float, float]
"""One number per parameter."""
Vector = Sequence[float] | Any
"""What is read by index: a tuple, or a row of an array."""


@leaf
def pair(a: Vector) -> Pair:
    """Returns the two numbers of a row."""
    return a[0], a[1]


@leaf
def five(a: Vector) -> Five:
    """Returns the five numbers of a row."""
    return a[0], a[1], a[2], a[3], a[4]


@leaf
def put_pair(a: Any, values: Pair) -> None:
    """Writes two numbers into a row."""
    a[0], a[1] = values


@leaf
def put_five(a: Any, values: Five) -> None:
    """Writes five numbers into a row."""
    a[0], a[1], a[2], a[3], a[4] = values
