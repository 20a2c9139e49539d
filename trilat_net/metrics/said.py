"""A number that was measured, or the reason why there is none.

Law: what a log cannot tell is null and says why; a number is finite, always.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Said(NamedTuple):
    """A number, or why there is none.

    Attributes:
        value: the number, finite; None where there is none.
        why: why there is none, in words; "" where there is one.
        applies: False where there could be none, in whatever log of this experiment: then nothing is unknown.
    """

    value: float | None
    why: str = ""
    applies: bool = True


Facts = dict[str, Said]
"""What was found, by the key of its quantity."""


def said(value: float | None, why: str = "it is no finite number") -> Said:
    """Returns a number as it is said; with the reason where there is none."""
    if value is None or not math.isfinite(value):
        return Said(None, why)
    return Said(float(value))


def unsaid(keys: Iterable[str], why: str, *, applies: bool = True) -> Facts:
    """Returns that none of these is known, and why; or that there are none to know."""
    return {key: Said(None, why, applies) for key in keys}


def rms(values: ArrayLike) -> float:
    """Returns the root mean square over rows of the column where it is largest; NaN of no rows.

    Args:
        values: shape (K, n).
    """
    array = np.asarray(values, dtype=np.float64)
    if not array.size:
        return math.nan
    return float(np.sqrt(np.einsum("kj,kj->j", array, array) / len(array)).max())


def peak(values: ArrayLike) -> float:
    """Returns the largest absolute value; NaN of none."""
    array = np.asarray(values, dtype=np.float64)
    return float(np.abs(array).max()) if array.size else math.nan
