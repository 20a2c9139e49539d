"""One period of the arm under a held torque: the classical Runge-Kutta method of fourth order.

Law: operators and environments are asked in every stage; what is held over the period is constant.
"""

from .arm import forward_dynamics
from .exogenous import Actors, Table, torque_on_arm
from .jit import leaf
from .vectors import Pair, Vector


@leaf
def along(x: Vector, step_s: float, rate: Vector) -> Pair:
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
    acts: Actors,
    table: Table,
) -> Pair:
    """Returns qdd at one stage, under the held u and what acts at that stage's time and state."""
    on_arm = torque_on_arm(t_s, q, qd, lengths, acts, table, 0)
    return forward_dynamics(theta, g, q, qd, (on_arm[0] + u[0], on_arm[1] + u[1]))


@leaf
def advance(
    t_s: float,
    h_s: float,
    q: Vector,
    qd: Vector,
    u: Vector,
    theta: Vector,
    g: float,
    lengths: Vector,
    acts: Actors,
    table: Table,
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
    q2, v2 = along(q1, half, v1), along(v1, half, a1)
    a2 = _acceleration(t_s + half, q2, v2, u, theta, g, lengths, acts, table)
    q3, v3 = along(q1, half, v2), along(v1, half, a2)
    a3 = _acceleration(t_s + half, q3, v3, u, theta, g, lengths, acts, table)
    q4, v4 = along(q1, h_s, v3), along(v1, h_s, a3)
    a4 = _acceleration(t_s + h_s, q4, v4, u, theta, g, lengths, acts, table)
    v_sum = (v1[0] + 2.0 * v2[0] + 2.0 * v3[0] + v4[0], v1[1] + 2.0 * v2[1] + 2.0 * v3[1] + v4[1])
    a_sum = (a1[0] + 2.0 * a2[0] + 2.0 * a3[0] + a4[0], a1[1] + 2.0 * a2[1] + 2.0 * a3[1] + a4[1])
    return along(q1, sixth, v_sum), along(v1, sixth, a_sum)
