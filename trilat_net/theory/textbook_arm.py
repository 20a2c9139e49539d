"""A chain of joints in plain NumPy and how it follows; the planar arm is
`analysis.arm_rows.PlacedArm`.

Invariant: independent of the compiled core, and analytic in every argument but where a chain
meets a stop (there the real part decides), so that a complex step gives derivatives exact to
rounding.

Vectors have their components on the first axis and any number of columns behind it: shape (n,)
or (n, B).

Of a spatial vector the linear half comes first, at the origin of the link's own frame. With the
Jacobian J_i of link i, its velocities V_i = J_i qd and W_i = J_i v, and its acceleration
A_i = X A_p + S a + V_i x (S v), gravity included, link i needs

    f_i = I A_i + 1/2 (V_i x* I W_i + W_i x* I V_i - I (V_i x W_i))

which is linear in its ten parameters: f_i = F_i pi_i. So Y = (J_1' F_1 ... J_n' F_n), Eq. (12),
and M = sum_i J_i' I_i J_i. Featherstone, "Rigid Body Dynamics Algorithms" (2008), for spatial
vectors.

Following in task space is that of `analysis.following.find_task_reference`, with psi = -k (q -
posture); a force F at the end effector is the torque J' F, and a torque tau there is the force
A^-1 J tau. Sources stand in `core.task_space` and docs/laws.md.
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
    """Returns the matrix of a x, shape (3, 3, ...)."""
    matrix: Numbers = np.einsum("ijk,j...->ik...", _EPSILON, a)
    return matrix


def _build_inertia_units() -> Numbers:
    """Returns I(pi) of unit parameters, shape (10, 6, 6): a link's inertia is linear in them."""
    units = np.zeros((LINK_PARAMETERS, 6, 6))
    units[0, :3, :3] = np.eye(3)
    for n in range(3):
        across = build_cross_matrix(np.eye(3)[n])
        units[1 + n, :3, 3:] = -across
        units[1 + n, 3:, :3] = across
    for n, (row, column) in enumerate(_INERTIA_PLACES):
        units[4 + n, 3 + row, 3 + column] = units[4 + n, 3 + column, 3 + row] = 1.0
    return units


_INERTIA_UNITS = _build_inertia_units()


def _cross_motion(V: Numbers) -> Numbers:
    """Returns the matrix of V x, shape (6, 6, ...); that of V x* is minus its transpose."""
    matrix = np.zeros((6, 6, *V.shape[1:]), V.dtype)
    matrix[:3, :3] = matrix[3:, 3:] = build_cross_matrix(V[3:])
    matrix[:3, 3:] = build_cross_matrix(V[:3])
    return matrix


def _multiply(a: Numbers, b: Numbers) -> Numbers:
    """Returns the product of matrices, shapes (a, b, ...) and (b, c, ...)."""
    product: Numbers = np.einsum("ab...,bc...->ac...", a, b)
    return product


class PlacedLink(NamedTuple):
    """A link of a chain in some poses.

    Attributes:
        X: carries spatial velocities of the link before into its frame, shape (6, 6, ...).
        S: motion of its joint at speed 1, shape (6,).
        J: its Jacobian, shape (6, n, ...).
        R_base: its orientation in the base, shape (3, 3, ...).
        place_m: its origin in the base, shape (3, ...).
    """

    X: Numbers
    S: Numbers
    J: Numbers
    R_base: Numbers
    place_m: Numbers


