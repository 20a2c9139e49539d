"""The parts of a control period that depend on the arm model, for an arm with n joints.

`kernel` computes a control period (tick) in eight stages. Some of them, such as the torque of
the control law, need the dynamics of the arm. This module implements these stages for a serial
chain, using recursions from joint to joint. The argument `chain` holds one row per joint,
described in `chain_dtype`.

Invariant:
    - `two_link_stages` provides the same functions for the planar two-link arm. `kernel` uses
      one module or the other.
"""

from math import isfinite

from ..step.control import limit_torque, robust_torque
from ..step.jit import leaf
from ..step.site_setup import Law
from ..step.vectors import Array, Row, RowArray, Vector, choose
from .chain import (
    find_acceleration,
    friction_torque,
    inverse_dynamics,
    parameter_gradient,
    place_joints,
    propagate_motion,
    put_model,
)
from .exogenous import TorqueSourceRows, TorqueTable, put_torque_on_chain
from .task_space import add_task_torque, update_pose, update_task_errors, update_wrench

_ADAPTIVE = int(Law.ADAPTIVE)


@leaf
def place_chain(s: Row, chain: RowArray) -> None:
    """Updates the pose of every link and, in task space, the pose of the end effector.

    Call this function whenever the joint positions change, because the other functions of this
    module use the poses.

    Args:
        s: State of the site. In task space (where arms follow each other's end effectors
            instead of joint angles), the end effector pose is written into it.
        chain: Joint data, one row per joint; the frames are updated.
    """
    place_joints(chain, s.q)
    if s.task:
        update_pose(s, chain)


@leaf
def update_errors(s: Row, chain: RowArray) -> None:
    """Computes the tracking errors of a chain and the reference motion of its control law.

    The results are the position error e, the velocity error ed, the filtered error r, and the
    reference velocity v and acceleration a. For the adaptive law, the product Y' r (Y is the
    regressor of the arm's dynamics) is also computed. The law uses this product to update its
    estimate of the dynamic parameters.

    Args:
        s: State of the site; the results are written into it.
        chain: Joint data, one row per joint. `place_chain` must have been called before.
    """
    if s.task:
        update_task_errors(s)
    else:
        _update_joint_errors(s, chain.shape[0])
    if s.law == _ADAPTIVE:
        propagate_motion(chain=chain, gravity=s.gravity, qd=s.qd, v=s.v, a=s.a)
        parameter_gradient(chain, s.Yr)


@leaf
def _update_joint_errors(s: Row, joints: int) -> None:
    """Computes the tracking errors of an arm that follows other arms joint by joint.

    For each joint, e = q - q_des is the position error, ed its derivative, v = -Lambda e the
    reference velocity, a its derivative, and r = qd - v the filtered error on which the control
    law acts.

    Args:
        s: State of the site, with the angles q, the velocities qd, the reference q_des and its
            rate qd_des, and the gain Lambda, 1/s; modified.
        joints: Number of joints.
    """
    for i in range(joints):
        s.e[i] = s.q[i] - s.q_des[i]
        s.ed[i] = s.qd[i] - s.qd_des[i]
        s.v[i] = -s.Lambda[i] * s.e[i]
        s.a[i] = -s.Lambda[i] * s.ed[i]
        s.r[i] = s.qd[i] - s.v[i]


@leaf
def advance_estimate(s: Row, gain_s: float, Yr: Vector) -> None:
    """Integrates the adaptive law's estimate of the dynamic parameters over a time step.

        theta_hat <- theta_hat - gain_s Gamma Y' r, limited to lower and upper bounds

    Here theta_hat is the estimate of parameters such as masses, Gamma the diagonal matrix of
    adaptation gains, Y the regressor of the arm's dynamics, and r the filtered tracking error.

    Args:
        s: State of the site, which contains theta_hat and Gamma.
        gain_s: Duration of the step, s.
        Yr: The product Y' r, shape (P,) for P parameters.
    """
    for p in range(s.parameters):
        step = gain_s * s.Gamma[p] * Yr[p]
        estimate = s.theta_hat[p] - step
        s.theta_hat[p] = min(max(estimate, s.low[p]), s.high[p])


