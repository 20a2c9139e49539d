"""Estimation of the offset and drift of another clock, and the slewed offset in use.

The estimate uses time stamps of messages that crossed a network. A message is never received
before it was sent. With

    offset = other clock - local clock,

every message therefore limits the offset at one instant of the local clock:

    ceiling (local side sent):     offset <= other reading on receipt - local reading on sending
    floor   (local side received): offset >= other reading on sending - local reading on receipt

The stamps t1 (local sending), t2 (other receiving), t3 (other sending) and t4 (local receiving)
of one exchange give the ceiling t2 - t1 and the floor t3 - t4. Their mean is the classical
estimate of the offset, their difference the round trip, and half of that the error bound.

Each window keeps its lowest ceiling and its highest floor. These may come from different
exchanges, so the bound is half the shortest way out plus half the shortest way back. Over the
windows the offset is modelled as a straight line. The lines below all ceilings and above all
floors are admissible, and their spread at present is the bound.

Assumptions: two clocks drift apart by less than DRIFT_LIMIT, and along a line to within WANDER
over the windows that are kept.

Invariant:
    - The stamps prove every bound, for any delays, however unequal the two directions are.
    - The offset in use never steps: it is continuous and piecewise linear. It reaches each new
      estimate within SLEW_NS and then follows the estimate's drift.
    - The bound of the offset in use covers the estimate's interval also during the slew.
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
"""Excess over the tightest limit at which the weight of a limit falls to a quarter, in ns."""
_PRIOR_DRIFT = 100_000.0
"""Standard deviation of the drift's prior around 0, ns/s.

The prior decides only while the windows span less than a second.
"""
_WEIGHTING_ROUNDS = 3


class OffsetLimit(NamedTuple):
    """Upper limit (ceiling) or lower limit (floor) of an offset.

    Attributes:
        local_ns: the instant of the local clock for which the limit holds.
        offset_ns: the limit, in ns.
    """

    local_ns: int
    offset_ns: int


class OffsetEstimate(NamedTuple):
    """Estimate of the offset and drift of another clock against the local clock.

    Attributes:
        local_ns: the instant of the local clock for which the estimate holds.
        offset_ns: the other clock minus the local clock at that instant.
        drift: growth of the offset, ns/s.
        low_ns, high_ns: limits of the offset at that instant.
        drift_low, drift_high: limits of the drift, ns/s.
    """

    local_ns: int
    offset_ns: int
    drift: float
    low_ns: int
    high_ns: int
    drift_low: float
    drift_high: float

    def extrapolate_ns(self, local_ns: int) -> int:
        """Returns the estimated offset at another instant of the local clock, in ns."""
        return self.offset_ns + round((local_ns - self.local_ns) * self.drift / NS_PER_S)

    def widen(self, *limits: OffsetLimit | None) -> "OffsetEstimate":
        """Returns the estimate with its interval widened to include contradicting limits."""
        offsets = [limit.offset_ns for limit in limits if limit is not None]
        low_ns = min([self.low_ns, *offsets])
        high_ns = max([self.high_ns, *offsets])
        return self._replace(low_ns=low_ns, high_ns=high_ns)

    def error_bound_ns(self, local_ns: int, offset_ns: int) -> int:
        """Returns the largest possible error of a value of the offset, in ns.

        Args:
            local_ns: instant of the local clock.
            offset_ns: value that is used for the offset at that instant.
        """
        passed_s = (local_ns - self.local_ns) / NS_PER_S
        is_later = passed_s >= 0.0
        upper_drift = self.drift_high if is_later else self.drift_low
        lower_drift = self.drift_low if is_later else self.drift_high
        error_above = self.high_ns - offset_ns + passed_s * upper_drift
        error_below = offset_ns - self.low_ns - passed_s * lower_drift
        return max(0, math.ceil(max(error_above, error_below)))


def exact_offset(offset_ns: int) -> OffsetEstimate:
    """Returns the estimate of a constant offset that is known exactly.

    Two readings of one clock have such an offset.
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
    """Returns an offset and its error bound as text."""
    return f"offset {offset_ns / 1e9:.6f} s +- {-(-bound_ns // 1000)} us"


