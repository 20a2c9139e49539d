"""The plane of a map: two axes of numbers, a panel per place of the others, verdicts counted per place.

Law: every run of the results is in just one place of one panel; what did not run is counted nowhere.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arm import Array
from ..errors import UsageError
from ..scenario import Scenario
from ..scenario.tables import is_number
from .label import label
from .label import place as told
from .outcome import Verdict

Counts = NDArray[np.int64]

VERDICTS = tuple(Verdict)
"""The order of the last axis of `Panel.counts`."""
STABLE = np.array([verdict.stable is True for verdict in VERDICTS])
UNSTABLE = np.array([verdict.stable is False for verdict in VERDICTS])
MOST_PANELS = 12


class Side(NamedTuple):
    """One axis of a plane.

    Attributes:
        key: what it sets, dotted.
        values: the numbers that it takes, rising, in the unit of the key.
        label: what it is called.
    """

    key: str
    values: tuple[float, ...]
    label: str

    @property
    def even(self) -> bool:
        """True where its values are as far apart, each from the next."""
        steps = np.diff(self.values)
        return len(steps) < 2 or bool(np.ptp(steps) <= 1e-6 * np.abs(steps).max())

    @property
    def places(self) -> Array:
        """Where its values are drawn: at themselves where they are even, else one apart from the next."""
        return np.array(self.values) if self.even else np.arange(len(self.values), dtype=np.float64)

    def placed(self, values: Array) -> Array:
        """Returns where any values of the axis are drawn; NaN beyond those that are one apart."""
        if self.even:
            return values.astype(np.float64)
        known = np.isfinite(values)
        where: Array = np.full(len(values), np.nan)
        where[known] = np.interp(values[known], self.values, self.places, np.nan, np.nan)
        return where


class Panel(NamedTuple):
    """One plane's worth of runs.

    Attributes:
        title: where it lies along the axes that are not drawn; "" where there are none.
        settings: the same as overrides, key by key; "law" among them where laws were swept.
        counts: runs per place and verdict, shape (y, x, 4), in the order of `VERDICTS`.
    """

    title: str
    settings: tuple[tuple[str, Any], ...]
    counts: Counts

    @property
    def runs(self) -> Counts:
        """Runs per place, shape (y, x)."""
        total: Counts = self.counts.sum(axis=2)
        return total

    @property
    def share(self) -> Array:
        """Share of stable runs among the decided ones, shape (y, x); NaN where none was decided."""
        stable, unstable = self.counts[:, :, STABLE].sum(axis=2), self.counts[:, :, UNSTABLE].sum(axis=2)
        decided = stable + unstable
        share: Array = np.full(decided.shape, np.nan)
        np.divide(stable, decided, out=share, where=decided > 0)
        return share


class Plane(NamedTuple):
    """What a map shows.

    Attributes:
        scenario: the name of what was run.
        x: the axis to the right.
        y: the axis upwards; a single value with an empty label where only one axis was swept.
        panels: one per place of the other axes.
        seeds: how many runs a place has at most.
    """

    scenario: str
    x: Side
    y: Side
    panels: tuple[Panel, ...]

    @property
    def seeds(self) -> int:
        """The largest number of runs of a place."""
        return max(int(panel.runs.max()) for panel in self.panels)


def plane(rows: Sequence[Mapping[str, Any]], axes: Sequence[str], scenario: Scenario) -> Plane:
    """Returns the plane of results: its first two axes of numbers, a panel per place of all others.

    Args:
        rows: one mapping per run: a value per axis, and "verdict" as its text.
        axes: the keys of the axes, in the order in which they were given; "law" where laws were swept.
        scenario: the experiment that was swept, for its words.

    Raises:
        UsageError: there is nothing to draw, or there are too many panels to see any.
    """
    if not rows:
        raise UsageError("no cell has run: there is nothing to draw")
    drawn = [key for key in axes if all(is_number(row[key]) for row in rows)][:2]
    if not drawn:
        raise UsageError(f"a map needs an axis of numbers, and {', '.join(axes)} has words only")
    sides = [_side(rows, key, scenario) for key in drawn]
    if len(sides) == 1:
        sides.append(Side("", (0.0,), ""))
    others = [key for key in axes if key not in drawn and len({row[key] for row in rows}) > 1]
    settings = list(dict.fromkeys(tuple((key, row[key]) for key in others) for row in rows))
    if len(settings) > MOST_PANELS:
        raise UsageError(
            f"a map has at most {MOST_PANELS} panels, and {', '.join(others)} would make {len(settings)}: "
            "sweep fewer values of what is not drawn"
        )
    panels = [Panel(_title(one, scenario), one, _empty(sides)) for one in settings]
    of = dict(zip(settings, panels, strict=True))
    place = [{value: n for n, value in enumerate(side.values)} for side in sides]
    verdicts = {verdict.value: n for n, verdict in enumerate(VERDICTS)}
    for row in rows:
        j, i = (place[n][row[side.key]] if side.key else 0 for n, side in enumerate(sides))
        panel = of[tuple((key, row[key]) for key in others)]
        panel.counts[i, j, verdicts[row["verdict"]]] += 1
    return Plane(scenario.name, sides[0], sides[1], tuple(panels))


def _side(rows: Sequence[Mapping[str, Any]], key: str, scenario: Scenario) -> Side:
    values = tuple(sorted({row[key] for row in rows}))  # whole numbers stay whole
    return Side(key, values, label(key, scenario))


def _empty(sides: Sequence[Side]) -> Counts:
    return np.zeros((len(sides[1].values), len(sides[0].values), len(VERDICTS)), dtype=np.int64)


def _title(settings: Sequence[tuple[str, Any]], scenario: Scenario) -> str:
    """Returns a panel's title: words stand for themselves, numbers with what they are."""
    words = []
    for key, value in settings:
        spaced = value.replace("_", " ") if isinstance(value, str) and key != "law" else value
        words.append(spaced if isinstance(spaced, str) else told(key, value, scenario))
    return ", ".join(words)
