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
"""Largest deviation of a schedule's rate from its clock, ns/s (200 ppm)."""
_SETTLE_S = 2.0  # time constant of an error: slow against the noise of an estimate


class TickSchedule:
    """Deadlines of one site's ticks.

    Args:
        epoch_ns: tick 0, on the site's clock.
        rate_hz: its tick rate.

    Attributes:
        slew: lag of the schedule against the clock, ns/s.
        error_ns: lateness against the leader's schedule when it was last steered.
    """

    def __init__(self, epoch_ns: int, rate_hz: int) -> None:
        self.slew = 0.0
        self.error_ns = 0
        self._rate_hz = rate_hz
        self._from_ns, self._base_ns = 0, epoch_ns
        self._slew_per_ns = 0.0

    def deadline(self, k: int) -> int:
        """Returns the deadline of tick k on the site's clock, ns."""
        passed_ns = k * NS_PER_S // self._rate_hz - self._from_ns
        return self._base_ns + passed_ns + int(passed_ns * self._slew_per_ns)

    def nominal(self, k: int) -> int:
        """Returns the nominal time of tick k, ns since the epoch."""
        return k * NS_PER_S // self._rate_hz

    def steer(self, k: int, error_ns: int, drift: float) -> None:
        """Slews towards the leader's schedule from a tick on.

        Args:
            k: that tick, at or after the last one it was steered from.
            error_ns: its lateness against the leader's schedule.
            drift: drift of the leader's clock against the own one, ns/s.
        """
        self._base_ns = self.deadline(k)
        self._from_ns = self.nominal(k)
        self.error_ns = error_ns
        self.slew = min(max(-drift - error_ns / _SETTLE_S, -SLEW_LIMIT), SLEW_LIMIT)
        self._slew_per_ns = self.slew / NS_PER_S


WINDOW_NS = 1_000_000_000
FIRST_WINDOW_NS = 100_000_000
FIRST_WINDOWS = 5
"""The first windows are shorter, so that the offsets soon improve on the pings."""
_FAR_NS = 1 << 62


class SentStamps:
    """Times of sending of the latest own records, by tick; enough for round trips of some seconds."""

    def __init__(self, capacity: int = 1 << 14) -> None:
        self._capacity = capacity
        self._ticks = [-1] * capacity
        self._instants = [0] * capacity

    def put(self, tick: int, at_ns: int) -> None:
        """Notes the time of sending of a record, on the own clock."""
        slot = tick % self._capacity
        self._ticks[slot], self._instants[slot] = tick, at_ns

    def at(self, tick: int) -> int | None:
        """Returns the time of sending of a record, or None if it is no longer known."""
        slot = tick % self._capacity
        return self._instants[slot] if self._ticks[slot] == tick else None


class LinkTiming(NamedTuple):
    """Timing of one link since the last statistics; -1 without samples.

    Attributes:
        delay_us: one-way delay, median.
        delay_max_us: one-way delay, largest.
        rtt_us: smallest round trip, without the time that the peer held the echo.
        faults: samples since the start that arrived before they were sent, by more than the bound.
    """

    delay_us: int
    delay_max_us: int
    rtt_us: int
    faults: int


