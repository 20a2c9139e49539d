"""Confirmation of a map over a real network: runs cells near its edges live and compares the
classes.

Invariant: a cell is confirmed if the log of the live session, classified over the same
duration, has the class of virtual time. A failed session confirms nothing, unless it failed by
diverging.
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
"""A live session lasts as long as the cell ran: longer ones are passed over, s."""
_BEYOND_S = 0.5
"""A cell that diverged runs so much longer than it needed to, s: not to end on the very tick.
"""


SessionRunner = Callable[[Scenario, str], tuple[Path, Sequence[str]]]
"""Runs a scenario over a network, called by a name; returns its log, which may be missing, and
what went wrong, in order.
"""


class ConfirmedCell(NamedTuple):
    """One cell, run live.

    Attributes:
        row: the cell, as its results have it.
        virtual: its class in virtual time.
        live: the class of the log; None where there is none.
        text: what the log shows in numbers, or what went wrong.
        log: where it lies; None where there is none.
    """

    row: ResultRow
    virtual: CellClass
    live: CellClass | None
    text: str
    log: Path | None

    @property
    def same(self) -> bool:
        """Whether both verdicts are the same."""
        return self.virtual is self.live


def choose_cells_near_edges(
    rows: Sequence[ResultRow], axes: Sequence[str], count: int
) -> list[ResultRow]:
    """Returns cells next to edges, as many on the stable side as on the other.

    How far a cell is from an edge is counted in steps along one axis, to the first cell that
    was decided the other way. The nearest are taken whose runs were short enough; of more than
    are asked for, those that are spread most evenly along the edge.

    Args:
        rows: one mapping per run, with its axes, "law", "seed", "cell", "verdict", "ran_s".
        axes: the keys of the axes.
        count: how many on each side.

    Raises:
        UsageError: there is no edge, or no cell next to one that ran short enough.
    """
    if count < 1:
        raise UsageError(f"--confirm takes a number of cells from 1 on, not {count}")
    places = _index_rows(rows, axes)
    away = _steps_away(places, len(axes))
    if not away:
        raise UsageError(
            "no two cells along an axis were decided differently: there is no edge to confirm"
        )
    chosen = []
    for side in (True, False):
        brief = [
            place
            for place in away
            if CellClass(places[place]["verdict"]).stable is side
            and places[place]["ran_s"] <= MAX_SESSION_S
        ]
        if not brief:
            word = "stable" if side else "other"
            raise UsageError(
                f"every cell on the {word} side of an edge ran longer than {MAX_SESSION_S:g} s"
            )
        farthest = sorted(away[place] for place in brief)[min(count, len(brief)) - 1]
        near = [place for place in brief if away[place] <= farthest]
        near.sort(key=lambda place: (*map(str, place[2:]), *place[:2]))
        spread = np.linspace(0, len(near) - 1, min(count, len(near))).round().astype(int)
        chosen += [places[near[n]] for n in spread]
    return chosen


def confirm_cell(row: ResultRow, run: SessionRunner) -> ConfirmedCell:
    """Runs a cell over a network and compares verdicts."""
    virtual = CellClass(row["verdict"])
    extra_s = _BEYOND_S if row["diverged_s"] is not None else 0.0
    lasts_s = min(row["ran_s"] + extra_s, MAX_SESSION_S + _BEYOND_S)
    scenario = msgspec.structs.replace(parse_scenario(row["scenario"]), duration_s=lasts_s)
    file, problems = run(scenario, f"cell-{row['cell']}")
    log = file if file.exists() else None
    try:
        found = classify_log_end(open_log(file))
    except LogError as error:
        return ConfirmedCell(
            row=row,
            virtual=virtual,
            live=None,
            text="; ".join([*problems, str(error)]),
            log=log,
        )
    if problems and found.behaviour is not EndBehaviour.DIVERGED:  # that ends all, as it should
        return ConfirmedCell(
            row=row, virtual=virtual, live=None, text="; ".join(problems), log=log
        )
    return ConfirmedCell(
        row=row, virtual=virtual, live=classify_end(found), text=found.text, log=log
    )


def tabulate_confirmations(found: Sequence[ConfirmedCell], axes: Sequence[str]) -> TextTable:
    """Returns a row per cell: where it lies, both verdicts, what the log shows and where it is."""
    heads = (
        "cell",
        *map(label_axis, axes),
        "seed",
        "virtual",
        "live",
        "",
        "the log shows",
        "log",
    )
    rows = []
    for one in found:
        values = [one.row[key] for key in axes]
        place = [value if isinstance(value, str) else f"{value:g}" for value in values]
        live = "none" if one.live is None else one.live.value
        same = "same" if one.same else "DIFFERS"
        where = "none" if one.log is None else str(one.log)
        cell = str(one.row["cell"])
        seed = str(one.row["seed"])
        rows.append((cell, *place, seed, one.virtual.value, live, same, one.text, where))
    return TextTable(heads, rows)


GridIndex = tuple[Any, ...]


def _index_rows(rows: Sequence[ResultRow], axes: Sequence[str]) -> dict[GridIndex, ResultRow]:
    values = [
        sorted({row[key] for row in rows}, key=lambda one: (isinstance(one, str), one))
        for key in axes
    ]
    numbers = [{value: n for n, value in enumerate(some)} for some in values]

    def index(row: ResultRow) -> GridIndex:
        places = (number[row[key]] for key, number in zip(axes, numbers, strict=True))
        return (*places, row.get("law"), row.get("seed"))

    return {index(row): row for row in rows}


def _steps_away(places: Mapping[GridIndex, ResultRow], axes: int) -> dict[GridIndex, int]:
    """Returns of decided places how many steps along an axis the first one is that was decided
    otherwise.
    """
    stable = {place: CellClass(row["verdict"]).stable for place, row in places.items()}
    lines: dict[GridIndex, list[GridIndex]] = {}
    for place, side in stable.items():
        if side is not None:
            for n in range(axes):
                lines.setdefault((n, *place[:n], *place[n + 1 :]), []).append(place)
    away: dict[GridIndex, int] = {}
    for (n, *_), line in lines.items():
        for place in line:
            others = [
                abs(one[n] - place[n]) for one in line if stable[one] is not stable[place]
            ]
            if others:
                away[place] = min(min(others), away.get(place, min(others)))
    return away
