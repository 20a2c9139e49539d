"""One tick of one site, compiled: its eight stages in order, and the integrator of the arm.

Invariant: one call computes a whole tick, and every stage is a leaf that the fused virtual-time run calls
as well. The arm advances one period by the classical Runge-Kutta method of fourth order: each of its
stages evaluates operators and environments, and what is held over the period is constant.
"""

import math

from . import control
from .dominance import update_reference
from .exogenous import TorqueSourceRows, TorqueTable, torque_on_arm
from .jit import leaf
from .link import accept_sample, recall_sample
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
    """Returns qdd at one stage, under the held u and what acts at that stage's time and state."""
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
    """Returns q and qd one period later, Eq. (8).

    Args:
        t_s: time at the start of the period, s since the epoch.
        h_s: the period, s.
        q: joint angles, shape (2,), rad.
        qd: joint velocities, shape (2,), rad/s.
        u: torque held over the period, control and sampled actors, shape (2,), N m.
        theta: the arm's parameters, shape (5,).
        g: gravitational acceleration, m/s^2.
        lengths: of the two links, m.
        acts: operators and environments, see `exogenous`.
        table: their recorded torques.
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
def _estimate(k: int, site: Row) -> None:
    """Stage 5: the trapezoid rule for Eq. (15), explicit since Y' r does not depend on the estimate."""
    if site.scheme == _DIGITAL or k == 0 or site.mode == _DIVERGED or site.law != _ADAPTIVE:
        return
    a, b = site.Yr_before, site.Yr
    both = (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4])
    estimate = control.update_estimate(site.theta_hat, 0.5 / site.rate_hz, site.Gamma, both)
    put_five(site.theta_hat, control.project_estimate(estimate, site.low, site.high))


@leaf
def torque_stage(site: RowArray) -> None:
    """Stage 6 of a tick: the torque of the site's law, unless that is somebody's own."""
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
def _errors_and_regressor(site: Row) -> None:
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
def _finite(q: Pair, qd: Pair) -> bool:
    """True while the arm's state is made of numbers that a record can hold."""
    return math.isfinite(q[0]) and math.isfinite(q[1]) and math.isfinite(qd[0]) and math.isfinite(qd[1])


@leaf
def _within_limits(site: Row) -> bool:
    """True while every joint speed is within the divergence stop."""
    within: bool = abs(site.qd[0]) <= site.qd_limit and abs(site.qd[1]) <= site.qd_limit
    return within


@leaf
def _emit(site: Row, row: Array) -> None:
    """Writes the record's floats in the order of EMITTED.

    A record holds finite numbers: where the arithmetic has left them, the run has diverged, and 0 stands.
    """
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
        if not math.isfinite(row[i]):
            row[i] = 0.0
            site.mode = _DIVERGED


@leaf
def _feel(t_ns: int, site: Row, actors: TorqueSourceRows, table: TorqueTable) -> None:
    """Writes what acts on the arm now, and what of it is held over the tick."""
    t_s, q, qd, lengths = t_ns * 1e-9, pair(site.q), pair(site.qd), pair(site.lengths)
    held = torque_on_arm(t_s, q, qd, lengths, actors, table, 1)
    now = torque_on_arm(t_s, q, qd, lengths, actors, table, 0)
    put_pair(site.held, held)
    put_pair(site.on_arm, (now[0] + held[0], now[1] + held[1]))


@leaf
def _held_torque(k: int, site: Row, i: int) -> float:
    """Returns what pushes a joint through the period: the torque at its middle, and what is held."""
    torque: float = site.tau[i]
    if site.scheme != _DIGITAL and k > 0:
        torque = control.limit_torque(1.5 * site.tau[i] - 0.5 * site.tau_before[i], site.tau_limit)
    held: float = site.held[i]
    return torque + held


