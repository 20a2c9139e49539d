"""Orientations of a plant's bodies in a stream of frames."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from ..core.task_space import POSITION
from ..core.vectors import Array
from ..log.orientations import QUATERNION_AXES, QuaternionSigns


class BodyTurns:
    """Poses of a plant's bodies in one stream: of both signs of a quaternion the nearer to the
    one before.
    """

    def __init__(self) -> None:
        self._signs: defaultdict[int, QuaternionSigns] = defaultdict(
            lambda: QuaternionSigns(w=0)
        )

    def align(self, bodies: Sequence[float]) -> Array:
        """Returns poses, shape (7 b,), as given: x, y, z, m, and the unit quaternion w, x, y, z
        of each.
        """
        poses = np.array(bodies, dtype=np.float64).reshape(-1, POSITION + len(QUATERNION_AXES))
        for body, pose in enumerate(poses):
            pose[POSITION:] = self._signs[body].align(pose[POSITION:].tolist())
        return poses.ravel()