class PlacedChain:
    """A chain in the poses q, shape (n, ...): the same methods as `PlacedArm`."""

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
            X = np.zeros((6, 6, *columns), np.result_type(R, p))
            X[:3, :3] = X[3:, 3:] = R.swapaxes(0, 1)
            X[:3, 3:] = -_multiply(R.swapaxes(0, 1), build_cross_matrix(p))
            S = np.zeros(6)
            S[slice(0, 3) if joint.prismatic else slice(3, 6)] = joint.axis
            J = _multiply(X, J)
            J[:, i] += S.reshape(6, *(1,) * len(columns))
            place_m = place_m + multiply_columns(R_base, p)
            R_base = _multiply(R_base, R)
            self._links.append(PlacedLink(X=X, S=S, J=J, R_base=R_base, place_m=place_m))

    def _per_joint(self, name: str) -> Numbers:
        values = np.array([getattr(joint, name) for joint in self._chain.joints])
        return values.reshape(-1, *(1,) * (self._q.ndim - 1))

    def regressor_matrix(self, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Returns Y(q, qd, v, a) of the links alone, without drives, shape (n, 10 n, ...), Eq.
        (12).
        """
        parts = []
        gravity = np.array([*self._chain.gravity_m_s2, 0.0, 0.0, 0.0])
        A = -np.multiply.outer(gravity, np.ones(self._q.shape[1:]))
        for i, (X, S, J, _, _) in enumerate(self._links):
            V = multiply_columns(J, qd)
            W = multiply_columns(J, v)
            V_x = _cross_motion(V)
            W_x = _cross_motion(W)
            A = multiply_columns(X, A) + np.multiply.outer(S, a[i])
            A = A + multiply_columns(V_x, np.multiply.outer(S, v[i]))
            I_A, I_V, I_W, I_VW = (
                np.einsum("pab,b...->ap...", _INERTIA_UNITS, motion)
                for motion in (A, V, W, multiply_columns(V_x, W))
            )
            F = I_A - 0.5 * (
                _multiply(V_x.swapaxes(0, 1), I_W) + _multiply(W_x.swapaxes(0, 1), I_V) + I_VW
            )
            parts.append(_multiply(J.swapaxes(0, 1), F))
        return np.concatenate(parts, axis=1)

    def required_torque(self, theta: Numbers, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
        """Returns M(q) a + C(q, qd) v + G(q) with the drives' inertia and friction at v, shape
        (n, ...).
        """
        friction = self.friction_torque(v)
        body = multiply_columns(self.regressor_matrix(qd, v, a), theta)
        torque: Numbers = body + self._per_joint("armature_kg_m2") * a + friction
        return torque

    def friction_torque(self, v: Numbers) -> Numbers:
        """Returns the torque of the joints' friction at speeds v, shape (n, ...), N m."""
        x = v / COULOMB_SPEED
        return self._per_joint("viscous") * v + self._per_joint("coulomb") * x / np.sqrt(
            1.0 + x * x
        )

    def gravity_torque(self, theta: Numbers) -> Numbers:
        """Returns G(q), shape (n, ...), N m."""
        still = np.zeros_like(self._q)
        return self.required_torque(theta, still, still, still)

    def inertia_matrix(self, theta: Numbers) -> Numbers:
        """Returns M(q) with the drives' inertia, shape (n, n, ...)."""
        M = np.multiply.outer(
            np.diag([joint.armature_kg_m2 for joint in self._chain.joints]),
            np.ones(self._q.shape[1:]),
        )
        for i, link in enumerate(self._links):
            own = theta[LINK_PARAMETERS * i : LINK_PARAMETERS * (i + 1)]
            inertia = np.einsum("pab,p...->ab...", _INERTIA_UNITS, own)
            M = M + _multiply(link.J.swapaxes(0, 1), _multiply(inertia, link.J))
        return M

    def joint_acceleration(self, theta: Numbers, qd: Numbers, torque: Numbers) -> Numbers:
        """Returns qdd of M qdd + C qd + G + friction = torque + stops, Eq. (8), shape (n, ...)."""
        at_no_acceleration = self.required_torque(theta, qd, qd, np.zeros_like(qd))
        force = torque + self._stop_torque(qd) - at_no_acceleration
        return solve_columns(self.inertia_matrix(theta), force)

    def _stop_torque(self, qd: Numbers) -> Numbers:
        q = self._q
        stiffness = self._per_joint("stop_stiffness")
        damping = self._per_joint("stop_damping")
        total: Numbers = np.zeros_like(q)
        for name, sign in (("lower", 1.0), ("upper", -1.0)):
            limit = self._per_joint(name)
            beyond = sign * (limit - q.real) > 0.0
            push = stiffness * (np.where(beyond, limit, 0.0) - q) - damping * qd
            total = total + np.where(beyond & (sign * push.real > 0.0), push, 0.0)
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
        """Returns the Jacobian of the end effector's position, shape (3, n, ...), m/rad or 1."""
        return self.pose_jacobian()[:3]

    def pose_jacobian(self) -> Numbers:
        """Returns the Jacobian of the end effector's velocity and turning, base axes, shape (6,
        n, ...).
        """
        return self._carry_to_tip(self._links[-1].J)

    def pose_jacobian_rate(self, qd: Numbers) -> Numbers:
        """Returns the derivative of that Jacobian along qd, shape (6, n, ...).

        Of column k in the frame of the last link it is X (V_k x S_k) - V x (X S_k); the frame
        turns with it.
        """
        V_last = multiply_columns(self._links[-1].J, qd)
        rate = np.zeros(self._links[-1].J.shape, np.result_type(self._links[-1].J, qd))
        for k, (X, S, J, _, _) in enumerate(self._links):
            rate = _multiply(X, rate)
            rate[:, k] += multiply_columns(
                _cross_motion(multiply_columns(J, qd)),
                np.multiply.outer(S, np.ones(qd.shape[1:])),
            )
        rate = self._carry_to_tip(rate - _multiply(_cross_motion(V_last), self._links[-1].J))
        turning = build_cross_matrix(multiply_columns(self._links[-1].R_base, V_last[3:]))
        J = self.pose_jacobian()
        turned: Numbers = np.concatenate([_multiply(turning, J[:3]), _multiply(turning, J[3:])])
        return rate + turned

    def _carry_to_tip(self, columns: Numbers) -> Numbers:
        R = self._links[-1].R_base
        tip = build_cross_matrix(np.array(self._chain.tip_m))
        linear = columns[:3] - np.einsum("ab,bn...->an...", tip, columns[3:])
        return np.concatenate([_multiply(R, linear), _multiply(R, columns[3:])])


def _place_joint(joint: ChainJoint, q: Numbers) -> tuple[Numbers, Numbers]:
    """Returns a link's orientation, shape (3, 3, ...), and origin in the frame of the link
    before.
    """
    at_rest = np.array(joint.rotation)
    axis = np.array(joint.axis)
    ones = np.ones(np.shape(q))
    R = np.multiply.outer(at_rest, ones)
    p = np.multiply.outer(np.array(joint.origin_m), ones)
    if joint.prismatic:
        return R, p + np.multiply.outer(at_rest @ axis, q)
    across = build_cross_matrix(axis)
    turned = np.multiply.outer(at_rest @ across, np.sin(q))
    return R + turned + np.multiply.outer(at_rest @ across @ across, 1.0 - np.cos(q)), p


SINGULAR = 1e-9
"""A pose whose lower bound of the Jacobian's least squared singular value is below this is
singular.
"""
_SMALL = 1e-4
"""Squares below this are small: four terms of a series are exact."""


def rotation_from_vector(vector: Numbers) -> Numbers:
    """Returns the rotation matrix of a vector, axis times angle, shape (3, 3, ...)."""
    square = np.sum(vector * vector, axis=0)
    small = square.real < _SMALL
    angle = np.sqrt(np.where(small, 1.0, square))
    of_sine = 1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0))
    of_cosine = 0.5 - square / 24.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))
    by_sine = np.where(small, of_sine, np.sin(angle) / angle)
    by_cosine = np.where(small, of_cosine, (1.0 - np.cos(angle)) / angle**2)
    across = build_cross_matrix(vector)
    eye = np.eye(3).reshape(3, 3, *(1,) * (vector.ndim - 1))
    turned: Numbers = eye + by_sine * across + by_cosine * _multiply(across, across)
    return turned


