"""Estimates the offset and drift between the clocks of two machines from message time stamps.

Delays between two machines can be measured only if the offset between their clocks is known. A
message cannot be received before it was sent. With

    offset = other clock - local clock,

each message therefore limits the offset at one time of the local clock:

    ceiling (sent locally):     offset <= other time of receipt - local time of sending
    floor   (received locally): offset >= other time of sending - local time of receipt

In an exchange with the stamps t1 (local sending), t2 (other receipt), t3 (other sending) and t4
(local receipt), the ceiling is t2 - t1 and the floor is t3 - t4. Their mean is the classical
estimate of the offset, as used by NTP. Their difference is the round trip time, and half of the
difference is the error bound.

The time stamps are divided into windows. Only the lowest ceiling and the highest floor of each
window are kept, which may come from different exchanges. The error bound is therefore half of
the shortest delay in one direction plus half of the shortest delay in the other. Across the
windows, the offset is modelled as a straight line. Every line below all ceilings and above all
floors is admissible, and the present values of the admissible lines form the range of the
offset.

Assumptions: the clocks drift apart by less than DRIFT_LIMIT, and their drift deviates from its
mean by less than WANDER over the stored windows.

Invariant:
    - Each error bound follows from the time stamps alone, however long the delays are and
      however much they differ between the two directions. The network is not assumed to be
      symmetric.
    - Delays are computed with a smoothed offset (`SlewedOffset`) that never steps, because a
      step would appear as a jump in all delays. The smoothed offset reaches each new estimate
      within SLEW_NS, and then follows the estimated drift.
    - The error bound of the smoothed offset also holds while the offset is still approaching a
      new estimate.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..records import NS_PER_S

_Array = NDArray[np.float64]

WINDOWS_KEPT = 60
"""Number of windows whose limits are stored."""
DRIFT_LIMIT = 500_000.0
"""Maximum drift between two clocks, in ns/s."""
WANDER = 1_000.0
"""Maximum deviation of the drift from its mean over the stored windows, in ns/s."""
_NOISE_NS = 3_000.0
"""Distance from the tightest limit at which the weight of a limit drops to a quarter, in ns."""
_PRIOR_DRIFT = 100_000.0
"""Standard deviation of the drift expected before any measurement, in ns/s.

