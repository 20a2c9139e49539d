"""The edge between stable and not along one key: a scan, then bisection.

Law: an edge is known to lie between two values that were run and judged, one stable and one not. Values that
stay undecided widen it, and are never counted for one side; a scan that sees more than one edge has them all.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

SCANNED = 9
"""Values of the scan: islands that are wider than an eighth of the range are seen."""
TOLERANCE = 0.005
_MOST = 60

Stable = Callable[[float], bool | None]
"""Whether a run at a value is stable; None where nobody knows."""


class Span(NamedTuple):
    """Where an edge lies.

    Attributes:
        low: the last value below it that was decided.
        high: the first one above it.
        stable_below: whether what lies below is the stable side.
        sharp: whether the two are as close as was asked; else what is between them was undecided.
    """

    low: float
    high: float
    stable_below: bool
    sharp: bool

    @property
    def middle(self) -> float:
        """The value half way."""
        return 0.5 * (self.low + self.high)

    @property
    def half_width(self) -> float:
        """Half of what is not known."""
        return 0.5 * (self.high - self.low)


class Margin(NamedTuple):
    """What was found along one key.

    Attributes:
        spans: the edges, from below; none where nothing changes, more than one where the scan saw islands.
        stable: where there is no edge, whether all that was decided is stable; None where nothing was.
        undecided: how many values stayed undecided.
        runs: how many values were run.
    """

    spans: tuple[Span, ...]
    stable: bool | None
    undecided: int
    runs: int


def margin(
    stable: Stable, low: float, high: float, tolerance: float = TOLERANCE, *, whole: bool = False
) -> Margin:
    """Returns the edges between two values.

    Args:
        stable: runs and judges one value.
        low: the first value of the range.
        high: the last one.
        tolerance: how wide an edge may be, over its value.
        whole: whether only whole numbers can be run.
    """
    known: dict[float, bool | None] = {}

    def ask(value: float) -> bool | None:
        if value not in known:
            known[value] = stable(value)
        return known[value]

    scan = np.linspace(low, high, SCANNED)
    values = list(dict.fromkeys((np.round(scan) if whole else scan).tolist()))
    decided = [value for value in values if ask(value) is not None]
    spans = tuple(
        _narrowed(ask, a, b, tolerance, whole) for a, b in pairwise(decided) if known[a] != known[b]
    )
    everywhere = known[decided[0]] if decided and not spans else None
    return Margin(spans, everywhere, sum(one is None for one in known.values()), len(known))


def _narrowed(ask: Stable, low: float, high: float, tolerance: float, whole: bool) -> Span:
    """Returns an edge between two values that were decided and differ, narrowed from both sides."""
    below = ask(low) is True
    side = {value: ask(value) for value in (low, high)}

    def is_low(value: float) -> bool:
        return ask(value) is side[first]

    def is_not_high(value: float) -> bool:
        return ask(value) is not side[last]

    first, last = low, high
    low, above = _halved(is_low, low, high, tolerance, whole)
    if ask(above) is not None:
        return Span(low, above, below, sharp=True)
    _, high = _halved(is_not_high, above, high, tolerance, whole)
    return Span(low, high, below, sharp=False)


def _halved(
    holds: Callable[[float], bool], low: float, high: float, tolerance: float, whole: bool
) -> tuple[float, float]:
    """Returns the last value at which something holds and the first at which it does not, by bisection."""
    for _ in range(_MOST):
        wide = high - low > (1.0 if whole else tolerance * max(abs(low), abs(high)))
        if not wide:
            break
        middle = 0.5 * (low + high)
        middle = float(np.floor(middle)) if whole else middle
        if holds(middle):
            low = middle
        else:
            high = middle
    return low, high
