"""Timing of a running site: tick deadlines, stamps, and delays and clock offset of each link.

Invariant (L1): tick k is due at `k * 10^9 // rate_hz` ns after the epoch, to the nanosecond, on the leader's
clock. A site on another clock follows by slewing, at most SLEW_LIMIT, never by a step. Measuring changes no
number of a run: an impossible stamp is counted, and its sample is used.

Four stamps make a round trip: own sending (t1) and the peer's arrival (t2) of the record that the peer
echoes, the peer's sending (t3) and own arrival (t4) of the record that carries the echo.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..core.ticks import NS_PER_S
from .messages import PeerSample
from .offset import OffsetEstimate, OffsetEstimator, OffsetLimit, SlewedOffset, format_offset

SLEW_LIMIT = 200_000.0
"""By how much a grid may run faster or slower than its clock, ns/s (200 ppm)."""
_SETTLE_S = 2.0  # an error goes down by e in this time: slow against the noise of an estimate


class TickSchedule:
    """Deadlines of one site's ticks.

    Args:
        epoch_ns: tick 0, on its clock.
        rate_hz: its tick rate.

    Attributes:
        slew: by how much it lags its clock, ns/s.
        error_ns: how late it was against the leader's grid when it was steered last.
    """

    def __init__(self, epoch_ns: int, rate_hz: int) -> None:
        self.slew = 0.0
        self.error_ns = 0
        self._rate_hz = rate_hz
        self._from_ns, self._base_ns = 0, epoch_ns
        self._per_ns = 0.0

    def deadline(self, k: int) -> int:
        """Returns when tick k is due, on the site's clock, ns."""
        passed_ns = k * NS_PER_S // self._rate_hz - self._from_ns
        return self._base_ns + passed_ns + int(passed_ns * self._per_ns)

    def nominal(self, k: int) -> int:
        """Returns the nominal time of tick k, ns since the epoch."""
        return k * NS_PER_S // self._rate_hz

    def steer(self, k: int, error_ns: int, drift: float) -> None:
        """Slews towards the leader's grid from a tick on.

        Args:
            k: that tick, at or after the last one it was steered from.
            error_ns: how much later than the leader's own it is due.
            drift: by how much the leader's clock is faster than the own one, ns/s.
        """
        self._base_ns = self.deadline(k)
        self._from_ns = self.nominal(k)
        self.error_ns = error_ns
        self.slew = min(max(-drift - error_ns / _SETTLE_S, -SLEW_LIMIT), SLEW_LIMIT)
        self._per_ns = self.slew / NS_PER_S


WINDOW_NS = 1_000_000_000
FIRST_WINDOW_NS = 100_000_000
FIRST_WINDOWS = 5
"""The first windows are shorter, so that a run begins to know soon what pings alone do not tell."""
_FAR_NS = 1 << 62


class SentStamps:
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


class LinkTiming(NamedTuple):
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


