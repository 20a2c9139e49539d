"""The parts of a control period that depend on the arm model, for the planar two-link arm.

`kernel` computes a control period (tick) in eight stages. Some of them, such as the torque of
the control law, need the dynamics of the arm. This module implements these stages for two
joints. The equations of both joints are written out without loops, which lets the compiled code
keep all values in registers.

Invariant:
    - `chain_stages` provides the same functions for a chain of n joints, with the joint rows as
      an additional argument. `kernel` uses one module or the other.
"""

from math import inf, isfinite

from ..step import control
from ..step.jit import leaf
from ..step.site_setup import Law
from ..step.vectors import Array, Pair, Row, Vector, put_five, put_pair, read_five, read_pair
from .exogenous import TorqueSourceRows, TorqueTable, torque_on_arm
from .two_link_arm import forward_dynamics, inertia, regressor

_ADAPTIVE = int(Law.ADAPTIVE)


@leaf
def update_errors(s: Row) -> None:
    """Computes the tracking errors of the planar arm and the regressor of its dynamics.

    The results are the position error e, the velocity error ed, the filtered error r, the
    regressor Y and the product Y' r. Y times the dynamic parameters of the arm is the torque
    required for the reference motion. The adaptive law uses Y' r to update its estimate of
    these parameters.

    Args:
        s: State of the site, with q, qd and the reference; the results are written into it.
    """
    q = read_pair(s.q)
    qd = read_pair(s.qd)
    Lambda = read_pair(s.Lambda)
    e, ed, r = control.control_errors(q=q, qd=qd, q_des=s.q_des, qd_des=s.qd_des, Lambda=Lambda)
    v = (-Lambda[0] * e[0], -Lambda[1] * e[1])
    a = (-Lambda[0] * ed[0], -Lambda[1] * ed[1])
    Y = regressor(g=s.g, q=q, qd=qd, v=v, a=a)
    put_pair(s.e, e)
    put_pair(s.ed, ed)
    put_pair(s.r, r)
    put_five(s.Y[0], Y[0])
    put_five(s.Y[1], Y[1])
    Yr = control.regressor_transpose_times(Y, r)
    put_five(s.Yr, Yr)


@leaf
def advance_estimate(s: Row, gain_s: float, Yr: Vector) -> None:
    """Advances the adaptive law's estimate of the arm's parameters by one time step.

    Each parameter, such as an inertia, is then clipped to its lower and upper bound, which
    keeps the estimate plausible.

    Args:
        s: State of the site, with the estimate, its gains and its bounds; the estimate is
            modified.
        gain_s: Duration of the step, s.
        Yr: The product Y' r, where Y is the regressor and r the filtered error, shape (5,).
    """
    estimate = control.update_estimate(s.theta_hat, gain_s, s.Gamma, Yr)
    projected = control.project_estimate(estimate, s.low, s.high)
    put_five(s.theta_hat, projected)


@leaf
def update_torque(s: Row) -> None:
    """Computes the motor torque of a built-in control law, limited to the motors' range.

    The adaptive law estimates the parameters of the arm:

        tau = Y theta_hat - Kp r - Kd ed - rho r / sqrt(r^2 + width^2)

    The last term is the robust term, a torque of at most rho that counteracts disturbances. It
    is omitted if rho is 0. The other law compensates for a known gravity torque G:

        tau = G(q) - K e - d qd - Kd ed + k_f felt

    The symbols are explained in `control`; see `adaptive_torque`, `robust_torque` and
    `damped_torque`.

    Args:
        s: State of the site, with the errors and the gains of each joint; the torque is written
            into it.
    """
    # The limit applies to the sum of all terms, below.
    no_limit = inf
    if s.law == _ADAPTIVE:
        Y = (read_five(s.Y[0]), read_five(s.Y[1]))
        tau = control.adaptive_torque(
            Y=Y,
            theta_hat=read_five(s.theta_hat),
            Kp=s.Kp,
            Kd=s.Kd,
            r=s.r,
            ed=s.ed,
            limit=no_limit,
        )
        has_robust_term = s.rho[0] > 0.0 or s.rho[1] > 0.0
        if has_robust_term:
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
            limit=no_limit,
        )
    tau_0 = control.limit_torque(tau[0], s.tau_limit[0])
    tau_1 = control.limit_torque(tau[1], s.tau_limit[1])
    put_pair(s.tau, (tau_0, tau_1))


