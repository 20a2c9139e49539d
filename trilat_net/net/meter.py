"""What the stamps on one link say: one-way delays, round trips, and where the peer's clock stands.

Law: measuring changes no number of a run. A stamp that cannot be right is counted, and its sample is used.

Four stamps make a round trip: own sending (t1) and the peer's arrival (t2) of the record that the peer
echoes, the peer's sending (t3) and own arrival (t4) of the record that carries the echo.
"""

from typing import NamedTuple

from .course import Course
from .messages import Sample
from .offset import Estimate, Limit, OffsetEstimator

WINDOW_NS = 1_000_000_000
FIRST_WINDOW_NS = 100_000_000
FIRST_WINDOWS = 5
"""The first windows are shorter, so that a run begins to know soon what pings alone do not tell."""
_FAR_NS = 1 << 62


class Sent:
    """When the latest own records were sent, by tick; as many as a round trip of some seconds needs."""

    def __init__(self, capacity: int = 1 << 14) -> None:
        self._capacity = capacity
        self._ticks = [-1] * capacity
        self._instants = [0] * capacity

    def put(self, tick: int, at_ns: int) -> None:
        """Notes when a record was sent, on the own clock."""
        place = tick % self._capacity
        self._ticks[place], self._instants[place] = tick, at_ns

    def at(self, tick: int) -> int | None:
        """Returns when a record was sent, or None where that is not known any more."""
        place = tick % self._capacity
        return self._instants[place] if self._ticks[place] == tick else None


class Figures(NamedTuple):
    """What one link measured since the last figures; -1 where nothing came.

    Attributes:
        delay_us: one-way delay, median.
        delay_max_us: its largest.
        rtt_us: smallest round trip, without the time that the peer held the echo.
        faults: samples since the start that came before they were sent, by more than the bound.
    """

    delay_us: int
    delay_max_us: int
    rtt_us: int
    faults: int


class Meter:
    """One link's receiving end, as far as time goes.

    Args:
        epoch_ns: tick 0 on the peer's clock.
        place: which of the peer's peers this site is.
        sent: the own records.
        course: the offset of the peer's clock to begin with.
        estimator: what refines it, or None where both clocks are one.

    Attributes:
        course: the offset in force.
        news: the newest sample since it was asked last: its tick, and its arrival on the own clock, ns.
        faults: stamps that cannot be right, since the start.
        worst_ns: how long before its sending a sample came, at worst, since `forgive`.
        contradicted: whether windows contradicted each other since then.
    """

    def __init__(
        self, epoch_ns: int, place: int, sent: Sent, course: Course, estimator: OffsetEstimator | None
    ) -> None:
        self.course = course
        self.news: tuple[int, int] | None = None
        self.faults = 0
        self.worst_ns = 0
        self.contradicted = False
        self._epoch_ns, self._place, self._sent, self._estimator = epoch_ns, place, sent, estimator
        self._delays: list[int] = []
        self._rtt_ns = _FAR_NS
        self._windows = 0
        self._opened_ns: int | None = None
        self._begin()

    @property
    def estimated(self) -> bool:
        """True where the peer's clock is another one."""
        return self._estimator is not None

    def _begin(self) -> None:
        self._there_ns = self._back_ns = _FAR_NS  # the smallest delays of the window, and what they limit
        self._ceiling: Limit | None = None
        self._floor: Limit | None = None

    def take(self, sample: Sample, arrived_ns: int) -> int:
        """Takes the stamps of one sample and returns its one-way delay, ns.

        Args:
            sample: what came.
            arrived_ns: when, on the own clock.
        """
        offset_ns = self.course.at(arrived_ns)
        sent_ns = sample.sent_ns + self._epoch_ns
        delay_ns = arrived_ns - sent_ns + offset_ns
        self._delays.append(delay_ns)
        if delay_ns < self._back_ns:
            self._back_ns = delay_ns
            self._floor = Limit(arrived_ns, sent_ns - arrived_ns)
        if delay_ns < 0 and delay_ns < -self.course.bound_at(arrived_ns):
            self.faults += 1
            self.worst_ns = max(self.worst_ns, -delay_ns)
        if self.news is None or sample.tick > self.news[0]:
            self.news = sample.tick, arrived_ns
        for place, tick, at_ns in sample.echo:
            if place == self._place and (own_ns := self._sent.at(tick)) is not None:
                reached_ns = at_ns + self._epoch_ns
                there_ns = reached_ns - offset_ns - own_ns
                if there_ns < self._there_ns:
                    self._there_ns = there_ns
                    self._ceiling = Limit(own_ns, reached_ns - own_ns)
                if there_ns + delay_ns < self._rtt_ns:
                    self._rtt_ns = there_ns + delay_ns
        return delay_ns

    def close(self, now_ns: int, from_ns: int) -> Estimate | None:
        """Ends the window if it is time, and goes by what it says; None where nothing changed.

        Args:
            now_ns: the own clock.
            from_ns: from when on the new estimate is in force.
        """
        if self._estimator is None:
            return None
        if self._opened_ns is None:
            self._opened_ns = now_ns
        length_ns = FIRST_WINDOW_NS if self._windows < FIRST_WINDOWS else WINDOW_NS
        if now_ns - self._opened_ns < length_ns:
            return None
        self._opened_ns = now_ns
        self._windows += 1
        broken = self._estimator.broken
        self._estimator.add(self._ceiling, self._floor)
        estimate = self._estimator.estimate(now_ns)
        if self._estimator.broken > broken:
            self.faults += 1
            self.contradicted = True
        if estimate is None:  # nothing has come, or what came contradicts itself: a clock has stepped
            estimate = self.course.estimate.including(self._ceiling, self._floor)
            self._windows = 0
        self._begin()
        self.course.bend(from_ns, estimate)
        return estimate

    def forgive(self) -> None:
        """Begins anew with what a log should be told of stamps that cannot be right."""
        self.worst_ns = 0
        self.contradicted = False

    def figures(self) -> Figures:
        """Returns what was measured since the last call."""
        delays = sorted(self._delays)
        self._delays = []
        rtt_us = -1 if self._rtt_ns == _FAR_NS else self._rtt_ns // 1000
        self._rtt_ns = _FAR_NS
        if not delays:
            return Figures(-1, -1, rtt_us, self.faults)
        return Figures(delays[len(delays) // 2] // 1000, delays[-1] // 1000, rtt_us, self.faults)