@leaf
def update_torque(s: Row, chain: RowArray) -> None:
    """Computes the motor torque of a built-in control law, limited to the motors' range.

    The law is either the adaptive law, including its robust term (a bounded torque against
    disturbances), or a law that compensates for a known gravity torque
    (`control.damped_torque`).

    Args:
        s: State of the site; the torque is written into it.
        chain: Joint data, one row per joint. `place_chain` must have been called before.
    """
    if s.law == _ADAPTIVE:
        inverse_dynamics(chain=chain, theta=s.theta_hat, v=s.v, a=s.a, torque=s.tau)
    else:
        put_gravity(s, chain, s.known, s.tau)
    if s.task:
        add_task_torque(s=s, gains=s.Kd, values=s.ed, factor=-1.0, torque=s.tau)
        if s.law != _ADAPTIVE:
            add_task_torque(s=s, gains=s.K, values=s.e, factor=-1.0, torque=s.tau)
            add_task_torque(s=s, gains=s.k_f, values=s.felt, factor=1.0, torque=s.tau)
    for i in range(chain.shape[0]):
        torque: float = s.tau[i]
        if not s.task:
            torque -= s.Kd[i] * s.ed[i]
            if s.law != _ADAPTIVE:
                reflected = s.k_f[i] * s.felt[i]
                spring = s.K[i] * s.e[i]
                torque += reflected - spring
        if s.law == _ADAPTIVE:
            torque -= s.Kp[i] * s.r[i]
            # The inverse dynamics contain the friction in full.
            uncompensated = 1.0 - s.friction[i]
            friction = uncompensated * friction_torque(chain[i], s.v[i])
            torque = choose(uncompensated != 0.0, torque - friction, torque)
            width = choose(s.rho[i] > 0.0, s.width[i], 1.0)
            robust = robust_torque(s.rho[i], width, s.r[i])
            torque = choose(s.rho[i] > 0.0, torque - robust, torque)
        else:
            torque -= s.d[i] * s.qd[i]
        s.tau[i] = limit_torque(torque, s.tau_limit[i])


@leaf
def put_gravity(s: Row, chain: RowArray, theta: Array, torque: Array) -> None:
    """Computes the torque that holds the chain against gravity, for given parameters.

    This is the inverse dynamics at zero velocity and acceleration. `place_joints` must have
    been called for the current positions.

    Args:
        s: State of the site.
        chain: Joint data, one row per joint.
        theta: Inertial parameters, shape (10 n,).
        torque: Receives the torque, shape (n,), N m.
    """
    zeros = s.zeros
    propagate_motion(chain=chain, gravity=s.gravity, qd=zeros, v=zeros, a=zeros)
    inverse_dynamics(chain=chain, theta=theta, v=zeros, a=zeros, torque=torque)


@leaf
def put_gravity_torque(s: Row, chain: RowArray, q: Array, torque: Array) -> None:
    """Computes the gravity torque at the joints of a simulated arm, using its true masses.

    The controller may not know these masses. `put_gravity` takes the parameters as an argument
    instead.

    Args:
        s: Settings of the site, including the true parameters.
        chain: Joint data, one row per joint; the frames are updated.
        q: Joint positions, shape (n,), rad or m.
        torque: Receives the gravity torque, shape (n,), N m.
    """
    place_joints(chain, q)
    put_gravity(s, chain, s.theta, torque)


@leaf
def update_model(s: Row, chain: RowArray) -> None:
    """Computes the dynamic model that a user-written control law can read, for a chain.

    The model always contains the gravity torque G. On request it also contains the inertia
    matrix M and the bias torque, which is C qd + G plus friction, minus the torque of the joint
    stops. C is the Coriolis matrix, and qd are the joint velocities.

    Args:
        s: State of the site; the model is written into it.
        chain: Joint data, one row per joint. `place_joints` must have been called before.
    """
    put_gravity(s, chain, s.known, s.G)
    if s.needs_model != 0:
        put_model(
            chain=chain, theta=s.known, gravity=s.gravity, q=s.q, qd=s.qd, M=s.M, bias=s.bias
        )


@leaf
def put_source_torque(
    t_s: float,
    s: Row,
    chain: RowArray,
    state: Array,
    actors: TorqueSourceRows,
    table: TorqueTable,
    sampled: int,
    torque: Array,
) -> None:
    """Computes the joint torque that operators and environments exert on an arm.

    Some of them are sampled: their torque is evaluated once per control period and held
    constant. All others act continuously. One call covers one of the two groups.

    Args:
        t_s: Time since the start of the session, s.
        s: Settings of the site.
        chain: Joint data, one row per joint; the frames are updated.
        state: Joint positions, followed by joint velocities, shape (2 n,).
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
        sampled: 1 for the torque of the sampled operators and environments, 0 for all others.
        torque: Receives the torque on the arm, shape (n,), N m.
    """
    place_joints(chain, state)
    qd = state[chain.shape[0] :]
    put_torque_on_chain(
        t_s=t_s,
        q=state,
        qd=qd,
        tip=s.tip,
        chain=chain,
        actors=actors,
        table=table,
        sampled=sampled,
        torque=torque,
    )


