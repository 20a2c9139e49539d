"""Schedules the control loop of an arm, and measures the clocks of the other arms.

The control loop of each arm runs once per tick. Tick k is due k * 10^9 // rate_hz ns after the
epoch, the common start time of the session. If several loops run on one machine, their wake-ups
are spread over the tick, so that they do not compete for the processors (`find_turn_ns`).

In each tick, a site sends the state of its arm (a sample) to the sites that follow it. Each
site measures the connection from every peer using four times:

    t1: this site sends a sample           (this site's clock)
    t2: the peer receives that sample      (the peer's clock)
    t3: the peer sends a sample of its own (the peer's clock)
    t4: this site receives that sample     (this site's clock)

The peer's sample contains its own sending time t3. It also contains t2, as the acknowledgement
(echo) of this site's sample. No message can arrive before it was sent. The offset of the peer's
clock (peer minus local) is therefore at most t2 - t1 and at least t3 - t4. `offset` computes an
estimate from the tightest of these limits.

Invariant:
    - Ticks are due on the clock of the leader (the first site of the scenario), exact to the
      nanosecond (law L1 of docs/develop/design.md).
    - A site on another machine follows the leader's clock by running its own schedule slightly
      faster or slower, by at most SLEW_LIMIT. The schedule never steps, so no tick is skipped
      or repeated. If the leader disconnects, the site continues with the last estimate.
    - Measured delays never decide whether a sample is used. A sample that seems to arrive
      before it was sent is counted as a clock fault, but still used.
"""

from array import array
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ..core import Site
from ..records import NS_PER_S, TickRecord
from .messages import MODE_WORDS, VERSION, LinkStats, PeerSample
from .offset import (
    DRIFT_LIMIT,
    OffsetEstimate,
    OffsetEstimator,
    OffsetLimit,
    SlewedOffset,
    format_offset,
)
from .topics import ticks_per_stats

SLEW_LIMIT = 200_000.0
"""Maximum deviation of the rate of a schedule from that of its clock, in ns/s (200 ppm)."""
_CORRECTION_TIME_S = 2.0
"""Time constant with which a schedule corrects its error, in s.

It is long enough to average out the noise of an offset estimate.
"""


class TickSchedule:
    """Times at which the ticks of one site are due, on the clock of that site.

    The due time grows linearly with the tick number. The rate can be adjusted at any tick,
    which keeps the site on the same schedule as the leader although their clocks differ.

    Args:
        epoch_ns: Time of tick 0 on the site's clock, in ns.
        rate_hz: Tick rate of the site.

    Attributes:
        slew: Time by which each second of the schedule is lengthened, in ns/s. Negative if the
            schedule runs faster than the site's clock.
        error_ns: Lateness relative to the leader's schedule at the last call to `adjust_rate`,
            in ns.
    """

    def __init__(self, epoch_ns: int, rate_hz: int) -> None:
        self.slew = 0.0
        self.error_ns = 0
        self._rate_hz = rate_hz
        # Nominal time and scheduled time of the first tick to which the present rate applies.
        self._base_nominal_ns = 0
        self._base_ns = epoch_ns
        self._slew_per_ns = 0.0

    def due_ns(self, k: int) -> int:
        """Returns the time at which a tick is due, on the site's clock, in ns.

        Args:
            k: Number of the tick.
        """
        passed_ns = k * NS_PER_S // self._rate_hz - self._base_nominal_ns
        return self._base_ns + passed_ns + int(passed_ns * self._slew_per_ns)

    def adjust_rate(self, k: int, error_ns: int, drift: float) -> None:
        """Adjusts the rate from tick `k` onwards to bring the schedule closer to the leader's.

        The new rate compensates for the drift between the clocks, and reduces the error with
        time constant `_CORRECTION_TIME_S`. The deviation of the rate from that of the site's
        clock is limited to `SLEW_LIMIT`.

        Args:
            k: Number of the tick. It must not be earlier than the tick of the previous
                adjustment.
            error_ns: Lateness of the tick relative to the leader's schedule, in ns.
            drift: Drift of the leader's clock relative to the site's clock, in ns/s.
        """
        self._base_ns = self.due_ns(k)
        self._base_nominal_ns = k * NS_PER_S // self._rate_hz
        self.error_ns = error_ns
        wanted_slew = -drift - error_ns / _CORRECTION_TIME_S
        self.slew = min(max(wanted_slew, -SLEW_LIMIT), SLEW_LIMIT)
        self._slew_per_ns = self.slew / NS_PER_S


