"""Cells of a map beside its edges, run once more over a network.

Law: a cell is confirmed where the log of the live session, judged by itself over just as long, has the
verdict that virtual time gave. A session that failed confirms nothing, unless it did so by diverging.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ..certificate.ending import Motion
from ..certificate.growth import growth
from ..errors import LogError, UsageError
from ..log.reader import open_log
from ..scenario import Scenario, parse
from .grid import Grid
from .label import label
from .outcome import VERDICT_OF, Verdict

LONGEST_S = 60.0
"""A live session lasts as long as the cell ran: longer ones are passed over, s."""
_BEYOND_S = 0.5
"""A cell that diverged runs so much longer than it needed to, s: not to end on the very tick."""

Row = Mapping[str, Any]


class Session(NamedTuple):
    """How a live session went.

    Attributes:
        log: its log, which may be missing.
        problems: what went wrong, in order.
    """

    log: Path
    problems: Sequence[str]


Runner = Callable[[Scenario, str], Session]
"""Runs a scenario over a network, called by a name, and says how it went."""


class Confirmed(NamedTuple):
    """One cell, run live.

    Attributes:
        row: the cell, as its results have it.
        virtual: its verdict in virtual time.
        live: the verdict of the log; None where there is none.
        text: what the log shows in numbers, or what went wrong.
        log: where it lies; None where there is none.
    """

    row: Row
    virtual: Verdict
    live: Verdict | None
    text: str
    log: Path | None

    @property
    def same(self) -> bool:
        """Whether both verdicts are the same."""
        return self.virtual is self.live


def beside_edges(
    rows: Sequence[Row], axes: Sequence[str], count: int, longest_s: float = LONGEST_S
) -> list[Row]:
    """Returns cells beside edges: so many on the stable side and so many on the other.

    How far a cell is from an edge is counted in steps along one axis, to the first cell that was decided the
    other way. The nearest are taken whose runs were short enough; of more than are asked for, those that are
    spread most evenly along the edge.

    Args:
        rows: one mapping per run, with its axes, "law", "seed", "cell", "verdict", "ran_s".
        axes: the keys of the axes.
        count: how many on each side.
        longest_s: cells that ran longer are passed over, s.

    Raises:
        UsageError: there is no edge, or no cell beside one that ran short enough.
    """
    if count < 1:
        raise UsageError(f"--confirm takes a number of cells from 1 on, not {count}")
    places, order = _places(rows, axes)
    away = _steps_away(places, len(axes))
    if not away:
        raise UsageError("no two cells along an axis were decided differently: there is no edge to confirm")
    chosen = []
    for side in (True, False):
        ours = {
            place: steps for place, steps in away.items() if Verdict(places[place]["verdict"]).stable is side
        }
        brief = [place for place in ours if places[place]["ran_s"] <= longest_s]
        if not brief:
            word = "stable" if side else "other"
            raise UsageError(f"every cell on the {word} side of an edge ran longer than {longest_s:g} s")
        farthest = sorted(ours[place] for place in brief)[min(count, len(brief)) - 1]
        near = [places[place] for place in brief if ours[place] <= farthest]
        chosen += _spread(near, order, count)
    return chosen


def confirm(row: Row, run: Runner, longest_s: float = LONGEST_S) -> Confirmed:
    """Runs a cell over a network and compares verdicts.

    Args:
        row: the cell, with "scenario", its text.
        run: runs a session.
        longest_s: how long a session may be, s.
    """
    virtual = Verdict(row["verdict"])
    extra_s = _BEYOND_S if row["diverged_s"] is not None else 0.0
    scenario = parse(row["scenario"])
    scenario = msgspec.structs.replace(
        scenario, duration_s=min(row["ran_s"] + extra_s, longest_s + _BEYOND_S)
    )
    session = run(scenario, f"cell-{row['cell']}")
    log = session.log if session.log.exists() else None
    try:
        found = growth(open_log(session.log))
    except LogError as error:
        return Confirmed(row, virtual, None, "; ".join([*session.problems, str(error)]), log)
    if session.problems and found.motion is not Motion.DIVERGED:  # one that diverges ends all, as it should
        return Confirmed(row, virtual, None, "; ".join(session.problems), log)
    return Confirmed(row, virtual, VERDICT_OF[found.motion], found.text, log)


def confirmed_table(found: Sequence[Confirmed], axes: Sequence[str]) -> Grid:
    """Returns a row per cell: where it lies, both verdicts, what the log shows and where it is.

    Args:
        found: the cells.
        axes: the keys of the axes.
    """
    heads = ("cell", *map(label, axes), "seed", "virtual", "live", "", "the log shows", "log")
    rows = []
    for one in found:
        values = [one.row[key] for key in axes]
        place = [value if isinstance(value, str) else f"{value:g}" for value in values]
        live = "none" if one.live is None else one.live.value
        same = "same" if one.same else "DIFFERS"
        where = "none" if one.log is None else str(one.log)
        cell, seed = str(one.row["cell"]), str(one.row["seed"])
        rows.append((cell, *place, seed, one.virtual.value, live, same, one.text, where))
    return Grid(heads, rows)


Place = tuple[Any, ...]


def _places(rows: Sequence[Row], axes: Sequence[str]) -> tuple[dict[Place, Row], Callable[[Row], Place]]:
    """Returns rows by place: numbers of the axes' values, then law and seed; and how a row is placed."""
    values = [sorted({row[key] for row in rows}, key=_sortable) for key in axes]
    numbers = [{value: n for n, value in enumerate(some)} for some in values]

    def place(row: Row) -> Place:
        where = [number[row[key]] for key, number in zip(axes, numbers, strict=True)]
        return (*where, row.get("law"), row.get("seed"))

    return {place(row): row for row in rows}, place


def _sortable(value: Any) -> tuple[bool, Any]:
    return isinstance(value, str), value


def _steps_away(places: Mapping[Place, Row], axes: int) -> dict[Place, int]:
    """Returns of decided places how many steps along an axis the first one is that was decided otherwise."""
    stable = {place: Verdict(row["verdict"]).stable for place, row in places.items()}
    lines: dict[Place, list[Place]] = {}
    for place, side in stable.items():
        if side is not None:
            for n in range(axes):
                lines.setdefault((n, *place[:n], *place[n + 1 :]), []).append(place)
    away: dict[Place, int] = {}
    for (n, *_), line in lines.items():
        for place in line:
            others = [abs(one[n] - place[n]) for one in line if stable[one] is not stable[place]]
            if others:
                away[place] = min(min(others), away.get(place, min(others)))
    return away


def _spread(rows: Sequence[Row], order: Callable[[Row], Place], count: int) -> list[Row]:
    """Returns some rows, as evenly apart as they can be in the order of their places."""
    ordered = sorted(rows, key=lambda row: tuple(map(str, order(row)[2:])) + order(row)[:2])
    if len(ordered) <= count:
        return ordered
    return [ordered[n] for n in np.linspace(0, len(ordered) - 1, count).round().astype(int)]
