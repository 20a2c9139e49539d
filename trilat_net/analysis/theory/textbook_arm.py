"""Computes the dynamics of an arm from textbook equations, for the linear analysis.

The arm is a chain of n joints. The module also computes the reference motion with which the arm
follows other arms. All equations are implemented in plain NumPy and share no code with the
compiled simulation, which makes them an independent check. The planar arm with two joints is in
`analysis.arm_rows.PlacedArm`. Vectors have their components on the first axis, and any number
of columns on the following axes.

The equations use spatial vectors, which combine a linear and an angular half (Featherstone,
"Rigid Body Dynamics Algorithms", 2008). The linear half comes first and refers to the origin of
the link's own frame. The following symbols are used:

- q, qd: joint angles and their velocities.
- v, a: reference velocities and accelerations of the joints, from the control law.
- J_i, I_i: Jacobian and spatial inertia of link i. V_i = J_i qd and W_i = J_i v are velocities.
- X, S: transformation from the frame of the previous link, and axis of the joint.
- x, x*: cross products of spatial motions and of spatial forces.

The acceleration of link i includes gravity and is computed from the acceleration A_p of the
previous link. It determines the force f_i on the link:

    A_i = X A_p + S a_i + V_i x (S v_i)
    f_i = I_i A_i + 1/2 (V_i x* I_i W_i + W_i x* I_i V_i - I_i (V_i x W_i))

The force is linear in the ten inertial parameters p_i of the link: f_i = F_i p_i. From this
follow the regressor Y = (J_1' F_1 ... J_n' F_n), the matrix that multiplies the parameters in
the torque, and the inertia matrix M = sum_i J_i' I_i J_i.

If end effectors follow each other instead of joints, the reference motion is computed as in
`analysis.following.find_task_reference`. docs/reference/task-space.md contains the equations
and sources.

Invariant:
    - The arithmetic of the compiled simulation is not used.
    - Every function is analytic in every argument, so a complex step yields derivatives that
      are exact up to rounding. The only exception is a chain at a joint stop, where the real
      part of the argument selects the branch.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ...core import (
    COULOMB_SPEED,
    LINK_PARAMETERS,
    POSITION,
    Array,
    ChainJoint,
    ChainSetup,
    SiteSetup,
    TaskSetup,
)
from ..arm_rows import Numbers, multiply_columns, solve_columns
from ..following import find_task_reference

_EPSILON = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _EPSILON[_i, _j, _k] = 1.0
    _EPSILON[_i, _k, _j] = -1.0
_INERTIA_ENTRIES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
"""Rows and columns of Ixx, Ixy, Iyy, Ixz, Iyz, Izz."""


def _build_cross_matrix(a: Numbers) -> Numbers:
    """Returns the matrix A that computes a cross product, A b = a x b, shape (3, 3, ...).

    Args:
        a: The left factor of the cross product, shape (3, ...).
    """
    matrix: Numbers = np.einsum("ijk,j...->ik...", _EPSILON, a)
    return matrix


def _build_inertia_units() -> Numbers:
    """Returns the spatial inertia of a link for each unit parameter, shape (10, 6, 6).

    A link's inertia is linear in its parameters: mass, first moments, second moments.
    """
    units = np.zeros((LINK_PARAMETERS, 6, 6))
    mass = units[0]
    mass[:3, :3] = np.eye(3)
    for n, axis in enumerate(np.eye(3)):
        cross = _build_cross_matrix(axis)
        first_moment = units[1 + n]
        first_moment[:3, 3:] = -cross
        first_moment[3:, :3] = cross
    for n, (row, column) in enumerate(_INERTIA_ENTRIES):
        second_moment = units[4 + n]
        # the angular half of a spatial inertia begins at index 3
        angular = second_moment[3:, 3:]
        angular[row, column] = 1.0
        angular[column, row] = 1.0
    return units


_INERTIA_UNITS = _build_inertia_units()


def _cross_motion(V: Numbers) -> Numbers:
    """Returns the matrix of the spatial cross product V x, shape (6, 6, ...).

    The matrix of V x* for forces is minus its transpose.
    """
    linear = V[:3]
    angular = V[3:]
    columns = V.shape[1:]
    matrix = np.zeros((6, 6, *columns), V.dtype)
    rotation = _build_cross_matrix(angular)
    matrix[:3, :3] = rotation
    matrix[3:, 3:] = rotation
    matrix[:3, 3:] = _build_cross_matrix(linear)
    return matrix


def _multiply(a: Numbers, b: Numbers) -> Numbers:
    """Returns the product of matrices of shapes (a, b, ...) and (b, c, ...)."""
    product: Numbers = np.einsum("ab...,bc...->ac...", a, b)
    return product


def _transpose(a: Numbers) -> Numbers:
    """Returns the transposes of matrices of shape (a, b, ...)."""
    return a.swapaxes(0, 1)


def _repeat_columns(vector: Numbers, columns: tuple[int, ...]) -> Numbers:
    """Returns an array of shape (*vector.shape, *columns) that repeats `vector`."""
    ones = np.ones(columns)
    repeated: Numbers = np.multiply.outer(vector, ones)
    return repeated


def _add_axes(values: Numbers, shape: tuple[int, ...], count: int) -> Numbers:
    """Reshapes values to `shape` and adds `count` axes of length 1, to fit any columns."""
    trailing = (1,) * count
    return values.reshape(*shape, *trailing)


class _PlacedLink(NamedTuple):
    """Pose and Jacobian of one link of an arm, for one or several poses of the arm.

    The arm has n joints. The axes "..." of the arrays stand for the poses. A spatial velocity
    combines a linear and an angular velocity.

    Attributes:
        X: Transformation of spatial velocities from the frame of the previous link into this
            link's frame, shape (6, 6, ...).
        S: Spatial velocity of the link's joint at speed 1, shape (6,).
        J: Jacobian that maps joint velocities to the link's spatial velocity, shape (6, n,
            ...).
        R_base: Orientation of the link relative to the base, as a rotation matrix, shape (3, 3,
            ...).
        place_m: Origin of the link's frame, relative to the base, shape (3, ...), in m.
    """

    X: Numbers
    S: Numbers
    J: Numbers
    R_base: Numbers
    place_m: Numbers


class PlacedChain:
    """Dynamics of a serial arm with n joints at given poses, such as its inertia matrix.

    The class implements textbook formulas independently of the simulation, in order to verify
    the simulation. The trailing axes "..." enumerate the poses. It has the same methods as the
    planar arm, `PlacedArm`.

    Args:
        chain: Description of the links and joints.
        q: Joint angles, shape (n, ...), in rad, or positions of prismatic joints in m.
    """

    def __init__(self, chain: ChainSetup, q: Numbers) -> None:
        self._chain = chain
        self._q = q
        self._columns = q.shape[1:]
        self._links: list[_PlacedLink] = []

        joints = len(q)
        columns = self._columns
        J = np.zeros((6, joints, *columns))
        R_base = _repeat_columns(np.eye(3), columns)
        place_m = np.zeros((3, *columns))
        for i, joint in enumerate(chain.joints):
            R, p = _place_joint(joint, q[i])

            X = _transform_velocities(R, p)
            S = _find_joint_axis(joint)
            J = _multiply(X, J)
            J[:, i] += _add_axes(S, (6,), len(columns))
            offset_m = multiply_columns(R_base, p)
            place_m = place_m + offset_m
            R_base = _multiply(R_base, R)

            link = _PlacedLink(
                X=X,
                S=S,
                J=J,
                R_base=R_base,
                place_m=place_m,
            )
            self._links.append(link)

    def _get_per_joint(self, name: str) -> Numbers:
        """Returns one attribute of every joint, such as "viscous", shape (n, 1, ...)."""
        joints = self._chain.joints
        column_axes = len(self._columns)
        values = np.array([getattr(joint, name) for joint in joints])
        return _add_axes(values, (-1,), column_axes)

    def regressor_matrix(self, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Computes the regressor Y, the matrix that multiplies an arm's parameters.

        Y theta is the torque that the n links require for a reference motion, where theta
        contains the ten inertial parameters of each link. Drives and friction are not included.
        The arm is in the pose of this object.

        Args:
            qd: Joint velocities, shape (n, ...), in rad/s.
            v: Reference velocities of the joints, shape (n, ...), in rad/s.
            a: Reference accelerations of the joints, shape (n, ...), in rad/s^2.

        Returns:
            The regressor, shape (n, 10 n, ...).
        """
        blocks = []
        gravity = np.array([*self._chain.gravity_m_s2, 0.0, 0.0, 0.0])
        # an upward acceleration of the base stands for gravity
        A = -_repeat_columns(gravity, self._columns)
        for i, link in enumerate(self._links):
            V = multiply_columns(link.J, qd)
            W = multiply_columns(link.J, v)
            V_cross = _cross_motion(V)
            W_cross = _cross_motion(W)
            # acceleration A_i of the link: A_i = X A_p + S a_i + V_i x (S v_i)
            S_a = np.multiply.outer(link.S, a[i])
            S_v = np.multiply.outer(link.S, v[i])
            A_before = multiply_columns(link.X, A)
            velocity_product = multiply_columns(V_cross, S_v)
            A = A_before + S_a
            A = A + velocity_product

            # F_i, of which each column is the force f_i of a unit parameter
            I_A = _multiply_inertia_units(A)
            I_V = _multiply_inertia_units(V)
            I_W = _multiply_inertia_units(W)
            V_cross_W = multiply_columns(V_cross, W)
            I_VW = _multiply_inertia_units(V_cross_W)
            # V x* is minus the transpose of V x
            minus_V_force = _multiply(_transpose(V_cross), I_W)
            minus_W_force = _multiply(_transpose(W_cross), I_V)
            cross_terms = minus_V_force + minus_W_force + I_VW
            F = I_A - 0.5 * cross_terms
            J_transposed = _transpose(link.J)
            block = _multiply(J_transposed, F)
            blocks.append(block)
        return np.concatenate(blocks, axis=1)

    def required_torque(
        self,
        theta: Numbers,
        qd: Numbers,
        v: Numbers,
        a: Numbers,
    ) -> Numbers:
        """Returns the torque required for a reference motion, shape (n, ...), in N m.

        This torque is M(q) a + C(q, qd) v + G(q) + friction(v), with the inertia matrix M
        including the drives, the Coriolis matrix C and the gravity torque G.

        Args:
            theta: Dynamic parameters of the links, shape (10 n, ...).
            qd: Joint velocities, shape (n, ...).
            v: Reference velocities of the joints, shape (n, ...).
            a: Reference accelerations of the joints, shape (n, ...).
        """
        Y = self.regressor_matrix(qd, v, a)
        links = multiply_columns(Y, theta)
        armatures = self._get_per_joint("armature_kg_m2")
        drives = armatures * a
        friction = self.friction_torque(v)
        torque: Numbers = links + drives + friction
        return torque

    def friction_torque(self, v: Numbers) -> Numbers:
        """Returns the torque needed to overcome the joint friction of the arm, in N m.

        Args:
            v: Joint velocities, shape (n, ...).

        Returns:
            Torque, shape (n, ...), with the sign of the velocity.
        """
        viscous_damping = self._get_per_joint("viscous")
        coulomb_torque = self._get_per_joint("coulomb")
        viscous = viscous_damping * v
        # a smooth sign of the speed
        x = v / COULOMB_SPEED
        root = np.sqrt(1.0 + x * x)
        coulomb = coulomb_torque * x / root
        return viscous + coulomb

    def gravity_torque(self, theta: Numbers) -> Numbers:
        """Returns the torque that holds the arm still against gravity, shape (n, ...), in N m.

        Args:
            theta: Dynamic parameters of the links, shape (10 n, ...).
        """
        zeros = np.zeros_like(self._q)
        return self.required_torque(theta, zeros, zeros, zeros)

    def inertia_matrix(self, theta: Numbers) -> Numbers:
        """Returns the inertia matrix M(q), which maps joint accelerations to torques.

        The matrix includes the inertia of the drives. The shape is (n, n, ...), with one matrix
        per pose.

        Args:
            theta: Dynamic parameters of the links, shape (10 n, ...).
        """
        armatures = [joint.armature_kg_m2 for joint in self._chain.joints]
        drives = np.diag(armatures)
        M = _repeat_columns(drives, self._columns)
        for i, link in enumerate(self._links):
            first = LINK_PARAMETERS * i
            parameters = theta[first : first + LINK_PARAMETERS]
            inertia = np.einsum("pab,p...->ab...", _INERTIA_UNITS, parameters)
            momentum = _multiply(inertia, link.J)
            J_transposed = _transpose(link.J)
            link_inertia = _multiply(J_transposed, momentum)
            M = M + link_inertia
        return M

    def joint_acceleration(self, theta: Numbers, qd: Numbers, torque: Numbers) -> Numbers:
        """Returns the joint accelerations under a torque, shape (n, ...).

        The accelerations qdd solve the equation of motion M qdd + C qd + G + friction = torque
        + stops, Eq. (8), where "stops" is the torque of the mechanical stops.

        Args:
            theta: Dynamic parameters of the links, shape (10 n, ...).
            qd: Joint velocities, shape (n, ...).
            torque: Torque of controller, operator and environment, shape (n, ...), in N m.
        """
        no_acceleration = np.zeros_like(qd)
        bias = self.required_torque(theta, qd, qd, no_acceleration)
        applied = torque + self._compute_stop_torque(qd)
        M = self.inertia_matrix(theta)
        net_torque = applied - bias
        return solve_columns(M, net_torque)

    def _compute_stop_torque(self, qd: Numbers) -> Numbers:
        """Returns the torque of the mechanical end stops of the joints, shape (n, ...), in N m.

        An end stop is a spring with a damper at the end of a joint's range.
        """
        q = self._q
        stiffness = self._get_per_joint("stop_stiffness")
        damping = self._get_per_joint("stop_damping")
        total: Numbers = np.zeros_like(q)
        for name, sign in (("lower", 1.0), ("upper", -1.0)):
            limit = self._get_per_joint(name)
            penetration = sign * (limit - q.real)
            is_beyond = penetration > 0.0
            stop_position = np.where(is_beyond, limit, 0.0)

            spring = stiffness * (stop_position - q)
            damper = damping * qd
            push = spring - damper
            # a stop pushes and never pulls
            points_back = sign * push.real > 0.0
            pushes_back = is_beyond & points_back
            stop_torque = np.where(pushes_back, push, 0.0)
            total = total + stop_torque
        return total

    def end_effector_position(self) -> Numbers:
        """Returns the position of the end effector in the base frame, in m.

        The shape is (3, ...), with one column per pose.
        """
        last = self._links[-1]
        tip_m = np.array(self._chain.tip_m)
        tip = _repeat_columns(tip_m, self._columns)
        tip_offset_m = multiply_columns(last.R_base, tip)
        return last.place_m + tip_offset_m

    def end_effector_orientation(self) -> Numbers:
        """Returns the rotation matrix of the end effector in the base frame.

        The columns of the matrix are the axes of the end effector. The shape is (3, 3, ...),
        with one matrix per pose.
        """
        R_last = self._links[-1].R_base
        R_tip = self._chain.tip_rotation
        orientation: Numbers = np.einsum("ab...,bc->ac...", R_last, R_tip)
        return orientation

    def position_jacobian(self) -> Numbers:
        """Returns the Jacobian J of the end effector's position, whose velocity is J qd.

        The shape is (3, n, ...). The entries are in m/rad, or dimensionless for a prismatic
        joint.
        """
        return self.pose_jacobian()[:3]

    def pose_jacobian(self) -> Numbers:
        """Returns the Jacobian J of the end effector's velocity, in the axes of the base.

        The first three rows of J qd are the linear velocity, the last three the angular
        velocity. The shape is (6, n, ...).
        """
        last = self._links[-1]
        return self._move_to_tip(last.J)

    def pose_jacobian_rate(self, qd: Numbers) -> Numbers:
        """Returns the time derivative of the end effector's Jacobian during a motion.

        The Jacobian maps n joint velocities to the linear and angular velocity of the end
        effector, in the axes of the base.

        Args:
            qd: Joint velocities, shape (n, ...), in rad/s.

        Returns:
            The derivative, shape (6, n, ...).
        """
        last = self._links[-1]
        V_last = multiply_columns(last.J, qd)
        number_type = np.result_type(last.J, qd)
        rate = np.zeros(last.J.shape, number_type)
        columns = qd.shape[1:]
        for k, link in enumerate(self._links):
            rate = _multiply(link.X, rate)
            V = multiply_columns(link.J, qd)
            V_cross = _cross_motion(V)
            # in the frame of the link, the axis of its joint changes at the rate V x S
            S = _repeat_columns(link.S, columns)
            axis_rate = multiply_columns(V_cross, S)
            rate[:, k] += axis_rate
        # rates so far are relative to the base; the Jacobian is in the moving frame of the tip
        V_last_cross = _cross_motion(V_last)
        frame_motion = _multiply(V_last_cross, last.J)
        rate = rate - frame_motion
        rate = self._move_to_tip(rate)

        link_angular_velocity = V_last[3:]
        angular_velocity = multiply_columns(last.R_base, link_angular_velocity)
        spin = _build_cross_matrix(angular_velocity)
        J = self.pose_jacobian()
        linear = _multiply(spin, J[:3])
        angular = _multiply(spin, J[3:])
        frame_rate: Numbers = np.concatenate([linear, angular])
        return rate + frame_rate

    def _move_to_tip(self, columns: Numbers) -> Numbers:
        """Converts spatial velocities from the last link to the end effector (tip of the arm).

        The arguments are along the axes of the link, and the results along those of the base.
        Both have the shape (6, n, ...).
        """
        R = self._links[-1].R_base
        tip_m = np.array(self._chain.tip_m)
        tip_cross = _build_cross_matrix(tip_m)
        angular = columns[3:]
        lever_term = np.einsum("ab,bn...->an...", tip_cross, angular)
        linear = columns[:3] - lever_term
        base_linear = _multiply(R, linear)
        base_angular = _multiply(R, angular)
        return np.concatenate([base_linear, base_angular])


