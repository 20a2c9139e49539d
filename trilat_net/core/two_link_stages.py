"""Computes those stages of a tick that depend on the arm, for the planar two-link arm.

A tick is one period of the control loop, and a stage is one of the eight steps in which
`kernel` computes a tick. The loops over the two joints are written out, so that the compiled
code keeps the numbers in registers.

Invariant:
    - `chain_stages` has the same functions for a chain of n joints. They have one more
      argument, the rows of the joints. `kernel` calls the functions of one module or the other.
"""

from math import inf, isfinite

from . import control
from .exogenous import TorqueSourceRows, TorqueTable, torque_on_arm
from .jit import leaf
from .site_setup import Law
from .two_link_arm import forward_dynamics, inertia, regressor
from .vectors import Array, Pair, Row, Vector, five, pair, put

_ADAPTIVE = int(Law.ADAPTIVE)


@leaf
def update_errors(s: Row) -> None:
    """Computes the errors of the planar arm, and the products that its control law needs.

    These are the errors e and ed, the filtered error r, the regressor Y of Eq. (12), which
    gives a torque if it is multiplied by parameters of the arm, and Y' r. All are written into
    the row.

    Args:
        s: Row of the site, with q, qd and the reference; written.
    """
    q = pair(s.q)
    qd = pair(s.qd)
    Lambda = pair(s.Lambda)
    e, ed, r = control.control_errors(q=q, qd=qd, q_des=s.q_des, qd_des=s.qd_des, Lambda=Lambda)
    v = (-Lambda[0] * e[0], -Lambda[1] * e[1])
    a = (-Lambda[0] * ed[0], -Lambda[1] * ed[1])
    Y = regressor(g=s.g, q=q, qd=qd, v=v, a=a)
    put(s.e, e)
    put(s.ed, ed)
    put(s.r, r)
    put(s.Y[0], Y[0])
    put(s.Y[1], Y[1])
    put(s.Yr, control.regressor_transpose_times(Y, r))


@leaf
def advance_estimate(s: Row, gain_s: float, Yr: Vector) -> None:
    """Advances the estimate of the arm's parameters by a step of Eq. (15), within its box.

    Args:
        s: Row of the site, with its settings and its state.
        gain_s: Duration of the step, s.
        Yr: Y' r, shape (5,).
    """
    estimate = control.update_estimate(s.theta_hat, gain_s, s.Gamma, Yr)
    put(s.theta_hat, control.project_estimate(estimate, s.low, s.high))


@leaf
def update_torque(s: Row) -> None:
    """Computes the torque of the site's control law, within its limits.

    The law is the adaptive law, Eq. (13), with its robust term, or a law of known gravity
    (`control.damped_torque`).

    Args:
        s: Row of the site, in which the torque is written.
    """
    if s.law == _ADAPTIVE:
        Y = (five(s.Y[0]), five(s.Y[1]))
        tau = control.adaptive_torque(
            Y=Y, theta_hat=five(s.theta_hat), Kp=s.Kp, Kd=s.Kd, r=s.r, ed=s.ed, limit=inf
        )
        if s.rho[0] > 0.0 or s.rho[1] > 0.0:
            robust_0 = control.robust_torque(s.rho[0], s.width[0], s.r[0])
            robust_1 = control.robust_torque(s.rho[1], s.width[1], s.r[1])
            tau = (tau[0] - robust_0, tau[1] - robust_1)
    else:
        tau = control.damped_torque(
            theta=s.known,
            g=s.g,
            K=s.K,
            d=s.d,
            Kd=s.Kd,
            k_f=s.k_f,
            q=s.q,
            qd=s.qd,
            e=s.e,
            ed=s.ed,
            felt=s.felt,
            limit=inf,
        )
    tau_0 = control.limit_torque(tau[0], s.tau_limit[0])
    tau_1 = control.limit_torque(tau[1], s.tau_limit[1])
    put(s.tau, (tau_0, tau_1))


@leaf
def put_gravity_torque(s: Row, torque: Array) -> None:
    """Computes the gravity torque G(q) of the true parameters of the arm.

    Args:
        s: Row of the site, with its settings and its state.
        torque: Written: the torque, shape (2,), N m.
    """
    put_gravity(s, s.theta, torque)


