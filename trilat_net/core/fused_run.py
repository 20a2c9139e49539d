"""Simulates all sites of an experiment in one compiled call, for studies of many runs.

A site is an arm with its control loop. The run takes place in virtual time: the clock of the
simulation jumps from one tick (period of the loop) to the next. Such a run writes no log. It
keeps only the largest errors and speeds and a few sums.

Invariant:

- The call uses the same compiled functions as `Site.step`, which computes a single tick.
- The ticks are computed in the same order as in an ordinary run in virtual time: by nominal
  time, and at equal times in the order of the sites in the scenario file.
- The numbers are equal to those of an ordinary run, bit for bit.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from . import chain_stages, two_link_stages
from .compiled_law import law_stage
from .exogenous import TorqueSourceRows, TorqueTable
from .jit import leaf
from .kernel import act_stages, channel_of, reference_stages, torque_stage
from .link import LinkArrays, accept_sample, release_sample
from .row_fields import ProgressRow, SiteRow, SumsRow, row_dtype
from .site_arrays import SiteArrays
from .task_space import POSITION
from .ticks import BUCKETS_PER_S, Mode, tick_ns
from .vectors import Array, IntArray, Row, RowArray

NEVER_NS = 2**63 - 1
"""The time of the next tick of a site that has made all its ticks, ns."""

PROGRESS_DTYPE = row_dtype("progress", {})
"""The layout of a site's progress, see `ProgressRow`."""


class RecentRecords(NamedTuple):
    """Last records of a site, kept as a ring while a peer may still need them.

    The records of all sites have one more axis in front.

    Attributes:
        t_ns: Nominal times of the records, ns since the epoch, shape (a power of two,).
        rows: Floats of the records, see `Layout.columns`, one row per record.
    """

    t_ns: IntArray
    rows: Array


@cache
def sums_dtype(joints: int) -> np.dtype[np.void]:
    """Returns the NumPy data type of the sums over all records of a site, see `SumsRow`.

    Args:
        joints: Number of joints of the arm, the length of the sums' vectors.
    """
    return row_dtype("sums", {"joints": joints})


_DIVERGED = int(Mode.DIVERGED)


def max_over_joints(buckets: Array) -> Array:
    """Returns the peaks of the position error e and the joint speed qd over all joints.

    Args:
        buckets: Peaks of each joint of a site in K intervals of time, shape (K, 3 n), see
            `run_until`.

    Returns:
        The largest |e|, rad, and the largest |qd|, rad/s, per interval, shape (K, 2).
    """
    joints = buckets.shape[1] // 3
    peaks: Array = buckets[:, : 2 * joints].reshape(-1, 2, joints).max(axis=2)
    return peaks


@leaf
def _first_sent(s: SiteRow) -> int:
    """Returns the first column of the numbers that a law sends in its site's row of floats."""
    shared_vectors = 5 if s.task else 2
    return 4 * s.joints + shared_vectors * s.shared + s.parameters


class ReplayedInputs(NamedTuple):
    """The arrivals and the live hands of a recorded run, which a fused run repeats.

    Attributes:
        first: Index into `samples` of the first arrival, by site, peer and tick, shape (N, P,
            K + 1). With K = 0 each sample arrives at the first tick after its stamp.
        samples: The stamps of the samples, in the order of their arrival.
        hands: The action of the live hand by site and tick: grip, target, and target plus rate,
            shape (N, K, 1 + 2 size). Without actions all hands are free.
        hand_indices: Per site the index of the live hand among the torque sources, shape (N,);
            -1: no live hand.
    """

    first: IntArray
    samples: IntArray
    hands: Array
    hand_indices: IntArray


@leaf
def _accept_record(
    k: int, rate_hz: int, peer: SiteRow, sample: int, sent: RecentRecords, link: LinkArrays
) -> None:
    """Accepts the record of a peer's tick as an arrival at tick k.

    The columns of the record are those of `TickRecord.shared`.

    Args:
        k: Tick of the receiver.
        rate_hz: Tick rate of the receiver, Hz.
        peer: Row of the peer.
        sample: Tick of the peer.
        sent: Last records of the peer.
        link: Arrays of the link from the peer.
    """
    n = peer.joints
    m = peer.shared
    first_sent = _first_sent(peer)
    q = 0
    qd = n
    tau_x = 3 * n + 2 * m
    if peer.task:
        q = first_sent - 3 * m
        qd = first_sent - 2 * m
        tau_x = first_sent - m
    row = sent.rows[sample & (sent.t_ns.shape[0] - 1)]
    accept_sample(
        k=k,
        rate_hz=rate_hz,
        tick=sample,
        q=row[q:],
        qd=row[qd:],
        tau_x=row[tau_x:],
        sent=row[first_sent:],
        link=link,
    )