def _multiply_inertia_units(motion: Numbers) -> Numbers:
    """Returns the momentum of a spatial motion for each unit inertial parameter of a link.

    Column p of the result, shape (6, 10, ...), is the momentum of a link whose parameter p is 1
    and whose other parameters are 0.
    """
    momentum: Numbers = np.einsum("pab,b...->ap...", _INERTIA_UNITS, motion)
    return momentum


def _transform_velocities(R: Numbers, p: Numbers) -> Numbers:
    """Returns the matrix that transforms a spatial velocity into the frame of the next link.

    A spatial velocity has six components, three of rotation and three of translation.

    Args:
        R: Orientation of the link in the frame of the previous link, shape (3, 3, ...).
        p: Origin of the link in that frame, shape (3, ...), in m.
    """
    R_transposed = _transpose(R)
    p_cross = _build_cross_matrix(p)
    lever = _multiply(R_transposed, p_cross)
    columns = p.shape[1:]
    number_type = np.result_type(R, p)
    X = np.zeros((6, 6, *columns), number_type)
    X[:3, :3] = R_transposed
    X[3:, 3:] = R_transposed
    X[:3, 3:] = -lever
    return X


def _find_joint_axis(joint: ChainJoint) -> Array:
    """Returns the spatial velocity of a joint that moves at speed 1, shape (6,)."""
    S = np.zeros(6)
    half = S[:3] if joint.prismatic else S[3:]
    half[:] = joint.axis
    return S


