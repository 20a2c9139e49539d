"""Timing of a running site: tick deadlines, stamps, and delays and clock offset of each link.

Invariant (L1): tick k is due at `k * 10^9 // rate_hz` ns after the epoch, to the nanosecond, on
the leader's clock. A site on another clock follows by slewing, at most SLEW_LIMIT, never by a
step; while the leader is away, along its clock as last estimated. Sites of one machine wake up
in turn after that, see `find_turn_ns`. Measuring changes no number of a run: an impossible
stamp is counted, and its sample is used.

Four stamps make a round trip: own sending (t1) and the peer's arrival (t2) of the record that
the peer echoes, the peer's sending (t3) and own arrival (t4) of the record that carries the
echo.
"""

from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..core.site_step import Site
from ..core.ticks import NS_PER_S, TickRecord
from .messages import MODE_WORDS, VERSION, LinkStats, PeerSample
from .offset import (
    DRIFT_LIMIT,
    OffsetEstimate,
    OffsetEstimator,
    OffsetLimit,
    SlewedOffset,
    exact_offset,
    format_offset,
)
from .topics import ticks_per_stats

SLEW_LIMIT = 200_000.0
"""Largest deviation of a schedule's rate from its clock, ns/s (200 ppm)."""
_SETTLE_S = 2.0  # time constant of an error: slow against the noise of an estimate


class TickSchedule:
    """The grid of one site's ticks, on its clock.

    Attributes:
        slew: lag of the schedule against the clock, ns/s.
        error_ns: lateness against the leader's schedule when it was last steered.
    """

    def __init__(self, epoch_ns: int, rate_hz: int) -> None:
        self.slew = 0.0
        self.error_ns = 0
        self._rate_hz = rate_hz
        self._from_ns = 0
        self._base_ns = epoch_ns
        self._slew_per_ns = 0.0

    def due_ns(self, k: int) -> int:
        """Returns when tick k lies on the grid, on the site's clock, ns."""
        passed_ns = k * NS_PER_S // self._rate_hz - self._from_ns
        return self._base_ns + passed_ns + int(passed_ns * self._slew_per_ns)

    def adjust_rate(self, k: int, error_ns: int, drift: float) -> None:
        """Slews towards the leader's schedule from a tick on, at or after the last one it was
        steered from.

        The tick is late by `error_ns` against that schedule; `drift`, ns/s, is that of the
        leader's clock.
        """
        self._base_ns = self.due_ns(k)
        self._from_ns = k * NS_PER_S // self._rate_hz
        self.error_ns = error_ns
        self.slew = min(max(-drift - error_ns / _SETTLE_S, -SLEW_LIMIT), SLEW_LIMIT)
        self._slew_per_ns = self.slew / NS_PER_S


WINDOW_NS = 1_000_000_000
FIRST_WINDOW_NS = 100_000_000
FIRST_WINDOWS = 5
"""The first windows are shorter, so that the offsets soon improve on the pings."""
_FAR_NS = 1 << 62


class SentStamps:
    """Times of sending of the latest own records, by tick; enough for round trips of some
    seconds.
    """

    def __init__(self, capacity: int = 1 << 14) -> None:
        self._capacity = capacity
        self._entries = array("q", [-1, 0]) * capacity  # tick, time

    def record(self, tick: int, at_ns: int) -> None:
        """Notes the time of sending of a record, on the own clock."""
        slot = 2 * (tick % self._capacity)
        self._entries[slot] = tick
        self._entries[slot + 1] = at_ns

    def find_ns(self, tick: int) -> int | None:
        """Returns the time of sending of a record, or None if it is no longer known."""
        slot = 2 * (tick % self._capacity)
        return self._entries[slot + 1] if self._entries[slot] == tick else None


class PeerClock(NamedTuple):
    """A peer's clock at the start of the session.

    Attributes:
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

    @property
    def is_own(self) -> bool:
        """True if it is this site's clock, too."""
        return self.estimator is None


