"""Following in task space in plain NumPy: rotations, what a site follows, and its reference velocity.

Invariant: independent of the compiled core, and analytic in every argument but where a branch is chosen (by
the real part), so that a complex step gives derivatives exact to rounding. Vectors have their components on
the first axis and any number of columns behind it, as in `textbook_arm`.

With J the Jacobian of the followed axes and A = J J' + 1 of each axis that is not followed + damping,

    v = psi + J' y,               A y  = -Lambda e - J psi
    a = psi' + Jd' y + J' y',     A y' = -Lambda ed - Jd v - J (psi' + Jd' y)

with psi = -k (q - posture); a force F at the end effector is the torque J' F, and a torque tau there is the
force A^-1 J tau. Sources stand in `core.task_space` and docs/laws.md.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..analysis.arm_rows import Numbers, multiply_columns, solve_columns
from ..core.site_setup import SiteSetup, TaskSetup
from ..core.vectors import Array
from .textbook_arm import PlacedChain, build_cross_matrix

PLACE_COORDINATES = 3
"""Coordinates of a task that are a place; those behind it are a rotation vector."""
SINGULAR = 1e-9
"""A pose whose lower bound of the Jacobian's least squared singular value is below this is singular."""
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
    squared = np.einsum("ab...,bc...->ac...", across, across)
    eye = np.eye(3).reshape(3, 3, *(1,) * (vector.ndim - 1))
    turned: Numbers = eye + by_sine * across + by_cosine * squared
    return turned


def vector_from_rotation(R: Numbers) -> Numbers:
    """Returns the rotation vector of a rotation matrix, shape (3, ...), at most half a turn long.

    By the quaternion, from its largest part (Shepperd, 1978).
    """
    xx, yy, zz = R[0, 0], R[1, 1], R[2, 2]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    forms = np.array(
        [
            [1.0 + xx + yy + zz, x, y, z],
            [x, 1.0 + xx - yy - zz, xy, xz],
            [y, xy, 1.0 - xx + yy - zz, yz],
            [z, xz, yz, 1.0 - xx - yy + zz],
        ]
    )
    sizes = np.array([forms[n, n].real for n in range(4)])
    quaternion = np.take_along_axis(forms, sizes.argmax(axis=0)[np.newaxis, np.newaxis], axis=0)[0]
    quaternion = quaternion / np.sqrt(np.sum(quaternion * quaternion, axis=0))
    quaternion = np.where(quaternion[0].real < 0.0, -quaternion, quaternion)
    w, v = quaternion[0], quaternion[1:]
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
    """Returns the pose that a site follows, as it shares its own: of places the mean by shares, Eq. (6).

    Of orientations it is the own one less the sum of alpha_ij Log(R_i R_j').

    Args:
        shares: row of the dominance matrix, shape (N,).
        own: what the site shares of its own pose, shape (m, ...).
        shared: of each site what it shares.
    """
    followed = [(share, pose) for share, pose in zip(shares.tolist(), shared, strict=True) if share]
    places = sum(share * pose[:PLACE_COORDINATES] for share, pose in followed)
    if len(own) == PLACE_COORDINATES:
        return np.asarray(places)
    R = rotation_from_vector(own[PLACE_COORDINATES:])
    apart = sum(
        share * turn_from(rotation_from_vector(pose[PLACE_COORDINATES:]), R) for share, pose in followed
    )
    reference = np.einsum("ab...,bc...->ac...", rotation_from_vector(-np.asarray(apart)), R)
    return np.concatenate(
        [np.asarray(places) + 0.0 * own[:PLACE_COORDINATES], vector_from_rotation(reference)]
    )


class Following(NamedTuple):
    """How a site follows, in a state: of joint space the angles, else the end effector along its axes.

    Attributes:
        x: what it shares of its pose, shape (m, ...).
        xd: its velocity, and of an orientation how it turns, shape (m, ...).
        e: error of the followed coordinates, shape (m, ...).
        ed: their velocity less that of the reference.
        v: reference velocity of the joints, shape (n, ...).
        a: its derivative.
        J: Jacobian of the followed axes, shape (m, n, ...); None in joint space, where it is one.
        A: J J' with its damping, shape (m, m, ...).
        least: lower bound of the square of the Jacobian's least singular value, undamped; inf in joint space.
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
        """Returns the torque of the joints that a force on the coordinates amounts to, shape (n, ...)."""
        return force if self.J is None else multiply_columns(self.J.swapaxes(0, 1), force)

    def from_joints(self, torque: Numbers) -> Numbers:
        """Returns the force on the coordinates that a torque of the joints amounts to, shape (m, ...)."""
        if self.J is None or self.A is None:
            return torque
        return solve_columns(self.A, multiply_columns(self.J, torque))


def follow_joints(Lambda: Numbers, q: Numbers, qd: Numbers, q_des: Numbers, qd_des: Numbers) -> Following:
    """Returns how a site follows joint by joint, Eq. (9), (10)."""
    e, ed = q - q_des, qd - qd_des
    return Following(q, qd, e, ed, -Lambda * e, -Lambda * ed)


def share_pose(task: TaskSetup, arm: PlacedChain) -> Numbers:
    """Returns what a site shares of its pose: place and rotation vector, or the place, shape (m, ...)."""
    place = task.scale * arm.end_effector_position()
    if len(task.axes) == PLACE_COORDINATES:
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
    """Returns how a site follows with its end effector; in a singular pose A and what needs it are NaN."""
    assert site.chain is not None
    assert site.chain.task is not None
    task, m = site.chain.task, site.layout.shared
    x, one = share_pose(task, arm), (1,) * (q.ndim - 1)
    axes = np.array(task.axes).reshape(m, *one)
    scales = np.array([task.scale] * PLACE_COORDINATES + [1.0] * PLACE_COORDINATES)[:m].reshape(m, 1, *one)
    whole, whole_rate = (scales * J[:m] for J in (arm.pose_jacobian(), arm.pose_jacobian_rate(qd)))
    xd, e = multiply_columns(whole, qd), x - x_des
    if m > PLACE_COORDINATES:
        R, R_des = (rotation_from_vector(pose[PLACE_COORDINATES:]) for pose in (x, x_des + 0.0 * x))
        e = np.concatenate([e[:PLACE_COORDINATES], turn_from(R_des, R)])
    e, ed = axes * e, axes * (xd - xd_des)
    J, Jd = axes[:, np.newaxis] * whole, axes[:, np.newaxis] * whole_rate
    A, least = _damp(task, J)
    posture = np.array(task.posture or site.q0).reshape(-1, *one)
    psi, psi_d = -task.posture_rate * (q - posture), -task.posture_rate * qd
    y = solve_columns(A, -Lambda * e - multiply_columns(J, psi))
    v = psi + multiply_columns(J.swapaxes(0, 1), y)
    psi_d = psi_d + multiply_columns(Jd.swapaxes(0, 1), y)
    y_d = solve_columns(A, -Lambda * ed - multiply_columns(Jd, v) - multiply_columns(J, psi_d))
    a = psi_d + multiply_columns(J.swapaxes(0, 1), y_d)
    return Following(x, xd, e, ed, v, a, J, A, least)


def _damp(task: TaskSetup, J: Numbers) -> tuple[Numbers, float]:
    """Returns J J', damped if the pose is nearly singular, and what decides it, 1 / trace((J J')^-1)."""
    m, one = len(task.axes), (1,) * (J.ndim - 2)
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