def _place_joint(joint: ChainJoint, q: Numbers) -> tuple[Numbers, Numbers]:
    """Returns a link's orientation and origin in the frame of the previous link.

    A revolute joint turns by Rodrigues' formula, R = R_0 (1 + sin q K + (1 - cos q) K^2) with
    the cross matrix K of the axis.

    Args:
        joint: The joint.
        q: Position of the joint, shape (...), in rad or m.

    Returns:
        The orientation, shape (3, 3, ...).
        The origin, shape (3, ...), in m.
    """
    R_0 = np.array(joint.rotation)
    axis = np.array(joint.axis)

    columns = np.shape(q)
    origin_m = np.array(joint.origin_m)
    R = _repeat_columns(R_0, columns)
    p = _repeat_columns(origin_m, columns)

    if joint.prismatic:
        direction = R_0 @ axis
        shift = np.multiply.outer(direction, q)
        return R, p + shift

    # Rodrigues' formula: R_0 (1 + sin q K + (1 - cos q) K^2).
    K = _build_cross_matrix(axis)
    R_0_K = R_0 @ K
    sine_term = np.multiply.outer(R_0_K, np.sin(q))
    cosine_factor = 1.0 - np.cos(q)
    cosine_term = np.multiply.outer(R_0_K @ K, cosine_factor)
    return R + sine_term + cosine_term, p