@leaf
def update_external_torque(
    t_s: float, s: Row, chain: RowArray, actors: TorqueSourceRows, table: TorqueTable
) -> None:
    """Computes the torque that operators and environments exert on the arm at time t.

    The total torque, the part of it that is held constant until the next control period, and
    the largest wall force are written into `s`.

    Args:
        t_s: Time since the start of the session, s.
        s: State of the site; modified.
        chain: Joint data, one row per joint; the frames are updated.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
    """
    place_joints(chain, s.q)
    held_n = put_torque_on_chain(
        t_s=t_s,
        q=s.q,
        qd=s.qd,
        tip=s.tip,
        chain=chain,
        actors=actors,
        table=table,
        sampled=1,
        torque=s.held,
    )
    now_n = put_torque_on_chain(
        t_s=t_s,
        q=s.q,
        qd=s.qd,
        tip=s.tip,
        chain=chain,
        actors=actors,
        table=table,
        sampled=0,
        torque=s.on_arm,
    )
    s.wall_n = max(held_n, now_n)
    for i in range(chain.shape[0]):
        # Either `held` or `sensed` is zero.
        s.on_arm[i] += s.held[i] + s.sensed[i]
    if s.task:
        update_wrench(s)


@leaf
def put_stage_torque(
    t_s: float, s: Row, chain: RowArray, actors: TorqueSourceRows, table: TorqueTable
) -> None:
    """Computes the torque of operators and environments at a stage of the integrator.

    The Runge-Kutta method evaluates the accelerations of the arm four times per control period,
    at four states (stages). Since walls and springs act continuously, their torque is needed at
    the time and position of each stage.

    Args:
        t_s: Time of the stage, s since the start of the session.
        s: State of the site, with the positions `stage_q` and velocities `stage_qd` of the
            stage; `stage_torque` is written.
        chain: Joint data, one row per joint, placed at the angles `stage_q`.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
    """
    put_torque_on_chain(
        t_s=t_s,
        q=s.stage_q,
        qd=s.stage_qd,
        tip=s.tip,
        chain=chain,
        actors=actors,
        table=table,
        sampled=0,
        torque=s.stage_torque,
    )


@leaf
def put_stage_acceleration(s: Row, chain: RowArray) -> None:
    """Computes the joint accelerations at an intermediate state (stage) of the integrator.

    The Runge-Kutta method evaluates the accelerations at four stages per control period. The
    total torque is the sum of the motor torque u, which is constant during the period, and the
    torque of operators and environments at this stage.

    Args:
        s: State of the site, with the positions `stage_q`, velocities `stage_qd` and external
            torques `stage_torque` of the stage. The accelerations are written into `stage_qdd`.
        chain: Joint data, one row per joint, placed at the angles `stage_q`.
    """
    for i in range(chain.shape[0]):
        s.stage_torque[i] += s.u[i]
    find_acceleration(
        chain=chain,
        theta=s.theta,
        gravity=s.gravity,
        q=s.stage_q,
        qd=s.stage_qd,
        torque=s.stage_torque,
        qdd=s.stage_qdd,
    )


@leaf
def _put_acceleration(
    t_s: float, s: Row, chain: RowArray, actors: TorqueSourceRows, table: TorqueTable
) -> None:
    """Computes the external torques and the joint accelerations at an integrator stage.

    A stage is one of the four states at which the Runge-Kutta method evaluates the
    accelerations of the arm in a control period.

    Args:
        t_s: Time of the stage, s since the start of the session.
        s: State of the site, with the positions `stage_q` and velocities `stage_qd` of the
            stage. The accelerations are written into `stage_qdd`.
        chain: Joint data, one row per joint.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.
    """
    # The torques and the dynamics depend on the positions of the links.
    place_joints(chain, s.stage_q)
    put_stage_torque(t_s=t_s, s=s, chain=chain, actors=actors, table=table)
    put_stage_acceleration(s, chain)


