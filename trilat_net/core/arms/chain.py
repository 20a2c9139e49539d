"""Kinematics and dynamics of a serial chain of revolute and prismatic joints.

Symbols: q, qd and qdd are the positions, velocities and accelerations of the n joints. M(q) is
the inertia matrix, C the Coriolis matrix, G the gravity torque and tau the joint torque. Joints
and links are numbered from the base. The frame of a link moves with the link, so the axis of
the joint that drives it is constant in that frame.

Each link has ten inertial parameters about the origin of its own frame:

    pi = (m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz)

Here m is the mass, c the centre of mass, and Ixx to Izz are the moments of inertia. The vector
theta, shape (10 n,), stacks the parameters of all links. The dynamics are linear in theta.

A spatial vector combines a linear part and an angular part at the origin of a frame. The
Newton-Euler recursion runs from the base to the tip. For link i with parent p, it computes

    V_i = X V_p + S qd      W_i = X W_p + S v      A_i = X A_p + S a + V_i x (S v)
    f_i = I A_i + 1/2 (V_i x* I W_i + W_i x* I V_i - I (V_i x W_i))      tau_i = S' f_i

- X transforms spatial vectors from the frame of link p to the frame of link i. S is the joint
  axis as a spatial vector, and I the spatial inertia of the link. The product x takes two
  velocities, and x* a velocity and a force.
- V is the velocity of the link. W is the velocity that the link would have if the joints moved
  at the reference velocities v of a control law. A is the acceleration of the link for the
  reference accelerations a, and f is the spatial force on the link.

The result is tau = M a + C v + G, in which C depends on qd. Because the product of V and W is
symmetric, C is the matrix of Christoffel symbols, and dM/dt - 2 C is skew-symmetric.

The adaptive control law needs the product Y' r, where Y is the regressor (the matrix for which
Y theta = tau) and r = qd - v is the filtered error. This product is the gradient of r' tau with
respect to theta. It is computed link by link from the vector V - W, and the matrix Y is never
formed.

Source: R. Featherstone, "Rigid Body Dynamics Algorithms" (2008), for spatial vectors,
Newton-Euler and composite bodies; G. Niemeyer and J.-J. Slotine, "Performance in adaptive
manipulator control", Int. J. Robotics Research 10 (1991), for the recursion of the adaptive
law.

Invariant:
    - Compiled functions allocate no memory. They write their results into the joint data array,
      which has one row per joint (see `chain_dtype`).
    - Sums are evaluated in a fixed order, which makes the results identical on every machine.
"""

from collections.abc import Sequence
from functools import cache
from math import sqrt
from typing import Any, NamedTuple

import numpy as np

from ...records import MAX_JOINTS as MAX_JOINTS
from ..step.jit import leaf
from ..step.vectors import Array, Row, RowArray, Vector, choose
from .elementary import sincos

LINK_PARAMETERS = 10
COULOMB_SPEED = 0.01
"""Speed at which the smoothed Coulomb friction reaches 71 % of its full value, rad/s or m/s."""

Three = tuple[float, float, float]
Matrix = tuple[Three, Three, Three]
Spatial = tuple[Three, Three]
"""A spatial vector, as a pair of its linear and its angular part."""


class ChainJoint(NamedTuple):
    """Geometry, drive, friction and end stops of one joint.

    The mass and inertia of the link that the joint moves are not stored here, but in the
    parameter vector theta of the chain.

    Attributes:
        prismatic: True for a sliding joint (m, N), False for a revolute joint (rad, N m).
        axis: Axis of motion in the link's frame, a unit vector.
        rotation: Orientation of the link's frame in the parent's frame at joint position 0,
            three rows.
        origin_m: Origin of the link's frame in the parent's frame, m.
        armature_kg_m2: Inertia of the drive at the joint, kg m^2; kg for a prismatic joint.
        viscous: Viscous friction coefficient, N m s/rad or N s/m.
        coulomb: Dry (Coulomb) friction, nearly independent of speed, N m or N. See
            `COULOMB_SPEED`.
        lower: Position of the lower stop, rad or m; -inf if there is no stop.
        upper: Position of the upper stop, rad or m; inf if there is no stop.
        stop_stiffness: Stiffness of each stop, N m/rad or N/m.
        stop_damping: Damping coefficient of each stop, N m s/rad or N s/m.
    """

    prismatic: bool
    axis: Three
    rotation: Matrix
    origin_m: Three
    armature_kg_m2: float = 0.0
    viscous: float = 0.0
    coulomb: float = 0.0
    lower: float = -np.inf
    upper: float = np.inf
    stop_stiffness: float = 0.0
    stop_damping: float = 0.0


_DRIVE = (
    "armature_kg_m2",
    "viscous",
    "coulomb",
    "lower",
    "upper",
    "stop_stiffness",
    "stop_damping",
)
_MOTIONS = ("V_lin", "V_ang", "W_lin", "W_ang", "A_lin", "A_ang", "f_lin", "f_ang")
_TIP = ("J_lin", "J_ang", "p_base", "axis_base")