SINGULAR = 1e-9
"""A pose is singular if the squared least singular value of its Jacobian is below this."""
_SMALL = 1e-4
"""Squares of angles below this are small: four terms of a series are then exact."""


def rotation_from_vector(vector: Numbers) -> Numbers:
    """Returns the rotation matrix of a rotation vector, shape (3, 3, ...).

    Uses Rodrigues' formula, with series expansions for small angles.

    Args:
        vector: Axis times angle, shape (3, ...), in rad.
    """
    square = np.sum(vector * vector, axis=0)
    is_small = square.real < _SMALL
    regular_square = np.where(is_small, 1.0, square)
    angle = np.sqrt(regular_square)
    # sin(x) / x and (1 - cos(x)) / x^2, with the inner factors of their series
    sine_inner = 1.0 - square / 20.0 * (1.0 - square / 42.0)
    cosine_inner = 1.0 - square / 30.0 * (1.0 - square / 56.0)
    sine_series = 1.0 - square / 6.0 * sine_inner
    cosine_series = 0.5 - square / 24.0 * cosine_inner

    sine_quotient = np.sin(angle) / angle
    versine = 1.0 - np.cos(angle)
    cosine_quotient = versine / angle**2

    sine_factor = np.where(is_small, sine_series, sine_quotient)
    cosine_factor = np.where(is_small, cosine_series, cosine_quotient)

    K = _build_cross_matrix(vector)
    K_squared = _multiply(K, K)

    column_axes = vector.ndim - 1
    identity = _add_axes(np.eye(3), (3, 3), column_axes)
    sine_term = sine_factor * K
    cosine_term = cosine_factor * K_squared
    rotation: Numbers = identity + sine_term + cosine_term
    return rotation


