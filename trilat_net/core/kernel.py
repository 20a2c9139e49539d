"""One tick of one site, compiled: its eight stages in order, and the integrator of the arm.

Invariant: one call computes a whole tick, and every stage is a leaf that the fused virtual-time
run calls as well. The arm advances one period by the classical Runge-Kutta method of fourth
order: each of its stages evaluates operators and environments, and what is held over the period
is constant.
"""

from math import isfinite

from . import chain_stages, control, two_link_stages
from .dominance import update_reference, update_stale_mode
from .exogenous import TorqueSourceRows, TorqueTable
from .jit import leaf
from .link import ChannelArrays, LinkArrays, accept_sample, release_sample, release_tick
from .resting import add_rest_torque, advance_rest, limit_torque_rate, rests, rests_by_law
from .safeguards import is_torque_finite, limit_reference, return_to_law
from .session_life import is_law_returning, latch_mode, update_session_life
from .site_arrays import SiteArrays, TickBuffers
from .site_setup import Law, Scheme, StaleAction
from .task_space import POSE, update_orientation_reference
from .ticks import LifeReason, Mode, tick_ns
from .vectors import Array, IntArray, Points, Row, RowArray, Vector, put

_DIVERGED = int(Mode.DIVERGED)
_FAULT = int(Mode.FAULT)
_NOT_FINITE = int(LifeReason.NOT_FINITE)
_GLIDE = int(StaleAction.GLIDE)
_DIGITAL = int(Scheme.DIGITAL)
_ADAPTIVE = int(Law.ADAPTIVE)
_OWN = int(Law.USER)


@leaf
def _place_arm(s: Row, chain: RowArray | None, links: RowArray, refers: bool) -> None:
    """Places the joints of a chain; if it refers to its peers anew, the orientation of its
    reference too.
    """
    if chain is None:
        return
    chain_stages.place_chain(s, chain)
    if refers and s.task and s.shared == POSE:
        update_orientation_reference(s, links)


@leaf
def _update_errors(s: Row, chain: RowArray | None) -> None:
    """Stage 4: errors, r, and what the law needs of the arm's dynamics."""
    if chain is None:
        two_link_stages.update_errors(s)
    else:
        chain_stages.update_errors(s, chain)


@leaf
def _advance_estimate(s: Row, chain: RowArray | None, gain_s: float, Yr: Vector) -> None:
    if chain is None:
        two_link_stages.advance_estimate(s, gain_s, Yr)
    else:
        chain_stages.advance_estimate(s, gain_s, Yr)


@leaf
def _adapts(s: Row) -> bool:
    """True in a mode in which estimates follow their law."""
    return bool(s.mode != _DIVERGED and (rests_by_law(s) or not rests(s)))


@leaf
def _update_estimate(k: int, s: Row, chain: RowArray | None) -> None:
    """Stage 5: the trapezoid rule for Eq. (15), explicit since Y' r does not depend on the
    estimate.
    """
    if s.scheme == _DIGITAL or k == s.first or s.law != _ADAPTIVE or not _adapts(s):
        return
    for p in range(s.Yr.shape[0]):
        s.Yr_before[p] += s.Yr[p]
    _advance_estimate(s, chain, 0.5 / s.rate_hz, s.Yr_before)


@leaf
def torque_stage(site: RowArray, chain: RowArray | None) -> None:
    """Stage 6 of a tick: the torque of the site's law; a user's law runs in Python instead."""
    s: Row = site[0]
    if s.law == _OWN:
        return
    if chain is None:
        two_link_stages.update_torque(s)
    else:
        chain_stages.update_torque(s, chain)


@leaf
def _put_known_gravity(s: Row, chain: RowArray | None, torque: Array) -> None:
    """Writes the torque of gravity as far as the law knows it, or has learnt it."""
    learns = s.law == _ADAPTIVE or (s.law == _OWN and s.theta_known == 0)
    theta = s.theta_hat if learns else s.known
    if chain is None:
        two_link_stages.put_gravity(s, theta, torque)
    else:
        chain_stages.put_gravity(s, chain, theta, torque)


@leaf
def _guard_torque(k: int, t_ns: int, s: Row, chain: RowArray | None) -> None:
    """Ends stage 6: the torque of an arm at rest or on its way back, and none that changes too
    fast.
    """
    resting = False
    if s.on_stale == _GLIDE:
        if s.reason != _NOT_FINITE and s.mode != _DIVERGED and not is_torque_finite(s):
            latch_mode(t_ns, s, _FAULT, _NOT_FINITE)
        resting = rests(s)
        if resting:
            if not rests_by_law(s):
                _put_known_gravity(s, chain, s.tau)
            add_rest_torque(k, t_ns, s)
        elif is_law_returning(t_ns, s):
            return_to_law(t_ns, s)
    limit_torque_rate(s)
    if resting:
        advance_rest(s)


