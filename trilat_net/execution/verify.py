"""Executes every site again from its log and compares every computed field of every record.

Invariant (L3, L5): the log alone feeds `Site.step`, besides user control laws that it names by
hash. On the platform that made the log (by fingerprint) whole runs are executed and must agree
bit for bit; elsewhere each tick is recomputed from the two records before it, to 1e-9 (1 +
|a|). A gap is reported; execution resumes after it from two consecutive records, and records
that cannot be judged are counted, never reported as differences.
"""

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, zip_longest
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from .. import process
from ..core.fingerprint import compute_fingerprint
from ..core.law_channel import LawChannel
from ..core.site_arrays import MAX_RAMPS
from ..core.site_setup import StaleAction
from ..core.site_step import Site
from ..core.ticks import MAX_ARRIVALS, CoreChange, PlantState, TickInput, TickRecord
from ..errors import LawFailed, ScenarioError
from ..files import digest_file
from ..log.accounting import MIN_COVERAGE, Coverage
from ..log.log_reader import Log, open_log
from ..log.mcap_reader import Progress
from ..log.running_digest import Integrity
from ..log.session_check import judge_integrity
from ..log.site_log import SiteLog
from ..net.messages import MODE_WORDS, STATE_VECTORS, State
from ..scenario import parse_core_change
from ..scenario.code_consent import find_user_laws
from ..scenario.run_changes import count_skipped_ticks
from .resumption import ArrivalEntry, RecordedInputs, read_output

TOLERANCE = 1e-9
"""Across platforms, a and b count as equal if |a - b| <= TOLERANCE (1 + |a|)."""

NumberEquality = Callable[[float, float], bool]


class RecordDifference(NamedTuple):
    """A field of a record, with the index of the number in it, that differs from the execution."""

    site: str
    tick: int
    field: str
    logged: Any
    computed: Any

    def __str__(self) -> str:
        logged, computed = (
            f"{value!r} ({value.hex()})" if isinstance(value, float) else repr(value)
            for value in (self.logged, self.computed)
        )
        return (
            f"{self.site}, tick {self.tick}, {self.field}: logged {logged}, computed {computed}"
        )


def equal_bits(a: float, b: float) -> bool:
    """True if two numbers have the same bits (-0.0 is not 0.0)."""
    return a.hex() == b.hex()


def equal_to_tolerance(a: float, b: float) -> bool:
    """True if two numbers agree as well as two platforms can."""
    return abs(a - b) <= TOLERANCE * (1.0 + abs(a))


def describe_law_failure(failed: LawFailed) -> RecordDifference:
    """Returns the difference of a user law that fails now and did not when the log was made."""
    return RecordDifference(
        site=failed.site,
        tick=failed.tick or 0,
        field="record",
        logged="is there",
        computed=failed.problem,
    )


_vectors_of = attrgetter(*STATE_VECTORS, "mem")


def _pack(a: State | TickRecord) -> bytes:
    return array("d", chain.from_iterable(_vectors_of(a))).tobytes()


def equal_record(logged: State, computed: TickRecord, peers: tuple[str, ...]) -> bool:
    """True if every computed field of a record has the same bits; fast, for the common case."""
    a = logged
    b = computed
    return (
        _pack(a) == _pack(b)
        and a.used == dict(zip(peers, b.used, strict=True))
        and (a.tick, a.t_ns, a.rx_crc) == (b.tick, b.t_ns, b.rx_crc)
        and a.mode == MODE_WORDS[b.mode]
        and a.cmd == b.cmd
    )


def find_first_difference(
    logged: State,
    computed: TickRecord,
    peers: tuple[str, ...],
    equal: NumberEquality,
    channel: LawChannel = LawChannel(),  # noqa: B008
) -> RecordDifference | None:
    """Returns the first field in which a record differs from an execution, or None.

    `channel` has the names of what the site's law sends.
    """
    for name, a, b, same in _compare_fields(
        logged=logged, computed=computed, peers=peers, equal=equal, channel=channel
    ):
        if not same:
            return RecordDifference(
                site=logged.site, tick=logged.tick, field=name, logged=a, computed=b
            )
    return None


