"""Edges of a measured map: where, up a column, stable places end.

Law: an edge lies between two places that were decided, one stable and one not; what is undecided between them
widens it. Of several runs of a place the majority decides, and a draw decides nothing.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from .plane import Panel, Plane


class Edge(NamedTuple):
    """A change between stable and not, up a column.

    Attributes:
        x: the column's value.
        low: the last value of the y axis below the change.
        high: the first one above it.
        stable_below: whether the places below are the stable ones.
    """

    x: float
    low: float
    high: float
    stable_below: bool

    @property
    def middle(self) -> float:
        """The value half way."""
        return 0.5 * (self.low + self.high)


def edges(plane: Plane, panel: Panel) -> list[Edge]:
    """Returns the edges of a panel, column by column, each from below."""
    found = []
    for x, share in zip(plane.x.values, panel.share.T, strict=True):
        found += [
            Edge(x, plane.y.values[a], plane.y.values[b], bool(share[a] > 0.5)) for a, b in _changes(share)
        ]
    return found


def _changes(share: Array) -> list[tuple[int, int]]:
    """Returns the places below and above every change of a column's majority."""
    decided = np.flatnonzero(np.isfinite(share) & (share != 0.5))
    stable = share[decided] > 0.5
    return [(int(decided[n]), int(decided[n + 1])) for n in np.flatnonzero(stable[1:] != stable[:-1])]
