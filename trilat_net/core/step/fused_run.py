"""Simulates all arms of an experiment in one compiled call, for studies with many runs.

A parameter sweep needs thousands of runs, but only a few figures from each, so these runs write
no log. They only keep the largest errors and speeds, and a few sums. The simulation clock jumps
from one tick to the next.

Invariant:

- The call uses the same compiled functions as `Site.step`, which computes a single tick.
- Ticks are computed in the same order as in an ordinary run in virtual time: by nominal time,
  and for equal times in the order of the sites in the scenario file.
- The results are bit-identical to those of an ordinary run.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from ..arms import chain_stages, two_link_stages
from ..arms.exogenous import TorqueSourceRows, TorqueTable
from ..arms.task_space import POSITION
from ..links.link import LinkArrays, accept_sample, release_sample
from ..plug.compiled_law import law_stage
from .jit import leaf
from .kernel import act_stages, channel_of, reference_stages, torque_stage
from .row_fields import ProgressRow, SiteRow, SumsRow, row_dtype
from .site_arrays import SiteArrays
from .ticks import BUCKETS_PER_S, Mode, tick_ns
from .vectors import Array, IntArray, Row, RowArray

NEVER_NS = 2**63 - 1
"""Used as the time of the next control period once an arm has completed its run, ns."""

PROGRESS_DTYPE = row_dtype("progress", {})
"""Memory layout of a site's progress, see `ProgressRow`."""


class RecentRecords(NamedTuple):
    """The latest records of a site, in a ring buffer.

    The buffer is long enough that all peers receive a record before it is overwritten. For
    several sites, the arrays have an additional leading axis.

    Attributes:
        t_ns: Times of the records, in ns since the start of the session. The length is a power
            of two.
        rows: Floating-point values of the records, one row per record, see `Layout.columns`.
    """

    t_ns: IntArray
    rows: Array


@cache
def sums_dtype(joints: int) -> np.dtype[np.void]:
    """Returns the NumPy data type of the sums from which the metrics of an arm are computed.

    `SumsRow` lists the sums, for example of squared errors and squared torques.

    Args:
        joints: Number of joints of the arm.
    """
    return row_dtype("sums", {"joints": joints})


_DIVERGED = int(Mode.DIVERGED)


@leaf
def first_sent_column(s: SiteRow) -> int:
    """Returns the first column of a record that holds values sent by the control law."""
    shared_vectors = 5 if s.task else 2
    return 4 * s.joints + shared_vectors * s.shared + s.parameters


class ReplayedInputs(NamedTuple):
    """Inputs of a recorded run of N arms, used to repeat the run in a simulation.

    Each arm receives samples from P peers.

    Attributes:
        first: Index into `samples` of the first arrival, by site, peer and tick. The shape is
            (N, P, K + 1) for K ticks. If K is 0, each sample arrives at the first tick after it
            was sent.
        samples: Ticks in which the peers sent the samples, in order of arrival.
        hands: Actions of the person or program that moves each arm, by site and tick, shape (N,
            K, 1 + 2 m). The columns are the grip firmness from 0 to 1, the m target
            coordinates, and these coordinates extrapolated by one second. If K is 0, nobody
            holds the arms.
        hand_indices: For each site, the index of this person or program among its torque
            sources (operators and environments), or -1 if nobody moves the arm. Shape (N,).
    """

    first: IntArray
    samples: IntArray
    hands: Array
    hand_indices: IntArray