class LinkTimingMonitor:
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
        self,
        epoch_ns: int,
        place: int,
        sent: SentStamps,
        course: SlewedOffset,
        estimator: OffsetEstimator | None,
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
        self._ceiling: OffsetLimit | None = None
        self._floor: OffsetLimit | None = None

    def take(self, sample: PeerSample, arrived_ns: int) -> int:
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
            self._floor = OffsetLimit(arrived_ns, sent_ns - arrived_ns)
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
                    self._ceiling = OffsetLimit(own_ns, reached_ns - own_ns)
                if there_ns + delay_ns < self._rtt_ns:
                    self._rtt_ns = there_ns + delay_ns
        return delay_ns

    def close(self, now_ns: int, from_ns: int) -> OffsetEstimate | None:
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

    def figures(self) -> LinkTiming:
        """Returns what was measured since the last call."""
        delays = sorted(self._delays)
        self._delays = []
        rtt_us = -1 if self._rtt_ns == _FAR_NS else self._rtt_ns // 1000
        self._rtt_ns = _FAR_NS
        if not delays:
            return LinkTiming(-1, -1, rtt_us, self.faults)
        return LinkTiming(delays[len(delays) // 2] // 1000, delays[-1] // 1000, rtt_us, self.faults)


FAULT_EVERY_NS = 1_000_000_000


class PeerClock(NamedTuple):
    """What is known of a peer's clock when the session begins.

    Attributes:
        name: the peer.
        epoch_ns: tick 0 on its clock.
        place: which of its peers this site is.
        estimate: where its clock stands.
        estimator: what the pings said, to be gone on with; None where both clocks are one.
    """

    name: str
    epoch_ns: int
    place: int
    estimate: OffsetEstimate
    estimator: OffsetEstimator | None


class ClockNotice(NamedTuple):
    """Something that a log should say of a clock: the facts of an event."""

    kind: str
    text: str
    facts: Mapping[str, object]


class SiteTiming:
    """A site's time.

    Args:
        epoch_ns: tick 0 on the own clock.
        rate_hz: the own tick rate.
        peers: what is known of the peers, in scenario order.
        leader: name of the site whose grid is the session's.

    Attributes:
        grid: when the own ticks are due.
        meters: per peer what its link measures, in scenario order.
    """

    def __init__(self, epoch_ns: int, rate_hz: int, peers: Sequence[PeerClock], leader: str) -> None:
        self.schedule = TickSchedule(epoch_ns, rate_hz)
        self._epoch_ns = epoch_ns
        self._names = [peer.name for peer in peers]
        self._sent = SentStamps()
        self.meters = [
            LinkTimingMonitor(
                peer.epoch_ns, peer.place, self._sent, SlewedOffset(peer.estimate), peer.estimator
            )
            for peer in peers
        ]
        self._turn = 0
        self._faults_ns = [-FAULT_EVERY_NS] * len(peers)
        self._followed: LinkTimingMonitor | None = None
        self._leader_epoch_ns = 0
        for peer, meter in zip(peers, self.meters, strict=True):
            meter.course.bend(epoch_ns, peer.estimate)
            if peer.name == leader and peer.estimator is not None:
                self._followed, self._leader_epoch_ns = meter, peer.epoch_ns

    def opening(self) -> list[ClockNotice]:
        """Returns what a log should say of the peers' clocks before tick 0."""
        return [
            _estimated(name, 0, self._epoch_ns, meter.course)
            for name, meter in zip(self._names, self.meters, strict=True)
            if meter.estimated
        ]

    def sent(self, tick: int, now_ns: int) -> int:
        """Notes when the record of a tick is sent, and returns it since the epoch, ns."""
        self._sent.put(tick, now_ns)
        return now_ns - self._epoch_ns

    def echo(self) -> list[tuple[int, int, int]]:
        """Returns of each peer the newest sample since the last call: (peer, tick, arrival), see `State`."""
        echo = []
        for index, meter in enumerate(self.meters):
            if meter.news is not None:
                tick, arrived_ns = meter.news
                meter.news = None
                echo.append((index, tick, arrived_ns - self._epoch_ns))
        return echo

    def settle(self, k: int, now_ns: int) -> list[ClockNotice]:
        """Goes by what was measured from tick k on; ten times a second.

        Args:
            k: the next tick.
            now_ns: the own clock.

        Returns:
            What a log should say of it.
        """
        news: list[ClockNotice] = []
        due_ns = self.schedule.deadline(k)
        self._estimate(k, now_ns, due_ns, news)
        for n, (name, meter) in enumerate(zip(self._names, self.meters, strict=True)):
            faulty = bool(meter.worst_ns) or meter.contradicted
            if faulty and now_ns - self._faults_ns[n] >= FAULT_EVERY_NS:
                self._faults_ns[n] = now_ns
                news.append(_fault(name, meter.worst_ns, meter.course.bound_ns))
                meter.forgive()
        if self._followed is not None:
            course = self._followed.course
            leader_ns = due_ns + course.at(due_ns) - self._leader_epoch_ns
            self.schedule.steer(k, leader_ns - self.schedule.nominal(k), course.estimate.drift)
        return news

    def _estimate(self, k: int, now_ns: int, due_ns: int, news: list[ClockNotice]) -> None:
        """Lets one peer at a time be estimated anew, in turn, because that takes a part of a tick."""
        for _ in self.meters:
            self._turn = (self._turn + 1) % len(self.meters)
            meter = self.meters[self._turn]
            if meter.close(now_ns, due_ns) is not None:
                news.append(_estimated(self._names[self._turn], k, due_ns, meter.course))
                return

    def measured(self, now_ns: int) -> dict[str, Any]:
        """Returns what `LinkStats` says of time, by field, and begins anew."""
        figures = {name: meter.figures() for name, meter in zip(self._names, self.meters, strict=True)}
        courses = {name: meter.course for name, meter in zip(self._names, self.meters, strict=True)}
        return {
            "offset_us": {name: course.at(now_ns) // 1000 for name, course in courses.items()},
            "bound_us": {name: -(-course.bound_at(now_ns) // 1000) for name, course in courses.items()},
            "delay_us": {name: figure.delay_us for name, figure in figures.items()},
            "delay_max_us": {name: figure.delay_max_us for name, figure in figures.items()},
            "rtt_us": {name: figure.rtt_us for name, figure in figures.items()},
            "clock_faults": {name: figure.faults for name, figure in figures.items()},
            "grid_error_us": self.schedule.error_ns // 1000,
            "slew_ppb": round(self.schedule.slew),
        }


def _estimated(name: str, k: int, at_ns: int, course: SlewedOffset) -> ClockNotice:
    """Says where a peer's clock stands from tick k on."""
    estimate = course.estimate
    offset_ns = course.at(at_ns)
    apart = max(estimate.drift_high - estimate.drift, estimate.drift - estimate.drift_low)
    return ClockNotice(
        "clock",
        f"clock of {name}: {format_offset(offset_ns, course.bound_ns)}, "
        f"drift {estimate.drift / 1000:+.2f} ppm",
        {
            "about": name,
            "ticks": k,
            "offset_ns": offset_ns,
            "bound_ns": course.bound_ns,
            "drift_ppb": round(estimate.drift),
            "drift_bound_ppb": round(apart) + 1,
        },
    )


def _fault(name: str, before_ns: int, bound_ns: int) -> ClockNotice:
    """Says that stamps cannot be right: a sample that came before it was sent, or windows that disagree."""
    what = f"its stamps contradict those before, beyond the bound of {bound_ns / 1000:.0f} us"
    if before_ns:
        what = f"a sample came {before_ns / 1e6:.3f} ms before it was sent"
    return ClockNotice(
        "clock fault",
        f"clock of {name}: {what}; one of the two clocks has stepped",
        {"about": name, "offset_ns": before_ns, "bound_ns": bound_ns},
    )