def vector_from_rotation(R: Numbers) -> Numbers:
    """Returns the rotation vector of a rotation matrix, shape (3, ...), of length at most pi.

    The vector is computed from the quaternion of the rotation.

    Args:
        R: Rotation matrix, shape (3, 3, ...).
    """
    quaternion = _find_quaternion(R)
    w = quaternion[0]
    v = quaternion[1:]
    square = np.sum(v * v, axis=0)
    is_small = square.real < _SMALL
    regular_square = np.where(is_small, 1.0, square)
    sine = np.sqrt(regular_square)

    # series of 2 atan(t) / sine, with t = tan(angle / 2)
    small_w = np.where(is_small, w, 1.0)
    small_square = np.where(is_small, square, 0.0)
    t_square = small_square / small_w**2
    series_tail = 1.0 / 5.0 - t_square / 7.0
    series_inner = 1.0 / 3.0 - t_square * series_tail
    series = 1.0 - t_square * series_inner
    small_factor = 2.0 / small_w * series

    # the arctangent of a ratio of at most 1, which avoids any division by zero
    is_below = sine.real <= w.real
    nonzero_w = np.where(w == 0.0, 1.0, w)
    divisor = np.where(is_below, nonzero_w, sine)
    dividend = np.where(is_below, sine, w)
    ratio = dividend / divisor
    arctangent = np.arctan(ratio)
    complement = 0.5 * np.pi - arctangent
    half_angle = np.where(is_below, arctangent, complement)

    large_factor = 2.0 * half_angle / sine
    factor = np.where(is_small, small_factor, large_factor)
    vector: Numbers = factor * v
    return vector