It only matters while the windows span less than a second.
"""
_WEIGHTING_ROUNDS = 3
"""Number of iterations of the reweighted least squares. Three are enough in practice."""


class OffsetLimit(NamedTuple):
    """Limit on the offset between two clocks, derived from the time stamps of one message.

    A message cannot arrive before it was sent. A message in one direction therefore gives an
    upper limit (ceiling), and one in the other direction a lower limit (floor).

    Attributes:
        local_ns: Time on the local clock at which the limit holds, in ns.
        offset_ns: The limit on the offset (other clock minus local clock), in ns.
    """

    local_ns: int
    offset_ns: int


class OffsetEstimate(NamedTuple):
    """Estimate of how far another clock is ahead of the local clock, and of its drift.

    Attributes:
        local_ns: Time on the local clock for which the estimate holds, in ns.
        offset_ns: The other clock minus the local clock at that time, in ns.
        drift: Growth of the offset, in ns/s.
        low_ns, high_ns: Limits on the offset at that time, in ns.
        drift_low, drift_high: Limits on the drift, in ns/s.
    """

    local_ns: int
    offset_ns: int
    drift: float
    low_ns: int
    high_ns: int
    drift_low: float
    drift_high: float

    def extrapolate_ns(self, local_ns: int) -> int:
        """Extrapolates the estimated offset to another time, in ns, assuming a constant drift.

        Args:
            local_ns: Time on the local clock, in ns.
        """
        return self.offset_ns + round((local_ns - self.local_ns) * self.drift / NS_PER_S)

    def widen(self, *limits: OffsetLimit | None) -> "OffsetEstimate":
        """Extends the range of possible offsets to include additional limits.

        Args:
            *limits: Upper and lower limits on the true offset, from the time stamps of
                messages. Limits that are None are ignored.

        Returns:
            A new estimate with the same offset and drift, whose range from `low_ns` to
            `high_ns` includes all given limits.
        """
        offsets = [limit.offset_ns for limit in limits if limit is not None]
        low_ns = min([self.low_ns, *offsets])
        high_ns = max([self.high_ns, *offsets])
        return self._replace(low_ns=low_ns, high_ns=high_ns)

    def error_bound_ns(self, local_ns: int, offset_ns: int) -> int:
        """Returns how far an assumed offset can be from the true offset at a given time, in ns.

        The true offset lies between the limits of this estimate, which widen with the distance
        from the time of the estimate.

        Args:
            local_ns: Time on the local clock, in ns.
            offset_ns: Assumed offset at that time (other clock minus local clock), in ns.
        """
        passed_s = (local_ns - self.local_ns) / NS_PER_S
        # Before the time of the estimate, a smaller drift gives a larger offset.
        is_later = passed_s >= 0.0
        upper_drift = self.drift_high if is_later else self.drift_low
        lower_drift = self.drift_low if is_later else self.drift_high
        error_above = self.high_ns - offset_ns + passed_s * upper_drift
        error_below = offset_ns - self.low_ns - passed_s * lower_drift
        return max(0, math.ceil(max(error_above, error_below)))

    @classmethod
    def exact(cls, offset_ns: int) -> "OffsetEstimate":
        """Returns the estimate for a constant offset that is known exactly.

        Used when two readings come from the same clock.

        Args:
            offset_ns: The offset (other clock minus local clock), in ns.
        """
        return cls(
            local_ns=0,
            offset_ns=offset_ns,
            drift=0.0,
            low_ns=offset_ns,
            high_ns=offset_ns,
            drift_low=0.0,
            drift_high=0.0,
        )


def format_offset(offset_ns: int, bound_ns: int) -> str:
    """Formats a clock offset and its error bound as a short string with units.

    Args:
        offset_ns: The offset, in ns.
        bound_ns: Largest possible error of the offset, in ns.
    """
    return f"offset {offset_ns / 1e9:.6f} s +- {-(-bound_ns // 1000)} us"


class OffsetEstimator:
    """Estimates the offset of another clock from the limits of the most recent windows.

    Each time window contributes the lowest upper limit (ceiling) and the highest lower limit
    (floor) of its messages.

    Attributes:
        broken: Number of times that the limits contradicted each other and the older half of
            them was discarded. A contradiction shows that a clock has stepped, or has drifted
            by more than DRIFT_LIMIT.
    """

    def __init__(self) -> None:
        self.broken = 0
        self._ceilings: deque[OffsetLimit] = deque(maxlen=WINDOWS_KEPT)
        self._floors: deque[OffsetLimit] = deque(maxlen=WINDOWS_KEPT)

    def add(self, ceiling: OffsetLimit | None, floor: OffsetLimit | None) -> None:
        """Adds the tightest limits on the offset from one time window.

        A message sent by this machine gives an upper limit (ceiling), and a message received by
        this machine gives a lower limit (floor).

        Args:
            ceiling: Lowest upper limit in the window. None if the other machine acknowledged no
                message from this machine.
            floor: Highest lower limit in the window. None if no message from the other machine
                arrived.
        """
        if ceiling is not None:
            self._ceilings.append(ceiling)
        if floor is not None:
            self._floors.append(floor)

    def estimate(self, now_ns: int) -> OffsetEstimate | None:
        """Estimates the present offset of the other clock.

        The offset is modelled as a straight line over time, below every stored ceiling and
        above every stored floor. If no such line exists, a clock has stepped, and the older
        limits date from before the step. The older half of the limits is then discarded,
        repeatedly if necessary, until a line exists.

        Args:
            now_ns: Present time on the local clock, in ns. It must not be earlier than any of
                the stored limits.

        Returns:
            The estimate, or None if there is no ceiling or no floor, since the offset is then
            bounded on one side at most.
        """
        while self._ceilings and self._floors:
            lines = _AdmissibleLines(self._ceilings, self._floors, now_ns)
            if lines.exist:
                return lines.estimate()

            self.broken += 1
            kept_limits = max(len(self._ceilings), len(self._floors)) // 2
            for limits in (self._ceilings, self._floors):
                while len(limits) > kept_limits:
                    limits.popleft()  # the oldest
        return None


class _AdmissibleLines:
    """All straight lines for the offset over time below every ceiling and above every floor.

    The ceilings and floors are the limits on the offset derived from the time stamps. The set
    of lines is described by its steepest and its flattest line.

    Times are in s relative to the present, and offsets in ns relative to the latest ceiling.
    These small values keep the precision that floating-point arithmetic would lose on 64-bit
    times.

    Args:
        ceilings: Lowest ceiling of each window.
        floors: Highest floor of each window.
        now_ns: Present time on the local clock, in ns.

    Attributes:
        exist: True if there is an admissible line.
        steepest, flattest: Largest and smallest slope of an admissible line, in ns/s.
    """

    def __init__(
        self, ceilings: deque[OffsetLimit], floors: deque[OffsetLimit], now_ns: int
    ) -> None:
        """Computes the steepest and the flattest line that the limits on a clock offset allow.

        A line describes a possible course of the offset over time. Its slope is the drift of
        the clock.
        """
        self._now_ns = now_ns
        self._base_ns = ceilings[-1].offset_ns
        self._ceiling_times_s, self._ceilings = self._read_columns(ceilings)
        self._floor_times_s, self._floors = self._read_columns(floors)
        # Times are negative: each limit is relaxed by WANDER for every second of its age.
        self._relaxed_ceilings = self._ceilings - WANDER * self._ceiling_times_s
        self._relaxed_floors = self._floors + WANDER * self._floor_times_s

        # Slope of the line through each pair of a ceiling (row) and a floor (column). A line
        # below the ceiling and above the floor has at most this slope if the ceiling is later
        # than the floor, and at least this slope if the ceiling is earlier.
        intervals_s = self._ceiling_times_s[:, None] - self._floor_times_s[None, :]
        gaps = self._relaxed_ceilings[:, None] - self._relaxed_floors[None, :]
        slopes = np.divide(gaps, intervals_s, out=np.zeros_like(gaps), where=intervals_s != 0.0)
        is_later = intervals_s > 0.0
        is_earlier = intervals_s < 0.0
        self.steepest = float(np.min(slopes, where=is_later, initial=DRIFT_LIMIT))
        self.flattest = float(np.max(slopes, where=is_earlier, initial=-DRIFT_LIMIT))

        # At the same time, the ceiling must not be below the floor.
        simultaneous_gap = np.min(gaps, where=intervals_s == 0.0, initial=0.0)
        self.exist = bool(simultaneous_gap >= 0.0 and self.flattest <= self.steepest)

    def _read_columns(self, limits: deque[OffsetLimit]) -> tuple[_Array, _Array]:
        """Converts limits on the offset to arrays of small numbers, for precise arithmetic.

        Args:
            limits: Ceilings or floors.

        Returns:
            The time of each limit in s relative to the present, which is never positive, and
            its offset in ns relative to the latest ceiling.
        """
        times_ns = [min(0, limit.local_ns - self._now_ns) for limit in limits]
        offsets_ns = [limit.offset_ns - self._base_ns for limit in limits]
        times_s = np.array(times_ns, dtype=np.float64) / NS_PER_S
        return times_s, np.array(offsets_ns, dtype=np.float64)

    def estimate(self) -> OffsetEstimate:
        """Estimates the offset from all straight lines consistent with the time stamps.

        A line describes the offset between the clocks over time. Let t be the time in s
        relative to the present, so that t <= 0 for all limits. The line

            offset(t) = v + slope t

        has the present value v. It is admissible if it lies below every ceiling c at its time
        t_c, and above every floor f at its time t_f:

            f - slope t_f <= v <= c - slope t_c.

        Because the drift is not exactly constant, ceilings and floors are first moved apart by
        `WANDER` per second of their age. The most probable slope is computed next. The
        estimated offset is the middle of the admissible values v for that slope. The limits of
        the estimate cover all admissible lines.

        Returns:
            The estimate for the present time.
        """
        slope = min(max(self._estimate_slope(), self.flattest), self.steepest)
        # Largest and smallest permitted value v for this slope.
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
        """Estimates the drift in ns/s by weighted least squares, with one slope for all limits.

        The ceilings and the floors have different levels but the same slope,

            slope = sum w (t - t_mean) offset / (sum w (t - t_mean)^2 + 1 / prior^2),

        where both sums extend over all ceilings and floors, w is the weight of a limit, t is
        its time, t_mean is the weighted mean time of its group, and prior is the standard
        deviation of the drift before any measurement.

        A limit from a slow message contains little information, so its weight decreases with
        its distance from the tightest limit of the group. Because this distance depends on the
        slope, the weights are recomputed in each round (iteratively reweighted least squares).
        In the first round, all weights are equal.

        Returns:
            The drift, in ns/s.
        """
        slope = 0.0
        prior_weight = _PRIOR_DRIFT**-2
        # The sign is 1 if the tightest limit of the group is the lowest, -1 if the highest.
        groups = (
            (self._ceiling_times_s, self._ceilings, 1.0),
            (self._floor_times_s, self._floors, -1.0),
        )

        for round_index in range(_WEIGHTING_ROUNDS):
            numerator = 0.0
            denominator = prior_weight
            for times, values, sign in groups:
                level = sign * (values - slope * times)
                excess = (level - level.min()) if round_index else np.zeros_like(level)
                weights = (excess + _NOISE_NS) ** -2.0
                mean_time = (weights * times).sum() / weights.sum()
                from_mean = times - mean_time
                numerator += float((weights * from_mean * values).sum())
                denominator += float((weights * from_mean**2).sum())
            slope = numerator / denominator
        return slope


SLEW_NS = 1_000_000_000
"""Time within which the smoothed offset reaches a new estimate, in ns."""


class _SlewSegment:
    """Smoothed offset of another clock from one estimate to the next, as two straight lines.

    The first line leads from the previous value of the offset to the estimate within SLEW_NS.
    The second line follows the estimate and its drift.

    Args:
        start_ns: Time on the local clock at which the segment begins, in ns.
        offset_ns: Smoothed offset at that time, in ns.
        estimate: The estimate.

    Attributes:
        start_ns: Time on the local clock at which the segment begins, in ns.
        estimate: The estimate.
        bound_ns: Largest error of the smoothed offset until it has reached the estimate, in ns.
    """

    def __init__(self, start_ns: int, offset_ns: int, estimate: OffsetEstimate) -> None:
        """Computes how the smoothed offset gradually approaches an estimate.

        The largest error during the transition is computed too.
        """
        self.start_ns = start_ns
        self.estimate = estimate
        # Time at which the smoothed offset has reached (joined) the line of the estimate.
        self._joined_ns = start_ns + SLEW_NS
        self._joined_offset_ns = estimate.extrapolate_ns(self._joined_ns)
        self._approach_rate = (self._joined_offset_ns - offset_ns) / SLEW_NS
        self._drift_per_ns = estimate.drift / NS_PER_S
        # The bound is a convex function of time on the first line: it is largest at an end.
        start_bound_ns = estimate.error_bound_ns(start_ns, offset_ns)
        joined_bound_ns = estimate.error_bound_ns(self._joined_ns, self._joined_offset_ns)
        self.bound_ns = max(start_bound_ns, joined_bound_ns)

    def evaluate_ns(self, local_ns: int) -> int:
        """Returns the smoothed offset (other clock minus local clock) at a given time, in ns.

        It approaches its estimate gradually, because a jump would disturb the control loop.

        Args:
            local_ns: Time on the local clock, in ns.
        """
        passed_ns = local_ns - self._joined_ns
        rate = self._approach_rate if passed_ns < 0 else self._drift_per_ns
        return self._joined_offset_ns + int(passed_ns * rate)

    def error_bound_ns(self, local_ns: int) -> int:
        """Returns the largest possible error of the smoothed offset at a given time, in ns.

        The error is the difference between the smoothed offset and the true offset (other clock
        minus local clock). Until `SLEW_NS` after the start of the segment, while the smoothed
        offset is still approaching the estimate, the result is `bound_ns`, the largest error in
        that phase. Afterwards, it is the largest distance of the smoothed offset from any
        offset that the estimate admits at that time.

        Args:
            local_ns: Time on the local clock, in ns.
        """
        is_approaching = self.start_ns <= local_ns <= self._joined_ns
        if is_approaching:
            return self.bound_ns
        smoothed_offset_ns = self.evaluate_ns(local_ns)
        return self.estimate.error_bound_ns(local_ns, smoothed_offset_ns)


class SlewedOffset:
    """Offset between two clocks (other clock minus local clock) that changes without steps.

    Delays are computed with this offset and not with the latest estimate, because each new
    estimate would appear as a step in all delays. The smoothed offset instead approaches each
    estimate along a straight line. Two segments are stored, for the latest estimate and the one
    before it, so the offset is defined only from the start of the earlier segment onwards.

    Args:
        estimate: First estimate. The smoothed offset equals it from the beginning.
    """

    def __init__(self, estimate: OffsetEstimate) -> None:
        segment = _SlewSegment(estimate.local_ns, estimate.offset_ns, estimate)
        self._segment = segment
        self._previous_segment = segment

    @property
    def estimate(self) -> OffsetEstimate:
        """Latest estimate of the offset between two clocks.

        The smoothed offset approaches this estimate gradually, because a jump would disturb the
        control loop.
        """
        return self._segment.estimate

    @property
    def bound_ns(self) -> int:
        """Largest error of the smoothed offset while it approaches the latest estimate, in ns.

        Afterwards, the possible error grows with the age of the estimate. `error_bound_ns`
        gives the error bound for any time.
        """
        return self._segment.bound_ns

    def slew_to(self, local_ns: int, estimate: OffsetEstimate) -> None:
        """Makes the offset approach a new estimate gradually, instead of jumping to it.

        The offset reaches the estimate after SLEW_NS, and then follows its drift.

        Args:
            local_ns: Time on the local clock at which the transition begins, in ns.
            estimate: The new estimate.
        """
        segment = _SlewSegment(local_ns, self.evaluate_ns(local_ns), estimate)
        self._previous_segment = self._segment
        self._segment = segment

    def evaluate_ns(self, local_ns: int) -> int:
        """Returns the smoothed clock offset at a given time (other minus local clock), in ns.

        Args:
            local_ns: Time on the local clock, in ns. It must not be earlier than the start of
                the earlier stored segment, when the offset began to approach the second latest
                estimate.
        """
        return self._select_segment(local_ns).evaluate_ns(local_ns)

    def error_bound_ns(self, local_ns: int) -> int:
        """Returns the largest possible error of the smoothed offset at a given time, in ns.

        Args:
            local_ns: Time on the local clock, in ns, subject to the same limit as in
                `evaluate_ns`.
        """
        return self._select_segment(local_ns).error_bound_ns(local_ns)

    def _select_segment(self, local_ns: int) -> _SlewSegment:
        """Returns the segment of the smoothed offset that applies at a local time.

        There are two segments: the approach to the latest estimate, and the previous segment
        for earlier times.
        """
        if local_ns >= self._segment.start_ns:
            return self._segment
        return self._previous_segment
