"""A serial chain of revolute and prismatic joints: kinematics and dynamics by recursion.

Each link has ten inertial parameters, pi = (m, m c, Ixx, Ixy, Iyy, Ixz, Iyz, Izz), about the
origin of its own frame. All dynamics are linear in them; theta lists the parameters of one link
after the other, shape (10 n,). A link's frame is that of its joint, and the joint's axis is
constant in this frame. A spatial vector has its linear half first, at the frame's origin.

The Newton-Euler recursion uses two separate velocities, as Eq. (12) of the paper requires:

    V_i = X V_p + S qd      W_i = X W_p + S v      A_i = X A_p + S a + V_i x (S v)
    f_i = I A_i + 1/2 (V_i x* I W_i + W_i x* I V_i - I (V_i x W_i))      tau_i = S' f_i

This product of velocities corresponds to the Christoffel symbols, so that dM/dt - 2 C is skew,
Eq. (4). With s = V - W, the gradient of r' tau with respect to pi is Y' r of Eq. (15), which is
computed link by link without a regressor.

Source: R. Featherstone, "Rigid Body Dynamics Algorithms" (2008), for spatial vectors,
Newton-Euler and composite bodies; G. Niemeyer and J.-J. Slotine, "Performance in adaptive
manipulator control", Int. J. Robotics Research 10 (1991), for the recursion of the adaptive
law.

Invariant:
    - Functions of the kernel allocate nothing.
    - Each sum has a fixed order.
"""

from collections.abc import Sequence
from functools import cache
from math import sqrt
from typing import Any, NamedTuple

import numpy as np

from .elementary import sincos
from .jit import leaf
from .vectors import Array, Row, RowArray, Vector

LINK_PARAMETERS = 10
MAX_JOINTS = 12
COULOMB_SPEED = 0.01
"""Speed at which the smoothed Coulomb friction has 71 % of its full value, rad/s or m/s."""

Three = tuple[float, float, float]
Matrix = tuple[Three, Three, Three]


class ChainJoint(NamedTuple):
    """One joint of a chain; theta contains the parameters of the link that it moves.

    Attributes:
        prismatic: true: the joint slides (m, N); false: it turns (rad, N m).
        axis: axis of motion in the link's frame, length 1.
        rotation: orientation of the link's frame in the previous link's frame at position 0,
            three rows.
        origin_m: origin of the link's frame in the previous link's frame, m.
        armature_kg_m2: inertia of the drive at the joint, kg m^2; kg for a prismatic joint.
        viscous: friction per speed, N m s/rad or N s/m.
        coulomb: friction that hardly depends on the speed, N m or N, see `COULOMB_SPEED`.
        lower: position of the lower stop, rad or m; -inf without a stop.
        upper: position of the upper stop, rad or m; inf without a stop.
        stop_stiffness: stiffness of both stops, N m/rad or N/m.
        stop_damping: damping of both stops, N m s/rad or N s/m.
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
    """Returns the layout of a joint's row, with constants and work space.

    Args:
        joints: the number of joints of the chain.
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
    """Returns the rows of a chain, shape (n,), see `chain_dtype`.

    The rotation of a joint by the angle q about its axis a (Rodrigues) uses three constant
    matrices, where F is the rotation at q = 0:

        R = F + sin(q) F [a] + (1 - cos(q)) F [a]^2

    Args:
        joints: the joints.
        width: number of joints for which the rows have room; by default that of the chain.
    """
    rows = np.zeros(len(joints), chain_dtype(width or len(joints)))
    row: Row
    for row, joint in zip(rows, joints, strict=True):
        x, y, z = joint.axis
        cross_matrix = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
        row.prismatic = int(joint.prismatic)
        row.axis = joint.axis
        row.origin = joint.origin_m
        row.at_rest = joint.rotation
        if joint.prismatic:
            row.slide = apply(joint.rotation, joint.axis)
        else:
            by_sine = multiply(joint.rotation, cross_matrix)
            row.by_sine = by_sine
            row.by_cosine = multiply(by_sine, cross_matrix)
        for name in _DRIVE:
            row[name] = getattr(joint, name)
    return rows


@leaf
def three(a: Vector) -> Three:
    """Returns the three numbers of a row."""
    return a[0], a[1], a[2]


@leaf
def put_three(a: Array, values: Three) -> None:
    """Writes three numbers into a row."""
    a[0], a[1], a[2] = values


@leaf
def dot(a: Three, b: Three) -> float:
    """Returns the scalar product a' b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@leaf
def cross(a: Three, b: Three) -> Three:
    """Returns the vector product a x b."""
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return x, y, z


@leaf
def add(a: Three, b: Three) -> Three:
    """Returns a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@leaf