def _find_quaternion(R: Numbers) -> Numbers:
    """Returns the unit quaternion (w, x, y, z), w >= 0, of a rotation, shape (4, ...).

    Each row of `products` is the quaternion times four times one of its parts. The row of the
    largest part has the smallest rounding error (Shepperd, 1978).

    Args:
        R: Rotation matrix, shape (3, 3, ...).
    """
    xx = R[0, 0]
    yy = R[1, 1]
    zz = R[2, 2]
    w_x = R[2, 1] - R[1, 2]
    w_y = R[0, 2] - R[2, 0]
    w_z = R[1, 0] - R[0, 1]
    x_y = R[0, 1] + R[1, 0]
    x_z = R[0, 2] + R[2, 0]
    y_z = R[1, 2] + R[2, 1]

    # w_x is four times the product of w and x, and so on; squares likewise
    square_w = 1.0 + xx + yy + zz
    square_x = 1.0 + xx - yy - zz
    square_y = 1.0 - xx + yy - zz
    square_z = 1.0 - xx - yy + zz
    products = np.array(
        [
            [square_w, w_x, w_y, w_z],
            [w_x, square_x, x_y, x_z],
            [w_y, x_y, square_y, y_z],
            [w_z, x_z, y_z, square_z],
        ]
    )

    diagonal = [products[n, n].real for n in range(4)]
    sizes = np.array(diagonal)
    largest = sizes.argmax(axis=0)
    row = largest[np.newaxis, np.newaxis]
    quaternion = np.take_along_axis(products, row, axis=0)[0]

    square = np.sum(quaternion * quaternion, axis=0)
    quaternion = quaternion / np.sqrt(square)
    has_negative_w = quaternion[0].real < 0.0
    with_positive_w: Numbers = np.where(has_negative_w, -quaternion, quaternion)
    return with_positive_w


def _relative_rotation_vector(other: Numbers, R: Numbers) -> Numbers:
    """Returns the rotation vector that turns one orientation into another, in rad.

    It has the direction of the axis and the length of the angle. Its components are those along
    the axes of the base.

    Args:
        other: Rotation matrix of the orientation before the rotation, shape (3, 3, ...).
        R: Rotation matrix of the orientation after the rotation, shape (3, 3, ...).

    Returns:
        Rotation vector, shape (3, ...), in rad.
    """
    rotation = np.einsum("ab...,cb...->ac...", R, other)
    return vector_from_rotation(rotation)


def evaluate_reference(shares: Array, site_pose: Numbers, shared: Sequence[Numbers]) -> Numbers:
    """Computes the reference pose of a site's end effector from the poses of all sites.

    The site follows site j with the dominance factor alpha_j. The reference position is the
    weighted mean of the positions. For the orientation, the rotation from each other site's
    orientation to the site's own orientation is expressed as a rotation vector (axis times
    angle). The site's orientation is then rotated back by the weighted sum of these vectors.

    Args:
        shares: Dominance factors alpha for all N sites, shape (N,).
        site_pose: Pose of the site itself, shape (m, ...): the position and, if m is 6, a
            rotation vector in rad.
        shared: Pose of each site, shape (m, ...).

    Returns:
        The reference pose, shape (m, ...).
    """
    pairs = zip(shares.tolist(), shared, strict=True)
    followed = [(share, pose) for share, pose in pairs if share]
    position = sum(share * pose[:POSITION] for share, pose in followed)
    if len(site_pose) == POSITION:
        return np.asarray(position)

    site_rotation = site_pose[POSITION:]
    R = rotation_from_vector(site_rotation)
    weighted_rotations = []
    for share, pose in followed:
        peer_rotation = pose[POSITION:]
        R_peer = rotation_from_vector(peer_rotation)
        rotation = _relative_rotation_vector(R_peer, R)
        weighted_rotations.append(share * rotation)

    difference = np.asarray(sum(weighted_rotations))
    turn_back = rotation_from_vector(-difference)
    reference = _multiply(turn_back, R)
    # zero times the site's pose gives the position the same number of columns
    columns = np.asarray(position) + 0.0 * site_pose[:POSITION]
    orientation = vector_from_rotation(reference)
    return np.concatenate([columns, orientation])