@leaf
def _write_record(s: Row, row: Array) -> None:
    """Writes the record's floats, see `Layout.columns`; one that is not finite diverges the run
    and is 0.
    """
    n = s.joints
    m = s.shared
    P = s.parameters
    at = 2 * n
    for i in range(n):
        row[i] = s.q[i]
        row[n + i] = s.qd[i]
    for i in range(m):
        row[at + i] = s.q_des[i]
        row[at + m + i] = s.qd_des[i]
    at += 2 * m
    for i in range(n):
        row[at + i] = s.tau[i]
        row[at + n + i] = 0.0 - s.on_arm[i]  # 0.0, never -0.0, where nothing acts
    at += 2 * n
    for p in range(P):
        row[at + p] = s.theta_hat[p]
    at += P
    if s.task:
        for i in range(m):
            row[at + i] = s.x[i]
            row[at + m + i] = s.xd[i]
            row[at + 2 * m + i] = s.wrench[i]
        at += 3 * m
    for i in range(at):
        if not isfinite(row[i]):
            row[i] = 0.0
            s.mode = _DIVERGED


@leaf
def _update_external_torque(
    t_s: float, s: Row, chain: RowArray | None, actors: TorqueSourceRows, table: TorqueTable
) -> None:
    """Writes the torque of operators and environments; a law may know that of its own tick."""
    if chain is None:
        two_link_stages.update_external_torque(t_s, s, actors, table)
    else:
        chain_stages.update_external_torque(
            t_s=t_s, s=s, chain=chain, actors=actors, table=table
        )


