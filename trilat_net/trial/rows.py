"""Some records of one site as arrays: what tallies take in.

Law: rows are in the order of time; a part of them is a view, not a copy.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arm import Array

Ints = NDArray[np.int64]


class Rows(NamedTuple):
    """Some records of one site, one after the other.

    Attributes:
        t_ns: nominal time, shape (K,), ns.
        q: joint angles, shape (K, 2), rad.
        qd: joint velocities, shape (K, 2), rad/s.
        q_des: reference, Eq. (6), shape (K, 2), rad.
        tau: control torque, shape (K, 2), N m.
        tau_x: exogenous torque in the sign of Eq. (8), shape (K, 2), N m.
        used: tick of the sample in use, -1 before the first, shape (K, P).
    """

    t_ns: Ints
    q: Array
    qd: Array
    q_des: Array
    tau: Array
    tau_x: Array
    used: Ints

    def since(self, t_ns: int) -> "Rows":
        """Returns the records that are later than a time."""
        return self._part(slice(int(np.searchsorted(self.t_ns, t_ns, side="right")), None))

    def between(self, from_ns: int, to_ns: int) -> "Rows":
        """Returns the records from one time to another, which is no longer of them."""
        first, last = np.searchsorted(self.t_ns, (from_ns, to_ns)).tolist()
        return self._part(slice(first, last))

    def _part(self, part: slice) -> "Rows":
        return Rows(
            self.t_ns[part],
            self.q[part],
            self.qd[part],
            self.q_des[part],
            self.tau[part],
            self.tau_x[part],
            self.used[part],
        )


def joined(blocks: Sequence[Rows]) -> Rows:
    """Returns blocks that follow each other as one."""
    return Rows(
        np.concatenate([rows.t_ns for rows in blocks]),
        np.concatenate([rows.q for rows in blocks]),
        np.concatenate([rows.qd for rows in blocks]),
        np.concatenate([rows.q_des for rows in blocks]),
        np.concatenate([rows.tau for rows in blocks]),
        np.concatenate([rows.tau_x for rows in blocks]),
        np.concatenate([rows.used for rows in blocks]),
    )
