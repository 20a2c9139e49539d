"""Orientations as time series without jumps: unit quaternions of consistent sign, or six
numbers.

A record has an orientation as a rotation vector, axis times angle, at most half a turn long.
That vector jumps by a whole turn where the angle passes half a turn, as for a tool that points
down, although nothing jumps. Near half a turn its steps are up to pi / 2 times those of the
motion, and no choice of branches is continuous for every motion of several turns. Series that
leave the program are therefore made of one of these:

- unit quaternions w, x, y, z. Each is nearest to the one before; the first has w >= 0. A turn
  by a small angle moves the quaternion by half of that angle.
- six numbers, the first and the second column of the rotation matrix. They depend on the
  orientation alone and not on the past, as observations and actions of a policy must (Y. Zhou
  et al., "On the continuity of rotation representations in neural networks", CVPR 2019). A turn
  by a small angle moves them by at most sqrt(2) times that angle.

Invariant:
- The rotation is that of the record, to rounding; only its numbers differ.
- Rotation vectors of any length are taken.
"""

from collections.abc import Sequence

import numpy as np

from ..core.task_space import POSE, POSITION
from ..core.vectors import Array
from ..scenario.arms import TASK_AXES

QUATERNION_AXES = ("qw", "qx", "qy", "qz")
"""Names of the four numbers of an orientation in a table."""
MATRIX_ENTRIES = ("r11", "r21", "r31", "r12", "r22", "r32")
"""Names of the six numbers of an orientation: row and column of the rotation matrix."""
SIX_AXES = (*TASK_AXES[:POSITION], *MATRIX_ENTRIES)
"""Names of the numbers of a pose with six numbers for its orientation."""


def compute_quaternion_parts(turns: Array) -> tuple[Array, Array]:
    """Returns w, shape (K, 1), and x, y, z, shape (K, 3), of rotation vectors, shape (K, 3),
    rad.
    """
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    return np.cos(0.5 * angle), 0.5 * np.sinc(angle / (2.0 * np.pi)) * turns


def compute_quaternions(turns: Array) -> Array:
    """Returns unit quaternions w, x, y, z of consistent sign, shape (K, 4), of rotation
    vectors, rad.
    """
    return align_signs(np.hstack(compute_quaternion_parts(turns)))


def align_signs(quaternions: Array) -> Array:
    """Returns quaternions, shape (K, 4), with signs such that each is nearest to the one
    before.
    """
    dots = np.einsum("ki,ki->k", quaternions[1:], quaternions[:-1])
    signs = np.cumprod(np.where(dots < 0.0, -1.0, 1.0))
    aligned = quaternions.copy()
    aligned[1:] *= signs[:, np.newaxis]
    return aligned


def compute_matrix_columns(turns: Array) -> Array:
    """Returns the first two columns of the matrices of rotation vectors, shape (..., 6), of
    (..., 3), rad.
    """
    rows = np.reshape(turns, (-1, 3))
    w, v = compute_quaternion_parts(rows)
    two = 2.0 * v
    wx, wy, wz = (w * two).T
    xx, yy, zz = (v * two).T
    xy = 2.0 * v[:, 0] * v[:, 1]
    xz = 2.0 * v[:, 0] * v[:, 2]
    yz = 2.0 * v[:, 1] * v[:, 2]
    columns = np.stack(
        [1.0 - yy - zz, xy + wz, xz - wy, xy - wz, 1.0 - xx - zz, yz + wx], axis=1
    )
    return columns.reshape(*np.shape(turns)[:-1], len(MATRIX_ENTRIES))


def expand_poses(x: Array) -> Array:
    """Returns poses with six numbers in place of their rotation vectors.

    An environment observes poses so, and a hand of one's own gets the same numbers from
    `HandView`:

    >>> import numpy as np
    >>> quarter_turn = np.array([0.5, 0.0, 0.2, 0.0, 0.0, np.pi / 2])
    >>> np.rint(10.0 * tn.expand_poses(quarter_turn)).astype(int).tolist()
    [5, 0, 2, 0, 10, 0, -10, 0, 0]

    Args:
        x: what sites share in task space: places, shape (..., 3), m, or places and rotation
            vectors, shape (..., 6), m and rad.

    Returns:
        Places and the first two columns of the rotation matrices, shape (..., 9); places alone
        as they are.
    """
    if x.shape[-1] != POSE:
        return x
    return np.concatenate(
        [x[..., :POSITION], compute_matrix_columns(x[..., POSITION:])], axis=-1
    )


def choose_nearest_vectors(turns: Array, references: Array) -> Array:
    """Returns rotation vectors of the same rotations that are nearest to other ones, shape (K,
    3), rad.

    They may be longer than half a turn.
    """
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    axis = np.divide(turns, angle, out=np.zeros_like(turns), where=angle > 0.0)
    along = np.einsum("ki,ki->k", axis, references)[:, np.newaxis]
    return np.asarray(turns + 2.0 * np.pi * np.round((along - angle) / (2.0 * np.pi)) * axis)


def compute_continuous_vectors(turns: Array) -> Array:
    """Returns rotation vectors, shape (K, 3), rad, without jumps at half a turn; whole turns
    have them.
    """
    quaternions = compute_quaternions(turns)
    w = quaternions[:, :1]
    v = quaternions[:, 1:]
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    by_sine = np.divide(
        2.0 * np.arctan2(sine, w), sine, out=np.full_like(w, 2.0), where=sine > 0.0
    )
    return np.asarray(by_sine * v)


class QuaternionSigns:
    """Sign of the quaternions of one stream: each is nearest to the one before; the first has w
    >= 0.

    The order of the four numbers is free; `w` says where w stands.
    """

    def __init__(self, w: int = 3) -> None:
        self._w = w
        self._last: tuple[float, ...] = ()

    def align(self, quaternion: Sequence[float]) -> tuple[float, ...]:
        """Returns a quaternion or its negative, which is the same rotation."""
        last = self._last
        dot = quaternion[self._w]
        if last:
            dot = sum(a * b for a, b in zip(quaternion, last, strict=True))
        self._last = tuple(-one for one in quaternion) if dot < 0.0 else tuple(quaternion)
        return self._last