@leaf
def _accept_prompt_records(
    k: int,
    t_ns: int,
    rate_hz: int,
    peer: SiteRow,
    records: int,
    next_sample: int,
    sent: RecentRecords,
    link: LinkArrays,
) -> int:
    """Accepts a peer's records with a stamp before time t, as if they arrived without delay.

    Args:
        k: The tick of the receiver.
        t_ns: Its nominal time, ns since the epoch.
        rate_hz: Its tick rate, Hz.
        peer: The row of the peer.
        records: The number of records that the peer has made.
        next_sample: The first record that was not accepted yet.
        sent: The last records of the peer.
        link: The link from the peer.

    Returns:
        The first record that is not accepted yet.
    """
    while next_sample < records and sent.t_ns[next_sample & (sent.t_ns.shape[0] - 1)] < t_ns:
        _accept_record(
            k=k, rate_hz=rate_hz, peer=peer, sample=next_sample, sent=sent, link=link
        )
        next_sample += 1
    return next_sample


@leaf
def _apply_recorded_hand(
    i: int, k: int, actors: TorqueSourceRows, feed: ReplayedInputs
) -> None:
    """Writes the recorded action of the live hand of a site into its row.

    Args:
        i: Index of the site.
        k: The tick.
        actors: Operators and environments of the site.
        feed: Inputs of the recorded run.
    """
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
    row: Array,
    t_ns: int,
    settled_rad: float,
    s: SiteRow,
    progress: ProgressRow,
    peaks: Array,
    sums: SumsRow,
) -> None:
    """Updates the peaks of the present bucket by a record, and advances to the next bucket.

    Args:
        row: The floats of the record.
        t_ns: Its nominal time, ns since the epoch.
        settled_rad: Errors below this are settled, rad.
        s: The row of the site.
        progress: The progress of the site.
        peaks: The peaks of the site, see `run_until`, shape (buckets, 3 n).
        sums: The sums of the site.
    """
    largest_error = 0.0
    bucket = progress.bucket
    joints = peaks.shape[1] // 3
    pose = _first_sent(s) - 3 * s.shared if s.task else 0
    reference = 2 * s.joints
    # A task may have fewer coordinates than the arm has joints, or more: the rest are zeros.
    for i in range(joints):
        e = 0.0
        speed = 0.0
        angle = 0.0
        if i < s.shared:
            e = row[pose + i] - row[reference + i]
            if i >= POSITION and s.task:  # an orientation: differences of vectors are no error
                e = s.e[i]
        if i < s.joints:
            speed = abs(row[s.joints + i])
            angle = row[i]
        sums.errors[i] += e * e
        error = abs(e)
        largest_error = max(largest_error, error)
        peaks[bucket, i] = max(peaks[bucket, i], error)
        peaks[bucket, joints + i] = max(peaks[bucket, joints + i], speed)
        peaks[bucket, 2 * joints + i] = angle
    if largest_error >= settled_rad:
        progress.unsettled_ns = t_ns
    progress.part += BUCKETS_PER_S
    while progress.part >= progress.rate_hz:
        progress.part -= progress.rate_hz
        progress.bucket += 1


@leaf
def _put_gravity_torque(s: SiteRow, chain: RowArray | None, row: Array, torque: Array) -> None:
    """Writes the gravity torque at the pose of a record, N m.

    Args:
        s: Row of the site.
        chain: Rows of the chain, or None for the planar arm.
        row: Floats of the record.
        torque: Written, shape (n,).
    """
    if chain is None:
        two_link_stages.put_gravity_torque(s, torque)
    else:
        chain_stages.put_gravity_torque(s, chain, row, torque)


