"""Min-max decimation of columns over time, for plotting.

Invariant: every bucket keeps the minimum and the maximum of every column, so a spike of one tick at 1 kHz
stays visible; a row of NaN stands in every gap wider than a bucket.
"""

from typing import NamedTuple

import numpy as np

from ..core.vectors import Array
from ..log.record_columns import Ints


class DecimatedTrace(NamedTuple):
    """C columns over P ticks, ready to be drawn; a row of NaN stands in every gap that can be seen."""

    tick: Ints
    t_s: Array
    values: Array


def extreme_rows(values: Array, buckets: int) -> Ints:
    """Returns the rows to keep, ascending: the first, the last, and each bucket's extremes per column.

    Buckets are equal runs of rows. NaN is no extreme, but a bucket of nothing else keeps one.
    """
    rows, columns = values.shape
    if rows <= 2 * buckets or not columns:
        return np.arange(rows)
    size = -(-rows // buckets)
    # the last bucket is filled up with its last row, which changes no extreme
    index = np.minimum(np.arange(-(-rows // size) * size), rows - 1).reshape(-1, size)
    keep = [np.array([0, rows - 1])]
    for column in range(columns):
        block = values[index, column]
        absent = np.isnan(block)
        lowest = np.where(absent, np.inf, block).argmin(1)
        highest = np.where(absent, -np.inf, block).argmax(1)
        bucket = np.arange(len(index))
        keep += [index[bucket, lowest], index[bucket, highest]]
    return np.unique(np.concatenate(keep))


def decimate(tick: Ints, t_s: Array, values: Array, buckets: int) -> DecimatedTrace:
    """Returns a trace with at most 2 C + 3 points per bucket; one bucket per pixel is enough.

    Ticks ascend and have nominal times, shape (K,), s; values have shape (K, C).
    """
    if not len(tick):
        return DecimatedTrace(tick, t_s, values)
    # a gap narrower than a bucket is narrower than a pixel, and there may be thousands of those
    widest = max(1.0, (tick[-1] - tick[0]) / buckets)
    before = np.flatnonzero(np.diff(tick) > widest)
    keep = np.union1d(extreme_rows(values, buckets), np.concatenate([before, before + 1]))
    after = np.searchsorted(keep, before) + 1
    step_s = (t_s[before + 1] - t_s[before]) / (tick[before + 1] - tick[before]) if len(before) else t_s[:0]
    return DecimatedTrace(
        np.insert(tick[keep], after, tick[before] + 1),
        np.insert(t_s[keep], after, t_s[before] + step_s),
        np.insert(values[keep], after, np.nan, axis=0),
    )