@leaf
def put_gravity(s: Row, theta: Array, torque: Array) -> None:
    """Computes the torque that holds the planar arm against gravity, for the given parameters.

    The last two columns of the regressor, g cos q_1 and g cos(q_1 + q_2), belong to gravity.

    Args:
        s: Row of the site, after `update_errors`.
        theta: Parameters of the arm, shape (5,).
        torque: Written: the torque, shape (2,), N m.
    """
    inner = s.Y[0, 3] * theta[3]
    outer = s.Y[1, 4] * theta[4]
    put(torque, (inner + outer, outer))


@leaf
def update_model(s: Row) -> None:
    """Computes the model of the planar arm for a user's law.

    The model consists of the gravity torque G. If the law asks for them, it also contains the
    inertia matrix M and the bias torque C qd + G, where C is the Coriolis matrix.
    """
    put_gravity(s, s.known, s.G)
    if s.needs_model != 0:
        q = pair(s.q)
        qd = pair(s.qd)
        M = inertia(s.known, q)
        put(s.M[0], M[0])
        put(s.M[1], M[1])
        Y = regressor(g=s.g, q=q, qd=qd, v=qd, a=(0.0, 0.0))
        for i in range(2):
            s.bias[i] = 0.0
            for p in range(5):
                s.bias[i] += Y[i][p] * s.known[p]


@leaf
def put_source_torque(
    t_s: float,
    s: Row,
    state: Vector,
    actors: TorqueSourceRows,
    table: TorqueTable,
    sampled: int,
    torque: Array,
) -> None:
    """Computes the torque of operators and environments ON the arm, the held part or the rest.

    Args:
        t_s: Time since the epoch, the common start of the session, s.
        s: Row of the site, with its settings and its state.
        state: q and qd of the arm, shape (4,).
        actors: Rows of operators and environments.
        table: Their numbers, for example recorded torques.
        sampled: 1: only those whose torque is held over a tick; 0: only the others.
        torque: Written: the torque, shape (2,), N m.
    """
    q = (state[0], state[1])
    qd = (state[2], state[3])
    on_arm = torque_on_arm(
        t_s=t_s,
        q=q,
        qd=qd,
        lengths=pair(s.lengths),
        actors=actors,
        table=table,
        sampled=sampled,
    )
    put(torque, (on_arm[0], on_arm[1]))


@leaf
def update_external_torque(
    t_s: float, s: Row, actors: TorqueSourceRows, table: TorqueTable
) -> None:
    """Computes the torque that operators and environments exert in a tick.

    The whole torque, the part of it that is held over the tick, and the force of the walls are
    written into the row of the site.

    Args:
        t_s: Time since the epoch, the common start of the session, s.
        s: Row of the site; written.
        actors: Rows of operators and environments.
        table: Their numbers, for example recorded torques.
    """
    q = pair(s.q)
    qd = pair(s.qd)
    lengths = pair(s.lengths)
    held = torque_on_arm(
        t_s=t_s, q=q, qd=qd, lengths=lengths, actors=actors, table=table, sampled=1
    )
    now = torque_on_arm(
        t_s=t_s, q=q, qd=qd, lengths=lengths, actors=actors, table=table, sampled=0
    )
    put(s.held, (held[0], held[1]))
    s.wall_n = max(held[2], now[2])
    put(s.on_arm, (now[0] + held[0], now[1] + held[1]))
    if s.external != 0:
        for i in range(2):
            s.on_arm[i] += s.sensed[i]


