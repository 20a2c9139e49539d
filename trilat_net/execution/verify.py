"""Executes every site again from its log and compares every computed field of every record.

Invariant (L3, L5): the log alone feeds `Site.step`, besides user control laws that it names by hash. On the
platform that made the log (by fingerprint) whole runs are executed and must agree bit for bit; elsewhere
each tick is recomputed from the two records before it, to 1e-9 (1 + |a|). A gap is reported; execution
resumes after it from two consecutive records, and records that cannot be judged are counted, never
reported as differences.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from .. import process
from ..core.fingerprint import compute_fingerprint
from ..core.site_step import MAX_CHANGES, Site
from ..core.ticks import MAX_ARRIVALS, Arrival, CoreChange, TickInput, TickRecord
from ..errors import LawFailed, ScenarioError
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from ..log.site_log import SiteLog
from ..net.messages import State
from ..scenario import Scenario, parse_core_change
from ..scenario.laws import ImportedLaw
from .difference import (
    RecordDifference,
    describe_law_failure,
    equal_bits,
    equal_record,
    equal_to_tolerance,
    find_first_difference,
)
from .resumption import Resumption, read_output, read_plant_state


@dataclass(slots=True)
class VerifyResult:
    """What an execution from a log showed.

    Attributes:
        whole_run: True where runs were executed whole and bits compared; False where tick by tick, to 1e-9.
        records: records in the log.
        identical: records of which every computed field agreed.
        unjudged: records that nothing could be said of, behind gaps.
        differing: records that differ.
        first: the first difference, by tick and then by site.
        gaps: missing ticks: (site, first, last).
    """

    whole_run: bool
    records: int = 0
    identical: int = 0
    unjudged: int = 0
    differing: int = 0
    first: RecordDifference | None = None
    gaps: list[tuple[str, int, int]] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """True where no record differs."""
        return self.first is None

    def differ(self, difference: RecordDifference) -> None:
        """Books a record that differs."""
        self.differing += 1
        if self.first is None or difference.tick < self.first.tick:
            self.first = difference


class LoggedUserLaw(NamedTuple):
    """A law that a log names.

    Attributes:
        code: where it is, as in "package.module:Law".
        sites: whose law it is.
        changed: how its file differs from the one that ran; "" where it does not.
    """

    code: str
    sites: tuple[str, ...]
    changed: str

    def __str__(self) -> str:
        told = f"its file was changed, {self.changed}" if self.changed else "its file is the one that ran"
        return f"{self.code} of {', '.join(self.sites)}; {told}"


def find_user_laws(scenario: Scenario, source: str = "") -> list[LoggedUserLaw]:
    """Returns the laws from outside of a scenario; nothing of them runs.

    Args:
        scenario: as a log holds it.
        source: what errors call it.

    Raises:
        ScenarioError: the file of one is not there.
    """
    laws: dict[tuple[str, str], tuple[ImportedLaw, list[str]]] = {}
    for name, spec in scenario.sites.items():
        if isinstance(spec.control, ImportedLaw):
            law = spec.control
            laws.setdefault((law.code, law.source_sha256), (law, []))[1].append(name)
    found = []
    for law, sites in laws.values():
        try:
            changed = law.changed() or ""
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=f"sites.{sites[0]}.control", source=source) from None
        found.append(LoggedUserLaw(law.code, tuple(sites), changed))
    return found


PROGRESS_EVERY = 256
"""Records after which one is told how many are done."""


class SiteVerifier:
    """One site, executed from its records.

    While it is `assured`, the site's state follows from the records before. It is lost at a gap, and when a
    sample comes into use that the log lacks; two records in a row bring it back. What arrived inside a gap
    is not known: samples that no record lists are taken to have come in it (`assumed`), and as long as one
    of them is in use a difference counts as unjudged. So it does when the sample in use is one that
    arrived but whose own record is missing (`lacking`).
    """

    def __init__(
        self,
        scenario: Scenario,
        site_log: SiteLog,
        changes: Mapping[int, Sequence[str]],
        by_tick: Mapping[str, Mapping[int, State]],
        ends: Mapping[str, int],
        verdict: VerifyResult,
    ) -> None:
        self._site = Site(scenario.setup(site_log.name))
        self._scenario, self._log = scenario, site_log
        self._external = site_log.name in scenario.external
        self._law_failed = False
        self._changes = sorted(changes.items())
        self._peers = site_log.peers
        self._by_tick = [by_tick[peer] for peer in site_log.peers]
        self._ends = [ends[peer] for peer in site_log.peers]
        self._own_end = ends[site_log.name]
        self._verdict = verdict
        self._same = equal_bits if verdict.whole_run else equal_to_tolerance
        self._assured = True
        self._resumption = Resumption(site_log, self._by_tick, self._ends)

    def run(self, told: Callable[[int], None] | None = None) -> None:
        """Executes every record.

        Args:
            told: told now and then how many are done.
        """
        verdict, states = self._verdict, self._log.states
        expected = 0
        for n, state in enumerate(states):
            if told is not None and n % PROGRESS_EVERY == 0:
                told(n)
            verdict.records += 1
            if state.tick == expected - 1:
                verdict.differ(RecordDifference(state.site, state.tick, "tick", state.tick, expected))
                continue
            if state.tick != expected:
                verdict.gaps.append((self._log.name, expected, state.tick - 1))
                self._assured = False
            expected = state.tick + 1
            try:
                if self._law_failed or (not self._assured and not self._resume(n)):
                    verdict.unjudged += 1
                    continue
                self._judge(n, state)
            except LawFailed as failed:
                self._law_failed = True
                verdict.differ(describe_law_failure(failed)._replace(tick=state.tick))
        if expected <= self._own_end:
            verdict.gaps.append((self._log.name, expected, self._own_end))

    def _judge(self, n: int, state: State) -> None:
        """Steps one tick and compares."""
        verdict = self._verdict
        states = self._log.states
        if not verdict.whole_run and n >= 2 and states[n - 2].tick == state.tick - 2:
            before, last = (read_output(states[m], self._peers) for m in (n - 2, n - 1))
            self._site.resume(before, last)
        arrivals, missing = self._arrivals(state)
        commands, strange = self._commands(state.tick)
        tick = TickInput(state.tick, arrivals, commands, read_plant_state(state) if self._external else None)
        if missing is not None and missing.field != "":
            strange = strange or missing
        if strange is not None:
            verdict.differ(strange)
            self._site.step(tick)
            return
        output = self._site.step(tick)
        if missing is not None:  # the log lacks a sample that came in: its CRC cannot be checked
            output = output._replace(rx_crc=state.rx_crc)
        if state.boot != states[0].boot:
            verdict.differ(RecordDifference(self._log.name, state.tick, "boot", state.boot, states[0].boot))
        elif state.site != self._log.name:
            verdict.differ(RecordDifference(self._log.name, state.tick, "site", state.site, self._log.name))
        elif equal_record(state, output, self._peers):
            verdict.identical += 1
        elif difference := find_first_difference(state, output, self._peers, self._same):
            self._book(state, output, difference)
        else:
            verdict.identical += 1

    def _commands(self, tick: int) -> tuple[list[CoreChange], RecordDifference | None]:
        """Returns the changes up to a tick that have not been ordered yet; one that is none differs."""
        commands: list[CoreChange] = []
        while self._changes and self._changes[0][0] <= tick:
            named, texts = self._changes.pop(0)
            for text in texts:
                try:
                    commands.append(parse_core_change(self._scenario, self._log.name, text))
                except ScenarioError:
                    valid = "a change of one of its links or of its shares"
                    return commands, RecordDifference(self._log.name, named, "cmd", text, valid)
        return commands[:MAX_CHANGES], None

    def _book(self, state: State, output: TickRecord, difference: RecordDifference) -> None:
        if self._resumption.in_doubt(state, output):
            self._verdict.unjudged += 1
            self._assured = False
        else:
            self._verdict.differ(difference)

    def _arrivals(self, state: State) -> tuple[list[Arrival], RecordDifference | None]:
        """Returns what a record says came in, with the samples of its peers' records.

        A sample that no record of the log can be is a difference; one whose record is merely missing is
        told by a difference without a field.
        """
        arrivals: list[Arrival] = []
        lacking = None
        for peer, tick, latency_us in state.rx:
            if not 0 <= peer < len(self._peers):
                return arrivals, RecordDifference(
                    state.site, state.tick, "rx (peer)", peer, "an index of a peer"
                )
            sample = self._by_tick[peer].get(tick)
            if sample is not None:
                arrivals.append(Arrival(peer, tick, sample.q, sample.qd, latency_us, sample.tau_x))
            elif 0 <= tick <= self._ends[peer]:
                self._resumption.lacking[peer].add(tick)
                lacking = RecordDifference(state.site, state.tick, "", tick, None)
            else:
                valid = f"a tick from 0 to {self._ends[peer]}"
                return arrivals, RecordDifference(
                    state.site, state.tick, f"rx[{self._peers[peer]}]", tick, valid
                )
        return arrivals[:MAX_ARRIVALS], lacking

    def _resume(self, n: int) -> bool:
        """Brings the site to where record n finds it, if the two records before it stand in a row."""
        if not self._resumption.possible(n):
            return False
        for command in self._commands(self._log.states[n].tick - 1)[0]:  # given in the gap
            self._site.order(command)
        self._resumption.place(self._site, n)
        self._assured = True
        return True


EXECUTED_SITES_KEY = "rerun_executed"
"""Entry of a session's metadata, of a log that a rerun wrote: the sites whose records follow from it."""


