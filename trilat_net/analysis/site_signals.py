"""Defines the signals of an arm, its settling time, and how signals are reduced for plots.

A signal is an array with a row for each record (the result of one tick of the arm's control
loop), such as the errors of the joints. For plots, the rows are reduced: each bucket of records
keeps the minimum and the maximum of each column, so that a spike of a single tick at 1 kHz
stays visible. A gap in the records that is wider than a bucket becomes a row of NaN, so that no
line is drawn across it.

Invariant:
    - Each signal has one definition, for figures, pages, summaries and metrics.
    - The torques of operators and environment are reported as they act on the arm. Their sign
      is the opposite of the recorded tau_x, the external torque in Eq. (8) of the paper.
    - Empty logs give empty arrays.
"""

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from ..core.step.vectors import Array
from ..log.log_reader import Log
from ..log.record_columns import Ints
from ..log.site_log import SiteLog
from ..scenario.expect import END_WINDOW_S

SETTLED_ERROR_RAD = 1e-2
"""Largest error of a settled site, in rad for joints and in m for axes of end effectors."""

Signal = Callable[[SiteLog], Array]
"""Function that returns a signal of a site, with a row for each of its K records."""
joint_angles: Signal = attrgetter("q")
"""Joint angles q, shape (K, n), in rad."""
joint_errors: Signal = attrgetter("e")
"""Errors e = q - q_des, Eq. (9), shape (K, n), in rad."""
controller_torques: Signal = attrgetter("tau")
"""Control torques tau, Eq. (13), shape (K, n), in N m."""
parameter_estimates: Signal = attrgetter("theta_hat")
"""Parameter estimates theta_hat, Eq. (15), shape (K, P), in kg m^2 and kg m.

P is 5 for the planar arm and 10 n for a chain.
"""


def reference_angles(part: SiteLog) -> Array:
    """Returns the angles that the joints of a site should reach, in rad.

    The reference q_des, Eq. (6), is the weighted mean of the peers' delayed angles. In task
    space the joints have no reference, and the angles q themselves are returned.

    Args:
        part: Log of the site.

    Returns:
        Angles, shape (K, n).
    """
    return part.q if part.layout.task else part.q_des


def follows_in_task_space(log: Log) -> bool:
    """Returns True if the sites follow each other with their end effectors.

    Their errors are then along axes in space, and not at joints.

    Args:
        log: The log of the run.
    """
    arms = log.scenario.arms.values()
    return any(arm.shares_pose for arm in arms)


def joint_error_rates(part: SiteLog) -> Array:
    """Returns the derivative of a site's error: its velocity minus the followed velocity.

    A site is the process that runs one arm.

    Args:
        part: The site's part of the log, with K records.

    Returns:
        Velocity errors of the n joints, shape (K, n), in rad/s. If the arm follows with its end
        effector, they are the errors of its m coordinates, shape (K, m).
    """
    if part.layout.task:
        # in task space the column qd_des holds xd_des
        velocity_error = part.xd - part.qd_des
        followed_axes = np.array(part.axes)
        rates: Array = velocity_error * followed_axes
        return rates
    return part.qd - part.qd_des


def shared_unit(log: Log) -> str:
    """Returns the unit of the coordinates that the sites share, and of their errors.

    It is "rad" for joint angles, "m" for positions and "m, rad" for poses of end effectors.

    Args:
        log: The log of the run.
    """
    first_site = log.sites[0]
    space = log.scenario.sites[first_site].task.space
    if space == "joints":
        return "rad"
    return "m" if space == "position" else "m, rad"


def external_torques(part: SiteLog) -> Array:
    """Returns the torque of operator and environment on the arm, shape (K, n), in N m."""
    return 0.0 - part.tau_x  # 0 - 0 is 0, but -0 would be printed as -0


def sample_ages_ms(log: Log, site: str) -> Array:
    """Returns the age of each peer's sample in use, in ms.

    Args:
        log: The log of the run.
        site: Name of the site.

    Returns:
        Ages, shape (K, N - 1), with a column for each peer. NaN before a peer's first sample.
    """
    part = log[site]
    columns = []
    for peer in part.peers:
        rate_hz = log.scenario.sites[peer].rate_hz
        columns.append(part.age_s(peer, rate_hz) * 1e3)
    shape = (len(part.peers), len(part))
    return np.array(columns).reshape(shape).T