def _compare_fields(
    logged: State,
    computed: TickRecord,
    peers: tuple[str, ...],
    equal: NumberEquality,
    channel: LawChannel,
) -> Iterator[tuple[str, Any, Any, bool]]:
    mode = MODE_WORDS[computed.mode]
    yield "tick", logged.tick, computed.tick, logged.tick == computed.tick
    yield "t_ns", logged.t_ns, computed.t_ns, logged.t_ns == computed.t_ns
    yield "mode", logged.mode, mode, logged.mode == mode
    sent = [f"ch.{entry}" for entry in channel.entries(peers)]
    for vector in STATE_VECTORS:
        before = getattr(logged, vector)
        now = getattr(computed, vector)
        if len(before) != len(now):
            yield f"{vector} (how many numbers)", len(before), len(now), False
            continue
        for n, (a, b) in enumerate(zip(before, now, strict=True)):
            name = sent[n] if vector == "ch" and n < len(sent) else f"{vector}[{n}]"
            yield name, float(a), b, equal(float(a), b)
    used = dict(zip(peers, computed.used, strict=True))
    for peer in sorted({*logged.used, *used}):
        a = logged.used.get(peer)
        b = used.get(peer)
        yield f"used[{peer}]", a, b, a == b
    yield "rx (its CRC-32)", logged.rx_crc, computed.rx_crc, logged.rx_crc == computed.rx_crc
    yield "cmd", logged.cmd, computed.cmd, logged.cmd == computed.cmd
    alike = all(
        equal(float(a), float(b)) for a, b in zip(logged.mem, computed.mem, strict=False)
    )
    yield "mem", logged.mem, computed.mem, alike and len(logged.mem) == len(computed.mem)


@dataclass(slots=True)
class VerifyResult:
    """The result of executing a log again, in numbers of records.

    Attributes:
        whole_run: True if whole runs were executed and bits compared; False if tick by tick, to
            1e-9.
        coverage: ticks by site: those that were executed and compared, and those of the run.
        min_coverage: the least share of them that passes.
        integrity: whether the log is as it was made.
        unjudged: records behind gaps that could not be judged.
        first: the difference of the earliest tick.
        gaps: missing ticks: (site, first, last).
        absences: ticks that a site did not make between two of its starts, likewise.
        withheld: sites whose law may not run, which were not executed; all else is of the
            others.
    """

    whole_run: bool
    coverage: Coverage
    min_coverage: float
    integrity: Integrity
    records: int = 0
    identical: int = 0
    unjudged: int = 0
    differing: int = 0
    first: RecordDifference | None = None
    gaps: list[tuple[str, int, int]] = field(default_factory=list)
    absences: list[tuple[str, int, int]] = field(default_factory=list)
    withheld: list[str] = field(default_factory=list)

    @property
    def agreed(self) -> bool:
        """True if no record differs, however few were judged."""
        return self.first is None

    @property
    def passed(self) -> bool:
        """True if no record differs, enough of every site was judged, and the log is as it was
        made.
        """
        enough = not self.withheld and self.coverage.share >= self.min_coverage
        return self.agreed and enough and self.integrity.passed

    def add(self, other: "VerifyResult") -> None:
        """Adds the result of other sites, which were executed from another log."""
        for name in (
            "records",
            "identical",
            "unjudged",
            "differing",
            "gaps",
            "absences",
            "withheld",
        ):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in other.withheld:
            self.coverage.expected.pop(name, None)
        self.whole_run &= other.whole_run
        self.coverage.judged.update(other.coverage.judged)
        self._keep_first(other.first)
        if not other.integrity.passed:
            self.integrity = other.integrity

    def add_difference(self, difference: RecordDifference) -> None:
        """Counts a record that differs."""
        self.differing += 1
        self._keep_first(difference)

    def _keep_first(self, difference: RecordDifference | None) -> None:
        if difference is not None and (self.first is None or difference.tick < self.first.tick):
            self.first = difference


