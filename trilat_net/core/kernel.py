"""One tick of one site, compiled: its eight stages in order, and the integrator of the arm.

Invariant: one call computes a whole tick, and every stage is a leaf that the fused virtual-time run calls
as well. The arm advances one period by the classical Runge-Kutta method of fourth order: each of its
stages evaluates operators and environments, and what is held over the period is constant.
"""

from math import isfinite

from . import control
from .dominance import update_reference
from .exogenous import TorqueSourceRows, TorqueTable, torque_on_arm
from .jit import leaf
from .link import LinkArrays, accept_sample, recall_sample, release_tick
from .site_arrays import SiteArrays, TickBuffers
from .site_setup import Law, Scheme
from .ticks import Mode, tick_ns
from .two_link_arm import forward_dynamics, regressor
from .vectors import Array, IntArray, Pair, Points, Row, RowArray, Vector, five, pair, put_five, put_pair


@leaf
def add_scaled(x: Vector, step_s: float, rate: Vector) -> Pair:
    """Returns x + step * rate."""
    return x[0] + step_s * rate[0], x[1] + step_s * rate[1]


@leaf
def _acceleration(
    t_s: float,
    q: Pair,
    qd: Pair,
    u: Vector,
    theta: Vector,
    g: float,
    lengths: Vector,
    acts: TorqueSourceRows,
    table: TorqueTable,
) -> Pair:
    """Returns qdd at one stage: under the held u, and the actors at that stage's time and state."""
    on_arm = torque_on_arm(t_s, q, qd, lengths, acts, table, 0)
    return forward_dynamics(theta, g, q, qd, (on_arm[0] + u[0], on_arm[1] + u[1]))


@leaf
def rk4_step(
    t_s: float,
    h_s: float,
    q: Vector,
    qd: Vector,
    u: Vector,
    theta: Vector,
    g: float,
    lengths: Vector,
    acts: TorqueSourceRows,
    table: TorqueTable,
) -> tuple[Pair, Pair]:
    """Returns q and qd one period of h_s later, Eq. (8).

    u, shape (2,), N m, is the torque that is held over the period: control and sampled actors.
    """
    half, sixth = 0.5 * h_s, h_s / 6.0
    q1, v1 = (q[0], q[1]), (qd[0], qd[1])
    a1 = _acceleration(t_s, q1, v1, u, theta, g, lengths, acts, table)
    q2, v2 = add_scaled(q1, half, v1), add_scaled(v1, half, a1)
    a2 = _acceleration(t_s + half, q2, v2, u, theta, g, lengths, acts, table)
    q3, v3 = add_scaled(q1, half, v2), add_scaled(v1, half, a2)
    a3 = _acceleration(t_s + half, q3, v3, u, theta, g, lengths, acts, table)
    q4, v4 = add_scaled(q1, h_s, v3), add_scaled(v1, h_s, a3)
    a4 = _acceleration(t_s + h_s, q4, v4, u, theta, g, lengths, acts, table)
    v_sum = (v1[0] + 2.0 * v2[0] + 2.0 * v3[0] + v4[0], v1[1] + 2.0 * v2[1] + 2.0 * v3[1] + v4[1])
    a_sum = (a1[0] + 2.0 * a2[0] + 2.0 * a3[0] + a4[0], a1[1] + 2.0 * a2[1] + 2.0 * a3[1] + a4[1])
    return add_scaled(q1, sixth, v_sum), add_scaled(v1, sixth, a_sum)


_DIVERGED = int(Mode.DIVERGED)
_DIGITAL = int(Scheme.DIGITAL)
_ADAPTIVE, _OWN = int(Law.ADAPTIVE), int(Law.OWN)


@leaf
def _update_estimate(k: int, site: Row) -> None:
    """Stage 5: the trapezoid rule for Eq. (15), explicit since Y' r does not depend on the estimate."""
    if site.scheme == _DIGITAL or k == 0 or site.mode == _DIVERGED or site.law != _ADAPTIVE:
        return
    a, b = site.Yr_before, site.Yr
    both = (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4])
    estimate = control.update_estimate(site.theta_hat, 0.5 / site.rate_hz, site.Gamma, both)
    put_five(site.theta_hat, control.project_estimate(estimate, site.low, site.high))


