"""Computes one control period (tick) of a site in compiled code.

A tick has eight stages, executed in this order:

- 1 accept: store the samples that arrived from other sites.
- 2 release: take the newest sample of each site whose simulated delay has passed.
- 3 reference: compute the position that the arm should follow.
- 4 errors: compute the tracking errors.
- 5 estimate: update the estimate of the arm's dynamic parameters.
- 6 torque: compute the torque of the control law.
- 7 emit: write the record, which contains the results of the tick.
- 8 advance: simulate the arm until the next tick.

The stages read and write the state of a site, stored as a row of type `SiteRow`. For an arm
that is a chain of joints, `chain` contains the joint data; for the planar two-link arm it is
None.

Invariant:
    - Live sites and the fused run (a simulation of all sites in one compiled loop) call the
      same functions for the stages.
    - Stage 8 integrates with the classical fourth-order Runge-Kutta method. Motor torque is
      constant during the tick. The torques of operators and environments are recomputed at each
      of the four evaluations, unless they are marked as sampled.
"""

from math import isfinite

from ..arms import chain_stages, two_link_stages
from ..arms.exogenous import TorqueSourceRows, TorqueTable
from ..arms.task_space import POSE, update_orientation_reference
from ..life.resting import add_rest_torque, advance_rest, limit_torque_rate, rests, rests_by_law
from ..life.safeguards import is_torque_finite, limit_reference, return_to_law
from ..life.session_life import is_law_returning, latch_mode, update_session_life
from ..links.dominance import update_reference, update_stale_mode
from ..links.link import ChannelArrays, LinkArrays, accept_sample, release_sample, release_tick
from . import control
from .jit import leaf
from .row_fields import ArrivalRow, SiteRow
from .site_arrays import SiteArrays, TickBuffers
from .site_setup import Law, StaleAction
from .ticks import LifeReason, Mode, tick_ns
from .vectors import Array, IntArray, Points, RowArray, Vector

_DIVERGED = int(Mode.DIVERGED)
_FAULT = int(Mode.FAULT)
_NOT_FINITE = int(LifeReason.NOT_FINITE)
_GLIDE = int(StaleAction.GLIDE)
_ADAPTIVE = int(Law.ADAPTIVE)
_USER = int(Law.USER)


@leaf
def _place_arm(
    s: SiteRow, chain: RowArray | None, links: RowArray, updates_reference: bool
) -> None:
    """Computes the positions of an arm's links, which the tracking errors require.

    If `updates_reference` is True, this also computes the orientation that the end effector
    should follow. The planar arm needs neither, because its equations contain the link
    positions.

    Args:
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        links: State of each link from another site, one row per link.
        updates_reference: True in a tick, False if the reference was restored from a record.
    """
    if chain is None:
        return
    chain_stages.place_chain(s, chain)
    if updates_reference and s.task and s.shared == POSE:
        update_orientation_reference(s, links)


@leaf
def _update_errors(s: SiteRow, chain: RowArray | None) -> None:
    """Computes the tracking errors e, ed and r of an arm, and the dynamics that its law needs.

    e is the position minus the reference, ed its derivative, and r the filtered error. This is
    stage 4 of a control period.

    Args:
        s: State of the site; updated in place.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
    """
    if chain is None:
        two_link_stages.update_errors(s)
    else:
        chain_stages.update_errors(s, chain)


@leaf
def _advance_estimate(s: SiteRow, chain: RowArray | None, gain_s: float, Yr: Vector) -> None:
    """Advances the estimated parameters to theta_hat - gain_s Gamma Yr, within their bounds.

    Gamma is the adaptation gain, and Yr is the product Y' r of the regressor and the filtered
    error.

    Args:
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        gain_s: Duration of the step, s.
        Yr: Y' r of Eq. (15), one entry per parameter.
    """
    if chain is None:
        two_link_stages.advance_estimate(s, gain_s, Yr)
    else:
        chain_stages.advance_estimate(s, gain_s, Yr)


@leaf
def adapts(s: SiteRow) -> bool:
    """Returns True if the estimate of the arm's parameters may change in the current mode.

    The estimate is frozen in the mode DIVERGED. While the arm is at rest, it changes only if
    the arm is held by the torque of the control law; see `rests_by_law`.
    """
    return bool(s.mode != _DIVERGED and (rests_by_law(s) or not rests(s)))