@leaf
def _advance_arm(
    t_s: float,
    h_s: float,
    s: Row,
    chain: RowArray | None,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> bool:
    if chain is None:
        return two_link_stages.advance_arm(t_s=t_s, h_s=h_s, s=s, actors=actors, table=table)
    return chain_stages.advance_arm(
        t_s=t_s, h_s=h_s, s=s, chain=chain, actors=actors, table=table
    )


@leaf
def _advance(
    k: int,
    t_ns: int,
    s: Row,
    chain: RowArray | None,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> None:
    """Stage 8: advances the state from t_k to t_{k+1} and keeps what tick k+1 needs of tick k.

    Constant over the period are the control torque at its middle, and the sampled sources.
    """
    h_s = 1.0 / s.rate_hz
    adapts = _adapts(s)  # of this tick: whether an arm at rest is fast depends on its speed
    put(s.q_before, s.q)
    if s.external == 0:
        for i in range(s.u.shape[0]):
            torque = s.tau[i]
            if s.scheme != _DIGITAL and k > s.first:
                torque = control.limit_torque(
                    1.5 * s.tau[i] - 0.5 * s.tau_before[i], s.tau_limit[i]
                )
            s.u[i] = torque + s.held[i]
        if not _advance_arm(
            t_s=t_ns * 1e-9, h_s=h_s, s=s, chain=chain, actors=actors, table=table
        ):
            s.mode = _DIVERGED
    if s.scheme == _DIGITAL and s.law == _ADAPTIVE and adapts and s.mode != _DIVERGED:
        _advance_estimate(s, chain, h_s, s.Yr)
    for i in range(s.tau.shape[0]):
        s.tau_before[i] = s.tau[i]
    for p in range(s.Yr.shape[0]):
        s.Yr_before[p] = s.Yr[p] if adapts and s.mode != _DIVERGED else 0.0


@leaf
def channel_of(channel: ChannelArrays | None, peer: int) -> ChannelArrays | None:
    """Returns what one peer sends, of what all peers do; of stacked arrays, what the peers of
    one site do.
    """
    if channel is None:
        return None
    return ChannelArrays(channel.waiting[peer], channel.received[peer], channel.columns[peer])


@leaf
def link_arrays(arrays: SiteArrays, peer: int) -> LinkArrays:
    """Returns the arrays of the link from one peer."""
    return LinkArrays(
        state=arrays.links[peer : peer + 1],
        models=arrays.models[peer],
        dues=arrays.dues[peer],
        calendar=arrays.calendars[peer],
        points=arrays.points,
        channel=channel_of(arrays.channel, peer),
    )


@leaf
def find_release(peer: int, tick: int, arrays: SiteArrays) -> int:
    """Returns the site's tick that releases a peer's sample, or LOST; see `release_tick`."""
    return release_tick(tick, arrays.site[0].rate_hz, link_arrays(arrays, peer))


@leaf
def accept_stage(k: int, count: int, arrays: SiteArrays, buffers: TickBuffers) -> None:
    """Stage 1: files the first `count` arrivals in their links."""
    rate_hz = arrays.site[0].rate_hz
    for n in range(count):
        arrival: Row = buffers.arrivals[n]
        link = link_arrays(arrays, arrival.peer)
        forces = buffers.forces[n]
        sent = buffers.sent[n]
        accept_sample(
            k=k,
            rate_hz=rate_hz,
            tick=arrival.tick,
            q=arrival.q,
            qd=arrival.qd,
            tau_x=forces,
            sent=sent,
            link=link,
        )


@leaf
def reference_stages(
    k: int,
    t_ns: int,
    site: RowArray,
    links: RowArray,
    ramps: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
    chain: RowArray | None,
) -> None:
    """Stages 3 to 5 of a tick and its external torque, with the samples that it releases in
    use.
    """
    s: Row = site[0]
    update_reference(t_ns, s, links, ramps)  # 3 reference
    _place_arm(s, chain, links, True)
    if s.on_stale == _GLIDE:
        update_session_life(t_ns, s, links)
    else:
        update_stale_mode(t_ns, s, links)
    if not rests(s):
        limit_reference(k, s)
    _update_errors(s, chain)  # 4 errors
    _update_estimate(k, s, chain)  # 5 estimate
    _update_external_torque(t_s=t_ns * 1e-9, s=s, chain=chain, actors=actors, table=table)


@leaf
def sense_stages(
    k: int, t_ns: int, count: int, arrays: SiteArrays, buffers: TickBuffers
) -> None:
    """Stages 1 to 5 of a tick: its arrivals, the reference, the errors, the estimate, the
    external torque.
    """
    rate_hz = arrays.site[0].rate_hz
    for missed in range(k - arrays.site[0].skipped, k):  # ticks that the site did not make
        for j in range(arrays.links.shape[0]):
            release_sample(missed, rate_hz, link_arrays(arrays, j))
    accept_stage(k, count, arrays, buffers)
    for j in range(arrays.links.shape[0]):  # 2 recall
        release_sample(k, rate_hz, link_arrays(arrays, j))
    a = arrays
    reference_stages(
        k=k,
        t_ns=t_ns,
        site=a.site,
        links=a.links,
        ramps=a.ramps,
        actors=a.actors,
        table=a.table,
        chain=a.chain,
    )


@leaf
def act_stages(
    k: int,
    t_ns: int,
    site: RowArray,
    actors: TorqueSourceRows,
    table: TorqueTable,
    chain: RowArray | None,
    record: Array,
) -> None:
    """Stages 7 and 8 of a tick, with the law's torque in place: the record, and the step to the
    next tick.
    """
    s: Row = site[0]
    _guard_torque(k, t_ns, s, chain)
    for i in range(s.joints):
        if s.on_stale != _GLIDE and not abs(s.qd[i]) <= s.qd_limit[i]:
            s.mode = _DIVERGED
    _write_record(s, record)  # 7 emit
    if s.mode != _DIVERGED:  # 8 advance
        _advance(k=k, t_ns=t_ns, s=s, chain=chain, actors=actors, table=table)


@leaf
def site_tick(
    k: int,
    t_ns: int,
    count: int,
    site: RowArray,
    links: RowArray,
    models: RowArray,
    dues: IntArray,
    calendars: RowArray,
    points: Points,
    ramps: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
    chain: RowArray | None,
    channel: ChannelArrays | None,
    arrivals: RowArray,
    forces: Array,
    sent: Array,
    record: Array,
) -> None:
    """Computes tick k of one site at t_ns, ns since the epoch, with its first `count` arrivals.

    It takes the fields of `SiteArrays` and `TickBuffers` one by one: passed from Python as
    tuples they would cost more than a microsecond.
    """
    arrays = SiteArrays(
        site=site,
        links=links,
        models=models,
        dues=dues,
        calendars=calendars,
        points=points,
        ramps=ramps,
        actors=actors,
        table=table,
        chain=chain,
        channel=channel,
    )
    sense_stages(
        k=k,
        t_ns=t_ns,
        count=count,
        arrays=arrays,
        buffers=TickBuffers(arrivals, forces, sent, record),
    )
    torque_stage(site, chain)  # 6 torque
    act_stages(
        k=k, t_ns=t_ns, site=site, actors=actors, table=table, chain=chain, record=record
    )


@leaf
def resume_stages(k: int, arrays: SiteArrays) -> None:
    """Repeats the end of tick k (stages 4 and 8) from a state that was filled in from its
    record.
    """
    s: Row = arrays.site[0]
    t_ns = tick_ns(k, s.rate_hz)
    _place_arm(s, arrays.chain, arrays.links, False)
    _update_errors(s, arrays.chain)
    _update_external_torque(
        t_s=t_ns * 1e-9, s=s, chain=arrays.chain, actors=arrays.actors, table=arrays.table
    )
    if s.mode != _DIVERGED:
        _advance(
            k=k, t_ns=t_ns, s=s, chain=arrays.chain, actors=arrays.actors, table=arrays.table
        )
