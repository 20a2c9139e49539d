"""Compare a log with virtual time, and find the samples that arrived late or were lost.

Invariant (L2):
    - A run in virtual time that gets the arrivals of a log equals that log at every tick.
    - A plain run in virtual time, over a prompt network, equals the log until the first sample
      arrives after its due tick or is lost in the network.
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
        records: number of compared records.
        identical: number of records whose computed fields all have equal bits.
        first: the difference at the earliest tick; None if all records are identical.
    """

    records: int
    identical: int
    first: RecordDifference | None


class LateSample(NamedTuple):
    """A sample of a peer that had not arrived at a site when it was due.

    Attributes:
        site: name of the receiver.
        peer: name of the sender.
        tick: tick of the sample, at the rate of the sender.
        due_tick: tick of the receiver at which the sample was due.
        arrived_tick: tick of the receiver at which the sample arrived; None if it was lost in
            the network. Samples that the model of the link loses are not late.
    """

    site: str
    peer: str
    tick: int
    due_tick: int
    arrived_tick: int | None

    def __str__(self) -> str:
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
        log: the log.
        executed: the name of the site and the record of every executed tick, in any order.
        arrivals: whether the arrivals (their CRC) have to be equal as well.
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
    """Returns every sample that had not arrived when it was due, in order of due ticks.

    A sample that never arrived counts as lost if the first record at or after its due tick
    still uses an older sample.
    """
    absent: list[LateSample] = []
    for name in log.sites:
        absent += _find_absent_at_site(log, name)
    return sorted(absent, key=lambda sample: sample.due_tick)


def _find_absent_at_site(log: Log, name: str) -> list[LateSample]:
    part = log[name]
    commands = log.commands(name)
    peer_ticks = [log.scenario.ticks(peer) for peer in part.peers]
    _, arrivals = part.arrivals
    arrived = [
        set(arrivals[arrivals[:, 0] == peer, 1].tolist()) for peer in range(len(part.peers))
    ]
    # only the links of the site are used, so its law is left out
    site = Site(log.scenario.setup(name)._replace(law_factory=None))
    checked = [0] * len(part.peers)  # per peer the number of samples looked at so far
    absent = []
    for state in part.states:
        for command in commands.get(state.tick, ()):
            site.apply_change(command, state.t_ns)
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
    """True if the first record from `due_tick` on uses a sample older than `tick`."""
    row = int(np.searchsorted(part.tick, due_tick))
    return bool((part.used[sender][row : row + 1] < tick).any())


class VirtualComparison(NamedTuple):
    """A log compared with two runs of its scenario in virtual time.

    Attributes:
        fed: comparison with the run that gets the arrivals of the log. They must be equal.
        plain: comparison with the run over a prompt network, which is equal until the first
            late or lost sample. Empty if an arm is external, because no plain run exists.
        absent: samples that arrived late or never, in order of due ticks.
    """

    fed: RecordComparison
    plain: RecordComparison
    absent: list[LateSample]

    @property
    def late(self) -> list[LateSample]:
        """The samples that arrived late."""
        return [sample for sample in self.absent if sample.arrived_tick is not None]

    @property
    def lost(self) -> list[LateSample]:
        """The samples that never arrived."""
        return [sample for sample in self.absent if sample.arrived_tick is None]

    @property
    def excused_from(self) -> int | None:
        """First tick at which plain virtual time may differ; None if no sample was late."""
        return self.absent[0].due_tick if self.absent else None


def compare_with_virtual(log: Log, progress: Progress | None = None) -> VirtualComparison:
    """Compares a log with its scenario in virtual time, with its arrivals and without.

    Both runs end at the last record of the log.

    Args:
        log: the log.
        progress: called now and then with the number of executed ticks and their total.
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
    """Returns the arrivals at a site by tick.

    Arrivals in gaps are assumed, unless too many records are missing.
    """
    part = log[name]
    rates_hz = [log.scenario.sites[peer].rate_hz for peer in part.peers]
    ends = [log.last_ticks[peer] for peer in part.peers]
    with suppress(LogError):
        return complete_deliveries(part, rates_hz, ends).entries
    return read_deliveries(part).entries


def _cut_to_records(log: Log) -> Scenario:
    """Returns the scenario of a log with a duration that ends at the last record."""
    ends_s = [
        (log[name].last_tick + 1) / log[name].rate_hz for name in log.sites if len(log[name])
    ]
    duration_s = min(log.scenario.duration_s, max(ends_s, default=log.scenario.duration_s))
    return msgspec.structs.replace(log.scenario, duration_s=duration_s)


def simulate_without_operators(log: Log) -> Log:
    """Runs the experiment of a log in virtual time without operators and returns that log."""
    return virtual.simulate_scenario(_cut_to_records(log).without_hands())
