"""Provides a site's signals as columns over its records, and its settling time.

For plots, columns are decimated: every bucket keeps the minimum and the maximum of every
column, so that a spike of one tick at 1 kHz stays visible. A row of NaN stands in every gap
that is wider than a bucket.

Invariant:
    - Each signal has one definition, for figures, page, summary and metrics.
    - Torques of operators and environment are those ON the arm, the negative of the record's
      tau_x of Eq. (8).
    - Empty logs give empty columns.
"""

from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from ..core.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog

SETTLED_ERROR_RAD = 1e-2
"""A site has settled once no error of a joint (rad) or along an axis (m) exceeds this any
more.
"""


Signal = Callable[[SiteLog], Array]
"""A column over the K records of a site."""
joint_angles: Signal = attrgetter("q")
"""q, shape (K, n), rad."""
joint_errors: Signal = attrgetter("e")
"""e = q - q_des, Eq. (9), shape (K, n), rad."""
controller_torques: Signal = attrgetter("tau")
"""tau, Eq. (13), shape (K, n), N m."""
parameter_estimates: Signal = attrgetter("theta_hat")
"""theta_hat, Eq. (15), shape (K, P), kg m^2 and kg m: P = 5 for the planar arm, 10 n for a
chain.
"""


def reference_angles(part: SiteLog) -> Array:
    """Returns q_des, Eq. (6), shape (K, n), rad; q in task space, where joints have none."""
    return part.q if part.layout.task else part.q_des


def follows_in_task_space(log: Log) -> bool:
    """True if sites follow with their end effectors, so that errors are those along axes."""
    return any(arm.shares_pose for arm in log.scenario.arms.values())


def joint_error_rates(part: SiteLog) -> Array:
    """Returns qd - qd_des, Eq. (18), shape (K, n), rad/s.

    In task space xd - xd_des is returned, shape (K, m).
    """
    if part.layout.task:
        rates: Array = (part.xd - part.qd_des) * np.array(part.axes)
        return rates
    return part.qd - part.qd_des


def shared_unit(log: Log) -> str:
    """Returns the unit of the shared coordinates and their errors: "rad", "m" or "m, rad"."""
    space = log.scenario.sites[log.sites[0]].task.space
    return {"joints": "rad", "position": "m"}.get(space, "m, rad")


def external_torques(part: SiteLog) -> Array:
    """Returns the torque of operator and environment ON the arm, shape (K, n), N m.

    It is the negative of tau_x.
    """
    return 0.0 - part.tau_x  # 0 - 0 is 0, but -0 would be printed as -0


def sample_ages_ms(log: Log, site: str) -> Array:
    """Returns the age of the sample in use by peer, shape (K, N - 1), ms.

    Ages before a peer's first sample are NaN.
    """
    part = log[site]
    columns = [part.age_s(peer, log.scenario.sites[peer].rate_hz) * 1e3 for peer in part.peers]
    return np.array(columns).reshape(len(part.peers), len(part)).T


def sites_with_operator(log: Log) -> list[str]:
    """Returns the sites with an operator, by the scenario or by the records."""
    specs = log.scenario.sites
    return [site for site in log.sites if specs[site].hands or np.any(log[site].tau_x)]


def largest_magnitude(values: Array) -> Array:
    """Returns the largest absolute value of each row, shape (K,)."""
    magnitude: Array = np.abs(values).max(axis=1, initial=0.0)
    return magnitude


def largest_remaining_error(part: SiteLog) -> Array:
    """Returns the largest error of any joint from each record to the last, shape (K,), rad."""
    largest = largest_magnitude(joint_errors(part))
    return np.maximum.accumulate(largest[::-1])[::-1]


def settling_time_s(part: SiteLog) -> float | None:
    """Returns the last time at which an error exceeded `SETTLED_ERROR_RAD`, in s.

    Returns 0 if no error ever exceeded it, and None if an error still does in the last record.
    """
    if not len(part):
        return None
    above = np.flatnonzero(largest_remaining_error(part) > SETTLED_ERROR_RAD)
    if not len(above):
        return 0.0
    last = above[-1]
    return None if last == len(part) - 1 else float(part.t_s[last])


