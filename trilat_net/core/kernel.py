"""One tick of one site, compiled: the state's layout, and the eight stages in order.

Law: one call computes a whole tick, and every stage is a leaf that other drivers of the same numbers (the
fused virtual-time kernel) call as well. A site's state is one row of a structured array: one argument
that costs a quarter of a microsecond to pass, and fields with the paper's names.
"""

import math

import numpy as np

from . import control
from .arm import JOINTS, PARAMETERS, Array, regressor
from .delay import Points, Row
from .exogenous import Actors, Table, torque_on_arm
from .grid import tick_ns
from .integrator import advance
from .jit import leaf
from .link import Rows, Ticks, accept, recall
from .setup import Law, Scheme
from .shares import follow_ramps
from .stale import mind_stale_peers
from .tick import Mode
from .vectors import Pair, five, pair, put_five, put_pair

_VECTOR = (JOINTS,)
SITE = np.dtype(
    (
        np.record,
        [
            ("rate_hz", "i8"),
            ("scheme", "i8"),
            ("law", "i8"),
            ("external", "i8"),
            ("ramps", "i8"),
            ("on_stale", "i8"),
            ("stale_ns", "i8"),
            ("return_ns", "i8"),
            ("g", "f8"),
            ("tau_limit", "f8"),
            ("qd_limit", "f8"),
            ("theta", "f8", (PARAMETERS,)),
            ("Lambda", "f8", _VECTOR),
            ("Kp", "f8", _VECTOR),
            ("Kd", "f8", _VECTOR),
            ("Gamma", "f8", (PARAMETERS,)),
            ("low", "f8", (PARAMETERS,)),
            ("high", "f8", (PARAMETERS,)),
            ("known", "f8", (PARAMETERS,)),
            ("K", "f8", _VECTOR),
            ("d", "f8", _VECTOR),
            ("k_f", "f8", _VECTOR),
            ("lengths", "f8", (2,)),
            # the state
            ("mode", "i8"),
            ("q", "f8", _VECTOR),
            ("qd", "f8", _VECTOR),
            ("theta_hat", "f8", (PARAMETERS,)),
            ("tau", "f8", _VECTOR),
            ("tau_before", "f8", _VECTOR),
            ("Yr", "f8", (PARAMETERS,)),
            ("Yr_before", "f8", (PARAMETERS,)),
            ("q_held", "f8", _VECTOR),
            ("return_from_ns", "i8"),
            # what a tick computes on its way
            ("q_des", "f8", _VECTOR),
            ("qd_des", "f8", _VECTOR),
            ("q_followed", "f8", _VECTOR),
            ("felt", "f8", _VECTOR),
            ("on_arm", "f8", _VECTOR),
            ("held", "f8", _VECTOR),
            ("e", "f8", _VECTOR),
            ("ed", "f8", _VECTOR),
            ("r", "f8", _VECTOR),
            ("Y", "f8", (JOINTS, PARAMETERS)),
        ],
    )
)
ARRIVAL = np.dtype((np.record, [("peer", "i8"), ("tick", "i8"), ("q", "f8", _VECTOR), ("qd", "f8", _VECTOR)]))

# Where each vector of a record lies in the row of floats that a tick emits.
EMITTED = ("q", "qd", "q_des", "qd_des", "tau", "tau_x", "theta_hat")
ROW_FLOATS = 6 * JOINTS + PARAMETERS

_DIVERGED = int(Mode.DIVERGED)
_DIGITAL = int(Scheme.DIGITAL)
_ADAPTIVE, _OWN = int(Law.ADAPTIVE), int(Law.OWN)


@leaf
def _reference(t_ns: int, site: Row, links: Rows, ramps: Array) -> None:
    """Writes q_id and its derivative, Eq. (6), summing over peers in scenario order.

    While shares change, the derivative has their rates in it too.
    """
    if site.ramps > 1:
        follow_ramps(t_ns, site.ramps, ramps, links)
    put_pair(site.q_followed, pair(site.q_des))
    for i in range(JOINTS):
        q_des = qd_des = felt = 0.0
        for j in range(links.shape[0]):
            link: Row = links[j]
            q_des += link.alpha * link.q[i]
            qd_des += link.alpha * link.qd[i] + link.alpha_rate * link.q[i]
            felt -= link.alpha * link.tau_x[i]
        site.q_des[i], site.qd_des[i], site.felt[i] = q_des, qd_des, felt
    mind_stale_peers(t_ns, site, links)


@leaf
def _estimate(k: int, site: Row) -> None:
    """Stage 5: the trapezoid rule for Eq. (15), explicit since Y' r does not depend on the estimate."""
    if site.scheme == _DIGITAL or k == 0 or site.mode == _DIVERGED or site.law != _ADAPTIVE:
        return
    a, b = site.Yr_before, site.Yr
    both = (a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4])
    estimate = control.estimate(site.theta_hat, 0.5 / site.rate_hz, site.Gamma, both)
    put_five(site.theta_hat, control.project(estimate, site.low, site.high))