WINDOW_NS = 1_000_000_000
"""Length of a window of time stamps, from which an offset is estimated, in ns."""
FIRST_WINDOW_NS = 100_000_000
FIRST_WINDOWS = 5
"""Number of shorter windows at the start, which quickly improve on the offsets from pings."""
_NO_DELAY_NS = 1 << 62
"""Initial value for the search of a minimum delay, larger than any measurable delay, in ns."""


class SentStamps:
    """Stores when this site sent its most recent samples, indexed by tick.

    When a peer echoes a sample, the sending time is looked up here. The capacity of 16 384
    ticks is enough for round trips of several seconds.
    """

    def __init__(self, capacity: int = 1 << 14) -> None:
        self._capacity = capacity
        self._entries = array("q", [-1, 0]) * capacity  # tick and sending time, alternately

    def record(self, tick: int, sent_ns: int) -> None:
        """Stores the time at which the sample of a tick was sent, replacing the oldest entry.

        Args:
            tick: Number of the tick.
            sent_ns: Time of sending on the local clock, in ns.
        """
        slot = 2 * (tick % self._capacity)
        self._entries[slot] = tick
        self._entries[slot + 1] = sent_ns

    def find_ns(self, tick: int) -> int | None:
        """Returns the time at which the sample of a tick was sent, on the local clock, in ns.

        None if that time is no longer stored, or if no sample was sent in that tick.

        Args:
            tick: Number of the tick.
        """
        slot = 2 * (tick % self._capacity)
        return self._entries[slot + 1] if self._entries[slot] == tick else None


class PeerClock(NamedTuple):
    """Clock of a peer, as known when the session starts or when the peer joins.

    Attributes:
        name: Name of the peer.
        epoch_ns: Time of tick 0 on the peer's clock, in ns.
        index_at_peer: Index of this site among the peers of that peer. Echoes identify sites by
            this index.
        estimate: Offset of the peer's clock.
        estimator: Estimator that already contains the limits from pings. None if the peer runs
            on this machine, and therefore shares its clock.
    """

    name: str
    epoch_ns: int
    index_at_peer: int
    estimate: OffsetEstimate
    estimator: OffsetEstimator | None

    @property
    def is_own(self) -> bool:
        """True if the peer runs on this machine and therefore shares its clock."""
        return self.estimator is None