class LinkTimingMonitor:
    """Timing of one link, at its receiving end.

    Args:
        epoch_ns: tick 0 on the peer's clock.
        place: index of this site among the peer's peers.
        sent: stamps of the own records.
        offset: the initial offset of the peer's clock.
        estimator: refines it; None if both clocks are one.

    Attributes:
        offset: the offset in use.
        newest: tick of the newest sample since the last echo, and its arrival on the own clock, ns.
        faults: impossible stamps since the start.
        worst_ns: largest time by which a sample arrived before it was sent, since `reset_faults`.
        contradicted: whether windows contradicted each other since then.
    """

    def __init__(
        self,
        epoch_ns: int,
        place: int,
        sent: SentStamps,
        offset: SlewedOffset,
        estimator: OffsetEstimator | None,
    ) -> None:
        self.offset = offset
        self.newest: tuple[int, int] | None = None
        self.faults = 0
        self.worst_ns = 0
        self.contradicted = False
        self._epoch_ns, self._place, self._sent, self._estimator = epoch_ns, place, sent, estimator
        self._delays: list[int] = []
        self._rtt_ns = _FAR_NS
        self._windows = 0
        self._opened_ns: int | None = None
        self._open_window()

    @property
    def estimated(self) -> bool:
        """True if the peer has another clock."""
        return self._estimator is not None

    def _open_window(self) -> None:
        self._there_ns = self._back_ns = _FAR_NS  # smallest delays of the window, with their limits
        self._ceiling: OffsetLimit | None = None
        self._floor: OffsetLimit | None = None

    def take(self, sample: PeerSample, arrived_ns: int) -> int:
        """Takes the stamps of one sample that arrived on the own clock; returns its one-way delay, ns."""
        offset_ns = self.offset.at(arrived_ns)
        sent_ns = sample.sent_ns + self._epoch_ns
        delay_ns = arrived_ns - sent_ns + offset_ns
        self._delays.append(delay_ns)
        if delay_ns < self._back_ns:
            self._back_ns = delay_ns
            self._floor = OffsetLimit(arrived_ns, sent_ns - arrived_ns)
        if delay_ns < 0 and delay_ns < -self.offset.bound_at(arrived_ns):
            self.faults += 1
            self.worst_ns = max(self.worst_ns, -delay_ns)
        if self.newest is None or sample.tick > self.newest[0]:
            self.newest = sample.tick, arrived_ns
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
        """Closes the window if it is due, and slews to the new estimate; None if nothing changed.

        Args:
            now_ns: the own clock.
            from_ns: start of the slew.
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
        if estimate is None:  # no stamps, or contradictory ones: a clock has stepped
            estimate = self.offset.estimate.including(self._ceiling, self._floor)
            self._windows = 0
        self._open_window()
        self.offset.slew_to(from_ns, estimate)
        return estimate

    def reset_faults(self) -> None:
        """Starts a new report of impossible stamps."""
        self.worst_ns = 0
        self.contradicted = False

    def figures(self) -> LinkTiming:
        """Returns the timing since the last call."""
        delays = sorted(self._delays)
        self._delays = []
        rtt_us = -1 if self._rtt_ns == _FAR_NS else self._rtt_ns // 1000
        self._rtt_ns = _FAR_NS
        if not delays:
            return LinkTiming(-1, -1, rtt_us, self.faults)
        return LinkTiming(delays[len(delays) // 2] // 1000, delays[-1] // 1000, rtt_us, self.faults)


FAULT_EVERY_NS = 1_000_000_000


class PeerClock(NamedTuple):
    """A peer's clock at the start of the session.

    Attributes:
        name: the peer.
        epoch_ns: tick 0 on its clock.
        place: index of this site among its peers.
        estimate: offset of its clock.
        estimator: the limits found by pings; None if both clocks are one.
    """

    name: str
    epoch_ns: int
    place: int
    estimate: OffsetEstimate
    estimator: OffsetEstimator | None


class ClockNotice(NamedTuple):
    """An event about a clock: its kind, its text and its further fields."""

    kind: str
    text: str
    facts: Mapping[str, object]


class SiteTiming:
    """Deadlines of a site, and timing of its links.

    Args:
        epoch_ns: tick 0 on the own clock.
        rate_hz: the own tick rate.
        peers: the peers' clocks, in scenario order.
        leader: the site whose schedule is the session's.

    Attributes:
        schedule: deadlines of the own ticks.
        meters: timing of the links, in scenario order of the peers.
    """

    def __init__(self, epoch_ns: int, rate_hz: int, peers: Sequence[PeerClock], leader: str) -> None:
        self.schedule = TickSchedule(epoch_ns, rate_hz)
        self._epoch_ns = epoch_ns
        self._names = [peer.name for peer in peers]
        self._sent = SentStamps()
        self.meters: list[LinkTimingMonitor] = []
        self._turn = 0
        self._faults_ns = [-FAULT_EVERY_NS] * len(peers)
        self._leader: LinkTimingMonitor | None = None
        self._leader_epoch_ns = 0
        for peer in peers:
            offset = SlewedOffset(peer.estimate)
            offset.slew_to(epoch_ns, peer.estimate)
            meter = LinkTimingMonitor(peer.epoch_ns, peer.place, self._sent, offset, peer.estimator)
            self.meters.append(meter)
            if peer.name == leader and meter.estimated:
                self._leader, self._leader_epoch_ns = meter, peer.epoch_ns

    def opening(self) -> list[ClockNotice]:
        """Returns the events about the peers' clocks before tick 0."""
        return [
            _estimate_notice(name, 0, self._epoch_ns, meter.offset)
            for name, meter in zip(self._names, self.meters, strict=True)
            if meter.estimated
        ]

    def sent(self, tick: int, now_ns: int) -> int:
        """Notes the time of sending of a record; returns it since the epoch, ns."""
        self._sent.put(tick, now_ns)
        return now_ns - self._epoch_ns

    def echo(self) -> list[tuple[int, int, int]]:
        """Returns each peer's newest sample since the last call: (peer, tick, arrival), see `State`."""
        echo = []
        for index, meter in enumerate(self.meters):
            if meter.newest is not None:
                tick, arrived_ns = meter.newest
                meter.newest = None
                echo.append((index, tick, arrived_ns - self._epoch_ns))
        return echo

    def settle(self, k: int, now_ns: int) -> list[ClockNotice]:
        """Estimates one clock, steers the schedule and returns the events; ten times a second.

        Args:
            k: the next tick.
            now_ns: the own clock.
        """
        notices: list[ClockNotice] = []
        due_ns = self.schedule.deadline(k)
        for _ in self.meters:  # one estimate at a time, in turn: it takes a part of a tick
            self._turn = (self._turn + 1) % len(self.meters)
            meter = self.meters[self._turn]
            if meter.close(now_ns, due_ns) is not None:
                notices.append(_estimate_notice(self._names[self._turn], k, due_ns, meter.offset))
                break
        for n, (name, meter) in enumerate(zip(self._names, self.meters, strict=True)):
            faulty = bool(meter.worst_ns) or meter.contradicted
            if faulty and now_ns - self._faults_ns[n] >= FAULT_EVERY_NS:
                self._faults_ns[n] = now_ns
                notices.append(_fault_notice(name, meter.worst_ns, meter.offset.bound_ns))
                meter.reset_faults()
        if self._leader is not None:
            offset = self._leader.offset
            leader_ns = due_ns + offset.at(due_ns) - self._leader_epoch_ns
            self.schedule.steer(k, leader_ns - self.schedule.nominal(k), offset.estimate.drift)
        return notices

    def measured(self, now_ns: int) -> dict[str, Any]:
        """Returns the timing fields of `LinkStats` since the last call."""
        timings = {name: meter.figures() for name, meter in zip(self._names, self.meters, strict=True)}
        offsets = {name: meter.offset for name, meter in zip(self._names, self.meters, strict=True)}
        return {
            "offset_us": {name: offset.at(now_ns) // 1000 for name, offset in offsets.items()},
            "bound_us": {name: -(-offset.bound_at(now_ns) // 1000) for name, offset in offsets.items()},
            "delay_us": {name: timing.delay_us for name, timing in timings.items()},
            "delay_max_us": {name: timing.delay_max_us for name, timing in timings.items()},
            "rtt_us": {name: timing.rtt_us for name, timing in timings.items()},
            "clock_faults": {name: timing.faults for name, timing in timings.items()},
            "grid_error_us": self.schedule.error_ns // 1000,
            "slew_ppb": round(self.schedule.slew),
        }


def _estimate_notice(name: str, k: int, at_ns: int, offset: SlewedOffset) -> ClockNotice:
    estimate = offset.estimate
    offset_ns = offset.at(at_ns)
    drift_bound = max(estimate.drift_high - estimate.drift, estimate.drift - estimate.drift_low)
    return ClockNotice(
        "clock",
        f"clock of {name}: {format_offset(offset_ns, offset.bound_ns)}, "
        f"drift {estimate.drift / 1000:+.2f} ppm",
        {
            "about": name,
            "ticks": k,
            "offset_ns": offset_ns,
            "bound_ns": offset.bound_ns,
            "drift_ppb": round(estimate.drift),
            "drift_bound_ppb": round(drift_bound) + 1,
        },
    )


def _fault_notice(name: str, before_ns: int, bound_ns: int) -> ClockNotice:
    """Reports a sample that arrived before it was sent, or windows that contradict each other."""
    what = f"its stamps contradict those before, beyond the bound of {bound_ns / 1000:.0f} us"
    if before_ns:
        what = f"a sample came {before_ns / 1e6:.3f} ms before it was sent"
    return ClockNotice(
        "clock fault",
        f"clock of {name}: {what}; one of the two clocks has stepped",
        {"about": name, "offset_ns": before_ns, "bound_ns": bound_ns},
    )