class OffsetEstimator:
    """Estimator of another clock's offset from the ceilings and floors of the latest windows.

    Attributes:
        broken: number of times at which the limits contradicted each other, so that the older
            limits were dropped. Then a clock has stepped, or was slewed by more than
            DRIFT_LIMIT.
    """

    def __init__(self) -> None:
        self.broken = 0
        self._ceilings: deque[OffsetLimit] = deque(maxlen=WINDOWS_KEPT)
        self._floors: deque[OffsetLimit] = deque(maxlen=WINDOWS_KEPT)

    def add(self, ceiling: OffsetLimit | None, floor: OffsetLimit | None) -> None:
        """Adds the limits of one window; None if no message arrived in that direction."""
        if ceiling is not None:
            self._ceilings.append(ceiling)
        if floor is not None:
            self._floors.append(floor)

    def estimate(self, now_ns: int) -> OffsetEstimate | None:
        """Returns the estimate for the present, or None if a direction has no limit yet.

        Args:
            now_ns: present reading of the local clock, not before the end of any window.
        """
        while self._ceilings and self._floors:
            lines = _AdmissibleLines(self._ceilings, self._floors, now_ns)
            if lines.exist:
                return lines.estimate()
            self.broken += 1
            kept_limits = max(len(self._ceilings), len(self._floors)) // 2
            for limits in (self._ceilings, self._floors):
                while len(limits) > kept_limits:
                    limits.popleft()
        return None


class _AdmissibleLines:
    """All straight lines below every ceiling and above every floor.

    Times are in s from the present, offsets in ns from the offset of the latest ceiling. The
    small numbers keep the precision that differences of 64-bit instants would lose.

    Attributes:
        exist: True if there is an admissible line.
        steepest, flattest: limits of the admissible slopes, ns/s.
    """

    def __init__(
        self, ceilings: deque[OffsetLimit], floors: deque[OffsetLimit], now_ns: int
    ) -> None:
        self._now_ns = now_ns
        self._base_ns = ceilings[-1].offset_ns
        self._ceiling_times_s, self._ceilings = self._read_columns(ceilings)
        self._floor_times_s, self._floors = self._read_columns(floors)
        # Times are negative: each limit is relaxed by WANDER for every second of its age.
        self._relaxed_ceilings = self._ceilings - WANDER * self._ceiling_times_s
        self._relaxed_floors = self._floors + WANDER * self._floor_times_s
        intervals_s = self._ceiling_times_s[:, None] - self._floor_times_s[None, :]
        gaps = self._relaxed_ceilings[:, None] - self._relaxed_floors[None, :]
        slopes = np.divide(gaps, intervals_s, out=np.zeros_like(gaps), where=intervals_s != 0.0)
        # A ceiling after a floor limits the slope from above, a ceiling before a floor limits
        # the slope from below.
        steepest = np.min(slopes, where=intervals_s > 0.0, initial=DRIFT_LIMIT)
        flattest = np.max(slopes, where=intervals_s < 0.0, initial=-DRIFT_LIMIT)
        self.steepest = float(steepest)
        self.flattest = float(flattest)
        simultaneous_gap = np.min(gaps, where=intervals_s == 0.0, initial=0.0)
        self.exist = bool(simultaneous_gap >= 0.0 and self.flattest <= self.steepest)

    def _read_columns(self, limits: deque[OffsetLimit]) -> tuple[Array, Array]:
        """Returns the times (s from now) and the offsets (ns from the base) of limits."""
        times_ns = [min(0, limit.local_ns - self._now_ns) for limit in limits]
        offsets_ns = [limit.offset_ns - self._base_ns for limit in limits]
        times_s = np.array(times_ns, dtype=np.float64) / NS_PER_S
        return times_s, np.array(offsets_ns, dtype=np.float64)

    def estimate(self) -> OffsetEstimate:
        """Returns the line in the middle, with the spread of all admissible lines now."""
        slope = min(max(self._estimate_slope(), self.flattest), self.steepest)
        lowest_ceiling = np.min(self._relaxed_ceilings - slope * self._ceiling_times_s)
        highest_floor = np.max(self._relaxed_floors - slope * self._floor_times_s)
        middle = 0.5 * (lowest_ceiling + highest_floor)
        # The present lies after every limit: the steepest line has the highest value there, and
        # the flattest line the lowest.
        high = np.min(self._relaxed_ceilings - self.steepest * self._ceiling_times_s)
        low = np.max(self._relaxed_floors - self.flattest * self._floor_times_s)
        return OffsetEstimate(
            local_ns=self._now_ns,
            offset_ns=self._base_ns + round(middle),
            drift=slope,
            low_ns=self._base_ns + int(np.floor(low)),
            high_ns=self._base_ns + int(np.ceil(high)),
            drift_low=self.flattest - WANDER,
            drift_high=self.steepest + WANDER,
        )

    def _estimate_slope(self) -> float:
        """Returns the drift: weighted least squares of one slope for ceilings and floors, ns/s.

        A window of slow messages has little information, so the weight of a limit falls with
        its distance from the tightest limit. The distance depends on the slope, so each round
        computes new weights (iteratively reweighted least squares).
        """
        sides = (
            (self._ceiling_times_s, self._ceilings, 1.0),
            (self._floor_times_s, self._floors, -1.0),
        )
        slope = 0.0
        prior_weight = _PRIOR_DRIFT**-2
        for round_index in range(_WEIGHTING_ROUNDS):
            numerator = 0.0
            denominator = prior_weight
            for times, values, sign in sides:
                distance = sign * (values - slope * times)
                # In the first round the slope is unknown, so that all weights are equal.
                excess = distance - distance.min() if round_index else np.zeros_like(distance)
                weights = (excess + _NOISE_NS) ** -2.0
                mean_time = (weights * times).sum() / weights.sum()
                from_mean = times - mean_time
                numerator += float((weights * from_mean * values).sum())
                denominator += float((weights * from_mean**2).sum())
            slope = numerator / denominator
        return slope