@leaf
def _put_source_torque(
    t_s: float,
    s: SiteRow,
    chain: RowArray | None,
    row: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
    sampled: int,
    torque: Array,
) -> None:
    """Writes the torque of some actors at the state of a record, N m.

    Args:
        t_s: Time since the epoch, s.
        s: Row of the site.
        chain: Rows of the chain, or None for the planar arm.
        row: Floats of the record.
        actors: Operators and environments.
        table: Their tables.
        sampled: 1: the actors that are held over a tick; 0: the others.
        torque: Written, shape (n,).
    """
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
    s: SiteRow,
    chain: RowArray | None,
    actors: TorqueSourceRows,
    table: TorqueTable,
    row: Array,
    sums: SumsRow,
) -> None:
    """Adds a record to the effort, and the period before it to the work of the environments.

    The effort is the squared torque beyond gravity. The work over a period is the mean of the
    present torque at both ends (trapezoid rule), plus the torque held over the period, times
    the change of q.

    Args:
        k: The tick.
        t_ns: Nominal time of the tick, ns since the epoch.
        s: Row of the site.
        chain: Rows of the chain, or None for the planar arm.
        actors: Operators and environments, the operators first.
        table: Their tables.
        row: Floats of the record.
        sums: Sums of the site.
    """
    n = s.joints
    t_s = t_ns * 1e-9
    first = sums.first_environment
    _put_gravity_torque(s, chain, row, sums.G)
    tau = 2 * (n + s.shared)
    effort = 0.0
    for i in range(n):
        beyond_gravity = row[tau + i] - sums.G[i]
        effort += beyond_gravity * beyond_gravity
    sums.effort += effort
    if first < 0:
        return  # the site has no environment

    for i in range(n):
        sums.held[i] = s.held[i]
        sums.now[i] = s.on_arm[i] - s.held[i]
    # Rows of operators come first. With operators, s.held and s.on_arm contain their torque
    # too.
    if first > 0:
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
    """Compiled control laws that users wrote, for all sites of a fused run.

    Attributes:
        addresses: Address of the machine code of each site's law, shape (N,), see
            `CompiledLaw`; 0: the kernel computes the law.
        rows: Numbers of each law, shape (N, most).
        sent: Numbers that each law sends, shape (N, most).
    """

    addresses: IntArray
    rows: Array
    sent: Array


@leaf
def _compute_torque(
    i: int,
    progress: ProgressRow,
    arrays: SiteArrays,
    chain: RowArray | None,
    laws: LawArrays | None,
) -> None:
    """Runs stage 6, the torque, of a site.

    Args:
        i: Index of the site.
        progress: Progress of the site.
        arrays: Arrays of all sites.
        chain: Rows of the site's chain, or None for the planar arm.
        laws: The users' compiled laws. A law in plain Python was called by the driver before.
    """
    if laws is None:
        torque_stage(arrays.site[i], chain)
        return
    channel = channel_of(arrays.channel, i)
    if laws.addresses[i] == 0 or channel is None:
        torque_stage(arrays.site[i], chain)
        return
    law_stage(
        k=progress.tick,
        t_ns=progress.t_ns,
        address=laws.addresses[i],
        law=laws.rows[i],
        site=arrays.site[i],
        links=arrays.links[i],
        chain=chain,
        channel=channel,
        sent=laws.sent[i],
    )


@leaf
def _record_sent(s: SiteRow, i: int, row: Array, laws: LawArrays | None) -> None:
    """Writes the numbers that the law of a site sends into its record.

    Args:
        s: Row of the site.
        i: Index of the site.
        row: Floats of the record; changed.
        laws: The users' compiled laws, or None.
    """
    if laws is not None:
        first = _first_sent(s)
        for c in range(s.sent):
            row[first + c] = laws.sent[i, c]


@leaf
def sense_site(
    i: int,
    progress: RowArray,
    next_samples: IntArray,
    sent: RecentRecords,
    feed: ReplayedInputs,
    arrays: SiteArrays,
    chain: RowArray | None,
) -> None:
    """Computes the part of a site's next tick before its control law (stages 1 to 5).

    The peers' records arrive as in the recorded run, or without delay if there is no recorded
    run. The remaining arguments are those of `run_until`.

    Args:
        i: Index of the site.
        progress: Progress of the sites.
        next_samples: Next sample of each peer to accept, shape (N, P).
        sent: Last records of the sites.
        feed: Inputs of a recorded run.
        arrays: Arrays of all sites.
        chain: Rows of the site's chain, or None for the planar arm.
    """
    site_progress: ProgressRow = progress[i]
    k = site_progress.tick
    t_ns = site_progress.t_ns
    rate_hz = site_progress.rate_hz
    links = arrays.links[i]
    for p in range(links.shape[0]):
        # The peers of a site are all other sites, in scenario order.
        j = p if p < i else p + 1
        link = LinkArrays(
            state=links[p : p + 1],
            models=arrays.models[i, p],
            dues=arrays.dues[i, p],
            calendar=arrays.calendars[i, p],
            points=arrays.points,
            channel=channel_of(channel_of(arrays.channel, i), p),
        )
        peer: SiteRow = arrays.site[j, 0]
        peer_progress: ProgressRow = progress[j]
        records = RecentRecords(sent.t_ns[j], sent.rows[j])
        if k + 1 < feed.first.shape[2]:
            for n in range(feed.first[i, p, k], feed.first[i, p, k + 1]):
                _accept_record(
                    k=k,
                    rate_hz=rate_hz,
                    peer=peer,
                    sample=feed.samples[n],
                    sent=records,
                    link=link,
                )
        else:
            next_samples[i, p] = _accept_prompt_records(
                k=k,
                t_ns=t_ns,
                rate_hz=rate_hz,
                peer=peer,
                records=peer_progress.tick,
                next_sample=next_samples[i, p],
                sent=records,
                link=link,
            )
        release_sample(k, rate_hz, link)
    _apply_recorded_hand(i, k, arrays.actors[i], feed)
    reference_stages(
        k=k,
        t_ns=t_ns,
        site=arrays.site[i],
        links=links,
        ramps=arrays.ramps[i],
        actors=arrays.actors[i],
        table=arrays.table,
        chain=chain,
    )