class Following(NamedTuple):
    """Errors and reference motion with which an arm follows other arms.

    Either the n joints follow, in which case m is n, or the end effector follows along m
    coordinates.

    Attributes:
        x: Pose that other arms can follow, shape (m, ...).
        xd: Velocity of x, with an angular velocity for the orientation, shape (m, ...).
        e: Error of the followed coordinates, x minus the desired pose, shape (m, ...).
        ed: Error of the velocities, xd minus the desired velocity, shape (m, ...).
        v: Reference velocity of the joints, shape (n, ...), in rad/s.
        a: Reference acceleration of the joints, the derivative of v, shape (n, ...), in
            rad/s^2.
        J: Jacobian of the followed axes, shape (m, n, ...), or `None` if joints follow.
        A: Product J J', with damping added near singular poses, shape (m, m, ...), or `None` if
            joints follow.
        least: Lower bound on the squared smallest singular value of J before damping. Infinite
            if joints follow.
    """

    x: Numbers
    xd: Numbers
    e: Numbers
    ed: Numbers
    v: Numbers
    a: Numbers
    J: Numbers | None = None
    A: Numbers | None = None
    least: float = np.inf

    def to_joints(self, force: Numbers) -> Numbers:
        """Converts a force on the end effector to the corresponding joint torque.

        The torque is J' F, with the force F and the Jacobian J of the m followed axes.

        Args:
            force: Force F along the followed axes, shape (m, ...).

        Returns:
            Torque at the n joints, shape (n, ...). If the arm follows with its joints instead
            of its end effector, the argument is returned unchanged.
        """
        if self.J is None:
            return force
        J_transposed = _transpose(self.J)
        return multiply_columns(J_transposed, force)

    def from_joints(self, torque: Numbers) -> Numbers:
        """Converts a joint torque to the corresponding force on the end effector.

        The force is A^-1 J tau, with the joint torque tau, the Jacobian J of the m followed
        axes, and A = J J' plus damping near singular poses.

        Args:
            torque: Torque tau at the n joints, shape (n, ...), in N m.

        Returns:
            The force, shape (m, ...). If the arm follows with its joints instead of its end
            effector, the argument is returned unchanged.
        """
        if self.J is None or self.A is None:
            return torque
        along_axes = multiply_columns(self.J, torque)
        return solve_columns(self.A, along_axes)

    @classmethod
    def in_joints(
        cls,
        Lambda: Numbers,
        q: Numbers,
        qd: Numbers,
        q_des: Numbers,
        qd_des: Numbers,
    ) -> "Following":
        """Computes the errors and the reference motion of n joints that follow desired angles.

        The reference velocity of the joints is v = -Lambda (q - q_des), and the reference
        acceleration is its derivative.

        Args:
            Lambda: Gain of the error, shape (n,), in 1/s.
            q: Joint angles, shape (n, ...), in rad.
            qd: Joint velocities, shape (n, ...), in rad/s.
            q_des: Desired angles, shape (n, ...), in rad.
            qd_des: Desired velocities, shape (n, ...), in rad/s.
        """
        e = q - q_des
        ed = qd - qd_des
        v = -Lambda * e
        a = -Lambda * ed
        return cls(
            x=q,
            xd=qd,
            e=e,
            ed=ed,
            v=v,
            a=a,
        )

    @classmethod
    def in_task(
        cls,
        site: SiteSetup,
        arm: PlacedChain,
        Lambda: Numbers,
        q: Numbers,
        qd: Numbers,
        x_des: Numbers,
        xd_des: Numbers,
    ) -> "Following":
        """Computes the errors and the reference motion of an end effector that follows a pose.

        The pose has m coordinates, and the arm has n joints.

        Args:
            site: Setup of the arm and its control law.
            arm: Model of the arm in the pose q.
            Lambda: Gains of the coordinates, in 1/s.
            q: Joint angles, shape (n, ...), in rad.
            qd: Joint velocities, shape (n, ...), in rad/s.
            x_des: Pose to follow, shape (m, ...).
            xd_des: Velocity of this pose, shape (m, ...).

        Returns:
            The errors of the end effector, and the reference velocity and acceleration of the
            joints. In a singular pose, all values that require the inverse of the Jacobian are
            NaN.
        """
        assert site.chain is not None
        assert site.chain.task is not None
        task = site.chain.task
        m = site.layout.shared
        column_axes = q.ndim - 1
        x = share_pose(task, arm)

        scales = np.array([task.scale] * POSITION + [1.0] * POSITION)
        scale_rows = _add_axes(scales[:m], (m, 1), column_axes)
        unscaled_J = arm.pose_jacobian()[:m]
        unscaled_J_rate = arm.pose_jacobian_rate(qd)[:m]
        full_J = scale_rows * unscaled_J
        full_J_rate = scale_rows * unscaled_J_rate
        xd = multiply_columns(full_J, qd)

        task_axes = np.array(task.axes)
        axes = _add_axes(task_axes, (m,), column_axes)
        e = axes * _subtract_poses(x, x_des)
        ed = axes * (xd - xd_des)
        axis_rows = axes[:, np.newaxis]
        J = axis_rows * full_J
        J_rate = axis_rows * full_J_rate
        A, least = _damp(task, J)

        preferred = np.array(task.posture or site.q0)
        posture = _add_axes(preferred, (-1,), column_axes)
        posture_error = q - posture
        psi = -task.posture_rate * posture_error
        psi_d = -task.posture_rate * qd
        v, a = find_task_reference(
            J=J,
            Jd=J_rate,
            solve=partial(solve_columns, A),
            posture=(psi, psi_d),
            error=(Lambda * e, Lambda * ed),
        )
        return cls(
            x=x,
            xd=xd,
            e=e,
            ed=ed,
            v=v,
            a=a,
            J=J,
            A=A,
            least=least,
        )


