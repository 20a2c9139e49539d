"""Compares a log with a simulation of its run, to find the effect of late and lost messages.

In each tick, an arm sends its state (a sample) to the other arms. The receiver holds a sample
until the delay prescribed by the scenario has passed, at which point the sample is due. As long
as the real network delivers every sample before it is due, the network has no effect on the
run, and a simulation without a network gives the same results. The first difference shows when
the network was too slow.

Invariant (L2):
    - A simulation in which all samples arrive when they arrived in the log agrees with the log
      in every tick.
    - A simulation in which all samples arrive without delay agrees with the log up to the first
      sample that was late or lost in the network.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

import numpy as np

from .. import process
from ..core import PlantState, Site
from ..errors import LawFailed, LogError, count_nouns
from ..log import Finding, Log, Progress, SiteLog
from ..records import NS_PER_S, TickRecord
from . import virtual
from .resumption import ArrivalEntry, find_recorded_hand
from .verification import PROGRESS_EVERY, RecordDifference, equal_record
from .virtual_network import Deliveries, Network, RecordedNetwork


class _RecordComparison(NamedTuple):
    """Result of comparing the records of a log with another execution of the same run.

    Attributes:
        records: Number of records that were compared.
        identical: Number of records in which all computed fields are bit-identical.
        first: Difference in the earliest tick. None if all records are identical.
    """

    records: int
    identical: int
    first: RecordDifference | None

    def to_finding(self, label: str, excused_from: int | None) -> Finding:
        """Returns a finding that states whether a log agrees with another execution of its run.

        Args:
            label: Name of the check.
            excused_from: Tick from which differences are expected. They do not cause the check
                to fail. None if no differences are expected.
        """
        first = self.first
        text = f"{self.identical}/{count_nouns(self.records, 'record')} identical"
        if first is None:
            return Finding(label, text, True)
        excused = excused_from is not None and first.tick >= excused_from
        return Finding(label, f"{text}; the first that differs: {first}", excused)


class _LateSample(NamedTuple):
    """Sample that had not arrived at its receiver when it was due.

    A sample is due after the delay that the scenario prescribes for the link. Samples that are
    lost according to the scenario are never due, and do not count.

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
        """Describes the late sample in one sentence, for the report to the user."""
        outcome = "never came"
        if self.arrived_tick is not None:
            outcome = f"came at tick {self.arrived_tick}"
        sample = f"sample {self.tick} of {self.peer}"
        return f"{sample} was due at tick {self.due_tick} of {self.site} and {outcome}"


