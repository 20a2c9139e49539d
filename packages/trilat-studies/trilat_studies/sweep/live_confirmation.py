"""Confirms a stability map over a real network, by running cells near its edges live.

A stability map shows for which parameters a scenario is stable. It is computed in virtual time:
the simulation advances without waiting for a clock or a network. This module selects cells,
combinations of parameters, on both sides of the edges of the map. It runs each of them as a
live session over a network, and compares the class of the recorded log with the class in
virtual time.

Invariant:
    - A cell is confirmed if the log of the live session, classified over the same duration, has
      the same class as the run in virtual time.
    - A failed session confirms nothing, unless it failed because an arm left its limits.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from trilat_net.analysis import EndBehaviour, RunEnd
from trilat_net.errors import LogError, UsageError
from trilat_net.log import open_log
from trilat_net.presentation import TextTable
from trilat_net.scenario import Scenario, parse_scenario

from .sweep_cell import CellClass, classify_decision
from .sweep_plan import label_axis
from .sweep_results import ResultRow

MAX_SESSION_S = 60.0
"""Duration of the longest cell that is confirmed, in s. A live session lasts as long as the
cell ran.
"""
_EXTRA_S = 0.5
"""Extra duration of a cell that diverged, in s, so that the divergence is not at the very end.
"""


SessionRunner = Callable[[Scenario, str], tuple[Path, Sequence[str]]]
"""Function that runs a scenario over a network, under a name for its log.

