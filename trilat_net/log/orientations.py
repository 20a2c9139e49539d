"""Orientations as time series without jumps: unit quaternions, or six numbers.

A record stores an orientation as a rotation vector, axis times angle, at most half a turn long.
When the angle passes half a turn, as for a tool that points down, the vector jumps by a whole
turn, although the orientation does not jump. Near half a turn the vector moves up to pi / 2
times as far as the orientation. No choice of branches is continuous for every motion of several
turns. Time series that leave the program therefore have one of these forms:

- Unit quaternions w, x, y, z. Each quaternion is nearest to the quaternion before, and the
  first has w >= 0. A turn by a small angle moves the quaternion by half of that angle.
- Six numbers: the first and the second column of the rotation matrix. They depend on the
  orientation alone and not on the past, as observations and actions of a policy must (Y. Zhou
  et al., "On the continuity of rotation representations in neural networks", CVPR 2019). A turn
  by a small angle moves them by at most sqrt(2) times that angle.

Invariant:
    - The rotation is that of the record, to rounding. Only its representation differs.
    - Rotation vectors of any length are accepted.
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
    """Returns unit quaternions of rotation vectors, as scalar and vector parts.

    The quaternion of a rotation vector r with the angle a = |r| is

        w = cos(a / 2),  (x, y, z) = r sin(a / 2) / a

    Args:
        turns: rotation vectors, shape (K, 3), rad.

    Returns:
        w, shape (K, 1), and (x, y, z), shape (K, 3).
    """
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    w = np.cos(0.5 * angle)
    # sin(a / 2) / a, also for a = 0: sinc(x) = sin(pi x) / (pi x)
    sine_by_angle = 0.5 * np.sinc(angle / (2.0 * np.pi))
    return w, sine_by_angle * turns


def compute_quaternions(turns: Array) -> Array:
    """Returns unit quaternions w, x, y, z of consistent sign, shape (K, 4).

    Args:
        turns: rotation vectors, shape (K, 3), rad.
    """
    w, v = compute_quaternion_parts(turns)
    return align_signs(np.hstack([w, v]))


def align_signs(quaternions: Array) -> Array:
    """Returns quaternions with signs such that each is nearest to the quaternion before.

    Args:
        quaternions: the quaternions, shape (K, 4), in order of time.
    """
    dots = np.einsum("ki,ki->k", quaternions[1:], quaternions[:-1])
    changes = np.where(dots < 0.0, -1.0, 1.0)
    signs = np.cumprod(changes)
    aligned = quaternions.copy()
    aligned[1:] *= signs[:, np.newaxis]
    return aligned


def compute_matrix_columns(turns: Array) -> Array:
    """Returns the first two columns of the rotation matrices of rotation vectors.

    Args:
        turns: rotation vectors, shape (..., 3), rad.

    Returns:
        The entries `MATRIX_ENTRIES`, shape (..., 6).
    """
    rows = np.reshape(turns, (-1, 3))
    w, v = compute_quaternion_parts(rows)
    # twice the products of the components of the quaternion
    double = 2.0 * v
    wx, wy, wz = (w * double).T
    xx, yy, zz = (v * double).T
    double_x, double_y, _ = double.T
    _, y, z = v.T
    xy = double_x * y
    xz = double_x * z
    yz = double_y * z
    first_column = [1.0 - yy - zz, xy + wz, xz - wy]
    second_column = [xy - wz, 1.0 - xx - zz, yz + wx]
    columns = np.stack([*first_column, *second_column], axis=1)
    shape = np.shape(turns)[:-1]
    return columns.reshape(*shape, len(MATRIX_ENTRIES))


def expand_poses(x: Array) -> Array:
    """Returns poses with six numbers in place of their rotation vectors.

    An environment observes poses in this form, and a user's hand gets the same numbers from
    `HandView`:

    >>> import numpy as np
    >>> quarter_turn = np.array([0.5, 0.0, 0.2, 0.0, 0.0, np.pi / 2])
    >>> np.rint(10.0 * tn.expand_poses(quarter_turn)).astype(int).tolist()
    [5, 0, 2, 0, 10, 0, -10, 0, 0]

    Args:
        x: positions, shape (..., 3), m; or poses, which are positions and rotation vectors,
            shape (..., 6), m and rad.

    Returns:
        Positions and the first two columns of the rotation matrices, shape (..., 9). Positions
        without rotation vectors are returned as they are.
    """
    if x.shape[-1] != POSE:
        return x
    positions = x[..., :POSITION]
    orientations = compute_matrix_columns(x[..., POSITION:])
    return np.concatenate([positions, orientations], axis=-1)


def choose_nearest_vectors(turns: Array, references: Array) -> Array:
    """Returns the rotation vectors of the same rotations that are nearest to references.

    The vectors differ from `turns` by whole turns about the same axis, and may be longer than
    half a turn.

    Args:
        turns: rotation vectors, shape (K, 3), rad.
        references: the references, shape (K, 3), rad.
    """
    angle = np.linalg.norm(turns, axis=1, keepdims=True)
    axis = np.divide(turns, angle, out=np.zeros_like(turns), where=angle > 0.0)
    projection = np.einsum("ki,ki->k", axis, references)[:, np.newaxis]
    turn_counts = np.round((projection - angle) / (2.0 * np.pi))
    whole_turns = 2.0 * np.pi * turn_counts * axis
    return np.asarray(turns + whole_turns)


def compute_continuous_vectors(turns: Array) -> Array:
    """Returns rotation vectors of the same rotations without jumps at half a turn.

    The vectors may be up to a whole turn long, and jump at a whole turn.

    Args:
        turns: rotation vectors, shape (K, 3), rad, in order of time.
    """
    quaternions = compute_quaternions(turns)
    w = quaternions[:, :1]
    v = quaternions[:, 1:]
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, w)
    # the limit of angle / sine for small angles is 2
    limit = np.full_like(w, 2.0)
    angle_by_sine = np.divide(angle, sine, out=limit, where=sine > 0.0)
    return np.asarray(angle_by_sine * v)


class QuaternionSigns:
    """Choice of the signs of the quaternions of a stream.

    Each quaternion is nearest to the quaternion before, and the first has w >= 0.

    Args:
        w: index of w among the four numbers of a quaternion.
    """

    def __init__(self, w: int = 3) -> None:
        self._w = w
        self._last: tuple[float, ...] = ()

    def align(self, quaternion: Sequence[float]) -> tuple[float, ...]:
        """Returns the next quaternion or its negative, which is the same rotation."""
        dot = quaternion[self._w]
        if self._last:
            dot = sum(a * b for a, b in zip(quaternion, self._last, strict=True))
        if dot < 0.0:
            self._last = tuple(-number for number in quaternion)
        else:
            self._last = tuple(quaternion)
        return self._last