def subtract(a: Three, b: Three) -> Three:
    """Returns a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@leaf
def scale(factor: float, a: Three) -> Three:
    """Returns factor * a."""
    return factor * a[0], factor * a[1], factor * a[2]


@leaf
def rotate(R: Array, a: Three) -> Three:
    """Returns R a."""
    return (
        R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2],
        R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2],
        R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2],
    )


@leaf
def rotate_back(R: Array, a: Three) -> Three:
    """Returns R' a."""
    return (
        R[0, 0] * a[0] + R[1, 0] * a[1] + R[2, 0] * a[2],
        R[0, 1] * a[0] + R[1, 1] * a[1] + R[2, 1] * a[2],
        R[0, 2] * a[0] + R[1, 2] * a[1] + R[2, 2] * a[2],
    )


def apply(a: Matrix, b: Three) -> Three:
    """Returns a b by sums in a fixed order."""
    x, y, z = a
    return (
        x[0] * b[0] + x[1] * b[1] + x[2] * b[2],
        y[0] * b[0] + y[1] * b[1] + y[2] * b[2],
        z[0] * b[0] + z[1] * b[1] + z[2] * b[2],
    )


def multiply(a: Matrix, b: Matrix) -> Matrix:
    """Returns the product a b of two matrices.

    The sums have a fixed order. The sums of a library may differ in the last bit.
    """
    columns = tuple(zip(*b, strict=True))
    rows: list[Any] = []
    for x, y, z in a:
        rows.append(tuple(x * u + y * v + z * w for u, v, w in columns))
    return tuple(rows)


@leaf
def place_joints(chain: RowArray, q: Vector) -> None:
    """Writes R and p of each link in the previous link's frame, at joint positions q."""
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        sine = 0.0
        versine = 0.0
        if row.prismatic == 0:
            sine, cosine = sincos(q[i])
            versine = 1.0 - cosine
        for j in range(3):
            for k in range(3):
                turn = row.at_rest[j, k] + sine * row.by_sine[j, k]
                row.R[j, k] = turn + versine * row.by_cosine[j, k]
            row.p[j] = row.origin[j] + q[i] * row.slide[j]


@leaf
def _move(row: Row, linear: Three, angular: Three, rate: float) -> tuple[Three, Three]:
    """Returns X V_p + S rate, a spatial velocity of a link from that of the previous link.

    Args:
        row: the joint's row.
        linear: linear half of V_p, in the previous link's frame.
        angular: angular half of V_p, in the previous link's frame.
        rate: velocity of the joint.
    """
    lin = rotate_back(row.R, add(linear, cross(angular, three(row.p))))
    ang = rotate_back(row.R, angular)
    if row.prismatic == 0:
        return lin, add(ang, scale(rate, three(row.axis)))
    return add(lin, scale(rate, three(row.axis))), ang


@leaf
def _momentum(pi: Vector, first: int, linear: Three, angular: Three) -> tuple[Three, Three]:
    """Returns the spatial momentum I(pi) V.

    Args:
        pi: inertial parameters of the links.
        first: index of the link's first parameter.
        linear: linear half of V.
        angular: angular half of V.
    """
    mc = (pi[first + 1], pi[first + 2], pi[first + 3])
    xx = pi[first + 4]
    xy = pi[first + 5]
    yy = pi[first + 6]
    xz = pi[first + 7]
    yz = pi[first + 8]
    zz = pi[first + 9]
    spin_x = xx * angular[0] + xy * angular[1] + xz * angular[2]
    spin_y = xy * angular[0] + yy * angular[1] + yz * angular[2]
    spin_z = xz * angular[0] + yz * angular[1] + zz * angular[2]
    linear_momentum = add(scale(pi[first], linear), cross(angular, mc))
    angular_momentum = add(cross(mc, linear), (spin_x, spin_y, spin_z))
    return linear_momentum, angular_momentum


@leaf
def _along_axis(row: Row, linear: Three, angular: Three) -> float:
    """Returns S' f, the component of a spatial force along a joint's axis."""
    return dot(three(row.axis), angular if row.prismatic == 0 else linear)


@leaf
def friction_torque(row: Row, speed: float) -> float:
    """Returns the friction torque at a speed, N m or N; it increases with the speed.

    f(v) = viscous v + coulomb x / sqrt(1 + x^2),    x = v / COULOMB_SPEED
    """
    x = speed / COULOMB_SPEED
    torque: float = row.viscous * speed + row.coulomb * (x / sqrt(1.0 + x * x))
    return torque