PROGRESS_EVERY = 256
"""Records between two reports of progress."""


class SiteVerifier:
    """One site, executed from its records.

    While it is `certain`, the site's state follows from the records before. A gap ends that,
    and so does the use of a sample that the log lacks; two consecutive records restore it.
    Arrivals inside a gap are unknown: samples that no record lists are assumed to have arrived
    there, and while one of them is in use a difference counts as unjudged. The same holds for a
    sample that arrived but whose own record is missing.
    """

    def __init__(
        self,
        log: Log,
        site: str,
        by_tick: Mapping[str, Mapping[int, State]],
        result: VerifyResult,
        resume_every: int = 0,
    ) -> None:
        self._resume_every = resume_every
        self._first = 0
        self._taken: list[CoreChange] = []
        self._setup = setup = log.scenario.setup(site)
        self._site = Site(setup)
        self._channel = setup.channel
        self._starts = {boot: first for first, boot in log.starts.get(site, ())}
        self._absences = {last + 1: first for first, last in log.absences.get(site, ())}
        reflects = setup.own is not None or any(setup.gains.k_f)
        self._apart = setup.on_stale.action is StaleAction.GLIDE and not reflects
        self._boot: int | None = None
        self._began = 0  # the place of the first record of this start
        self._scenario = log.scenario
        self._log = log[site]
        self._result = result
        self._external = site in log.scenario.external
        self._law_failed = False
        self._own_end = log.last_ticks[site]
        self._equal = equal_bits if result.whole_run else equal_to_tolerance
        self._certain = True
        self._inputs = RecordedInputs(
            part=log[site],
            samples=by_tick,
            ends=log.last_ticks,
            changes=log.changes(site),
            links=setup.links,
        )

    def run(self, report: Callable[[int], None] | None = None) -> None:
        """Executes every record; `report` gets the number of records of all sites so far, now
        and then.
        """
        result = self._result
        states = self._log.states
        name = self._log.name
        before = result.records - result.unjudged
        expected = 0
        for n, state in enumerate(states):
            if report is not None and n % PROGRESS_EVERY == 0:
                report(result.records)
            result.records += 1
            if state.tick == expected - 1 and state.boot not in self._starts:
                result.add_difference(
                    RecordDifference(
                        site=state.site,
                        tick=state.tick,
                        field="tick",
                        logged=state.tick,
                        computed=expected,
                    )
                )
                continue
            if self._boot is None or (state.boot != self._boot and state.boot in self._starts):
                expected = self._begin_start(n, expected)
            if state.tick != expected + count_skipped_ticks(state.cmd):
                result.gaps.append((name, expected, state.tick - 1))
                self._certain = False
            expected = state.tick + 1
            try:
                if self._resume_every and state.tick % self._resume_every == 0:
                    self._start_afresh(n, state)
                resumes = not self._certain and not self._law_failed and n - 2 >= self._began
                if resumes and self._inputs.can_resume(n, apart=self._apart):
                    missed, _ = self._parse_changes(state.tick - 1)  # ordered in the gap
                    self._inputs.resume(self._site, n, missed)
                    self._certain = True
                if self._certain and not self._law_failed:
                    self._verify_record(n, state)
                elif other := self._find_other_sender(state):
                    result.add_difference(other)
                else:
                    result.unjudged += 1
            except LawFailed as failed:
                self._law_failed = True
                result.add_difference(describe_law_failure(failed)._replace(tick=state.tick))
            except ValueError as error:  # no site takes so many changes
                self._certain = False
                result.add_difference(
                    RecordDifference(
                        site=name,
                        tick=state.tick,
                        field="cmd",
                        logged="here",
                        computed=str(error),
                    )
                )
        result.coverage.judged[name] = result.records - result.unjudged - before
        if expected <= self._own_end:
            result.gaps.append((name, expected, self._own_end))

    def _begin_start(self, n: int, expected: int) -> int:
        """Goes over to the start of the site that made record n; returns its first tick."""
        self._boot = self._log.states[n].boot
        self._began = n
        first = self._starts.get(self._boot)
        if first is None or first < expected:
            return expected
        absent = max(self._absences.get(first, first), expected)
        if expected < absent:
            self._result.gaps.append((self._log.name, expected, absent - 1))
        if absent < first:
            self._result.absences.append((self._log.name, absent, first - 1))
        self._inputs.pop_changes(first - 1)  # the start before took them in
        self._site = Site(self._setup)
        self._certain = True
        self._first = first
        self._taken.clear()
        self._site.begin_at(first)
        return first

    def _start_afresh(self, n: int, state: State) -> None:
        """Has record n made by a site that knows the records before it alone, if they tell
        enough.
        """
        known = self._certain and n - 2 >= self._began
        if not known or self._law_failed or not self._inputs.can_resume(n, apart=self._apart):
            return
        self._site = Site(self._setup)
        self._certain = False
        if self._first:
            self._site.begin_at(self._first)
        for change in self._taken:
            self._site.order(change, state.t_ns)

    def _find_other_sender(self, state: State) -> RecordDifference | None:
        name = self._log.name
        if state.boot != (boot := self._boot):
            return RecordDifference(
                site=name, tick=state.tick, field="boot", logged=state.boot, computed=boot
            )
        return (
            None
            if state.site == name
            else RecordDifference(
                site=name, tick=state.tick, field="site", logged=state.site, computed=name
            )
        )

    def _verify_record(self, n: int, state: State) -> None:
        result = self._result
        states = self._log.states
        peers = self._log.peers
        difference = self._find_other_sender(state)
        if (
            not result.whole_run
            and n - 2 >= self._began
            and states[n - 2].tick == state.tick - 2
        ):
            self._site.resume(
                read_output(states[n - 2], peers), read_output(states[n - 1], peers)
            )
        arrivals, missing = self._inputs.find_arrivals(state.rx)
        invalid = None
        if missing:
            entries, invalid = self._check_arrivals(state)
            arrivals, missing = self._inputs.find_arrivals(entries)
            self._inputs.add_lacking(missing)
        changes, invalid_change = self._parse_changes(state.tick)
        plant = (
            PlantState(state.q, state.qd, state.tau_x, state.bodies) if self._external else None
        )
        output = self._site.step(
            TickInput(
                k=state.tick,
                arrivals=arrivals[:MAX_ARRIVALS],
                commands=changes,
                measured=plant,
                hand=state.hand,
            )
        )
        if missing:  # the CRC of a sample that the log lacks cannot be checked
            output = output._replace(rx_crc=state.rx_crc)
        difference = invalid_change or invalid or difference
        if difference is None and not equal_record(state, output, peers):
            difference = find_first_difference(
                logged=state,
                computed=output,
                peers=peers,
                equal=self._equal,
                channel=self._channel,
            )
            if difference is not None and self._inputs.is_uncertain(state, output):
                result.unjudged += 1
                self._certain = False
                return
        if difference is None:
            result.identical += 1
        else:
            result.add_difference(difference)

    def _parse_changes(self, tick: int) -> tuple[list[CoreChange], RecordDifference | None]:
        """Returns the changes up to a tick that were not executed yet; an invalid one is a
        difference.
        """
        changes: list[CoreChange] = []
        for named, text in self._inputs.pop_changes(tick):
            try:
                changes.append(parse_core_change(self._scenario, self._log.name, text))
            except ScenarioError:
                valid = "a change of one of its links or of its shares"
                return changes, RecordDifference(
                    site=self._log.name, tick=named, field="cmd", logged=text, computed=valid
                )
        self._taken += changes[:MAX_RAMPS]
        return changes[:MAX_RAMPS], None

    def _check_arrivals(
        self, state: State
    ) -> tuple[Sequence[ArrivalEntry], RecordDifference | None]:
        for n, (peer, tick, _) in enumerate(state.rx):
            if not 0 <= peer < len(self._inputs.samples):
                invalid = RecordDifference(
                    site=state.site,
                    tick=state.tick,
                    field="rx (peer)",
                    logged=peer,
                    computed="an index of a peer",
                )
                return state.rx[:n], invalid
            if (
                tick not in self._inputs.samples[peer]
                and not 0 <= tick <= self._inputs.ends[peer]
            ):
                valid = f"a tick from 0 to {self._inputs.ends[peer]}"
                where = f"rx[{self._log.peers[peer]}]"
                return state.rx[:n], RecordDifference(
                    site=state.site, tick=state.tick, field=where, logged=tick, computed=valid
                )
        return state.rx, None