@leaf
def torque_stage(site: RowArray) -> None:
    """Stage 6 of a tick: the torque of the site's law; a user's law runs in Python instead."""
    s: Row = site[0]
    if s.law == _ADAPTIVE:
        Y = (five(s.Y[0]), five(s.Y[1]))
        put_pair(s.tau, control.adaptive_torque(Y, five(s.theta_hat), s.Kp, s.Kd, s.r, s.ed, s.tau_limit))
    elif s.law != _OWN:
        put_pair(
            s.tau,
            control.damped_torque(
                s.known, s.g, s.K, s.d, s.Kd, s.k_f, s.q, s.qd, s.e, s.ed, s.felt, s.tau_limit
            ),
        )


@leaf
def _update_errors(site: Row) -> None:
    """Writes e, ed, r, the regressor of Eq. (12) and Y' r from q, qd and the reference."""
    q, qd, Lambda = pair(site.q), pair(site.qd), pair(site.Lambda)
    e, ed, r = control.control_errors(q, qd, site.q_des, site.qd_des, Lambda)
    v = (-Lambda[0] * e[0], -Lambda[1] * e[1])
    a = (-Lambda[0] * ed[0], -Lambda[1] * ed[1])
    Y = regressor(site.g, q, qd, v, a)
    put_pair(site.e, e)
    put_pair(site.ed, ed)
    put_pair(site.r, r)
    put_five(site.Y[0], Y[0])
    put_five(site.Y[1], Y[1])
    put_five(site.Yr, control.regressor_transpose_times(Y, r))


@leaf
def _write_record(site: Row, row: Array) -> None:
    """Writes the record's floats, see `ROW_FLOATS`; a number that is not finite diverges the run and is 0."""
    n = site.q.shape[0]
    for i in range(n):
        row[i] = site.q[i]
        row[n + i] = site.qd[i]
        row[2 * n + i] = site.q_des[i]
        row[3 * n + i] = site.qd_des[i]
        row[4 * n + i] = site.tau[i]
        row[5 * n + i] = 0.0 - site.on_arm[i]  # 0.0, never -0.0, where nothing acts
    for p in range(site.theta_hat.shape[0]):
        row[6 * n + p] = site.theta_hat[p]
    for i in range(row.shape[0]):
        if not isfinite(row[i]):
            row[i] = 0.0
            site.mode = _DIVERGED


@leaf
def _update_external_torque(t_ns: int, site: Row, actors: TorqueSourceRows, table: TorqueTable) -> None:
    """Writes the torque of operators and environments now, the part of it held, and the force of a wall."""
    t_s, q, qd, lengths = t_ns * 1e-9, pair(site.q), pair(site.qd), pair(site.lengths)
    held = torque_on_arm(t_s, q, qd, lengths, actors, table, 1)
    now = torque_on_arm(t_s, q, qd, lengths, actors, table, 0)
    put_pair(site.held, (held[0], held[1]))
    site.wall_n = max(held[2], now[2])
    put_pair(site.on_arm, (now[0] + held[0], now[1] + held[1]))


@leaf
def _held_torque(k: int, site: Row, i: int) -> float:
    """Returns the constant torque on a joint over the period: control at mid-period, and sampled sources."""
    torque: float = site.tau[i]
    if site.scheme != _DIGITAL and k > 0:
        torque = control.limit_torque(1.5 * site.tau[i] - 0.5 * site.tau_before[i], site.tau_limit)
    held: float = site.held[i]
    return torque + held


