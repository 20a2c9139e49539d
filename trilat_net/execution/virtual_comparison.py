"""Compares a log with virtual time and finds the samples that arrived late.

Invariant (L2): virtual time fed with a log's arrivals equals that log on every tick, always; plain virtual
time equals it until the first sample arrives after its due tick.
"""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec

from .. import process
from ..core.site_step import Site
from ..core.ticks import PlantState, TickRecord
from ..errors import LawFailed
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from ..scenario import Scenario
from . import virtual
from .difference import (
    RecordDifference,
    describe_law_failure,
    equal_bits,
    equal_record,
    find_first_difference,
)
from .verify import find_last_ticks
from .virtual_network import Network, RecordedNetwork


class RecordComparison(NamedTuple):
    """Agreement of a log with another execution: equal bits, and the first difference by tick, then site."""

    records: int
    identical: int
    first: RecordDifference | None


class LateSample(NamedTuple):
    """A sample of a peer that arrived at a site after it was due; the last two are the site's ticks."""

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


def compare_records(
    log: Log, executed: Iterable[tuple[str, TickRecord]], *, arrivals: bool
) -> RecordComparison:
    """Compares every record of a log with another execution, (site, record) in any order, bit for bit.

    Without `arrivals` only what was computed from them must be equal.
    """
    by_tick = {name: log[name].by_tick for name in log.sites}
    records = identical = 0
    first: RecordDifference | None = None
    try:
        for site, output in executed:
            state = by_tick[site].get(output.tick)
            if state is None:
                continue
            records += 1
            computed = output if arrivals else output._replace(rx_crc=state.rx_crc)
            peers = log[site].peers
            if equal_record(state, computed, peers):
                identical += 1
                continue
            difference = find_first_difference(state, computed, peers, equal_bits)
            if first is None or (difference is not None and difference.tick < first.tick):
                first = difference
    except LawFailed as failed:  # now, and not when the log was made
        first = first or describe_law_failure(failed)
    return RecordComparison(records, identical, first)


def find_late_samples(log: Log) -> list[LateSample]:
    """Returns every sample that arrived after it was due, by the tick at which it was due."""
    late = []
    for name in log.sites:
        site = Site(log.scenario.setup(name)._replace(own=None))  # only its links matter: no law runs
        ordered = log.commands(name)
        for state in log[name].states:
            for command in ordered.get(state.tick, ()):
                site.order(command)
            for peer, tick, _ in state.rx:
                due = site.release_tick(peer, tick)
                if due is not None and due < state.tick and not site.measures(peer):
                    late.append(LateSample(name, site.peers[peer], tick, due, state.tick))
    return sorted(late, key=lambda sample: sample.due_tick)


class VirtualComparison(NamedTuple):
    """A log against virtual time: always equal if fed with its arrivals, else until the first late sample.

    The plain one is empty if an arm is external: there is no such run.
    """

    fed: RecordComparison
    plain: RecordComparison
    late: list[LateSample]


def compare_with_virtual(log: Log, progress: Progress | None = None) -> VirtualComparison:
    """Runs a log's scenario again in virtual time, with its arrivals and without, and compares.

    Nothing runs beyond the log's last record. `progress` gets the ticks done and their total.
    """
    scenario = _recorded_scenario(log)
    total = 2 * sum(map(scenario.ticks, scenario.names))
    peers = {name: scenario.peers(name) for name in scenario.names}
    states = {name: log[name].states for name in log.sites}
    arms = {name: {s.tick: PlantState(s.q, s.qd) for s in states[name]} for name in log.scenario.external}
    ends = find_last_ticks(log)
    with process.pause_gc():
        ordered = {name: log.commands(name) for name in scenario.names}

        def execute(network: Network | None, before: int) -> Iterator[tuple[str, TickRecord]]:
            ticks = virtual.execute_virtual(scenario, network, ordered, arms, ends)
            for n, (site, _, output) in enumerate(ticks):
                if progress is not None and n % 256 == 0:
                    progress(before + n, total)
                yield site.name, output

        recorded = RecordedNetwork({name: {s.tick: s.rx for s in states[name]} for name in states}, peers)
        fed = compare_records(log, execute(recorded, 0), arrivals=True)
        if arms:
            plain = RecordComparison(0, 0, None)
        else:
            plain = compare_records(log, execute(None, total // 2), arrivals=False)
        return VirtualComparison(fed, plain, find_late_samples(log))


def _recorded_scenario(log: Log) -> Scenario:
    """Returns a log's scenario, no longer than its records: a torn log is a short run."""
    ends_s = [(int(log[name].tick[-1]) + 1) / log[name].rate_hz for name in log.sites if len(log[name])]
    duration_s = min(log.scenario.duration_s, max(ends_s, default=log.scenario.duration_s))
    return msgspec.structs.replace(log.scenario, duration_s=duration_s)


def simulate_without_operators(log: Log) -> Log:
    """Returns the log's experiment in virtual time without operators."""
    return virtual.simulate_scenario(_recorded_scenario(log).without_hands(), as_named=False)