@leaf
def add_scaled(x: Vector, step_s: float, rate: Vector) -> Pair:
    """Returns x + step_s * rate, a linear step of two numbers over the duration `step_s`."""
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
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> Pair:
    """Returns qdd at a stage of the integrator, rad/s^2.

    The torque is the held u plus the torque of the actors at the time and state of the stage.

    Args:
        t_s: Time of the stage, s since the epoch.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        u: Held torque, shape (2,), N m.
        theta: Parameters of the arm, shape (5,).
        g: Gravitational acceleration, m/s^2.
        lengths: Lengths of the two links, m.
        actors: Rows of operators and environments.
        table: Their numbers, for example recorded torques.
    """
    on_arm = torque_on_arm(
        t_s=t_s, q=q, qd=qd, lengths=lengths, actors=actors, table=table, sampled=0
    )
    torque = (on_arm[0] + u[0], on_arm[1] + u[1])
    return forward_dynamics(theta=theta, g=g, q=q, qd=qd, torque=torque)


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
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> tuple[Pair, Pair]:
    """Returns q and qd one period later, Eq. (8), by the classical Runge-Kutta method.

    Args:
        t_s: Time at the beginning of the period, s since the epoch.
        h_s: The period, s.
        q: Joint angles at the beginning, rad.
        qd: Joint velocities at the beginning, rad/s.
        u: Torque that is held over the period (control and sampled actors), shape (2,), N m.
        theta: The arm's parameters, shape (5,).
        g: Gravitational acceleration, m/s^2.
        lengths: Lengths of the two links, m.
        actors: Operators and environments.
        table: Their recorded torques.
    """
    half = 0.5 * h_s
    sixth = h_s / 6.0
    q1 = (q[0], q[1])
    v1 = (qd[0], qd[1])
    a1 = _acceleration(
        t_s=t_s, q=q1, qd=v1, u=u, theta=theta, g=g, lengths=lengths, actors=actors, table=table
    )
    q2 = add_scaled(q1, half, v1)
    v2 = add_scaled(v1, half, a1)
    a2 = _acceleration(
        t_s=t_s + half,
        q=q2,
        qd=v2,
        u=u,
        theta=theta,
        g=g,
        lengths=lengths,
        actors=actors,
        table=table,
    )
    q3 = add_scaled(q1, half, v2)
    v3 = add_scaled(v1, half, a2)
    a3 = _acceleration(
        t_s=t_s + half,
        q=q3,
        qd=v3,
        u=u,
        theta=theta,
        g=g,
        lengths=lengths,
        actors=actors,
        table=table,
    )
    q4 = add_scaled(q1, h_s, v3)
    v4 = add_scaled(v1, h_s, a3)
    a4 = _acceleration(
        t_s=t_s + h_s,
        q=q4,
        qd=v4,
        u=u,
        theta=theta,
        g=g,
        lengths=lengths,
        actors=actors,
        table=table,
    )
    v_sum_0 = v1[0] + 2.0 * v2[0] + 2.0 * v3[0] + v4[0]
    v_sum_1 = v1[1] + 2.0 * v2[1] + 2.0 * v3[1] + v4[1]
    a_sum_0 = a1[0] + 2.0 * a2[0] + 2.0 * a3[0] + a4[0]
    a_sum_1 = a1[1] + 2.0 * a2[1] + 2.0 * a3[1] + a4[1]
    q_next = add_scaled(q1, sixth, (v_sum_0, v_sum_1))
    qd_next = add_scaled(v1, sixth, (a_sum_0, a_sum_1))
    return q_next, qd_next


@leaf
def advance_arm(
    t_s: float, h_s: float, s: Row, actors: TorqueSourceRows, table: TorqueTable
) -> bool:
    """Simulates the motion of the arm in one period (Runge-Kutta method of fourth order).

    The torque `s.u` is held over the period. The joint angles q and velocities qd at its end
    are written into the row of the site.

    Args:
        t_s: Time at the beginning of the period, s since the epoch.
        h_s: The period, s.
        s: Row of the site; written.
        actors: Rows of operators and environments.
        table: Their numbers, for example recorded torques.

    Returns:
        False if the result is not finite. Then q and qd are unchanged.
    """
    q, qd = rk4_step(
        t_s=t_s,
        h_s=h_s,
        q=pair(s.q),
        qd=pair(s.qd),
        u=pair(s.u),
        theta=five(s.theta),
        g=s.g,
        lengths=pair(s.lengths),
        actors=actors,
        table=table,
    )
    is_finite = isfinite(q[0]) and isfinite(q[1]) and isfinite(qd[0]) and isfinite(qd[1])
    if not is_finite:
        return False
    put(s.q, q)
    put(s.qd, qd)
    return True