@leaf
def _update_estimate(k: int, s: SiteRow, chain: RowArray | None) -> None:
    """Updates the estimate of the arm's dynamic parameters (stage 5 of a tick).

    The estimate theta obeys Eq. (15) of the paper, dtheta/dt = -Gamma Y' r, where Gamma is the
    matrix of adaptation gains, Y the regressor and r the filtered error. The trapezoidal rule
    with period h gives

        theta_k = theta_{k-1} - h/2 Gamma (Y'r_{k-1} + Y'r_k)

    The rule is explicit, because Y' r does not depend on the estimate. The scheme `digital`
    instead advances the estimate with the Euler method at the end of the tick, in stage 8.

    Args:
        k: Current tick.
        s: State of the site. `Yr` is Y' r of tick k. `Yr_before` is that of tick k - 1, and is
            overwritten with the sum of both until stage 8 sets it again.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
    """
    # `adapts` is evaluated last, because it is the expensive condition.
    if updates_estimate(k, s) and adapts(s):
        sum_trapezoid(s)
        _advance_estimate(s, chain, 0.5 / s.rate_hz, s.Yr_before)


@leaf
def updates_estimate(k: int, s: SiteRow) -> bool:
    """Returns True if an adaptive law integrates its parameter estimate in this control period.

    The estimate is not integrated in the first period of a site. Under the scheme `digital`, it
    is integrated elsewhere, at the end of the period. Whether the mode permits adaptation is
    checked by `adapts`, not here.
    """
    return bool(not s.digital and k != s.first and s.law == _ADAPTIVE)


@leaf
def sum_trapezoid(s: SiteRow) -> None:
    """Adds the adaptation rates Y' r of the previous and the current control period.

    The parameter estimate is integrated with the trapezoidal rule, which needs this sum. The
    sum is stored in `Yr_before`; see `_update_estimate`.
    """
    for p in range(s.Yr.shape[0]):
        s.Yr_before[p] += s.Yr[p]


@leaf
def torque_stage(site: RowArray, chain: RowArray | None) -> None:
    """Computes the torque of a control law that is built into the compiled simulation.

    Does nothing for a law written as a Python class, which is called by `law_stage`.

    Args:
        site: State of the site, shape (1,). The torque is written to it.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
    """
    s: SiteRow = site[0]
    if s.law == _USER:
        return
    if chain is None:
        two_link_stages.update_torque(s)
    else:
        chain_stages.update_torque(s, chain)


@leaf
def _put_known_gravity(s: SiteRow, chain: RowArray | None, torque: Array) -> None:
    """Computes the torque that holds the arm, using its known or estimated parameters.

    This torque holds an arm at rest if the control law cannot. The estimate is used for
    adaptive laws, and for arms with unknown parameters.

    Args:
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        torque: Output array for the torque, shape (n,), N m.
    """
    is_model_unknown = s.law == _USER and s.theta_known == 0
    uses_estimate = s.law == _ADAPTIVE or is_model_unknown
    theta = s.theta_hat if uses_estimate else s.known
    if chain is None:
        two_link_stages.put_gravity(s, theta, torque)
    else:
        chain_stages.put_gravity(s, chain, theta, torque)


@leaf
def guard_torque(k: int, t_ns: int, s: SiteRow, chain: RowArray | None) -> None:
    """Converts the torque of the control law to the torque sent to the motors.

    Called after the law has written its torque to `tau`. The rate of change is always limited.
    Under the rule `glide` (where an arm comes to rest while another arm is silent), the torque
    is modified first in the following cases:

    - The torque is not finite: the mode changes to FAULT, in which the arm comes to rest.
    - The arm is at rest or coming to rest: damping and an integral term are added, see
      `resting`. If the law cannot hold the arm, its torque is replaced with the gravity torque.
    - The arm has just left rest: the torque is blended from the rest torque to the law's
      torque.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the epoch (the common start of the session).
        s: State of the site; updated in place.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
    """
    resting = False
    if s.on_stale == _GLIDE:
        # A site with the reason NOT_FINITE is already in FAULT, and does not enter it again.
        if s.reason != _NOT_FINITE and s.mode != _DIVERGED and not is_torque_finite(s):
            latch_mode(t_ns, s, _FAULT, _NOT_FINITE)
        # The mode may just have changed to FAULT, in which the arm rests.
        resting = rests(s)
        if resting:
            if not rests_by_law(s):
                _put_known_gravity(s, chain, s.tau)
            add_rest_torque(k, t_ns, s)
        elif is_law_returning(t_ns, s):
            return_to_law(t_ns, s)
    limit_torque_rate(s)
    if resting:
        # The integral term must not grow while a limit cuts off the torque.
        advance_rest(s)


