"""The plane of a stability map.

Two numeric axes with their labels, a panel per setting of the others, class counts per grid point, and the
measured edges.

Invariant: every run is in exactly one grid point of one panel. A label takes its words from the scenario key
and its unit from the key's suffix; a gain has the unit that its control law states. An edge lies between two
decided grid points of a column, one stable and one not; undecided ones widen it, the majority of the runs
decides, and a draw decides nothing.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core.vectors import Array
from ...errors import UsageError
from ...fields import is_number
from ...scenario import Scenario
from .sweep_cell import CellClass

_UNITS = {
    "_nm_s_rad": "N m s/rad",
    "_nm_rad": "N m/rad",
    "_n_s_m": "N s/m",
    "_kg_m2": "kg m²",
    "_n_m": "N/m",
    "_m_s2": "m/s²",
    "_rad_s": "rad/s",
    "_rad": "rad",
    "_ms": "ms",
    "_hz": "Hz",
    "_nm": "N m",
    "_kg": "kg",
    "_m": "m",
    "_s": "s",
}
"""The longest that a key ends in counts."""
_GAINS = {
    "K": "N m/rad",
    "d": "N m s/rad",
    "Kp": "N m s/rad",
    "Kd": "N m s/rad",
    "Lambda": "1/s",
}


def label_axis(key: str, scenario: Scenario | None = None) -> str:
    """Returns the label of an axis, as "delay (ms)" for link.delay_ms."""
    words, unit = describe_key(key, scenario)
    return f"{words} ({unit})" if unit else words


def label_setting(key: str, value: Any, scenario: Scenario | None = None) -> str:
    """Returns a key with its value, as "delay 200 ms" for link.delay_ms = 200."""
    words, unit = describe_key(key, scenario)
    if isinstance(value, bool):
        value = str(value).lower()
    number = f"{value:g}" if is_number(value) else str(value).replace("_", " ")
    return " ".join(word for word in (words, number, unit) if word)


def describe_key(key: str, scenario: Scenario | None = None) -> tuple[str, str]:
    """Returns what a key sets, in words, and its unit, "" where it has none."""
    *folders, last = key.split(".")
    number = ""
    if last.isdigit() and folders:  # one of several joints or parameters
        *folders, last, number = *folders, f"[{last}]"
    endings = [ending for ending in _UNITS if last.endswith(ending)]
    ending = max(endings, key=len, default="")
    unit = _GAINS.get(last) or _UNITS.get(ending, "")
    word = last.removesuffix(ending)
    if last not in _GAINS and (unit or len(word) > 3):
        word = word.replace("_", " ")
    return f"{word}{number}{_describe_owner(folders, scenario)}", unit


def _describe_owner(folders: list[str], scenario: Scenario | None) -> str:
    """Returns whose key it is, in words; "" for a group's."""
    match folders:
        case ["sites", site, ("hands" | "environment") as group, number]:
            kind = "hand" if group == "hands" else "environment"
            if scenario is not None and site in scenario.sites and number.isdigit():
                some = getattr(scenario.sites[site], group)
                if int(number) < len(some):
                    kind = str(some[int(number)].__struct_config__.tag).replace("_", " ")
            return f", {kind} of {site}"
        case ["sites", site, *_]:
            return f" of {site}"
        case ["links", link, *_]:
            return f" {link}"
        case ["dominance", site]:
            return f"'s share in {site}"
        case _:
            return ""


RunCounts = NDArray[np.int64]

CELL_CLASSES = tuple(CellClass)
"""The order of the last axis of `MapPanel.counts`."""
MAX_PANELS = 12


class PlaneAxis(NamedTuple):
    """One axis of a plane: a dotted key, the numbers that it takes, rising, in its unit, and a label."""

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


class MapPanel(NamedTuple):
    """One plane's worth of runs.

    Attributes:
        title: where it lies along the axes that are not drawn; "" where there are none.
        settings: the same as overrides, key by key; "law" among them where laws were swept.
        counts: runs per place and class, shape (y, x, 4), in the order of `CELL_CLASSES`.
        exponents_per_s: growth exponents, 1/s, means of the seeds, shape (y, x); NaN where there is none.
    """

    title: str
    settings: tuple[tuple[str, Any], ...]
    counts: RunCounts
    exponents_per_s: Array

    @property
    def runs(self) -> RunCounts:
        """Runs per place, shape (y, x)."""
        total: RunCounts = self.counts.sum(axis=2)
        return total

    @property
    def stable(self) -> RunCounts:
        """Stable runs per place, shape (y, x)."""
        stable: RunCounts = self.counts[:, :, [verdict.stable is True for verdict in CELL_CLASSES]].sum(
            axis=2
        )
        return stable

    @property
    def decided(self) -> RunCounts:
        """Decided runs per place, shape (y, x)."""
        return self.runs - self.counts[:, :, CELL_CLASSES.index(CellClass.UNDECIDED)]

    @property
    def share(self) -> Array:
        """Share of stable runs among the decided ones, shape (y, x); NaN where none was decided."""
        stable, decided = self.stable, self.decided
        share: Array = np.full(decided.shape, np.nan)
        np.divide(stable, decided, out=share, where=decided > 0)
        return share


