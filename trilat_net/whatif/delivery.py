"""Which samples come to a site, and at which of its ticks: what the network of the log did.

Law: a sample comes when the log says that it did, and never where the log knows that it did not; delay is the
link's business (L2) and may be another. Where a record is missing, what came is assumed, and told apart.
"""

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from statistics import median_low
from typing import NamedTuple

import numpy as np

from ..core.grid import NS_PER_S
from ..errors import LogError
from ..log.reader import SiteLog

Listed = Sequence[int]
"""As in a record's `rx`: index of the peer, tick of its sample, us."""


class Deliveries(NamedTuple):
    """What comes to one site.

    Attributes:
        at: per tick what arrives, in order.
        unrecorded: ticks between the first record and the last without one: what arrives then is assumed.
        first: the first tick that has a record.
        last: the last one, -1 where there is none.
    """

    at: dict[int, Sequence[Listed]]
    unrecorded: frozenset[int]
    first: int
    last: int


class Sender(NamedTuple):
    """What there is to know of a peer: its tick rate, Hz, and the last tick that it made."""

    rate_hz: int
    last: int


def recorded(part: SiteLog) -> Deliveries:
    """Returns what came to a site, by its records alone."""
    counts, rows = part.arrivals
    entries = rows.tolist()
    stops = np.cumsum(counts).tolist()
    at: dict[int, Sequence[Listed]] = {}
    start = 0
    for tick, stop in zip(part.tick.tolist(), stops, strict=True):
        at[tick] = [entry for entry in entries[start:stop] if 0 <= entry[0] < len(part.peers)]
        start = stop
    return Deliveries(at, frozenset(), min(at, default=0), max(at, default=-1))


def complete(part: SiteLog, senders: Sequence[Sender]) -> Deliveries:
    """Returns what came to a site at every tick from its first record to its last.

    At ticks without a record come those samples that no record lists and that can have come there: after
    they were sent, behind the last one before them that a record lists, before the first one after them, as
    near as can be to when they would have come by the median of their link.

    Args:
        part: the site's records.
        senders: its peers, in scenario order.

    Raises:
        LogError: fewer than half of those ticks have a record.
    """
    known = recorded(part)
    at, ticks = known.at, known.last + 1 - known.first
    if len(at) == ticks:
        return known
    if 2 * len(at) < ticks:
        raise LogError(
            f"{part.name} has records of {len(at)} of {ticks} ticks: too few to execute what lies between"
        )
    missing = [tick for tick in range(known.first, known.last) if tick not in at]
    assumed: dict[int, list[list[int]]] = {}
    for peer, sender in enumerate(senders):
        for tick, entry in _assumed(known, missing, part.rate_hz, peer, sender):
            assumed.setdefault(tick, []).append(entry)
    filled = at | {tick: sorted(came) for tick, came in assumed.items()}
    return known._replace(at=filled, unrecorded=frozenset(missing))


def _first_ticks(came: Deliveries, peer: int) -> dict[int, tuple[int, int]]:
    """Returns of every sample of a peer that came when it first did: the tick, and the us of its entry."""
    first: dict[int, tuple[int, int]] = {}
    for k in sorted(came.at):
        for j, tick, us in came.at[k]:
            if j == peer and tick >= 0:
                first.setdefault(tick, (k, us))
    return first


def _assumed(
    known: Deliveries, missing: list[int], rate_hz: int, peer: int, sender: Sender
) -> Iterator[tuple[int, list[int]]]:
    """Yields at which missing tick each sample of a peer came that no record lists."""
    first = _first_ticks(known, peer)
    listed = sorted(first)
    lags_ns = [first[m][0] * NS_PER_S // rate_hz - m * NS_PER_S // sender.rate_hz for m in listed]
    lag_ns = median_low(lags_ns) if lags_ns else NS_PER_S // rate_hz
    delay_us = median_low(us for _, us in first.values()) if first else 0
    newest = min(sender.last, known.last * sender.rate_hz // rate_hz)
    for m in range(newest + 1):
        due = -(-(m * NS_PER_S // sender.rate_hz + lag_ns) * rate_hz // NS_PER_S)
        if m in first or due < known.first:
            continue
        place = bisect_left(listed, m)
        before = first[listed[place - 1]][0] if place else known.first
        behind = first[listed[place]][0] if place < len(listed) else known.last
        sent = m * rate_hz // sender.rate_hz + 1  # nothing comes before it was sent
        tick = _nearest(missing, due, max(min(before, behind), sent), max(before, behind))
        if tick is not None:
            yield tick, [peer, m, delay_us]


def _nearest(missing: list[int], due: int, low: int, high: int) -> int | None:
    """Returns the missing tick from `low` to `high` that is nearest to `due`, or None."""
    start, stop = bisect_left(missing, low), bisect_left(missing, high + 1)
    if start >= stop:
        return None
    place = min(max(bisect_left(missing, due), start), stop - 1)
    before = max(place - 1, start)
    return min(missing[place], missing[before], key=lambda tick: abs(tick - due))


def retimed(
    came: Deliveries, rate_hz: int, new_rate_hz: int, rates_hz: Sequence[int], new_rates_hz: Sequence[int]
) -> Deliveries:
    """Returns the same network for sites that tick at other rates.

    A sample is under way for as long as the last sample of the log that was not stamped later, from its
    stamp to the tick that took it in; where that one never came, it does not come either.

    Args:
        came: what came to a site by the log.
        rate_hz: its rate in the log.
        new_rate_hz: its rate in the rerun.
        rates_hz: per peer the rate in the log.
        new_rates_hz: per peer the rate in the rerun.
    """
    end_ns = came.last * NS_PER_S // rate_hz
    at: dict[int, list[Listed]] = {}
    for peer, (old_hz, new_hz) in enumerate(zip(rates_hz, new_rates_hz, strict=True)):
        first = _first_ticks(came, peer)
        for m in range(end_ns * new_hz // NS_PER_S + 1):
            stamp_ns = m * NS_PER_S // new_hz
            model = ((stamp_ns + 1) * old_hz - 1) // NS_PER_S
            if model in first:
                k, us = first[model]
                lag_ns = k * NS_PER_S // rate_hz - model * NS_PER_S // old_hz
                tick = -(-(stamp_ns + lag_ns) * new_rate_hz // NS_PER_S)
                at.setdefault(tick, []).append((peer, m, us))
    return Deliveries(dict(at), frozenset(), 0, end_ns * new_rate_hz // NS_PER_S)
