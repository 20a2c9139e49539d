"""The state of a compiled run as one vector of numbers: to copy it, and to go a part of the way to another.

Invariant: between two states only floating-point numbers are mixed; counters, times and modes are those of
one of them, and numbers that are equal in both stay as they are, bit for bit.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.vectors import Array

AnyArray = NDArray[np.generic]


def _float_words(dtype: np.dtype[np.generic]) -> NDArray[np.bool_]:
    """Returns which words of eight bytes of an array's element are floating-point numbers."""
    if dtype.fields is None:
        base = dtype.base if dtype.subdtype is None else dtype.subdtype[0]
        return np.full(max(1, dtype.itemsize // 8), base.kind == "f")
    words = np.zeros(dtype.itemsize // 8, dtype=bool)
    for field, offset, *_ in dtype.fields.values():
        words[offset // 8 : (offset + field.itemsize) // 8] = _float_words(field)
    return words


class RunState:
    """The arrays that a run changes, all of words of eight bytes; they stay where they are."""

    def __init__(self, arrays: Sequence[AnyArray]) -> None:
        self._words: list[NDArray[np.int64]] = []
        self._floats: list[NDArray[np.bool_]] = []
        for array in arrays:
            if array.size:
                flat = array.reshape(-1).view(np.int64)
                assert np.shares_memory(flat, array)  # a copy would not be the run's
                self._words.append(flat)
                self._floats.append(np.tile(_float_words(array.dtype), array.size))

    def approach(self, other: "RunState", factor: float) -> None:
        """Becomes another state of the same run plus so much of the difference to it; 0: its very bits."""
        for own, its, floats in zip(self._words, other._words, self._floats, strict=True):
            if factor == 0.0:
                own[:] = its
                continue
            changed = np.flatnonzero((own != its) & floats)
            x, y = own.view(np.float64)[changed], its.view(np.float64)[changed]
            mixed: Array = y + factor * (x - y)
            own[:] = its
            own.view(np.float64)[changed] = np.where(np.isfinite(mixed), mixed, y)
