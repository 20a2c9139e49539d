"""Simulated networks: at which tick of the receiver each sample arrives.

`PromptNetwork` delivers a sample at the first tick after its stamp. `RecordedNetwork` delivers
samples at the ticks that a log recorded (`read_deliveries`), completes where records are
missing (`complete_deliveries`), or moves to other tick rates (`retime_deliveries`).

Invariant:
    - Delay belongs to the link (L2). A network only decides at which tick a sample arrives. If
      a sample arrives before the tick at which it is due, the numbers of the run do not depend
      on that tick.
    - A recorded sample is delivered at the tick at which the log says that it arrived.
    - A sample is never delivered at a tick at which the log excludes its arrival. At ticks
      without a record an arrival is assumed, and the tick counts as unrecorded.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from statistics import median_low
from typing import NamedTuple, Protocol

import numpy as np

from ..core.ticks import MAX_ARRIVALS, NS_PER_S, Arrival, TickRecord
from ..errors import LogError, count_nouns
from ..log.site_log import SiteLog
from .resumption import ArrivalEntry, make_arrival


class Network(Protocol):
    """The network between the sites of a virtual run."""

    def send(self, sender: str, output: TickRecord) -> None:
        """Accepts the record of one tick of a sender for delivery to its peers."""

    def is_ready(self, receiver: str, k: int) -> bool:
        """True if every sample that arrives at tick `k` of a receiver has been sent."""

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """Returns the samples that arrive at tick `k` of a receiver, in order."""


class PromptNetwork:
    """Delivers every sample at the first tick of the receiver after the sample's stamp.

    Args:
        rates: tick rate of each site, Hz.
    """

    def __init__(self, rates: Mapping[str, int]) -> None:
        self._rates = rates
        self._in_transit: dict[str, dict[str, deque[TickRecord]]] = {
            receiver: {sender: deque() for sender in rates if sender != receiver}
            for receiver in rates
        }

    def send(self, sender: str, output: TickRecord) -> None:
        """See `Network`."""
        for receiver, queues in self._in_transit.items():
            if receiver != sender:
                queues[sender].append(output)

    def is_ready(self, receiver: str, k: int) -> bool:  # noqa: ARG002 - see `Network`
        """Returns True: the sites run in order of time, so every earlier sample was sent."""
        return True

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """See `Network`."""
        now_ns = k * NS_PER_S // self._rates[receiver]
        arrivals = []
        for index, queue in enumerate(self._in_transit[receiver].values()):
            while queue and queue[0].t_ns < now_ns:
                sample = queue.popleft()
                latency_us = (now_ns - sample.t_ns) // 1000
                arrivals.append(make_arrival(index, sample.tick, sample, latency_us))
        return arrivals


class RecordedNetwork:
    """Delivers samples at the ticks that a log recorded, with the content of the running sites.

    Args:
        schedule: the arrivals of each site, by tick.
        peers: the peers of each site, in scenario order.
    """

    def __init__(
        self,
        schedule: Mapping[str, Mapping[int, Sequence[ArrivalEntry]]],
        peers: Mapping[str, Sequence[str]],
    ) -> None:
        self._schedule = schedule
        self._peers = peers
        self._sent: dict[tuple[str, int], TickRecord] = {}
        # per receiver the tick checked last, and how many of its arrivals were sent by then
        self._checked = dict.fromkeys(schedule, (0, 0))

    def send(self, sender: str, output: TickRecord) -> None:
        """See `Network`."""
        self._sent[sender, output.tick] = output

    def is_ready(self, receiver: str, k: int) -> bool:
        """See `Network`.

        A site whose loop ran late in the log received samples of later times than its own tick,
        so the senders of these samples have to run first.
        """
        peers = self._peers[receiver]
        entries = self._schedule[receiver].get(k, ())
        checked_tick, sent_count = self._checked[receiver]
        if checked_tick != k:
            sent_count = 0
        for peer, tick, _ in entries[sent_count:]:
            if (peers[peer], tick) not in self._sent:
                break
            sent_count += 1
        self._checked[receiver] = (k, sent_count)
        return sent_count == len(entries)

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """See `Network`. A sample that its sender did not produce does not arrive.

        After a gap of the log more samples may be assumed to arrive than a tick accepts
        (`MAX_ARRIVALS`); then the newest of them arrive.
        """
        peers = self._peers[receiver]
        arrivals = []
        for peer, tick, latency_us in self._schedule[receiver].get(k, ()):
            sample = self._sent.get((peers[peer], tick))
            if sample is not None:
                arrivals.append(make_arrival(peer, tick, sample, latency_us))
        return arrivals[-MAX_ARRIVALS:]


class Deliveries(NamedTuple):
    """The arrivals at one site, by tick.

    Attributes:
        entries: the arrivals of each tick, in order.
        unrecorded: ticks between `first` and `last` that have no record, so that their arrivals
            are assumed.
        first: first tick with a record.
        last: last tick with a record; -1 without records.
    """

    entries: dict[int, Sequence[ArrivalEntry]]
    unrecorded: frozenset[int]
    first: int
    last: int


def read_deliveries(part: SiteLog) -> Deliveries:
    """Returns the arrivals at a site that its records list."""
    counts, rows = part.arrivals
    arrivals = rows.tolist()
    entries: dict[int, Sequence[ArrivalEntry]] = {}
    start = 0
    for tick, stop in zip(part.tick.tolist(), np.cumsum(counts).tolist(), strict=True):
        # a damaged record may list a peer that the site does not have
        entries[tick] = [
            entry for entry in arrivals[start:stop] if 0 <= entry[0] < len(part.peers)
        ]
        start = stop
    return Deliveries(
        entries=entries,
        unrecorded=frozenset(),
        first=min(entries, default=0),
        last=max(entries, default=-1),
    )


def complete_deliveries(
    part: SiteLog, rates_hz: Sequence[int], ends: Sequence[int]
) -> Deliveries:
    """Returns the arrivals at a site for every tick from its first record to its last.

    At a tick without a record, samples are assumed to arrive that no record lists and that can
    have arrived there: after the sample was sent, after the last earlier sample that a record
    lists, and before the first later sample that a record lists. Among these ticks the nearest
    to the median delay of the link is chosen.

    Args:
        part: the records of the site.
        rates_hz: tick rates of its peers, Hz.
        ends: last ticks of its peers.

    Raises:
        LogError: fewer than half of these ticks have a record.
    """
    recorded = read_deliveries(part)
    ticks = recorded.last + 1 - recorded.first
    if len(recorded.entries) == ticks:
        return recorded
    if 2 * len(recorded.entries) < ticks:
        raise LogError(
            f"{part.name} has records of {len(recorded.entries)} of "
            f"{count_nouns(ticks, 'tick')}: too few to execute what lies between"
        )
    unrecorded = [
        tick for tick in range(recorded.first, recorded.last) if tick not in recorded.entries
    ]
    assumed: dict[int, list[list[int]]] = {}
    for peer, (peer_hz, end) in enumerate(zip(rates_hz, ends, strict=True)):
        arrivals = _assume_arrivals(
            recorded=recorded,
            unrecorded=unrecorded,
            rate_hz=part.rate_hz,
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


def _find_first_arrivals(deliveries: Deliveries, peer: int) -> dict[int, tuple[int, int]]:
    """Returns when each sample of a peer arrived first.

    Returns:
        By the tick of the sample: the tick of its first arrival, and its latency, us.
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
    """Yields the assumed arrivals of the samples of one peer that no record lists.

    Args:
        recorded: the arrivals that the records list.
        unrecorded: the ticks without a record, ascending.
        rate_hz: tick rate of the receiver, Hz.
        peer: index of the sender among the receiver's peers.
        peer_hz: tick rate of the sender, Hz.
        end: last tick of the sender.

    Yields:
        The tick of the arrival, and its entry as in a record's `rx`.
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
        due = -(-(stamp_ns + lag_ns) * rate_hz // NS_PER_S)  # rounded up to a tick
        if sample in first_arrivals or due < recorded.first:
            continue
        # the arrivals of the samples before and after it, which may have overtaken each other
        index = bisect_left(listed, sample)
        before = recorded.first
        if index > 0:
            before = first_arrivals[listed[index - 1]][0]
        after = recorded.last
        if index < len(listed):
            after = first_arrivals[listed[index]][0]
        earliest = max(min(before, after), sample * rate_hz // peer_hz + 1)
        start = bisect_left(unrecorded, earliest)
        stop = bisect_left(unrecorded, max(before, after) + 1)
        if start < stop:
            position = min(max(bisect_left(unrecorded, due), start), stop - 1)
            tick = unrecorded[position]
            previous_tick = unrecorded[max(position - 1, start)]
            if abs(previous_tick - due) < abs(tick - due):
                tick = previous_tick
            yield tick, [peer, sample, latency_us]


def retime_deliveries(
    deliveries: Deliveries,
    rate_hz: int,
    new_rate_hz: int,
    rates_hz: Sequence[int],
    new_rates_hz: Sequence[int],
) -> Deliveries:
    """Returns the arrivals over the same network for sites that tick at other rates.

    Each sample of the rerun has a model: the last sample of the log that was not stamped later.
    The sample takes as long from its stamp to the tick that receives it as its model did. If
    the model never arrived, the sample does not arrive either.

    Args:
        deliveries: the arrivals at the site in the log.
        rate_hz: tick rate of the site in the log, Hz.
        new_rate_hz: tick rate of the site in the rerun, Hz.
        rates_hz: tick rates of its peers in the log, Hz.
        new_rates_hz: tick rates of its peers in the rerun, Hz.
    """
    end_ns = deliveries.last * NS_PER_S // rate_hz
    entries: dict[int, list[ArrivalEntry]] = {}
    for peer, (old_hz, new_hz) in enumerate(zip(rates_hz, new_rates_hz, strict=True)):
        first_arrivals = _find_first_arrivals(deliveries, peer)
        for sample in range(end_ns * new_hz // NS_PER_S + 1):
            stamp_ns = sample * NS_PER_S // new_hz
            model = ((stamp_ns + 1) * old_hz - 1) // NS_PER_S
            if model not in first_arrivals:
                continue
            arrival_tick, latency_us = first_arrivals[model]
            arrival_ns = arrival_tick * NS_PER_S // rate_hz
            lag_ns = arrival_ns - model * NS_PER_S // old_hz
            tick = -(-(stamp_ns + lag_ns) * new_rate_hz // NS_PER_S)  # rounded up to a tick
            entries.setdefault(tick, []).append((peer, sample, latency_us))
    return Deliveries(
        entries=dict(entries),
        unrecorded=frozenset(),
        first=0,
        last=end_ns * new_rate_hz // NS_PER_S,
    )
