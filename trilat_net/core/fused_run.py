"""A run of all sites in virtual time, compiled as a whole and reduced to peaks as it is made.

Invariant: its leaves are those of `Site.step`, in the order of the virtual-time driver (nominal time,
then the scenario's order of sites), and its numbers are that driver's, bit for bit.
"""

import numpy as np

from .exogenous import TorqueSourceRows, TorqueTable
from .jit import leaf
from .kernel import act_stages, follow_stages, torque_stage
from .link import accept_sample
from .site_arrays import ROW_FLOATS
from .ticks import BUCKETS_PER_S, Mode, tick_ns
from .two_link_arm import JOINTS
from .vectors import Array, IntArray, Points, Row, RowArray

NEVER_NS = 2**63 - 1
"""When a site that has made all its ticks makes the next one."""

PROGRESS_DTYPE = np.dtype(
    (
        np.record,
        [
            ("tick", "i8"),
            ("t_ns", "i8"),
            ("ticks", "i8"),
            ("rate_hz", "i8"),
            ("bucket", "i8"),
            ("part", "i8"),
            ("apart_ns", "i8"),
            ("diverged_ns", "i8"),
        ],
    )
)
"""How far a site is: its next tick and the time of that, how many it makes in all; the bucket, and how many
of BUCKETS_PER_S-th ticks of it are gone; when its |e| last was above the limit of rest, and when it diverged
(-1: never)."""
SENT_DTYPE = np.dtype((np.record, [("t_ns", "i8"), ("row", "f8", (ROW_FLOATS,))]))
"""The record of a tick, as long as a peer may still want it."""

_DIVERGED = int(Mode.DIVERGED)
_Q_DES, _TAU_X = 2 * JOINTS, 5 * JOINTS


@leaf
def _take(
    k: int,
    t_ns: int,
    rate_hz: int,
    made: int,
    next_sample: int,
    sent: RowArray,
    link: Row,
    models: RowArray,
    samples: RowArray,
    calendar: IntArray,
    points: Points,
) -> int:
    """Accepts a peer's samples up to, and without, time t; returns which is the next.

    Args:
        k: the receiver's tick.
        t_ns: its time, ns since the epoch.
        rate_hz: its rate, Hz.
        made: how many ticks the peer has made.
        next_sample: the first one that was not taken.
        sent: the peer's records, dtype SENT.
        link: the link's row, and so on as in `link.accept`.
        models: see there.
        samples: see there.
        calendar: see there.
        points: see there.
    """
    while next_sample < made:
        record: Row = sent[next_sample & (sent.shape[0] - 1)]
        if record.t_ns >= t_ns:
            break
        row = record.row
        q, qd, tau_x = row[:JOINTS], row[JOINTS:_Q_DES], row[_TAU_X : _TAU_X + JOINTS]
        accept_sample(k, rate_hz, next_sample, q, qd, tau_x, link, models, samples, calendar, points)
        next_sample += 1
    return next_sample


@leaf
def _note(row: Array, t_ns: int, apart_rad: float, course: Row, peaks: Array) -> None:
    """Takes the largest |e| and |qd| of a record into its bucket, and turns to the next when it is full."""
    error = speed = 0.0
    for i in range(JOINTS):
        error = max(error, abs(row[i] - row[_Q_DES + i]))
        speed = max(speed, abs(row[JOINTS + i]))
    n = course.bucket
    peaks[n, 0] = max(peaks[n, 0], error)
    peaks[n, 1] = max(peaks[n, 1], speed)
    if error >= apart_rad:
        course.apart_ns = t_ns
    course.part += BUCKETS_PER_S
    while course.part >= course.rate_hz:
        course.part -= course.rate_hz
        course.bucket += 1


@leaf
def run_until(
    last_ns: int,
    apart_rad: float,
    courses: RowArray,
    taken: IntArray,
    sent: RowArray,
    peaks: Array,
    sites: RowArray,
    links: RowArray,
    models: RowArray,
    samples: RowArray,
    calendars: IntArray,
    points: Points,
    ramps: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> None:
    """Steps every site up to a time, or to the instant at which one diverges.

    Args:
        last_ns: the last nominal time that is stepped, ns since the epoch.
        apart_rad: an |e| of this or more is noted with its time, see COURSE.
        courses: how far each site is, shape (N,), dtype COURSE.
        taken: which sample of each peer is taken in next, shape (N, P).
        sent: each site's last records, shape (N, a power of two), dtype SENT.
        peaks: largest |e| and |qd| of each bucket, -1 where there is no record, shape (N, buckets, 2).
        sites: the tables of all sites, see `tables.stacked`; here and below.
        links: see there.
        models: see there.
        samples: see there.
        calendars: see there.
        points: see there.
        ramps: see there.
        actors: see there.
        table: see there.
    """
    count = courses.shape[0]
    while True:
        t_ns = NEVER_NS
        for i in range(count):
            course: Row = courses[i]
            t_ns = min(t_ns, course.t_ns)
        if t_ns > last_ns or t_ns == NEVER_NS:
            return
        for i in range(count):
            course = courses[i]
            if course.t_ns != t_ns:
                continue
            k, rate_hz = course.tick, course.rate_hz
            for p in range(count - 1):
                j = p if p < i else p + 1
                peer: Row = courses[j]
                channel = links[i, p], models[i, p], samples[i, p], calendars[i, p]
                taken[i, p] = _take(k, t_ns, rate_hz, peer.tick, taken[i, p], sent[j], *channel, points)
            site = sites[i]
            follow_stages(k, t_ns, site, links[i], models[i], samples[i], calendars[i], points, ramps[i])
            torque_stage(site)
            record: Row = sent[i, k & (sent.shape[1] - 1)]
            record.t_ns = t_ns
            act_stages(k, t_ns, site, actors[i], table, record.row)
            _note(record.row, t_ns, apart_rad, course, peaks[i])
            if site[0].mode == _DIVERGED:
                course.diverged_ns = t_ns
                last_ns = t_ns
            course.tick = k + 1
            course.t_ns = tick_ns(k + 1, rate_hz) if k + 1 < course.ticks else NEVER_NS