@leaf
def put_gravity_torque(s: Row, torque: Array) -> None:
    """Computes the gravity torque at the joints of the planar arm, using its true parameters.

    The controller may not know these parameters. `put_gravity` takes the parameters as an
    argument instead.

    Args:
        s: State of the site, with the joint angles and the true parameters.
        torque: Receives the gravity torque, shape (2,), N m.
    """
    put_gravity(s, s.theta, torque)


@leaf
def put_gravity(s: Row, theta: Array, torque: Array) -> None:
    """Computes the torque that holds the planar arm against gravity, for given parameters.

    The last two columns of the regressor, g cos q_1 and g cos(q_1 + q_2), are the gravity
    terms.

    Args:
        s: State of the site, after `update_errors`.
        theta: Parameters of the arm, shape (5,).
        torque: Receives the torque, shape (2,), N m.
    """
    inner = s.Y[0, 3] * theta[3]
    outer = s.Y[1, 4] * theta[4]
    put_pair(torque, (inner + outer, outer))


@leaf
def update_model(s: Row) -> None:
    """Computes the dynamic model that a user-written control law can read, for the planar arm.

    The model always contains the gravity torque G. On request it also contains the inertia
    matrix M and the bias torque C qd + G, where C is the Coriolis matrix.
    """
    put_gravity(s, s.known, s.G)
    if s.needs_model != 0:
        q = read_pair(s.q)
        qd = read_pair(s.qd)
        M = inertia(s.known, q)
        put_pair(s.M[0], M[0])
        put_pair(s.M[1], M[1])
        # Y theta is M a + C v + G, here with v = qd and a = 0.
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
    """Computes the torque exerted by one group of operators and environments.

    The two groups are the sampled ones, whose torque is evaluated once per control period and
    then held constant, and all others, which act continuously on the planar arm.

    Args:
        t_s: Time since the start of the session, s.
        s: Settings of the site.
        state: Two joint angles in rad, followed by two joint velocities in rad/s.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
        sampled: 1 for the torque of the sampled operators and environments, 0 for all others.
        torque: Receives the torque on the arm, shape (2,), N m.
    """
    q = (state[0], state[1])
    qd = (state[2], state[3])
    on_arm = torque_on_arm(
        t_s=t_s,
        q=q,
        qd=qd,
        lengths=read_pair(s.lengths),
        actors=actors,
        table=table,
        sampled=sampled,
    )
    put_pair(torque, (on_arm[0], on_arm[1]))


@leaf
def update_external_torque(
    t_s: float, s: Row, actors: TorqueSourceRows, table: TorqueTable
) -> None:
    """Computes the current torque of operators and environments on the planar arm.

    The torque is the sum of up to three parts:

    - The torque of the sampled operators and environments, which is evaluated once per control
      period and then held constant.
    - The torque of all others, which act continuously. It is recomputed while the arm moves
      during the period.
    - If the arm is real or simulated elsewhere (`external`), the measured torque.

    Args:
        t_s: Time since the start of the session, s.
        s: State of the site; modified. `on_arm` receives the total torque and `held` the first
            part, N m. `wall_n` receives the largest wall force, N. `sensed` is the measured
            torque, N m.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
    """
    q = read_pair(s.q)
    qd = read_pair(s.qd)
    lengths = read_pair(s.lengths)
    held_0, held_1, held_wall_n = torque_on_arm(
        t_s=t_s, q=q, qd=qd, lengths=lengths, actors=actors, table=table, sampled=1
    )
    continuous_0, continuous_1, continuous_wall_n = torque_on_arm(
        t_s=t_s, q=q, qd=qd, lengths=lengths, actors=actors, table=table, sampled=0
    )
    put_pair(s.held, (held_0, held_1))
    s.wall_n = max(held_wall_n, continuous_wall_n)
    total_0 = continuous_0 + held_0
    total_1 = continuous_1 + held_1
    put_pair(s.on_arm, (total_0, total_1))
    is_measured = s.external != 0
    if is_measured:
        for i in range(2):
            s.on_arm[i] += s.sensed[i]