def _compare_records(
    log: Log, executed: Iterable[tuple[str, TickRecord]], *, arrivals: bool
) -> _RecordComparison:
    """Compares every record of a log with another execution of the run, bit for bit.

    Args:
        log: Log whose records are compared.
        executed: Results of the other execution in any order, each with the name of the site.
            Ticks that the log does not contain are skipped.
        arrivals: If True, the same samples must have arrived in each tick too. Their checksums
            are compared.
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
            difference = RecordDifference.find(state, computed, peers)
            if first is None or (difference is not None and difference.tick < first.tick):
                first = difference
    except LawFailed as failure:  # the law did not fail when the log was recorded
        first = first or RecordDifference.of_law_failure(failure)
    return _RecordComparison(records, identical, first)


def find_absent_samples(log: Log) -> list[_LateSample]:
    """Finds every sample that was late or lost in the network of a live session.

    A sample is due at its receiver after the delay prescribed by the scenario.

    If records of the receiver are missing, the log does not show whether a sample was lost or
    arrived in the missing ticks. The sample counts as lost if the receiver still uses an older
    sample in its first recorded tick at or after the due tick.

    Args:
        log: Log of a live session.

    Returns:
        The samples, in order of the tick in which they were due. Empty if all samples were on
        time.
    """
    absent: list[_LateSample] = []
    for name in log.sites:
        absent += _find_absent_at_site(log, name)
    return sorted(absent, key=lambda sample: sample.due_tick)


def _find_absent_at_site(log: Log, name: str) -> list[_LateSample]:
    """Finds the samples that had not arrived at one site when they were due.

    A sample is due after the delay that the scenario prescribes for the link.

    Args:
        log: Log of a live session.
        name: Name of the receiver.
    """
    site_log = log[name]
    commands = log.commands(name)
    peer_ticks = [log.scenario.ticks(peer) for peer in site_log.peers]
    _, arrivals = site_log.arrivals
    arrived_ticks = []  # for each peer, the ticks of all samples that ever arrived
    for peer in range(len(site_log.peers)):
        is_from_peer = arrivals[:, 0] == peer
        arrived_ticks.append(set(arrivals[is_from_peer, 1].tolist()))
    # Only the links of the site are used, so its control law is left out.
    site = Site(log.scenario.setup(name)._replace(law_factory=None))
    examined_counts = [0] * len(
        site_log.peers
    )  # for each peer, the number of samples examined so far
    absent = []
    for state in site_log.states:
        for command in commands.get(state.tick, ()):
            site.apply_change(command, state.t_ns)

        # Samples that arrived in this tick, but were due earlier.
        for peer, tick, _ in state.rx:
            # A damaged record may list any peer and tick.
            is_possible = 0 <= peer < len(peer_ticks) and 0 <= tick < peer_ticks[peer]
            due_tick = site.release_tick(peer, tick) if is_possible else None
            if due_tick is None or due_tick >= state.tick or site.is_measured(peer):
                continue
            absent.append(
                _LateSample(
                    site=name,
                    peer=site.peers[peer],
                    tick=tick,
                    due_tick=due_tick,
                    arrived_tick=state.tick,
                )
            )

        # Samples that were sent before this tick and never arrived.
        for peer, sender in enumerate(site_log.peers):
            newest = state.t_ns * site.peer_rate_hz(peer) // NS_PER_S
            sent = min(newest, log.last_ticks[sender]) + 1
            for tick in range(examined_counts[peer], sent):
                if tick in arrived_ticks[peer] or site.is_measured(peer):
                    continue
                due_tick = site.release_tick(peer, tick)
                if due_tick is None or not _uses_older(site_log, sender, tick, due_tick):
                    continue
                absent.append(
                    _LateSample(
                        site=name,
                        peer=sender,
                        tick=tick,
                        due_tick=due_tick,
                        arrived_tick=None,
                    )
                )
            examined_counts[peer] = max(examined_counts[peer], sent)
    return absent


def _uses_older(site_log: SiteLog, sender: str, tick: int, due_tick: int) -> bool:
    """Returns True if a site was still using an older sample when a given sample was due.

    Args:
        site_log: Records of the receiver.
        sender: Name of the site that sent the sample.
        tick: Tick in which the sample was sent.
        due_tick: Tick of the receiver in which the sample was due. If it has no record, the
            next record is examined.
    """
    row = int(np.searchsorted(site_log.tick, due_tick))
    return bool((site_log.used[sender][row : row + 1] < tick).any())


class _VirtualComparison(NamedTuple):
    """Comparison of the log of a live session with simulations of the same experiment.

    It shows whether the real network changed the result beyond the delays and losses prescribed
    by the scenario.

    Attributes:
        fed: Comparison with a simulation in which each sample arrives when it arrived in the
            session. All records must be equal.
        plain: Comparison with a simulation of a perfect network, in which samples arrive
            without delay. The records must be equal up to the first late or lost sample. If an
            arm is external, no records are compared, because its motion is known only for the
            recorded run.
        absent: Samples that arrived too late or never, in order of the tick in which they were
            due.
    """

    fed: _RecordComparison
    plain: _RecordComparison
    absent: list[_LateSample]

    @property
    def late(self) -> list[_LateSample]:
        """Samples that arrived later than the scenario's delay model allows."""
        return [sample for sample in self.absent if sample.arrived_tick is not None]

    @property
    def lost(self) -> list[_LateSample]:
        """Samples that the network lost, excluding losses prescribed by the scenario."""
        return [sample for sample in self.absent if sample.arrived_tick is None]

    @property
    def excused_from(self) -> int | None:
        """First tick of the log that may differ from a simulation with a perfect network.

        In this tick, a site needed a sample that was late or lost. None if no sample was late
        or lost.
        """
        return self.absent[0].due_tick if self.absent else None


def compare_with_virtual(log: Log, progress: Progress | None = None) -> _VirtualComparison:
    """Compares a log with two simulations of its scenario in virtual time.

    In the first simulation, samples arrive as in the log. In the second simulation, they arrive
    without delay. Both simulations end at the last record of the log.

    Args:
        log: Log of a live session, which contains its scenario.
        progress: Function that is called from time to time with the number of executed ticks
            and their total.
    """
    scenario = virtual.cut_to_records(log)
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

        def execute(
            network: Network | None, ticks_before: int
        ) -> Iterator[tuple[str, TickRecord]]:
            """Simulates the scenario of the recorded session again, tick by tick.

            The commands, the actions of live operators and the motion of external arms are
            taken from the log. A tick is executed when the caller requests its record.

            Args:
                network: Network that delivers the samples. If None, samples arrive without
                    delay.
                ticks_before: Number of ticks of earlier simulations, for reporting progress.

            Yields:
                The name of the site and the record of the tick.
            """
            ticks = virtual.execute_virtual(
                scenario=scenario,
                network=network,
                commands=commands,
                measured=arm_states,
                ends=log.last_ticks,
                hands=hands,
            )
            for executed_ticks, (site, _, record) in enumerate(ticks):
                if progress is not None and executed_ticks % PROGRESS_EVERY == 0:
                    progress(ticks_before + executed_ticks, total)
                yield site.name, record

        arrivals = {name: _read_arrivals(log, name) for name in log.sites}
        fed = _compare_records(log, execute(RecordedNetwork(arrivals, peers), 0), arrivals=True)
        if arm_states:
            plain = _RecordComparison(0, 0, None)
        else:
            plain = _compare_records(log, execute(None, total // 2), arrivals=False)
        return _VirtualComparison(fed, plain, find_absent_samples(log))


def _read_arrivals(log: Log, name: str) -> Mapping[int, Sequence[ArrivalEntry]]:
    """Returns a mapping from tick to the samples that arrived at a site in that tick.

    Arrivals in gaps in the log are estimated, unless too many records are missing.
    """
    site_log = log[name]
    rates_hz = [log.scenario.sites[peer].rate_hz for peer in site_log.peers]
    ends = [log.last_ticks[peer] for peer in site_log.peers]
    with suppress(LogError):
        return Deliveries.complete(site_log, rates_hz, ends).entries
    return Deliveries.read(site_log).entries