def settling_time_of_all_s(times_s: Sequence[float | None]) -> float | None:
    """Returns the time at which the last site has settled, in s; None if some site has not."""
    settled_s = [time_s for time_s in times_s if time_s is not None]
    return max(settled_s) if len(settled_s) == len(times_s) else None


def operator_displacement(log: Log, twin: Log, site: str) -> tuple[Ints, Array, Array]:
    """Returns how far operators displaced a site, against a twin of the run without operators.

    Args:
        log: the log of the run.
        twin: the log of its twin.
        site: name of the site.

    Returns:
        The ticks that both logs have, shape (K,).
        Their times, shape (K,), s.
        q of the log minus q of the twin, shape (K, n), rad.
    """
    part = log[site]
    twin_part = twin[site]
    tick, rows, twin_rows = np.intersect1d(
        part.tick, twin_part.tick, assume_unique=True, return_indices=True
    )
    displacement = joint_angles(part)[rows] - joint_angles(twin_part)[twin_rows]
    return tick, part.t_s[rows], displacement


class DecimatedTrace(NamedTuple):
    """C columns over P ticks, ready to be drawn; a row of NaN stands in every visible gap.

    Attributes:
        tick: ticks, shape (P,).
        t_s: their times, shape (P,), s.
        values: the columns, shape (P, C).
    """

    tick: Ints
    t_s: Array
    values: Array


def extreme_rows(values: Array, buckets: int) -> Ints:
    """Returns the rows to keep: the first, the last, and each bucket's extremes per column.

    Buckets are equal runs of rows. NaN is no extreme, but a bucket of NaN alone keeps a row.

    Args:
        values: the columns, shape (K, C).
        buckets: number of buckets.
    """
    rows, columns = values.shape
    if rows <= 2 * buckets or not columns:
        return np.arange(rows)
    size = -(-rows // buckets)
    # the last bucket is filled up with its last row, which changes no extreme
    filled_rows = np.arange(-(-rows // size) * size)
    index = np.minimum(filled_rows, rows - 1).reshape(-1, size)
    bucket = np.arange(len(index))
    keep = [np.array([0, rows - 1])]
    for column in range(columns):
        block = values[index, column]
        missing = np.isnan(block)
        lowest = np.where(missing, np.inf, block).argmin(1)
        highest = np.where(missing, -np.inf, block).argmax(1)
        keep += [index[bucket, lowest], index[bucket, highest]]
    return np.unique(np.concatenate(keep))


def decimate(tick: Ints, t_s: Array, values: Array, buckets: int) -> DecimatedTrace:
    """Returns a trace with at most 2 C + 3 points per bucket; a bucket per pixel is enough.

    Args:
        tick: ascending ticks, shape (K,).
        t_s: their nominal times, shape (K,), s.
        values: the columns, shape (K, C).
        buckets: number of buckets.
    """
    if not len(tick):
        return DecimatedTrace(tick, t_s, values)
    # narrower gaps are narrower than a pixel, and there may be thousands of them
    bucket_ticks = max(1.0, (tick[-1] - tick[0]) / buckets)
    before_gap = np.flatnonzero(np.diff(tick) > bucket_ticks)
    after_gap = before_gap + 1
    keep = np.union1d(extreme_rows(values, buckets), np.concatenate([before_gap, after_gap]))
    inserted_at = np.searchsorted(keep, before_gap) + 1
    period_s = t_s[:0]
    if len(before_gap):
        gap_ticks = tick[after_gap] - tick[before_gap]
        period_s = (t_s[after_gap] - t_s[before_gap]) / gap_ticks
    return DecimatedTrace(
        tick=np.insert(tick[keep], inserted_at, tick[before_gap] + 1),
        t_s=np.insert(t_s[keep], inserted_at, t_s[before_gap] + period_s),
        values=np.insert(values[keep], inserted_at, np.nan, axis=0),
    )