def verify(
    log: Log,
    progress: Progress | None = None,
    *,
    min_coverage: float = MIN_COVERAGE,
    resume_every: int = 0,
) -> VerifyResult:
    """Executes every site of a log again; `progress` gets the records done and their total.

    Args:
        log: the log.
        progress: called now and then.
        min_coverage: the least share of every site's ticks that must be judged to pass.
        resume_every: at every tick that it divides a site starts afresh from the records, so
            that what a law knows besides shows; 0: at none.

    Raises:
        LogError: a record cannot be read.
        ScenarioError: a user law that may run cannot be made.
    """
    result = _begin(log, min_coverage)
    with process.pause_gc():
        sites = log.executed_sites
        total = sum(len(log[name]) for name in sites)
        report = None if progress is None else lambda done: progress(done, total)
        _execute_sites(
            log=log, sites=sites, result=result, report=report, resume_every=resume_every
        )
        others = [name for name in log.sites if name not in sites]
        if others and (source := open_rerun_source(log)) is not None:
            for name in others:
                _compare_with_source(log[name], source[name], result)
            theirs = _begin(source, min_coverage)
            _execute_sites(
                source, [name for name in source.executed_sites if name in others], theirs
            )
            result.add(theirs)
    return result


def _begin(log: Log, min_coverage: float) -> VerifyResult:
    return VerifyResult(
        whole_run=log.session.get("fingerprint") == compute_fingerprint(),
        coverage=Coverage({}, {site: log.expected_ticks(site) for site in log.sites}),
        min_coverage=min_coverage,
        integrity=judge_integrity(log),
    )


