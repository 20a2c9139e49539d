"""Task-space control: the end effectors of different arms follow each other.

In joint space, arms compare their joint angles instead, which requires identical kinematics.

Symbols: q and qd are the positions and velocities of the joints, J is the Jacobian of the
followed coordinates, and Jd its derivative. x is the pose of the end effector, and e its
deviation from the desired pose. The error decays at the rate Lambda, in 1/s. J' denotes the
transpose of a matrix, and dx/dt the derivative of a vector.

The control law needs a joint reference velocity v and its derivative a:

    v = psi + J' y                J J' y     = -Lambda e - J psi
    a = dpsi/dt + d(J' y)/dt      J J' dy/dt = -Lambda de/dt - Jd psi - J dpsi/dt
                                               - (Jd J' + J Jd') y

Here psi = -k (q - q_posture) pulls the joints towards a preferred posture at the rate k, in
1/s. Only the component of psi that does not move the end effector has an effect. The second
equation of the first line defines y. For the filtered error r = qd - v, it follows that J r =
dx/dt + Lambda e.

Near singular poses, damping is added to J J'. The damping is zero while 1 / trace((J J')^-1), a
lower bound of the square of the smallest singular value of J, exceeds the square of
`singular_value`.

Source: Y.-C. Liu and N. Chopra, "Controlled synchronization of heterogeneous robotic
manipulators in the task space", IEEE Trans. Robotics 28 (2012); damping after Y. Nakamura and
H. Hanafusa, "Inverse kinematic solutions with singularity robustness", J. Dynamic Systems,
Measurement, and Control 108 (1986).

Invariant:
    - All task-space vectors refer to a frame shared by all arms. They have 3 components for a
      position, m, or 6 for a pose that includes an orientation (see `rotation_vector`).
    - A coordinate that an arm does not follow has no effect on this arm.
"""

from ..step.jit import leaf
from ..step.vectors import Array, Row, RowArray, choose, holds_anywhere
from .chain import (
    Three,
    add_vectors,
    cross_product,
    place_end_effector,
    put_three,
    read_three,
    scale_vector,
    subtract_vectors,
)
from .rotation import compose_rotations, relative_rotation, rotation_matrix

POSITION = 3
"""Number of task-space coordinates if only positions are followed."""
POSE = 6
"""Number of task-space coordinates if positions and orientations are followed."""
TINY = 1e-12
"""Pivot of J J' below which the end effector cannot move along the axis at all."""


@leaf
def has_orientation(s: Row) -> bool:
    """Returns True if the arms follow each other in position and orientation (6 coordinates).

    Returns False if they follow only end effector positions, or joint angles.
    """
    is_pose: bool = s.task != 0 and s.shared == POSE
    return is_pose


@leaf
def count_linear_coordinates(s: Row) -> int:
    """Returns the number of shared coordinates whose difference is a plain subtraction.

    These are the positions (m) or joint angles (rad), which come first. In a pose, the last
    three coordinates are an orientation, and the difference of two orientations is a rotation.
    """
    return POSITION if has_orientation(s) else s.q_des.shape[0]


@leaf
def update_pose(s: Row, chain: RowArray) -> None:
    """Computes the pose and velocity of the end effector from the motion of the joints.

    The results are the pose x, its velocity xd, the Jacobian J and the derivative of J. A pose
    is a position, or a position and a rotation vector, in the frame shared by all arms.

    Args:
        s: State of the site, with the joint positions q and velocities qd; modified. `tip` is
            the end effector's position in the frame of the last link, m, `tip_back` the inverse
            of its orientation in that frame, and `scale` the ratio of the shared coordinates to
            the coordinates of this arm.
        chain: Joint data, one row per joint. `place_joints` must have been called before.
    """
    # This also writes the frames of the links and the columns of J in base axes.
    position = place_end_effector(chain, s.tip)
    shared_position = scale_vector(s.scale, position)
    put_three(s.x[:3], shared_position)
    if s.shared == POSE:
        # The orientation of the end effector is R_base tip_back', which this function converts
        # to a rotation vector.
        last: Row = chain[chain.shape[0] - 1]
        orientation = relative_rotation(last.R_base, s.tip_back)
        put_three(s.x[3:], orientation)

    # J and xd = J qd
    J = s.J
    xd = s.xd
    for j in range(s.shared):
        xd[j] = 0.0
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        rate = s.qd[i]
        for j in range(3):
            linear = s.scale * row.J_lin[j]
            J[j, i] = linear
            xd[j] += linear * rate
            if s.shared == POSE:
                angular = row.J_ang[j]
                J[3 + j, i] = angular
                xd[3 + j] += angular * rate
    _update_jacobian_rate(s, chain, position)


