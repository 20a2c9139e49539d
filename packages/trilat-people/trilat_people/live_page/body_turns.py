"""Keeps the orientations of moving bodies continuous, so plots of them do not jump.

A unit quaternion and its negative describe the same orientation. If the sign changes from one
time to the next, a plot of the quaternion jumps although the body moves smoothly, and
interpolating between the two gives wrong results. `BodyTurns` chooses consistent signs for the
bodies of a plant, whose poses are published many times per second.
"""

from collections.abc import Sequence

import numpy as np

from trilat_net.core import POSITION, Array
from trilat_net.log import QuaternionSigns


class BodyTurns:
    """Chooses the signs of the quaternions of a plant's bodies in a stream of frames.

    Of the two quaternions that describe an orientation, the one closer to the quaternion in the
    previous frame is chosen, so a plot or an interpolation has no jump.
    """

    def __init__(self) -> None:
        self._signs: dict[int, QuaternionSigns] = {}

    def align(self, bodies: Sequence[float]) -> Array:
        """Returns the poses of all bodies with quaternion signs that match the previous call.

        Args:
            bodies: Seven values for each of the b bodies: position x, y, z in m, and unit
                quaternion w, x, y, z.

        Returns:
            The same values, with the signs of some quaternions flipped, shape (7 b,).
        """
        pose_length = POSITION + 4  # a quaternion has four numbers
        numbers = np.array(bodies, dtype=np.float64)
        poses = numbers.reshape(-1, pose_length)
        for body, pose in enumerate(poses):
            if body not in self._signs:
                self._signs[body] = QuaternionSigns(w=0)
            signs = self._signs[body]
            quaternion = pose[POSITION:]
            quaternion[:] = signs.align(quaternion.tolist())
        return poses.ravel()