@leaf
def _write_record(s: SiteRow, row: Array) -> None:
    """Writes the results of a control period as a single vector of floats, for the log.

    The order is that of `Layout.columns`: motion, reference, torques, parameter estimate, and,
    if arms follow each other's end effectors, the motion of the end effector. If a value is not
    finite, it is replaced with 0, and the arm enters the mode DIVERGED.

    Args:
        s: State of the site.
        row: Output array for the values.
    """
    joints = s.joints
    shared = s.shared
    parameters = s.parameters
    # `first` is the index of the first value in the next group.
    first = 2 * joints
    for i in range(joints):
        row[i] = s.q[i]
        row[joints + i] = s.qd[i]
    for i in range(shared):
        row[first + i] = s.q_des[i]
        row[first + shared + i] = s.qd_des[i]
    first += 2 * shared
    for i in range(joints):
        row[first + i] = s.tau[i]
        # A subtraction instead of a negation, so that the record contains 0.0 and not -0.0
        # where nothing acts.
        row[first + joints + i] = 0.0 - s.on_arm[i]
    first += 2 * joints
    for p in range(parameters):
        row[first + p] = s.theta_hat[p]
    first += parameters
    if s.task:
        for i in range(shared):
            row[first + i] = s.x[i]
            row[first + shared + i] = s.xd[i]
            row[first + 2 * shared + i] = s.wrench[i]
        first += 3 * shared
    for i in range(first):
        if not isfinite(row[i]):
            row[i] = 0.0
            s.mode = _DIVERGED


@leaf
def _update_external_torque(
    t_s: float, s: SiteRow, chain: RowArray | None, actors: TorqueSourceRows, table: TorqueTable
) -> None:
    """Computes the torque that operators and environments exert on the arm at a given time.

    Args:
        t_s: Time since the start of the session, s.
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        actors: Operators and environments of the arm, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
    """
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
    s: SiteRow,
    chain: RowArray | None,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> bool:
    """Simulates the joint angles and velocities of the arm over one control period.

    Args:
        t_s: Time at the start of the period, s since the start of the session.
        h_s: Length of the period, s.
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        actors: Operators and environments of the arm, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.

    Returns:
        True on success. False if the result is not finite, in which case nothing is changed.
    """
    if chain is None:
        return two_link_stages.advance_arm(t_s=t_s, h_s=h_s, s=s, actors=actors, table=table)
    return chain_stages.advance_arm(
        t_s=t_s, h_s=h_s, s=s, chain=chain, actors=actors, table=table
    )


@leaf
def hold_motor_torque(k: int, s: SiteRow) -> None:
    """Computes the motor torque u that is held constant during the control period.

    The constant torque that best represents the period is the torque at its midpoint,
    extrapolated from this tick and the previous one:

        u = 1.5 tau_k - 0.5 tau_{k-1}, within the limit

    At the first tick, and under the scheme `digital`, u = tau_k.

    Args:
        k: Current tick.
        s: State of the site. `u` and `q_before` are written.
    """
    for i in range(s.q.shape[0]):
        s.q_before[i] = s.q[i]
    if s.external != 0:
        return
    for i in range(s.u.shape[0]):
        torque = s.tau[i]
        if not s.digital and k > s.first:
            extrapolated = 1.5 * s.tau[i] - 0.5 * s.tau_before[i]
            torque = control.limit_torque(extrapolated, s.tau_limit[i])
        s.u[i] = torque + s.held[i]


@leaf
def finish_advance(s: SiteRow, chain: RowArray | None, is_adapting: bool) -> None:
    """Stores the torque and the adaptation rate Y' r of this tick for the next tick.

    Y' r drives the parameter estimate; see `_update_estimate`. Under the scheme `digital`, this
    function also advances the estimate itself.

    Args:
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        is_adapting: Result of `adapts` before the arm moved.
    """
    h_s = 1.0 / s.rate_hz
    if s.digital and s.law == _ADAPTIVE and is_adapting and s.mode != _DIVERGED:
        _advance_estimate(s, chain, h_s, s.Yr)
    for i in range(s.tau.shape[0]):
        s.tau_before[i] = s.tau[i]
    for p in range(s.Yr.shape[0]):
        s.Yr_before[p] = s.Yr[p] if is_adapting and s.mode != _DIVERGED else 0.0