def verify(log: Log, progress: Progress | None = None) -> VerifyResult:
    """Executes every site of a log again.

    Args:
        log: the log.
        progress: told how many records are done, and how many there are.

    Raises:
        LogError: a record cannot be read.
        ScenarioError: a law from outside is not there.
    """
    verdict = VerifyResult(whole_run=log.session.get("fingerprint") == compute_fingerprint())
    with process.pause_gc():
        by_tick = {name: log[name].by_tick for name in log.sites}
        ends = find_last_ticks(log)
        sites = find_executed_sites(log)
        total = sum(len(log[name]) for name in sites)
        for name in sites:
            told = None if progress is None else _offset_progress(progress, verdict.records, total)
            SiteVerifier(log.scenario, log[name], log.changes(name), by_tick, ends, verdict).run(told)
    return verdict


def _offset_progress(progress: Progress, before: int, total: int) -> Callable[[int], None]:
    return lambda done: progress(before + done, total)


def find_executed_sites(log: Log) -> tuple[str, ...]:
    """Returns the sites whose records can be executed from the file.

    All of them, but in an open-loop rerun: there the others stand as they were recorded against sites that
    were otherwise.
    """
    named = log.session.get(EXECUTED_SITES_KEY)
    return tuple(name for name in log.sites if named is None or name in named.split())


def find_last_ticks(log: Log) -> dict[str, int]:
    """Returns the last tick that each site is known to have made, -1 where nothing is known.

    By its own word at the end; where it never said one, by its records and by what its peers had from it.
    """
    most = {name: log.scenario.ticks(name) for name in log.sites}
    said = {
        event.member: min(max(event.ticks, 0), most[event.member]) - 1
        for event in log.events
        if event.kind == "end" and event.member in most
    }
    last = {name: max((state.tick for state in log[name].states[-1:]), default=-1) for name in log.sites}
    for name in log.sites:
        peers = log[name].peers
        if said.keys() >= set(peers):
            continue
        for state in log[name].states:
            for peer, tick, _ in state.rx:
                if 0 <= peer < len(peers) and tick < most[peers[peer]]:
                    last[peers[peer]] = max(last[peers[peer]], tick)
    return {name: said.get(name, known) for name, known in last.items()}
