"""Offset and drift of another clock, estimated from stamps that crossed a network, and the
slewed offset.

Invariant: stamps prove every bound, for any delays, however unequal the two directions. A
message is never received before it was sent, so with offset = other clock - own clock

    offset <= (their reading on receiving) - (own reading on sending): a ceiling, when the own
    clock sent; offset >= (their reading on sending) - (own reading on receiving): a floor, when
    the own clock received.

A ceiling and a floor of one exchange t1..t4 are the classical (t2 - t1) and (t3 - t4): their
mean is the offset, their distance the round trip, half of that the bound. Each window keeps its
lowest ceiling and its highest floor; these may come from different exchanges, so the bound is
half the shortest way out plus half the shortest way back. Over the windows the offset is a
line; the lines through all ceilings and floors are admissible, and their spread now is the
bound. Assumed: clocks drift apart by less than DRIFT_LIMIT, and over the kept windows along a
line to within WANDER.

The offset in use never steps: it is continuous and piecewise linear, reaches each new estimate
within SLEW_NS and then follows the estimate's drift. Its bound covers the estimate's interval
also on the way.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from ..core.ticks import NS_PER_S
from ..core.vectors import Array

WINDOWS_KEPT = 60
DRIFT_LIMIT = 500_000.0
"""Largest drift of one clock against another, ns/s."""
WANDER = 1_000.0
"""Largest deviation of the drift from its mean over the windows kept, ns/s."""
_NOISE_NS = 3_000.0
_PRIOR = 100_000.0  # of the drift, ns/s: decides only while the windows span less than a second
_ROUNDS = 3


class OffsetLimit(NamedTuple):
    """Upper limit (ceiling) or lower limit (floor) of an offset at an instant of the own clock."""

    local_ns: int
    offset_ns: int


class OffsetEstimate(NamedTuple):
    """Another clock minus the own one at an instant of the own, and its growth, ns/s, with
    their limits.
    """

    local_ns: int
    offset_ns: int
    drift: float
    low_ns: int
    high_ns: int
    drift_low: float
    drift_high: float

    def extrapolate_ns(self, at_ns: int) -> int:
        """Returns the offset at another instant, ns."""
        return self.offset_ns + round((at_ns - self.local_ns) * self.drift / NS_PER_S)

    def widen(self, *limits: OffsetLimit | None) -> "OffsetEstimate":
        """Returns the same, widened to include limits that contradict it."""
        offsets = [limit.offset_ns for limit in limits if limit is not None]
        return self._replace(
            low_ns=min([self.low_ns, *offsets]), high_ns=max([self.high_ns, *offsets])
        )

    def error_bound_ns(self, at_ns: int, offset_ns: int) -> int:
        """Returns the largest distance of the offset from a value at another instant, ns."""
        passed_s = (at_ns - self.local_ns) / NS_PER_S
        up = self.drift_high
        down = self.drift_low
        if passed_s < 0.0:
            up, down = down, up
        above = self.high_ns - offset_ns + passed_s * up
        below = offset_ns - self.low_ns - passed_s * down
        return max(0, math.ceil(max(above, below)))


def exact_offset(offset_ns: int) -> OffsetEstimate:
    """Returns the estimate of an offset that is exact for ever, as of two readings of one
    clock.
    """
    return OffsetEstimate(
        local_ns=0,
        offset_ns=offset_ns,
        drift=0.0,
        low_ns=offset_ns,
        high_ns=offset_ns,
        drift_low=0.0,
        drift_high=0.0,
    )


def format_offset(offset_ns: int, bound_ns: int) -> str:
    """Returns an offset and its bound as text."""
    return f"offset {offset_ns / 1e9:.6f} s +- {-(-bound_ns // 1000)} us"


class OffsetEstimator:
    """The ceilings and floors of one clock, and the line between them.

    Attributes:
        broken: how often the limits contradicted each other, so that the older ones were
            dropped: a clock stepped, or was slewed harder than DRIFT_LIMIT.
    """

    def __init__(self) -> None:
        self.broken = 0
        self._ceilings: deque[OffsetLimit] = deque(maxlen=WINDOWS_KEPT)
        self._floors: deque[OffsetLimit] = deque(maxlen=WINDOWS_KEPT)

    def add(self, ceiling: OffsetLimit | None, floor: OffsetLimit | None) -> None:
        """Takes the limits of one window; None if nothing arrived in that direction."""
        if ceiling is not None:
            self._ceilings.append(ceiling)
        if floor is not None:
            self._floors.append(floor)

    def estimate(self, now_ns: int) -> OffsetEstimate | None:
        """Returns the estimate now, at or after every window; None while one direction has no
        limit.
        """
        while self._ceilings and self._floors:
            lines = _Lines(self._ceilings, self._floors, now_ns)
            if lines.possible:
                return lines.estimate()
            self.broken += 1
            kept = max(len(self._ceilings), len(self._floors)) // 2
            for limits in (self._ceilings, self._floors):
                while len(limits) > kept:
                    limits.popleft()
        return None


class _Lines:
    """All lines under every ceiling and over every floor; times are s from now, values ns from
    a base.
    """

    def __init__(
        self, ceilings: deque[OffsetLimit], floors: deque[OffsetLimit], now_ns: int
    ) -> None:
        self._now_ns = now_ns
        self._base_ns = ceilings[-1].offset_ns
        self._above_s, self._above = self._columns(ceilings)
        self._below_s, self._below = self._columns(floors)
        self._widest = self._above - WANDER * self._above_s
        self._lowest = self._below + WANDER * self._below_s
        apart_s = self._above_s[:, None] - self._below_s[None, :]
        room = self._widest[:, None] - self._lowest[None, :]
        slopes = np.divide(room, apart_s, out=np.zeros_like(room), where=apart_s != 0.0)
        self.steepest = float(np.min(slopes, where=apart_s > 0.0, initial=DRIFT_LIMIT))
        self.flattest = float(np.max(slopes, where=apart_s < 0.0, initial=-DRIFT_LIMIT))
        touching = np.min(room, where=apart_s == 0.0, initial=0.0)
        self.possible = bool(touching >= 0.0 and self.flattest <= self.steepest)

    def _columns(self, limits: deque[OffsetLimit]) -> tuple[Array, Array]:
        times = np.array(
            [min(0, limit.local_ns - self._now_ns) for limit in limits], dtype=np.float64
        )
        values = np.array(
            [limit.offset_ns - self._base_ns for limit in limits], dtype=np.float64
        )
        return times / NS_PER_S, values

    def estimate(self) -> OffsetEstimate:
        """Returns the line in the middle, and the span of all lines now."""
        slope = min(max(self._slope(), self.flattest), self.steepest)
        middle = 0.5 * (
            np.min(self._widest - slope * self._above_s)
            + np.max(self._lowest - slope * self._below_s)
        )
        # now lies behind every limit: the highest value is the steepest line's, the lowest the flattest's
        high = np.min(self._widest - self.steepest * self._above_s)
        low = np.max(self._lowest - self.flattest * self._below_s)
        return OffsetEstimate(
            local_ns=self._now_ns,
            offset_ns=self._base_ns + round(middle),
            drift=slope,
            low_ns=self._base_ns + int(np.floor(low)),
            high_ns=self._base_ns + int(np.ceil(high)),
            drift_low=self.flattest - WANDER,
            drift_high=self.steepest + WANDER,
        )

    def _slope(self) -> float:
        """Returns the drift: least squares of one slope for ceilings and floors.

        A window of slow messages tells little: its weight falls with its distance from the best
        one, which depends on the slope, hence some rounds.
        """
        slope = 0.0
        drift_weight = _PRIOR**-2
        for n in range(_ROUNDS):
            numerator = 0.0
            denominator = drift_weight
            for times, values, side in (
                (self._above_s, self._above, 1.0),
                (self._below_s, self._below, -1.0),
            ):
                level = side * (values - slope * times)
                excess = (level - level.min()) if n else np.zeros_like(level)
                weights = (excess + _NOISE_NS) ** -2.0
                total = weights.sum()
                from_mean = times - (weights * times).sum() / total
                numerator += float((weights * from_mean * values).sum())
                denominator += float((weights * from_mean**2).sum())
            slope = numerator / denominator
        return slope


SLEW_NS = 1_000_000_000
"""Time to reach a new estimate."""


class _SlewSegment:
    """The slew from an instant and a value to one estimate, and on along it."""

    def __init__(self, from_ns: int, offset_ns: int, estimate: OffsetEstimate) -> None:
        self.from_ns = from_ns
        self.estimate = estimate
        self._joined_ns = from_ns + SLEW_NS
        self._joined_offset_ns = estimate.extrapolate_ns(self._joined_ns)
        self._approach = (self._joined_offset_ns - offset_ns) / SLEW_NS
        self._drift = estimate.drift / NS_PER_S
        self.bound_ns = max(
            estimate.error_bound_ns(from_ns, offset_ns),
            estimate.error_bound_ns(self._joined_ns, self._joined_offset_ns),
        )

    def evaluate_ns(self, at_ns: int) -> int:
        passed_ns = at_ns - self._joined_ns
        return self._joined_offset_ns + int(
            passed_ns * (self._approach if passed_ns < 0 else self._drift)
        )

    def error_bound_ns(self, at_ns: int) -> int:
        if self.from_ns <= at_ns <= self._joined_ns:
            return self.bound_ns
        return self.estimate.error_bound_ns(at_ns, self.evaluate_ns(at_ns))


class SlewedOffset:
    """The offset in use over time, the other clock minus the own one."""

    def __init__(self, estimate: OffsetEstimate) -> None:
        self._segment = self._before = _SlewSegment(
            estimate.local_ns, estimate.offset_ns, estimate
        )

    @property
    def estimate(self) -> OffsetEstimate:
        """The estimate that it slews to."""
        return self._segment.estimate

    @property
    def bound_ns(self) -> int:
        """Its largest error, for SLEW_NS from the last `slew_to` on; then it grows."""
        return self._segment.bound_ns

    def slew_to(self, at_ns: int, estimate: OffsetEstimate) -> None:
        """Slews to a new estimate from an instant of the own clock on."""
        segment = _SlewSegment(at_ns, self.evaluate_ns(at_ns), estimate)
        self._before = self._segment
        self._segment = segment

    def evaluate_ns(self, at_ns: int) -> int:
        """Returns the offset at an instant, not before the last but one `slew_to`, ns."""
        segment = self._segment
        return (
            segment.evaluate_ns(at_ns)
            if at_ns >= segment.from_ns
            else self._before.evaluate_ns(at_ns)
        )

    def error_bound_ns(self, at_ns: int) -> int:
        """Returns its largest error at such an instant, ns."""
        segment = self._segment
        return (
            segment.error_bound_ns(at_ns)
            if at_ns >= segment.from_ns
            else self._before.error_bound_ns(at_ns)
        )