@leaf
def _pass_force(row: Row, before: Row) -> None:
    """Adds a link's spatial force to that of the previous link, in the previous frame."""
    linear = rotate(row.R, three(row.f_lin))
    angular = add(rotate(row.R, three(row.f_ang)), cross(three(row.p), linear))
    put_three(before.f_lin, add(three(before.f_lin), linear))
    put_three(before.f_ang, add(three(before.f_ang), angular))


@leaf
def propagate_motion(
    chain: RowArray, gravity: Vector, qd: Vector, v: Vector, a: Vector
) -> None:
    """Writes V, W and A of each link, after `place_joints`.

    Args:
        chain: the chain's rows.
        gravity: gravitational acceleration in the base's frame, m/s^2, shape (3,).
        qd: velocities of the joints, shape (n,).
        v: reference velocities, which C multiplies, shape (n,).
        a: reference accelerations, which M multiplies, shape (n,).
    """
    still = (0.0, 0.0, 0.0)
    V = W = (still, still)
    A = ((-gravity[0], -gravity[1], -gravity[2]), still)
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        V = _move(row, V[0], V[1], qd[i])
        W = _move(row, W[0], W[1], v[i])
        A = _move(row, A[0], A[1], a[i])
        along = scale(v[i], three(row.axis))
        if row.prismatic == 0:
            A = (add(A[0], cross(V[0], along)), add(A[1], cross(V[1], along)))
        else:
            A = (add(A[0], cross(V[1], along)), A[1])
        put_three(row.V_lin, V[0])
        put_three(row.V_ang, V[1])
        put_three(row.W_lin, W[0])
        put_three(row.W_ang, W[1])
        put_three(row.A_lin, A[0])
        put_three(row.A_ang, A[1])


@leaf
def _motion_cross(V: tuple[Three, Three], W: tuple[Three, Three]) -> tuple[Three, Three]:
    """Returns V x W of two spatial velocities."""
    return add(cross(V[1], W[0]), cross(V[0], W[1])), cross(V[1], W[1])


@leaf
def _force_cross(V: tuple[Three, Three], f: tuple[Three, Three]) -> tuple[Three, Three]:
    """Returns V x* f of a spatial velocity and a spatial force."""
    return cross(V[1], f[0]), add(cross(V[1], f[1]), cross(V[0], f[0]))


@leaf
def inverse_dynamics(
    chain: RowArray, theta: Vector, v: Vector, a: Vector, torque: Array
) -> None:
    """Writes the torque of the inverse dynamics, shape (n,), after `propagate_motion`.

        M a + C(q, qd) v + G + armature a + friction(v)

    With friction at the reference velocity, r' (friction(qd) - friction(v)) >= 0: friction can
    only dissipate energy.
    """
    n = chain.shape[0]
    for i in range(n):
        row: Row = chain[i]
        V = (three(row.V_lin), three(row.V_ang))
        W = (three(row.W_lin), three(row.W_ang))
        first = LINK_PARAMETERS * i
        f = _momentum(theta, first, three(row.A_lin), three(row.A_ang))
        between = _motion_cross(V, W)
        f_1 = _force_cross(V, _momentum(theta, first, W[0], W[1]))
        f_2 = _force_cross(W, _momentum(theta, first, V[0], V[1]))
        f_3 = _momentum(theta, first, between[0], between[1])
        lin = add(add(f_1[0], f_2[0]), scale(-1.0, f_3[0]))
        ang = add(add(f_1[1], f_2[1]), scale(-1.0, f_3[1]))
        put_three(row.f_lin, add(f[0], scale(0.5, lin)))
        put_three(row.f_ang, add(f[1], scale(0.5, ang)))
    for i in range(n - 1, -1, -1):
        row = chain[i]
        borne = _along_axis(row, three(row.f_lin), three(row.f_ang))
        torque[i] = borne + row.armature_kg_m2 * a[i] + friction_torque(row, v[i])
        if i > 0:
            _pass_force(row, chain[i - 1])


@leaf
def _add_products(
    factor: float, x: tuple[Three, Three], y: tuple[Three, Three], first: int, gradient: Array
) -> None:
    """Adds factor times the gradient of x' I(pi) y with respect to pi.

    Args:
        factor: the factor.
        x: a spatial velocity.
        y: a spatial velocity.
        first: index of the link's first parameter.
        gradient: changed in its ten entries from `first`.
    """
    (x_lin, x_ang) = x
    (y_lin, y_ang) = y
    lever = add(cross(y_lin, x_ang), cross(x_lin, y_ang))
    gradient[first] += factor * dot(x_lin, y_lin)
    for j in range(3):
        gradient[first + 1 + j] += factor * lever[j]
    gradient[first + 4] += factor * (x_ang[0] * y_ang[0])
    gradient[first + 5] += factor * (x_ang[0] * y_ang[1] + x_ang[1] * y_ang[0])
    gradient[first + 6] += factor * (x_ang[1] * y_ang[1])
    gradient[first + 7] += factor * (x_ang[0] * y_ang[2] + x_ang[2] * y_ang[0])
    gradient[first + 8] += factor * (x_ang[1] * y_ang[2] + x_ang[2] * y_ang[1])
    gradient[first + 9] += factor * (x_ang[2] * y_ang[2])