@leaf
def finish_site(
    i: int,
    settled_rad: float,
    progress: RowArray,
    sent: RecentRecords,
    peaks: Array,
    sums: RowArray,
    arrays: SiteArrays,
    chain: RowArray | None,
    laws: LawArrays | None,
) -> int:
    """Completes a site's next tick (stages 6 to 8), and adds its record to peaks and sums.

    Args:
        i: Index of the site.
        settled_rad: Errors below this are settled, rad.
        progress: Progress of the sites.
        sent: Last records of the sites; the new record is written.
        peaks: Peaks of the sites, see `run_until`.
        sums: Sums of the sites.
        arrays: Arrays of all sites.
        chain: Rows of the site's chain, or None for the planar arm.
        laws: The users' compiled laws, or None.

    Returns:
        The mode of the site.
    """
    site_progress: ProgressRow = progress[i]
    k = site_progress.tick
    t_ns = site_progress.t_ns
    rate_hz = site_progress.rate_hz
    site = arrays.site[i]
    _compute_torque(i=i, progress=site_progress, arrays=arrays, chain=chain, laws=laws)
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
    site_sums: SumsRow = sums[i]  # one view for both: a view of a row costs time
    _update_peaks(
        row=record,
        t_ns=t_ns,
        settled_rad=settled_rad,
        s=site[0],
        progress=site_progress,
        peaks=peaks[i],
        sums=site_sums,
    )
    _update_sums(
        k=k,
        t_ns=t_ns,
        s=site[0],
        chain=chain,
        actors=arrays.actors[i],
        table=arrays.table,
        row=record,
        sums=site_sums,
    )
    site_progress.tick = k + 1
    if k + 1 < site_progress.ticks:
        site_progress.t_ns = tick_ns(k + 1, rate_hz)
    else:
        site_progress.t_ns = NEVER_NS
    mode: int = site[0].mode
    return mode


@leaf
def run_until(
    last_ns: int,
    settled_rad: float,
    progress: RowArray,
    next_samples: IntArray,
    sent: RecentRecords,
    feed: ReplayedInputs,
    peaks: Array,
    sums: RowArray,
    arrays: SiteArrays,
    chains: RowArray | None,
    laws: LawArrays | None,
) -> None:
    """Steps all sites up to a time, or to the instant at which a site diverges.

    Args:
        last_ns: The last nominal time to step, ns since the epoch.
        settled_rad: `unsettled_ns` is the last time of an |e| of this or more, rad.
        progress: The progress of the sites, shape (N,), PROGRESS_DTYPE.
        next_samples: The next sample of each peer to accept, shape (N, P).
        sent: The last records of the sites.
        feed: The inputs of a recorded run.
        peaks: Per bucket the largest |e| of each joint, then the largest |qd| of each joint,
            then the last q of each joint; -1 where there is no record; shape (N, buckets, 3 n).
        sums: The sums of the sites, shape (N,), see `sums_dtype`.
        arrays: The arrays of all sites, see `stack_site_arrays`.
        chains: Its `chain` once more: as an argument that is None it keeps Numba from compiling
            the leaves of chains.
        laws: The users' compiled laws; None: there are none.
    """
    count = progress.shape[0]
    while True:
        t_ns = NEVER_NS
        for i in range(count):
            site_progress: ProgressRow = progress[i]
            t_ns = min(t_ns, site_progress.t_ns)
        if t_ns > last_ns or t_ns == NEVER_NS:
            return
        for i in range(count):
            site_progress = progress[i]
            if site_progress.t_ns != t_ns:
                continue
            # Two calls, because Numba needs one type of `chain` in each.
            if chains is None:
                sense_site(
                    i=i,
                    progress=progress,
                    next_samples=next_samples,
                    sent=sent,
                    feed=feed,
                    arrays=arrays,
                    chain=None,
                )
                mode = finish_site(
                    i=i,
                    settled_rad=settled_rad,
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
                    next_samples=next_samples,
                    sent=sent,
                    feed=feed,
                    arrays=arrays,
                    chain=chain,
                )
                mode = finish_site(
                    i=i,
                    settled_rad=settled_rad,
                    progress=progress,
                    sent=sent,
                    peaks=peaks,
                    sums=sums,
                    arrays=arrays,
                    chain=chain,
                    laws=laws,
                )
            if mode == _DIVERGED:
                site_progress.diverged_ns = t_ns
                last_ns = t_ns
