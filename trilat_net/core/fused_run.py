"""A run of all sites in virtual time, compiled as a whole and reduced to peaks as it proceeds.

Invariant: its leaves are those of `Site.step`, in the order of the virtual-time driver (nominal
time, then the scenario's order of sites), and its numbers are that driver's, bit for bit.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from . import chain_stages, two_link_stages
from .compiled_law import law_stage
from .exogenous import TorqueSourceRows, TorqueTable
from .jit import leaf
from .kernel import act_stages, channel_of, reference_stages, torque_stage
from .link import LinkArrays, accept_sample, release_sample
from .site_arrays import SiteArrays
from .task_space import POSITION
from .ticks import BUCKETS_PER_S, Mode, tick_ns
from .vectors import Array, IntArray, Row, RowArray

NEVER_NS = 2**63 - 1
"""The time of the next tick of a site that has made all its ticks."""

_PROGRESS = (
    "tick",
    "t_ns",
    "ticks",
    "rate_hz",
    "bucket",
    "part",
    "unsettled_ns",
    "diverged_ns",
)
PROGRESS_DTYPE = np.dtype((np.record, [(name, "i8") for name in _PROGRESS]))
"""A site's progress: its next tick and the time of that, how many it makes in all; the bucket,
and how many BUCKETS_PER_S-th ticks of it are gone; when its |e| last was above the limit of
rest, and when it diverged (-1: never).
"""


class RecentRecords(NamedTuple):
    """The last records of a site, kept as long as a peer may still want them; of all sites one
    axis more.

    Attributes:
        t_ns: their nominal times, ns since the epoch, shape (a power of two,).
        rows: their floats, see `Layout.columns`, a row each.
    """

    t_ns: IntArray
    rows: Array


@cache
def sums_dtype(joints: int) -> np.dtype[np.void]:
    """Returns the layout of a site's sums over its records.

    Of |tau - G|^2 and of e^2; the largest force of a wall; the work of its environments, from
    which of its actors on (-1: it has none). And of the record before: q, the present and the
    held torque of the environments; `off` is scratch.
    """
    fields: list[Any] = [("first_environment", "i8")]
    fields += [(name, "f8") for name in ("effort", "force_peak_n", "environment_j")]
    names = ("errors", "q", "now_before", "held_before", "G", "now", "held")
    return np.dtype((np.record, fields + [(name, "f8", (joints,)) for name in names]))


_DIVERGED = int(Mode.DIVERGED)


def max_over_joints(buckets: Array) -> Array:
    """Returns the largest |e| and |qd| of any joint, of buckets as `run_until` makes them,
    shape (K, 2).
    """
    joints = buckets.shape[1] // 3
    found: Array = buckets[:, : 2 * joints].reshape(-1, 2, joints).max(axis=2)
    return found


@leaf
def _first_sent(s: Row) -> int:
    """Returns where in a site's row of floats the numbers begin that its law sends."""
    first: int = 4 * s.joints + (5 if s.task else 2) * s.shared + s.parameters
    return first


class ReplayedInputs(NamedTuple):
    """What came to the sites of a recorded run from outside, in place of prompt samples and
    free hands.

    Attributes:
        first: by site, peer and tick the place of its first arrival, shape (N, P, K + 1); K =
            0: every sample comes at the first tick after its stamp.
        samples: the ticks of the samples that arrive, in order.
        hands: by site and tick grip, target, and target plus rate of its live hand, shape (N,
            K, 1 + 2 size).
        hand_rows: which of a site's torque sources that is, shape (N,); -1: it has none.
    """

    first: IntArray
    samples: IntArray
    hands: Array
    hand_indices: IntArray


@leaf
def _accept_made(
    k: int, rate_hz: int, peer: Row, sample: int, sent: RecentRecords, link: LinkArrays
) -> None:
    """Accepts a sample that its sender has made."""
    n = peer.joints
    m = peer.shared
    q = 0
    qd = n
    tau_x = 3 * n + 2 * m
    sent_at = _first_sent(peer)
    if peer.task:
        q = sent_at - 3 * m
        qd = sent_at - 2 * m
        tau_x = sent_at - m
    row = sent.rows[sample & (sent.t_ns.shape[0] - 1)]
    accept_sample(
        k=k,
        rate_hz=rate_hz,
        tick=sample,
        q=row[q:],
        qd=row[qd:],
        tau_x=row[tau_x:],
        sent=row[sent_at:],
        link=link,
    )


