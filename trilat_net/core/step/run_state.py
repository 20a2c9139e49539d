"""Defines the state of a simulated run, which can be copied to another run.

The growth of a small difference between two runs of the same scenario shows whether the runs
are stable.

Invariant:
    - Numbers that are equal in both runs do not change.
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

    N is the number of sites (processes that run one arm), and P the largest number of peers
    (other sites) from which a site receives samples (sent states).

    Attributes:
        tables: Arrays of all sites.
        progress: Progress of each site, shape (N,), see `ProgressRow`.
        next_samples: Next sample to accept, for each site and peer, shape (N, P).
        sent: Latest records (results of control periods) of the sites.
        peaks: Peaks in intervals of 50 ms, see `run_until`.
        sums: Sums over the records, shape (N,), see `SumsRow`.
        settled_rad: Position error below which an arm counts as settled, rad.
        laws: Gains and memory of compiled laws that are not part of the kernel. None if no site
            has such a law.
        compiled_laws: The compiled laws themselves, by the index of their site.
        has_plain_law: True if a site has a law in plain Python.
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

    With this object, the state of a run can be copied to another run, or moved closer to that
    of another run. The views share the memory of the run, so a change of the object changes the
    run. Integers are used because equal integers mean equal bits.

    Args:
        arrays: The arrays that contain the state. Their memory is shared, not copied.
    """

    def __init__(self, arrays: Sequence[NDArray[np.generic]]) -> None:
        self._bits: list[NDArray[np.int64]] = []
        self._floats: list[NDArray[np.bool_]] = []
        for array in arrays:
            if not array.size:
                continue
            flat = array.reshape(-1).view(np.int64)
            # If `reshape` had made a copy, changes would not reach the run.
            assert np.shares_memory(flat, array)
            self._bits.append(flat)
            self._floats.append(np.tile(self.mark_floats(array.dtype), array.size))

    def scale_difference(self, other: "RunState", factor: float) -> None:
        """Multiplies the difference between this state and another state by a factor.

        Every floating-point number x of this state becomes x_other + factor (x - x_other). With
        the factor 0, this state becomes an exact copy of the other state. Integers, and results
        that would not be finite, are copied from the other state.

        Args:
            other: State of another run of the same scenario. It does not change.
            factor: Number by which the difference is multiplied. It has no unit.
        """
        arrays = zip(self._bits, other._bits, self._floats, strict=True)
        for bits, other_bits, is_float in arrays:
            if factor == 0.0:
                bits[:] = other_bits
                continue

            # Only numbers that differ are computed. Rounding would change the others.
            changed = np.flatnonzero((bits != other_bits) & is_float)
            x = bits.view(np.float64)[changed]
            y = other_bits.view(np.float64)[changed]
            bits[:] = other_bits
            bits.view(np.float64)[changed] = self.scale_differences(x, y, factor)

    @staticmethod
    def mark_floats(dtype: np.dtype[np.generic]) -> NDArray[np.bool_]:
        """Marks which of the 8-byte numbers in an element of an array are floats.

        For a structured type with the fields x (two float64) and count (int64), the result is
        [True, True, False]. A small disturbance of a run scales only the floats
        (`scale_differences`). The size of every field of the kernel is a multiple of eight
        bytes.

        Args:
            dtype: Data type of the element. It may have fields, which may have fields
                themselves.
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

        With a factor below 1, for example, the first state moves closer to the second.

        Args:
            x: Numbers of a run.
            y: The same numbers of another run. They replace results that would not be finite.
            factor: The factor.
        """
        mixed: Array = y + factor * (x - y)
        return np.where(np.isfinite(mixed), mixed, y)
