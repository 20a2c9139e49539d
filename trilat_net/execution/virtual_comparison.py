"""Compares a log with virtual time, and finds the samples that arrived late or were lost.

A sample is the state that a site publishes in one tick. A receiver uses it when it is due, that
is after the delay of the link.

Invariant (L2):
    - If a run in virtual time receives the samples in the ticks in which they arrived according
      to a log, it equals the log in every tick.
    - A run in virtual time in which all samples arrive at once equals the log up to the first
      sample that arrived after it was due, or was lost in the network.
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
from ..log.site_log import SiteLog
from ..scenario import Scenario
from . import virtual
from .resumption import ArrivalEntry, find_recorded_hand
from .verify import (
    PROGRESS_EVERY,
    RecordDifference,
    describe_law_failure,
    equal_bits,
    equal_record,
    find_first_difference,
)
from .virtual_network import Network, RecordedNetwork, complete_deliveries, read_deliveries


class RecordComparison(NamedTuple):
    """Agreement of the records of a log with another execution.

    Attributes:
        records: Number of compared records.
        identical: Number of records in which all computed fields have the same bits.
        first: Difference in the earliest tick. None if all records are identical.
    """

    records: int
    identical: int
    first: RecordDifference | None


class LateSample(NamedTuple):
    """Sample of a peer that had not arrived at a site when it was due.

    Samples that are lost according to the model of the link are not due, and do not count.

    Attributes:
        site: Name of the receiver.
        peer: Name of the sender.
        tick: Tick in which the sender published the sample.
        due_tick: Tick of the receiver in which the sample was due.
        arrived_tick: Tick of the receiver in which the sample arrived. None if it was lost in
            the network.
    """

    site: str
    peer: str
    tick: int
    due_tick: int
    arrived_tick: int | None

    def __str__(self) -> str:
        """Returns a sentence about the sample."""
        outcome = "never came"
        if self.arrived_tick is not None:
            outcome = f"came at tick {self.arrived_tick}"
        sample = f"sample {self.tick} of {self.peer}"
        return f"{sample} was due at tick {self.due_tick} of {self.site} and {outcome}"


def compare_records(
    log: Log, executed: Iterable[tuple[str, TickRecord]], *, arrivals: bool
) -> RecordComparison:
    """Compares every record of a log with another execution, bit for bit.

    Args:
        log: The log.
        executed: Name of the site and record of every executed tick, in any order. Ticks that
            the log does not contain are skipped.
        arrivals: If True, the checksums of the arrivals must be equal as well.
    """
    by_tick = {name: log[name].by_tick for name in log.sites}
    records = 0
    identical = 0
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
    except LawFailed as failure:  # the law did not fail when the log was recorded
        first = first or describe_law_failure(failure)
    return RecordComparison(records, identical, first)


def find_absent_samples(log: Log) -> list[LateSample]:
    """Returns every sample that had not arrived when it was due, in the order of the due ticks.

    The records do not say whether a sample was lost, or arrived in a tick whose record is
    missing. A sample that no record lists counts as lost if the first record from its due tick
    on still uses an older sample.
    """
    absent: list[LateSample] = []
    for name in log.sites:
        absent += _find_absent_at_site(log, name)
    return sorted(absent, key=lambda sample: sample.due_tick)


def _find_absent_at_site(log: Log, name: str) -> list[LateSample]:
    """Returns the samples that had not arrived at one site when they were due."""
    part = log[name]
    commands = log.commands(name)
    peer_ticks = [log.scenario.ticks(peer) for peer in part.peers]
    _, arrivals = part.arrivals
    arrived = [
        set(arrivals[arrivals[:, 0] == peer, 1].tolist()) for peer in range(len(part.peers))
    ]
    # only the links of the site are used, so its law is left out
    site = Site(log.scenario.setup(name)._replace(law_factory=None))
    checked = [0] * len(part.peers)  # for each peer, the number of samples examined so far
    absent = []
    for state in part.states:
        for command in commands.get(state.tick, ()):
            site.apply_change(command, state.t_ns)

        # samples that arrived in this tick, but were due earlier
        for peer, tick, _ in state.rx:
            # a damaged record may list any peer and tick
            exists = 0 <= peer < len(peer_ticks) and 0 <= tick < peer_ticks[peer]
            due_tick = site.release_tick(peer, tick) if exists else None
            if due_tick is None or due_tick >= state.tick or site.is_measured(peer):
                continue
            absent.append(
                LateSample(
                    site=name,
                    peer=site.peers[peer],
                    tick=tick,
                    due_tick=due_tick,
                    arrived_tick=state.tick,
                )
            )

        # samples that were sent before this tick and never arrived
        for peer, sender in enumerate(part.peers):
            newest = state.t_ns * site.peer_rate_hz(peer) // NS_PER_S
            sent = min(newest, log.last_ticks[sender]) + 1
            for tick in range(checked[peer], sent):
                if tick in arrived[peer] or site.is_measured(peer):
                    continue
                due_tick = site.release_tick(peer, tick)
                if due_tick is None or not _uses_older(part, sender, tick, due_tick):
                    continue
                absent.append(
                    LateSample(
                        site=name,
                        peer=sender,
                        tick=tick,
                        due_tick=due_tick,
                        arrived_tick=None,
                    )
                )
            checked[peer] = max(checked[peer], sent)
    return absent


def _uses_older(part: SiteLog, sender: str, tick: int, due_tick: int) -> bool:
    """True if the first record from `due_tick` on uses a sample that is older than `tick`."""
    row = int(np.searchsorted(part.tick, due_tick))
    return bool((part.used[sender][row : row + 1] < tick).any())


class VirtualComparison(NamedTuple):
    """Comparison of a log with two runs of its scenario in virtual time.

    Attributes:
        fed: Comparison with the run in which samples arrive as in the log. They must be equal.
        plain: Comparison with the run in which samples arrive at once. They must be equal up to
            the first late or lost sample. Without records if an arm is external, because its
            motion is known only for the recorded run.
        absent: Samples that arrived late or never, in the order of the due ticks.
    """

    fed: RecordComparison
    plain: RecordComparison
    absent: list[LateSample]

    @property
    def late(self) -> list[LateSample]:
        """Samples that arrived late."""
        return [sample for sample in self.absent if sample.arrived_tick is not None]

    @property
    def lost(self) -> list[LateSample]:
        """Samples that never arrived."""
        return [sample for sample in self.absent if sample.arrived_tick is None]

    @property
    def excused_from(self) -> int | None:
        """First tick in which the plain run may differ. None if no sample was late or lost."""
        return self.absent[0].due_tick if self.absent else None


def compare_with_virtual(log: Log, progress: Progress | None = None) -> VirtualComparison:
    """Compares a log with two runs of its scenario in virtual time.

    In the first run, samples arrive as in the log; in the second run, they arrive at once. Both
    runs end at the last record of the log.

    Args:
        log: The log.
        progress: Function that is called now and then with the number of executed ticks and
            their total.
    """
    scenario = _cut_to_records(log)
    total = 2 * sum(map(scenario.ticks, scenario.names))
    peers = {name: scenario.peers(name) for name in scenario.names}
    arm_states = {
        name: {
            state.tick: PlantState(state.q, state.qd, state.tau_x, state.bodies)
            for state in log[name].states
        }
        for name in log.scenario.external
    }
    with process.pause_gc():
        commands = {name: log.commands(name) for name in scenario.names}
        hands = {name: partial(find_recorded_hand, log[name]) for name in scenario.names}

        def execute(network: Network | None, before: int) -> Iterator[tuple[str, TickRecord]]:
            ticks = virtual.execute_virtual(
                scenario=scenario,
                network=network,
                commands=commands,
                measured=arm_states,
                ends=log.last_ticks,
                hands=hands,
            )
            for count, (site, _, output) in enumerate(ticks):
                if progress is not None and count % PROGRESS_EVERY == 0:
                    progress(before + count, total)
                yield site.name, output

        arrivals = {name: _read_arrivals(log, name) for name in log.sites}
        fed = compare_records(log, execute(RecordedNetwork(arrivals, peers), 0), arrivals=True)
        if arm_states:
            plain = RecordComparison(0, 0, None)
        else:
            plain = compare_records(log, execute(None, total // 2), arrivals=False)
        return VirtualComparison(fed, plain, find_absent_samples(log))


def _read_arrivals(log: Log, name: str) -> Mapping[int, Sequence[ArrivalEntry]]:
    """Returns the arrivals at a site, by tick.

    Arrivals in gaps of the log are assumed, unless too many records are missing.
    """
    part = log[name]
    rates_hz = [log.scenario.sites[peer].rate_hz for peer in part.peers]
    ends = [log.last_ticks[peer] for peer in part.peers]
    with suppress(LogError):
        return complete_deliveries(part, rates_hz, ends).entries
    return read_deliveries(part).entries


def _cut_to_records(log: Log) -> Scenario:
    """Returns the scenario of a log, shortened so that it ends at the last record."""
    ends_s = [
        (log[name].last_tick + 1) / log[name].rate_hz for name in log.sites if len(log[name])
    ]
    duration_s = min(log.scenario.duration_s, max(ends_s, default=log.scenario.duration_s))
    return msgspec.structs.replace(log.scenario, duration_s=duration_s)


def simulate_without_operators(log: Log) -> Log:
    """Returns the log of a run of the same experiment in virtual time, without operators."""
    return virtual.simulate_scenario(_cut_to_records(log).without_hands())