def sites_with_operator(log: Log) -> list[str]:
    """Lists the sites at which somebody may act on the arm.

    They have an operator in the scenario, or recorded external torques.

    Args:
        log: The log of the run.
    """
    sites = []
    for site in log.sites:
        has_hands = bool(log.scenario.sites[site].hands)
        if has_hands or np.any(log[site].tau_x):
            sites.append(site)
    return sites


def largest_magnitude(values: Array) -> Array:
    """Returns the largest absolute value of each row, shape (K,)."""
    magnitudes = np.abs(values)
    largest: Array = magnitudes.max(axis=1, initial=0.0)
    return largest


class JointError(NamedTuple):
    """The largest error |e| of some records.

    Attributes:
        value: The error, in the unit of the shared coordinates.
        site: Name of the site.
        joint: Name of the site and of its joint, or of the axis of its end effector.
        t_s: Time of the record, in s.
    """

    value: float
    site: str
    joint: str
    t_s: float


def find_largest_error(part: SiteLog, from_s: float = -math.inf) -> JointError | None:
    """Finds the largest error |e| of a site, the first one if it occurs repeatedly.

    Args:
        part: Log of the site.
        from_s: Time after which records count, in s.

    Returns:
        The error. None if no record has a finite error.
    """
    first = int(np.searchsorted(part.t_s, from_s, side="right"))
    errors = np.abs(joint_errors(part)[first:])
    if not np.isfinite(errors).any():
        return None
    row, column = np.unravel_index(int(np.nanargmax(errors)), errors.shape)
    kind = "axis" if part.layout.task else "joint"
    return JointError(
        value=float(errors[row, column]),
        site=part.name,
        joint=f"{part.name} {kind} {column + 1}",
        t_s=float(part.t_s[first + row]),
    )


def find_error_of_last_second(part: SiteLog) -> JointError | None:
    """Finds the largest error |e| of a site in the last second of its records.

    Args:
        part: Log of the site.

    Returns:
        The error. None if no record of that second has a finite error.
    """
    if not len(part):
        return None
    return find_largest_error(part, from_s=float(part.t_s[-1]) - END_WINDOW_S)


def find_last_error(log: Log) -> JointError | None:
    """Finds the largest error |e| of all sites in the last second of their records.

    Args:
        log: Log of the run.

    Returns:
        The error. None if no record of that second has a finite error.
    """
    errors = [find_error_of_last_second(log[site]) for site in log.sites]
    known = [error for error in errors if error is not None]
    return max(known, key=lambda error: error.value, default=None)


def largest_remaining_error(part: SiteLog) -> Array:
    """Returns for each record the largest error of any joint from there to the end.

    Args:
        part: Log of the site.

    Returns:
        Largest error, shape (K,). It never rises.
    """
    largest = largest_magnitude(joint_errors(part))
    reversed_largest = largest[::-1]
    from_the_end = np.maximum.accumulate(reversed_largest)
    return from_the_end[::-1]


def settling_time_s(part: SiteLog) -> float | None:
    """Returns the last time at which an error exceeded `SETTLED_ERROR_RAD`, in s.

    Returns:
        The time. 0 if no error ever exceeded the bound. None if the last record has an error
        that exceeds it, or if there are no records.
    """
    if not len(part):
        return None
    is_above = largest_remaining_error(part) > SETTLED_ERROR_RAD
    rows_above = np.flatnonzero(is_above)
    if not len(rows_above):
        return 0.0
    last_row = rows_above[-1]
    if last_row == len(part) - 1:
        return None
    return float(part.t_s[last_row])


def settling_time_of_all_s(times_s: Sequence[float | None]) -> float | None:
    """Returns the time at which the last site has settled, in s.

    Args:
        times_s: Settling time of each site, from `settling_time_s`. None for a site that has
            not settled.

    Returns:
        The largest time. None if some site has not settled.
    """
    settled_s = [time_s for time_s in times_s if time_s is not None]
    if len(settled_s) < len(times_s):
        return None
    return max(settled_s)