@leaf
def _advance(k: int, t_ns: int, site: Row, actors: TorqueSourceRows, table: TorqueTable) -> None:
    """Stage 8: advances the state from t_k to t_{k+1} and keeps what tick k+1 needs of tick k."""
    s = site
    h_s = 1.0 / s.rate_hz
    if s.external == 0:
        u = (_held_torque(k, s, 0), _held_torque(k, s, 1))
        q, qd = rk4_step(
            t_ns * 1e-9, h_s, pair(s.q), pair(s.qd), u, five(s.theta), s.g, pair(s.lengths), actors, table
        )
        if isfinite(q[0]) and isfinite(q[1]) and isfinite(qd[0]) and isfinite(qd[1]):
            put_pair(s.q, q)
            put_pair(s.qd, qd)
        else:
            s.mode = _DIVERGED
    if s.scheme == _DIGITAL and s.law == _ADAPTIVE:
        estimate = control.update_estimate(s.theta_hat, h_s, s.Gamma, s.Yr)
        put_five(s.theta_hat, control.project_estimate(estimate, s.low, s.high))
    put_pair(s.tau_before, pair(s.tau))
    put_five(s.Yr_before, five(s.Yr))


@leaf
def link_arrays(arrays: SiteArrays, peer: int) -> LinkArrays:
    """Returns the arrays of the link from one peer."""
    state = arrays.links[peer : peer + 1]
    return LinkArrays(state, arrays.models[peer], arrays.samples[peer], arrays.calendars[peer], arrays.points)


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
        accept_sample(k, rate_hz, arrival.tick, arrival.q, arrival.qd, buffers.forces[n], link)


@leaf
def reference_stages(k: int, t_ns: int, site: RowArray, links: RowArray, ramps: Array) -> None:
    """Stages 3 to 5 of a tick, with the samples that it releases in use."""
    s: Row = site[0]
    update_reference(t_ns, s, links, ramps)  # 3 reference
    _update_errors(s)  # 4 errors
    _update_estimate(k, s)  # 5 estimate


@leaf
def sense_stages(k: int, t_ns: int, count: int, arrays: SiteArrays, buffers: TickBuffers) -> None:
    """Stages 1 to 5 of a tick: its arrivals, the reference, the errors, the estimate."""
    accept_stage(k, count, arrays, buffers)
    rate_hz = arrays.site[0].rate_hz
    for j in range(arrays.links.shape[0]):  # 2 recall
        recall_sample(k, rate_hz, link_arrays(arrays, j))
    reference_stages(k, t_ns, arrays.site, arrays.links, arrays.ramps)


@leaf
def act_stages(
    k: int, t_ns: int, site: RowArray, actors: TorqueSourceRows, table: TorqueTable, record: Array
) -> None:
    """Stages 7 and 8 of a tick, with the torque in place: the record, and the step to the next tick."""
    s: Row = site[0]
    _update_external_torque(t_ns, s, actors, table)
    if not (abs(s.qd[0]) <= s.qd_limit and abs(s.qd[1]) <= s.qd_limit):
        s.mode = _DIVERGED
    _write_record(s, record)  # 7 emit
    if s.mode != _DIVERGED:  # 8 advance
        _advance(k, t_ns, s, actors, table)


@leaf
def site_tick(
    k: int,
    t_ns: int,
    count: int,
    site: RowArray,
    links: RowArray,
    models: RowArray,
    samples: RowArray,
    calendars: IntArray,
    points: Points,
    ramps: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
    arrivals: RowArray,
    forces: Array,
    record: Array,
) -> None:
    """Computes tick k of one site at t_ns, ns since the epoch, with its first `count` arrivals.

    It takes the fields of `SiteArrays` and `TickBuffers` one by one: passed from Python as tuples they would
    cost more than a microsecond.
    """
    arrays = SiteArrays(site, links, models, samples, calendars, points, ramps, actors, table)
    sense_stages(k, t_ns, count, arrays, TickBuffers(arrivals, forces, record))
    torque_stage(site)  # 6 torque
    act_stages(k, t_ns, site, actors, table, record)


@leaf
def resume_stages(k: int, arrays: SiteArrays) -> None:
    """Repeats the end of tick k (stages 4 and 8) from a state that was filled in from its record."""
    s: Row = arrays.site[0]
    t_ns = tick_ns(k, s.rate_hz)
    _update_errors(s)
    _update_external_torque(t_ns, s, arrays.actors, arrays.table)
    if s.mode != _DIVERGED:
        _advance(k, t_ns, s, arrays.actors, arrays.table)