class MapPlane(NamedTuple):
    """What a map shows of a scenario: a panel per place of the axes that are not drawn.

    Where only one axis was swept, y has an empty key and a single value.
    """

    scenario: str
    x: PlaneAxis
    y: PlaneAxis
    panels: tuple[MapPanel, ...]

    @property
    def judged_by_twins(self) -> bool:
        """True if there are growth exponents to be drawn."""
        return any(np.isfinite(panel.exponents_per_s).any() for panel in self.panels)

    @property
    def seeds(self) -> int:
        """The largest number of runs of a place."""
        return max(int(panel.runs.max()) for panel in self.panels)


def build_plane(rows: Sequence[Mapping[str, Any]], axes: Sequence[str], scenario: Scenario) -> MapPlane:
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
    sides = [  # whole numbers stay whole
        PlaneAxis(key, tuple(sorted({row[key] for row in rows})), label_axis(key, scenario)) for key in drawn
    ]
    if len(sides) == 1:
        sides.append(PlaneAxis("", (0.0,), ""))
    others = [key for key in axes if key not in drawn and len({row[key] for row in rows}) > 1]
    settings = list(dict.fromkeys(tuple((key, row[key]) for key in others) for row in rows))
    if len(settings) > MAX_PANELS:
        found = f"at most {MAX_PANELS} panels, and {', '.join(others)} would make {len(settings)}"
        raise UsageError(f"a map has {found}: sweep fewer values of what is not drawn")
    shape = len(sides[1].values), len(sides[0].values), len(CELL_CLASSES)
    panels = [
        MapPanel(_title(one, scenario), one, np.zeros(shape, dtype=np.int64), np.zeros(shape[:2]))
        for one in settings
    ]
    of = dict(zip(settings, panels, strict=True))
    place = [{value: n for n, value in enumerate(side.values)} for side in sides]
    verdicts = {verdict.value: n for n, verdict in enumerate(CELL_CLASSES)}
    for row in rows:
        j, i = (place[n][row[side.key]] if side.key else 0 for n, side in enumerate(sides))
        panel = of[tuple((key, row[key]) for key in others)]
        panel.counts[i, j, verdicts[row["verdict"]]] += 1
        exponent = row.get("exponent_per_s")
        panel.exponents_per_s[i, j] += np.nan if exponent is None else exponent
    for panel in panels:
        panel.exponents_per_s[...] /= np.maximum(panel.runs, 1)
        panel.exponents_per_s[panel.runs == 0] = np.nan
    return MapPlane(scenario.name, sides[0], sides[1], tuple(panels))


def _title(settings: Sequence[tuple[str, Any]], scenario: Scenario) -> str:
    """Returns a panel's title: words stand for themselves, numbers with what they are."""
    words = []
    for key, value in settings:
        spaced = value.replace("_", " ") if isinstance(value, str) and key != "law" else value
        words.append(spaced if isinstance(spaced, str) else label_setting(key, value, scenario))
    return ", ".join(words)


class StableInterval(NamedTuple):
    """A change between stable and not, along one key.

    Attributes:
        low: the last value below it that was decided.
        high: the first one above it.
        stable_below: whether what lies below is the stable side.
        sharp: True if nothing between the two stayed undecided.
    """

    low: float
    high: float
    stable_below: bool
    sharp: bool = True

    @property
    def middle(self) -> float:
        """The value half way."""
        return 0.5 * (self.low + self.high)


def find_map_edges(plane: MapPlane, panel: MapPanel) -> list[tuple[float, StableInterval]]:
    """Returns the edges of a panel with the values of their columns, each column from below."""
    found = []
    y = plane.y.values
    for x, share in zip(plane.x.values, panel.share.T, strict=True):
        decided = np.flatnonzero(np.isfinite(share) & (share != 0.5))
        stable = share[decided] > 0.5
        for n in np.flatnonzero(stable[1:] != stable[:-1]):
            low, high = decided[n : n + 2].tolist()
            found.append((x, StableInterval(y[low], y[high], bool(stable[n]), high == low + 1)))
    return found
