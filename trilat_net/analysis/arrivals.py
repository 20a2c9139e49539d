"""What came over a link, as the receiver's records list it.

Law (L3): a record names its inputs. What a missing record would have named is unknown, and is counted
neither as come nor as missing.
"""

from typing import NamedTuple

import numpy as np

from ..core.grid import NS_PER_S
from ..core.link import AHEAD_LIMIT_NS
from ..log.reader import Ints, Log
from .fates import Bools, first_ticks


class Arrivals(NamedTuple):
    """What came over a link, in the order taken in.

    Attributes:
        tick: the receiver's tick, shape (A,).
        sample: the sample's own tick, shape (A,).
        delay_us: the number beside it in the record, shape (A,), us.
        refused: how many more came with a stamp out of range, or of a tick that their sender never makes.
    """

    tick: Ints
    sample: Ints
    delay_us: Ints
    refused: int

    @property
    def first(self) -> "Arrivals":
        """The same without what came again, by sample."""
        sample, place = np.unique(self.sample, return_index=True)
        return Arrivals(self.tick[place], sample, self.delay_us[place], self.refused)


def arrivals(log: Log, site: str) -> dict[str, Arrivals]:
    """Returns what came to a site, per peer."""
    part = log[site]
    counts, entries = part.arrivals
    tick = np.repeat(part.tick, counts)
    found = {}
    for index, peer in enumerate(part.peers):
        here = entries[:, 0] == index
        at, sample, delay_us = tick[here], entries[here, 1], entries[here, 2]
        known = _in_range(at, sample, part.rate_hz, log.scenario.sites[peer].rate_hz)
        known &= sample < log.scenario.ticks(peer)
        refused = len(at) - int(np.count_nonzero(known))
        found[peer] = Arrivals(at[known], sample[known], delay_us[known], refused)
    return found


def _in_range(tick: Ints, sample: Ints, rate_hz: int, peer_rate_hz: int) -> Bools:
    """Returns which stamps a link takes: none before the epoch, none more than the limit ahead."""
    latest_ns = tick * NS_PER_S // rate_hz + AHEAD_LIMIT_NS
    limit = ((latest_ns + 1) * peer_rate_hz - 1) // NS_PER_S  # in ticks: a stamp itself might overflow
    known: Bools = (sample >= 0) & (sample <= limit)
    return known


def sent(log: Log, peer: str, newest: int) -> int:
    """Returns how many samples a peer has sent, as far as the log tells.

    Args:
        log: the log.
        peer: who sends.
        newest: the newest of its samples that came anywhere; -1: none.
    """
    part = log[peer]
    said = [event.ticks for event in log.events if event.kind == "end" and event.member == peer]
    recorded = int(part.tick[-1]) + 1 if len(part) else 0
    return min(max(newest + 1, recorded, *said), log.scenario.ticks(peer))


def judged(log: Log, site: str, stamp_ns: Ints, came: Arrivals) -> Bools:
    """Returns for which samples it is known whether they came, shape (M,).

    Known are those that came, those older than the newest that came, and those older than the slowest
    took; except those that may have come in a tick whose record is missing.

    Args:
        log: the log.
        site: who receives.
        stamp_ns: the stamps of the samples 0 to M - 1, ns since the epoch.
        came: what came of them, each once.
    """
    part, count = log[site], len(stamp_ns)
    if not len(part):
        return np.zeros(count, dtype=np.bool_)
    prompt = first_ticks(stamp_ns + 1, part.rate_hz)
    slowest = int((came.tick - prompt[came.sample]).max(initial=0))
    newest = int(came.sample.max(initial=-1))
    last = min(int(part.tick[-1]), log.scenario.ticks(site) - 1)
    known: Bools = (np.arange(count) <= newest) | (prompt + slowest <= last)
    absent = np.ones(last + 1, dtype=np.bool_)
    absent[part.tick[part.tick <= last]] = False
    lacking = np.flatnonzero(absent)
    if len(lacking):
        following = np.append(lacking, np.iinfo(np.int64).max)[np.searchsorted(lacking, prompt)]
        known &= following - prompt > slowest
    known[came.sample] = True
    return known
