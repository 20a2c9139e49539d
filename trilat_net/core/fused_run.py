"""A run of all sites in virtual time, compiled as a whole and reduced to peaks as it proceeds.

Invariant: its leaves are those of `Site.step`, in the order of the virtual-time driver (nominal time,
then the scenario's order of sites), and its numbers are that driver's, bit for bit.
"""

import numpy as np

from .exogenous import TorqueSourceRows, TorqueTable, torque_on_arm
from .jit import leaf
from .kernel import act_stages, reference_stages, torque_stage
from .link import LinkArrays, accept_sample, recall_sample
from .site_arrays import RECORD_Q_DES, RECORD_TAU, RECORD_TAU_X, ROW_FLOATS, SiteArrays
from .ticks import BUCKETS_PER_S, Mode, tick_ns
from .two_link_arm import JOINTS
from .vectors import Array, IntArray, Row, RowArray, pair

NEVER_NS = 2**63 - 1
"""The time of the next tick of a site that has made all its ticks."""

_PROGRESS = ("tick", "t_ns", "ticks", "rate_hz", "bucket", "part", "apart_ns", "diverged_ns")
PROGRESS_DTYPE = np.dtype((np.record, [(name, "i8") for name in _PROGRESS]))
"""A site's progress: its next tick and the time of that, how many it makes in all; the bucket, and how many
BUCKETS_PER_S-th ticks of it are gone; when its |e| last was above the limit of rest, and when it diverged
(-1: never)."""
SENT_DTYPE = np.dtype((np.record, [("t_ns", "i8"), ("row", "f8", (ROW_FLOATS,))]))
"""The record of a tick, as long as a peer may still want it."""

_PAIR = (JOINTS,)
SUMS_DTYPE = np.dtype(
    (
        np.record,
        [
            ("first_environment", "i8"),
            *((name, "f8") for name in ("effort", "force_peak_n", "environment_j")),
            *((name, "f8", _PAIR) for name in ("errors", "q", "now", "held")),
        ],
    )
)
"""A site's sums over its records: of |tau - G|^2 and of e^2; the largest force of a wall; the work of its
environments, from which of its actors on (-1: it has none). And of the record before: q, the present and the
held torque of the environments."""
PEAK_COLUMNS = 3 * JOINTS
"""Of a bucket: per joint the largest |e|, then per joint the largest |qd|, then the last q of each."""

_DIVERGED = int(Mode.DIVERGED)


def largest_of_joints(buckets: Array) -> Array:
    """Returns the largest |e| and |qd| of any joint, of buckets of `PEAK_COLUMNS`, shape (K, 2)."""
    found: Array = buckets[:, : 2 * JOINTS].reshape(-1, 2, JOINTS).max(axis=2)
    return found


@leaf
def _receive(
    k: int, t_ns: int, rate_hz: int, made: int, next_sample: int, sent: RowArray, link: LinkArrays
) -> int:
    """Accepts a peer's samples before time t, of the `made` there are; returns which is the next."""
    while next_sample < made:
        record: Row = sent[next_sample & (sent.shape[0] - 1)]
        if record.t_ns >= t_ns:
            break
        row = record.row
        q, qd = row[:JOINTS], row[JOINTS:RECORD_Q_DES]
        tau_x = row[RECORD_TAU_X : RECORD_TAU_X + JOINTS]
        accept_sample(k, rate_hz, next_sample, q, qd, tau_x, link)
        next_sample += 1
    return next_sample


@leaf
def _update_peaks(row: Array, t_ns: int, apart_rad: float, progress: Row, peaks: Array, sums: Row) -> None:
    """Updates the present bucket by a record, see `PEAK_COLUMNS`; a full bucket is left."""
    error = 0.0
    n = progress.bucket
    for i in range(JOINTS):
        e = row[i] - row[RECORD_Q_DES + i]
        sums.errors[i] += e * e
        apart = abs(e)
        error = max(error, apart)
        peaks[n, i] = max(peaks[n, i], apart)
        peaks[n, JOINTS + i] = max(peaks[n, JOINTS + i], abs(row[JOINTS + i]))
        peaks[n, 2 * JOINTS + i] = row[i]
    if error >= apart_rad:
        progress.apart_ns = t_ns
    progress.part += BUCKETS_PER_S
    while progress.part >= progress.rate_hz:
        progress.part -= progress.rate_hz
        progress.bucket += 1