@leaf
def site_torque(site: Rows) -> None:
    """Stage 6 of a tick: the torque of the site's law, unless that is somebody's own."""
    s: Row = site[0]
    if s.law == _ADAPTIVE:
        Y = (five(s.Y[0]), five(s.Y[1]))
        put_pair(s.tau, control.torque(Y, five(s.theta_hat), s.Kp, s.Kd, s.r, s.ed, s.tau_limit))
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
    e, ed, r = control.errors(q, qd, site.q_des, site.qd_des, Lambda)
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
def _feel(t_ns: int, site: Row, actors: Actors, table: Table) -> None:
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
        torque = control.limited(1.5 * site.tau[i] - 0.5 * site.tau_before[i], site.tau_limit)
    held: float = site.held[i]
    return torque + held


@leaf
def _advance(k: int, t_ns: int, site: Row, actors: Actors, table: Table) -> None:
    """Stage 8: carries the state from t_k to t_{k+1} and remembers what tick k+1 needs of tick k."""
    s = site
    h_s = 1.0 / s.rate_hz
    if s.external == 0:
        u = (_held_torque(k, s, 0), _held_torque(k, s, 1))
        q, qd = advance(
            t_ns * 1e-9, h_s, pair(s.q), pair(s.qd), u, five(s.theta), s.g, pair(s.lengths), actors, table
        )
        if _finite(q, qd):
            put_pair(s.q, q)
            put_pair(s.qd, qd)
        else:
            s.mode = _DIVERGED
    if s.scheme == _DIGITAL and s.law == _ADAPTIVE:
        estimate = control.estimate(s.theta_hat, h_s, s.Gamma, s.Yr)
        put_five(s.theta_hat, control.project(estimate, s.low, s.high))
    put_pair(s.tau_before, pair(s.tau))
    put_five(s.Yr_before, five(s.Yr))


@leaf
def site_accept(
    k: int,
    count: int,
    site: Rows,
    links: Rows,
    models: Rows,
    samples: Rows,
    calendars: Ticks,
    points: Points,
    arrivals: Rows,
    forces: Array,
) -> None:
    """Stage 1: takes the first `count` arrivals into their links; arguments as in `site_tick`."""
    rate_hz = site[0].rate_hz
    for n in range(count):
        arrival: Row = arrivals[n]
        j = arrival.peer
        tick, q, qd = arrival.tick, arrival.q, arrival.qd
        accept(k, rate_hz, tick, q, qd, forces[n], links[j], models[j], samples[j], calendars[j], points)


@leaf
def site_follow(
    k: int,
    t_ns: int,
    site: Rows,
    links: Rows,
    models: Rows,
    samples: Rows,
    calendars: Ticks,
    points: Points,
    ramps: Array,
) -> None:
    """Stages 2 to 5 of a tick, with its arrivals in their links; arguments as in `site_tick`."""
    s: Row = site[0]
    for j in range(links.shape[0]):  # 2 recall
        recall(k, s.rate_hz, links[j], models[j], samples[j], calendars[j], points)
    _reference(t_ns, s, links, ramps)  # 3 reference
    _errors_and_regressor(s)  # 4 errors
    _estimate(k, s)  # 5 estimate


@leaf
def site_look(
    k: int,
    t_ns: int,
    count: int,
    site: Rows,
    links: Rows,
    models: Rows,
    samples: Rows,
    calendars: Ticks,
    points: Points,
    ramps: Array,
    arrivals: Rows,
    forces: Array,
) -> None:
    """Stages 1 to 5 of a tick: what came in, the reference, the errors, the estimate; see `site_tick`."""
    site_accept(k, count, site, links, models, samples, calendars, points, arrivals, forces)
    site_follow(k, t_ns, site, links, models, samples, calendars, points, ramps)


@leaf
def site_act(k: int, t_ns: int, site: Rows, actors: Actors, table: Table, row: Array) -> None:
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
    site: Rows,
    links: Rows,
    models: Rows,
    samples: Rows,
    calendars: Ticks,
    points: Points,
    ramps: Array,
    arrivals: Rows,
    forces: Array,
    actors: Actors,
    table: Table,
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
    site_look(k, t_ns, count, site, links, models, samples, calendars, points, ramps, arrivals, forces)
    site_torque(site)  # 6 torque
    site_act(k, t_ns, site, actors, table, row)


@leaf
def site_resume(k: int, site: Rows, actors: Actors, table: Table) -> None:
    """Repeats the end of tick k (stages 4 and 8) from a state that was filled in from its record."""
    s: Row = site[0]
    t_ns = tick_ns(k, s.rate_hz)
    _errors_and_regressor(s)
    _feel(t_ns, s, actors, table)
    if s.mode != _DIVERGED:
        _advance(k, t_ns, s, actors, table)
