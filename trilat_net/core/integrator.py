"""One period of the arm under a held torque: the classical Runge-Kutta method of fourth order.

Law: operators and environments are asked in every stage; what is held over the period is constant.
"""

from .arm import Array, forward_dynamics
from .exogenous import Actors, Table, torque_on_arm
from .jit import leaf

STAGE_ROWS = 14
"""Rows of the work array of `advance`: stage angles, stage velocities, torque, four accelerations, the sum of
velocities, and six for what acts on the arm."""


@leaf
def _acceleration(
    t_s: float,
    q: Array,
    qd: Array,
    u: Array,
    theta: Array,
    g: float,
    lengths: Array,
    actors: Actors,
    table: Table,
    work: Array,
    qdd: Array,
) -> None:
    """Writes qdd at one stage, under the held u and what acts at that stage's time and state."""
    total = work[2]
    torque_on_arm(t_s, q, qd, lengths, actors, table, 0, work[8:14], total)
    for i in range(u.shape[0]):
        total[i] += u[i]
    forward_dynamics(theta, g, q, qd, total, qdd)


@leaf
def advance(
    t_s: float,
    h_s: float,
    q: Array,
    qd: Array,
    u: Array,
    theta: Array,
    g: float,
    lengths: Array,
    actors: Actors,
    table: Table,
    work: Array,
) -> None:
    """Advances q and qd in place by one period, Eq. (8).

    Args:
        t_s: time at the start of the period, s since the epoch.
        h_s: the period, s.
        q: joint angles, shape (n,), rad; changed.
        qd: joint velocities, shape (n,), rad/s; changed.
        u: torque held over the period, control and sampled actors, shape (n,), N m.
        theta: the arm's parameters, shape (5,).
        g: gravitational acceleration, m/s^2.
        lengths: of the two links, m.
        actors: operators and environments, see `exogenous`.
        table: their recorded torques.
        work: scratch, shape (STAGE_ROWS, n).
    """
    joints = q.shape[0]
    qs, vs = work[0], work[1]
    a1, a2, a3, a4 = work[3], work[4], work[5], work[6]
    v_sum = work[7]
    half = 0.5 * h_s
    _acceleration(t_s, q, qd, u, theta, g, lengths, actors, table, work, a1)
    for i in range(joints):
        qs[i] = q[i] + half * qd[i]
        vs[i] = qd[i] + half * a1[i]
        v_sum[i] = qd[i] + 2.0 * vs[i]
    _acceleration(t_s + half, qs, vs, u, theta, g, lengths, actors, table, work, a2)
    for i in range(joints):
        qs[i] = q[i] + half * vs[i]
        vs[i] = qd[i] + half * a2[i]
        v_sum[i] += 2.0 * vs[i]
    _acceleration(t_s + half, qs, vs, u, theta, g, lengths, actors, table, work, a3)
    for i in range(joints):
        qs[i] = q[i] + h_s * vs[i]
        vs[i] = qd[i] + h_s * a3[i]
        v_sum[i] += vs[i]
    _acceleration(t_s + h_s, qs, vs, u, theta, g, lengths, actors, table, work, a4)
    for i in range(joints):
        q[i] += h_s / 6.0 * v_sum[i]
        qd[i] += h_s / 6.0 * (a1[i] + 2.0 * a2[i] + 2.0 * a3[i] + a4[i])