@leaf
def _accept_record(
    k: int, rate_hz: int, peer: SiteRow, sample: int, sent: RecentRecords, link: LinkArrays
) -> None:
    """Delivers a sample from one simulated arm to another, without a network.

    The sample is read from the peer's record. With n joints, m coordinates shared between arms
    and P parameters, the floating-point values of a record are

        q (n), qd (n), q_des (m), qd_des (m), tau (n), tau_x (n), theta_hat (P),
        x (m), xd (m), wrench (m),                                  only in task space
        the values sent by the peer's control law

    Arms that share joint angles send q, qd and tau_x. Arms in task space instead send the pose
    x, its velocity xd and the external wrench on the end effector.

    Args:
        k: Current tick of the receiver.
        rate_hz: Tick rate of the receiver, Hz.
        peer: State of the peer.
        sample: Tick in which the peer sent the sample.
        sent: Latest records of the peer, in a ring buffer: the record of tick i is at index i
            modulo the length.
        link: Arrays of the link from the peer, in which the sample is stored.
    """
    n = peer.joints
    m = peer.shared
    first_sent = first_sent_column(peer)
    q_column = 0
    qd_column = n
    tau_x_column = 3 * n + 2 * m
    if peer.task:
        # x, xd and the wrench are the last vectors before the values sent by the law.
        q_column = first_sent - 3 * m
        qd_column = first_sent - 2 * m
        tau_x_column = first_sent - m
    # The length of the ring is a power of two, so a modulo is a mask of the lower bits.
    ring_mask = sent.t_ns.shape[0] - 1
    row = sent.rows[sample & ring_mask]
    # Each slice starts at its vector and may be longer: `accept_sample` ignores the rest.
    accept_sample(
        k=k,
        rate_hz=rate_hz,
        tick=sample,
        q=row[q_column:],
        qd=row[qd_column:],
        tau_x=row[tau_x_column:],
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
    """Delivers all samples that a peer sent before time t, without network delay.

    The samples are read from the peer's records, and stored until the simulated delay of the
    link has passed.

    Args:
        k: Current tick of the receiver.
        t_ns: Time t of this tick, ns since the epoch (the common start of the session).
        rate_hz: Tick rate of the receiver, Hz.
        peer: State of the peer.
        records: Number of records that the peer has written.
        next_sample: Tick of the peer's first record that has not been accepted yet.
        sent: Latest records of the peer, in a ring buffer: record n is at index n modulo its
            length.
        link: Arrays of the link from the peer.

    Returns:
        The tick of the peer's first record that remains to be accepted.
    """
    # The length of the ring is a power of two, so a modulo is a mask of the lower bits.
    ring_mask = sent.t_ns.shape[0] - 1
    while next_sample < records and sent.t_ns[next_sample & ring_mask] < t_ns:
        _accept_record(
            k=k, rate_hz=rate_hz, peer=peer, sample=next_sample, sent=sent, link=link
        )
        next_sample += 1
    return next_sample


@leaf
def _apply_recorded_hand(
    i: int, k: int, actors: TorqueSourceRows, feed: ReplayedInputs
) -> None:
    """Repeats a live operator's action on an arm in one control period of a recorded run.

    A live operator (hand) is simulated by a spring that pulls the arm to a target. The grip (a
    factor of the force), the target, and the target extrapolated by one second are written to
    the row of the live hand. Nothing happens if there is no live hand, or after the end of the
    recorded run.

    Args:
        i: Index of the site.
        k: Current tick.
        actors: Operators and environments of the site. The fields `a` and `b` of a live hand
            are its target and its target extrapolated by one second, m or rad.
        feed: Inputs of the recorded run. For each site and tick, `feed.hands` contains the
            grip, 0 to 1, the coordinates of the target, and these coordinates extrapolated by
            one second.
    """
    index = feed.hand_indices[i]
    has_live_hand = index >= 0
    if not has_live_hand or k >= feed.hands.shape[1]:
        return
    hand: Row = actors[index]
    coordinates = (feed.hands.shape[2] - 1) // 2
    first_target = 1
    first_target_ahead = first_target + coordinates
    hand.grip = feed.hands[i, k, 0]
    for n in range(min(coordinates, hand.a.shape[0])):
        hand.a[n] = feed.hands[i, k, first_target + n]
        hand.b[n] = feed.hands[i, k, first_target_ahead + n]


@leaf
def update_peaks(
    row: Array,
    t_ns: int,
    settled_rad: float,
    s: SiteRow,
    progress: ProgressRow,
    peaks: Array,
    sums: SumsRow,
) -> None:
    """Updates the peak errors and speeds of an arm, and its error sums, with a new record.

    A simulation of many runs keeps these statistics instead of the records. It keeps one set of
    peaks per time interval (bucket).

    Args:
        row: Floating-point values of the record.
        t_ns: Nominal time of the control period, ns since the start of the session.
        settled_rad: Position error below which the arm counts as settled, rad.
        s: State of the site.
        progress: Progress of the site. Its field `unsettled_ns`, the last time at which an
            error was not below `settled_rad`, is updated.
        peaks: Peaks of the current interval, see `run_until`, shape (3 n,).
        sums: Sums over all records of the site.
    """
    largest_error = 0.0
    joints = peaks.shape[0] // 3
    pose = first_sent_column(s) - 3 * s.shared if s.task else 0
    reference = 2 * s.joints
    # A task may have fewer or more coordinates than the arm has joints. The rest are zeros.
    for i in range(joints):
        e = 0.0
        speed = 0.0
        angle = 0.0
        if i < s.shared:
            e = row[pose + i] - row[reference + i]
            # For an orientation, the difference of rotation vectors is not an error.
            if i >= POSITION and s.task:
                e = s.e[i]
        if i < s.joints:
            speed = abs(row[s.joints + i])
            angle = row[i]
        sums.errors[i] += e * e
        error = abs(e)
        largest_error = max(largest_error, error)
        peaks[i] = max(peaks[i], error)
        peaks[joints + i] = max(peaks[joints + i], speed)
        peaks[2 * joints + i] = angle
    if largest_error >= settled_rad:
        progress.unsettled_ns = t_ns


@leaf
def _advance_bucket(progress: ProgressRow) -> None:
    """Advances to the next time interval (bucket) for which the largest values are kept.

    Called when an arm has completed all control periods of the current interval. Periods are
    counted in fractions of the interval, because an interval need not be a multiple of a
    period.

    Args:
        progress: Progress of the site; updated in place.
    """
    progress.part += BUCKETS_PER_S
    while progress.part >= progress.rate_hz:
        progress.part -= progress.rate_hz
        progress.bucket += 1


@leaf
def _put_gravity_torque(s: SiteRow, chain: RowArray | None, row: Array, torque: Array) -> None:
    """Computes the gravity torque of an arm in the pose of a given record.

    Args:
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        row: Floating-point values of the record, which start with the joint angles.
        torque: Output array for the torque, shape (n,), N m.
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
    """Computes the torque of operators and environments for the motion in a given record.

    Args:
        t_s: Time since the start of the session, s.
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        row: Floating-point values of the record, which start with joint angles and velocities.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
        sampled: 1 to select those whose torque is constant during a control period, 0 to select
            all others.
        torque: Output array for the torque, shape (n,), N m.
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
def update_sums(
    k: int,
    t_ns: int,
    s: SiteRow,
    chain: RowArray | None,
    environments: TorqueSourceRows,
    table: TorqueTable,
    row: Array,
    sums: SumsRow,
) -> None:
    """Adds one control period to the sums of an arm's motor effort and its environments' work.

    The effort is the sum of the squares of control torque minus gravity torque. The work in a
    control period is the torque times the change in the joint angles q. For a torque that
    varies during the period, the mean of its values at both ends is used (trapezoidal rule). A
    torque that is constant during the period is added to this mean.

    Args:
        k: Tick to add.
        t_ns: Nominal time of the tick, ns since the start of the session.
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        environments: Torque sources of the arm that are environments, not operators.
        table: Tables of all operators and environments, for example of recorded torques.
        row: Floating-point values of the record of this tick.
        sums: Sums over all records of the site; updated in place.
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
    # With operators, s.held and s.on_arm contain their torque too.
    if first > 0:
        _put_source_torque(
            t_s=t_s,
            s=s,
            chain=chain,
            row=row,
            actors=environments,
            table=table,
            sampled=0,
            torque=sums.now,
        )
        _put_source_torque(
            t_s=t_s,
            s=s,
            chain=chain,
            row=row,
            actors=environments,
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
    """Arrays through which the compiled simulation of N arms calls users' control laws.

    Attributes:
        addresses: Address of the machine code of each site's law, shape (N,), see
            `CompiledLaw`. 0 if the site uses a built-in law.
        rows: Gains and memory of each law, one row per site, padded to equal length.
        sent: Values that each law sends to other sites, one row per site, padded to equal
            length.
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
    """Computes the torque of an arm's control law in the current tick.

    `torque_stage` computes the torque of built-in laws, and does nothing for user-written laws.
    A compiled user law is called by `law_stage`. A user law in plain Python has already been
    called by the driver of the simulation.

    Args:
        i: Index of the site.
        progress: Progress of the site, including the tick and its nominal time.
        arrays: Arrays of all sites.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        laws: Compiled user laws, or None if no site has one. The address is 0 for a site
            without a compiled law.
    """
    if laws is None:
        torque_stage(arrays.site[i], chain)
        return
    # The channel contains the values that other sites' laws send to this law. A site with a
    # compiled law always has a channel.
    channel = channel_of(arrays.channel, i)
    is_compiled = laws.addresses[i] != 0
    if not is_compiled or channel is None:
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
    """Writes the values that a control law sends to other arms to the record of its arm.

    The other arms in the simulation read the values from this record.

    Args:
        s: State of the site.
        i: Index of the site.
        row: Floating-point values of the record; updated in place.
        laws: Compiled user-written control laws, or None if there are none.
    """
    if laws is not None:
        first = first_sent_column(s)
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
    """Computes the part of an arm's next control period that precedes its control law.

    Accepts the messages of the other arms, then computes the reference, the errors and the
    parameter estimate. Messages arrive as they did in the recorded run, or without delay if no
    run is being repeated.

    Args:
        i: Index of the site.
        progress: State of the simulation, one row per site, see `ProgressRow`.
        next_samples: Number of the next sample to accept, for each of N sites and P peers,
            shape (N, P).
        sent: Latest records of the sites, from which the samples are taken.
        feed: Inputs of the recorded run.
        arrays: Arrays of all sites.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
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
    """Completes a control period of one arm, which `sense_site` has begun.

    The control law computes the torque, the arm moves on to the next period, and the results
    are added to the statistics of the run.

    Args:
        i: Index of the site.
        settled_rad: Position error below which the arm counts as settled, rad.
        progress: State of the simulation, one row per site, see `ProgressRow`.
        sent: Latest records of the sites; the new record is written here.
        peaks: Largest errors and speeds so far, see `run_until`; updated in place.
        sums: Sums over the records, see `SumsRow`; updated in place.
        arrays: Arrays of all sites; updated in place.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        laws: Compiled user-written control laws, or None if there are none.

    Returns:
        The mode of the site, a member of `Mode`.
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
    site_sums: SumsRow = sums[i]  # one view for both uses, because creating a view takes time
    update_peaks(
        row=record,
        t_ns=t_ns,
        settled_rad=settled_rad,
        s=site[0],
        progress=site_progress,
        peaks=peaks[i, site_progress.bucket],
        sums=site_sums,
    )
    _advance_bucket(site_progress)
    # Rows of operators come before those of environments.
    first_environment = max(site_sums.first_environment, 0)
    update_sums(
        k=k,
        t_ns=t_ns,
        s=site[0],
        chain=chain,
        environments=arrays.actors[i, first_environment:],
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
    """Simulates all arms of an experiment until a given time, or until an arm diverges.

    The control periods of all arms are interleaved in chronological order, because each arm
    receives the states of the others.

    Args:
        last_ns: Time of the last control period to compute, ns since the start of the session.
        settled_rad: Position error below which an arm counts as settled, rad. The progress of a
            site stores when this error was last exceeded.
        progress: Progress of the sites, shape (N,), PROGRESS_DTYPE.
        next_samples: Number of the next sample to accept, for each of N sites and P peers,
            shape (N, P).
        sent: Latest records of the sites, from which the samples are taken.
        feed: Inputs of the recorded run to repeat.
        peaks: For each time interval (bucket), the largest position error |e| of each joint,
            then the largest speed |qd| of each joint, then the last angle q of each joint, or
            -1 if the interval contains no record. Shape (N, buckets, 3 n).
        sums: Sums over the records of the sites, shape (N,), see `sums_dtype`.
        arrays: Arrays of all sites, see `SiteArrays.stack`.
        chains: The same array as the field `chain` of `arrays`. If None, Numba does not compile
            the functions for chains of joints.
        laws: Compiled user-written control laws, or None if there are none.
    """
    count = progress.shape[0]
    while True:
        # The time of the next control period of any site.
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
