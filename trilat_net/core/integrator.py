"""One period of the arm under a held torque: the classical Runge-Kutta method of fourth order.

Law: the operator's torque is asked for in every stage; the control torque is constant over the period.
"""

from .arm import Array, forward_dynamics
from .exogenous import torque_on_arm
from .jit import leaf

STAGE_ROWS = 8
"""Rows of the work array of `advance`: stage angles, stage velocities, torque, then four accelerations."""


@leaf
def _acceleration(
    t_s: float, q: Array, qd: Array, u: Array, theta: Array, g: float, pulses: Array, total: Array, qdd: Array
) -> None:
    """Writes qdd at one stage, under the held u and the operator's torque at that stage's time."""
    torque_on_arm(t_s, pulses, total)
    for i in range(u.shape[0]):
        total[i] += u[i]
    forward_dynamics(theta, g, q, qd, total, qdd)


@leaf
def advance(
    t_s: float, h_s: float, q: Array, qd: Array, u: Array, theta: Array, g: float, pulses: Array, work: Array
) -> None:
    """Advances q and qd in place by one period, Eq. (8).

    Args:
        t_s: time at the start of the period, s since the epoch.
        h_s: the period, s.
        q: joint angles, shape (n,), rad; changed.
        qd: joint velocities, shape (n,), rad/s; changed.
        u: control torque held over the period, shape (n,), N m.
        theta: the arm's parameters, shape (5,).
        g: gravitational acceleration, m/s^2.
        pulses: the operator's torque, see `exogenous`.
        work: scratch, shape (STAGE_ROWS, n).
    """
    joints = q.shape[0]
    qs, vs, total = work[0], work[1], work[2]
    a1, a2, a3, a4 = work[3], work[4], work[5], work[6]
    v_sum = work[7]
    half = 0.5 * h_s
    _acceleration(t_s, q, qd, u, theta, g, pulses, total, a1)
    for i in range(joints):
        qs[i] = q[i] + half * qd[i]
        vs[i] = qd[i] + half * a1[i]
        v_sum[i] = qd[i] + 2.0 * vs[i]
    _acceleration(t_s + half, qs, vs, u, theta, g, pulses, total, a2)
    for i in range(joints):
        qs[i] = q[i] + half * vs[i]
        vs[i] = qd[i] + half * a2[i]
        v_sum[i] += 2.0 * vs[i]
    _acceleration(t_s + half, qs, vs, u, theta, g, pulses, total, a3)
    for i in range(joints):
        qs[i] = q[i] + h_s * vs[i]
        vs[i] = qd[i] + h_s * a3[i]
        v_sum[i] += vs[i]
    _acceleration(t_s + h_s, qs, vs, u, theta, g, pulses, total, a4)
    for i in range(joints):
        q[i] += h_s / 6.0 * v_sum[i]
        qd[i] += h_s / 6.0 * (a1[i] + 2.0 * a2[i] + 2.0 * a3[i] + a4[i])
