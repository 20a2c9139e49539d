"""Chooses the runs of a sweep that locate the edge between stable and unstable parameters.

A map of 201 by 201 parameter values has 40 401 cells, most of which lie far from the edge. A
refined sweep first runs a coarse subset of this grid. It then repeatedly halves the boxes that
the edge crosses, until their corners are neighbouring cells.

Invariant:
    - The choice of cells depends only on the plan and on the results, not on the order of the
      runs or on interruptions.
    - A box is halved if two of its known points lie on different sides of the edge. An edge
      that enters and leaves a coarse box between two of its corners is missed.
    - A cell is chosen at most once.
"""

import itertools
import math
from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from .sweep_plan import SweepPlan

_Sides = NDArray[np.int8]

NOT_KNOWN = -1
"""Side of a cell that has not run, or that is not a valid scenario."""
UNSTABLE, STABLE, UNDECIDED = range(3)
"""Sides of the stability edge."""


class EdgeRefinement:
    """Chooses which cells of a sweep are simulated, refining the grid near edges of stability.

    The refinement proceeds in rounds. In each round, the caller simulates the cells returned by
    `find_next_cells` and passes the results to the next call, until no more cells are returned.

    Args:
        plan: The sweep. Its attribute `refine` is the number of times that the distance between
            grid points is halved near the edge.
    """

    def __init__(self, plan: SweepPlan) -> None:
        # The law is the first dimension of the grid.
        self._dimensions = [1 + n for n in plan.refined_axes]
        self._shape = plan.shape
        self._halvings = plan.refine
        self._level = 0
        self._sides: _Sides = np.full(plan.cells, NOT_KNOWN, np.int8)
        self._chosen = np.zeros(plan.cells, bool)

    def find_next_cells(self, sides: Mapping[int, int]) -> list[int]:
        """Stores the results of the last round and returns the cells to simulate next.

        Args:
            sides: Side of the edge on which each cell lies (see `choose_side`), for all cells
                that have run since the last call.

        Returns:
            Numbers of the cells, in ascending order. Empty if the refinement is complete.
        """
        for number, side in sides.items():
            self._sides[number] = side
        while self._level <= self._halvings:
            is_needed = np.zeros(self._shape, bool)
            for panel in self._iterate_panels():
                is_needed[panel] = self._mark_panel(panel)
            new_cells = np.flatnonzero(is_needed.reshape(-1) & ~self._chosen)
            if len(new_cells):
                self._chosen[new_cells] = True
                numbers: list[int] = new_cells.tolist()
                return numbers
            self._level += 1
        return []

    def list_coarse_cells(self) -> list[int]:
        """Returns the numbers of the cells in the coarse grid, which are simulated first."""
        is_needed = np.zeros(self._shape, bool)
        for panel in self._iterate_panels():
            is_needed[panel] = self._mark_lattice()
        numbers: list[int] = np.flatnonzero(is_needed).tolist()
        return numbers

    def count_most_cells(self) -> int:
        """Estimates the number of cells that a refined sweep will simulate.

        The estimate assumes that the edge of stability crosses each panel of the map once. It
        is used to tell the user how long the sweep will take.
        """
        panels = sum(1 for _ in self._iterate_panels())
        along_edge = 0
        for level in range(self._halvings):
            lines = [len(self._find_lines(dimension, level)) for dimension in self._dimensions]
            along_edge += 3 * sum(lines)
        cells = len(self.list_coarse_cells()) + panels * along_edge
        return min(math.prod(self._shape), cells)

    @staticmethod
    def choose_side(*, stable: int, decided: int) -> int:
        """Classifies a cell as stable, unstable or undecided by the majority of its runs.

        Args:
            stable: Number of stable runs of the cell.
            decided: Number of runs that were judged either stable or not stable.

        Returns:
            One of the constants `STABLE`, `UNSTABLE` and `UNDECIDED`.
        """
        if 2 * stable == decided:
            return UNDECIDED  # without a decided run, or without a majority
        return STABLE if 2 * stable > decided else UNSTABLE

    def _iterate_panels(self) -> Iterator[tuple[int | slice, ...]]:
        """Yields one grid index per panel, which selects all values of the refined axes.

        A panel is one setting of the control law and of the axes that are not refined.
        """
        indices: list[list[int | slice]] = []
        for dimension, count in enumerate(self._shape):
            is_refined = dimension in self._dimensions
            indices.append([slice(None)] if is_refined else list(range(count)))
        yield from itertools.product(*indices)

    def _find_lines(self, dimension: int, level: int) -> NDArray[np.int64]:
        """Returns the indices along one axis of the grid lines at a given level.

        Level 0 is the coarse grid. Each further level halves the distance between the lines.
        """
        last = self._shape[dimension] - 1
        stride = 1 << (self._halvings - level)
        return np.unique([*range(0, last, stride), last])

    def _mark_lattice(self) -> NDArray[np.bool_]:
        """Marks the corners of the coarse grid's boxes in an empty panel."""
        is_needed = np.zeros([self._shape[dimension] for dimension in self._dimensions], bool)
        lines = [self._find_lines(dimension, 0) for dimension in self._dimensions]
        is_needed[np.ix_(*lines)] = True
        return is_needed

    def _mark_panel(self, panel: tuple[int | slice, ...]) -> NDArray[np.bool_]:
        """Marks the cells of a panel that must be simulated in this round.

        These cells halve the boxes that the edge of stability crosses.

        Args:
            panel: Index of the panel.
        """
        if self._level == 0:
            return self._mark_lattice()
        sides = self._sides.reshape(self._shape)[panel]
        is_chosen = self._chosen.reshape(self._shape)[panel]
        is_needed = np.zeros(sides.shape, bool)
        coarse_lines = [self._find_lines(n, self._level - 1) for n in self._dimensions]
        fine_lines = [self._find_lines(n, self._level) for n in self._dimensions]

        # boxes of the previous level whose corners have all run
        has_corners = is_chosen[np.ix_(*coarse_lines)]
        for axis in range(len(coarse_lines)):
            # A box needs both of its corners along each axis.
            has_corners = np.delete(has_corners, -1, axis) & np.delete(has_corners, 0, axis)
        for box in np.argwhere(has_corners):
            lines_in_box = []
            for index, corners, lines in zip(box, coarse_lines, fine_lines, strict=True):
                low, high = corners[index : index + 2]
                lines_in_box.append(lines[(lines >= low) & (lines <= high)])
            points = np.ix_(*lines_in_box)
            # The edge crosses the box if its known points lie on different sides. A point
            # between two corners may be known from the neighbouring box.
            known = sides[points]
            known = known[known != NOT_KNOWN]
            if len(known) and (known != known[0]).any():
                is_needed[points] = True
        return is_needed