@leaf
def _receive(
    k: int,
    t_ns: int,
    rate_hz: int,
    peer: Row,
    made: int,
    next_sample: int,
    sent: RecentRecords,
    link: LinkArrays,
) -> int:
    """Accepts a peer's samples before time t, of the `made` there are; returns which is the
    next.
    """
    while next_sample < made and sent.t_ns[next_sample & (sent.t_ns.shape[0] - 1)] < t_ns:
        _accept_made(k=k, rate_hz=rate_hz, peer=peer, sample=next_sample, sent=sent, link=link)
        next_sample += 1
    return next_sample


@leaf
def _take_hand(i: int, k: int, actors: TorqueSourceRows, feed: ReplayedInputs) -> None:
    """Lets the live hand of a site do what it did at tick k."""
    if feed.hand_indices[i] < 0 or k >= feed.hands.shape[1]:
        return
    hand: Row = actors[feed.hand_indices[i]]
    size = (feed.hands.shape[2] - 1) // 2
    hand.grip = feed.hands[i, k, 0]
    for n in range(min(size, hand.a.shape[0])):
        hand.a[n] = feed.hands[i, k, 1 + n]
        hand.b[n] = feed.hands[i, k, 1 + size + n]


@leaf
def _update_peaks(
    row: Array, t_ns: int, apart_rad: float, s: Row, progress: Row, peaks: Array, sums: Row
) -> None:
    """Updates the present bucket by a record, see `run_until`; a full bucket is left."""
    error = 0.0
    bucket = progress.bucket
    joints = peaks.shape[1] // 3
    here = _first_sent(s) - 3 * s.shared if s.task else 0
    # where a task has more or fewer coordinates than there are joints, zeros stand
    for i in range(joints):
        e = speed = angle = 0.0
        if i < s.shared:
            e = row[here + i] - row[2 * s.joints + i]
            if i >= POSITION and s.task:  # of an orientation
                e = s.e[i]
        if i < s.joints:
            speed = abs(row[s.joints + i])
            angle = row[i]
        sums.errors[i] += e * e
        apart = abs(e)
        error = max(error, apart)
        peaks[bucket, i] = max(peaks[bucket, i], apart)
        peaks[bucket, joints + i] = max(peaks[bucket, joints + i], speed)
        peaks[bucket, 2 * joints + i] = angle
    if error >= apart_rad:
        progress.unsettled_ns = t_ns
    progress.part += BUCKETS_PER_S
    while progress.part >= progress.rate_hz:
        progress.part -= progress.rate_hz
        progress.bucket += 1


@leaf
def _put_gravity_torque(s: Row, chain: RowArray | None, row: Array, torque: Array) -> None:
    if chain is None:
        two_link_stages.put_gravity_torque(s, torque)
    else:
        chain_stages.put_gravity_torque(s, chain, row, torque)


@leaf
def _put_source_torque(
    t_s: float,
    s: Row,
    chain: RowArray | None,
    row: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
    sampled: int,
    torque: Array,
) -> None:
    if chain is None:
        two_link_stages.put_source_torque(
            t_s=t_s, s=s, state=row, actors=actors, table=table, sampled=sampled, torque=torque
        )
    else:
        chain_stages.put_source_torque(
            t_s=t_s,
            s=s,
            chain=chain,
            state=row,
            actors=actors,
            table=table,
            sampled=sampled,
            torque=torque,
        )


