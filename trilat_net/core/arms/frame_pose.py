"""Combines the poses of coordinate frames, and expresses inertias in other frames.

The functions are plain Python, because arm files are read before any code is compiled.

Invariant:
    - Sums are evaluated in a fixed order, which makes the results identical on every machine.
"""

from typing import NamedTuple

from .chain import Matrix, Three, multiply_matrices, multiply_vector
from .elementary import sincos
from .rotation import rotation_matrix

_plain_sincos = getattr(sincos, "py_func", sincos)
"""Uncompiled version of `sincos`, because compiling takes longer than reading an arm file."""


class FramePose(NamedTuple):
    """Position and orientation of a coordinate frame, expressed in another frame.

    Attributes:
        rotation: Rotation matrix, three rows.
        origin_m: Origin of the frame, in m.
    """

    rotation: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    origin_m: Three = (0.0, 0.0, 0.0)

    @classmethod
    def from_angles(cls, rpy_rad: Three, origin_m: Three) -> "FramePose":
        """Returns the pose with the rotation R_z(yaw) R_y(pitch) R_x(roll).

        Args:
            rpy_rad: Roll, pitch and yaw angles, rad.
            origin_m: Origin of the frame, m.
        """
        # s and c are sines and cosines.
        (sr, cr), (sp, cp), (sy, cy) = map(_plain_sincos, rpy_rad)
        rotation = (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
        return cls(rotation, origin_m)

    @classmethod
    def from_rotation_vector(cls, vector_rad: Three) -> "FramePose":
        """Returns the pose with the rotation given by a rotation vector, and no translation.

        Args:
            vector_rad: Axis of the rotation times its angle, rad.
        """
        return cls(rotation_matrix(vector_rad))

    def __matmul__(self, inner: "FramePose") -> "FramePose":
        """Returns the composition of two poses.

        `inner` is expressed in the frame of this pose. The result is the pose of the inner
        frame, expressed in the outer frame of this pose.
        """
        x, y, z = self.turn(inner.origin_m)
        ox, oy, oz = self.origin_m
        rotation = multiply_matrices(self.rotation, inner.rotation)
        return FramePose(rotation, (ox + x, oy + y, oz + z))

    def turn(self, vector: Three) -> Three:
        """Transforms a vector from the axes of this frame to the axes of the outer frame.

        Args:
            vector: The vector, expressed in this frame.
        """
        return multiply_vector(self.rotation, vector)

    def place_body(self, mass: float, tensor: Matrix) -> tuple[float, ...]:
        """Returns the inertial parameters of a body, expressed in the outer frame of this pose.

        The tensor I about the centre of mass is rotated, R I R^T, and moved to the origin of
        the outer frame with the parallel axis theorem.

        Args:
            mass: Mass, in kg.
            tensor: Inertia about the centre of mass, in kg m^2, in the axes of this pose. The
                origin of this pose is the centre of mass.

        Returns:
            The ten parameters m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
        """
        # Rows of the rotation R, and the centre of mass in the other frame.
        (r0, r1, r2), (x, y, z) = self
        # Columns of I R^T. The entries of R I R^T follow row by row.
        columns = (
            multiply_vector(tensor, r0),
            multiply_vector(tensor, r1),
            multiply_vector(tensor, r2),
        )
        (xx, xy, xz) = multiply_vector(columns, r0)
        (_, yy, yz) = multiply_vector(columns, r1)
        (_, _, zz) = multiply_vector(columns, r2)
        return (
            mass,
            mass * x,
            mass * y,
            mass * z,
            xx + mass * (y * y + z * z),
            xy - mass * x * y,
            yy + mass * (x * x + z * z),
            xz - mass * x * z,
            yz - mass * y * z,
            zz + mass * (x * x + y * y),
        )