SLEW_NS = 1_000_000_000
"""Time in which the offset in use reaches a new estimate, in ns."""


class _SlewSegment:
    """The offset in use from one instant on: a slew to an estimate, then along the estimate.

    Args:
        start_ns: instant of the local clock at which the slew begins.
        offset_ns: offset in use at that instant.
        estimate: the estimate to reach within SLEW_NS.

    Attributes:
        bound_ns: largest error of the offset in use during the slew.
    """

    def __init__(self, start_ns: int, offset_ns: int, estimate: OffsetEstimate) -> None:
        self.start_ns = start_ns
        self.estimate = estimate
        self._joined_ns = start_ns + SLEW_NS
        self._joined_offset_ns = estimate.extrapolate_ns(self._joined_ns)
        self._approach_rate = (self._joined_offset_ns - offset_ns) / SLEW_NS
        self._drift_per_ns = estimate.drift / NS_PER_S
        # The bound is convex over the slew, so the largest bound is at one of the two ends.
        start_bound_ns = estimate.error_bound_ns(start_ns, offset_ns)
        joined_bound_ns = estimate.error_bound_ns(self._joined_ns, self._joined_offset_ns)
        self.bound_ns = max(start_bound_ns, joined_bound_ns)

    def evaluate_ns(self, local_ns: int) -> int:
        """Returns the offset in use at an instant of the local clock, in ns."""
        passed_ns = local_ns - self._joined_ns
        rate = self._approach_rate if passed_ns < 0 else self._drift_per_ns
        return self._joined_offset_ns + int(passed_ns * rate)

    def error_bound_ns(self, local_ns: int) -> int:
        """Returns the largest possible error of the offset in use at an instant, in ns."""
        if self.start_ns <= local_ns <= self._joined_ns:
            return self.bound_ns
        return self.estimate.error_bound_ns(local_ns, self.evaluate_ns(local_ns))


class SlewedOffset:
    """The offset in use over time: the other clock minus the local clock, without steps.

    Args:
        estimate: the first estimate, which the offset equals at first.
    """

    def __init__(self, estimate: OffsetEstimate) -> None:
        segment = _SlewSegment(estimate.local_ns, estimate.offset_ns, estimate)
        self._segment = segment
        self._previous_segment = segment

    @property
    def estimate(self) -> OffsetEstimate:
        """The estimate to which the offset slews."""
        return self._segment.estimate

    @property
    def bound_ns(self) -> int:
        """Largest error of the offset during SLEW_NS from the last `slew_to`; then it grows."""
        return self._segment.bound_ns

    def slew_to(self, local_ns: int, estimate: OffsetEstimate) -> None:
        """Starts to slew to a new estimate at an instant of the local clock."""
        segment = _SlewSegment(local_ns, self.evaluate_ns(local_ns), estimate)
        self._previous_segment = self._segment
        self._segment = segment

    def evaluate_ns(self, local_ns: int) -> int:
        """Returns the offset in use at an instant of the local clock, in ns.

        The instant must not precede the last call but one of `slew_to`.
        """
        return self._select_segment(local_ns).evaluate_ns(local_ns)

    def error_bound_ns(self, local_ns: int) -> int:
        """Returns the largest possible error of the offset in use at an instant, in ns.

        The instant must not precede the last call but one of `slew_to`.
        """
        return self._select_segment(local_ns).error_bound_ns(local_ns)

    def _select_segment(self, local_ns: int) -> _SlewSegment:
        """Returns the segment that holds at an instant of the local clock."""
        if local_ns >= self._segment.start_ns:
            return self._segment
        return self._previous_segment