class LinkTimingMonitor:
    """Timing of one link, at its receiving end.

    Attributes:
        newest: tick of the newest sample since the last echo, and its arrival on the own clock,
            ns.
        worst_ns: largest time by which a sample arrived before it was sent, since the last
            report.
        unheard: True once the peer was found not to hear this site, until it hears it again.
    """

    def __init__(self, peer: PeerClock, sent: SentStamps) -> None:
        self.faults = 0
        self._sent = sent
        self._delays: list[int] = []
        self._rtt_ns = _FAR_NS
        self.admit(peer)

    def admit(self, peer: PeerClock) -> None:
        """Begins with a start of the peer, and its clock."""
        self.peer = peer
        self.offset = SlewedOffset(peer.estimate)
        self.newest: tuple[int, int] | None = None
        self.worst_ns = 0
        self.contradicted = self.is_unacknowledged = False
        self._heard_ns = self._acknowledged_ns = -1
        self._acknowledged = -1
        self._epoch_ns = peer.epoch_ns
        self._place = peer.place
        self._shared_ns = peer.estimate.offset_ns if peer.is_own else None
        self._windows = 0
        self._opened_ns: int | None = None
        self._open_window()

    def _open_window(self) -> None:
        self._there_ns = self._back_ns = (
            _FAR_NS  # smallest delays of the window, with their limits
        )
        self._ceiling: OffsetLimit | None = None
        self._floor: OffsetLimit | None = None

    def receive(self, sample: PeerSample, arrived_ns: int) -> int:
        """Takes the stamps of one sample that arrived on the own clock; returns its one-way
        delay, ns.
        """
        offset_ns = (
            self.offset.evaluate_ns(arrived_ns) if self._shared_ns is None else self._shared_ns
        )
        sent_ns = sample.sent_ns + self._epoch_ns
        delay_ns = arrived_ns - sent_ns + offset_ns
        self._delays.append(delay_ns)
        if delay_ns < self._back_ns:
            self._back_ns = delay_ns
            self._floor = OffsetLimit(arrived_ns, sent_ns - arrived_ns)
        if delay_ns < 0 and delay_ns < -self.offset.error_bound_ns(arrived_ns):
            self.faults += 1
            self.worst_ns = max(self.worst_ns, -delay_ns)
        if self.newest is None or sample.tick > self.newest[0]:
            self.newest = sample.tick, arrived_ns
        self._heard_ns = arrived_ns
        for place, tick, at_ns in sample.echo:
            if place == self._place and (own_ns := self._sent.find_ns(tick)) is not None:
                if tick > self._acknowledged:
                    self._acknowledged = tick
                    self._acknowledged_ns = arrived_ns
                reached_ns = at_ns + self._epoch_ns
                there_ns = reached_ns - offset_ns - own_ns
                if there_ns < self._there_ns:
                    self._there_ns = there_ns
                    self._ceiling = OffsetLimit(own_ns, reached_ns - own_ns)
                if there_ns + delay_ns < self._rtt_ns:
                    self._rtt_ns = there_ns + delay_ns
        return delay_ns

    def is_receiving(self, now_ns: int) -> bool:
        """True if a sample of the peer arrived within UNHEARD_NS."""
        return self._heard_ns >= 0 and now_ns - self._heard_ns <= UNHEARD_NS

    def is_acknowledged(self, now_ns: int) -> bool | None:
        """True if the peer acknowledged a newer sample within UNHEARD_NS.

        None before its first acknowledgement, and while it is silent itself.
        """
        if self._acknowledged < 0 or not self.is_receiving(now_ns):
            return None
        return self._heard_ns - self._acknowledged_ns <= UNHEARD_NS

    def close(self, now_ns: int, from_ns: int) -> OffsetEstimate | None:
        """Closes the window if it is due, and slews to the new estimate from an instant on;
        else None.
        """
        estimator = self.peer.estimator
        if estimator is None:
            return None
        if self._opened_ns is None:
            self._opened_ns = now_ns
        length_ns = FIRST_WINDOW_NS if self._windows < FIRST_WINDOWS else WINDOW_NS
        if now_ns - self._opened_ns < length_ns:
            return None
        self._opened_ns = now_ns
        self._windows += 1
        broken = estimator.broken
        estimator.add(self._ceiling, self._floor)
        estimate = estimator.estimate(now_ns)
        if estimator.broken > broken:
            self.faults += 1
            self.contradicted = True
        if estimate is None:  # no stamps, or contradictory ones: a clock has stepped
            estimate = self.offset.estimate.widen(self._ceiling, self._floor)
            self._windows = 0
        self._open_window()
        self.offset.slew_to(from_ns, estimate)
        return estimate

    def pop_measurements(self, now_ns: int) -> dict[str, int]:
        """Returns the link's timing fields of `LinkStats` since the last call."""
        delays = sorted(self._delays)
        rtt_ns = self._rtt_ns
        self._delays = []
        self._rtt_ns = _FAR_NS
        return {
            "offset_us": self.offset.evaluate_ns(now_ns) // 1000,
            "bound_us": -(-self.offset.error_bound_ns(now_ns) // 1000),
            "delay_us": delays[len(delays) // 2] // 1000 if delays else -1,
            "delay_max_us": delays[-1] // 1000 if delays else -1,
            "rtt_us": -1 if rtt_ns == _FAR_NS else rtt_ns // 1000,
            "clock_faults": self.faults,
        }


FAULT_EVERY_NS = 1_000_000_000
UNHEARD_NS = 200_000_000
"""A peer that is heard and acknowledges no newer sample for longer does not hear this site."""
FIRST_BOUND_NS = 2_000_000
"""How far the clock of a site that joins may be from what it says, besides the bound that it
states.
"""


ClockNotice = dict[str, Any]
"""The fields of an event about a clock, or about a peer that does not hear this site."""


def find_turn_ns(place: int, sites: int, rate_hz: int) -> int:
    """Returns how long after a tick of the grid a site wakes up that is one of several on its
    machine.

    Woken up at one instant, they would wait for one another's processors. The turns take half
    of a period, so that a sample of the last one is still there well before the next tick of
    the first.

    Args:
        place: of the site among them, from 0.
        sites: how many they are.
        rate_hz: the highest of their tick rates.
    """
    return place * NS_PER_S // (2 * sites * rate_hz)


class SiteTiming:
    """Deadlines of a site, and timing of its links; the schedule of the leader is the
    session's.

    Attributes:
        turn_ns: how long after a tick of the grid the site wakes up, see `find_turn_ns`.
    """

    def __init__(
        self,
        epoch_ns: int,
        rate_hz: int,
        peers: Sequence[PeerClock],
        leader: str,
        turn_ns: int = 0,
    ) -> None:
        self.schedule = TickSchedule(epoch_ns, rate_hz)
        self.turn_ns = turn_ns
        self._epoch_ns = epoch_ns
        self._rate_hz = rate_hz
        self._sent = SentStamps()
        self.monitors = [LinkTimingMonitor(peer, self._sent) for peer in peers]
        for meter in self.monitors:
            meter.offset.slew_to(epoch_ns, meter.peer.estimate)
        self._leader_name = leader
        self._turn = 0
        self._faults_ns = [-FAULT_EVERY_NS] * len(peers)

    def deadline_ns(self, k: int) -> int:
        """Returns when the site is to wake up for tick k, on its clock, ns: on the grid, and in
        its turn.
        """
        return self.schedule.due_ns(k) + self.turn_ns

    def list_initial_notices(self) -> list[ClockNotice]:
        """Returns the events about the peers' clocks before tick 0."""
        meters = (meter for meter in self.monitors if not meter.peer.is_own)
        return [_estimate_notice(meter, 0, self._epoch_ns) for meter in meters]

    def admit(
        self, index: int, t_ns: int, epoch_ns: int, bound_ns: int | None
    ) -> list[ClockNotice]:
        """Begins with another start of a peer, which joins at a time since the epoch; returns
        the events.

        Args:
            index: the peer's.
            t_ns: the time of its first tick.
            epoch_ns: the epoch on its clock, as it counts.
            bound_ns: how far it may be wrong about that; None if its clock is this site's.
        """
        meter = self.monitors[index]
        known = meter.peer._replace(epoch_ns=epoch_ns, estimate=exact_offset(0), estimator=None)
        if bound_ns is None:
            meter.admit(known)
            return []
        k = t_ns * self._rate_hz // NS_PER_S
        at_ns = self.schedule.due_ns(k)
        offset_ns = epoch_ns + k * NS_PER_S // self._rate_hz - at_ns
        wide_ns = bound_ns + FIRST_BOUND_NS
        sides = offset_ns - wide_ns, offset_ns + wide_ns, -DRIFT_LIMIT, DRIFT_LIMIT
        estimate = OffsetEstimate(at_ns, offset_ns, 0.0, *sides)
        meter.admit(known._replace(estimate=estimate, estimator=OffsetEstimator()))
        return [_estimate_notice(meter, k, at_ns)]

    def record_sent(self, tick: int, now_ns: int) -> int:
        """Notes the time of sending of a record; returns it since the epoch, ns."""
        self._sent.record(tick, now_ns)
        return now_ns - self._epoch_ns

    def pop_echo(self) -> list[tuple[int, int, int]]:
        """Returns each peer's newest sample since the last call: (peer, tick, arrival), see
        `State`.
        """
        echo = []
        for index, meter in enumerate(self.monitors):
            if meter.newest is not None:
                tick, arrived_ns = meter.newest
                meter.newest = None
                echo.append((index, tick, arrived_ns - self._epoch_ns))
        return echo

    def update_clocks(self, k: int, now_ns: int) -> list[ClockNotice]:
        """Estimates one clock, steers the schedule from tick k on, returns the events; ten
        times a second.
        """
        notices: list[ClockNotice] = []
        due_ns = self.schedule.due_ns(k)
        for _ in self.monitors:  # one estimate at a time, in turn: it takes a part of a tick
            self._turn = (self._turn + 1) % len(self.monitors)
            meter = self.monitors[self._turn]
            if meter.close(now_ns, due_ns) is not None:
                notices.append(_estimate_notice(meter, k, due_ns))
                break
        for n, meter in enumerate(self.monitors):
            faulty = bool(meter.worst_ns) or meter.contradicted
            if faulty and now_ns - self._faults_ns[n] >= FAULT_EVERY_NS:
                self._faults_ns[n] = now_ns
                notices.append(_fault_notice(meter))
                meter.worst_ns = 0
                meter.contradicted = False
            if meter.is_unacknowledged is meter.is_acknowledged(
                now_ns
            ):  # None, of a silent peer, is neither
                meter.is_unacknowledged = not meter.is_unacknowledged
                notices.append(_hearing_notice(meter, k))
            if meter.peer.name == self._leader_name and not meter.peer.is_own:
                leader_ns = due_ns + meter.offset.evaluate_ns(due_ns) - meter.peer.epoch_ns
                error_ns = leader_ns - k * NS_PER_S // self._rate_hz
                self.schedule.adjust_rate(k, error_ns, meter.offset.estimate.drift)
        return notices

    def pop_measurements(self, now_ns: int) -> dict[str, Any]:
        """Returns the timing fields of `LinkStats` since the last call."""
        stats: dict[str, Any] = {
            "grid_error_us": self.schedule.error_ns // 1000,
            "slew_ppb": round(self.schedule.slew),
        }
        for meter in self.monitors:
            for field, value in meter.pop_measurements(now_ns).items():
                stats.setdefault(field, {})[meter.peer.name] = value
        return stats


def _estimate_notice(meter: LinkTimingMonitor, k: int, at_ns: int) -> ClockNotice:
    offset = meter.offset
    estimate = meter.offset.estimate
    name = meter.peer.name
    offset_ns = offset.evaluate_ns(at_ns)
    drift_bound = max(estimate.drift_high - estimate.drift, estimate.drift - estimate.drift_low)
    told = (
        f"{format_offset(offset_ns, offset.bound_ns)}, drift {estimate.drift / 1000:+.2f} ppm"
    )
    return {
        "kind": "clock",
        "text": f"clock of {name}: {told}",
        "about": name,
        "ticks": k,
        "offset_ns": offset_ns,
        "bound_ns": offset.bound_ns,
        "drift_ppb": round(estimate.drift),
        "drift_bound_ppb": round(drift_bound) + 1,
    }


def _fault_notice(meter: LinkTimingMonitor) -> ClockNotice:
    name = meter.peer.name
    before_ns = meter.worst_ns
    bound_ns = meter.offset.bound_ns
    what = f"its stamps contradict those before, beyond the bound of {bound_ns / 1000:.0f} us"
    if before_ns:
        what = f"a sample came {before_ns / 1e6:.3f} ms before it was sent"
    text = f"clock of {name}: {what}; one of the two clocks has stepped"
    return {
        "kind": "clock fault",
        "text": text,
        "about": name,
        "offset_ns": before_ns,
        "bound_ns": bound_ns,
    }


def _hearing_notice(meter: LinkTimingMonitor, k: int) -> ClockNotice:
    name = meter.peer.name
    if meter.is_unacknowledged:
        text = f"{name} is heard and does not hear: for {UNHEARD_NS // 1_000_000} ms it acknowledged nothing"
        return {"kind": "unheard", "text": text, "about": name, "ticks": k}
    return {"kind": "heard", "text": f"{name} hears again", "about": name, "ticks": k}


_LINK_COUNTS = ("accepted", "late", "duplicate", "refused", "lost", "superseded", "copies")


class LoopStats:
    """Counters of a loop, since the last statistics and since the start.

    Attributes:
        overruns: ticks whose work began after the next one was due, or that were not made.
    """

    def __init__(self, site: Site, boot: int) -> None:
        self._site = site
        self._boot = boot
        self._rates = [site.peer_rate_hz(peer) for peer in range(len(site.peers))]
        self._every = ticks_per_stats(site.rate_hz)
        self._period_us = 1_000_000 / site.rate_hz
        self._late_max_us = self._busy_max_us = 0
        self.dropped: Counter[str] = Counter()
        self.overruns = 0

    def count_tick(self, late_us: int, busy_us: int, skipped: int = 0) -> None:
        """Counts one tick: its lateness, the computing time of the one before, and how many
        were not made.
        """
        self.overruns += skipped
        if late_us > self._late_max_us:
            self._late_max_us = late_us
        if busy_us > self._busy_max_us:
            self._busy_max_us = busy_us
        self.overruns += late_us >= self._period_us

    def is_due(self, k: int, skipped: int = 0) -> bool:
        """True at the ticks after which statistics are published; one stands for the skipped
        ones before.
        """
        return k % self._every <= skipped

    def pop_stats(
        self, output: TickRecord, measured: Mapping[str, Any] | None = None
    ) -> LinkStats:
        """Returns the statistics as of a record's tick, with the timing fields that were
        measured if any.

        The largest values begin anew.
        """
        peers = self._site.peers
        counts = dict(zip(peers, self._site.counts(), strict=True))
        age_us = {
            peer: (output.t_ns - used * NS_PER_S // rate_hz) // 1000 if used >= 0 else -1
            for peer, used, rate_hz in zip(peers, output.used, self._rates, strict=True)
        }
        by_peer: dict[str, Any] = {
            field: {peer: getattr(count, field) for peer, count in counts.items()}
            for field in _LINK_COUNTS
        }
        stats = LinkStats(
            v=VERSION,
            site=self._site.name,
            boot=self._boot,
            tick=output.tick,
            t_ns=output.t_ns,
            mode=MODE_WORDS[output.mode],
            age_us=age_us,
            **by_peer,
            dropped=dict(self.dropped),
            late_max_us=self._late_max_us,
            busy_max_us=self._busy_max_us,
            overruns=self.overruns,
            **(measured or {}),
        )
        self._late_max_us = self._busy_max_us = 0
        return stats