class LinkTimingMonitor:
    """Measures the delay of one link, and the offset between the clocks of its two sites.

    The site at the receiving end of the link creates the monitor and passes every sample from
    the peer to `receive`. Offsets are estimated from windows of time stamps. An impossible
    combination of time stamps counts as a fault, since it shows that a clock has stepped.

    Args:
        peer: Clock of the sending peer.
        sent: Times at which this site sent its own samples.

    Attributes:
        peer: Clock of the sending peer.
        offset: Offset of the peer's clock over time, used to compute delays.
        faults: Number of clock faults: impossible time stamps, and windows that contradict
            earlier ones.
        newest: Newest sample from the peer whose arrival this site has not acknowledged yet:
            its tick, and its arrival on the local clock in ns. None if all samples are
            acknowledged.
        worst_ns: Longest time by which a sample seemed to arrive before it was sent since the
            last event about a fault, in ns. 0 if there was no such sample.
        contradicted: True if a window has contradicted earlier windows since that event.
        is_unacknowledged: True if an event has reported that the peer acknowledges no samples,
            and no later event has reported that it acknowledges samples again.
    """

    def __init__(self, peer: PeerClock, sent: SentStamps) -> None:
        self.faults = 0
        self._sent = sent
        self._delays: list[int] = []
        self._shortest_round_trip_ns = _NO_DELAY_NS
        self.admit(peer)

    def admit(self, peer: PeerClock) -> None:
        """Restarts the delay measurement of a link after its sender has been restarted.

        The new process may run on a different machine, and therefore on a different clock.

        Args:
            peer: Clock of the new process.
        """
        self.peer = peer
        self.offset = SlewedOffset(peer.estimate)
        self.newest: tuple[int, int] | None = None
        self.worst_ns = 0
        self.contradicted = False
        self.is_unacknowledged = False
        self._received_ns = -1  # arrival of the newest sample
        # Newest tick that the peer has acknowledged, and arrival of that acknowledgement.
        self._acknowledged_ns = -1
        self._acknowledged_tick = -1

        self._epoch_ns = peer.epoch_ns
        self._index_at_peer = peer.index_at_peer
        self._shared_clock_offset_ns = peer.estimate.offset_ns if peer.is_own else None
        self._windows = 0
        self._window_start_ns: int | None = None
        self._open_window()

    def _open_window(self) -> None:
        """Begins a new time window, in which the minimum delay per direction is determined.

        Only the minimum is kept, because it gives the tightest limit on the offset between the
        clocks.
        """
        self._smallest_outward_ns = _NO_DELAY_NS
        self._smallest_return_ns = _NO_DELAY_NS
        self._ceiling: OffsetLimit | None = None
        self._floor: OffsetLimit | None = None

    def receive(self, sample: PeerSample, arrived_ns: int) -> int:
        """Measures the delay of a received sample, and of local samples that it acknowledges.

        A sample contains echoes: for samples that the peer has received, the time of arrival on
        the peer's clock. The echo of a local sample gives the delay from this site to the peer.

        Args:
            sample: A sample received from the peer, including echoes.
            arrived_ns: Time of its arrival on the local clock, in ns.

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

        # The peer confirms samples of all its peers. `index` identifies the peer that sent the
        # sample.
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
        """Returns True if a message from the peer has arrived within the last _UNHEARD_NS.

        Args:
            now_ns: Present time on the local clock, in ns.
        """
        return self._received_ns >= 0 and now_ns - self._received_ns <= _UNHEARD_NS

    def is_acknowledged(self, now_ns: int) -> bool | None:
        """Determines whether the peer is still receiving the samples of this site.

        The peer's samples acknowledge the samples that it has received from this site. If they
        keep arriving but have acknowledged nothing new for _UNHEARD_NS, the peer is not
        receiving this site.

        Args:
            now_ns: Present time on the local clock, in ns.

        Returns:
            True if the peer is receiving this site, and False if not. None if unknown, because
            the peer has not acknowledged any sample yet or no samples from the peer arrive.
        """
        has_confirmed_any = self._acknowledged_tick >= 0
        if not has_confirmed_any or not self.is_receiving(now_ns):
            return None
        unconfirmed_ns = self._received_ns - self._acknowledged_ns
        return unconfirmed_ns <= _UNHEARD_NS

    def close_window(self, now_ns: int, slew_ns: int) -> OffsetEstimate | None:
        """Estimates the clock offset from the current time window, once it is long enough.

        The next window then begins, and the offset used to compute delays gradually approaches
        the new estimate. A window that contradicts earlier ones shows that a clock has stepped,
        and is counted as a fault. If no estimate is possible, the bounds of the offset are
        widened, and the next windows are short.

        Args:
            now_ns: Present time on the local clock, in ns.
            slew_ns: Time on the local clock at which the offset begins to approach the
                estimate, in ns.

        Returns:
            The new estimate. None if the window is not long enough yet, or if the peer runs on
            this machine, where both sites use the same clock.
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
        contradictions_before = estimator.broken
        estimator.add(self._ceiling, self._floor)
        estimate = estimator.estimate(now_ns)
        if estimator.broken > contradictions_before:
            self.faults += 1
            self.contradicted = True
        if estimate is None:  # there were no stamps, or they contradict each other
            estimate = self.offset.estimate.widen(self._ceiling, self._floor)
            self._windows = 0
        self._open_window()
        self.offset.slew_to(slew_ns, estimate)
        return estimate

    def pop_measurements(self, now_ns: int) -> dict[str, int]:
        """Returns the offset and the delays of this link, and discards the measured delays.

        The offset and its error bound apply to the present time. The delays are those measured
        since the last call.

        Args:
            now_ns: Present time on the local clock, in ns.

        Returns:
            The fields of `LinkStats` that describe the timing of this link. A delay of -1 means
            that nothing was measured.
        """
        delays = sorted(self._delays)
        round_trip_ns = self._shortest_round_trip_ns
        self._delays = []
        self._shortest_round_trip_ns = _NO_DELAY_NS

        median_us = -1
        longest_us = -1
        if delays:
            median_us = delays[len(delays) // 2] // 1000
            longest_us = delays[-1] // 1000

        return {
            "offset_us": self.offset.evaluate_ns(now_ns) // 1000,
            # A bound is rounded up: -(-a // b) is the smallest integer that is at least a / b.
            "bound_us": -(-self.offset.error_bound_ns(now_ns) // 1000),
            "delay_us": median_us,
            "delay_max_us": longest_us,
            "rtt_us": -1 if round_trip_ns == _NO_DELAY_NS else round_trip_ns // 1000,
            "clock_faults": self.faults,
        }


FAULT_EVERY_NS = 1_000_000_000
"""Minimum time between two events about clock faults of the same peer, in ns."""
_UNHEARD_NS = 200_000_000
"""Time with no new acknowledgement after which a peer counts as not receiving this site.

The condition applies only while samples from the peer itself arrive.
"""
_FIRST_BOUND_NS = 2_000_000
"""Margin added to the clock error reported by a joining site, in ns."""


ClockNotice = dict[str, Any]
"""Fields of an event about a peer's clock, or about a peer that is not receiving this site."""


def find_turn_ns(index: int, sites: int, rate_hz: int) -> int:
    """Returns how long after the start of a tick a site wakes up, in ns.

    If all sites on a machine woke up at the same time, they would compete for its processors.
    Their wake-ups are spread over half a tick, which leaves enough time for the sample of the
    last site to arrive before the next tick of the first site.

    Args:
        index: Index of the site among the sites on its machine.
        sites: Number of these sites.
        rate_hz: Highest tick rate of these sites.
    """
    return index * NS_PER_S // (2 * sites * rate_hz)


class SiteTiming:
    """Schedules the ticks of a site, and measures the timing of the links from its peers.

    The site asks for the time of its next wake-up, reports each sample that it sends, and calls
    `update_clocks` ten times per second.

    Args:
        epoch_ns: Time of tick 0 on the site's clock, in ns.
        rate_hz: Tick rate of the site.
        peers: Clocks of the peers.
        leader: Name of the site whose schedule all sites follow.
        turn_ns: Delay of each wake-up after the start of the tick, see `find_turn_ns`.

    Attributes:
        schedule: Times at which the ticks are due.
        turn_ns: Delay of each wake-up after the start of the tick, in ns.
        monitors: Timing of the link from each peer.
    """

    def __init__(
        self,
        epoch_ns: int,
        rate_hz: int,
        peers: Sequence[PeerClock],
        leader: str,
        turn_ns: int = 0,
    ) -> None:
        """Starts the schedule of ticks, with initial estimates of the other clocks."""
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
        """Returns the time at which the process wakes up for a tick, on its own clock, in ns.

        This is the time at which the tick is due, plus the delay `turn_ns`.

        Args:
            k: Number of the tick.
        """
        return self.schedule.due_ns(k) + self.turn_ns

    def list_initial_notices(self) -> list[ClockNotice]:
        """Returns the initial clock offsets of the peers as events, one per peer, for the log.

        Peers on this machine have no offset and are left out.
        """
        return [
            _describe_estimate(monitor, 0, self._epoch_ns)
            for monitor in self.monitors
            if not monitor.peer.is_own
        ]

    def admit(
        self,
        index: int,
        t_ns: int,
        epoch_ns: int,
        bound_ns: int | None,
    ) -> list[ClockNotice]:
        """Starts to measure the link from a peer that joins, or rejoins, a running session.

        The peer reports the time of the epoch on its own clock, and how accurate this time is.
        This yields the first estimate of the offset between the clocks. Its error bound is
        wide, because no time stamps have been exchanged yet.

        Args:
            index: Index of the peer among all peers of this site.
            t_ns: Nominal time of the peer's first tick, in ns since the epoch (the common start
                of the session).
            epoch_ns: Time of the epoch on the peer's clock, as reported by the peer, in ns.
            bound_ns: Largest error of `epoch_ns`, in ns. None if the peer runs on this machine.

        Returns:
            An event that states the estimate. Empty if the peer runs on this machine.
        """
        monitor = self.monitors[index]
        clock = monitor.peer._replace(
            epoch_ns=epoch_ns, estimate=OffsetEstimate.exact(0), estimator=None
        )
        if bound_ns is None:
            monitor.admit(clock)
            return []

        # The offset is the time at which the peer's first tick is due on the peer's clock,
        # minus the time at which the same tick of this site is due on the local clock.
        k = t_ns * self._rate_hz // NS_PER_S
        due_ns = self.schedule.due_ns(k)
        offset_ns = epoch_ns + k * NS_PER_S // self._rate_hz - due_ns
        half_width_ns = bound_ns + _FIRST_BOUND_NS
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
        """Stores when a tick's sample was sent, and returns that time in ns since the epoch.

        The stored time is needed to measure the delay of the sample later.

        Args:
            tick: Number of the tick.
            now_ns: Time of sending on the site's clock, in ns.
        """
        self._sent.record(tick, now_ns)
        return now_ns - self._epoch_ns

    def pop_echo(self) -> list[tuple[int, int, int]]:
        """Returns the acknowledgements (echoes) of received samples to be sent to the peers.

        Every sample that a site publishes contains one echo per peer: the tick and the arrival
        time of the newest sample received from that peer. From the echo, the peer computes the
        delay of the link to this site. Each arrival is acknowledged only once.

        Returns:
            For each peer from which a sample has arrived since the last call: the index of the
            peer, the tick in which it sent the sample, and the time of arrival in ns since the
            epoch (the common start of the session).
        """
        echo = []
        for index, monitor in enumerate(self.monitors):
            if monitor.newest is not None:
                tick, arrived_ns = monitor.newest
                monitor.newest = None
                echo.append((index, tick, arrived_ns - self._epoch_ns))
        return echo

    def update_clocks(self, k: int, now_ns: int) -> list[ClockNotice]:
        """Updates the clock offset of one peer, and adjusts the schedule to the leader's.

        All sites follow the schedule of the leader (the first site of the scenario). If the
        leader runs on another machine, the error of the local schedule is computed with the
        smoothed offset of the leader's clock: the time on the leader's clock when tick k is due
        at this site, minus the nominal time k / rate of this tick, both since the epoch (the
        start of the session). The error is positive if the tick is late relative to the
        leader's schedule.

        Estimating an offset takes a considerable part of a tick, so each call processes at most
        one peer.

        Args:
            k: Number of the next tick, from which the adjusted schedule applies.
            now_ns: Present time on the site's clock, in ns.

        Returns:
            Events about new estimates, about clock faults, and about peers that are not
            receiving this site.
        """
        due_ns = self.schedule.due_ns(k)
        notices = self._update_next_estimate(k, now_ns, due_ns)
        for index, monitor in enumerate(self.monitors):
            notices += self._find_faults(index, k, now_ns)
            is_leader = monitor.peer.name == self._leader_name
            if is_leader and not monitor.peer.is_own:
                # The offset is the leader's clock minus the local clock.
                due_on_leader_clock_ns = due_ns + monitor.offset.evaluate_ns(due_ns)
                since_epoch_ns = due_on_leader_clock_ns - monitor.peer.epoch_ns
                nominal_ns = k * NS_PER_S // self._rate_hz
                error_ns = since_epoch_ns - nominal_ns
                self.schedule.adjust_rate(k, error_ns, monitor.offset.estimate.drift)
        return notices

    def _update_next_estimate(self, k: int, now_ns: int, due_ns: int) -> list[ClockNotice]:
        """Estimates the clock offset of at most one peer, taking the peers in turn.

        One estimate takes a considerable part of a tick. Several of them in one call would
        delay the next tick.

        Args:
            k: Next tick.
            now_ns: Present time on the site's clock, in ns.
            due_ns: Time at which that tick is due, on the site's clock, in ns.

        Returns:
            The event that states the new estimate. Empty if no peer has a full window of time
            stamps.
        """
        for _ in self.monitors:
            self._next_estimated = (self._next_estimated + 1) % len(self.monitors)
            monitor = self.monitors[self._next_estimated]
            if monitor.close_window(now_ns, due_ns) is not None:
                return [_describe_estimate(monitor, k, due_ns)]
        return []

    def _find_faults(self, index: int, k: int, now_ns: int) -> list[ClockNotice]:
        """Returns the events about a peer's clock faults and about its acknowledgements.

        Clock faults are reported at most once per `FAULT_EVERY_NS`. If the peer no longer
        acknowledges the samples of this site, this is reported once when it begins and once
        when it ends.

        Args:
            index: Index of the peer.
            k: Next tick.
            now_ns: Present time on the site's clock, in ns.
        """
        monitor = self.monitors[index]
        notices = []
        is_faulty = bool(monitor.worst_ns) or monitor.contradicted
        if is_faulty and now_ns - self._fault_notice_ns[index] >= FAULT_EVERY_NS:
            self._fault_notice_ns[index] = now_ns
            notices.append(_describe_fault(monitor))
            monitor.worst_ns = 0
            monitor.contradicted = False

        is_acknowledged = monitor.is_acknowledged(now_ns)
        if is_acknowledged is None:  # not known at present
            return notices
        was_acknowledged = not monitor.is_unacknowledged  # value that the last event reported
        if is_acknowledged != was_acknowledged:
            monitor.is_unacknowledged = not is_acknowledged
            notices.append(_describe_acknowledgement(monitor, k))
        return notices

    def pop_measurements(self, now_ns: int) -> dict[str, Any]:
        """Returns the timing statistics of the site, and resets the measured delays.

        Args:
            now_ns: Present time on the local clock, in ns.

        Returns:
            The timing fields of `LinkStats`. The first fields are the lateness of this site
            relative to the leader's schedule and the correction of its own rate. All other
            fields are dictionaries that map the name of the site at the other end of a link to
            the measured quantity.
        """
        stats: dict[str, Any] = {
            "grid_error_us": self.schedule.error_ns // 1000,
            "slew_ppb": round(self.schedule.slew),
        }
        for monitor in self.monitors:
            for field, value in monitor.pop_measurements(now_ns).items():
                stats.setdefault(field, {})[monitor.peer.name] = value
        return stats


def _describe_estimate(monitor: LinkTimingMonitor, k: int, local_ns: int) -> ClockNotice:
    """Returns the event that states the offset and the drift of a peer's clock.

    It shows users and readers of the log how accurate the measured delays are.

    Args:
        monitor: Timing of the link from the peer.
        k: First tick to which the offset applies.
        local_ns: Time of that tick on the local clock, in ns.
    """
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
    """Returns the event that reports that a peer's clock, or the local clock, has stepped.

    The evidence is a sample that seems to have arrived before it was sent, or a window of time
    stamps that contradicts earlier windows.
    """
    name = monitor.peer.name

    early_ns = monitor.worst_ns
    bound_ns = monitor.offset.bound_ns
    if early_ns:
        fault = f"a sample arrived {early_ns / 1e6:.3f} ms before it was sent"
    else:
        bound_us = bound_ns / 1000
        fault = f"time stamps contradict earlier ones, beyond the bound of {bound_us:.0f} us"

    return {
        "kind": "clock fault",
        "text": f"clock of {name}: {fault}; one of the two clocks has stepped",
        "about": name,
        "offset_ns": early_ns,
        "bound_ns": bound_ns,
    }


def _describe_acknowledgement(monitor: LinkTimingMonitor, k: int) -> ClockNotice:
    """Returns the event that a peer no longer receives this site, or receives it again.

    Samples from the peer arrive in both cases. The event tells users that the connection is
    interrupted only in the other direction, from this site to the peer.

    Args:
        monitor: Timing of the link from the peer.
        k: Current tick, which the event states in its field `ticks`.
    """
    name = monitor.peer.name
    if monitor.is_unacknowledged:
        timeout_ms = _UNHEARD_NS // 1_000_000
        kind = "unheard"
        text = (
            f"samples of {name} arrive, but {name} has acknowledged none of this site's "
            f"samples for {timeout_ms} ms"
        )
    else:
        kind = "heard"
        text = f"{name} acknowledges this site's samples again"
    return {"kind": kind, "text": text, "about": name, "ticks": k}


_LINK_COUNTS = ("accepted", "late", "duplicate", "refused", "lost", "superseded", "copies")
"""Counters of a link kept by the kernel, which `LinkStats` contains for each peer."""


class LoopStats:
    """Statistics of a control loop and its network links, published ten times per second.

    Args:
        site: The site in the simulation kernel, which counts the samples that arrive on each
            link.
        boot: Random number that identifies this start of the site's process.

    Attributes:
        dropped: Mapping from reason to the number of messages dropped since the start.
        overruns: Number of ticks since the start that began after the next tick was due, or
            that were skipped.
        skipped: Number of ticks skipped since the start.
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
        self.skipped = 0

    @property
    def late_ticks(self) -> int:
        """Number of ticks that began after the next tick was already due."""
        return self.overruns - self.skipped

    def count_tick(self, late_us: int, busy_us: int, skipped: int = 0) -> None:
        """Adds one tick to the statistics.

        The statistics contain sums since the start, and maxima since the last publication.

        Args:
            late_us: Lateness of the beginning of the tick, in us.
            busy_us: Computing time of the previous tick, in us.
            skipped: Number of ticks that were skipped before this tick.
        """
        self.overruns += skipped
        self.skipped += skipped
        if late_us > self._late_max_us:
            self._late_max_us = late_us
        if busy_us > self._busy_max_us:
            self._busy_max_us = busy_us
        self.overruns += late_us >= self._period_us

    def is_due(self, k: int, skipped: int = 0) -> bool:
        """Returns True if the site publishes its statistics after tick `k`.

        Statistics are published every `ticks_per_stats` ticks. If the tick of a publication is
        skipped, the statistics are published after the next tick that is executed.

        Args:
            k: Number of the tick.
            skipped: Number of ticks that were skipped before it.
        """
        # Number of ticks since the last tick at which statistics were due.
        ticks_since_due = k % self._ticks_per_stats
        return ticks_since_due <= skipped

    def pop_stats(
        self, output: TickRecord, measured: Mapping[str, Any] | None = None
    ) -> LinkStats:
        """Returns the statistics after a tick, and resets the maxima.

        The maxima are the largest lateness and the largest computing time of a tick since the
        last call.

        Args:
            output: Result of the tick.
            measured: Timing fields of `LinkStats`. If None, they keep their defaults.
        """
        peers = self._site.peers
        counts = dict(zip(peers, self._site.counts(), strict=True))

        age_us = {}  # age of the peer's sample that the tick used, -1 if there was none
        for peer, used, rate_hz in zip(peers, output.used, self._peer_rates_hz, strict=True):
            age_us[peer] = -1
            if used >= 0:
                sample_ns = used * NS_PER_S // rate_hz
                age_us[peer] = (output.t_ns - sample_ns) // 1000

        counts_by_field: dict[str, Any] = {}
        for field in _LINK_COUNTS:
            counts_by_field[field] = {
                peer: getattr(count, field) for peer, count in counts.items()
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
