"""Timing of a running site: tick deadlines, time stamps, and the clock offset of each link.

Tick k is due at k * 10^9 // rate_hz ns after the epoch. Sites on one machine wake up one after
another after that instant, see `find_turn_ns`.

Four stamps make a round trip: the local sending (t1) and the peer's receipt (t2) of the record
that the peer echoes, and the peer's sending (t3) and the local receipt (t4) of the record that
carries the echo.

Invariant:
    - Rule L1: ticks are due to the nanosecond, on the leader's clock.
    - A site on another clock follows the leader's clock by slewing its schedule by at most
      SLEW_LIMIT, never by a step. While the leader is away, the site follows the leader's clock
      as last estimated.
    - Measuring changes no number of a run: an impossible stamp is counted, and its sample is
      used all the same.
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
_CORRECTION_TIME_S = 2.0
"""Time constant with which a schedule corrects its error, in s.

It is long against the noise of an offset estimate.
"""


class TickSchedule:
    """Schedule of one site's ticks, on the site's clock.

    Attributes:
        slew: rate by which the schedule lags behind the clock, ns/s.
        error_ns: lateness against the leader's schedule at the last `adjust_rate`.
    """

    def __init__(self, epoch_ns: int, rate_hz: int) -> None:
        self.slew = 0.0
        self.error_ns = 0
        self._rate_hz = rate_hz
        self._base_nominal_ns = 0
        self._base_ns = epoch_ns
        self._slew_per_ns = 0.0

    def due_ns(self, k: int) -> int:
        """Returns the instant at which tick `k` is due, on the site's clock, in ns."""
        passed_ns = k * NS_PER_S // self._rate_hz - self._base_nominal_ns
        return self._base_ns + passed_ns + int(passed_ns * self._slew_per_ns)

    def adjust_rate(self, k: int, error_ns: int, drift: float) -> None:
        """Adjusts the rate from tick `k` on, so that the schedule approaches the leader's.

        Args:
            k: the tick; no earlier than that of the last adjustment.
            error_ns: lateness of the tick against the leader's schedule.
            drift: drift of the leader's clock against the site's clock, ns/s.
        """
        self._base_ns = self.due_ns(k)
        self._base_nominal_ns = k * NS_PER_S // self._rate_hz
        self.error_ns = error_ns
        self.slew = min(max(-drift - error_ns / _CORRECTION_TIME_S, -SLEW_LIMIT), SLEW_LIMIT)
        self._slew_per_ns = self.slew / NS_PER_S


WINDOW_NS = 1_000_000_000
"""Length of a window of the offset estimate, in ns."""
FIRST_WINDOW_NS = 100_000_000
FIRST_WINDOWS = 5
"""The first windows are shorter, so that the offsets soon become better than those of pings."""
_NO_DELAY_NS = 1 << 62
"""Larger than any delay: there is no measurement yet."""


class SentStamps:
    """Sending times of the latest local records, by tick.

    The capacity is enough for round trips of several seconds.
    """

    def __init__(self, capacity: int = 1 << 14) -> None:
        self._capacity = capacity
        self._entries = array("q", [-1, 0]) * capacity  # tick and sending time, alternately

    def record(self, tick: int, sent_ns: int) -> None:
        """Stores the sending time of a record, on the local clock."""
        slot = 2 * (tick % self._capacity)
        self._entries[slot] = tick
        self._entries[slot + 1] = sent_ns

    def find_ns(self, tick: int) -> int | None:
        """Returns the sending time of a record, or None if it is no longer stored."""
        slot = 2 * (tick % self._capacity)
        return self._entries[slot + 1] if self._entries[slot] == tick else None


class PeerClock(NamedTuple):
    """Clock of a peer at the start of the session.

    Attributes:
        name: name of the peer.
        epoch_ns: instant of tick 0 on the peer's clock.
        index_at_peer: index of this site among the peer's peers.
        estimate: offset of the peer's clock.
        estimator: the limits of the offset that pings found; None if this site and the peer
            share one clock.
    """

    name: str
    epoch_ns: int
    index_at_peer: int
    estimate: OffsetEstimate
    estimator: OffsetEstimator | None

    @property
    def is_own(self) -> bool:
        """True if the peer's clock is this site's clock, too."""
        return self.estimator is None