@leaf
def _update_sums(
    k: int, t_ns: int, s: Row, actors: TorqueSourceRows, table: TorqueTable, row: Array, sums: Row
) -> None:
    """Adds a record to the effort, and the period before it to the work of the environments.

    G is in the regressor of this tick, whose last columns are g cos q_1 and g cos(q_1 + q_2).
    """
    outer = s.Y[1, 4] * s.theta[4]
    off_0 = row[RECORD_TAU] - (s.Y[0, 3] * s.theta[3] + outer)
    off_1 = row[RECORD_TAU + 1] - outer
    sums.effort += off_0 * off_0 + off_1 * off_1
    first = sums.first_environment
    if first < 0:
        return
    t_s, q, qd, lengths = t_ns * 1e-9, (row[0], row[1]), (row[2], row[3]), pair(s.lengths)
    held = pair(s.held)
    now = (s.on_arm[0] - held[0], s.on_arm[1] - held[1])
    if first > 0:  # beside operators, whose rows come first
        in_stages = torque_on_arm(t_s, q, qd, lengths, actors[first:], table, 0)
        sampled = torque_on_arm(t_s, q, qd, lengths, actors[first:], table, 1)
        now, held = (in_stages[0], in_stages[1]), (sampled[0], sampled[1])
    sums.force_peak_n = max(sums.force_peak_n, s.wall_n)
    if k > 0:
        for i in range(JOINTS):
            mean = 0.5 * (sums.now[i] + now[i]) + sums.held[i]
            sums.environment_j += mean * (q[i] - sums.q[i])
    for i in range(JOINTS):
        sums.q[i], sums.now[i], sums.held[i] = q[i], now[i], held[i]


@leaf
def run_until(
    last_ns: int,
    apart_rad: float,
    progress: RowArray,
    taken: IntArray,
    sent: RowArray,
    peaks: Array,
    sums: RowArray,
    arrays: SiteArrays,
) -> None:
    """Steps every site up to a time, or to the instant at which one diverges.

    Args:
        last_ns: the last nominal time that is stepped, ns since the epoch.
        apart_rad: the time of the last |e| of this or more is kept, see PROGRESS_DTYPE.
        progress: of each site, shape (N,), PROGRESS_DTYPE.
        taken: the next sample of each peer to accept, shape (N, P).
        sent: each site's last records, shape (N, a power of two), SENT_DTYPE.
        peaks: of each bucket its `PEAK_COLUMNS`, -1 where there is no record, shape (N, buckets, 6).
        sums: of each site, shape (N,), SUMS_DTYPE.
        arrays: of all sites, see `stack_site_arrays`.
    """
    count = progress.shape[0]
    while True:
        t_ns = NEVER_NS
        for i in range(count):
            own: Row = progress[i]
            t_ns = min(t_ns, own.t_ns)
        if t_ns > last_ns or t_ns == NEVER_NS:
            return
        for i in range(count):
            own = progress[i]
            if own.t_ns != t_ns:
                continue
            k, rate_hz = own.tick, own.rate_hz
            site, links = arrays.site[i], arrays.links[i]
            for p in range(count - 1):
                j = p if p < i else p + 1
                peer: Row = progress[j]
                link = LinkArrays(
                    links[p : p + 1],
                    arrays.models[i, p],
                    arrays.samples[i, p],
                    arrays.calendars[i, p],
                    arrays.points,
                )
                taken[i, p] = _receive(k, t_ns, rate_hz, peer.tick, taken[i, p], sent[j], link)
                recall_sample(k, rate_hz, link)
            reference_stages(k, t_ns, site, links, arrays.ramps[i])
            torque_stage(site)
            record: Row = sent[i, k & (sent.shape[1] - 1)]
            record.t_ns = t_ns
            act_stages(k, t_ns, site, arrays.actors[i], arrays.table, record.row)
            total: Row = sums[i]
            _update_peaks(record.row, t_ns, apart_rad, own, peaks[i], total)
            _update_sums(k, t_ns, site[0], arrays.actors[i], arrays.table, record.row, total)
            if site[0].mode == _DIVERGED:
                own.diverged_ns = t_ns
                last_ns = t_ns
            own.tick = k + 1
            own.t_ns = tick_ns(k + 1, rate_hz) if k + 1 < own.ticks else NEVER_NS