def vector_from_rotation(R: Numbers) -> Numbers:
    """Returns the rotation vector of a rotation matrix, shape (3, ...), at most half a turn
    long.

    By the quaternion, from its largest part (Shepperd, 1978).
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
    forms = np.array(
        [
            [1.0 + xx + yy + zz, x, y, z],
            [x, 1.0 + xx - yy - zz, xy, xz],
            [y, xy, 1.0 - xx + yy - zz, yz],
            [z, xz, yz, 1.0 - xx - yy + zz],
        ]
    )
    sizes = np.array([forms[n, n].real for n in range(4)])
    quaternion = np.take_along_axis(
        forms, sizes.argmax(axis=0)[np.newaxis, np.newaxis], axis=0
    )[0]
    quaternion = quaternion / np.sqrt(np.sum(quaternion * quaternion, axis=0))
    quaternion = np.where(quaternion[0].real < 0.0, -quaternion, quaternion)
    w = quaternion[0]
    v = quaternion[1:]
    square = np.sum(v * v, axis=0)
    small = square.real < _SMALL
    sine = np.sqrt(np.where(small, 1.0, square))
    t = np.where(small, square, 0.0) / np.where(small, w, 1.0) ** 2
    series = 2.0 / np.where(small, w, 1.0) * (1.0 - t * (1.0 / 3.0 - t * (1.0 / 5.0 - t / 7.0)))
    below = sine.real <= w.real
    ratio = np.where(below, sine, w) / np.where(below, np.where(w == 0.0, 1.0, w), sine)
    angle = 2.0 * np.where(below, np.arctan(ratio), 0.5 * np.pi - np.arctan(ratio))
    vector: Numbers = np.where(small, series, angle / sine) * v
    return vector


def turn_from(other: Numbers, R: Numbers) -> Numbers:
    """Returns Log(R other'): the turn from the other orientation to this one, in base axes."""
    return vector_from_rotation(np.einsum("ab...,cb...->ac...", R, other))


def evaluate_reference(shares: Array, own: Numbers, shared: Sequence[Numbers]) -> Numbers:
    """Returns the pose that a site follows, as it shares its own: of places the mean by shares,
    Eq. (6).

    Of orientations it is the own one less the sum of alpha_ij Log(R_i R_j').

    Args:
        shares: row of the dominance matrix, shape (N,).
        own: what the site shares of its own pose, shape (m, ...).
        shared: of each site what it shares.
    """
    followed = [
        (share, pose) for share, pose in zip(shares.tolist(), shared, strict=True) if share
    ]
    places = sum(share * pose[:POSITION] for share, pose in followed)
    if len(own) == POSITION:
        return np.asarray(places)
    R = rotation_from_vector(own[POSITION:])
    apart = sum(
        share * turn_from(rotation_from_vector(pose[POSITION:]), R) for share, pose in followed
    )
    reference = _multiply(rotation_from_vector(-np.asarray(apart)), R)
    return np.concatenate(
        [np.asarray(places) + 0.0 * own[:POSITION], vector_from_rotation(reference)]
    )


class Following(NamedTuple):
    """How a site follows, in a state: of joint space the angles, else the end effector along
    its axes.

    Attributes:
        x: what it shares of its pose, shape (m, ...).
        xd: its velocity, and of an orientation how it turns, shape (m, ...).
        e: error of the followed coordinates, shape (m, ...).
        ed: their velocity less that of the reference.
        v: reference velocity of the joints, shape (n, ...).
        a: its derivative.
        J: Jacobian of the followed axes, shape (m, n, ...); None in joint space, where it is
            one.
        A: J J' with its damping, shape (m, m, ...).
        least: lower bound of the square of the Jacobian's least singular value, undamped; inf
            in joint space.
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
        """Returns the torque of the joints that a force on the coordinates amounts to, shape
        (n, ...).
        """
        return force if self.J is None else multiply_columns(self.J.swapaxes(0, 1), force)

    def from_joints(self, torque: Numbers) -> Numbers:
        """Returns the force on the coordinates that a torque of the joints amounts to, shape
        (m, ...).
        """
        if self.J is None or self.A is None:
            return torque
        return solve_columns(self.A, multiply_columns(self.J, torque))


def follow_joints(
    Lambda: Numbers, q: Numbers, qd: Numbers, q_des: Numbers, qd_des: Numbers
) -> Following:
    """Returns how a site follows joint by joint, Eq. (9), (10)."""
    e = q - q_des
    ed = qd - qd_des
    return Following(x=q, xd=qd, e=e, ed=ed, v=-Lambda * e, a=-Lambda * ed)


def share_pose(task: TaskSetup, arm: PlacedChain) -> Numbers:
    """Returns what a site shares of its pose: place and rotation vector, or the place, shape
    (m, ...).
    """
    place = task.scale * arm.end_effector_position()
    if len(task.axes) == POSITION:
        return place
    return np.concatenate([place, vector_from_rotation(arm.end_effector_orientation())])


def follow_in_task(
    site: SiteSetup,
    arm: PlacedChain,
    Lambda: Numbers,
    q: Numbers,
    qd: Numbers,
    x_des: Numbers,
    xd_des: Numbers,
) -> Following:
    """Returns how a site follows with its end effector; in a singular pose A and what needs it
    are NaN.
    """
    assert site.chain is not None
    assert site.chain.task is not None
    task = site.chain.task
    m = site.layout.shared
    x = share_pose(task, arm)
    one = (1,) * (q.ndim - 1)
    axes = np.array(task.axes).reshape(m, *one)
    scales = np.array([task.scale] * POSITION + [1.0] * POSITION)[:m].reshape(m, 1, *one)
    whole, whole_rate = (
        scales * J[:m] for J in (arm.pose_jacobian(), arm.pose_jacobian_rate(qd))
    )
    xd = multiply_columns(whole, qd)
    e = x - x_des
    if m > POSITION:
        R, R_des = (rotation_from_vector(pose[POSITION:]) for pose in (x, x_des + 0.0 * x))
        e = np.concatenate([e[:POSITION], turn_from(R_des, R)])
    e = axes * e
    ed = axes * (xd - xd_des)
    J = axes[:, np.newaxis] * whole
    Jd = axes[:, np.newaxis] * whole_rate
    A, least = _damp(task, J)
    posture = np.array(task.posture or site.q0).reshape(-1, *one)
    psi = -task.posture_rate * (q - posture)
    psi_d = -task.posture_rate * qd
    v, a = find_task_reference(
        J=J,
        Jd=Jd,
        solve=partial(solve_columns, A),
        posture=(psi, psi_d),
        error=(Lambda * e, Lambda * ed),
    )
    return Following(x=x, xd=xd, e=e, ed=ed, v=v, a=a, J=J, A=A, least=least)


def _damp(task: TaskSetup, J: Numbers) -> tuple[Numbers, float]:
    """Returns J J', damped if the pose is nearly singular, and what decides it, 1 / trace((J
    J')^-1).
    """
    m = len(task.axes)
    one = (1,) * (J.ndim - 2)
    followed = [n for n, on in enumerate(task.axes) if on]
    free = np.diag(1.0 - np.array(task.axes)).reshape(m, m, *one)
    A = np.einsum("an...,bn...->ab...", J, J) + free
    inner = np.moveaxis(A[followed][:, followed], (0, 1), (-2, -1))
    sizes = np.linalg.svd(inner.real, compute_uv=False)
    if not sizes[..., -1].min() > SINGULAR:
        return A + np.nan, 0.0
    least = 1.0 / np.trace(np.linalg.inv(inner), axis1=-2, axis2=-1)
    limit = task.singular_value**2
    damping = np.where(least.real < limit, limit - least, 0.0)
    return A + damping * np.eye(m).reshape(m, m, *one), float(least.real.min())