@leaf
def _advance(k: int, t_ns: int, site: Row, actors: TorqueSourceRows, table: TorqueTable) -> None:
    """Stage 8: carries the state from t_k to t_{k+1} and remembers what tick k+1 needs of tick k."""
    s = site
    h_s = 1.0 / s.rate_hz
    if s.external == 0:
        u = (_held_torque(k, s, 0), _held_torque(k, s, 1))
        q, qd = rk4_step(
            t_ns * 1e-9, h_s, pair(s.q), pair(s.qd), u, five(s.theta), s.g, pair(s.lengths), actors, table
        )
        if _finite(q, qd):
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
def accept_stage(
    k: int,
    count: int,
    site: RowArray,
    links: RowArray,
    models: RowArray,
    samples: RowArray,
    calendars: IntArray,
    points: Points,
    arrivals: RowArray,
    forces: Array,
) -> None:
    """Stage 1: takes the first `count` arrivals into their links; arguments as in `site_tick`."""
    rate_hz = site[0].rate_hz
    for n in range(count):
        arrival: Row = arrivals[n]
        j = arrival.peer
        tick, q, qd = arrival.tick, arrival.q, arrival.qd
        accept_sample(
            k, rate_hz, tick, q, qd, forces[n], links[j], models[j], samples[j], calendars[j], points
        )


@leaf
def follow_stages(
    k: int,
    t_ns: int,
    site: RowArray,
    links: RowArray,
    models: RowArray,
    samples: RowArray,
    calendars: IntArray,
    points: Points,
    ramps: Array,
) -> None:
    """Stages 2 to 5 of a tick, with its arrivals in their links; arguments as in `site_tick`."""
    s: Row = site[0]
    for j in range(links.shape[0]):  # 2 recall
        recall_sample(k, s.rate_hz, links[j], models[j], samples[j], calendars[j], points)
    update_reference(t_ns, s, links, ramps)  # 3 reference
    _errors_and_regressor(s)  # 4 errors
    _estimate(k, s)  # 5 estimate


@leaf
def sense_stages(
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
    arrivals: RowArray,
    forces: Array,
) -> None:
    """Stages 1 to 5 of a tick: what came in, the reference, the errors, the estimate; see `site_tick`."""
    accept_stage(k, count, site, links, models, samples, calendars, points, arrivals, forces)
    follow_stages(k, t_ns, site, links, models, samples, calendars, points, ramps)


@leaf
def act_stages(
    k: int, t_ns: int, site: RowArray, actors: TorqueSourceRows, table: TorqueTable, row: Array
) -> None:
    """Stages 7 and 8 of a tick, with the torque in place: the record, and the way to the next tick."""
    s: Row = site[0]
    _feel(t_ns, s, actors, table)
    if not _within_limits(s):
        s.mode = _DIVERGED
    _emit(s, row)  # 7 emit
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
    arrivals: RowArray,
    forces: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
    row: Array,
) -> None:
    """Computes one tick of one site; what `Site.step` and the virtual-time kernel both call.

    Args:
        k: the tick.
        t_ns: its time, ns since the epoch.
        count: how many rows of `arrivals` are filled.
        site: the site's state and constants, one row of dtype SITE, shape (1,).
        links: one row per peer, shape (P,), dtype LINK.
        models: what the links' channels do, shape (P, M), dtype MODEL.
        samples: where samples wait, shape (P, pages), dtype SAMPLE.
        calendars: the links' calendars, shape (P, pages).
        points: traces and outages, shape (n, 2).
        ramps: how shares change, shape (R, 2 + P), see `shares`.
        arrivals: what came in, shape (MAX_ARRIVALS,), dtype ARRIVAL.
        forces: the peers' exogenous torques that came with it, shape (MAX_ARRIVALS, n), N m.
        actors: operators and environments, shape (A,), dtype ACTOR.
        table: their recorded torques.
        row: the record's floats in the order of EMITTED, shape (ROW_FLOATS,); written.
    """
    sense_stages(k, t_ns, count, site, links, models, samples, calendars, points, ramps, arrivals, forces)
    torque_stage(site)  # 6 torque
    act_stages(k, t_ns, site, actors, table, row)


@leaf
def resume_stages(k: int, site: RowArray, actors: TorqueSourceRows, table: TorqueTable) -> None:
    """Repeats the end of tick k (stages 4 and 8) from a state that was filled in from its record."""
    s: Row = site[0]
    t_ns = tick_ns(k, s.rate_hz)
    _errors_and_regressor(s)
    _feel(t_ns, s, actors, table)
    if s.mode != _DIVERGED:
        _advance(k, t_ns, s, actors, table)