@leaf
def _update_jacobian_rate(s: Row, chain: RowArray, tip: Three) -> None:
    """Computes the time derivative of the end effector's Jacobian J.

    J has one column per joint. It changes because the joint axes turn with their links, and
    because the joints and the end effector move.

    Args:
        s: State of the site, with the joint velocities qd; the derivative is written into `Jd`.
        chain: Joint data, one row per joint. `place_end_effector` must have been called before.
        tip: Position of the end effector in base axes, m.
    """
    zeros = (0.0, 0.0, 0.0)
    angular_velocity = zeros
    origin_velocity = zeros
    tip_velocity = zeros
    origin_before = zeros
    for i in range(chain.shape[0]):
        column = read_three(chain[i].J_lin)
        joint_part = scale_vector(s.qd[i], column)
        tip_velocity = add_vectors(tip_velocity, joint_part)

    for i in range(chain.shape[0]):
        row: Row = chain[i]
        axis = read_three(row.axis_base)
        origin = read_three(row.p_base)
        joint_velocity = scale_vector(s.qd[i], axis)
        # The previous link carries the joint's origin along.
        link_vector = subtract_vectors(origin, origin_before)
        link_velocity = cross_product(angular_velocity, link_vector)
        origin_velocity = add_vectors(origin_velocity, link_velocity)
        origin_before = origin
        if row.prismatic == 0:
            # The derivatives of the joint's columns, J_ang = axis and J_lin = axis x lever.
            angular_velocity = add_vectors(angular_velocity, joint_velocity)
            axis_rate = cross_product(angular_velocity, axis)
            lever = subtract_vectors(tip, origin)
            lever_rate = subtract_vectors(tip_velocity, origin_velocity)
            axis_part = cross_product(axis_rate, lever)
            lever_part = cross_product(axis, lever_rate)
            linear = add_vectors(axis_part, lever_part)
            angular = axis_rate
        else:
            # The derivatives of J_ang = 0 and J_lin = axis.
            origin_velocity = add_vectors(origin_velocity, joint_velocity)
            linear = cross_product(angular_velocity, axis)
            angular = zeros
        for j in range(3):
            s.Jd[j, i] = s.scale * linear[j]
            if s.shared == POSE:
                s.Jd[3 + j, i] = angular[j]


@leaf
def update_orientation_reference(s: Row, links: RowArray) -> None:
    """Computes the desired orientation of the end effector, and its angular velocity.

    The reference is the orientation R_i of this arm, rotated towards the other arms. The
    rotation vector is

        -sum_j alpha_ij Log(R_i R_j')

    where R_j is the orientation of arm j, alpha_ij the weight that this arm gives to it, and
    Log converts a rotation matrix to a rotation vector. The angular velocity is the weighted
    sum of the other arms' angular velocities w_j, plus the effect of changing weights:

        sum_j (alpha_ij w_j - alpha_ij' Log(R_i R_j'))

    This is exact only if the orientations agree.

    Args:
        s: State of the site; the reference is written into it.
        links: States of the links from the other arms, one row per link.
    """
    rotation_vector = read_three(s.x[3:])
    orientation = rotation_matrix(rotation_vector)
    difference = (0.0, 0.0, 0.0)
    velocity = (0.0, 0.0, 0.0)
    for j in range(links.shape[0]):
        link: Row = links[j]
        peer_vector = read_three(link.q[3:])
        peer_orientation = rotation_matrix(peer_vector)
        turn = relative_rotation(orientation, peer_orientation)
        weighted_turn = scale_vector(link.alpha, turn)
        difference = add_vectors(difference, weighted_turn)
        peer_velocity = scale_vector(link.alpha, read_three(link.qd[3:]))
        ramp_velocity = scale_vector(-link.alpha_rate, turn)
        link_velocity = add_vectors(peer_velocity, ramp_velocity)
        velocity = add_vectors(velocity, link_velocity)
    turn_back = scale_vector(-1.0, difference)
    reference = compose_rotations(turn_back, rotation_vector)
    put_three(s.q_des[3:], reference)
    put_three(s.qd_des[3:], velocity)


@leaf
def _divide(number: float, pivot: float) -> float:
    """Returns a number divided by a pivot of a matrix factorisation, or 0 if the pivot is 0.

    A pivot of J J' is 0 for a direction in which the end effector cannot move. The result 0
    then means no motion in that direction.
    """
    has_pivot = pivot > TINY
    return choose(has_pivot, number / choose(has_pivot, pivot, 1.0), 0.0)


