"""Converts orientations to time series without jumps: unit quaternions, or six numbers.

A log stores an orientation as a rotation vector, the axis of a rotation times its angle, which
is at most half a turn. When the angle passes half a turn, as it does for a tool that points
down, the vector jumps by a whole turn, although the orientation changes smoothly. Adding whole
turns to the vector does not avoid these jumps for every motion. Time series that leave the
program therefore use one of these formats:

- Unit quaternions w, x, y, z. A quaternion and its negative represent the same orientation. The
  signs are chosen such that the first quaternion has w >= 0 and each quaternion is as close as
  possible to the previous one. A rotation by a small angle moves the quaternion by half of that
  angle.
- Six numbers: the first and second columns of the rotation matrix. They depend only on the
  current orientation and not on the past, as required for observations and actions of a learned
  policy (Y. Zhou et al., "On the continuity of rotation representations in neural networks",
  CVPR 2019). A rotation by a small angle moves them by at most sqrt(2) times that angle.

Invariant:
    - The rotation is that of the log, up to rounding. Only its representation differs.
    - Rotation vectors of any length are accepted.
"""

from collections.abc import Sequence

import numpy as np

from ..core import POSE, POSITION, Array

QUATERNION_AXES = ("qw", "qx", "qy", "qz")
"""Names of the four components of a quaternion in tables."""
MATRIX_ENTRIES = ("r11", "r21", "r31", "r12", "r22", "r32")
"""Names of the six numbers of an orientation, with row and column of the rotation matrix."""


def align_signs(quaternions: Array) -> Array:
    """Chooses the signs of a time series of unit quaternions so that it does not jump.

    A quaternion and its negative represent the same orientation. Each quaternion is given the
    sign that brings it closest to the previous one. The sign of the first quaternion is kept.

    Args:
        quaternions: The quaternions in chronological order, shape (K, 4).

    Returns:
        The quaternions or their negatives, shape (K, 4).
    """
    dots = np.einsum("ki,ki->k", quaternions[1:], quaternions[:-1])
    changes = np.where(dots < 0.0, -1.0, 1.0)
    # A change of sign applies to all later quaternions as well.
    signs = np.cumprod(changes)
    aligned = quaternions.copy()
    aligned[1:] *= signs[:, np.newaxis]
    return aligned


class RotationVectors:
    """Orientations as rotation vectors, with conversions to other representations.

    A rotation vector is the axis of a rotation times its angle. Adding whole turns does not
    change the rotation.

    Args:
        turns: K rotation vectors, shape (K, 3), in rad. For `as_matrix_columns`, any shape
            (..., 3) is allowed.
    """

    def __init__(self, turns: Array) -> None:
        self._turns = turns

    def _as_quaternion_parts(self) -> tuple[Array, Array]:
        """Computes the unit quaternions of the rotations, as scalar and vector parts.

        The quaternion of a rotation vector r with the angle a = |r| is

            w = cos(a / 2),  (x, y, z) = r sin(a / 2) / a

        Returns:
            The scalar parts w, shape (K, 1), and the vector parts (x, y, z), shape (K, 3).
        """
        angle = np.linalg.norm(self._turns, axis=1, keepdims=True)
        w = np.cos(0.5 * angle)
        # This is sin(a / 2) / a, even for a = 0, because sinc(x) = sin(pi x) / (pi x).
        sine_by_angle = 0.5 * np.sinc(angle / (2.0 * np.pi))
        return w, sine_by_angle * self._turns

    def as_quaternions(self) -> Array:
        """Computes the unit quaternions of the rotations as a time series without jumps.

        A quaternion and its negative represent the same rotation. Signs are chosen such that
        consecutive quaternions are close to each other, as needed for plotting and
        interpolation. The rotation vectors must be in chronological order.

        Returns:
            The quaternions w, x, y, z, shape (K, 4).
        """
        w, v = self._as_quaternion_parts()
        return align_signs(np.hstack([w, v]))

    def as_matrix_columns(self) -> Array:
        """Computes the first two columns of the rotation matrices.

        For a rotation with the unit quaternion (w, x, y, z), they are

            (1 - 2 y y - 2 z z,  2 x y + 2 w z,  2 x z - 2 w y)
            (2 x y - 2 w z,  1 - 2 x x - 2 z z,  2 y z + 2 w x)

        Returns:
            The entries `MATRIX_ENTRIES`, shape (..., 6) for rotation vectors of shape (..., 3).
        """
        rows = RotationVectors(np.reshape(self._turns, (-1, 3)))
        w, v = rows._as_quaternion_parts()
        # In the following, xy is twice the product of the components x and y, and so on.
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
        shape = np.shape(self._turns)[:-1]
        return columns.reshape(*shape, len(MATRIX_ENTRIES))

    def nearest_to(self, references: Array) -> Array:
        """Adds whole turns to each rotation vector to minimise its distance from a reference.

        The results may be longer than half a turn.

        Args:
            references: One reference per rotation vector, shape (K, 3), in rad.

        Returns:
            Rotation vectors of the same rotations, shape (K, 3), in rad.
        """
        turns = self._turns
        angle = np.linalg.norm(turns, axis=1, keepdims=True)
        axis = np.divide(turns, angle, out=np.zeros_like(turns), where=angle > 0.0)
        # All vectors of the same rotation are on a line along the axis. The nearest one to the
        # reference is nearest to the projection of the reference on this line.
        projection = np.einsum("ki,ki->k", axis, references)[:, np.newaxis]
        turn_counts = np.round((projection - angle) / (2.0 * np.pi))
        whole_turns = 2.0 * np.pi * turn_counts * axis
        return np.asarray(turns + whole_turns)

    def without_jumps(self) -> Array:
        """Unwraps the rotation vectors, so that they stay continuous at half a turn.

        The unwrapped vectors represent the same rotations. They can be up to a full turn long,
        and jump only at a full turn. The rotation vectors must be in chronological order.

        Returns:
            The unwrapped rotation vectors, shape (K, 3), in rad.
        """
        quaternions = self.as_quaternions()
        w = quaternions[:, :1]
        v = quaternions[:, 1:]
        return _to_rotation_vectors(w, v)

    def turns_from(self, references: Array) -> Array:
        """Computes the rotation vectors from reference orientations to these orientations.

        Let the orientation be the quaternion (a, u), with scalar part a and vector part u, and
        the reference (b, v). The rotation between them is the product of (a, u) and the
        conjugate (b, -v), the quaternion (w, p):

            w = a b + u . v
            p = b u - a v - u x v

        This is a rotation by the angle 2 atan2(|p|, w) about the axis p.

        Args:
            references: Reference orientations as rotation vectors, shape (K, 3), in rad.

        Returns:
            Rotation vectors of at most half a turn, shape (K, 3), in rad.
        """
        a, u = self._as_quaternion_parts()
        b, v = RotationVectors(references)._as_quaternion_parts()
        w = a * b + np.sum(u * v, axis=1, keepdims=True)
        p = b * u - a * v - np.cross(u, v)

        # (w, p) and (-w, -p) are the same rotation. The one with w >= 0 is the shorter turn.
        p *= np.where(w < 0.0, -1.0, 1.0)
        return _to_rotation_vectors(abs(w), p)


