"""Confirms a map over a real network: runs cells near its edges live and compares classes.

Invariant:
    - A cell is confirmed if the log of the live session, classified over the same duration, has
      the class of virtual time.
    - A failed session confirms nothing, unless it failed because an arm diverged.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ...analysis.run_end import EndBehaviour, classify_log_end
from ...errors import LogError, UsageError
from ...log.log_reader import open_log
from ...reporting.result_text import TextTable
from ...scenario import Scenario, parse_scenario
from .sweep_cell import CellClass, classify_end
from .sweep_plan import label_axis
from .sweep_results import ResultRow

MAX_SESSION_S = 60.0
"""Longest cell that is confirmed, in s: a live session lasts as long as the cell ran."""
_EXTRA_S = 0.5
"""Extra duration of a cell that diverged, in s, so that it does not end on the same tick."""


SessionRunner = Callable[[Scenario, str], tuple[Path, Sequence[str]]]
"""Runs a scenario over a network under a name.

Returns the path of its log, which may not exist, and the problems of the session, in order.
"""


GridIndex = tuple[Any, ...]
"""Position of a run in the grid: its index on each axis, then its law and its seed."""


class ConfirmedCell(NamedTuple):
    """One cell that was run live.

    Attributes:
        row: the cell's run in the results of the sweep.
        virtual: the class in virtual time.
        live: the class of the log of the live session; None if the session failed.
        text: the figures of the log, or the problems of the session.
        log: the path of the log; None if the session left no log.
    """

    row: ResultRow
    virtual: CellClass
    live: CellClass | None
    text: str
    log: Path | None

    @property
    def same(self) -> bool:
        """True if the classes of virtual time and of the live session agree."""
        return self.virtual is self.live


def choose_cells_near_edges(
    rows: Sequence[ResultRow], axes: Sequence[str], count: int
) -> list[ResultRow]:
    """Returns the cells nearest to edges, with the same target number on either side.

    The distance of a cell from an edge is the number of steps along one axis to the nearest
    cell with the opposite verdict. Cells that ran longer than `MAX_SESSION_S` are left out. If
    more than `count` cells are equally near, those spread most evenly along the edge are
    chosen.

    Args:
        rows: one mapping per run, with its axes, "law", "seed", "cell", "verdict", "ran_s".
        axes: the keys of the axes.
        count: largest number of cells on each side.

    Raises:
        UsageError: the results have no edge, or all cells on one side of it ran too long.
    """
    if count < 1:
        raise UsageError(f"--confirm takes a number of cells from 1 on, not {count}")
    row_at = _index_rows(rows, axes)
    distances = _compute_edge_distances(row_at, len(axes))
    if not distances:
        raise UsageError(
            "no two cells along an axis were decided differently: there is no edge to confirm"
        )
    chosen = []
    for stable in (True, False):
        candidates = {}
        for index, distance in distances.items():
            row = row_at[index]
            short = row["ran_s"] <= MAX_SESSION_S
            if short and CellClass(row["verdict"]).stable is stable:
                candidates[index] = distance
        if not candidates:
            side = "stable" if stable else "other"
            raise UsageError(
                f"every cell on the {side} side of an edge ran longer than {MAX_SESSION_S:g} s"
            )
        chosen += [row_at[index] for index in _choose_nearest(candidates, count)]
    return chosen


def _choose_nearest(distances: Mapping[GridIndex, int], count: int) -> list[GridIndex]:
    """Returns at most `count` of the runs nearest to an edge, spread evenly along the edge.

    The distance of the `count`-th nearest run is the limit: all runs within this limit are
    candidates.

    Args:
        distances: distance of each run from the edge, by position in the grid.
        count: largest number of runs.
    """
    nearest = sorted(distances.values())[:count]
    limit = nearest[-1]
    near = [index for index, distance in distances.items() if distance <= limit]
    near.sort(key=_rank_along_edge)
    spread = np.linspace(0, len(near) - 1, min(count, len(near)))
    return [near[n] for n in spread.round().astype(int)]


def _rank_along_edge(index: GridIndex) -> tuple[Any, ...]:
    """Returns the sorting key of a run: panel, law and seed first, then the two drawn axes."""
    return (*map(str, index[2:]), *index[:2])


def confirm_cell(row: ResultRow, run: SessionRunner) -> ConfirmedCell:
    """Runs a cell over a network and compares the classes.

    Args:
        row: the cell's run in the results of the sweep.
        run: runs a scenario over a network.
    """
    virtual = CellClass(row["verdict"])
    extra_s = _EXTRA_S if row["diverged_s"] is not None else 0.0
    duration_s = min(row["ran_s"] + extra_s, MAX_SESSION_S + _EXTRA_S)
    scenario = msgspec.structs.replace(parse_scenario(row["scenario"]), duration_s=duration_s)
    path, problems = run(scenario, f"cell-{row['cell']}")
    live = None
    try:
        end = classify_log_end(open_log(path))
    except LogError as error:
        text = "; ".join([*problems, str(error)])
    else:
        # a divergence ends the session by design and reports a problem
        if problems and end.behaviour is not EndBehaviour.DIVERGED:
            text = "; ".join(problems)
        else:
            text = end.text
            live = classify_end(end)
    log = path if path.exists() else None
    return ConfirmedCell(row=row, virtual=virtual, live=live, text=text, log=log)


def tabulate_confirmations(
    confirmations: Sequence[ConfirmedCell], axes: Sequence[str]
) -> TextTable:
    """Returns a table with a row per cell: its values, both classes, figures and log."""
    heads = ["cell", *map(label_axis, axes)]
    heads += ["seed", "virtual", "live", "", "the log shows", "log"]
    rows = []
    for confirmed in confirmations:
        run = confirmed.row
        row = [str(run["cell"])]
        for key in axes:
            value = run[key]
            row.append(value if isinstance(value, str) else f"{value:g}")
        row.append(str(run["seed"]))
        row.append(confirmed.virtual.value)
        row.append("none" if confirmed.live is None else confirmed.live.value)
        row.append("same" if confirmed.same else "DIFFERS")
        row.append(confirmed.text)
        row.append("none" if confirmed.log is None else str(confirmed.log))
        rows.append(tuple(row))
    return TextTable(tuple(heads), rows)


def _index_rows(rows: Sequence[ResultRow], axes: Sequence[str]) -> dict[GridIndex, ResultRow]:
    """Returns the rows by their position in the grid; numbers precede texts on an axis."""
    ranks: dict[str, dict[Any, int]] = {}
    for key in axes:
        values = {row[key] for row in rows}
        numbers = sorted(value for value in values if not isinstance(value, str))
        texts = sorted(value for value in values if isinstance(value, str))
        ranks[key] = {value: rank for rank, value in enumerate([*numbers, *texts])}
    row_at: dict[GridIndex, ResultRow] = {}
    for row in rows:
        position = [ranks[key][row[key]] for key in axes]
        row_at[*position, row.get("law"), row.get("seed")] = row
    return row_at


def _compute_edge_distances(
    row_at: Mapping[GridIndex, ResultRow], axis_count: int
) -> dict[GridIndex, int]:
    """Returns the distance of decided runs from the nearest run with the opposite verdict.

    Distances are counted in steps along one axis, the other axes, the law and the seed being
    equal. Runs without an opposite verdict on any of their lines are left out.
    """
    stable = {index: CellClass(row["verdict"]).stable for index, row in row_at.items()}
    lines: dict[GridIndex, list[GridIndex]] = {}
    for index, verdict in stable.items():
        if verdict is None:
            continue
        for axis in range(axis_count):
            line = (axis, *index[:axis], *index[axis + 1 :])
            lines.setdefault(line, []).append(index)
    distances: dict[GridIndex, int] = {}
    for (axis, *_), indices in lines.items():
        for index in indices:
            steps = [
                abs(other[axis] - index[axis])
                for other in indices
                if stable[other] is not stable[index]
            ]
            if index in distances:
                steps.append(distances[index])
            if steps:
                distances[index] = min(steps)
    return distances