@leaf
def _factor(s: Row, damping: float) -> None:
    """Factors the matrix J J' + damping I as L D L', for use by `_solve`.

    J is the Jacobian of the end effector. L is a lower triangular matrix with ones on its
    diagonal, and D a diagonal matrix. They are stored together in `s.A`: D on the diagonal, and
    L below it. Row by row, with the matrix B = J J' + damping I,

        L_jk D_k = B_jk - sum_{p < k} L_jp L_kp D_p    for k < j
        D_j      = B_jj - sum_{p < j} L_jp^2 D_p

    J has a row of zeros for each axis that is not followed. For such an axis, 1 is added to the
    diagonal of B, so that its pivot D_j is not zero. If any other pivot is zero, the arm cannot
    move along that axis, and the column of L is set to zero.

    Args:
        s: State of the site. `axes` is 1 for each axis that is followed, otherwise 0.
        damping: The damping, in the unit of J J'. It is zero except near singular poses.
    """
    J = s.J
    A = s.A
    for j in range(s.shared):
        for k in range(j + 1):
            entry = 0.0  # an entry of B, then of L or D
            if k == j:
                entry = damping + 1.0 - s.axes[j]
            for i in range(s.joints):
                entry += J[j, i] * J[k, i]
            for p in range(k):
                pivot = A[p, p]
                product = A[j, p] * A[k, p]
                entry -= product * pivot
            if k < j:
                entry = _divide(entry, A[k, k])
            A[j, k] = entry


@leaf
def _solve(s: Row, b: Array, y: Array) -> None:
    """Solves the linear system L D L' y = b by forward and backward substitution.

    The lower triangular matrix L and the diagonal matrix D are stored in `s.A` by `_factor`,
    which must have been called before.

    Args:
        s: State of the site. `A` has D on its diagonal, and the lower triangular matrix L below
            it.
        b: Right-hand side, shape (m,) for m coordinates of the end effector.
        y: Receives the solution, shape (m,).
    """
    A = s.A
    coordinates = s.shared
    # Substitute forwards: y becomes the solution of L y = b.
    for j in range(coordinates):
        y[j] = b[j]
        for k in range(j):
            y[j] -= A[j, k] * y[k]
    for j in range(coordinates - 1, -1, -1):
        y[j] = _divide(y[j], A[j, j])
        for k in range(j + 1, coordinates):
            y[j] -= A[k, j] * y[k]


@leaf
def _factor_damped(s: Row) -> None:
    """Factors J J', adding damping near singular poses.

    J is the Jacobian of the end effector. 1 / trace((J J')^-1) is a lower bound of the square
    of the smallest singular value of J. If this bound is below the square of
    `s.singular_value`, the damping is the difference, otherwise zero. The trace covers the
    followed axes. It is computed from the undamped factors by solving for each column of the
    inverse.

    Args:
        s: State of the site. J and its derivative Jd get rows of zeros for axes that are not
            followed. The factors are written into A (see `_factor`). `b` and `y` are work
            space.
    """
    for j in range(s.shared):
        mask = s.axes[j]
        for i in range(s.joints):
            s.J[j, i] *= mask
            s.Jd[j, i] *= mask

    _factor(s, 0.0)
    limit = s.singular_value * s.singular_value
    trace = 0.0 * limit  # zero, or one zero for each of several runs side by side
    for j in range(s.shared):
        # With a pivot that vanishes or is NaN, the true trace is infinite. This value makes the
        # lower bound practically zero.
        trace = choose(s.A[j, j] > TINY, trace, 1.0 / TINY)
        # Solving for a unit vector gives a column of the inverse.
        for k in range(s.shared):
            s.b[k] = 1.0 if k == j else 0.0
        _solve(s, s.b, s.y)
        diagonal = s.y[j]
        trace += diagonal * s.axes[j]

    has_trace = trace > 0.0
    lower_bound = choose(has_trace, 1.0 / choose(has_trace, trace, 1.0), limit)
    is_near_singular = lower_bound < limit
    if holds_anywhere(is_near_singular):
        # Without damping, the factors stay the same.
        _factor(s, choose(is_near_singular, limit - lower_bound, 0.0))


@leaf
def _update_axis_errors(s: Row) -> None:
    """Computes the error e of the end effector and its derivative ed, for each axis.

    For a position, e is the difference from the reference, m. For a pose, the last three
    entries of e are the rotation vector from the reference orientation to the current
    orientation, rad. Both are zero along axes that are not followed, so the control law does
    not act along them.
    """
    for j in range(s.shared):
        s.e[j] = s.x[j] - s.q_des[j]
        s.ed[j] = s.xd[j] - s.qd_des[j]
    if s.shared == POSE:
        orientation = rotation_matrix(read_three(s.x[3:]))
        reference = rotation_matrix(read_three(s.q_des[3:]))
        turn = relative_rotation(orientation, reference)
        put_three(s.e[3:], turn)
    for j in range(s.shared):
        mask = s.axes[j]
        s.e[j] *= mask
        s.ed[j] *= mask


