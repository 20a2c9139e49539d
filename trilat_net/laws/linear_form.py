"""The small motions of a control law that has states, or sends more than its peers' samples have.

Invariant: a law states them once, as blocks of a matrix; what it has in common with a law of known gravity
(`linear_gains`) is no part of them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..core.vectors import Array

Place = str | tuple[str, int]
"""A row or column of a form. Rows: "tau"; the rate of a state, by its name; ("to", j): what peer j is sent.
Columns: "q", "qd", "q_des", "qd_des", a state, ("from", j): what came from peer j, and "tau_h" ON the arm."""


class LinearSituation(NamedTuple):
    """What the small motions of a law may depend on.

    Attributes:
        site: the index of the site.
        names: of the sites.
        laws: the control of each site.
        alpha: dominance matrix in force, shape (N, N).
        inertia: M(q) of the site's arm, shape (n, n), kg m^2.
    """

    site: int
    names: tuple[str, ...]
    laws: tuple[Any, ...]
    alpha: Array
    inertia: Array

    @property
    def peers(self) -> list[int]:
        """Indices of the other sites."""
        return [j for j in range(len(self.names)) if j != self.site]


class LinearForm:
    """The small motions of a law at a site with n joints; every row and column stands for n numbers.

    Args:
        joints: n.
        states: names of its states.
        sends_acceleration: what it sends is the acceleration of its arm, and not what its rows say.

    Attributes:
        blocks: by row and column, shape (n, n).
    """

    def __init__(self, joints: int, states: Sequence[str] = (), *, sends_acceleration: bool = False) -> None:
        self.joints, self.states, self.sends_acceleration = joints, tuple(states), sends_acceleration
        self.blocks: dict[tuple[Place, Place], Array] = {}

    def add(self, row: Place, column: Place, gain: Any) -> None:
        """Adds a gain per joint, one of all, or a matrix, to a block."""
        block = np.asarray(gain, dtype=np.float64)
        if block.ndim < 2:
            block = np.diag(np.broadcast_to(block, self.joints))
        self.blocks[row, column] = self.blocks.get((row, column), 0.0) + block

    def list_receivers(self) -> list[int]:
        """Returns the peers to which it sends."""
        return sorted({int(row[1]) for row, _ in self.blocks if isinstance(row, tuple)})