@cache
def chain_dtype(joints: int) -> np.dtype[np.void]:
    """Returns the NumPy dtype of the data of one joint.

    Each row holds the constants of a joint and of the link that it moves, together with work
    space for the algorithms. In field names, lin and ang denote the linear and the angular part
    of a spatial vector at the origin of the link's frame. Positions are in m.

    - Constants: the fields of `ChainJoint` for the axis and the drive; `origin`, the origin of
      the link's frame in the parent's frame; `slide`, the axis of a prismatic joint in the
      parent's frame, or zero for a revolute joint; and the matrices of Rodrigues' formula (see
      `build_chain`), namely `at_rest` (F), `by_sine` (F [a]) and `by_cosine` (F [a]^2).
    - Placement: R and p, the orientation and origin of the link's frame in the parent's frame.
      `R_base` is the orientation of the link, `p_base` its origin and `axis_base` the joint
      axis, all in the base frame.
    - Motion, as spatial vectors: the link velocity V, its velocity W and acceleration A in the
      reference motion of a control law, and the force f on the link.
    - Dynamics: `bias`, the torque C qd + G plus friction, minus the torque of the stops;
      `composite`, the ten inertial parameters of the rigid body formed by this link and all
      later links; and M, a row of the inertia matrix.
    - End effector: `J_lin` and `J_ang`, a column of its Jacobian.

    Args:
        joints: Number of joints of the chain, which is the length of a row of M.
    """
    matrices = ("at_rest", "by_sine", "by_cosine", "R", "R_base")
    vectors = ("axis", "origin", "slide", "p", *_MOTIONS, *_TIP)
    numbers = (*_DRIVE, "bias")

    fields: list[Any] = [("prismatic", "i8")]
    fields += [(name, "f8", (3, 3)) for name in matrices]
    fields += [(name, "f8", (3,)) for name in vectors]
    fields += [(name, "f8") for name in numbers]
    fields.append(("composite", "f8", (LINK_PARAMETERS,)))
    fields.append(("M", "f8", (joints,)))
    return np.dtype((np.record, fields))


def build_chain(joints: Sequence[ChainJoint], width: int = 0) -> RowArray:
    """Creates the joint data array that the compiled functions operate on.

    The constants of each joint are filled in. They include three matrices that give the
    rotation R of a joint at angle q about its axis a without a matrix product (Rodrigues'
    formula):

        R = F + sin(q) F [a] + (1 - cos(q)) F [a]^2

    Here F is the rotation at q = 0, and [a] is the matrix of the cross product with a.

    Args:
        joints: The joints, starting at the base.
        width: Number of elements of the field `M`, which holds a row of the inertia matrix.
            Defaults to the number of joints.

    Returns:
        Array with one row per joint, shape (n,). See `chain_dtype`.
    """
    rows = np.zeros(len(joints), chain_dtype(width or len(joints)))
    row: Row
    for row, joint in zip(rows, joints, strict=True):
        x, y, z = joint.axis
        cross_matrix = (
            (0.0, -z, y),
            (z, 0.0, -x),
            (-y, x, 0.0),
        )
        row.prismatic = int(joint.prismatic)
        row.axis = joint.axis
        row.origin = joint.origin_m
        row.at_rest = joint.rotation
        if joint.prismatic:
            row.slide = multiply_vector(joint.rotation, joint.axis)
        else:
            by_sine = multiply_matrices(joint.rotation, cross_matrix)
            row.by_sine = by_sine
            row.by_cosine = multiply_matrices(by_sine, cross_matrix)
        for name in _DRIVE:
            row[name] = getattr(joint, name)
    return rows


@leaf
def read_three(a: Vector) -> Three:
    """Returns the three elements of an array as a tuple, for 3D vector arithmetic.

    Compiled code keeps a tuple in registers, whereas a new array would allocate memory in the
    control loop.

    Args:
        a: A vector of length 3, for example a field of a joint's row.
    """
    return a[0], a[1], a[2]


@leaf
def put_three(a: Array, values: Three) -> None:
    """Copies a tuple of three elements into an array of length 3.

    The array is overwritten in place, because compiled code in the control loop must not
    allocate memory.

    Args:
        a: The array to overwrite.
        values: The three elements.
    """
    x, y, z = values
    a[0] = x
    a[1] = y
    a[2] = z


@leaf
def dot_product(a: Three, b: Three) -> float:
    """Returns the scalar product a' b = a_1 b_1 + a_2 b_2 + a_3 b_3 of two 3D vectors."""
    x = a[0] * b[0]
    y = a[1] * b[1]
    z = a[2] * b[2]
    return x + y + z