@leaf
def _add_scaled(x: Vector, step_s: float, rate: Vector) -> Pair:
    """Returns x + step_s * rate: two joint values after `step_s` seconds at constant rates."""
    first = x[0] + step_s * rate[0]
    second = x[1] + step_s * rate[1]
    return first, second


@leaf
def find_stage_acceleration(
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
    """Computes the joint accelerations at one of the four Runge-Kutta stages.

    The torque is the sum of u, which is constant during the control period, and the torque of
    operators and environments at the time and state of the stage.

    Args:
        t_s: Time of the stage, s since the start of the session.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        u: Held torque, shape (2,), N m.
        theta: Parameters of the arm, shape (5,).
        g: Gravitational acceleration, m/s^2.
        lengths: Lengths of the two links, m.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
    """
    on_arm = torque_on_arm(
        t_s=t_s, q=q, qd=qd, lengths=lengths, actors=actors, table=table, sampled=0
    )
    torque = (on_arm[0] + u[0], on_arm[1] + u[1])
    return forward_dynamics(theta=theta, g=g, q=q, qd=qd, torque=torque)


@leaf
def advance_stage(
    t_s: float,
    ahead_s: float,
    q: Vector,
    qd: Vector,
    qd_before: Vector,
    qdd_before: Vector,
    u: Vector,
    theta: Vector,
    g: float,
    lengths: Vector,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> tuple[Pair, Pair]:
    """Computes the state and the acceleration at Runge-Kutta stage 2, 3 or 4.

    The Runge-Kutta method evaluates the acceleration of the arm at four states (stages) per
    control period. The state of a stage is the state at the start of the period plus `ahead_s`
    times the derivatives at the previous stage.

    Args:
        t_s: Time at the beginning of the period, s since the start of the session.
        ahead_s: Time from the beginning of the period to the stage, s.
        q: Joint angles at the beginning of the period, rad.
        qd: Joint velocities at the beginning of the period, rad/s.
        qd_before: Joint velocities at the previous stage, rad/s.
        qdd_before: Joint accelerations at the previous stage, rad/s^2.
        u: Held torque, shape (2,), N m.
        theta: Parameters of the arm, shape (5,).
        g: Gravitational acceleration, m/s^2.
        lengths: Lengths of the two links, m.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.

    Returns:
        Joint velocities and joint accelerations at the stage.
    """
    stage_q = _add_scaled(q, ahead_s, qd_before)
    stage_qd = _add_scaled(qd, ahead_s, qdd_before)
    stage_qdd = find_stage_acceleration(
        t_s=t_s + ahead_s,
        q=stage_q,
        qd=stage_qd,
        u=u,
        theta=theta,
        g=g,
        lengths=lengths,
        actors=actors,
        table=table,
    )
    return stage_qd, stage_qdd


@leaf
def combine_stages(
    h_s: float,
    q: Vector,
    qd: Vector,
    qd_2: Vector,
    qd_3: Vector,
    qd_4: Vector,
    qdd_1: Vector,
    qdd_2: Vector,
    qdd_3: Vector,
    qdd_4: Vector,
) -> tuple[Pair, Pair]:
    """Completes the Runge-Kutta method: computes the state at the end of the period.

        q(t + h) = q(t) + h/6 (qd_1 + 2 qd_2 + 2 qd_3 + qd_4)        and the same for qd, qdd

    Args:
        h_s: The period h, s.
        q: Joint angles at the beginning of the period, rad.
        qd: Joint velocities at the beginning of the period (stage 1), rad/s.
        qd_2: Joint velocities at stage 2, rad/s.
        qd_3: Joint velocities at stage 3, rad/s.
        qd_4: Joint velocities at stage 4, rad/s.
        qdd_1: Joint accelerations at stage 1, rad/s^2.
        qdd_2: Joint accelerations at stage 2, rad/s^2.
        qdd_3: Joint accelerations at stage 3, rad/s^2.
        qdd_4: Joint accelerations at stage 4, rad/s^2.
    """
    sixth = h_s / 6.0
    v_sum_0 = qd[0] + 2.0 * qd_2[0] + 2.0 * qd_3[0] + qd_4[0]
    v_sum_1 = qd[1] + 2.0 * qd_2[1] + 2.0 * qd_3[1] + qd_4[1]
    a_sum_0 = qdd_1[0] + 2.0 * qdd_2[0] + 2.0 * qdd_3[0] + qdd_4[0]
    a_sum_1 = qdd_1[1] + 2.0 * qdd_2[1] + 2.0 * qdd_3[1] + qdd_4[1]
    q_next = _add_scaled(q, sixth, (v_sum_0, v_sum_1))
    qd_next = _add_scaled(qd, sixth, (a_sum_0, a_sum_1))
    return q_next, qd_next


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
    """Simulates the motion of the planar arm over one period of the control loop.

    Uses the classical fourth-order Runge-Kutta method. Operators and environments act
    continuously, except those marked as sampled.

    Args:
        t_s: Time at the beginning of the period, in s since the start of the session.
        h_s: The period, s.
        q: Joint angles at the beginning, rad.
        qd: Joint velocities at the beginning, rad/s.
        u: Torque held constant over the period, shape (2,), N m: the motors plus the sampled
            operators and environments.
        theta: Dynamic parameters of the arm, shape (5,).
        g: Gravitational acceleration, m/s^2.
        lengths: Lengths of the two links, m.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.

    Returns:
        Joint angles and joint velocities at the end of the period.
    """
    half = 0.5 * h_s
    q1 = (q[0], q[1])
    v1 = (qd[0], qd[1])
    a1 = find_stage_acceleration(
        t_s=t_s, q=q1, qd=v1, u=u, theta=theta, g=g, lengths=lengths, actors=actors, table=table
    )
    v2, a2 = advance_stage(
        t_s=t_s,
        ahead_s=half,
        q=q1,
        qd=v1,
        qd_before=v1,
        qdd_before=a1,
        u=u,
        theta=theta,
        g=g,
        lengths=lengths,
        actors=actors,
        table=table,
    )
    v3, a3 = advance_stage(
        t_s=t_s,
        ahead_s=half,
        q=q1,
        qd=v1,
        qd_before=v2,
        qdd_before=a2,
        u=u,
        theta=theta,
        g=g,
        lengths=lengths,
        actors=actors,
        table=table,
    )
    v4, a4 = advance_stage(
        t_s=t_s,
        ahead_s=h_s,
        q=q1,
        qd=v1,
        qd_before=v3,
        qdd_before=a3,
        u=u,
        theta=theta,
        g=g,
        lengths=lengths,
        actors=actors,
        table=table,
    )
    return combine_stages(
        h_s=h_s,
        q=q1,
        qd=v1,
        qd_2=v2,
        qd_3=v3,
        qd_4=v4,
        qdd_1=a1,
        qdd_2=a2,
        qdd_3=a3,
        qdd_4=a4,
    )


@leaf
def move_arm(s: Row, q: Pair, qd: Pair) -> bool:
    """Writes joint angles and velocities into the state of an arm, if all are finite.

    A simulation that has become unstable then stops at its last finite state and does not fill
    the log with NaN.

    Returns:
        True if all values are finite. Otherwise False, and the state is unchanged.
    """
    is_finite = isfinite(q[0]) and isfinite(q[1]) and isfinite(qd[0]) and isfinite(qd[1])
    if not is_finite:
        return False
    put_pair(s.q, q)
    put_pair(s.qd, qd)
    return True


@leaf
def advance_arm(
    t_s: float, h_s: float, s: Row, actors: TorqueSourceRows, table: TorqueTable
) -> bool:
    """Simulates the motion of the arm over one period (fourth-order Runge-Kutta method).

    The torque `s.u` is constant during the period. The joint angles q and velocities qd at the
    end of the period are written into the state of the site.

    Args:
        t_s: Time at the beginning of the period, s since the start of the session.
        h_s: The period, s.
        s: State of the site; modified.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.

    Returns:
        True if the result is finite. Otherwise False, and q and qd are unchanged.
    """
    q, qd = rk4_step(
        t_s=t_s,
        h_s=h_s,
        q=read_pair(s.q),
        qd=read_pair(s.qd),
        u=read_pair(s.u),
        theta=read_five(s.theta),
        g=s.g,
        lengths=read_pair(s.lengths),
        actors=actors,
        table=table,
    )
    return move_arm(s, q, qd)