def share_pose(task: TaskSetup, arm: PlacedChain) -> Numbers:
    """Returns the pose of the end effector that an arm sends to the other arms.

    The pose consists of the position in m and, if the task includes orientation, the rotation
    vector in rad.

    Args:
        task: The task, which states whether it includes orientation.
        arm: The arm in its pose.
    """
    position = task.scale * arm.end_effector_position()
    if len(task.axes) == POSITION:
        return position
    orientation = arm.end_effector_orientation()
    rotation = vector_from_rotation(orientation)
    return np.concatenate([position, rotation])


def _subtract_poses(x: Numbers, x_des: Numbers) -> Numbers:
    """Returns the difference x - x_des of two poses of an end effector, shape (m, ...).

    Positions are subtracted. Orientations R and R_des differ by the rotation vector Log(R
    R_des').
    """
    e = x - x_des
    if len(x) == POSITION:
        return e
    # zero times x gives x_des the same number of columns
    columns_of_x_des = x_des + 0.0 * x
    rotation = x[POSITION:]
    desired_rotation = columns_of_x_des[POSITION:]
    R = rotation_from_vector(rotation)
    R_des = rotation_from_vector(desired_rotation)
    rotation_error = _relative_rotation_vector(R_des, R)
    return np.concatenate([e[:POSITION], rotation_error])


def _damp(task: TaskSetup, J: Numbers) -> tuple[Numbers, float]:
    """Returns J J', damped near singular poses, and the bound that determines the damping.

    The bound 1 / trace((J J')^-1) is at most the square of the least singular value of J. Below
    the limit sigma^2, it is raised to the limit by adding the difference to the diagonal
    (damped least squares).

    Args:
        task: The task, with the followed axes and the limit sigma.
        J: Jacobian of the followed axes, shape (m, n, ...), with zero rows for the others.
    """
    m = len(task.axes)
    column_axes = J.ndim - 2
    followed = [n for n, is_followed in enumerate(task.axes) if is_followed]
    # ones on the diagonal of the axes that are not followed keep the matrix regular
    is_free = 1.0 - np.array(task.axes)
    free_axes = _add_axes(np.diag(is_free), (m, m), column_axes)
    J_J_transposed = np.einsum("an...,bn...->ab...", J, J)
    A = J_J_transposed + free_axes
    A_followed = A[followed][:, followed]
    # NumPy expects matrices on the last two axes
    matrices = np.moveaxis(A_followed, (0, 1), (-2, -1))
    singular_values = np.linalg.svd(matrices.real, compute_uv=False)
    least_singular_value = singular_values[..., -1]
    if not least_singular_value.min() > SINGULAR:
        return A + np.nan, 0.0

    inverses = np.linalg.inv(matrices)
    inverse_trace = np.trace(inverses, axis1=-2, axis2=-1)
    bound = 1.0 / inverse_trace
    limit = task.singular_value**2
    is_damped = bound.real < limit
    damping = np.where(is_damped, limit - bound, 0.0)
    identity = _add_axes(np.eye(m), (m, m), column_axes)
    least_bound = float(bound.real.min())
    return A + damping * identity, least_bound
