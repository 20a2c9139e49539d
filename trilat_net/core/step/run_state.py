"""Defines the state of a simulated run, which can be copied to another run.

How a small difference between two runs of the same scenario grows shows whether the runs are
stable.

Invariant:
    - Values that are equal in both runs stay equal when the difference is scaled.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..plug.compiled_law import CompiledLaw
from .fused_run import LawArrays, RecentRecords, ReplayedInputs
from .site_arrays import SiteArrays
from .vectors import Array, IntArray, RowArray


class RunMemory(NamedTuple):
    """All arrays of a simulated run, for modules that compute several runs side by side.

    N is the number of sites, and P the largest number of peers of any site.

    Attributes:
        tables: Arrays of all sites.
        progress: Progress of each site, shape (N,), see `ProgressRow`.
        next_samples: Next sample to accept, for each site and peer, shape (N, P).
        sent: Latest records of the sites.
        peaks: Peaks in intervals of 50 ms, see `run_until`.
        sums: Sums over the records, shape (N,), see `SumsRow`.
        settled_rad: Position error below which an arm counts as settled, rad.
        laws: Gains and memory of compiled laws that are not part of the kernel. None if no site
            has such a law.
        compiled_laws: The compiled laws themselves, keyed by site index.
        has_plain_law: True if any site has a law in plain Python.
        feed: Inputs of a recorded run.
    """

    tables: SiteArrays
    progress: RowArray
    next_samples: IntArray
    sent: RecentRecords
    peaks: Array
    sums: RowArray
    settled_rad: float
    laws: LawArrays | None
    compiled_laws: Mapping[int, CompiledLaw]
    has_plain_law: bool
    feed: ReplayedInputs


class RunState:
    """The complete state of a simulated run: all arrays that change, viewed as 64-bit integers.

    Used to copy the state of another run to this run, or to move the state of this run closer
    to that of another run. The views share memory with the run, so changing this object changes
    the run. Integer views are used because equal integers mean equal bits.

    Args:
        arrays: Arrays that contain the state. Their memory is shared, not copied.
    """

    def __init__(self, arrays: Sequence[NDArray[np.generic]]) -> None:
        self._bits: list[NDArray[np.int64]] = []
        self._floats: list[NDArray[np.bool_]] = []
        for array in arrays:
            if not array.size:
                continue
            flat = array.reshape(-1).view(np.int64)
            # If `reshape` had made a copy, changing the views would not change the run.
            assert np.shares_memory(flat, array)
            self._bits.append(flat)
            self._floats.append(np.tile(self.mark_floats(array.dtype), array.size))

    def scale_difference(self, other: "RunState", factor: float) -> None:
        """Multiplies the difference between this state and another state by a factor.

        Every floating-point value x of this state becomes x_other + factor (x - x_other). With
        a factor of 0, this state becomes an exact copy of the other. Integers, and results that
        would not be finite, are copied from the other state.

        Args:
            other: State of another run of the same scenario. It is not changed.
            factor: Dimensionless scale factor.
        """
        arrays = zip(self._bits, other._bits, self._floats, strict=True)
        for bits, other_bits, is_float in arrays:
            if factor == 0.0:
                bits[:] = other_bits
                continue

            # Only compute values that differ, because rounding would change the others.
            changed = np.flatnonzero((bits != other_bits) & is_float)
            x = bits.view(np.float64)[changed]
            y = other_bits.view(np.float64)[changed]
            bits[:] = other_bits
            bits.view(np.float64)[changed] = self.scale_differences(x, y, factor)

    @staticmethod
    def mark_floats(dtype: np.dtype[np.generic]) -> NDArray[np.bool_]:
        """Marks which 8-byte words in an array element are floats.

        For a structured type with the fields x (two float64) and count (int64), the result is
        [True, True, False]. Scaling a small perturbation of a run affects only the floats
        (`scale_differences`). The size of every kernel field is a multiple of eight bytes.

        Args:
            dtype: Data type of the element, which may have nested fields.
        """
        if dtype.fields is None:
            return np.full(max(1, dtype.itemsize // 8), dtype.base.kind == "f")
        is_float = np.zeros(dtype.itemsize // 8, dtype=bool)
        for field_dtype, offset, *_ in dtype.fields.values():
            start = offset // 8
            stop = (offset + field_dtype.itemsize) // 8
            is_float[start:stop] = RunState.mark_floats(field_dtype)
        return is_float

    @staticmethod
    def scale_differences(x: Array, y: Array, factor: float) -> Array:
        """Scales the difference between the states of two simulations: y + factor (x - y).

        A factor below 1 moves the first state closer to the second.

        Args:
            x: Values from one run.
            y: The same values from another run. They replace results that would not be finite.
            factor: Scale factor.
        """
        mixed: Array = y + factor * (x - y)
        return np.where(np.isfinite(mixed), mixed, y)