@leaf
def cross_product(a: Three, b: Three) -> Three:
    """Returns the cross product a x b of two 3D vectors."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return x, y, z


@leaf
def add_vectors(a: Three, b: Three) -> Three:
    """Returns the sum a + b of two 3D vectors."""
    x = a[0] + b[0]
    y = a[1] + b[1]
    z = a[2] + b[2]
    return x, y, z


@leaf
def subtract_vectors(a: Three, b: Three) -> Three:
    """Returns the difference a - b of two 3D vectors."""
    x = a[0] - b[0]
    y = a[1] - b[1]
    z = a[2] - b[2]
    return x, y, z


@leaf
def scale_vector(factor: float, a: Three) -> Three:
    """Returns a 3D vector multiplied by a scalar, factor * a."""
    x = factor * a[0]
    y = factor * a[1]
    z = factor * a[2]
    return x, y, z


@leaf
def rotate_by_matrix(R: Array, a: Three) -> Three:
    """Returns the product R a of a rotation matrix and a 3D vector.

    If R is the orientation of a link in the base frame, this transforms a vector from link
    coordinates to base coordinates.

    Args:
        R: Rotation matrix, shape (3, 3).
        a: The vector.
    """
    x, y, z = a
    first = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z
    second = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
    third = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
    return first, second, third


@leaf
def _rotate_back(R: Array, a: Three) -> Three:
    """Returns R' a: a 3D vector rotated by the inverse of the rotation matrix R.

    The inverse of a rotation matrix is its transpose.

    Args:
        R: Rotation matrix, shape (3, 3).
        a: The vector.
    """
    x, y, z = a
    first = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
    second = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
    third = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
    return first, second, third


def multiply_vector(a: Matrix, b: Three) -> Three:
    """Returns the product of a 3 x 3 matrix `a` and a 3D vector `b`.

    Sums are evaluated in a fixed order, which makes the result bit-identical on every machine.

    Args:
        a: The matrix, three rows of three elements.
        b: The vector, three elements.
    """
    x, y, z = b
    products = []
    for a_x, a_y, a_z in a:
        product = a_x * x + a_y * y + a_z * z
        products.append(product)
    first, second, third = products
    return first, second, third


def multiply_matrices(a: Matrix, b: Matrix) -> Matrix:
    """Returns the product a b of two 3 x 3 matrices, each given as three rows.

    Sums are evaluated in a fixed order, which makes the result bit-identical on every machine.
    With a linear algebra library, the last bit could differ.
    """
    columns: Any = zip(*b, strict=True)
    product_columns = [multiply_vector(a, column) for column in columns]
    rows: Any = zip(*product_columns, strict=True)
    return tuple(rows)


@leaf
def place_joints(chain: RowArray, q: Vector) -> None:
    """Computes the position and orientation of every link from the joint positions.

    The rotation R and the origin p (m) of each link's frame, relative to the parent's frame,
    are written into the rows of `chain`. The equation for R is given in `build_chain`. Most
    other functions of this module read R and p, so call this function whenever the positions
    change.

    Args:
        chain: Joint data, one row per joint; modified.
        q: Joint positions, shape (n,), rad or m.
    """
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        sine = 0.0
        versine = 0.0
        if row.prismatic == 0:
            sine, cosine = sincos(q[i])
            versine = 1.0 - cosine
        for j in range(3):
            for k in range(3):
                at_rest = row.at_rest[j, k]
                sine_part = sine * row.by_sine[j, k]
                versine_part = versine * row.by_cosine[j, k]
                row.R[j, k] = at_rest + sine_part + versine_part
            displacement = q[i] * row.slide[j]
            row.p[j] = row.origin[j] + displacement


@leaf
def _move(row: Row, linear: Three, angular: Three, rate: float) -> Spatial:
    """Returns the spatial velocity of a link from the velocities of its parent and its joint.

    In spatial notation, this is X V_p + S rate. Accelerations are transformed in the same way.

    Args:
        row: Row of the joint between the two links.
        linear: Linear part of the parent's velocity V_p, in the parent's frame.
        angular: Angular part of V_p, in the parent's frame.
        rate: Velocity of the joint, rad/s or m/s.

    Returns:
        The linear and the angular part, in the link's own frame.
    """
    p = read_three(row.p)
    turning_velocity = cross_product(angular, p)
    velocity_at_p = add_vectors(linear, turning_velocity)
    link_linear = _rotate_back(row.R, velocity_at_p)
    link_angular = _rotate_back(row.R, angular)
    axis = read_three(row.axis)
    joint_velocity = scale_vector(rate, axis)
    if row.prismatic == 0:
        link_angular = add_vectors(link_angular, joint_velocity)
    else:
        link_linear = add_vectors(link_linear, joint_velocity)
    return link_linear, link_angular


@leaf
def _momentum(pi: Vector, first: int, linear: Three, angular: Three) -> Spatial:
    """Returns the linear and angular momentum of a link about the origin of its frame.

    This is the product I(pi) V, where V is the spatial velocity of the link and I(pi) its
    spatial inertia.

    Args:
        pi: Inertial parameters of all links. For each link: the mass m, m times the centre of
            mass, and the moments of inertia Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
        first: Index of the link's first parameter in `pi`.
        linear: Linear velocity of the link's origin, m/s.
        angular: Angular velocity of the link, rad/s.
    """
    m = pi[first]
    mc_x = pi[first + 1]
    mc_y = pi[first + 2]
    mc_z = pi[first + 3]
    I_xx = pi[first + 4]
    I_xy = pi[first + 5]
    I_yy = pi[first + 6]
    I_xz = pi[first + 7]
    I_yz = pi[first + 8]
    I_zz = pi[first + 9]
    x, y, z = angular
    spin_x = I_xx * x + I_xy * y + I_xz * z
    spin_y = I_xy * x + I_yy * y + I_yz * z
    spin_z = I_xz * x + I_yz * y + I_zz * z
    mc = (mc_x, mc_y, mc_z)
    spin = (spin_x, spin_y, spin_z)
    origin_momentum = scale_vector(m, linear)
    turning_momentum = cross_product(angular, mc)
    linear_momentum = add_vectors(origin_momentum, turning_momentum)
    moment = cross_product(mc, linear)
    angular_momentum = add_vectors(moment, spin)
    return linear_momentum, angular_momentum


@leaf
def _along_axis(row: Row, linear: Three, angular: Three) -> float:
    """Returns the component of a spatial force along the axis of a joint, S' f.

    A spatial force f combines a force and a torque, and S is the joint axis. The result is the
    torque of a revolute joint, N m, or the force of a prismatic joint, N.

    Args:
        row: Row of the joint.
        linear: Linear part of f, the force.
        angular: Angular part of f, the torque.
    """
    axis = read_three(row.axis)
    along = angular if row.prismatic == 0 else linear
    return dot_product(axis, along)


@leaf
def friction_torque(row: Row, speed: float) -> float:
    """Returns the friction torque that opposes the motion of a joint, N m.

        f(v) = viscous v + coulomb x / sqrt(1 + x^2),    x = v / COULOMB_SPEED

    The torque increases with the joint velocity v. The second term is a smooth approximation of
    dry friction; a jump at v = 0 would disturb the integration.

    Args:
        row: Row of the joint, with the coefficients `viscous` and `coulomb`.
        speed: Velocity v of the joint, rad/s or m/s.
    """
    x = speed / COULOMB_SPEED
    smooth_sign = x / sqrt(1.0 + x * x)
    viscous: float = row.viscous * speed
    coulomb: float = row.coulomb * smooth_sign
    return viscous + coulomb


@leaf
def _pass_force(row: Row, before: Row) -> None:
    """Adds the force on a link to the force on its parent, which has to support both.

    The inverse dynamics accumulates forces in this way from the tip of an arm to its base. The
    force and its torque are first transformed to the parent's frame.

    Args:
        row: Row of the joint that moves the link.
        before: Row of the previous joint; modified.
    """
    R = row.R
    p = read_three(row.p)
    force = rotate_by_matrix(R, read_three(row.f_lin))
    link_torque = rotate_by_matrix(R, read_three(row.f_ang))
    lever_torque = cross_product(p, force)
    torque = add_vectors(link_torque, lever_torque)
    total_force = add_vectors(read_three(before.f_lin), force)
    total_torque = add_vectors(read_three(before.f_ang), torque)
    put_three(before.f_lin, total_force)
    put_three(before.f_ang, total_torque)


@leaf
def propagate_motion(
    chain: RowArray, gravity: Vector, qd: Vector, v: Vector, a: Vector
) -> None:
    """Computes the velocities and the acceleration of every link, from the base to the tip.

    All of them are spatial vectors, which combine a linear and an angular part. V is the link
    velocity for qd, W the link velocity for v, and A the link acceleration for a, including
    gravity. They are stored in the joint rows, where `inverse_dynamics` and
    `parameter_gradient` read them. `place_joints` must have been called for the same positions.

    Args:
        chain: Joint data, one row per joint; modified.
        gravity: Gravitational acceleration in the base frame, m/s^2, shape (3,).
        qd: Joint velocities, shape (n,), rad/s or m/s.
        v: Reference velocities, which multiply the Coriolis matrix C, shape (n,).
        a: Reference accelerations, which multiply the inertia matrix M, shape (n,).
    """
    still = (0.0, 0.0, 0.0)
    V_lin = still
    V_ang = still
    W_lin = still
    W_ang = still
    # A base that accelerates upwards has the same effect as gravity.
    A_lin = (-gravity[0], -gravity[1], -gravity[2])
    A_ang = still
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        V_lin, V_ang = _move(row, V_lin, V_ang, qd[i])
        W_lin, W_ang = _move(row, W_lin, W_ang, v[i])
        A_lin, A_ang = _move(row, A_lin, A_ang, a[i])
        # V x (S v)
        axis = read_three(row.axis)
        joint_velocity = scale_vector(v[i], axis)
        if row.prismatic == 0:
            linear_part = cross_product(V_lin, joint_velocity)
            angular_part = cross_product(V_ang, joint_velocity)
            A_lin = add_vectors(A_lin, linear_part)
            A_ang = add_vectors(A_ang, angular_part)
        else:
            linear_part = cross_product(V_ang, joint_velocity)
            A_lin = add_vectors(A_lin, linear_part)
        put_three(row.V_lin, V_lin)
        put_three(row.V_ang, V_ang)
        put_three(row.W_lin, W_lin)
        put_three(row.W_ang, W_ang)
        put_three(row.A_lin, A_lin)
        put_three(row.A_ang, A_ang)


@leaf
def _motion_cross(V: Spatial, W: Spatial) -> Spatial:
    """Returns the spatial cross product V x W, the rate of change of W as it moves with V.

    For V = (v, w) and W = (v', w'), with the linear part first, this is (w x v' + v x w', w x
    w').
    """
    V_lin, V_ang = V
    W_lin, W_ang = W
    turned_W = cross_product(V_ang, W_lin)
    moved_W = cross_product(V_lin, W_ang)
    linear = add_vectors(turned_W, moved_W)
    angular = cross_product(V_ang, W_ang)
    return linear, angular


@leaf
def _force_cross(V: Spatial, f: Spatial) -> Spatial:
    """Returns the spatial cross product V x* f, the rate of change of f as it moves with V.

    For V = (v, w) and f = (force, torque), this is (w x force, w x torque + v x force).
    """
    V_lin, V_ang = V
    force, torque = f
    linear = cross_product(V_ang, force)
    turned_torque = cross_product(V_ang, torque)
    moved_force = cross_product(V_lin, force)
    angular = add_vectors(turned_torque, moved_force)
    return linear, angular


@leaf
def inverse_dynamics(
    chain: RowArray, theta: Vector, v: Vector, a: Vector, torque: Array
) -> None:
    """Computes the joint torque required for the reference motion.

        M a + C(q, qd) v + G + armature a + friction(v)

    M is the inertia matrix of the links, C the Coriolis matrix, G the gravity torque and
    `armature` the inertia of the drives. Friction is evaluated at the reference velocity v
    instead of qd. With r = qd - v, it follows that r' (friction(qd) - friction(v)) >= 0, so the
    difference from the real friction can only dissipate energy. `propagate_motion` must have
    been called for the same motion.

    Args:
        chain: Joint data, one row per joint.
        theta: Inertial parameters, ten per link, shape (10 n,).
        v: Reference velocities, shape (n,), rad/s or m/s.
        a: Reference accelerations, shape (n,), rad/s^2 or m/s^2.
        torque: Receives the torque, shape (n,), N m or N.
    """
    n = chain.shape[0]
    # The force on each link.
    for i in range(n):
        row: Row = chain[i]
        first = LINK_PARAMETERS * i
        V_lin = read_three(row.V_lin)
        V_ang = read_three(row.V_ang)
        W_lin = read_three(row.W_lin)
        W_ang = read_three(row.W_ang)
        A_lin = read_three(row.A_lin)
        A_ang = read_three(row.A_ang)
        V = (V_lin, V_ang)
        W = (W_lin, W_ang)
        V_x_W = _motion_cross(V, W)
        I_V = _momentum(theta, first, V_lin, V_ang)
        I_W = _momentum(theta, first, W_lin, W_ang)
        I_A = _momentum(theta, first, A_lin, A_ang)
        # V x* I W + W x* I V - I (V x W)
        V_x_I_W = _force_cross(V, I_W)
        W_x_I_V = _force_cross(W, I_V)
        I_V_x_W = _momentum(theta, first, V_x_W[0], V_x_W[1])
        force_sum = add_vectors(V_x_I_W[0], W_x_I_V[0])
        torque_sum = add_vectors(V_x_I_W[1], W_x_I_V[1])
        turning_force = subtract_vectors(force_sum, I_V_x_W[0])
        turning_torque = subtract_vectors(torque_sum, I_V_x_W[1])
        half_force = scale_vector(0.5, turning_force)
        half_torque = scale_vector(0.5, turning_torque)
        put_three(row.f_lin, add_vectors(I_A[0], half_force))
        put_three(row.f_ang, add_vectors(I_A[1], half_torque))

    # Torque of each joint, from the tip to the base: a joint carries all links after it.
    for i in range(n - 1, -1, -1):
        row = chain[i]
        force = read_three(row.f_lin)
        moment = read_three(row.f_ang)
        rigid = _along_axis(row, force, moment)
        drive = row.armature_kg_m2 * a[i]
        friction = friction_torque(row, v[i])
        torque[i] = rigid + drive + friction
        if i > 0:
            _pass_force(row, chain[i - 1])


@leaf
def _add_products(factor: float, x: Spatial, y: Spatial, first: int, gradient: Array) -> None:
    """Adds one term x' I y of the product Y' r to the gradient of a link's parameters.

    I is the spatial inertia of the link. It is linear in the ten inertial parameters

        pi = (m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz),

    namely the mass m, the vector m c with the centre of mass c, and the moments of inertia J.
    With the linear parts x_lin and y_lin and the angular parts x_ang and y_ang, the term is

        x' I y = m x_lin' y_lin
               + (m c)' (cross_product(y_lin, x_ang) + cross_product(x_lin, y_ang))
               + x_ang' J y_ang

    The coefficients of the parameters in this sum are the derivatives with respect to them.
    Because J is symmetric, Ixy, Ixz and Iyz each appear in two elements and have two products.

    Args:
        factor: Factor of the term.
        x: A spatial velocity: the linear part, m/s, followed by the angular part, rad/s.
        y: A spatial velocity or acceleration, also with the linear part first.
        first: Index of the link's first parameter (the mass) in `gradient`.
        gradient: Gradient for all links, shape (10 n,). `factor` times the ten derivatives is
            added to the entries starting at `first`, in the order of pi.
    """
    x_lin, x_ang = x
    y_lin, y_ang = y
    x_1, x_2, x_3 = x_ang
    y_1, y_2, y_3 = y_ang
    d_m = dot_product(x_lin, y_lin)
    y_lin_x_x_ang = cross_product(y_lin, x_ang)
    x_lin_x_y_ang = cross_product(x_lin, y_ang)
    d_mc = add_vectors(y_lin_x_x_ang, x_lin_x_y_ang)
    d_Ixx = x_1 * y_1
    d_Ixy = x_1 * y_2 + x_2 * y_1
    d_Iyy = x_2 * y_2
    d_Ixz = x_1 * y_3 + x_3 * y_1
    d_Iyz = x_2 * y_3 + x_3 * y_2
    d_Izz = x_3 * y_3
    gradient[first] += factor * d_m
    for axis in range(3):
        gradient[first + 1 + axis] += factor * d_mc[axis]
    gradient[first + 4] += factor * d_Ixx
    gradient[first + 5] += factor * d_Ixy
    gradient[first + 6] += factor * d_Iyy
    gradient[first + 7] += factor * d_Ixz
    gradient[first + 8] += factor * d_Iyz
    gradient[first + 9] += factor * d_Izz


@leaf
def parameter_gradient(chain: RowArray, gradient: Array) -> None:
    """Computes Y' r, with which the adaptive control law updates its parameter estimate.

    Y is the regressor: Y theta is the torque of the links in `inverse_dynamics`, where theta is
    the vector of their inertial parameters. The filtered error r = qd - v is the difference
    between the velocities qd and the reference velocities v of the joints. `propagate_motion`
    must have been called for the same qd and v.

    With the spatial velocity s = V - W, the product is the gradient of the sum of s' f over all
    links. As in the module docstring, V is the velocity of the link, W its velocity at v, A its
    reference acceleration, I its spatial inertia and f the force. In

        s' f = s' I A + 1/2 s' (V x* I W + W x* I V - I (V x W))

    the identity s' (V x* F) = -(V x s)' F gives each term the form x' I y, which is linear in
    the parameters of the link:

        s' f = s' I A - 1/2 (V x s)' I W - 1/2 (W x s)' I V - 1/2 s' I (V x W)

    Args:
        chain: Joint data, one row per joint.
        gradient: Receives Y' r, ten entries per link, shape (10 n,).
    """
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        V_lin = read_three(row.V_lin)
        V_ang = read_three(row.V_ang)
        W_lin = read_three(row.W_lin)
        W_ang = read_three(row.W_ang)
        A_lin = read_three(row.A_lin)
        A_ang = read_three(row.A_ang)
        s_lin = subtract_vectors(V_lin, W_lin)
        s_ang = subtract_vectors(V_ang, W_ang)
        V = (V_lin, V_ang)
        W = (W_lin, W_ang)
        A = (A_lin, A_ang)
        s = (s_lin, s_ang)
        V_x_s = _motion_cross(V, s)
        W_x_s = _motion_cross(W, s)
        V_x_W = _motion_cross(V, W)

        first = LINK_PARAMETERS * i
        end = first + LINK_PARAMETERS
        for p in range(first, end):
            gradient[p] = 0.0
        # The four terms of s' f, in the order of the equation.
        _add_products(factor=1.0, x=s, y=A, first=first, gradient=gradient)
        _add_products(factor=-0.5, x=V_x_s, y=W, first=first, gradient=gradient)
        _add_products(factor=-0.5, x=W_x_s, y=V, first=first, gradient=gradient)
        _add_products(factor=-0.5, x=s, y=V_x_W, first=first, gradient=gradient)


@leaf
def _add_composite(row: Row, before: Row) -> None:
    """Adds the mass and inertia of a composite body to those of the parent link.

    A composite body consists of a link and all later links, as if they were rigidly connected.
    The inertia matrix of an arm is computed from such bodies. The inertia is moved to the
    origin of the parent link with the parallel axis theorem, written out for the ten parameters
    of a body (mass, first moments, moments of inertia).

    Args:
        row: Row of the joint that moves the body.
        before: Row of the previous joint, whose composite body is modified.
    """
    pi = row.composite
    total = before.composite
    R = row.R
    m = pi[0]
    p = read_three(row.p)
    link_mc = (pi[1], pi[2], pi[3])
    mc = rotate_by_matrix(R, link_mc)
    # I is the inertia matrix about the origin of the link, in the axes of the link. It is
    # symmetric. x, y and z are the columns of R I, and R I R' has the rows I_x, I_y and I_z.
    column_1 = (pi[4], pi[5], pi[7])
    column_2 = (pi[5], pi[6], pi[8])
    column_3 = (pi[7], pi[8], pi[9])
    x = rotate_by_matrix(R, column_1)
    y = rotate_by_matrix(R, column_2)
    z = rotate_by_matrix(R, column_3)
    row_1 = (x[0], y[0], z[0])
    row_2 = (x[1], y[1], z[1])
    row_3 = (x[2], y[2], z[2])
    I_x = rotate_by_matrix(R, row_1)
    I_y = rotate_by_matrix(R, row_2)
    I_z = rotate_by_matrix(R, row_3)
    p_mc = dot_product(p, mc)
    p_p = dot_product(p, p)
    polar = 2.0 * p_mc + m * p_p
    p_x, p_y, p_z = p
    mc_x, mc_y, mc_z = mc
    mp_x = m * p_x
    mp_y = m * p_y
    mp_z = m * p_z
    # The moments of inertia about the previous link's origin.
    I_xx = I_x[0] + polar
    I_xx -= 2.0 * p_x * mc_x
    I_xx -= mp_x * p_x
    I_xy = I_x[1] - p_x * mc_y
    I_xy -= p_y * mc_x
    I_xy -= mp_x * p_y
    I_yy = I_y[1] + polar
    I_yy -= 2.0 * p_y * mc_y
    I_yy -= mp_y * p_y
    I_xz = I_x[2] - p_x * mc_z
    I_xz -= p_z * mc_x
    I_xz -= mp_x * p_z
    I_yz = I_y[2] - p_y * mc_z
    I_yz -= p_z * mc_y
    I_yz -= mp_y * p_z
    I_zz = I_z[2] + polar
    I_zz -= 2.0 * p_z * mc_z
    I_zz -= mp_z * p_z
    total[0] += m
    total[1] += mc_x + mp_x
    total[2] += mc_y + mp_y
    total[3] += mc_z + mp_z
    total[4] += I_xx
    total[5] += I_xy
    total[6] += I_yy
    total[7] += I_xz
    total[8] += I_yz
    total[9] += I_zz


@leaf
def mass_matrix(chain: RowArray, theta: Vector) -> None:
    """Computes the inertia matrix M(q) of the arm, including the inertia of the drives.

    Because M is symmetric, only its lower triangle is written into the field `M` of the rows.
    The composite-rigid-body algorithm (Featherstone) is used. `place_joints` must have been
    called for the same positions.

    Args:
        chain: Joint data, one row per joint; modified.
        theta: Inertial parameters, ten per link, shape (10 n,).
    """
    n = chain.shape[0]
    for i in range(n):
        row: Row = chain[i]
        first = LINK_PARAMETERS * i
        for p in range(LINK_PARAMETERS):
            row.composite[p] = theta[first + p]

    still = (0.0, 0.0, 0.0)
    for i in range(n - 1, -1, -1):
        row = chain[i]
        # The force that accelerates the composite body (the link and all links after it) at the
        # joint's unit acceleration.
        axis = read_three(row.axis)
        if row.prismatic == 0:
            linear, angular = _momentum(row.composite, 0, still, axis)
        else:
            linear, angular = _momentum(row.composite, 0, axis, still)
        rigid = _along_axis(row, linear, angular)
        row.M[i] = rigid + row.armature_kg_m2
        # The torque of this force at each earlier joint is an element of M off the diagonal.
        for j in range(i - 1, -1, -1):
            link: Row = chain[j + 1]
            linear = rotate_by_matrix(link.R, linear)
            link_torque = rotate_by_matrix(link.R, angular)
            lever_torque = cross_product(read_three(link.p), linear)
            angular = add_vectors(link_torque, lever_torque)
            row.M[j] = _along_axis(chain[j], linear, angular)
        if i > 0:
            _add_composite(row, chain[i - 1])


@leaf
def _stop_torque(row: Row, q: float, qd: float) -> float:
    """Returns the torque of the mechanical stops at the ends of a joint's range, N m.

    Beyond the end of the range, a spring and a damper push the joint back, and never pull.
    Within the range, the torque is 0. For a prismatic joint, the result is a force, N.

    Args:
        row: Row of the joint.
        q: Position of the joint, rad or m.
        qd: Velocity of the joint, rad/s or m/s.
    """
    damper = row.stop_damping * qd
    lower_spring = row.stop_stiffness * (row.lower - q)
    upper_spring = row.stop_stiffness * (row.upper - q)
    lower_push: float = max(lower_spring - damper, 0.0)
    upper_push: float = min(upper_spring - damper, 0.0)
    # `choose` takes the place of branches, because this code is also compiled for several runs
    # at once.
    upper_or_none = choose(q > row.upper, upper_push, 0.0)
    return choose(q < row.lower, lower_push, upper_or_none)


@leaf
def _bias(chain: RowArray, theta: Vector, gravity: Vector, q: Vector, qd: Vector) -> None:
    """Computes the bias torque, which is required even if the joints do not accelerate.

        bias = C qd + G + friction - stops

    The terms are the Coriolis torque, the gravity torque, the joint friction, and the torque of
    the joint stops. `place_joints` must have been called for the same positions.

    Args:
        chain: Joint data, one row per joint. The result is written into `bias`.
        theta: Inertial parameters, shape (10 n,).
        gravity: Gravitational acceleration in the base frame, m/s^2, shape (3,).
        q: Joint positions, shape (n,).
        qd: Joint velocities, shape (n,).
    """
    n = chain.shape[0]
    still = (0.0, 0.0, 0.0)
    V_lin = still
    V_ang = still
    # A base that accelerates upwards has the same effect as gravity.
    A_lin = (-gravity[0], -gravity[1], -gravity[2])
    A_ang = still

    # Velocity V, acceleration A and force of each link, from the base to the tip.
    for i in range(n):
        row: Row = chain[i]
        V_lin, V_ang = _move(row, V_lin, V_ang, qd[i])
        A_lin, A_ang = _move(row, A_lin, A_ang, 0.0)
        # V x (S qd)
        axis = read_three(row.axis)
        joint_velocity = scale_vector(qd[i], axis)
        if row.prismatic == 0:
            linear_part = cross_product(V_lin, joint_velocity)
            angular_part = cross_product(V_ang, joint_velocity)
            A_lin = add_vectors(A_lin, linear_part)
            A_ang = add_vectors(A_ang, angular_part)
        else:
            linear_part = cross_product(V_ang, joint_velocity)
            A_lin = add_vectors(A_lin, linear_part)
        # I A + V x* I V
        first = LINK_PARAMETERS * i
        force, torque = _momentum(theta, first, A_lin, A_ang)
        momentum = _momentum(theta, first, V_lin, V_ang)
        V = (V_lin, V_ang)
        turning_force, turning_torque = _force_cross(V, momentum)
        put_three(row.f_lin, add_vectors(force, turning_force))
        put_three(row.f_ang, add_vectors(torque, turning_torque))

    # Torque of each joint, from the tip to the base: a joint carries all links after it.
    for i in range(n - 1, -1, -1):
        row = chain[i]
        force = read_three(row.f_lin)
        moment = read_three(row.f_ang)
        rigid = _along_axis(row, force, moment)
        friction = friction_torque(row, qd[i])
        row.bias = rigid + friction
        row.bias -= _stop_torque(row, q[i], qd[i])
        if i > 0:
            _pass_force(row, chain[i - 1])


@leaf
def put_model(
    chain: RowArray,
    theta: Vector,
    gravity: Vector,
    q: Vector,
    qd: Vector,
    M: Array,
    bias: Array,
) -> None:
    """Computes the inertia matrix and the bias torque for control laws that need them.

    The bias torque is C qd + G + friction - stops: Coriolis torque, gravity torque and joint
    friction, minus the torque of the stops. `place_joints` must have been called for the same
    positions.

    Args:
        chain: Joint data, one row per joint.
        theta: Inertial parameters, ten per link, shape (10 n,).
        gravity: Gravitational acceleration in the base frame, m/s^2, shape (3,).
        q: Joint positions, shape (n,), rad or m.
        qd: Joint velocities, shape (n,), rad/s or m/s.
        M: Receives the inertia matrix, shape (n, n).
        bias: Receives the bias torque, shape (n,), N m or N.
    """
    _bias(chain=chain, theta=theta, gravity=gravity, q=q, qd=qd)
    mass_matrix(chain, theta)
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        bias[i] = row.bias
        for j in range(i + 1):
            M[i, j] = M[j, i] = row.M[j]


@leaf
def find_acceleration(
    chain: RowArray,
    theta: Vector,
    gravity: Vector,
    q: Vector,
    qd: Vector,
    torque: Vector,
    qdd: Array,
) -> None:
    """Computes the joint accelerations qdd caused by a torque, Eq. (8).

        M qdd = torque - C qd - G - friction + stops

    M is the inertia matrix, C qd the Coriolis torque, G the gravity torque and `stops` the
    torque of the stops. M is factored in place as L D L', which needs no square roots.
    `place_joints` must have been called for the same positions.

    Args:
        chain: Joint data, one row per joint.
        theta: Inertial parameters, ten per link, shape (10 n,).
        gravity: Gravitational acceleration in the base frame, m/s^2, shape (3,).
        q: Joint positions, shape (n,), rad or m.
        qd: Joint velocities, shape (n,), rad/s or m/s.
        torque: Total torque on the joints, shape (n,), N m or N.
        qdd: Receives the accelerations, shape (n,), rad/s^2 or m/s^2.
    """
    n = chain.shape[0]
    _bias(chain=chain, theta=theta, gravity=gravity, q=q, qd=qd)
    mass_matrix(chain, theta)

    # Factor row i of M, and substitute forwards.
    for i in range(n):
        row: Row = chain[i]
        M_i = row.M
        for j in range(i):
            M_j = chain[j].M
            for k in range(j):
                pivot = chain[k].M[k]
                product = M_i[k] * M_j[k]
                M_i[j] -= product * pivot
            M_i[j] /= M_j[j]
        for k in range(i):
            pivot = chain[k].M[k]
            square = M_i[k] * M_i[k]
            M_i[i] -= square * pivot
        total = torque[i] - row.bias
        for k in range(i):
            total -= M_i[k] * qdd[k]
        qdd[i] = total

    # Divide by D, and substitute backwards.
    for i in range(n - 1, -1, -1):
        qdd[i] /= chain[i].M[i]
        for k in range(i + 1, n):
            qdd[i] -= chain[k].M[i] * qdd[k]


@leaf
def place_end_effector(chain: RowArray, tip: Vector) -> Three:
    """Computes the position of the end effector, its Jacobian, and the link orientations.

    All results are expressed in the base frame. The position of the end effector is returned;
    the other results are written into the joint rows:

    - `J_lin` and `J_ang`: the column of the Jacobian for this joint, which is the linear and
      angular velocity of the end effector per unit joint velocity.
    - `R_base`: the orientation of the link that the joint moves.
    - `p_base` and `axis_base`: the position, in m, and the axis of the joint.

    Args:
        chain: Joint data, one row per joint. `place_joints` must have been called before.
        tip: Position of the end effector in the last link's frame, m, shape (3,).

    Returns:
        The position of the end effector, m.
    """
    n = chain.shape[0]
    position = (0.0, 0.0, 0.0)
    for i in range(n):
        row: Row = chain[i]
        R = row.R
        R_base = row.R_base
        if i == 0:
            position = read_three(row.p)
            for j in range(3):
                put_three(R_base[j], read_three(R[j]))
        else:
            before = chain[i - 1].R_base
            offset = rotate_by_matrix(before, read_three(row.p))
            position = add_vectors(position, offset)
            for k in range(3):
                column = (R[0, k], R[1, k], R[2, k])
                x, y, z = rotate_by_matrix(before, column)
                R_base[0, k] = x
                R_base[1, k] = y
                R_base[2, k] = z
        axis = rotate_by_matrix(R_base, read_three(row.axis))
        put_three(row.axis_base, axis)
        put_three(row.p_base, position)
    tip_offset = rotate_by_matrix(chain[n - 1].R_base, read_three(tip))
    position = add_vectors(position, tip_offset)
    for i in range(n):
        row = chain[i]
        axis = read_three(row.axis_base)
        if row.prismatic == 0:
            lever = subtract_vectors(position, read_three(row.p_base))
            put_three(row.J_lin, cross_product(axis, lever))
            put_three(row.J_ang, axis)
        else:
            put_three(row.J_lin, axis)
            put_three(row.J_ang, (0.0, 0.0, 0.0))
    return position