It returns the path of the log, which may not exist, and the problems of the session in the
order of time.
"""


GridIndex = tuple[Any, ...]
"""Position of a run in the grid: its index on each axis, then its law and its seed."""


class _ConfirmedCell(NamedTuple):
    """A combination of parameters that was simulated, and then run over a real network.

    The combination is part of a sweep over parameters. The comparison shows whether the
    stability in the simulation also holds over a real network.

    Attributes:
        row: The simulated run in the results of the sweep.
        virtual: How the simulated run ended, for example converged or diverged.
        live: How the run over the network ended. None if this run failed.
        text: Numbers from the log of the run over the network, or its problems.
        log: Path of this log. None if there is no log.
    """

    row: ResultRow
    virtual: CellClass
    live: CellClass | None
    text: str
    log: Path | None

    @property
    def same(self) -> bool:
        """True if the live run has the same class as the run in virtual time.

        For example, both converged.
        """
        return self.virtual is self.live


def choose_cells_near_edges(
    rows: Sequence[ResultRow], axes: Sequence[str], count: int
) -> list[ResultRow]:
    """Selects the cells nearest to the edges of stability, up to `count` on either side.

    The distance of a cell from an edge is the number of steps along one axis to the nearest
    cell with the opposite result. Cells that ran longer than `MAX_SESSION_S` are left out. If
    more cells than `count` are equally near, those are selected that are spread most evenly
    along the edge.

    Args:
        rows: One mapping per run, with the values of the axes and the keys "law", "seed",
            "cell", "verdict" and "ran_s".
        axes: Keys of the axes.
        count: Largest number of cells on each side.

    Raises:
        UsageError: The results have no edge, or all cells on one side of it ran too long.
    """
    if count < 1:
        raise UsageError(f"--confirm must be a number of cells, at least 1, not {count}")
    row_of_index = _index_rows(rows, axes)
    distances = _compute_edge_distances(row_of_index, len(axes))
    if not distances:
        raise UsageError(
            "no two cells along an axis were decided differently: there is no edge to confirm"
        )

    selected = []
    for stable in (True, False):
        candidates = {}
        for index, distance in distances.items():
            row = row_of_index[index]
            is_short = row["ran_s"] <= MAX_SESSION_S
            if is_short and CellClass(row["verdict"]).stable is stable:
                candidates[index] = distance
        if not candidates:
            side = "stable" if stable else "other"
            raise UsageError(
                f"every cell on the {side} side of an edge ran longer than {MAX_SESSION_S:g} s"
            )
        indices = _select_nearest(candidates, count)
        selected += [row_of_index[index] for index in indices]
    return selected


def _select_nearest(distances: Mapping[GridIndex, int], count: int) -> list[GridIndex]:
    """Returns at most `count` of the runs nearest to an edge, spread evenly along the edge.

    All runs that are not farther than the `count`-th nearest run are candidates.

    Args:
        distances: Distance of each run from the edge, by its position in the grid.
        count: Largest number of runs.
    """
    nearest = sorted(distances.values())[:count]
    limit = nearest[-1]
    near = [index for index, distance in distances.items() if distance <= limit]
    near.sort(key=_rank_along_edge)
    selected_count = min(count, len(near))
    spread = np.linspace(0, len(near) - 1, selected_count)
    positions = spread.round().astype(int)
    return [near[n] for n in positions]


def _rank_along_edge(index: GridIndex) -> tuple[Any, ...]:
    """Returns the sort key by which neighbouring cells beside an edge come side by side.

    Runs of the same panel, law and seed come together. Within these, the runs are sorted by the
    two axes that a map draws. A selection at equal distances is then spread along the edge.

    Args:
        index: Position of the run along all axes, then its law and its seed.
    """
    return (*map(str, index[2:]), *index[:2])


def confirm_cell(row: ResultRow, run: SessionRunner) -> _ConfirmedCell:
    """Runs a cell of a sweep over a real network, and compares the results.

    The cell is classified from the log of this live session, as the sweep classified it in
    virtual time.

    Args:
        row: Run of the cell in the results of the sweep.
        run: Function that runs a scenario over a network.

    Returns:
        Both classes. The live class is None if the session failed.
    """
    virtual = CellClass(row["verdict"])
    extra_s = _EXTRA_S if row["diverged_s"] is not None else 0.0
    longest_s = MAX_SESSION_S + _EXTRA_S
    duration_s = min(row["ran_s"] + extra_s, longest_s)
    scenario = parse_scenario(row["scenario"])
    scenario = msgspec.structs.replace(scenario, duration_s=duration_s)
    path, problems = run(scenario, f"cell-{row['cell']}")

    live = None
    try:
        end = RunEnd.of_log(open_log(path))
    except LogError as error:
        text = "; ".join([*problems, str(error)])
    else:
        # A session in which an arm leaves its limits ends early and reports a problem. This is
        # how it should be, and the log counts.
        has_diverged = end.behaviour is EndBehaviour.DIVERGED
        if problems and not has_diverged:
            text = "; ".join(problems)
        else:
            text = end.text
            live = classify_decision(end.stability, end.behaviour)
    log = path if path.exists() else None
    return _ConfirmedCell(row=row, virtual=virtual, live=live, text=text, log=log)


def tabulate_confirmations(
    confirmations: Sequence[_ConfirmedCell], axes: Sequence[str]
) -> TextTable:
    """Returns a table of the cells that were run live, with one row per cell.

    A row has the values of the cell, its classes in virtual time and live, numbers from the
    log, and the path of the log.

    Args:
        confirmations: The cells.
        axes: Keys of the axes of the sweep.
    """
    heads = ["cell", *map(label_axis, axes)]
    heads += ["seed", "virtual", "live", "", "the log shows", "log"]
    rows = []
    for confirmed in confirmations:
        run = confirmed.row
        row = [str(run["cell"])]
        for key in axes:
            value = run[key]
            row.append(value if isinstance(value, str) else f"{value:g}")
        live = "none" if confirmed.live is None else confirmed.live.value
        agreement = "same" if confirmed.same else "DIFFERS"
        log = "none" if confirmed.log is None else str(confirmed.log)
        row.append(str(run["seed"]))
        row.append(confirmed.virtual.value)
        row.append(live)
        row.append(agreement)
        row.append(confirmed.text)
        row.append(log)
        rows.append(tuple(row))
    return TextTable(tuple(heads), rows)


def _index_rows(rows: Sequence[ResultRow], axes: Sequence[str]) -> dict[GridIndex, ResultRow]:
    """Returns the runs by their position in the grid, by which neighbours are found.

    The values of an axis are numbered in rising order, numbers before texts. The law and the
    seed follow the numbers: the run with the second value of x and the first of y is at (1, 0,
    law, seed).

    Args:
        rows: The runs, one mapping from columns to values per run.
        axes: Keys of the axes.
    """
    ranks: dict[str, dict[Any, int]] = {}
    for key in axes:
        values = {row[key] for row in rows}
        numbers = sorted(value for value in values if not isinstance(value, str))
        texts = sorted(value for value in values if isinstance(value, str))
        ordered = [*numbers, *texts]
        ranks[key] = {value: rank for rank, value in enumerate(ordered)}
    row_of_index: dict[GridIndex, ResultRow] = {}
    for row in rows:
        position = [ranks[key][row[key]] for key in axes]
        index = (*position, row.get("law"), row.get("seed"))
        row_of_index[index] = row
    return row_of_index


def _compute_edge_distances(
    row_of_index: Mapping[GridIndex, ResultRow], axis_count: int
) -> dict[GridIndex, int]:
    """Returns the distance of each decided run from the nearest run with the opposite result.

    Distances are counted in steps along one axis, where the values on all other axes, the law
    and the seed are the same.

    Args:
        row_of_index: The runs by their position in the grid.
        axis_count: Number of axes.

    Returns:
        Distances by position. Runs without an opposite result along any axis are left out.
    """
    stable = {}
    for index, row in row_of_index.items():
        verdict = CellClass(row["verdict"])
        stable[index] = verdict.stable

    # A line contains the decided runs that differ in their position on one axis only.
    lines: dict[GridIndex, list[GridIndex]] = {}
    for index, is_stable in stable.items():
        if is_stable is None:
            continue
        for axis in range(axis_count):
            before = index[:axis]
            after = index[axis + 1 :]
            line = (axis, *before, *after)
            line_indices = lines.setdefault(line, [])
            line_indices.append(index)

    distances: dict[GridIndex, int] = {}
    for (axis, *_), indices in lines.items():
        for index in indices:
            steps = []
            for other in indices:
                is_opposite = stable[other] is not stable[index]
                if is_opposite:
                    steps.append(abs(other[axis] - index[axis]))
            if index in distances:
                steps.append(distances[index])
            if steps:
                distances[index] = min(steps)
    return distances