@leaf
def _advance(
    k: int,
    t_ns: int,
    s: SiteRow,
    chain: RowArray | None,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> None:
    """Simulates the arm until the next control period, and stores what that period needs.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the start of the session.
        s: State of the site.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        actors: Operators and environments of the arm, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
    """
    h_s = 1.0 / s.rate_hz
    # Evaluate this before the arm moves: whether an arm at rest is fast depends on its speed.
    is_adapting = adapts(s)
    hold_motor_torque(k, s)
    if s.external == 0:
        is_finite = _advance_arm(
            t_s=t_ns * 1e-9, h_s=h_s, s=s, chain=chain, actors=actors, table=table
        )
        if not is_finite:
            s.mode = _DIVERGED
    finish_advance(s, chain, is_adapting)


@leaf
def channel_of(channel: ChannelArrays | None, peer: int) -> ChannelArrays | None:
    """Selects the arrays for the values sent by the control law of one peer.

    Some laws send values other than the motion of the arm, for example energies.

    Args:
        channel: Arrays of all peers of a site, or of all sites of a simulation. None if this
            site's control law reads no such values.
        peer: Index of the peer, or of the site.

    Returns:
        Views of the arrays, or None if `channel` is None.
    """
    if channel is None:
        return None
    return ChannelArrays(channel.waiting[peer], channel.received[peer], channel.columns[peer])


@leaf
def _link_arrays(arrays: SiteArrays, peer: int) -> LinkArrays:
    """Returns the arrays of the network link from one peer, as views without copying.

    The arrays are described in `LinkArrays`. Nearly all of them are rows of this arm's arrays,
    one row per peer. `state` is a slice of shape (1,), because it must remain an array.
    `points` is the table of all links, in which each link has its own rows.

    Args:
        arrays: Arrays of the site.
        peer: Index of the peer, in scenario order.
    """
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
    """Finds the control period of this arm in which a peer's sample is first used.

    Args:
        peer: Index of the peer.
        tick: Tick in which the peer sent the sample.
        arrays: Arrays of the site.

    Returns:
        The tick of this site if the sample arrives in time. LOST if the link drops the sample,
        or if the sample is too old.
    """
    return release_tick(tick, arrays.site[0].rate_hz, _link_arrays(arrays, peer))


@leaf
def accept_stage(k: int, count: int, arrays: SiteArrays, buffers: TickBuffers) -> None:
    """Stores newly arrived messages until their simulated network delay has passed.

    The ring buffers in which messages wait are called calendars.

    Args:
        k: Current tick.
        count: Number of samples that arrived since the previous tick.
        arrays: Arrays of the site; updated in place.
        buffers: Buffers that contain the samples.
    """
    rate_hz = arrays.site[0].rate_hz
    for n in range(count):
        arrival: ArrivalRow = buffers.arrivals[n]
        accept_sample(
            k=k,
            rate_hz=rate_hz,
            tick=arrival.tick,
            q=arrival.q,
            qd=arrival.qd,
            tau_x=buffers.forces[n],
            sent=buffers.sent[n],
            link=_link_arrays(arrays, arrival.peer),
        )


@leaf
def guard_reference(k: int, t_ns: int, s: SiteRow, links: RowArray) -> None:
    """Limits the speed of the reference, and stops it while peers are silent.

    The reference stops if no messages have arrived from the peers for too long.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the start of the session.
        s: State of the site, including the reference; updated in place.
        links: States of the links from the other sites.
    """
    if s.on_stale == _GLIDE:
        update_session_life(t_ns, s, links)
    else:
        update_stale_mode(t_ns, s, links)
    if not rests(s):
        limit_reference(k, s)


@leaf
def error_stages(
    k: int,
    t_ns: int,
    s: SiteRow,
    chain: RowArray | None,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> None:
    """Computes the tracking errors, the parameter estimate and the external torque of an arm.

    These are stages 4 and 5 of a control period, which follow the reference and precede the
    control law.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the start of the session.
        s: State of the site, including the reference; updated in place.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments.
    """
    # 4 errors
    _update_errors(s, chain)
    # 5 estimate
    _update_estimate(k, s, chain)
    _update_external_torque(t_s=t_ns * 1e-9, s=s, chain=chain, actors=actors, table=table)


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
    """Computes the reference, tracking errors and parameter estimate of a control period.

    The reference (the position to follow) is derived from the newest states of the peers whose
    network delay has passed. The external torque of operators and environments is computed
    last.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the start of the session.
        site: State of the site, shape (1,); updated in place.
        links: States of the links from the other sites, one row per link.
        ramps: Planned changes of the dominance factors.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
    """
    s: SiteRow = site[0]
    # 3 reference
    update_reference(t_ns, s, links, ramps)
    _place_arm(s, chain, links, True)
    guard_reference(k, t_ns, s, links)
    error_stages(k=k, t_ns=t_ns, s=s, chain=chain, actors=actors, table=table)


@leaf
def sense_stages(
    k: int, t_ns: int, count: int, arrays: SiteArrays, buffers: TickBuffers
) -> None:
    """Computes the part of a tick that precedes the control law (stages 1 to 5).

    - 1 accept: store the samples that arrived, until their simulated delay has passed.
    - 2 release: take the newest sample of each peer whose delay has passed.
    - 3 reference: compute the position that the arm should follow.
    - 4 errors: compute the tracking errors.
    - 5 estimate: update the estimate of the arm's dynamic parameters.

    Finally, the torque exerted on the arm by operators and environments is computed.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the epoch (the common start of the session).
        count: Number of samples that arrived since the previous tick.
        arrays: Arrays of the site, see `SiteArrays`; updated in place.
        buffers: Buffers that contain the samples that arrived.
    """
    rate_hz = arrays.site[0].rate_hz
    # Samples wait in a ring buffer with one page per tick. The pages of the ticks that the site
    # has missed (because it was too slow) are emptied first. Otherwise a later tick with the
    # same page would use their samples.
    for missed in range(k - arrays.site[0].skipped, k):
        for j in range(arrays.links.shape[0]):
            release_sample(missed, rate_hz, _link_arrays(arrays, j))
    # 1 accept
    accept_stage(k, count, arrays, buffers)
    # 2 release
    for j in range(arrays.links.shape[0]):
        release_sample(k, rate_hz, _link_arrays(arrays, j))
    # 3 reference, 4 errors, 5 estimate
    reference_stages(
        k=k,
        t_ns=t_ns,
        site=arrays.site,
        links=arrays.links,
        ramps=arrays.ramps,
        actors=arrays.actors,
        table=arrays.table,
        chain=arrays.chain,
    )


@leaf
def emit_stage(s: SiteRow, record: Array) -> None:
    """Writes the results of a control period to its record, for the log (stage 7).

    If a joint exceeds its speed limit, the run of this arm ends in the mode DIVERGED. Under the
    rule `glide`, the arm comes to rest instead; see `session_life`.

    Args:
        s: State of the site, including the motor torque; updated in place.
        record: Output array for the floating-point values of the record.
    """
    for i in range(s.joints):
        is_within_limit = abs(s.qd[i]) <= s.qd_limit[i]  # False for NaN
        if s.on_stale != _GLIDE and not is_within_limit:
            s.mode = _DIVERGED
    _write_record(s, record)


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
    """Computes the part of a control period that follows the control law.

    Limits the torque, writes the record and moves the arm to the next period (stages 6 to 8).
    `emit_stage` describes what happens if a joint exceeds its speed limit.

    Args:
        k: Current tick.
        t_ns: Nominal time of the tick, ns since the start of the session.
        site: State of the site, shape (1,), including the torque of the law; updated in place.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments.
        chain: Data of the joints, one row per joint. None for the planar two-link arm.
        record: Output array for the floating-point values of the record.
    """
    s: SiteRow = site[0]
    guard_torque(k, t_ns, s, chain)
    # 7 emit
    emit_stage(s, record)
    # 8 advance
    if s.mode != _DIVERGED:
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
    """Computes one complete control period of an arm that uses a built-in control law.

    `k` is the tick, and `t_ns` its nominal time in ns since the start of the session. Only the
    first `count` rows of `arrivals`, which hold the messages that arrived, are read.

    The remaining arguments are the fields of `SiteArrays` and `TickBuffers`. They are passed
    individually because passing the two tuples from Python takes a microsecond longer.
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
    # 6 torque
    torque_stage(site, chain)
    act_stages(
        k=k, t_ns=t_ns, site=site, actors=actors, table=table, chain=chain, record=record
    )


@leaf
def resume_stages(k: int, arrays: SiteArrays) -> None:
    """Completes the state of an arm restored from a log, to allow the run to continue.

    Some values that the next tick needs are not in the log: the tracking errors and external
    torques of tick `k`, and the motion of the arm from tick `k` to the next tick. They are
    recomputed here from the restored state.

    Args:
        k: The last recorded tick.
        arrays: Arrays of the site, with the restored state; updated in place.
    """
    s: SiteRow = arrays.site[0]
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
