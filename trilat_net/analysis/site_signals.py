"""Signals of a site as columns over its records, and its settling time; empty logs give empty
columns.

Invariant: one definition of each signal, for figures, page, summary and metrics. Torques of
operators and environment are those ON the arm, the negative of the record's tau_x of Eq. (8).

For plots columns are decimated: every bucket keeps the minimum and the maximum of every column,
so a spike of one tick at 1 kHz stays visible; a row of NaN stands in every gap wider than a
bucket.
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
"""A site has settled once no joint's error exceeds this any more, rad, or none along an axis,
m.
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
"""theta_hat, Eq. (15), shape (K, P); P = 5 of the planar arm, kg m^2 and kg m, 10 n of a chain.
"""


def reference_angles(part: SiteLog) -> Array:
    """Returns q_des, Eq. (6), shape (K, n), rad; in task space, where joints have none, q."""
    return part.q if part.layout.task else part.q_des


def follows_in_task_space(log: Log) -> bool:
    """True if sites follow with their end effectors: an axis has an error then, and no joint."""
    return any(arm.shares_pose for arm in log.scenario.arms.values())


def joint_error_rates(part: SiteLog) -> Array:
    """Returns qd - qd_des, Eq. (18), shape (K, n), rad/s; in task space xd - xd_des, shape (K,
    m).
    """
    return (
        (part.xd - part.qd_des) * np.array(part.axes)
        if part.layout.task
        else part.qd - part.qd_des
    )


def shared_unit(log: Log) -> str:
    """Returns the unit of what sites share and of their errors: "rad", "m", or of poses both."""
    return {"joints": "rad", "position": "m"}.get(
        log.scenario.sites[log.sites[0]].task.space, "m, rad"
    )


def external_torques(part: SiteLog) -> Array:
    """Returns the torque of operator and environment ON the arm, shape (K, n), N m: the
    negative of tau_x.
    """
    return 0.0 - part.tau_x  # 0 - 0 is 0, where -0 would print as such


def sample_ages_ms(log: Log, site: str) -> Array:
    """Returns the age of the sample in use per peer, shape (K, N - 1), ms; NaN before the
    first.
    """
    part = log[site]
    columns = [part.age_s(peer, log.scenario.sites[peer].rate_hz) * 1e3 for peer in part.peers]
    return np.array(columns).reshape(len(part.peers), len(part)).T


def sites_with_operator(log: Log) -> list[str]:
    """Returns the sites with an operator, by the scenario or by the records."""
    return [
        name for name in log.sites if log.scenario.sites[name].hands or np.any(log[name].tau_x)
    ]


def largest_magnitude(values: Array) -> Array:
    """Returns the largest absolute value of each row, shape (K,)."""
    found: Array = np.abs(values).max(axis=1, initial=0.0)
    return found


def largest_remaining_error(part: SiteLog) -> Array:
    """Returns the largest error of any joint from each record to the last, shape (K,), rad."""
    largest = largest_magnitude(joint_errors(part))
    return np.maximum.accumulate(largest[::-1])[::-1]


def settling_time_s(part: SiteLog) -> float | None:
    """Returns when an error last exceeded `SETTLED_ERROR_RAD`, s; 0 if none did, None if one
    still does.
    """
    if not len(part):
        return None
    above = np.flatnonzero(largest_remaining_error(part) > SETTLED_ERROR_RAD)
    if not len(above):
        return 0.0
    return None if above[-1] == len(part) - 1 else float(part.t_s[above[-1]])


def settling_time_of_all_s(times_s: Sequence[float | None]) -> float | None:
    """Returns when the last of some sites has settled, s; None if one has not."""
    settled = [at_s for at_s in times_s if at_s is not None]
    return max(settled) if len(settled) == len(times_s) else None


def operator_displacement(log: Log, twin: Log, site: str) -> tuple[Ints, Array, Array]:
    """Returns how far operators moved a site: q of the log minus q of its twin without them,
    (K, n), rad.

    Before it stand the ticks that both logs have, and their times, s.
    """
    part = log[site]
    other = twin[site]
    tick, ours, theirs = np.intersect1d(
        part.tick, other.tick, assume_unique=True, return_indices=True
    )
    return tick, part.t_s[ours], joint_angles(part)[ours] - joint_angles(other)[theirs]


class DecimatedTrace(NamedTuple):
    """C columns over P ticks, ready to be drawn; a row of NaN stands in every gap that can be
    seen.
    """

    tick: Ints
    t_s: Array
    values: Array


def extreme_rows(values: Array, buckets: int) -> Ints:
    """Returns the rows to keep, ascending: the first, the last, and each bucket's extremes per
    column.

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
    step_s = (
        (t_s[before + 1] - t_s[before]) / (tick[before + 1] - tick[before])
        if len(before)
        else t_s[:0]
    )
    return DecimatedTrace(
        np.insert(tick[keep], after, tick[before] + 1),
        np.insert(t_s[keep], after, t_s[before] + step_s),
        np.insert(values[keep], after, np.nan, axis=0),
    )
