"""Delivery of every sample of a link: as its model predicts it, and as the receiver's records list it.

Invariant (L4): the prediction is a function of seed, link and index; the log's scenario and the changes that
its records name determine it, also for samples that never arrived.
Invariant (L3): a record names its inputs. Samples that only a missing record could name stay unknown and
count neither as arrived nor as missing.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.channel import LOST, schedule_deliveries
from ..core.delay import LINK_MODEL_DTYPE, DelayKind, LinkModel
from ..core.link import AHEAD_LIMIT_NS, link_dtype
from ..core.site_setup import LinkSetup
from ..core.ticks import NS_PER_S
from ..core.vectors import Array, Row
from ..log.log_reader import Log
from ..log.record_columns import Ints
from .aligned import Bools

_BLOCK = 8192


class PredictedDelivery(NamedTuple):
    """Delivery of the samples 0 to M - 1 of a link's peer, as its model predicts it; times since the epoch.

    Attributes:
        stamp_ns, due_ns: the stamp of each, and when it is due, shape (M,), ns; `LOST` for a lost one.
        drawn_ns: the same by the model's own delay alone, without duplicates, order and play-out.
        measured: True if nothing is injected: a sample is due at once, shape (M,).
        copies: duplicates that the link makes.
    """

    stamp_ns: Ints
    due_ns: Ints
    drawn_ns: Ints
    measured: Bools
    copies: int

    @property
    def lost(self) -> Bools:
        """True for samples that the link loses, shape (M,)."""
        lost: Bools = self.due_ns == LOST
        return lost

    @property
    def drawn_ms(self) -> Array:
        """The injected delays of the samples that are not lost, ms."""
        kept = ~self.lost & ~self.measured
        return (self.drawn_ns[kept] - self.stamp_ns[kept]) / 1e6

    def release(self, rate_hz: int) -> Ints:
        """Returns the receiver's tick at which each comes into use if it has arrived, shape (M,); or LOST."""
        ticks = first_ticks(np.maximum(self.due_ns, self.stamp_ns + 1), rate_hz)
        return np.where(self.lost, LOST, ticks)


def first_ticks(due_ns: Ints, rate_hz: int) -> Ints:
    """Returns the first ticks at or after times, ns; `core.ticks.first_tick_at` for arrays."""
    return -(-due_ns * rate_hz // NS_PER_S)


def predict_delivery(log: Log, peer: str, site: str, count: int) -> PredictedDelivery:
    """Returns the predicted delivery of the first `count` samples of a link, peer -> site.

    Raises:
        LogError: a record names a change that is none.
    """
    setup = next(link for link in log.scenario.setup(site).links if link.peer == peer)
    index = log[site].peers.index(peer)
    commands = (command for batch in log.commands(site).values() for command in batch)
    ordered = [one.model for one in commands if one.peer == index and one.model is not None]
    models, points = _list_models(setup, ordered)
    due_ns, copies = _schedule(setup, models, points, count)
    alone = models.copy()
    alone["duplicate"], alone["in_order"], alone["playout_us"] = 0.0, 0, 0
    drawn_ns = due_ns if np.array_equal(alone, models) else _schedule(setup, alone, points, count)[0]
    stamp_ns = np.arange(count, dtype=np.int64) * NS_PER_S // setup.rate_hz
    kind = models["kind"][np.searchsorted(models["from_ns"][1:], stamp_ns, side="right")]
    return PredictedDelivery(stamp_ns, due_ns, drawn_ns, kind == DelayKind.MEASURED, copies)


def _schedule(setup: LinkSetup, models: NDArray[np.void], points: Ints, count: int) -> tuple[Ints, int]:
    """Returns when each sample is due, and the number of copies; by a row of the core's link."""
    row: Row = np.zeros(1, link_dtype(0))[0]
    row.rate_hz, row.key, row.models = setup.rate_hz, setup.key, len(models)
    row.used, row.foreseen = -1, -1
    row.outage_first, row.outage_count = len(points) - len(setup.outages), len(setup.outages)
    due_ns = np.empty(count, dtype=np.int64)
    dues = np.empty(_BLOCK, dtype=np.int64)
    for start in range(0, count, _BLOCK):
        end = min(start + _BLOCK, count)
        schedule_deliveries(end - 1, row, models, dues, points)
        due_ns[start:end] = dues[: end - start]
    return due_ns, int(row.copies)


def _list_models(setup: LinkSetup, ordered: list[LinkModel]) -> tuple[NDArray[np.void], Ints]:
    """Returns a link's models in the order of their first stamps, and its points: traces, then outages.

    Ordered changes hold from a time at which no sample had been decided, so all can stand there at once.
    """
    points: list[tuple[int, int]] = []
    placed = []
    for model, trace in zip(setup.models, setup.traces, strict=True):
        if trace is not None:
            model = model._replace(trace_first=len(points), trace_count=len(trace))
            points += [(int(t_us), int(delay_us)) for t_us, delay_us in trace]
        placed.append(model)
    models = np.array(sorted([*placed, *ordered], key=lambda model: model.from_ns), LINK_MODEL_DTYPE)
    return models, np.array([*points, *setup.outages], dtype=np.int64).reshape(-1, 2)


class Arrivals(NamedTuple):
    """Arrivals over a link, in the order of the records, shape (A,).

    Attributes:
        tick, sample: the receiver's tick, and the sample's own.
        delay_us: its one-way delay in the record.
        refused: number of others with a stamp out of range, or of a tick that their sender never makes.
    """

    tick: Ints
    sample: Ints
    delay_us: Ints
    refused: int

    @property
    def first(self) -> "Arrivals":
        """The first arrival of each sample, by sample."""
        sample, place = np.unique(self.sample, return_index=True)
        return Arrivals(self.tick[place], sample, self.delay_us[place], self.refused)


def read_arrivals(log: Log, site: str) -> dict[str, Arrivals]:
    """Returns the arrivals at a site, per peer."""
    part = log[site]
    counts, entries = part.arrivals
    tick = np.repeat(part.tick, counts)
    found = {}
    for index, peer in enumerate(part.peers):
        here = entries[:, 0] == index
        at, sample, delay_us = tick[here], entries[here, 1], entries[here, 2]
        # a link accepts no stamp before the epoch, and none further ahead than the limit
        latest_ns = at * NS_PER_S // part.rate_hz + AHEAD_LIMIT_NS
        peer_hz = log.scenario.sites[peer].rate_hz
        limit = ((latest_ns + 1) * peer_hz - 1) // NS_PER_S  # in ticks: a stamp itself might overflow
        known = (sample >= 0) & (sample <= limit) & (sample < log.scenario.ticks(peer))
        refused = len(at) - int(np.count_nonzero(known))
        found[peer] = Arrivals(at[known], sample[known], delay_us[known], refused)
    return found


def count_sent(log: Log, peer: str, newest: int) -> int:
    """Returns how many samples a peer has sent, as far as the log shows; `newest` of them came, or -1."""
    part = log[peer]
    stated = [event.ticks for event in log.events if event.kind == "end" and event.member == peer]
    recorded = int(part.tick[-1]) + 1 if len(part) else 0
    return min(max(newest + 1, recorded, *stated), log.scenario.ticks(peer))


def mark_judged_samples(log: Log, site: str, stamp_ns: Ints, came: Arrivals) -> Bools:
    """Returns for which samples it is known whether they arrived, shape (M,).

    Known are those that arrived, those older than the newest that arrived, and those older than the slowest
    took; except those that may have arrived in a tick whose record is missing. Given are the stamps of the
    samples 0 to M - 1, ns since the epoch, and their first arrivals.
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
