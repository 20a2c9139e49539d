"""A chain of joints in plain NumPy, and how a site follows its peers.

The planar arm is `analysis.arm_rows.PlacedArm`. Vectors have their components on the first axis
and any number of columns behind it: shape (n,) or (n, B).

A spatial vector has its linear half first, at the origin of the link's own frame. Link i has
the Jacobian J_i, the velocities V_i = J_i qd and W_i = J_i v, and the acceleration
A_i = X A_p + S a + V_i x (S v), which includes gravity; A_p is that of the link before. Link i
needs the force

    f_i = I A_i + 1/2 (V_i x* I W_i + W_i x* I V_i - I (V_i x W_i))

which is linear in its ten parameters: f_i = F_i pi_i. Therefore Y = (J_1' F_1 ... J_n' F_n),
Eq. (12), and M = sum_i J_i' I_i J_i. Spatial vectors after Featherstone, "Rigid Body Dynamics
Algorithms" (2008).

Following in task space is that of `analysis.following.find_task_reference`, with
psi = -k (q - posture). A force F at the end effector is the torque J' F, and a torque tau is
the force A^-1 J tau. Sources are in `core.task_space` and docs/laws.md.

Invariant:
    - Nothing is imported from the compiled core's arithmetic.
    - Every function is analytic in every argument, except where a chain meets a stop (there the
      real part decides), so that a complex step gives derivatives exact to rounding.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ..analysis.arm_rows import Numbers, multiply_columns, solve_columns
from ..analysis.following import find_task_reference
from ..core.chain import COULOMB_SPEED, LINK_PARAMETERS, ChainJoint
from ..core.site_setup import ChainSetup, SiteSetup, TaskSetup
from ..core.task_space import POSITION
from ..core.vectors import Array

_EPSILON = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _EPSILON[_i, _j, _k] = 1.0
    _EPSILON[_i, _k, _j] = -1.0
_INERTIA_PLACES = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
"""Rows and columns of Ixx, Ixy, Iyy, Ixz, Iyz, Izz."""


def build_cross_matrix(a: Numbers) -> Numbers:
    """Returns the matrix of the cross product with a, shape (3, 3, ...)."""
    matrix: Numbers = np.einsum("ijk,j...->ik...", _EPSILON, a)
    return matrix


def _build_inertia_units() -> Numbers:
    """Returns the spatial inertia of each unit parameter of a link, shape (10, 6, 6).

    A link's inertia is linear in its parameters: mass, first moments, second moments.
    """
    units = np.zeros((LINK_PARAMETERS, 6, 6))
    units[0, :3, :3] = np.eye(3)
    for n in range(3):
        cross = build_cross_matrix(np.eye(3)[n])
        units[1 + n, :3, 3:] = -cross
        units[1 + n, 3:, :3] = cross
    for n, (row, column) in enumerate(_INERTIA_PLACES):
        units[4 + n, 3 + row, 3 + column] = 1.0
        units[4 + n, 3 + column, 3 + row] = 1.0
    return units


_INERTIA_UNITS = _build_inertia_units()


def _cross_motion(V: Numbers) -> Numbers:
    """Returns the matrix of the spatial cross product V x, shape (6, 6, ...).

    The matrix of V x* for forces is minus its transpose.
    """
    matrix = np.zeros((6, 6, *V.shape[1:]), V.dtype)
    rotation = build_cross_matrix(V[3:])
    matrix[:3, :3] = rotation
    matrix[3:, 3:] = rotation
    matrix[:3, 3:] = build_cross_matrix(V[:3])
    return matrix


def _multiply(a: Numbers, b: Numbers) -> Numbers:
    """Returns the product of matrices of shapes (a, b, ...) and (b, c, ...)."""
    product: Numbers = np.einsum("ab...,bc...->ac...", a, b)
    return product


class PlacedLink(NamedTuple):
    """A link of a chain in some poses.

    Attributes:
        X: transformation of spatial velocities from the frame of the link before into this
            link's frame, shape (6, 6, ...).
        S: spatial velocity of its joint at speed 1, shape (6,).
        J: Jacobian of the link, shape (6, n, ...).
        R_base: orientation in the base, shape (3, 3, ...).
        place_m: origin in the base, shape (3, ...), m.
    """

    X: Numbers
    S: Numbers
    J: Numbers
    R_base: Numbers
    place_m: Numbers


class PlacedChain:
    """A chain in the poses q, shape (n, ...), with the same methods as `PlacedArm`."""

    def __init__(self, chain: ChainSetup, q: Numbers) -> None:
        self._chain = chain
        self._q = q
        self._links: list[PlacedLink] = []
        columns = q.shape[1:]
        J = np.zeros((6, len(q), *columns))
        R_base = np.multiply.outer(np.eye(3), np.ones(columns))
        place_m = np.zeros((3, *columns))
        for i, joint in enumerate(chain.joints):
            R, p = _place_joint(joint, q[i])
            R_transposed = R.swapaxes(0, 1)
            X = np.zeros((6, 6, *columns), np.result_type(R, p))
            X[:3, :3] = R_transposed
            X[3:, 3:] = R_transposed
            X[:3, 3:] = -_multiply(R_transposed, build_cross_matrix(p))
            S = np.zeros(6)
            half = slice(0, 3) if joint.prismatic else slice(3, 6)
            S[half] = joint.axis
            J = _multiply(X, J)
            J[:, i] += S.reshape(6, *(1,) * len(columns))
            place_m = place_m + multiply_columns(R_base, p)
            R_base = _multiply(R_base, R)
            self._links.append(PlacedLink(X=X, S=S, J=J, R_base=R_base, place_m=place_m))

    def _get_per_joint(self, name: str) -> Numbers:
        """Returns an attribute of every joint, shape (n, 1, ...)."""
        values = np.array([getattr(joint, name) for joint in self._chain.joints])
        return values.reshape(-1, *(1,) * (self._q.ndim - 1))

    def regressor_matrix(self, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Returns the regressor Y(q, qd, v, a) of the links without drives, Eq. (12).

        Its shape is (n, 10 n, ...).
        """
        blocks = []
        gravity = np.array([*self._chain.gravity_m_s2, 0.0, 0.0, 0.0])
        # an upward acceleration of the base stands for gravity
        A = -np.multiply.outer(gravity, np.ones(self._q.shape[1:]))
        for i, link in enumerate(self._links):
            V = multiply_columns(link.J, qd)
            W = multiply_columns(link.J, v)
            V_cross = _cross_motion(V)
            W_cross = _cross_motion(W)
            A = multiply_columns(link.X, A) + np.multiply.outer(link.S, a[i])
            A = A + multiply_columns(V_cross, np.multiply.outer(link.S, v[i]))
            I_A = _multiply_inertia_units(A)
            I_V = _multiply_inertia_units(V)
            I_W = _multiply_inertia_units(W)
            I_VW = _multiply_inertia_units(multiply_columns(V_cross, W))
            # V x* is minus the transpose of V x
            cross_terms = _multiply(V_cross.swapaxes(0, 1), I_W)
            cross_terms = cross_terms + _multiply(W_cross.swapaxes(0, 1), I_V) + I_VW
            F = I_A - 0.5 * cross_terms
            blocks.append(_multiply(link.J.swapaxes(0, 1), F))
        return np.concatenate(blocks, axis=1)

    def required_torque(self, theta: Numbers, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Returns M(q) a + C(q, qd) v + G(q) + friction(v), shape (n, ...), N m.

        M includes the inertia of the drives.
        """
        friction = self.friction_torque(v)
        links = multiply_columns(self.regressor_matrix(qd, v, a), theta)
        torque: Numbers = links + self._get_per_joint("armature_kg_m2") * a + friction
        return torque

    def friction_torque(self, v: Numbers) -> Numbers:
        """Returns the torque of the joints' friction at speeds v, shape (n, ...), N m."""
        x = v / COULOMB_SPEED
        viscous = self._get_per_joint("viscous") * v
        return viscous + self._get_per_joint("coulomb") * x / np.sqrt(1.0 + x * x)

    def gravity_torque(self, theta: Numbers) -> Numbers:
        """Returns G(q), shape (n, ...), N m."""
        zeros = np.zeros_like(self._q)
        return self.required_torque(theta, zeros, zeros, zeros)

    def inertia_matrix(self, theta: Numbers) -> Numbers:
        """Returns M(q) with the drives' inertia, shape (n, n, ...)."""
        armatures = np.diag([joint.armature_kg_m2 for joint in self._chain.joints])
        M = np.multiply.outer(armatures, np.ones(self._q.shape[1:]))
        for i, link in enumerate(self._links):
            parameters = theta[LINK_PARAMETERS * i : LINK_PARAMETERS * (i + 1)]
            inertia = np.einsum("pab,p...->ab...", _INERTIA_UNITS, parameters)
            M = M + _multiply(link.J.swapaxes(0, 1), _multiply(inertia, link.J))
        return M

    def joint_acceleration(self, theta: Numbers, qd: Numbers, torque: Numbers) -> Numbers:
        """Returns the joint accelerations qdd under a torque, shape (n, ...).

        They solve M qdd + C qd + G + friction = torque + stops, Eq. (8).
        """
        bias = self.required_torque(theta, qd, qd, np.zeros_like(qd))
        force = torque + self._compute_stop_torque(qd) - bias
        return solve_columns(self.inertia_matrix(theta), force)

    def _compute_stop_torque(self, qd: Numbers) -> Numbers:
        """Returns the torque of the joints' end stops, springs with dampers, shape (n, ...)."""
        q = self._q
        stiffness = self._get_per_joint("stop_stiffness")
        damping = self._get_per_joint("stop_damping")
        total: Numbers = np.zeros_like(q)
        for name, sign in (("lower", 1.0), ("upper", -1.0)):
            limit = self._get_per_joint(name)
            is_beyond = sign * (limit - q.real) > 0.0
            push = stiffness * (np.where(is_beyond, limit, 0.0) - q) - damping * qd
            pushes_back = is_beyond & (sign * push.real > 0.0)
            total = total + np.where(pushes_back, push, 0.0)
        return total

    def end_effector_position(self) -> Numbers:
        """Returns the position of the end effector in the base, shape (3, ...), m."""
        last = self._links[-1]
        tip = np.multiply.outer(np.array(self._chain.tip_m), np.ones(self._q.shape[1:]))
        return last.place_m + multiply_columns(last.R_base, tip)

    def end_effector_orientation(self) -> Numbers:
        """Returns the orientation of the end effector in the base, shape (3, 3, ...)."""
        turned: Numbers = np.einsum(
            "ab...,bc->ac...", self._links[-1].R_base, self._chain.tip_rotation
        )
        return turned

    def position_jacobian(self) -> Numbers:
        """Returns the Jacobian of the end effector's position, shape (3, n, ...).

        Its unit is m/rad, or 1 for a prismatic joint.
        """
        return self.pose_jacobian()[:3]

    def pose_jacobian(self) -> Numbers:
        """Returns the Jacobian of the end effector's linear and angular velocity.

        Its axes are those of the base, and its shape is (6, n, ...).
        """
        return self._move_to_tip(self._links[-1].J)

    def pose_jacobian_rate(self, qd: Numbers) -> Numbers:
        """Returns the time derivative of the pose Jacobian along qd, shape (6, n, ...).

        In the frame of the last link, the derivative of column k is
        X (V_k x S_k) - V x (X S_k); the rotation of the frame adds to it.
        """
        last = self._links[-1]
        V_last = multiply_columns(last.J, qd)
        rate = np.zeros(last.J.shape, np.result_type(last.J, qd))
        for k, link in enumerate(self._links):
            rate = _multiply(link.X, rate)
            V_cross = _cross_motion(multiply_columns(link.J, qd))
            axis = np.multiply.outer(link.S, np.ones(qd.shape[1:]))
            rate[:, k] += multiply_columns(V_cross, axis)
        rate = self._move_to_tip(rate - _multiply(_cross_motion(V_last), last.J))
        angular_velocity = multiply_columns(last.R_base, V_last[3:])
        spin = build_cross_matrix(angular_velocity)
        J = self.pose_jacobian()
        frame_rate: Numbers = np.concatenate([_multiply(spin, J[:3]), _multiply(spin, J[3:])])
        return rate + frame_rate

    def _move_to_tip(self, columns: Numbers) -> Numbers:
        """Returns spatial velocities of the last link at the tip and along base axes."""
        R = self._links[-1].R_base
        tip = build_cross_matrix(np.array(self._chain.tip_m))
        linear = columns[:3] - np.einsum("ab,bn...->an...", tip, columns[3:])
        return np.concatenate([_multiply(R, linear), _multiply(R, columns[3:])])


def _multiply_inertia_units(motion: Numbers) -> Numbers:
    """Returns the momentum of each unit parameter for a spatial motion, shape (6, 10, ...)."""
    momentum: Numbers = np.einsum("pab,b...->ap...", _INERTIA_UNITS, motion)
    return momentum


def _place_joint(joint: ChainJoint, q: Numbers) -> tuple[Numbers, Numbers]:
    """Returns a link's orientation and origin in the frame of the link before.

    A revolute joint turns by Rodrigues' formula, R = R_0 (1 + sin q K + (1 - cos q) K^2) with
    the cross matrix K of the axis.

    Args:
        joint: the joint.
        q: position of the joint, shape (...), rad or m.

    Returns:
        The orientation, shape (3, 3, ...), and the origin, shape (3, ...), m.
    """
    R_0 = np.array(joint.rotation)
    axis = np.array(joint.axis)
    ones = np.ones(np.shape(q))
    R = np.multiply.outer(R_0, ones)
    p = np.multiply.outer(np.array(joint.origin_m), ones)
    if joint.prismatic:
        return R, p + np.multiply.outer(R_0 @ axis, q)
    K = build_cross_matrix(axis)
    sine_term = np.multiply.outer(R_0 @ K, np.sin(q))
    cosine_term = np.multiply.outer(R_0 @ K @ K, 1.0 - np.cos(q))
    return R + sine_term + cosine_term, p


SINGULAR = 1e-9
"""A pose is singular if the squared least singular value of its Jacobian is below this.

A lower bound of that value is compared.
"""
_SMALL = 1e-4
"""Squares of angles below this are small: four terms of a series are exact."""


def rotation_from_vector(vector: Numbers) -> Numbers:
    """Returns the rotation matrix of a rotation vector, shape (3, 3, ...).

    Rodrigues' formula with series for small angles.

    Args:
        vector: axis times angle, shape (3, ...), rad.
    """
    square = np.sum(vector * vector, axis=0)
    is_small = square.real < _SMALL
    angle = np.sqrt(np.where(is_small, 1.0, square))
    # sin(x) / x and (1 - cos(x)) / x^2
    sine_series = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
    cosine_series = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    sine_factor = np.where(is_small, sine_series, np.sin(angle) / angle)
    cosine_factor = np.where(is_small, cosine_series, (1.0 - np.cos(angle)) / angle**2)
    K = build_cross_matrix(vector)
    identity = np.eye(3).reshape(3, 3, *(1,) * (vector.ndim - 1))
    rotation: Numbers = identity + sine_factor * K + cosine_factor * _multiply(K, K)
    return rotation


def vector_from_rotation(R: Numbers) -> Numbers:
    """Returns the rotation vector of a rotation matrix, shape (3, ...), at most pi long.

    It is computed from the quaternion, and that from its largest part (Shepperd, 1978).

    Args:
        R: rotation matrix, shape (3, 3, ...).
    """
    quaternion = _find_quaternion(R)
    w = quaternion[0]
    v = quaternion[1:]
    square = np.sum(v * v, axis=0)
    is_small = square.real < _SMALL
    sine = np.sqrt(np.where(is_small, 1.0, square))
    # series of 2 atan(t) / sine, with t = tan(angle / 2)
    t_square = np.where(is_small, square, 0.0) / np.where(is_small, w, 1.0) ** 2
    series = 1.0 - t_square * (1.0 / 3.0 - t_square * (1.0 / 5.0 - t_square / 7.0))
    small_factor = 2.0 / np.where(is_small, w, 1.0) * series
    # the arctangent of a ratio of at most 1, so that no part of it divides by zero
    is_below = sine.real <= w.real
    divisor = np.where(is_below, np.where(w == 0.0, 1.0, w), sine)
    ratio = np.where(is_below, sine, w) / divisor
    angle = 2.0 * np.where(is_below, np.arctan(ratio), 0.5 * np.pi - np.arctan(ratio))
    vector: Numbers = np.where(is_small, small_factor, angle / sine) * v
    return vector


def _find_quaternion(R: Numbers) -> Numbers:
    """Returns the unit quaternion (w, x, y, z), w >= 0, of a rotation, shape (4, ...).

    Each row of `products` is the quaternion times four times one of its parts. The row of the
    largest part has the smallest rounding error (Shepperd, 1978).
    """
    xx = R[0, 0]
    yy = R[1, 1]
    zz = R[2, 2]
    x = R[2, 1] - R[1, 2]
    y = R[0, 2] - R[2, 0]
    z = R[1, 0] - R[0, 1]
    xy = R[0, 1] + R[1, 0]
    xz = R[0, 2] + R[2, 0]
    yz = R[1, 2] + R[2, 1]
    products = np.array(
        [
            [1.0 + xx + yy + zz, x, y, z],
            [x, 1.0 + xx - yy - zz, xy, xz],
            [y, xy, 1.0 - xx + yy - zz, yz],
            [z, xz, yz, 1.0 - xx - yy + zz],
        ]
    )
    sizes = np.array([products[n, n].real for n in range(4)])
    largest = sizes.argmax(axis=0)[np.newaxis, np.newaxis]
    quaternion = np.take_along_axis(products, largest, axis=0)[0]
    quaternion = quaternion / np.sqrt(np.sum(quaternion * quaternion, axis=0))
    with_positive_w: Numbers = np.where(quaternion[0].real < 0.0, -quaternion, quaternion)
    return with_positive_w


def relative_rotation_vector(other: Numbers, R: Numbers) -> Numbers:
    """Returns Log(R other'), the rotation from another orientation to R, in base axes."""
    return vector_from_rotation(np.einsum("ab...,cb...->ac...", R, other))


def evaluate_reference(shares: Array, site_pose: Numbers, shared: Sequence[Numbers]) -> Numbers:
    """Returns the pose that a site follows, in the coordinates of its shared pose, Eq. (6).

    The position is the mean of the peers' positions, weighted with the dominance factors. The
    orientation is Exp(-sum_j alpha_ij Log(R_i R_j')) R_i.

    Args:
        shares: row of the dominance matrix, shape (N,).
        site_pose: the shared pose of the site itself, shape (m, ...).
        shared: the shared pose of each site, shape (m, ...).
    """
    followed = [
        (share, pose) for share, pose in zip(shares.tolist(), shared, strict=True) if share
    ]
    position = sum(share * pose[:POSITION] for share, pose in followed)
    if len(site_pose) == POSITION:
        return np.asarray(position)
    R = rotation_from_vector(site_pose[POSITION:])
    difference = sum(
        share * relative_rotation_vector(rotation_from_vector(pose[POSITION:]), R)
        for share, pose in followed
    )
    reference = _multiply(rotation_from_vector(-np.asarray(difference)), R)
    # zero times the site's pose gives the position the same number of columns
    columns = np.asarray(position) + 0.0 * site_pose[:POSITION]
    return np.concatenate([columns, vector_from_rotation(reference)])


class Following(NamedTuple):
    """How a site follows, in joint space or with its end effector along the followed axes.

    Attributes:
        x: the shared pose, shape (m, ...).
        xd: its velocity, and the angular velocity for an orientation, shape (m, ...).
        e: error of the followed coordinates, shape (m, ...).
        ed: their velocity less the reference's, shape (m, ...).
        v: reference velocity of the joints, shape (n, ...).
        a: derivative of v, shape (n, ...).
        J: Jacobian of the followed axes, shape (m, n, ...); None in joint space, where it is
            the unit matrix.
        A: J J' with its damping, shape (m, m, ...).
        least: lower bound of the square of the undamped Jacobian's least singular value; inf in
            joint space.
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
        """Returns the joint torque J' F of a force F on the coordinates, shape (n, ...)."""
        return force if self.J is None else multiply_columns(self.J.swapaxes(0, 1), force)

    def from_joints(self, torque: Numbers) -> Numbers:
        """Returns the force A^-1 J tau on the coordinates of a joint torque, shape (m, ...)."""
        if self.J is None or self.A is None:
            return torque
        return solve_columns(self.A, multiply_columns(self.J, torque))


def follow_joints(
    Lambda: Numbers, q: Numbers, qd: Numbers, q_des: Numbers, qd_des: Numbers
) -> Following:
    """Returns how a site follows joint by joint, Eq. (9), (10): v = -Lambda (q - q_des)."""
    e = q - q_des
    ed = qd - qd_des
    return Following(x=q, xd=qd, e=e, ed=ed, v=-Lambda * e, a=-Lambda * ed)


def share_pose(task: TaskSetup, arm: PlacedChain) -> Numbers:
    """Returns the pose that a site shares: position and rotation vector, or position only."""
    position = task.scale * arm.end_effector_position()
    if len(task.axes) == POSITION:
        return position
    return np.concatenate([position, vector_from_rotation(arm.end_effector_orientation())])


def follow_in_task(
    site: SiteSetup,
    arm: PlacedChain,
    Lambda: Numbers,
    q: Numbers,
    qd: Numbers,
    x_des: Numbers,
    xd_des: Numbers,
) -> Following:
    """Returns how a site follows with its end effector.

    In a singular pose A and everything computed from it is NaN.

    Args:
        site: setup of a site that follows in task space.
        arm: the arm in the pose q.
        Lambda: rates of the followed coordinates, 1/s.
        q: joint positions, shape (n, ...).
        qd: joint velocities, shape (n, ...).
        x_des: reference of the shared pose, shape (m, ...).
        xd_des: reference of its velocity, shape (m, ...).
    """
    assert site.chain is not None
    assert site.chain.task is not None
    task = site.chain.task
    m = site.layout.shared
    x = share_pose(task, arm)
    trailing = (1,) * (q.ndim - 1)
    axes = np.array(task.axes).reshape(m, *trailing)
    scales = np.array([task.scale] * POSITION + [1.0] * POSITION)[:m].reshape(m, 1, *trailing)
    full_J = scales * arm.pose_jacobian()[:m]
    full_J_rate = scales * arm.pose_jacobian_rate(qd)[:m]
    xd = multiply_columns(full_J, qd)
    e = x - x_des
    if m > POSITION:
        R = rotation_from_vector(x[POSITION:])
        columns_of_x_des = x_des + 0.0 * x
        R_des = rotation_from_vector(columns_of_x_des[POSITION:])
        e = np.concatenate([e[:POSITION], relative_rotation_vector(R_des, R)])
    e = axes * e
    ed = axes * (xd - xd_des)
    J = axes[:, np.newaxis] * full_J
    J_rate = axes[:, np.newaxis] * full_J_rate
    A, least = _damp(task, J)
    posture = np.array(task.posture or site.q0).reshape(-1, *trailing)
    psi = -task.posture_rate * (q - posture)
    psi_d = -task.posture_rate * qd
    v, a = find_task_reference(
        J=J,
        Jd=J_rate,
        solve=partial(solve_columns, A),
        posture=(psi, psi_d),
        error=(Lambda * e, Lambda * ed),
    )
    return Following(x=x, xd=xd, e=e, ed=ed, v=v, a=a, J=J, A=A, least=least)


def _damp(task: TaskSetup, J: Numbers) -> tuple[Numbers, float]:
    """Returns J J', damped if the pose is nearly singular, and the bound that decides.

    The bound 1 / trace((J J')^-1) is at most the square of the least singular value. Below the
    limit sigma^2 it is raised to the limit by adding the difference to the diagonal (damped
    least squares).

    Args:
        task: the task.
        J: Jacobian of the followed axes, shape (m, n, ...), with zero rows for the others.
    """
    m = len(task.axes)
    trailing = (1,) * (J.ndim - 2)
    followed = [n for n, is_followed in enumerate(task.axes) if is_followed]
    # ones on the diagonal of the axes that are not followed keep the matrix regular
    free_axes = np.diag(1.0 - np.array(task.axes)).reshape(m, m, *trailing)
    A = np.einsum("an...,bn...->ab...", J, J) + free_axes
    inner = np.moveaxis(A[followed][:, followed], (0, 1), (-2, -1))
    singular_values = np.linalg.svd(inner.real, compute_uv=False)
    if not singular_values[..., -1].min() > SINGULAR:
        return A + np.nan, 0.0
    bound = 1.0 / np.trace(np.linalg.inv(inner), axis1=-2, axis2=-1)
    limit = task.singular_value**2
    damping = np.where(bound.real < limit, limit - bound, 0.0)
    identity = np.eye(m).reshape(m, m, *trailing)
    return A + damping * identity, float(bound.real.min())