def operator_displacement(log: Log, twin: Log, site: str) -> tuple[Ints, Array, Array]:
    """Returns how far operators displaced a site, compared with a run without operators.

    Args:
        log: The log of the run.
        twin: The log of the same run without operators.
        site: Name of the site.

    Returns:
        The ticks that both logs have, shape (K,).
        Their times, shape (K,), in s.
        q of the log minus q of the twin, shape (K, n), in rad.
    """
    part = log[site]
    twin_part = twin[site]
    common_tick, rows, twin_rows = np.intersect1d(
        part.tick, twin_part.tick, assume_unique=True, return_indices=True
    )
    q = joint_angles(part)[rows]
    twin_q = joint_angles(twin_part)[twin_rows]
    return common_tick, part.t_s[rows], q - twin_q


class _DecimatedTrace(NamedTuple):
    """Signals reduced to few points, so that they can be drawn quickly.

    A gap in the records that would be visible is marked by a row of NaN, which interrupts the
    curve.

    Attributes:
        tick: Ticks of the P points, shape (P,).
        t_s: Times of the points, shape (P,), in s.
        values: Values of the C signals, shape (P, C).
    """

    tick: Ints
    t_s: Array
    values: Array


def extreme_rows(values: Array, buckets: int) -> Ints:
    """Chooses the rows of some signals that a plot needs, so that no peak gets lost.

    The rows are divided into intervals with equal numbers of rows (buckets). In each bucket the
    rows with the largest and the smallest value of each column are kept. The first and the last
    row are kept as well. NaN is never an extreme. A bucket in which a column is NaN throughout
    keeps its first row.

    Args:
        values: The signals in columns, shape (K, C).
        buckets: Number of buckets.

    Returns:
        Indices of the rows.
    """
    rows, columns = values.shape
    if rows <= 2 * buckets or not columns:
        return np.arange(rows)

    # The negated floor division rounds up.
    size = -(-rows // buckets)
    filled_buckets = -(-rows // size)
    # the last bucket is filled up with its last row, which changes no extreme
    filled_rows = np.arange(filled_buckets * size)
    valid_rows = np.minimum(filled_rows, rows - 1)
    index = valid_rows.reshape(-1, size)
    bucket = np.arange(filled_buckets)

    ends = np.array([0, rows - 1])
    keep = [ends]
    for column in range(columns):
        block = values[index, column]
        missing = np.isnan(block)
        above_missing = np.where(missing, np.inf, block)
        below_missing = np.where(missing, -np.inf, block)
        lowest = above_missing.argmin(1)
        highest = below_missing.argmax(1)
        keep.append(index[bucket, lowest])
        keep.append(index[bucket, highest])
    return np.unique(np.concatenate(keep))


def decimate(
    tick: Ints,
    t_s: Array,
    values: Array,
    buckets: int,
) -> _DecimatedTrace:
    """Reduces signals to the points that a plot needs, so that no peak gets lost.

    The time is divided into buckets, of which each keeps at most 2 C + 3 points for C columns,
    among them the extremes of each column. One bucket per pixel of a plot is enough.

    Args:
        tick: Ascending ticks, shape (K,).
        t_s: Their nominal times, shape (K,), in s.
        values: The signals in columns, shape (K, C).
        buckets: Number of buckets.
    """
    if not len(tick):
        return _DecimatedTrace(tick, t_s, values)

    # narrower gaps are narrower than a pixel, and there may be thousands of them
    ticks = tick[-1] - tick[0]
    bucket_ticks = max(1.0, ticks / buckets)
    before_gap = np.flatnonzero(np.diff(tick) > bucket_ticks)
    after_gap = before_gap + 1
    beside_gaps = np.concatenate([before_gap, after_gap])
    keep = np.union1d(extreme_rows(values, buckets), beside_gaps)

    # the row of NaN is one period after the last record before the gap
    gap_ticks = tick[after_gap] - tick[before_gap]
    gap_s = t_s[after_gap] - t_s[before_gap]
    period_s = gap_s / gap_ticks
    nan_position = np.searchsorted(keep, before_gap) + 1
    nan_tick = tick[before_gap] + 1
    nan_t_s = t_s[before_gap] + period_s
    kept_values = values[keep]
    return _DecimatedTrace(
        tick=np.insert(tick[keep], nan_position, nan_tick),
        t_s=np.insert(t_s[keep], nan_position, nan_t_s),
        values=np.insert(kept_values, nan_position, np.nan, axis=0),
    )
