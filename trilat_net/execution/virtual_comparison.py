"""Compares a log with virtual time and finds the samples that arrived late.

Invariant (L2): virtual time fed with a log's arrivals equals that log on every tick, always;
plain virtual time equals it until the first sample arrives after its due tick, or is lost on
the way.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np

from .. import process
from ..core.site_step import Site
from ..core.ticks import NS_PER_S, PlantState, TickRecord
from ..errors import LawFailed, LogError
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from ..scenario import Scenario
from . import virtual
from .resumption import ArrivalEntry, find_recorded_hand
from .verify import (
    RecordDifference,
    describe_law_failure,
    equal_bits,
    equal_record,
    find_first_difference,
)
from .virtual_network import Network, RecordedNetwork, complete_deliveries, read_deliveries


class RecordComparison(NamedTuple):
    """Agreement of a log with another execution: equal bits, and the first difference by tick,
    then site.
    """

    records: int
    identical: int
    first: RecordDifference | None


class LateSample(NamedTuple):
    """A sample of a peer that was not at a site when it was due; the last two are the site's
    ticks.

    A sample that was lost on the way, not by its link's model, has no `arrived_tick`.
    """

    site: str
    peer: str
    tick: int
    due_tick: int
    arrived_tick: int | None

    def __str__(self) -> str:
        how = "never came" if self.arrived_tick is None else f"came at tick {self.arrived_tick}"
        return f"sample {self.tick} of {self.peer} was due at tick {self.due_tick} of {self.site} and {how}"


def compare_records(
    log: Log, executed: Iterable[tuple[str, TickRecord]], *, arrivals: bool
) -> RecordComparison:
    """Compares every record of a log with another execution, (site, record) in any order, bit
    for bit.

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


def find_absent_samples(log: Log) -> list[LateSample]:
    """Returns every sample that was not there when it was due, by the tick at which it was due.

    One that never came counts as lost if a record at that tick, or after it, still has an older
    one in use.
    """
    absent = []
    for name in log.sites:
        # only its links matter: no law runs
        site = Site(log.scenario.setup(name)._replace(own=None))
        part = log[name]
        ordered = log.commands(name)
        _, rows = part.arrivals
        ticks = [log.scenario.ticks(peer) for peer in part.peers]
        came = [set(rows[rows[:, 0] == j, 1].tolist()) for j in range(len(part.peers))]
        asked = [0] * len(part.peers)
        for state in part.states:
            for command in ordered.get(state.tick, ()):
                site.order(command, state.t_ns)
            for peer, tick, _ in state.rx:
                # a damaged record names any
                made = 0 <= peer < len(ticks) and 0 <= tick < ticks[peer]
                due = site.release_tick(peer, tick) if made else None
                if due is not None and due < state.tick and not site.measures(peer):
                    absent.append(
                        LateSample(
                            site=name,
                            peer=site.peers[peer],
                            tick=tick,
                            due_tick=due,
                            arrived_tick=state.tick,
                        )
                    )
            for j, sender in enumerate(part.peers):
                sent = (
                    min(state.t_ns * site.peer_rate_hz(j) // NS_PER_S, log.last_ticks[sender])
                    + 1
                )
                for tick in range(asked[j], sent):
                    due = (
                        None
                        if tick in came[j] or site.measures(j)
                        else site.release_tick(j, tick)
                    )
                    if due is None:
                        continue
                    place = int(np.searchsorted(part.tick, due))
                    if (part.used[sender][place : place + 1] < tick).any():
                        absent.append(
                            LateSample(
                                site=name,
                                peer=sender,
                                tick=tick,
                                due_tick=due,
                                arrived_tick=None,
                            )
                        )
                asked[j] = max(asked[j], sent)
    return sorted(absent, key=lambda sample: sample.due_tick)


class VirtualComparison(NamedTuple):
    """A log against virtual time: equal if fed with its arrivals, else until the first late or
    lost sample.

    The plain one is empty if an arm is external: there is no such run.
    """

    fed: RecordComparison
    plain: RecordComparison
    absent: list[LateSample]

    @property
    def late(self) -> list[LateSample]:
        """The samples that came late."""
        return [sample for sample in self.absent if sample.arrived_tick is not None]

    @property
    def lost(self) -> list[LateSample]:
        """The samples that never came."""
        return [sample for sample in self.absent if sample.arrived_tick is None]

    @property
    def excused_from(self) -> int | None:
        """The tick from which plain virtual time may differ; None if every sample was there in
        time.
        """
        return self.absent[0].due_tick if self.absent else None


def compare_with_virtual(log: Log, progress: Progress | None = None) -> VirtualComparison:
    """Runs a log's scenario again in virtual time, with its arrivals and without, and compares.

    Nothing runs beyond the log's last record. `progress` gets the ticks done and their total.
    """
    scenario = _recorded_scenario(log)
    total = 2 * sum(map(scenario.ticks, scenario.names))
    peers = {name: scenario.peers(name) for name in scenario.names}
    arms = {
        name: {s.tick: PlantState(s.q, s.qd, s.tau_x, s.bodies) for s in log[name].states}
        for name in log.scenario.external
    }
    with process.pause_gc():
        ordered = {name: log.commands(name) for name in scenario.names}
        hands = {name: partial(find_recorded_hand, log[name]) for name in scenario.names}

        def execute(network: Network | None, before: int) -> Iterator[tuple[str, TickRecord]]:
            ticks = virtual.execute_virtual(
                scenario=scenario,
                network=network,
                commands=ordered,
                measured=arms,
                ends=log.last_ticks,
                hands=hands,
            )
            for n, (site, _, output) in enumerate(ticks):
                if progress is not None and n % 256 == 0:
                    progress(before + n, total)
                yield site.name, output

        recorded = RecordedNetwork(
            {name: _complete_arrivals(log, name) for name in log.sites}, peers
        )
        fed = compare_records(log, execute(recorded, 0), arrivals=True)
        if arms:
            plain = RecordComparison(0, 0, None)
        else:
            plain = compare_records(log, execute(None, total // 2), arrivals=False)
        return VirtualComparison(fed, plain, find_absent_samples(log))


def _complete_arrivals(log: Log, name: str) -> Mapping[int, Sequence[ArrivalEntry]]:
    """Returns the arrivals of a site by tick; in gaps those that are assumed, if not too much
    is missing.
    """
    part = log[name]
    rates_hz = [log.scenario.sites[peer].rate_hz for peer in part.peers]
    with suppress(LogError):
        return complete_deliveries(
            part, rates_hz, [log.last_ticks[peer] for peer in part.peers]
        ).entries
    return read_deliveries(part).entries


def _recorded_scenario(log: Log) -> Scenario:
    ends_s = [
        (log[name].last_tick + 1) / log[name].rate_hz for name in log.sites if len(log[name])
    ]
    duration_s = min(log.scenario.duration_s, max(ends_s, default=log.scenario.duration_s))
    return msgspec.structs.replace(log.scenario, duration_s=duration_s)


def simulate_without_operators(log: Log) -> Log:
    """Returns the log's experiment in virtual time without operators."""
    return virtual.simulate_scenario(_recorded_scenario(log).without_hands())
