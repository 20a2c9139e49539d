"""Simulates when messages between arms arrive, in place of a real network.

In each tick, an arm sends its state (a sample) to the other arms. There are two kinds of
networks:

- `PromptNetwork` delivers a sample in the first tick after it was sent.
- `RecordedNetwork` delivers a sample in the tick in which it arrived according to a log. If
  records are missing from the log, the arrivals in their ticks are estimated. If the tick rate
  was changed, the arrivals are converted.

Invariant:
    - A network only decides when a sample arrives. The receiver then holds the sample until the
      delay of the link has passed (L2). An arrival before that time has no effect.
    - A recorded sample is delivered in the tick in which it arrived according to the log.
    - A sample is never delivered in a tick in which it did not arrive according to the log.
      Ticks without a record, whose arrivals are estimated, are marked.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from statistics import median_low
from typing import NamedTuple, Protocol

from ..core import MAX_ARRIVALS
from ..errors import LogError, count_nouns
from ..log import SiteLog
from ..records import NS_PER_S, Arrival, TickRecord
from .resumption import ArrivalEntry, make_arrival


class Network(Protocol):
    """Interface of a network between the sites of a simulation in virtual time.

    A network determines in which tick of the receiver a sample arrives. The simulation calls
    `send` after each tick of a site, and `deliver` before each tick.
    """

    def send(self, sender: str, output: TickRecord) -> None:
        """Accepts the sample that a site sends after a tick, for later delivery.

        Args:
            sender: Name of the site.
            output: Results of the tick, which contain the sample.
        """

    def is_ready(self, receiver: str, k: int) -> bool:
        """Returns True if all samples that a site receives in its next tick have been sent.

        Only then can the next tick be executed.

        Args:
            receiver: Name of the site.
            k: Number of its next tick.
        """

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """Returns the samples that arrive at a site during one tick, in order of arrival.

        Args:
            receiver: Name of the site.
            k: Number of the tick.
        """


class PromptNetwork:
    """Simulated network that delivers every sample without delay.

    A sample arrives in the receiver's first tick after it was sent. Delays prescribed by the
    scenario are applied later, by the receiver.

    Args:
        rates: Mapping from site to tick rate, in Hz.
    """

    def __init__(self, rates: Mapping[str, int]) -> None:
        self._rates = rates
        self._in_transit: dict[str, dict[str, deque[TickRecord]]] = {
            receiver: {sender: deque() for sender in rates if sender != receiver}
            for receiver in rates
        }

    def send(self, sender: str, output: TickRecord) -> None:
        """Stores the sample of a tick until all other sites have received it."""
        for receiver, queues in self._in_transit.items():
            if receiver != sender:
                queues[sender].append(output)

    def is_ready(self, receiver: str, k: int) -> bool:  # noqa: ARG002 - see `Network`
        """Returns True, because a site never has to wait before executing its next tick.

        The sites are simulated in order of time, so all earlier samples have been sent.
        """
        return True

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """Returns the samples sent before tick `k` that the site has not received yet."""
        now_ns = k * NS_PER_S // self._rates[receiver]
        arrivals = []
        for index, queue in enumerate(self._in_transit[receiver].values()):
            while queue and queue[0].t_ns < now_ns:
                sample = queue.popleft()
                latency_us = (now_ns - sample.t_ns) // 1000
                arrivals.append(make_arrival(index, sample.tick, sample, latency_us))
        return arrivals


class RecordedNetwork:
    """Simulated network in which samples arrive in the same ticks as in a log.

    Only the arrival times are taken from the log. The content of a sample is that of the
    simulated sender, which may differ from the log if settings were changed.

    Args:
        schedule: Arrivals at each site, keyed by tick of the receiver.
        peers: For each site, the names of the other sites in scenario order.
    """

    def __init__(
        self,
        schedule: Mapping[str, Mapping[int, Sequence[ArrivalEntry]]],
        peers: Mapping[str, Sequence[str]],
    ) -> None:
        self._schedule = schedule
        self._peers = peers
        self._sent: dict[tuple[str, int], TickRecord] = {}
        # For each receiver, the tick that `is_ready` checked last, and the number of arrivals
        # that had been sent then. These need not be checked again.
        self._checked = dict.fromkeys(schedule, (0, 0))

    def send(self, sender: str, output: TickRecord) -> None:
        """Stores a sent sample under its sender and tick until it is delivered."""
        self._sent[sender, output.tick] = output

    def is_ready(self, receiver: str, k: int) -> bool:
        """Returns True if all samples that the log lists for a receiver's tick have been sent.

        In a live session, a site whose loop ran late may have received samples with later time
        stamps than its own tick. The senders of these samples must run first. Meanwhile, this
        method is called repeatedly. Each call continues with the first sample that had not been
        sent at the end of the previous call.

        Args:
            receiver: Name of the receiving site.
            k: Number of its next tick.
        """
        sender_names = self._peers[receiver]
        arrivals = self._schedule[receiver].get(k, ())  # (index of the sender, tick, latency)
        checked_tick, sent_count = self._checked[receiver]
        if checked_tick != k:
            sent_count = 0
        for sender_index, sent_tick, _ in arrivals[sent_count:]:
            if (sender_names[sender_index], sent_tick) not in self._sent:
                break
            sent_count += 1
        self._checked[receiver] = (k, sent_count)
        return sent_count == len(arrivals)

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """Returns the samples that arrive in tick `k` of a receiver according to the log.

        Samples that the sender has not produced do not arrive. After a gap in the log, more
        samples may be assumed to arrive than a tick accepts (`MAX_ARRIVALS`). In this case,
        only the newest samples are returned.
        """
        peers = self._peers[receiver]
        arrivals = []
        for peer, tick, latency_us in self._schedule[receiver].get(k, ()):
            sample = self._sent.get((peers[peer], tick))
            if sample is not None:
                arrivals.append(make_arrival(peer, tick, sample, latency_us))
        return arrivals[-MAX_ARRIVALS:]


class Deliveries(NamedTuple):
    """Samples that one site received from other sites according to a log.

    Attributes:
        entries: Samples that arrived in each tick, in order of arrival, keyed by tick.
        unrecorded: Ticks between `first` and `last` whose record is missing from the log. Their
            entries are estimated.
        first: First tick with a record.
        last: Last tick with a record. -1 if there are no records.
    """

    entries: dict[int, Sequence[ArrivalEntry]]
    unrecorded: frozenset[int]
    first: int
    last: int

    @classmethod
    def read(cls, site_log: SiteLog) -> "Deliveries":
        """Reads from a site's records which samples arrived in each tick.

        Ticks without a record are left out; use `Deliveries.complete` to fill them in.

        Args:
            site_log: Records of the site, each of which lists the samples that arrived in its
                tick.
        """
        counts, rows = site_log.arrivals
        arrivals = rows.tolist()  # those of all ticks, one after another
        peer_count = len(site_log.peers)
        entries: dict[int, Sequence[ArrivalEntry]] = {}
        start = 0
        for tick, count in zip(site_log.tick.tolist(), counts.tolist(), strict=True):
            stop = start + count
            # A damaged record may list a peer that the site does not have.
            entries[tick] = [
                entry for entry in arrivals[start:stop] if 0 <= entry[0] < peer_count
            ]
            start = stop
        return cls(
            entries=entries,
            unrecorded=frozenset(),
            first=min(entries, default=0),
            last=max(entries, default=-1),
        )

    @classmethod
    def complete(
        cls, site_log: SiteLog, rates_hz: Sequence[int], last_ticks: Sequence[int]
    ) -> "Deliveries":
        """Returns the arrivals at a site for every tick from its first to its last record.

        If the record of a tick is missing, the log does not show which samples arrived in this
        tick. A sample that no record lists is assumed to have arrived in a tick without a
        record. This tick must be after the sample was sent, after the arrival of the last
        earlier sample that a record lists, and before the arrival of the first later sample. If
        several ticks meet these conditions, the tick whose delay is closest to the median delay
        of the link is chosen. If no tick does, the sample does not arrive.

        Args:
            site_log: Records of the site, each of which lists the samples that arrived in its
                tick.
            rates_hz: Tick rates of the site's peers, in Hz.
            last_ticks: Last tick of each peer, in the same order.

        Raises:
            LogError: Fewer than half of the ticks have a record.
        """
        recorded = Deliveries.read(site_log)
        tick_count = recorded.last + 1 - recorded.first
        if len(recorded.entries) == tick_count:
            return recorded
        if 2 * len(recorded.entries) < tick_count:
            raise LogError(
                f"{site_log.name} has records of only {len(recorded.entries)} of "
                f"{count_nouns(tick_count, 'tick')}: too few to execute the ticks between them"
            )

        unrecorded = [
            tick
            for tick in range(recorded.first, recorded.last)
            if tick not in recorded.entries
        ]
        assumed: dict[int, list[list[int]]] = {}
        for peer, (peer_hz, end) in enumerate(zip(rates_hz, last_ticks, strict=True)):
            arrivals = _assume_arrivals(
                recorded=recorded,
                unrecorded=unrecorded,
                rate_hz=site_log.rate_hz,
                peer=peer,
                peer_hz=peer_hz,
                end=end,
            )
            for tick, entry in arrivals:
                assumed.setdefault(tick, []).append(entry)

        entries = dict(recorded.entries)
        for tick, tick_entries in assumed.items():
            entries[tick] = sorted(tick_entries)
        return recorded._replace(entries=entries, unrecorded=frozenset(unrecorded))

    def retime(
        self,
        rate_hz: int,
        new_rate_hz: int,
        rates_hz: Sequence[int],
        new_rates_hz: Sequence[int],
    ) -> "Deliveries":
        """Converts the arrivals of a log to arrivals for sites with different tick rates.

        The network is assumed to be the same. Each sample of the new run is matched with the
        last sample of the log that was sent at the same time or earlier. The new sample takes
        as long from its time stamp to the tick of its arrival as the recorded sample did. If
        the recorded sample never arrived, neither does the new sample.

        Args:
            rate_hz: Tick rate of the site in the log, in Hz.
            new_rate_hz: Tick rate of the site in the new run, in Hz.
            rates_hz: Tick rates of its peers in the log, in Hz.
            new_rates_hz: Tick rates of its peers in the new run, in Hz.
        """
        end_ns = self.last * NS_PER_S // rate_hz
        entries: dict[int, list[ArrivalEntry]] = {}
        for peer, (old_hz, new_hz) in enumerate(zip(rates_hz, new_rates_hz, strict=True)):
            first_arrivals = _find_first_arrivals(self, peer)
            for sample_tick in range(end_ns * new_hz // NS_PER_S + 1):
                stamp_ns = sample_tick * NS_PER_S // new_hz
                # The last sample m of the log with the stamp m * NS_PER_S // old_hz <=
                # stamp_ns.
                model_tick = ((stamp_ns + 1) * old_hz - 1) // NS_PER_S
                if model_tick not in first_arrivals:
                    continue
                arrival_tick, latency_us = first_arrivals[model_tick]
                arrival_ns = arrival_tick * NS_PER_S // rate_hz
                model_stamp_ns = model_tick * NS_PER_S // old_hz
                lag_ns = arrival_ns - model_stamp_ns
                new_arrival_tick = _round_up_to_tick(stamp_ns + lag_ns, new_rate_hz)
                entries.setdefault(new_arrival_tick, []).append((peer, sample_tick, latency_us))
        return Deliveries(
            entries=dict(entries),
            unrecorded=frozenset(),
            first=0,
            last=end_ns * new_rate_hz // NS_PER_S,
        )


def _find_first_arrivals(deliveries: Deliveries, peer: int) -> dict[int, tuple[int, int]]:
    """Returns when each sample from a peer arrived for the first time.

    Args:
        deliveries: Arrivals at the receiver.
        peer: Index of the sender among the receiver's peers.

    Returns:
        A mapping from the tick of each sample to the tick of its first arrival and its latency
        in microseconds.
    """
    first_arrivals: dict[int, tuple[int, int]] = {}
    for k in sorted(deliveries.entries):
        for sender, tick, latency_us in deliveries.entries[k]:
            if sender == peer and tick >= 0:
                first_arrivals.setdefault(tick, (k, latency_us))
    return first_arrivals


def _assume_arrivals(
    recorded: Deliveries,
    unrecorded: list[int],
    rate_hz: int,
    peer: int,
    peer_hz: int,
    end: int,
) -> Iterator[tuple[int, list[int]]]:
    """Yields assumed arrivals of samples from one peer that no record lists.

    Because records are missing from the log, the true arrivals are unknown.

    Args:
        recorded: Arrivals that the records list.
        unrecorded: Ticks without a record, in ascending order.
        rate_hz: Tick rate of the receiver, in Hz.
        peer: Index of the sender among the receiver's peers.
        peer_hz: Tick rate of the sender, in Hz.
        end: Last tick of the sender.

    Yields:
        The tick of the arrival, and its entry in the format of a record's `rx`.
    """
    first_arrivals = _find_first_arrivals(recorded, peer)
    listed = sorted(first_arrivals)
    lags_ns = []
    for sample in listed:
        arrival_ns = first_arrivals[sample][0] * NS_PER_S // rate_hz
        lags_ns.append(arrival_ns - sample * NS_PER_S // peer_hz)
    lag_ns = median_low(lags_ns) if lags_ns else NS_PER_S // rate_hz
    latencies_us = [latency_us for _, latency_us in first_arrivals.values()]
    latency_us = median_low(latencies_us) if latencies_us else 0

    newest = min(end, recorded.last * peer_hz // rate_hz)
    for sample in range(newest + 1):
        stamp_ns = sample * NS_PER_S // peer_hz
        expected_tick = _round_up_to_tick(stamp_ns + lag_ns, rate_hz)
        if sample in first_arrivals or expected_tick < recorded.first:
            continue

        # The sample arrived between the samples before and after it. These may have overtaken
        # each other, so either may be the earlier arrival.
        index = bisect_left(listed, sample)
        arrival_before = recorded.first
        if index > 0:
            arrival_before = first_arrivals[listed[index - 1]][0]
        arrival_after = recorded.last
        if index < len(listed):
            arrival_after = first_arrivals[listed[index]][0]
        first_tick_after_stamp = sample * rate_hz // peer_hz + 1
        earliest = max(min(arrival_before, arrival_after), first_tick_after_stamp)
        latest = max(arrival_before, arrival_after)

        # Choose the possible tick that is nearest to the expected one.
        start = bisect_left(unrecorded, earliest)
        stop = bisect_left(unrecorded, latest + 1)
        if start < stop:
            position = min(max(bisect_left(unrecorded, expected_tick), start), stop - 1)
            tick = unrecorded[position]
            previous_tick = unrecorded[max(position - 1, start)]
            if abs(previous_tick - expected_tick) < abs(tick - expected_tick):
                tick = previous_tick
            yield tick, [peer, sample, latency_us]


def _round_up_to_tick(t_ns: int, rate_hz: int) -> int:
    """Returns the first tick at or after a time in ns, in exact integer arithmetic."""
    return -(-t_ns * rate_hz // NS_PER_S)