@leaf
def parameter_gradient(chain: RowArray, gradient: Array) -> None:
    """Writes Y' r, Eq. (15), for r = qd - v, shape (10 n,), after `propagate_motion`."""
    for i in range(chain.shape[0]):
        row: Row = chain[i]
        V = (three(row.V_lin), three(row.V_ang))
        W = (three(row.W_lin), three(row.W_ang))
        s = (add(V[0], scale(-1.0, W[0])), add(V[1], scale(-1.0, W[1])))
        first = LINK_PARAMETERS * i
        for p in range(first, first + LINK_PARAMETERS):
            gradient[p] = 0.0
        _add_products(
            factor=1.0,
            x=s,
            y=(three(row.A_lin), three(row.A_ang)),
            first=first,
            gradient=gradient,
        )
        _add_products(factor=-0.5, x=_motion_cross(V, s), y=W, first=first, gradient=gradient)
        _add_products(factor=-0.5, x=_motion_cross(W, s), y=V, first=first, gradient=gradient)
        _add_products(factor=-0.5, x=s, y=_motion_cross(V, W), first=first, gradient=gradient)


@leaf
def _add_composite(row: Row, before: Row) -> None:
    """Adds a composite body to that of the previous link, about the previous link's origin.

    The parallel-axis theorem is written out for the ten parameters of a body.
    """
    pi = row.composite
    total = before.composite
    R = row.R
    m = pi[0]
    p = three(row.p)
    h = rotate(R, (pi[1], pi[2], pi[3]))
    x = rotate(R, (pi[4], pi[5], pi[7]))
    y = rotate(R, (pi[5], pi[6], pi[8]))
    z = rotate(R, (pi[7], pi[8], pi[9]))
    # x, y and z are the columns of R I; I is symmetric.
    I_x = rotate(R, (x[0], y[0], z[0]))
    I_y = rotate(R, (x[1], y[1], z[1]))
    I_z = rotate(R, (x[2], y[2], z[2]))
    around = 2.0 * dot(p, h) + m * dot(p, p)
    total[0] += m
    for j in range(3):
        total[1 + j] += h[j] + m * p[j]
    total[4] += I_x[0] + around - 2.0 * p[0] * h[0] - m * p[0] * p[0]
    total[5] += I_x[1] - p[0] * h[1] - p[1] * h[0] - m * p[0] * p[1]
    total[6] += I_y[1] + around - 2.0 * p[1] * h[1] - m * p[1] * p[1]
    total[7] += I_x[2] - p[0] * h[2] - p[2] * h[0] - m * p[0] * p[2]
    total[8] += I_y[2] - p[1] * h[2] - p[2] * h[1] - m * p[1] * p[2]
    total[9] += I_z[2] + around - 2.0 * p[2] * h[2] - m * p[2] * p[2]


@leaf
def mass_matrix(chain: RowArray, theta: Vector) -> None:
    """Writes M(q) with the drives' inertia into the rows' `M`, after `place_joints`.

    Only the lower triangle is written. Method: composite rigid bodies (Featherstone).
    """
    n = chain.shape[0]
    for i in range(n):
        row: Row = chain[i]
        for p in range(LINK_PARAMETERS):
            row.composite[p] = theta[LINK_PARAMETERS * i + p]
    still = (0.0, 0.0, 0.0)
    for i in range(n - 1, -1, -1):
        row = chain[i]
        axis = three(row.axis)
        if row.prismatic == 0:
            linear, angular = _momentum(row.composite, 0, still, axis)
        else:
            linear, angular = _momentum(row.composite, 0, axis, still)
        row.M[i] = _along_axis(row, linear, angular) + row.armature_kg_m2
        for j in range(i - 1, -1, -1):
            above: Row = chain[j + 1]
            linear = rotate(above.R, linear)
            angular = add(rotate(above.R, angular), cross(three(above.p), linear))
            row.M[j] = _along_axis(chain[j], linear, angular)
        if i > 0:
            _add_composite(row, chain[i - 1])