@leaf
def _update_sums(
    k: int,
    t_ns: int,
    s: Row,
    chain: RowArray | None,
    actors: TorqueSourceRows,
    table: TorqueTable,
    row: Array,
    sums: Row,
) -> None:
    """Adds a record to the effort, and the period before it to the work of the environments."""
    n = s.joints
    t_s = t_ns * 1e-9
    first = sums.first_environment
    _put_gravity_torque(s, chain, row, sums.G)
    tau = 2 * (n + s.shared)
    effort = 0.0
    for i in range(n):
        off = row[tau + i] - sums.G[i]
        effort += off * off
    sums.effort += effort
    if first < 0:
        return
    for i in range(n):
        sums.held[i] = s.held[i]
        sums.now[i] = s.on_arm[i] - s.held[i]
    if first > 0:  # beside operators, whose rows come first
        _put_source_torque(
            t_s=t_s,
            s=s,
            chain=chain,
            row=row,
            actors=actors[first:],
            table=table,
            sampled=0,
            torque=sums.now,
        )
        _put_source_torque(
            t_s=t_s,
            s=s,
            chain=chain,
            row=row,
            actors=actors[first:],
            table=table,
            sampled=1,
            torque=sums.held,
        )
    sums.force_peak_n = max(sums.force_peak_n, s.wall_n)
    for i in range(n):
        if k > 0:
            mean = 0.5 * (sums.now_before[i] + sums.now[i]) + sums.held_before[i]
            sums.environment_j += mean * (row[i] - sums.q[i])
        sums.q[i] = row[i]
        sums.now_before[i] = sums.now[i]
        sums.held_before[i] = sums.held[i]


class LawArrays(NamedTuple):
    """The plugged laws of all sites.

    Attributes:
        addresses: of the machine code of each site's law, shape (N,); 0: it has none, see
            `CompiledLaw`.
        rows: the numbers of each law, shape (N, most).
        sent: what each law sends, shape (N, most).
    """

    addresses: IntArray
    rows: Array
    sent: Array


@leaf
def _find_torque(
    i: int, own: Row, arrays: SiteArrays, chain: RowArray | None, laws: LawArrays | None
) -> None:
    """Stage 6 of a site; a law in plain Python was asked already."""
    if laws is None:
        torque_stage(arrays.site[i], chain)
        return
    channel = channel_of(arrays.channel, i)
    if laws.addresses[i] == 0 or channel is None:
        torque_stage(arrays.site[i], chain)
        return
    site = arrays.site[i]
    links = arrays.links[i]
    row = laws.rows[i]
    sent = laws.sent[i]
    address = laws.addresses[i]
    law_stage(
        k=own.tick,
        t_ns=own.t_ns,
        address=address,
        law=row,
        site=site,
        links=links,
        chain=chain,
        channel=channel,
        sent=sent,
    )


@leaf
def _record_sent(s: Row, i: int, row: Array, laws: LawArrays | None) -> None:
    if laws is not None:
        first = _first_sent(s)
        for c in range(s.sent):
            row[first + c] = laws.sent[i, c]


@leaf
def sense_site(
    i: int,
    progress: RowArray,
    taken: IntArray,
    sent: RecentRecords,
    feed: ReplayedInputs,
    arrays: SiteArrays,
    chain: RowArray | None,
) -> None:
    """Stages 1 to 5 of a site's next tick."""
    own: Row = progress[i]
    k = own.tick
    t_ns = own.t_ns
    rate_hz = own.rate_hz
    site = arrays.site[i]
    links = arrays.links[i]
    for p in range(links.shape[0]):
        j = p if p < i else p + 1
        peer: Row = progress[j]
        link = LinkArrays(
            state=links[p : p + 1],
            models=arrays.models[i, p],
            dues=arrays.dues[i, p],
            calendar=arrays.calendars[i, p],
            points=arrays.points,
            channel=channel_of(channel_of(arrays.channel, i), p),
        )
        sender: Row = arrays.site[j, 0]
        kept = RecentRecords(sent.t_ns[j], sent.rows[j])
        if k + 1 < feed.first.shape[2]:
            for n in range(feed.first[i, p, k], feed.first[i, p, k + 1]):
                _accept_made(
                    k=k,
                    rate_hz=rate_hz,
                    peer=sender,
                    sample=feed.samples[n],
                    sent=kept,
                    link=link,
                )
        else:
            taken[i, p] = _receive(
                k=k,
                t_ns=t_ns,
                rate_hz=rate_hz,
                peer=sender,
                made=peer.tick,
                next_sample=taken[i, p],
                sent=kept,
                link=link,
            )
        release_sample(k, rate_hz, link)
    _take_hand(i, k, arrays.actors[i], feed)
    reference_stages(
        k=k,
        t_ns=t_ns,
        site=site,
        links=links,
        ramps=arrays.ramps[i],
        actors=arrays.actors[i],
        table=arrays.table,
        chain=chain,
    )