@leaf
def update_task_errors(s: Row) -> None:
    """Computes the errors of the end effector and the reference motion of the joints.

    The results are the errors e and ed of the followed coordinates, the joint reference
    velocity v and acceleration a, and the filtered error r = qd - v. With the Jacobian J and a
    velocity psi that pulls the joints towards a preferred posture,

        v = psi + J' y                J J' y     = -Lambda e - J psi
        a = dpsi/dt + d(J' y)/dt      J J' dy/dt = -Lambda de/dt - Jd psi - J dpsi/dt
                                                   - (Jd J' + J Jd') y

    Args:
        s: State of the site; the results are written into it.
    """
    n = s.joints
    m = s.shared
    J = s.J
    Jd = s.Jd
    b = s.b
    y = s.y
    v = s.v
    a = s.a
    # Jd' y and J' y are stored in fields that the integrator needs only later.
    Jd_y = s.stage_q
    J_y = s.stage_qd
    _update_axis_errors(s)
    _factor_damped(s)
    k = s.posture_rate

    # y, from J J' y = -Lambda e - J psi, with psi = -k (q - q_posture)
    for j in range(m):
        b[j] = -s.Lambda[j] * s.e[j]
        for i in range(n):
            posture_error = s.q[i] - s.posture[i]
            b[j] += J[j, i] * k * posture_error
    # v and a start as psi and its derivative.
    for i in range(n):
        posture_error = s.q[i] - s.posture[i]
        v[i] = -k * posture_error
        a[i] = -k * s.qd[i]
    _solve(s, b, y)
    for i in range(n):
        Jd_y[i] = 0.0
        J_y[i] = 0.0
        for j in range(m):
            Jd_y[i] += Jd[j, i] * y[j]
            J_y[i] += J[j, i] * y[j]

    # dy/dt, from J J' dy/dt = -Lambda de/dt - Jd (psi + J' y) - J (dpsi/dt + Jd' y)
    for j in range(m):
        b[j] = -s.Lambda[j] * s.ed[j]
        for i in range(n):
            rate = v[i] + J_y[i]
            acceleration = a[i] + Jd_y[i]
            Jd_part = Jd[j, i] * rate
            J_part = J[j, i] * acceleration
            b[j] -= Jd_part + J_part
    _solve(s, b, y)

    # v = psi + J' y and a = dpsi/dt + Jd' y + J' dy/dt
    for i in range(n):
        v[i] += J_y[i]
        a[i] += Jd_y[i]
        for j in range(m):
            a[i] += J[j, i] * y[j]
        s.r[i] = s.qd[i] - v[i]


@leaf
def add_task_torque(s: Row, gains: Array, values: Array, factor: float, torque: Array) -> None:
    """Adds the joint torque that exerts a given force at the end effector.

    The force is the product of gains and values, for example a stiffness times a position
    error. The torque is factor J' (gains * values), where J is the Jacobian of the end
    effector.

    Args:
        s: State of the site, with J.
        gains: Gain for each coordinate of the end effector.
        values: Value for each coordinate of the end effector, for example the position error.
        factor: Factor applied to the force.
        torque: The torque is added to this array, shape (n,), N m.
    """
    for i in range(s.joints):
        for j in range(s.shared):
            force = gains[j] * values[j]
            torque[i] += factor * s.J[j, i] * force


@leaf
def update_wrench(s: Row) -> None:
    """Computes the force and torque at the end effector for the external joint torque tau_x.

    This wrench is the solution of

        J J' wrench = J tau_x

    where J is the Jacobian of the end effector and tau_x the external joint torque, due to
    operators and environments. The torque ON the arm is -tau_x. J J', including its damping
    near singular poses, must already have been factored (by `update_task_errors`).

    Args:
        s: State of the site, with the torque ON each joint in `on_arm`, N m. The wrench is
            written into it, one entry per shared coordinate, N and N m.
    """
    J_tau_x = s.b
    for j in range(s.shared):
        J_tau_x[j] = 0.0
        for i in range(s.joints):
            torque_on_joint = s.on_arm[i]
            J_tau_x[j] -= s.J[j, i] * torque_on_joint
    _solve(s, J_tau_x, s.wrench)
