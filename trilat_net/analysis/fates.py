"""What a link does to every sample of its peer: when each is due, which are lost.

Law (L4): a fate is a function of seed, link and index; the log's scenario and the changes that its records
name are enough to know it, whether a sample came or not.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arm import Array
from ..core.channel import LOST, foresee
from ..core.delay import MODEL, Delay, Model, Row
from ..core.grid import NS_PER_S
from ..core.link import LINK, SAMPLE
from ..core.setup import LinkSetup
from ..log.reader import Ints, Log

_BLOCK = 8192

Bools = NDArray[np.bool_]


class Fates(NamedTuple):
    """What a link does to the samples 0 to M - 1 of its peer.

    Attributes:
        stamp_ns: when each was taken, ns since the epoch, shape (M,).
        due_ns: when each is due, ns since the epoch, shape (M,); `LOST` where it is lost.
        drawn_ns: the same by the model's own delay alone, without duplicates, order and play-out.
        measured: where nothing is injected: a sample is due at once, shape (M,).
        copies: duplicates that the link makes of them.
    """

    stamp_ns: Ints
    due_ns: Ints
    drawn_ns: Ints
    measured: Bools
    copies: int

    @property
    def lost(self) -> Bools:
        """Where the link loses the sample, shape (M,)."""
        lost: Bools = self.due_ns == LOST
        return lost

    @property
    def drawn_ms(self) -> Array:
        """The delays that the model gives to samples that it does not lose; none of a measured one, ms."""
        kept = ~self.lost & ~self.measured
        delays: Array = (self.drawn_ns[kept] - self.stamp_ns[kept]) / 1e6
        return delays

    def release(self, rate_hz: int) -> Ints:
        """Returns the receiver's tick at which each comes into use if it is there, shape (M,); or LOST."""
        ticks = first_ticks(np.maximum(self.due_ns, self.stamp_ns + 1), rate_hz)
        release: Ints = np.where(self.lost, LOST, ticks)
        return release


def first_ticks(due_ns: Ints, rate_hz: int) -> Ints:
    """Returns the first ticks at or after some times; `core.grid.first_tick_at` for arrays.

    Args:
        due_ns: ns since the epoch, shape (M,).
        rate_hz: the rate of the ticks, Hz.
    """
    ticks: Ints = -(-due_ns * rate_hz // NS_PER_S)
    return ticks


def fates(log: Log, peer: str, site: str, count: int) -> Fates:
    """Returns what a link does to the first samples of its peer.

    Args:
        log: the log.
        peer: who sends.
        site: who receives.
        count: how many samples.

    Raises:
        LogError: a record names a change that is none.
    """
    setup = next(link for link in log.scenario.setup(site).links if link.peer == peer)
    index = log[site].peers.index(peer)
    ordered = [
        command.model
        for commands in log.commands(site).values()
        for command in commands
        if command.peer == index and command.model is not None
    ]
    models, points = _models(setup, ordered)
    due_ns, copies = _due(setup, models, points, count)
    alone = models.copy()
    alone["duplicate"], alone["in_order"], alone["playout_us"] = 0.0, 0, 0
    drawn_ns = due_ns if np.array_equal(alone, models) else _due(setup, alone, points, count)[0]
    stamp_ns = np.arange(count, dtype=np.int64) * NS_PER_S // setup.rate_hz
    in_force = np.searchsorted(models["from_ns"][1:], stamp_ns, side="right")
    return Fates(stamp_ns, due_ns, drawn_ns, models["kind"][in_force] == Delay.MEASURED, copies)


def _due(setup: LinkSetup, models: NDArray[np.void], points: Ints, count: int) -> tuple[Ints, int]:
    """Returns when each sample is due, and how many copies were made: the link's row as a site has it."""
    row: Row = np.zeros(1, LINK)[0]
    row.rate_hz, row.key, row.models = setup.rate_hz, setup.key, len(models)
    row.used, row.foreseen = -1, -1
    row.outage_first, row.outage_count = len(points) - len(setup.outages), len(setup.outages)
    due_ns = np.empty(count, dtype=np.int64)
    pages = np.zeros(_BLOCK, SAMPLE)
    for start in range(0, count, _BLOCK):
        end = min(start + _BLOCK, count)
        foresee(end - 1, row, models, pages, points)
        due_ns[start:end] = pages["due_ns"][: end - start]
    return due_ns, int(row.copies)


def _models(setup: LinkSetup, ordered: list[Model]) -> tuple[NDArray[np.void], Ints]:
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
    models = np.array(sorted([*placed, *ordered], key=lambda model: model.from_ns), MODEL)
    return models, np.array([*points, *setup.outages], dtype=np.int64).reshape(-1, 2)