@leaf
def _stop_torque(row: Row, q: float, qd: float) -> float:
    """Returns the torque of a joint's stops, a spring and a damper that never pull."""
    if q < row.lower:
        push: float = row.stop_stiffness * (row.lower - q) - row.stop_damping * qd
        return max(push, 0.0)
    if q > row.upper:
        push = row.stop_stiffness * (row.upper - q) - row.stop_damping * qd
        return min(push, 0.0)
    return 0.0


@leaf
def _bias(chain: RowArray, theta: Vector, gravity: Vector, q: Vector, qd: Vector) -> None:
    """Writes C qd + G + friction - stops into the rows' `bias`, after `place_joints`."""
    n = chain.shape[0]
    still = (0.0, 0.0, 0.0)
    V = (still, still)
    A = ((-gravity[0], -gravity[1], -gravity[2]), still)
    for i in range(n):
        row: Row = chain[i]
        V = _move(row, V[0], V[1], qd[i])
        A = _move(row, A[0], A[1], 0.0)
        along = scale(qd[i], three(row.axis))
        if row.prismatic == 0:
            A = (add(A[0], cross(V[0], along)), add(A[1], cross(V[1], along)))
        else:
            A = (add(A[0], cross(V[1], along)), A[1])
        first = LINK_PARAMETERS * i
        f = _momentum(theta, first, A[0], A[1])
        turning = _force_cross(V, _momentum(theta, first, V[0], V[1]))
        put_three(row.f_lin, add(f[0], turning[0]))
        put_three(row.f_ang, add(f[1], turning[1]))
    for i in range(n - 1, -1, -1):
        row = chain[i]
        rigid = _along_axis(row, three(row.f_lin), three(row.f_ang))
        row.bias = rigid + friction_torque(row, qd[i])
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
    """Writes M and the bias torque C qd + G + friction - stops, after `place_joints`.

    Args:
        chain: the chain's rows.
        theta: inertial parameters, shape (10 n,).
        gravity: gravitational acceleration in the base's frame, m/s^2, shape (3,).
        q: joint positions, shape (n,).
        qd: joint velocities, shape (n,).
        M: written, shape (n, n).
        bias: written, shape (n,).
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
    """Writes the joint accelerations qdd, Eq. (8), shape (n,), after `place_joints`.

        M qdd = torque - C qd - G - friction + stops

    `torque` is the whole torque on the joints. M is factored in place as L D L', which needs no
    square roots.
    """
    n = chain.shape[0]
    _bias(chain=chain, theta=theta, gravity=gravity, q=q, qd=qd)
    mass_matrix(chain, theta)
    for i in range(n):
        row: Row = chain[i]
        for j in range(i):
            other: Row = chain[j]
            for k in range(j):
                row.M[j] -= row.M[k] * other.M[k] * chain[k].M[k]
            row.M[j] /= other.M[j]
        for k in range(i):
            row.M[i] -= row.M[k] * row.M[k] * chain[k].M[k]
        total = torque[i] - row.bias
        for k in range(i):
            total -= row.M[k] * qdd[k]
        qdd[i] = total
    for i in range(n - 1, -1, -1):
        qdd[i] /= chain[i].M[i]
        for k in range(i + 1, n):
            qdd[i] -= chain[k].M[i] * qdd[k]


@leaf
def place_end_effector(chain: RowArray, tip: Vector) -> Three:
    """Writes the Jacobian and the links' orientations into the rows, in base axes.

    Args:
        chain: the chain's rows, after `place_joints`. Written are the columns of the Jacobian
            J_lin, m/rad or 1, and J_ang, 1 or 0, and for each link its orientation R_base, its
            joint's position p_base and its joint's axis axis_base.
        tip: the end effector in the last link's frame, m, shape (3,).

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
            position = three(row.p)
            for j in range(3):
                put_three(R_base[j], three(R[j]))
        else:
            before = chain[i - 1].R_base
            position = add(position, rotate(before, three(row.p)))
            for k in range(3):
                column = rotate(before, (R[0, k], R[1, k], R[2, k]))
                R_base[0, k], R_base[1, k], R_base[2, k] = column
        put_three(row.axis_base, rotate(R_base, three(row.axis)))
        put_three(row.p_base, position)
    position = add(position, rotate(chain[n - 1].R_base, three(tip)))
    for i in range(n):
        row = chain[i]
        axis = three(row.axis_base)
        if row.prismatic == 0:
            lever = subtract(position, three(row.p_base))
            put_three(row.J_lin, cross(axis, lever))
            put_three(row.J_ang, axis)
        else:
            put_three(row.J_lin, axis)
            put_three(row.J_ang, (0.0, 0.0, 0.0))
    return position