@leaf
def finish_site(
    i: int,
    apart_rad: float,
    progress: RowArray,
    sent: RecentRecords,
    peaks: Array,
    sums: RowArray,
    arrays: SiteArrays,
    chain: RowArray | None,
    laws: LawArrays | None,
) -> int:
    """Stages 6 to 8 of a site's next tick, and what is kept of it; returns its mode."""
    own: Row = progress[i]
    k = own.tick
    t_ns = own.t_ns
    rate_hz = own.rate_hz
    site = arrays.site[i]
    _find_torque(i=i, own=own, arrays=arrays, chain=chain, laws=laws)
    page = k & (sent.t_ns.shape[1] - 1)
    sent.t_ns[i, page] = t_ns
    record = sent.rows[i, page]
    act_stages(
        k=k,
        t_ns=t_ns,
        site=site,
        actors=arrays.actors[i],
        table=arrays.table,
        chain=chain,
        record=record,
    )
    _record_sent(site[0], i, record, laws)
    total: Row = sums[i]
    _update_peaks(
        row=record,
        t_ns=t_ns,
        apart_rad=apart_rad,
        s=site[0],
        progress=own,
        peaks=peaks[i],
        sums=total,
    )
    _update_sums(
        k=k,
        t_ns=t_ns,
        s=site[0],
        chain=chain,
        actors=arrays.actors[i],
        table=arrays.table,
        row=record,
        sums=total,
    )
    own.tick = k + 1
    own.t_ns = tick_ns(k + 1, rate_hz) if k + 1 < own.ticks else NEVER_NS
    mode: int = site[0].mode
    return mode


@leaf
def run_until(
    last_ns: int,
    apart_rad: float,
    progress: RowArray,
    taken: IntArray,
    sent: RecentRecords,
    feed: ReplayedInputs,
    peaks: Array,
    sums: RowArray,
    arrays: SiteArrays,
    chains: RowArray | None,
    laws: LawArrays | None,
) -> None:
    """Steps every site up to a time, or to the instant at which one diverges.

    Args:
        last_ns: the last nominal time that is stepped, ns since the epoch.
        apart_rad: the time of the last |e| of this or more is kept, see PROGRESS_DTYPE.
        progress: of each site, shape (N,), PROGRESS_DTYPE.
        taken: the next sample of each peer to accept, shape (N, P).
        sent: each site's last records.
        feed: what came from outside in a run that was recorded.
        peaks: of each bucket per joint the largest |e|, then per joint the largest |qd|, then
            the last q of each; -1 where there is no record; shape (N, buckets, 3 n).
        sums: of each site, shape (N,), see `sums_dtype`.
        arrays: of all sites, see `stack_site_arrays`.
        chains: its `chain` once more: an argument that is None keeps the leaves of chains
            uncompiled.
        laws: compiled laws that are plugged in; None: there are none.
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
            if chains is None:
                sense_site(
                    i=i,
                    progress=progress,
                    taken=taken,
                    sent=sent,
                    feed=feed,
                    arrays=arrays,
                    chain=None,
                )
                mode = finish_site(
                    i=i,
                    apart_rad=apart_rad,
                    progress=progress,
                    sent=sent,
                    peaks=peaks,
                    sums=sums,
                    arrays=arrays,
                    chain=None,
                    laws=laws,
                )
            else:
                chain = chains[i, : arrays.site[i, 0].joints]
                sense_site(
                    i=i,
                    progress=progress,
                    taken=taken,
                    sent=sent,
                    feed=feed,
                    arrays=arrays,
                    chain=chain,
                )
                mode = finish_site(
                    i=i,
                    apart_rad=apart_rad,
                    progress=progress,
                    sent=sent,
                    peaks=peaks,
                    sums=sums,
                    arrays=arrays,
                    chain=chain,
                    laws=laws,
                )
            if mode == _DIVERGED:
                own.diverged_ns = t_ns
                last_ns = t_ns
