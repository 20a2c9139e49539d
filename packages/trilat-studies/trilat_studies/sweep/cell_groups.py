"""Orders the runs of a sweep so that many of them can be simulated side by side.

Cells that differ only in numerical parameters, such as a gain or a delay, are computed together
with vector instructions. Other parameters change the structure of the scenario: the control
law, the joints of an arm, the sites or their tick rates. This module divides the cells of a
sweep into groups with the same structure, which are run one after the other.

Invariant:
    - Every cell of the grid belongs to exactly one group.
    - Grouping changes the order of the runs, but not the results.
"""

from collections.abc import Hashable, Iterator, Sequence
from itertools import product
from math import prod
from typing import NamedTuple

from trilat_net.errors import ScenarioError, count_nouns
from trilat_net.execution import FusedRun

from . import sweep_cell
from .sweep_plan import SweepPlan

LAW_KEY = "law"
"""Name of the grid dimension that holds the control laws."""


class CellGroups(NamedTuple):
    """Divides the grid of a sweep into groups of cells that can be simulated side by side.

    All cells in a group have the same structure: control laws, joints, sites and tick rates.
    For example, a sweep over two control laws and 50 delays has two groups of 50 cells.

    Attributes:
        keys: Keys of the axes that change the structure.
        parts: For each dimension of the grid, its indices, partitioned by structure. The law is
            the first dimension.
    """

    keys: tuple[str, ...]
    parts: tuple[tuple[Sequence[int], ...], ...]

    @classmethod
    def of_plan(cls, plan: SweepPlan) -> "CellGroups":
        """Groups the cells of a sweep by the structure of their scenarios.

        Each axis is examined with all other axes at their first values. To limit the cost for
        large grids, scenarios are loaded for at most 32 values per axis. If their structures
        differ and the axis has further values, every value of that axis becomes a group of its
        own.

        Args:
            plan: The sweep.
        """
        names = (LAW_KEY, *(axis.key for axis in plan.axes))
        keys = []
        parts: list[tuple[Sequence[int], ...]] = []
        for dimension, (name, count) in enumerate(zip(names, plan.shape, strict=True)):
            checked = plan.list_checked_indices(dimension)
            indices_by_structure: dict[Hashable, list[int]] = {}
            for index in checked:
                structure = _find_structure(plan, dimension, index) if count > 1 else None
                indices_by_structure.setdefault(structure, []).append(index)

            if len(indices_by_structure) == 1:
                parts.append((range(count),))
                continue

            keys.append(name)
            if len(checked) == count:
                parts.append(tuple(map(tuple, indices_by_structure.values())))
            else:
                # the structure of values that were not checked is unknown
                parts.append(tuple((index,) for index in range(count)))
        return cls(tuple(keys), tuple(parts))

    @property
    def group_count(self) -> int:
        """Number of groups into which the cells of the sweep are divided."""
        return prod(map(len, self.parts))

    @property
    def sentence(self) -> str:
        """Sentence that tells the user by which parameters the sweep is divided into groups.

        Empty if there is only one group.
        """
        if not self.keys:
            return ""
        change = "changes" if len(self.keys) == 1 else "change"
        keys = " and ".join(self.keys)
        groups = count_nouns(self.group_count, "group")
        return (
            f"{keys} {change} the structure: {groups} of cells, which run one after the other"
        )

    def iterate_cells(self, shape: Sequence[int]) -> Iterator[int]:
        """Yields the numbers of all cells in order of execution, one group after the other.

        Args:
            shape: Number of values in each dimension of the grid.
        """
        for index_ranges in product(*self.parts):
            for indices in product(*index_ranges):
                # cells are numbered row by row
                number = 0
                for count, index in zip(shape, indices, strict=True):
                    number = number * count + index
                yield number


def _find_structure(plan: SweepPlan, dimension: int, index: int) -> Hashable:
    """Returns the structure of the first scenario that has a given value on one axis.

    Args:
        plan: The sweep.
        dimension: Dimension of the axis in the grid.
        index: Index of its value.

    Returns:
        The structure; the reason why the run cannot be computed together with others, if there
        is one; or `None` if the cell is not a valid scenario.
    """
    # A sweep of single runs must not load the code of lanes.
    from trilat_net.core import RunGroup

    stride = prod(plan.shape[dimension + 1 :])
    cell = plan.cell(index * stride)
    try:
        scenario = plan.scenario(*cell.overrides)
        sweep_cell.check_sweepable(scenario)
        return RunGroup.describe_structure(FusedRun(scenario))
    except ScenarioError:
        return None
