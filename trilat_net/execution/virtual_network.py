"""Networks of an execution: the receiver's tick at which each sample arrives, prompt or as a
log recorded it.

Invariant (L2): delay belongs to the link. A network only decides at which tick a sample
arrives; as long as that precedes the tick at which the sample is due, the numbers do not depend
on it. A rerun delivers a sample where the log says that it arrived, never where the log
excludes it; in ticks without a record an arrival is assumed, and counted as such.
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
    """Joins the sites of a virtual run."""

    def send(self, sender: str, output: TickRecord) -> None:
        """Takes the record of one tick from its sender."""

    def is_ready(self, receiver: str, k: int) -> bool:
        """True where everything that arrives for tick k of a receiver has been sent."""

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """Returns what arrives for tick k of a receiver, in order."""


class PromptNetwork:
    """Every sample arrives at the first tick of the receiver after its stamp; `rates` by site,
    Hz.
    """

    def __init__(self, rates: Mapping[str, int]) -> None:
        self._rates = rates
        self._under_way: dict[str, dict[str, deque[TickRecord]]] = {
            i: {j: deque() for j in rates if j != i} for i in rates
        }

    def send(self, sender: str, output: TickRecord) -> None:
        """See `Network`."""
        for receiver, queues in self._under_way.items():
            if receiver != sender:
                queues[sender].append(output)

    def is_ready(self, receiver: str, k: int) -> bool:  # noqa: ARG002 - see `Network`
        """See `Network`: in order of time, always true."""
        return True

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """See `Network`."""
        now_ns = k * NS_PER_S // self._rates[receiver]
        arrivals = []
        for index, queue in enumerate(self._under_way[receiver].values()):
            while queue and queue[0].t_ns < now_ns:
                sample = queue.popleft()
                latency_us = (now_ns - sample.t_ns) // 1000
                arrivals.append(make_arrival(index, sample.tick, sample, latency_us))
        return arrivals


class RecordedNetwork:
    """Samples arrive where a log says that they did, per site and tick; running sites make
    their content.
    """

    def __init__(
        self,
        schedule: Mapping[str, Mapping[int, Sequence[ArrivalEntry]]],
        peers: Mapping[str, Sequence[str]],
    ) -> None:
        self._schedule = schedule
        self._peers = peers
        self._sent: dict[tuple[str, int], TickRecord] = {}
        self._came = dict.fromkeys(schedule, (0, 0))

    def send(self, sender: str, output: TickRecord) -> None:
        """See `Network`."""
        self._sent[sender, output.tick] = output

    def is_ready(self, receiver: str, k: int) -> bool:
        """See `Network`. A loop that was late received samples of ticks ahead of its own."""
        peers = self._peers[receiver]
        entries = self._schedule[receiver].get(k, ())
        asked, came = self._came[receiver]
        n = came if asked == k else 0
        while n < len(entries) and (peers[entries[n][0]], entries[n][1]) in self._sent:
            n += 1
        self._came[receiver] = k, n
        return n == len(entries)

    def deliver(self, receiver: str, k: int) -> list[Arrival]:
        """See `Network`. A sample that its sender never made does not arrive.

        Behind a gap of the log more may be assumed to arrive than a tick takes: the newest do.
        """
        arrivals = []
        for j, tick, latency_us in self._schedule[receiver].get(k, ()):
            sample = self._sent.get((self._peers[receiver][j], tick))
            if sample is not None:
                arrivals.append(make_arrival(j, tick, sample, latency_us))
        return arrivals[-MAX_ARRIVALS:]


class Deliveries(NamedTuple):
    """The arrivals of one site per tick, in order, from the first tick with a record to the
    last, or -1.

    In the `unrecorded` ticks between them arrivals are assumed.
    """

    entries: dict[int, Sequence[ArrivalEntry]]
    unrecorded: frozenset[int]
    first: int
    last: int


def read_deliveries(part: SiteLog) -> Deliveries:
    """Returns the arrivals of a site that its records list."""
    counts, rows = part.arrivals
    entries = rows.tolist()
    at: dict[int, Sequence[ArrivalEntry]] = {}
    start = 0
    for tick, stop in zip(part.tick.tolist(), np.cumsum(counts).tolist(), strict=True):
        at[tick] = [entry for entry in entries[start:stop] if 0 <= entry[0] < len(part.peers)]
        start = stop
    return Deliveries(at, frozenset(), min(at, default=0), max(at, default=-1))


def complete_deliveries(
    part: SiteLog, rates_hz: Sequence[int], ends: Sequence[int]
) -> Deliveries:
    """Returns the arrivals of a site at every tick from its first record to its last.

    At ticks without a record those samples arrive that no record lists and that can have
    arrived there: after they were sent, after the last earlier sample that a record lists,
    before the first later one, as near as possible to the median delay of their link. `ends`
    are the last ticks that the peers made.

    Raises:
        LogError: fewer than half of those ticks have a record.
    """
    known = read_deliveries(part)
    at = known.entries
    ticks = known.last + 1 - known.first
    if len(at) == ticks:
        return known
    if 2 * len(at) < ticks:
        raise LogError(
            f"{part.name} has records of {len(at)} of {count_nouns(ticks, 'tick')}: too few "
            "to execute what lies between"
        )
    missing = [tick for tick in range(known.first, known.last) if tick not in at]
    assumed: dict[int, list[list[int]]] = {}
    for peer, (peer_hz, end) in enumerate(zip(rates_hz, ends, strict=True)):
        for tick, entry in _assume_arrivals(
            known=known,
            missing=missing,
            rate_hz=part.rate_hz,
            peer=peer,
            peer_hz=peer_hz,
            end=end,
        ):
            assumed.setdefault(tick, []).append(entry)
    filled = at | {tick: sorted(entries) for tick, entries in assumed.items()}
    return known._replace(entries=filled, unrecorded=frozenset(missing))


def _find_first_arrivals(deliveries: Deliveries, peer: int) -> dict[int, tuple[int, int]]:
    first: dict[int, tuple[int, int]] = {}
    for k in sorted(deliveries.entries):
        for j, tick, us in deliveries.entries[k]:
            if j == peer and tick >= 0:
                first.setdefault(tick, (k, us))
    return first


def _assume_arrivals(
    known: Deliveries, missing: list[int], rate_hz: int, peer: int, peer_hz: int, end: int
) -> Iterator[tuple[int, list[int]]]:
    first = _find_first_arrivals(known, peer)
    listed = sorted(first)
    lags_ns = [first[m][0] * NS_PER_S // rate_hz - m * NS_PER_S // peer_hz for m in listed]
    lag_ns = median_low(lags_ns) if lags_ns else NS_PER_S // rate_hz
    delay_us = median_low(us for _, us in first.values()) if first else 0
    newest = min(end, known.last * peer_hz // rate_hz)
    for m in range(newest + 1):
        due = -(-(m * NS_PER_S // peer_hz + lag_ns) * rate_hz // NS_PER_S)
        if m in first or due < known.first:
            continue
        place = bisect_left(listed, m)
        before = first[listed[place - 1]][0] if place else known.first
        after = first[listed[place]][0] if place < len(listed) else known.last
        sent = m * rate_hz // peer_hz + 1  # nothing arrives before it was sent
        start = bisect_left(missing, max(min(before, after), sent))
        stop = bisect_left(missing, max(before, after) + 1)
        if start < stop:
            nearest = min(max(bisect_left(missing, due), start), stop - 1)
            candidates = (missing[nearest], missing[max(nearest - 1, start)])
            yield min(candidates, key=lambda tick: abs(tick - due)), [peer, m, delay_us]


def retime_deliveries(
    deliveries: Deliveries,
    rate_hz: int,
    new_rate_hz: int,
    rates_hz: Sequence[int],
    new_rates_hz: Sequence[int],
) -> Deliveries:
    """Returns the arrivals over the same network for sites that tick at other rates.

    A sample is under way for as long as the last sample of the log that was not stamped later,
    from its stamp to the tick that received it; if that one never arrived, neither does this
    one. Rates, Hz: the site's and its peers', in the log and in the rerun.
    """
    end_ns = deliveries.last * NS_PER_S // rate_hz
    at: dict[int, list[ArrivalEntry]] = {}
    for peer, (old_hz, new_hz) in enumerate(zip(rates_hz, new_rates_hz, strict=True)):
        first = _find_first_arrivals(deliveries, peer)
        for m in range(end_ns * new_hz // NS_PER_S + 1):
            stamp_ns = m * NS_PER_S // new_hz
            model = ((stamp_ns + 1) * old_hz - 1) // NS_PER_S
            if model in first:
                k, us = first[model]
                lag_ns = k * NS_PER_S // rate_hz - model * NS_PER_S // old_hz
                tick = -(-(stamp_ns + lag_ns) * new_rate_hz // NS_PER_S)
                at.setdefault(tick, []).append((peer, m, us))
    return Deliveries(dict(at), frozenset(), 0, end_ns * new_rate_hz // NS_PER_S)
