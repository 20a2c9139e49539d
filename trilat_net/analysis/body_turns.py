"""Aligns the orientations of a plant's bodies in a stream of frames."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from ..core.task_space import POSITION
from ..core.vectors import Array
from ..log.orientations import QUATERNION_AXES, QuaternionSigns


class BodyTurns:
    """Chooses the signs of the quaternions of a plant's bodies in one stream of frames.

    Of the two quaternions of an orientation, the one nearer to that of the frame before is
    chosen.
    """

    def __init__(self) -> None:
        self._signs: defaultdict[int, QuaternionSigns] = defaultdict(
            lambda: QuaternionSigns(w=0)
        )

    def align(self, bodies: Sequence[float]) -> Array:
        """Returns the poses of a frame with chosen signs, shape (7 b,).

        Args:
            bodies: pose of each body: position x, y, z in m, and unit quaternion w, x, y, z.
        """
        poses = np.array(bodies, dtype=np.float64).reshape(-1, POSITION + len(QUATERNION_AXES))
        for body, pose in enumerate(poses):
            pose[POSITION:] = self._signs[body].align(pose[POSITION:].tolist())
        return poses.ravel()
