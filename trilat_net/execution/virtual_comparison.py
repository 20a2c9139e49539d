"""Compares a log with virtual time and finds the samples that arrived late.

Invariant (L2): virtual time fed with a log's arrivals equals that log on every tick, always; plain virtual
time equals it until the first sample arrives after its due tick.
"""

import io
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import msgspec

from .. import process
from ..core.site_step import Site
from ..core.ticks import PlantState, TickRecord
from ..errors import LawFailed
from ..log.log_reader import Log, open_log
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
from .resumption import read_plant_state
from .verify import find_last_ticks
from .virtual_network import Network, RecordedNetwork


class RecordComparison(NamedTuple):
    """How far two executions agree.

    Attributes:
        records: records compared.
        identical: those of which every computed field has the same bits.
        first: the first difference, by tick and then by site, or None.
    """

    records: int
    identical: int
    first: RecordDifference | None


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


def compare_records(
    log: Log, executed: Iterable[tuple[str, TickRecord]], *, arrivals: bool
) -> RecordComparison:
    """Compares every record of a log with another execution, bit for bit.

    Args:
        log: the log.
        executed: the other execution: (site, record), in any order.
        arrivals: whether arrivals must be the same too, or only what was computed from them.
    """
    by_tick = {name: log[name].by_tick for name in log.sites}
    records = agreeing = 0
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
                agreeing += 1
                continue
            difference = find_first_difference(state, computed, peers, equal_bits)
            if first is None or (difference is not None and difference.tick < first.tick):
                first = difference
    except LawFailed as failed:  # here, and not when the log was made
        first = first or describe_law_failure(failed)
    return RecordComparison(records, agreeing, first)


def read_plant_states(log: Log) -> dict[str, dict[int, PlantState]]:
    """Returns what arms outside of the program were measured to do: their sites' records say it."""
    outside = log.scenario.external
    return {name: {state.tick: read_plant_state(state) for state in log[name].states} for name in outside}


def find_late_samples(log: Log) -> list[LateSample]:
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


def read_arrival_schedule(log: Log) -> dict[str, dict[int, list[list[int]]]]:
    """Returns what arrived when: per site and tick the arrivals, as a `RecordedNetwork` wants them."""
    return {name: {state.tick: state.rx for state in log[name].states} for name in log.sites}


class VirtualComparison(NamedTuple):
    """A log against virtual time.

    Attributes:
        fed: against virtual time fed with the log's arrivals; equal always.
        plain: against plain virtual time; equal until the first late sample. Of nothing where an arm is
            outside of the program: there is no such run.
        late: the samples that came after they were due.
    """

    fed: RecordComparison
    plain: RecordComparison
    late: list[LateSample]


def compare_with_virtual(log: Log, progress: Progress | None = None) -> VirtualComparison:
    """Runs a log's scenario again in virtual time, with its arrivals and without, and compares.

    Args:
        log: the log; what is behind its last record is not run.
        progress: told how many ticks are done, and how many there are.
    """
    scenario = _recorded_scenario(log)
    total = 2 * sum(map(scenario.ticks, scenario.names))
    peers = {name: scenario.peers(name) for name in scenario.names}
    arms = read_plant_states(log)
    ends = find_last_ticks(log)
    with process.pause_gc():
        ordered = {name: log.commands(name) for name in scenario.names}

        def outputs(network: Network | None, before: int) -> Iterator[tuple[str, TickRecord]]:
            ran = virtual.execute_virtual(scenario, network, ordered, arms, ends)
            return _report_progress(((site.name, output) for site, _, output in ran), progress, before, total)

        return VirtualComparison(
            compare_records(
                log, outputs(RecordedNetwork(read_arrival_schedule(log), peers), 0), arrivals=True
            ),
            RecordComparison(0, 0, None)
            if arms
            else compare_records(log, outputs(None, total // 2), arrivals=False),
            find_late_samples(log),
        )


def _recorded_scenario(log: Log) -> Scenario:
    """Returns a log's scenario, as long as there are records: a torn log is a short run."""
    ends_s = [(int(log[name].tick[-1]) + 1) / log[name].rate_hz for name in log.sites if len(log[name])]
    duration_s = min(log.scenario.duration_s, max(ends_s, default=log.scenario.duration_s))
    return msgspec.structs.replace(log.scenario, duration_s=duration_s)


def _report_progress(
    outputs: Iterator[tuple[str, TickRecord]], progress: Progress | None, before: int, total: int
) -> Iterator[tuple[str, TickRecord]]:
    """Yields the same, and tells now and then how many there were."""
    for n, output in enumerate(outputs):
        if progress is not None and n % 256 == 0:
            progress(before + n, total)
        yield output


def simulate_without_operators(log: Log) -> Log:
    """Returns the log's experiment in virtual time with nobody at the arms."""
    stream = io.BytesIO()
    virtual.write_virtual_log(_recorded_scenario(log).without_hands(), stream, as_named=False)
    stream.seek(0)
    return open_log(stream)