class LinkTimingMonitor:
    """Timing of one link, at its receiving end.

    Args:
        peer: clock of the sending peer.
        sent: sending times of this site's records.

    Attributes:
        peer: clock of the sending peer.
        offset: offset of the peer's clock, in use.
        faults: number of impossible stamps and of contradicting windows since the start.
        newest: tick of the newest sample since the last echo, and its arrival on the local
            clock, in ns.
        worst_ns: longest time by which a sample arrived before it was sent, since the last
            notice.
        contradicted: True if a window has contradicted those before since the last notice.
        is_unacknowledged: True from the notice that the peer acknowledges nothing until the
            notice that it does so again.
    """

    def __init__(self, peer: PeerClock, sent: SentStamps) -> None:
        self.faults = 0
        self._sent = sent
        self._delays: list[int] = []
        self._shortest_round_trip_ns = _NO_DELAY_NS
        self.admit(peer)

    def admit(self, peer: PeerClock) -> None:
        """Starts anew with another start of the peer, and its clock."""
        self.peer = peer
        self.offset = SlewedOffset(peer.estimate)
        self.newest: tuple[int, int] | None = None
        self.worst_ns = 0
        self.contradicted = False
        self.is_unacknowledged = False
        self._received_ns = -1
        self._acknowledged_ns = -1
        self._acknowledged_tick = -1
        self._epoch_ns = peer.epoch_ns
        self._index_at_peer = peer.index_at_peer
        self._shared_clock_offset_ns = peer.estimate.offset_ns if peer.is_own else None
        self._windows = 0
        self._window_start_ns: int | None = None
        self._open_window()

    def _open_window(self) -> None:
        # The smallest delays of the window give its tightest limits.
        self._smallest_outward_ns = _NO_DELAY_NS
        self._smallest_return_ns = _NO_DELAY_NS
        self._ceiling: OffsetLimit | None = None
        self._floor: OffsetLimit | None = None

    def receive(self, sample: PeerSample, arrived_ns: int) -> int:
        """Evaluates the stamps of one sample.

        Args:
            sample: the sample.
            arrived_ns: its arrival on the local clock.

        Returns:
            The one-way delay of the sample, in ns.
        """
        if self._shared_clock_offset_ns is None:
            offset_ns = self.offset.evaluate_ns(arrived_ns)
        else:
            offset_ns = self._shared_clock_offset_ns
        sent_ns = sample.sent_ns + self._epoch_ns
        delay_ns = arrived_ns - sent_ns + offset_ns
        self._delays.append(delay_ns)
        if delay_ns < self._smallest_return_ns:
            self._smallest_return_ns = delay_ns
            self._floor = OffsetLimit(arrived_ns, sent_ns - arrived_ns)
        # The bound is computed only for negative delays, which are rare.
        if delay_ns < 0 and delay_ns < -self.offset.error_bound_ns(arrived_ns):
            self.faults += 1
            self.worst_ns = max(self.worst_ns, -delay_ns)
        if self.newest is None or sample.tick > self.newest[0]:
            self.newest = sample.tick, arrived_ns
        self._received_ns = arrived_ns
        for index, tick, peer_arrival_ns in sample.echo:
            if index != self._index_at_peer:
                continue
            local_sent_ns = self._sent.find_ns(tick)
            if local_sent_ns is None:
                continue
            if tick > self._acknowledged_tick:
                self._acknowledged_tick = tick
                self._acknowledged_ns = arrived_ns
            reached_ns = peer_arrival_ns + self._epoch_ns
            outward_ns = reached_ns - offset_ns - local_sent_ns
            if outward_ns < self._smallest_outward_ns:
                self._smallest_outward_ns = outward_ns
                self._ceiling = OffsetLimit(local_sent_ns, reached_ns - local_sent_ns)
            if outward_ns + delay_ns < self._shortest_round_trip_ns:
                self._shortest_round_trip_ns = outward_ns + delay_ns
        return delay_ns

    def is_receiving(self, now_ns: int) -> bool:
        """True if a sample of the peer arrived within UNHEARD_NS."""
        return self._received_ns >= 0 and now_ns - self._received_ns <= UNHEARD_NS

    def is_acknowledged(self, now_ns: int) -> bool | None:
        """True if the peer acknowledged a newer sample within UNHEARD_NS.

        None before the peer's first acknowledgement, and while nothing arrives from the peer.
        """
        if self._acknowledged_tick < 0 or not self.is_receiving(now_ns):
            return None
        return self._received_ns - self._acknowledged_ns <= UNHEARD_NS

    def close_window(self, now_ns: int, slew_ns: int) -> OffsetEstimate | None:
        """Closes the window if it is long enough, and starts to slew to the new estimate.

        Args:
            now_ns: the present, on the local clock.
            slew_ns: instant at which the slew starts, on the local clock.

        Returns:
            The new estimate; None if the window stays open, or if both sites share one clock.
        """
        estimator = self.peer.estimator
        if estimator is None:
            return None
        if self._window_start_ns is None:
            self._window_start_ns = now_ns
        length_ns = FIRST_WINDOW_NS if self._windows < FIRST_WINDOWS else WINDOW_NS
        if now_ns - self._window_start_ns < length_ns:
            return None
        self._window_start_ns = now_ns
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
        self.offset.slew_to(slew_ns, estimate)
        return estimate

    def pop_measurements(self, now_ns: int) -> dict[str, int]:
        """Returns the link's timing fields of `LinkStats` since the last call."""
        delays = sorted(self._delays)
        round_trip_ns = self._shortest_round_trip_ns
        self._delays = []
        self._shortest_round_trip_ns = _NO_DELAY_NS
        return {
            "offset_us": self.offset.evaluate_ns(now_ns) // 1000,
            "bound_us": -(-self.offset.error_bound_ns(now_ns) // 1000),
            "delay_us": delays[len(delays) // 2] // 1000 if delays else -1,
            "delay_max_us": delays[-1] // 1000 if delays else -1,
            "rtt_us": -1 if round_trip_ns == _NO_DELAY_NS else round_trip_ns // 1000,
            "clock_faults": self.faults,
        }


FAULT_EVERY_NS = 1_000_000_000
"""Shortest time between two notices of clock faults of one peer, in ns."""
UNHEARD_NS = 200_000_000
"""Time without a new acknowledgement after which a peer counts as not receiving this site.

The peer itself must be received meanwhile.
"""
FIRST_BOUND_NS = 2_000_000
"""Error of a joining site's clock that is allowed for besides the stated bound, in ns."""


ClockNotice = dict[str, Any]
"""The fields of an event about a clock, or about a peer that does not receive this site."""


def find_turn_ns(index: int, sites: int, rate_hz: int) -> int:
    """Returns how long after a tick of the schedule a site wakes up, in ns.

    Sites on one machine that woke up at one instant would wait for one another's processors.
    Their turns cover half of a period, so that a sample of the last site still arrives well
    before the next tick of the first.

    Args:
        index: index of the site among the sites on its machine.
        sites: number of these sites.
        rate_hz: the highest of their tick rates.
    """
    return index * NS_PER_S // (2 * sites * rate_hz)


class SiteTiming:
    """Deadlines of a site, and timing of its links.

    Args:
        epoch_ns: instant of tick 0 on the site's clock.
        rate_hz: tick rate of the site.
        peers: clocks of the peers.
        leader: name of the site whose schedule is the session's.
        turn_ns: delay of the wake-up after a tick of the schedule, see `find_turn_ns`.

    Attributes:
        schedule: the ticks of the site.
        turn_ns: delay of the wake-up after a tick of the schedule.
        monitors: timing of the link from each peer.
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
        for monitor in self.monitors:
            monitor.offset.slew_to(epoch_ns, monitor.peer.estimate)
        self._leader_name = leader
        self._next_estimated = 0
        self._fault_notice_ns = [-FAULT_EVERY_NS] * len(peers)

    def deadline_ns(self, k: int) -> int:
        """Returns the instant at which the site wakes up for tick `k`, on its clock, in ns."""
        return self.schedule.due_ns(k) + self.turn_ns

    def list_initial_notices(self) -> list[ClockNotice]:
        """Returns the events about the peers' clocks before tick 0."""
        return [
            _describe_estimate(monitor, 0, self._epoch_ns)
            for monitor in self.monitors
            if not monitor.peer.is_own
        ]

    def admit(
        self, index: int, t_ns: int, epoch_ns: int, bound_ns: int | None
    ) -> list[ClockNotice]:
        """Starts the timing of a peer that joins, or rejoins, a running session.

        Args:
            index: index of the peer.
            t_ns: nominal time of the peer's first tick, since the epoch.
            epoch_ns: instant of the epoch on the peer's clock, as the peer states it.
            bound_ns: largest error of that instant; None if the peer shares this site's clock.

        Returns:
            The events about the peer's clock.
        """
        monitor = self.monitors[index]
        clock = monitor.peer._replace(
            epoch_ns=epoch_ns, estimate=exact_offset(0), estimator=None
        )
        if bound_ns is None:
            monitor.admit(clock)
            return []
        k = t_ns * self._rate_hz // NS_PER_S
        due_ns = self.schedule.due_ns(k)
        offset_ns = epoch_ns + k * NS_PER_S // self._rate_hz - due_ns
        half_width_ns = bound_ns + FIRST_BOUND_NS
        estimate = OffsetEstimate(
            local_ns=due_ns,
            offset_ns=offset_ns,
            drift=0.0,
            low_ns=offset_ns - half_width_ns,
            high_ns=offset_ns + half_width_ns,
            drift_low=-DRIFT_LIMIT,
            drift_high=DRIFT_LIMIT,
        )
        monitor.admit(clock._replace(estimate=estimate, estimator=OffsetEstimator()))
        return [_describe_estimate(monitor, k, due_ns)]

    def record_sent(self, tick: int, now_ns: int) -> int:
        """Stores the sending time of a record, and returns it in ns since the epoch."""
        self._sent.record(tick, now_ns)
        return now_ns - self._epoch_ns

    def pop_echo(self) -> list[tuple[int, int, int]]:
        """Returns the newest sample of each peer since the last call, see `State.echo`.

        Each entry is (index of the peer, tick, arrival in ns since the epoch).
        """
        echo = []
        for index, monitor in enumerate(self.monitors):
            if monitor.newest is not None:
                tick, arrived_ns = monitor.newest
                monitor.newest = None
                echo.append((index, tick, arrived_ns - self._epoch_ns))
        return echo

    def update_clocks(self, k: int, now_ns: int) -> list[ClockNotice]:
        """Updates one offset estimate, and adjusts the schedule; called ten times a second.

        Args:
            k: the next tick, from which on the schedule is adjusted.
            now_ns: the present, on the site's clock.

        Returns:
            The events about clocks and about peers that do not receive this site.
        """
        due_ns = self.schedule.due_ns(k)
        notices = self._update_next_estimate(k, now_ns, due_ns)
        for index, monitor in enumerate(self.monitors):
            notices += self._find_faults(index, k, now_ns)
            if monitor.peer.name == self._leader_name and not monitor.peer.is_own:
                leader_ns = due_ns + monitor.offset.evaluate_ns(due_ns) - monitor.peer.epoch_ns
                error_ns = leader_ns - k * NS_PER_S // self._rate_hz
                self.schedule.adjust_rate(k, error_ns, monitor.offset.estimate.drift)
        return notices

    def _update_next_estimate(self, k: int, now_ns: int, due_ns: int) -> list[ClockNotice]:
        """Closes at most one window, since an estimate takes a considerable part of a tick.

        The monitors have their turns one after another.
        """
        for _ in self.monitors:
            self._next_estimated = (self._next_estimated + 1) % len(self.monitors)
            monitor = self.monitors[self._next_estimated]
            if monitor.close_window(now_ns, due_ns) is not None:
                return [_describe_estimate(monitor, k, due_ns)]
        return []

    def _find_faults(self, index: int, k: int, now_ns: int) -> list[ClockNotice]:
        """Returns the events about one peer's clock faults and acknowledgements."""
        monitor = self.monitors[index]
        notices = []
        is_faulty = bool(monitor.worst_ns) or monitor.contradicted
        if is_faulty and now_ns - self._fault_notice_ns[index] >= FAULT_EVERY_NS:
            self._fault_notice_ns[index] = now_ns
            notices.append(_describe_fault(monitor))
            monitor.worst_ns = 0
            monitor.contradicted = False
        # None, for a silent peer, is equal to neither True nor False.
        if monitor.is_unacknowledged is monitor.is_acknowledged(now_ns):
            monitor.is_unacknowledged = not monitor.is_unacknowledged
            notices.append(_describe_acknowledgement(monitor, k))
        return notices

    def pop_measurements(self, now_ns: int) -> dict[str, Any]:
        """Returns the timing fields of `LinkStats` since the last call."""
        stats: dict[str, Any] = {
            "grid_error_us": self.schedule.error_ns // 1000,
            "slew_ppb": round(self.schedule.slew),
        }
        for monitor in self.monitors:
            for field, value in monitor.pop_measurements(now_ns).items():
                stats.setdefault(field, {})[monitor.peer.name] = value
        return stats


def _describe_estimate(monitor: LinkTimingMonitor, k: int, local_ns: int) -> ClockNotice:
    """Returns the event that states the offset in use, from tick `k` at `local_ns` on."""
    offset = monitor.offset
    estimate = offset.estimate
    name = monitor.peer.name
    offset_ns = offset.evaluate_ns(local_ns)
    drift_above = estimate.drift_high - estimate.drift
    drift_below = estimate.drift - estimate.drift_low
    drift_bound = max(drift_above, drift_below)
    offset_text = format_offset(offset_ns, offset.bound_ns)
    return {
        "kind": "clock",
        "text": f"clock of {name}: {offset_text}, drift {estimate.drift / 1000:+.2f} ppm",
        "about": name,
        "ticks": k,
        "offset_ns": offset_ns,
        "bound_ns": offset.bound_ns,
        "drift_ppb": round(estimate.drift),
        "drift_bound_ppb": round(drift_bound) + 1,
    }


def _describe_fault(monitor: LinkTimingMonitor) -> ClockNotice:
    """Returns the event about impossible stamps, or about a window that contradicts others."""
    name = monitor.peer.name
    early_ns = monitor.worst_ns
    bound_ns = monitor.offset.bound_ns
    if early_ns:
        fault = f"a sample came {early_ns / 1e6:.3f} ms before it was sent"
    else:
        bound_us = bound_ns / 1000
        fault = f"its stamps contradict those before, beyond the bound of {bound_us:.0f} us"
    return {
        "kind": "clock fault",
        "text": f"clock of {name}: {fault}; one of the two clocks has stepped",
        "about": name,
        "offset_ns": early_ns,
        "bound_ns": bound_ns,
    }


def _describe_acknowledgement(monitor: LinkTimingMonitor, k: int) -> ClockNotice:
    """Returns the event that a peer has stopped, or resumed, to acknowledge samples."""
    name = monitor.peer.name
    if monitor.is_unacknowledged:
        timeout_ms = UNHEARD_NS // 1_000_000
        text = f"{name} is heard and does not hear: for {timeout_ms} ms it acknowledged nothing"
        return {"kind": "unheard", "text": text, "about": name, "ticks": k}
    return {"kind": "heard", "text": f"{name} hears again", "about": name, "ticks": k}


_LINK_COUNTS = ("accepted", "late", "duplicate", "refused", "lost", "superseded", "copies")


class LoopStats:
    """Counters of a site's loop, since the last statistics and since the start.

    Attributes:
        dropped: messages that were dropped, by reason, since the start.
        overruns: ticks whose work began after the next tick was due, or that were skipped,
            since the start.
    """

    def __init__(self, site: Site, boot: int) -> None:
        self._site = site
        self._boot = boot
        self._peer_rates_hz = [site.peer_rate_hz(peer) for peer in range(len(site.peers))]
        self._ticks_per_stats = ticks_per_stats(site.rate_hz)
        self._period_us = 1_000_000 / site.rate_hz
        self._late_max_us = 0
        self._busy_max_us = 0
        self.dropped: Counter[str] = Counter()
        self.overruns = 0

    def count_tick(self, late_us: int, busy_us: int, skipped: int = 0) -> None:
        """Counts one tick.

        Args:
            late_us: lateness of the tick.
            busy_us: computing time of the previous tick.
            skipped: number of ticks that were skipped before this one.
        """
        self.overruns += skipped
        if late_us > self._late_max_us:
            self._late_max_us = late_us
        if busy_us > self._busy_max_us:
            self._busy_max_us = busy_us
        self.overruns += late_us >= self._period_us

    def is_due(self, k: int, skipped: int = 0) -> bool:
        """True if statistics are published after tick `k`, or were due at a skipped tick."""
        return k % self._ticks_per_stats <= skipped

    def pop_stats(
        self, output: TickRecord, measured: Mapping[str, Any] | None = None
    ) -> LinkStats:
        """Returns the statistics after a tick, and resets the largest lateness and time.

        Args:
            output: the record of the tick.
            measured: timing fields of `LinkStats`, if they were measured.
        """
        peers = self._site.peers
        counts = dict(zip(peers, self._site.counts(), strict=True))
        age_us = {
            peer: (output.t_ns - used * NS_PER_S // rate_hz) // 1000 if used >= 0 else -1
            for peer, used, rate_hz in zip(peers, output.used, self._peer_rates_hz, strict=True)
        }
        counts_by_field: dict[str, Any] = {
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
            **counts_by_field,
            dropped=dict(self.dropped),
            late_max_us=self._late_max_us,
            busy_max_us=self._busy_max_us,
            overruns=self.overruns,
            **(measured or {}),
        )
        self._late_max_us = 0
        self._busy_max_us = 0
        return stats
