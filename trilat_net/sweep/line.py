"""Lines that theory draws on a map: of a condition in closed form, and of the linear analysis.

Law: a line is where a quantity that theory has at every place of the map is zero; it is found without any of
the map's runs.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..core.arm import Array
from ..errors import ScenarioError
from ..scenario import Scenario
from .criterion import Criterion, criterion
from .plane import Side

At = Callable[[float, float], Scenario]
"""The scenario of a panel at (x, y)."""

_PAIR = ((None, -1), (1, None))
"""All places but the last along an axis, and all but the first."""
_TOLERANCE = 1e-6
_MOST = 60
LINEAR = "linear analysis"
_ABOUT = "where the rightmost root of the loop, linearised, crosses the imaginary axis"


class Line(NamedTuple):
    """One line.

    Attributes:
        label: what the legend calls it.
        text: the same for plain text.
        about: where it is from.
        spare: what is zero on it and positive where theory says stable, shape (y, x); NaN where it is silent.
        rank: how it is drawn: 0 is the first look, and so on.
    """

    label: str
    text: str
    about: str
    spare: Array
    rank: int

    @property
    def there(self) -> bool:
        """Whether it goes through the map: between four places that theory speaks of, some on either side."""
        corners = np.array([self.spare[a:b, c:d] for a, b in _PAIR for c, d in _PAIR])
        stable = (corners > 0.0).sum(axis=0)
        return bool((np.isfinite(corners).all(axis=0) & (stable > 0) & (stable < len(corners))).any())

    def crossings(self, column: int, y: Side) -> list[float]:
        """Returns where it crosses a column, from below; between two places as if it went straight."""
        spare, values = self.spare[:, column], y.values
        found = []
        for n in range(len(values) - 1):
            a, b = float(spare[n]), float(spare[n + 1])
            if np.isfinite([a, b]).all() and (a > 0.0) != (b > 0.0):
                found.append(values[n] + (values[n + 1] - values[n]) * a / (a - b))
        return found


def closed_form(at: At, x: Side, y: Side) -> Line | None:
    """Returns the line of the condition in closed form; None where there is none, or not within the map.

    Args:
        at: makes the scenario of a place.
        x: the axis to the right.
        y: the axis upwards.
    """
    told = [[criterion(at(right, up)) for right in x.values] for up in y.values]
    first = next((one for row in told for one in row if one is not None), None)
    if first is None:
        return None
    spare = np.array([[np.nan if one is None else one.excess for one in row] for row in told])
    line = Line(first.symbol, first.text, first.source, spare, 0)
    return line if line.there else None


def linear(columns: Sequence[tuple[list[float], list[str]]]) -> tuple[Line | None, list[str]]:
    """Returns the line of the linear analysis, and what is to be known of it.

    Args:
        columns: per value of the x axis the real parts of the rightmost roots, 1/s, and remarks.
    """
    spare = -np.array([growths for growths, _ in columns]).T
    remarks = list(dict.fromkeys(remark for _, some in columns for remark in some))
    line = Line(LINEAR, LINEAR, _ABOUT, np.where(np.isinf(spare), np.nan, spare), 1)
    return line if line.there else None, remarks


def met(condition: Callable[[float], Criterion | None], low: float, high: float) -> float | None:
    """Returns where between two values a condition is just met, or None.

    By regula falsi; the weight of the end that stays is halved, so that it does not stay for ever.

    Args:
        condition: tells of a value how much more there is than it asks for; may refuse one.
        low: from.
        high: to.
    """
    a, b = _excess(condition, low), _excess(condition, high)
    if a is None or b is None or (a > 0.0) == (b > 0.0):
        return None
    small = _TOLERANCE * (abs(a) + abs(b))
    middle = low
    for _ in range(_MOST):
        middle = (low * b - high * a) / (b - a)
        here = _excess(condition, middle)
        if here is None or abs(here) <= small:
            return None if here is None else middle
        if (here > 0.0) == (a > 0.0):
            low, a, b = middle, here, 0.5 * b
        else:
            high, b, a = middle, here, 0.5 * a
    return middle


def _excess(condition: Callable[[float], Criterion | None], value: float) -> float | None:
    """Returns what a condition has to spare; None where it does not speak, as between whole numbers."""
    try:
        found = condition(value)
    except ScenarioError:
        return None
    return None if found is None else found.excess
