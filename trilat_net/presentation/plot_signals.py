"""Defines the signals that only figures and pages show, and decimates signals for plots.

A signal is an array with one row per tick. A one-minute run at 1 kHz has 60 000 rows, too many
for a plot, so the rows are decimated: each bucket of records keeps the minimum and the maximum
of each column, so that even a spike of a single tick remains visible. A gap in the records that
is wider than a bucket becomes a row of NaN, which interrupts the plotted line. Signals that
metrics and summaries also use are in `analysis.site_signals`.

Invariant:
    - Empty logs result in empty arrays.
"""

from typing import NamedTuple

import numpy as np

from ..core import Array
from ..log import Ints, Log, SiteLog


def reference_angles(part: SiteLog) -> Array:
    """Returns the reference angles of an arm's joints, in rad.

    The reference q_des, Eq. (6), is the weighted mean of the delayed angles of the other arms.
    If the arms follow each other's end effectors (task space), there are no joint references,
    and the actual angles q are returned.

    Args:
        part: Records of the arm.

    Returns:
        Angles, shape (K, n).
    """
    return part.q if part.layout.task else part.q_des


def shared_unit(log: Log) -> str:
    """Returns the unit of the coordinates in which the arms follow each other.

    This is "rad" for joint angles, "m" for end effector positions, and "m, rad" for end
    effector poses. Errors have the same unit.

    Args:
        log: The log of the run.
    """
    first_site = log.sites[0]
    space = log.scenario.sites[first_site].task.space
    if space == "joints":
        return "rad"
    return "m" if space == "position" else "m, rad"


def sample_ages_ms(log: Log, site: str) -> Array:
    """Returns the ages of the peer samples that a site used in each tick, in ms.

    A site uses the newest sample from each peer. Its age is the delay that the control loop
    experiences.

    Args:
        log: The log of the run.
        site: Name of the site.

    Returns:
        Ages, shape (K, N - 1), with one column per peer. NaN before the first sample of a peer.
    """
    records = log[site]
    columns = []
    for peer in records.peers:
        rate_hz = log.scenario.sites[peer].rate_hz
        columns.append(records.age_s(peer, rate_hz) * 1e3)
    # The shape is stated, because a site without peers has no columns.
    shape = (len(records.peers), len(records))
    return np.array(columns).reshape(shape).T


def sites_with_operator(log: Log) -> list[str]:
    """Returns the sites at which a person or program may act on the arm.

    These sites have an operator in the scenario, or recorded external torques.

    Args:
        log: The log of the run.
    """
    sites = []
    for site in log.sites:
        has_operator = bool(log.scenario.sites[site].hands)
        has_external_torque = np.any(log[site].tau_x)
        if has_operator or has_external_torque:
            sites.append(site)
    return sites


class _DecimatedTrace(NamedTuple):
    """Signals decimated to a few points, for fast drawing.

    A gap in the records that would be visible is marked by a row of NaN, which interrupts the
    curve.

    Attributes:
        tick: Ticks of the P points, shape (P,).
        t_s: Times of the points, in s, shape (P,).
        values: Values of the C signals, shape (P, C).
    """

    tick: Ints
    t_s: Array
    values: Array


def extreme_rows(values: Array, buckets: int) -> Ints:
    """Selects the rows of a set of signals that a plot needs in order to show every peak.

    The rows are divided into buckets with equal numbers of rows. Each bucket keeps the rows
    with the largest and smallest value of each column. The first and the last row are always
    kept. NaN is never an extreme. A bucket in which a column is entirely NaN keeps its first
    row.

    Args:
        values: The signals in columns, shape (K, C).
        buckets: Number of buckets.

    Returns:
        Indices of the selected rows.
    """
    row_count, column_count = values.shape
    if row_count <= 2 * buckets or not column_count:
        return np.arange(row_count)

    # The negated floor division rounds up, so that all rows lie in a bucket.
    bucket_size = -(-row_count // buckets)
    filled_buckets = -(-row_count // bucket_size)
    # the last bucket is filled up with its last row, which changes no extreme
    filled_rows = np.arange(filled_buckets * bucket_size)
    valid_rows = np.minimum(filled_rows, row_count - 1)
    rows_of_buckets = valid_rows.reshape(-1, bucket_size)
    bucket_numbers = np.arange(filled_buckets)

    first_and_last = np.array([0, row_count - 1])
    chosen_rows = [first_and_last]
    for column in range(column_count):
        block = values[rows_of_buckets, column]
        missing = np.isnan(block)
        above_missing = np.where(missing, np.inf, block)
        below_missing = np.where(missing, -np.inf, block)
        lowest = above_missing.argmin(1)
        highest = below_missing.argmax(1)
        chosen_rows.append(rows_of_buckets[bucket_numbers, lowest])
        chosen_rows.append(rows_of_buckets[bucket_numbers, highest])
    return np.unique(np.concatenate(chosen_rows))


def decimate(
    tick: Ints,
    t_s: Array,
    values: Array,
    buckets: int,
) -> _DecimatedTrace:
    """Decimates signals to the points that a plot needs in order to show every peak.

    The time axis is divided into buckets. For C columns, each bucket keeps at most 2 C + 3
    points, including the extremes of each column. One bucket per pixel of the plot is enough.

    Args:
        tick: Ticks in ascending order, shape (K,).
        t_s: Nominal times of the ticks, in s, shape (K,).
        values: The signals in columns, shape (K, C).
        buckets: Number of buckets.
    """
    if not len(tick):
        return _DecimatedTrace(tick, t_s, values)

    # shorter gaps are narrower than a pixel, and there may be thousands of them
    total_ticks = tick[-1] - tick[0]
    bucket_ticks = max(1.0, total_ticks / buckets)
    before_gap = np.flatnonzero(np.diff(tick) > bucket_ticks)
    after_gap = before_gap + 1
    beside_gaps = np.concatenate([before_gap, after_gap])
    chosen_rows = np.union1d(extreme_rows(values, buckets), beside_gaps)

    # the row of NaN is one period after the last record before the gap
    gap_ticks = tick[after_gap] - tick[before_gap]
    gap_s = t_s[after_gap] - t_s[before_gap]
    period_s = gap_s / gap_ticks
    nan_position = np.searchsorted(chosen_rows, before_gap) + 1
    nan_tick = tick[before_gap] + 1
    nan_t_s = t_s[before_gap] + period_s
    chosen_values = values[chosen_rows]
    return _DecimatedTrace(
        tick=np.insert(tick[chosen_rows], nan_position, nan_tick),
        t_s=np.insert(t_s[chosen_rows], nan_position, nan_t_s),
        values=np.insert(chosen_values, nan_position, np.nan, axis=0),
    )
