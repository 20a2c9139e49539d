"""Compares a log with another execution of the same experiment, and names the first late sample.

Law (L2): virtual time fed with a log's arrivals equals that log on every tick, always; plain virtual time
equals it as long as no sample came after it was due.
"""

from collections.abc import Iterable
from typing import NamedTuple

from ..core.site import Site
from ..core.tick import Measured, Output
from ..errors import LawFailed
from ..log.reader import Log
from .difference import Difference, first_difference, identical, law_failed, same_bits
from .resumption import measured


class Comparison(NamedTuple):
    """How far two executions agree.

    Attributes:
        records: records compared.
        identical: those of which every computed field has the same bits.
        first: the first difference, by tick and then by site, or None.
    """

    records: int
    identical: int
    first: Difference | None


class LateSample(NamedTuple):
    """A sample that came after it was due.

    Attributes:
        site: who received it.
        peer: who sent it.
        tick: the sample's own tick.
        due_tick: the receiver's tick at which it was due.
        arrived_tick: the receiver's tick at which it was taken in.
    """

    site: str
    peer: str
    tick: int
    due_tick: int
    arrived_tick: int

    def __str__(self) -> str:
        return (
            f"sample {self.tick} of {self.peer} was due at tick {self.due_tick} of {self.site} "
            f"and came at tick {self.arrived_tick}"
        )


def compare(log: Log, executed: Iterable[tuple[str, Output]], *, arrivals: bool) -> Comparison:
    """Compares every record of a log with another execution, bit for bit.

    Args:
        log: the log.
        executed: the other execution: (site, record), in any order.
        arrivals: whether arrivals must be the same too, or only what was computed from them.
    """
    by_tick = {name: log[name].by_tick for name in log.sites}
    records = agreeing = 0
    first: Difference | None = None
    try:
        for site, output in executed:
            state = by_tick[site].get(output.tick)
            if state is None:
                continue
            records += 1
            computed = output if arrivals else output._replace(rx_crc=state.rx_crc)
            peers = log[site].peers
            if identical(state, computed, peers):
                agreeing += 1
                continue
            difference = first_difference(state, computed, peers, same_bits)
            if first is None or (difference is not None and difference.tick < first.tick):
                first = difference
    except LawFailed as failed:  # here, and not when the log was made
        first = first or law_failed(failed)
    return Comparison(records, agreeing, first)


def measurements(log: Log) -> dict[str, dict[int, Measured]]:
    """Returns what arms outside of the program were measured to do: their sites' records say it."""
    outside = log.scenario.external
    return {name: {state.tick: measured(state) for state in log[name].states} for name in outside}


def late_samples(log: Log) -> list[LateSample]:
    """Returns every sample that came after it was due, by the tick at which it was due."""
    late = []
    for name in log.sites:
        site = Site(log.scenario.setup(name)._replace(own=None))  # looks at links, and runs no law
        ordered = log.commands(name)
        for state in log[name].states:
            for command in ordered.get(state.tick, ()):
                site.order(command)
            for peer, tick, _ in state.rx:
                due = site.release_tick(peer, tick)
                if due is not None and due < state.tick and not site.measures(peer):
                    late.append(LateSample(name, site.peers[peer], tick, due, state.tick))
    return sorted(late, key=lambda sample: sample.due_tick)


def schedule(log: Log) -> dict[str, dict[int, list[list[int]]]]:
    """Returns what arrived when: per site and tick the arrivals, as a `RecordedNetwork` wants them."""
    return {name: {state.tick: state.rx for state in log[name].states} for name in log.sites}