@leaf
def use_stage(s: Row, joints: int, weight: float, ahead_s: float) -> None:
    """Completes a stage of the Runge-Kutta method and prepares the next one.

    The method integrates the joint positions q and velocities qd over a period h. A stage is
    one of its four evaluations of the derivatives (qd, qdd), where qdd is the acceleration:

        q(t + h) = q(t) + h/6 (qd_1 + 2 qd_2 + 2 qd_3 + qd_4)        and the same for qd, qdd
        q_{n+1}  = q(t) + ahead_s qd_n                               and the same for qd, qdd

    The first line is the result; this function accumulates the sum in parentheses. The second
    line is the state at which stage n + 1 evaluates the derivatives.

    Args:
        s: State of the site. `q` and `qd` are the state at the beginning of the period.
            `stage_q`, `stage_qd` and `stage_qdd` belong to this stage; the first two are
            replaced by the state of the next stage. The sums `sum_qd` and `sum_qdd` are
            updated.
        joints: Number of joints.
        weight: Weight of this stage in the sums, 1 or 2.
        ahead_s: Time from the beginning of the period to the next stage, s.
    """
    for i in range(joints):
        s.sum_qd[i] += weight * s.stage_qd[i]
        s.sum_qdd[i] += weight * s.stage_qdd[i]
        # The order matters: the next `stage_q` needs the `stage_qd` of this stage.
        s.stage_q[i] = s.q[i] + ahead_s * s.stage_qd[i]
        s.stage_qd[i] = s.qd[i] + ahead_s * s.stage_qdd[i]


@leaf
def begin_stages(s: Row, joints: int) -> None:
    """Prepares the first of the four Runge-Kutta stages of a control period.

    The first stage starts from the current positions and velocities of the arm, and the sums of
    the derivatives are reset to zero.

    Args:
        s: State of the site.
        joints: Number of joints.
    """
    for i in range(joints):
        s.stage_q[i] = s.q[i]
        s.stage_qd[i] = s.qd[i]
        s.sum_qd[i] = 0.0
        s.sum_qdd[i] = 0.0


@leaf
def end_stages(h_s: float, s: Row, joints: int) -> bool:
    """Completes the Runge-Kutta method: computes the state at the end of the control period.

        q(t + h) = q(t) + h/6 sum_qd,    qd(t + h) = qd(t) + h/6 sum_qdd

    Args:
        h_s: The period h, s.
        s: State of the site, with the weighted sums of the velocities and accelerations of all
            stages. Positions q and velocities qd are written.
        joints: Number of joints.

    Returns:
        True if the result is finite. Otherwise positions and velocities are unchanged.
    """
    sixth = h_s / 6.0
    are_finite = True
    for i in range(joints):
        q = s.q[i] + sixth * s.sum_qd[i]
        qd = s.qd[i] + sixth * s.sum_qdd[i]
        s.stage_q[i] = q
        s.stage_qd[i] = qd
        are_finite = are_finite and isfinite(q) and isfinite(qd)

    if are_finite:
        for i in range(joints):
            s.q[i] = s.stage_q[i]
            s.qd[i] = s.stage_qd[i]
    return are_finite


@leaf
def advance_arm(
    t_s: float,
    h_s: float,
    s: Row,
    chain: RowArray,
    actors: TorqueSourceRows,
    table: TorqueTable,
) -> bool:
    """Simulates the motion of the arm over one period of the control loop.

    The motor torque is constant over the period. Uses the classical fourth-order Runge-Kutta
    method, and writes the joint positions and velocities at the end of the period into the
    state of the site.

    Args:
        t_s: Time at the beginning of the period, in s since the start of the session.
        h_s: The period, s.
        s: State of the site, with the motor torque `u`; modified.
        chain: Joint data, one row per joint.
        actors: Operators and environments, one row each.
        table: Numerical data of all operators and environments, for example recorded torques.

    Returns:
        True if the result is finite. Otherwise False, and positions and velocities are
        unchanged.
    """
    n = chain.shape[0]
    begin_stages(s, n)
    half = 0.5 * h_s
    # Four evaluations: at the beginning, twice in the middle, and at the end of the period. The
    # evaluations in the middle count twice.
    _put_acceleration(t_s=t_s, s=s, chain=chain, actors=actors, table=table)
    use_stage(s, n, 1.0, half)
    _put_acceleration(t_s=t_s + half, s=s, chain=chain, actors=actors, table=table)
    use_stage(s, n, 2.0, half)
    _put_acceleration(t_s=t_s + half, s=s, chain=chain, actors=actors, table=table)
    use_stage(s, n, 2.0, h_s)
    _put_acceleration(t_s=t_s + h_s, s=s, chain=chain, actors=actors, table=table)
    use_stage(s, n, 1.0, 0.0)
    return end_stages(h_s, s, n)