def _to_rotation_vectors(w: Array, v: Array) -> Array:
    """Converts unit quaternions to rotation vectors, in rad.

    The angle of the quaternion (w, v) is 2 atan2(|v|, w). Its axis is v.

    Args:
        w: Scalar parts, shape (K, 1).
        v: Vector parts, shape (K, 3).
    """
    sine = np.linalg.norm(v, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, w)
    # The limit of angle / sine for small angles is 2.
    limit = np.full_like(w, 2.0)
    angle_by_sine = np.divide(angle, sine, out=limit, where=sine > 0.0)
    return np.asarray(angle_by_sine * v)


def expand_poses(x: Array) -> Array:
    """Replaces the rotation vector of each pose by two columns of its rotation matrix.

    The observations of training environments contain poses in this format, and `HandView`
    passes the same numbers to a user's operator class:

    >>> import numpy as np
    >>> quarter_turn = np.array([0.5, 0.0, 0.2, 0.0, 0.0, np.pi / 2])
    >>> np.rint(10.0 * tn.expand_poses(quarter_turn)).astype(int).tolist()
    [5, 0, 2, 0, 10, 0, -10, 0, 0]

    Args:
        x: Positions, shape (..., 3), in m, or poses, which are positions and rotation vectors,
            shape (..., 6), in m and rad.

    Returns:
        The positions and the first two columns of the rotation matrices, shape (..., 9).
        Positions without rotation vectors are returned unchanged.
    """
    if x.shape[-1] != POSE:
        return x
    positions = x[..., :POSITION]
    orientations = RotationVectors(x[..., POSITION:]).as_matrix_columns()
    return np.concatenate([positions, orientations], axis=-1)


class QuaternionSigns:
    """Chooses the signs of unit quaternions that arrive one by one, to avoid jumps.

    A quaternion and its negative represent the same orientation. Each quaternion is given the
    sign that brings it closest to the previous one. The first one is given the sign for which w
    >= 0.

    Args:
        w: Index of the scalar part w in a quaternion. In ROS 2, the scalar part is last.
    """

    def __init__(self, w: int = 3) -> None:
        self._w = w
        self._last: tuple[float, ...] = ()

    def align(self, quaternion: Sequence[float]) -> tuple[float, ...]:
        """Chooses the sign of the next quaternion in a time series, to avoid a jump.

        The sign is the one that brings the quaternion closest to that of the previous call. In
        the first call, it is the sign for which w >= 0.

        Args:
            quaternion: The four components of the next unit quaternion, passed in chronological
                order.

        Returns:
            The quaternion or its negative, which represents the same orientation.
        """
        # Two unit quaternions are nearest to each other if their scalar product is positive.
        dot = quaternion[self._w]
        if self._last:
            dot = sum(a * b for a, b in zip(quaternion, self._last, strict=True))
        if dot < 0.0:
            self._last = tuple(-number for number in quaternion)
        else:
            self._last = tuple(quaternion)
        return self._last