def _execute_sites(
    log: Log,
    sites: Sequence[str],
    result: VerifyResult,
    report: Callable[[int], None] | None = None,
    resume_every: int = 0,
) -> None:
    by_tick = {name: log[name].by_tick for name in log.sites}
    laws = find_user_laws(log.scenario)
    withheld = [name for law in laws if not law.allowed for name in law.sites if name in sites]
    result.withheld += withheld
    for name in withheld:
        result.coverage.expected.pop(name, None)
    for name in (name for name in sites if name not in withheld):
        SiteVerifier(
            log=log, site=name, by_tick=by_tick, result=result, resume_every=resume_every
        ).run(report)


def _compare_with_source(recorded: SiteLog, source: SiteLog, result: VerifyResult) -> None:
    if recorded.payloads == source.payloads:
        return
    for ours, theirs in zip_longest(recorded.states, source.states):
        if ours is None or theirs is None or ours != msgspec.structs.replace(theirs, v=ours.v):
            tick = (ours or theirs).tick
            result.add_difference(
                RecordDifference(
                    site=recorded.name,
                    tick=tick,
                    field="record",
                    logged="here",
                    computed="in its log",
                )
            )
            return


def open_rerun_source(log: Log) -> Log | None:
    """Returns the log that a rerun was made of, if it stands beside it and is the same file;
    else None.
    """
    names, digests = (
        log.session.get(key, "").split() for key in ("rerun_of", "rerun_of_sha256")
    )
    files = [Path(log.sources[0]).with_name(Path(name).name) for name in names]
    if not files or len(files) != len(digests) or not all(map(Path.is_file, files)):
        return None
    if [*map(digest_file, files)] != digests:
        return None
    source = open_log(*files)
    return source if source.sites == log.sites else None
