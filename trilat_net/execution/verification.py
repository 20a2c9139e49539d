"""Verifies a log by re-executing every tick and comparing every computed field of every record.

This is possible because the log contains not only the result of each tick, but also its inputs,
such as the samples that arrived.

Invariant (L3, L5):
    - The inputs of `Site.step` come only from the log, and its code comes from the program and
      from files with users' control laws, whose hashes are in the log.
    - On the platform on which the log was recorded (equal fingerprint), whole runs are
      executed, and must be bit-identical to the log.
    - On other platforms, rounding differs. Each tick is then computed from the two preceding
      records, and two values a and b agree if |a - b| <= 1e-9 (1 + |a|).
    - Gaps in the log are reported. After a gap, execution resumes from two consecutive records.
      Records that cannot be judged are counted, but never reported as differences.
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
from ..core import (
    MAX_ARRIVALS,
    MAX_RAMPS,
    CoreChange,
    LawChannel,
    PlantState,
    Site,
    TickInput,
    TickRepeater,
    compute_fingerprint,
)
from ..errors import LawFailed, ScenarioError
from ..files import digest_file
from ..log import (
    MIN_COVERAGE,
    Coverage,
    Integrity,
    Log,
    Progress,
    SiteLog,
    count_skipped_ticks,
    open_log,
)
from ..net import MODE_WORDS, STATE_VECTORS, State
from ..records import TickRecord
from .recorded_rows import LEAST_ROWS, PlainRows, SampleTable
from .resumption import ArrivalEntry, RecordedInputs

TOLERANCE = 1e-9
"""Numbers a and b from different platforms are considered equal if |a - b| <= TOLERANCE (1 +
|a|).
"""

NumberEquality = Callable[[float, float], bool]
"""Function that decides whether a logged and a computed number are considered equal."""


def _equal_bits(a: float, b: float) -> bool:
    """Returns True if two floating-point numbers are identical bit by bit.

    Unlike `==`, this distinguishes -0.0 from 0.0, and treats two NaNs as equal.
    """
    return a.hex() == b.hex()


class RecordDifference(NamedTuple):
    """Difference between a record of a log and the result of re-executing its tick.

    Only the first differing field is stored.

    Attributes:
        site: Name of the site that produced the record.
        tick: Number of the tick.
        field: Name of the field. For a vector, the name includes the index of the element, for
            example "q[1]".
        logged: Value in the log.
        computed: Value computed by the re-execution.
    """

    site: str
    tick: int
    field: str
    logged: Any
    computed: Any

    def __str__(self) -> str:
        """Describes the difference in one sentence, for the report to the user."""
        logged = _format_value(self.logged)
        computed = _format_value(self.computed)
        location = f"{self.site}, tick {self.tick}, {self.field}"
        return f"{location}: logged {logged}, computed {computed}"

    @classmethod
    def of_law_failure(cls, failure: LawFailed) -> "RecordDifference":
        """Describes the failure of a user's control law in a re-executed tick of a log.

        The law did not fail in the logged session. After the failure, no further ticks of the
        site can be executed. The report counts the failure as a logged record that the
        re-execution did not reproduce.

        Args:
            failure: The error raised by the control law.
        """
        return cls(
            site=failure.site,
            tick=failure.tick or 0,
            field="record",
            logged="is there",
            computed=failure.problem,
        )

    @classmethod
    def find(
        cls,
        logged: State,
        computed: TickRecord,
        peers: tuple[str, ...],
        equal: NumberEquality = _equal_bits,
        channel: LawChannel = LawChannel(),  # noqa: B008
    ) -> "RecordDifference | None":
        """Finds the first field of a record that differs from a re-execution of its tick.

        Args:
            logged: Record of the tick in the log.
            computed: Result of re-executing the tick.
            peers: Names of the other sites, in scenario order.
            equal: Function that decides whether two numbers are considered equal. By default,
                they must be bit-identical.
            channel: Layout and names of the vectors that the site's control law sends. By
                default, the law sends no vectors.

        Returns:
            The difference, or None if all computed fields agree.
        """
        comparisons = _compare_fields(
            logged=logged, computed=computed, peers=peers, equal=equal, channel=channel
        )
        for name, logged_value, computed_value, is_equal in comparisons:
            if not is_equal:
                return cls(
                    site=logged.site,
                    tick=logged.tick,
                    field=name,
                    logged=logged_value,
                    computed=computed_value,
                )
        return None


def _format_value(value: object) -> str:
    """Formats a value as a string. For a floating-point number, its bits are shown too."""
    return f"{value!r} ({value.hex()})" if isinstance(value, float) else repr(value)


def _equal_to_tolerance(a: float, b: float) -> bool:
    """Returns True if two numbers agree within `TOLERANCE`.

    Two platforms may round some operations differently. The results of the same computation
    should still agree to this extent.
    """
    return abs(a - b) <= TOLERANCE * (1.0 + abs(a))


_get_vectors = attrgetter(*STATE_VECTORS, "mem")


def _pack_vectors(record: State | TickRecord) -> bytes:
    """Packs all vectors of a record into bytes, which can be compared in one step."""
    return array("d", chain.from_iterable(_get_vectors(record))).tobytes()


def equal_record(logged: State, computed: TickRecord, peers: tuple[str, ...]) -> bool:
    """Returns True if a record is bit-identical to the result of re-executing its tick.

    All computed fields are compared. Nearly all records are equal, so this function is
    optimised for speed. If it returns False, use `RecordDifference.find` to find the differing
    field.

    Args:
        logged: Record of the tick in the log.
        computed: Result of re-executing the tick.
        peers: Names of the other sites, in scenario order.
    """
    return (
        _pack_vectors(logged) == _pack_vectors(computed)
        and logged.used == dict(zip(peers, computed.used, strict=True))
        and logged.tick == computed.tick
        and logged.t_ns == computed.t_ns
        and logged.rx_crc == computed.rx_crc
        and logged.mode == MODE_WORDS[computed.mode]
        and logged.cmd == computed.cmd
    )


def _compare_fields(
    logged: State,
    computed: TickRecord,
    peers: tuple[str, ...],
    equal: NumberEquality,
    channel: LawChannel,
) -> Iterator[tuple[str, Any, Any, bool]]:
    """Compares a recorded tick with its re-execution, field by field.

    See `RecordDifference.find`.

    Yields:
        Name of the field, logged value, computed value, and whether they are equal.
    """
    mode = MODE_WORDS[computed.mode]
    yield "tick", logged.tick, computed.tick, logged.tick == computed.tick
    yield "t_ns", logged.t_ns, computed.t_ns, logged.t_ns == computed.t_ns
    yield "mode", logged.mode, mode, logged.mode == mode

    channel_names = [f"ch.{entry}" for entry in channel.entries(peers)]
    for vector in STATE_VECTORS:
        logged_numbers = getattr(logged, vector)
        computed_numbers = getattr(computed, vector)
        logged_count = len(logged_numbers)
        computed_count = len(computed_numbers)
        if logged_count != computed_count:
            yield f"{vector} (number of values)", logged_count, computed_count, False
            continue
        names = [f"{vector}[{n}]" for n in range(logged_count)]
        if vector == "ch":
            names[: len(channel_names)] = channel_names[:logged_count]
        for name, a, b in zip(names, logged_numbers, computed_numbers, strict=True):
            yield name, float(a), b, equal(float(a), b)

    used = dict(zip(peers, computed.used, strict=True))
    for peer in sorted({*logged.used, *used}):
        logged_tick = logged.used.get(peer)
        computed_tick = used.get(peer)
        yield f"used[{peer}]", logged_tick, computed_tick, logged_tick == computed_tick
    yield "rx (its CRC-32)", logged.rx_crc, computed.rx_crc, logged.rx_crc == computed.rx_crc
    yield "cmd", logged.cmd, computed.cmd, logged.cmd == computed.cmd

    same_numbers = all(
        equal(float(a), float(b)) for a, b in zip(logged.mem, computed.mem, strict=False)
    )
    same_length = len(logged.mem) == len(computed.mem)
    yield "mem", logged.mem, computed.mem, same_numbers and same_length


@dataclass(slots=True)
class VerifyResult:
    """Result of checking a log by re-executing its ticks.

    Each record is judged by comparing it with the result of re-executing its tick. It may be
    impossible to judge a record after a gap in the log.

    Attributes:
        whole_run: True if whole runs were executed and compared bit by bit. False if single
            ticks were executed and compared within a tolerance.
        coverage: For each site, the number of judged ticks and the number of ticks of the run.
        min_coverage: Smallest fraction of every site's ticks that must be compared.
        integrity: States whether the log is unchanged since it was written.
        records: Number of records that were examined.
        identical: Number of records in which every computed field agrees with the re-execution.
        unjudged: Number of records after gaps that could not be judged.
        differing: Number of records that differ from the re-execution.
        first: Difference in the earliest tick. None if there is no difference.
        gaps: Ranges of missing ticks, as (site, first tick, last tick).
        absences: Ranges of ticks that a site did not execute because it had left the session,
            as (site, first tick, last tick).
        withheld: Names of the sites that were not run again, because their control law is code
            that is not allowed to run. They are excluded from all other results.
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
        """True if no record of the log differs from the re-execution of its tick.

        Also True if few or no records could be compared.
        """
        return self.first is None

    @property
    def passed(self) -> bool:
        """True if the log can be trusted to contain what the controllers computed.

        This requires that no record differs from its re-execution, that the log is unchanged
        since it was written, and that enough ticks of every site were compared.
        """
        enough = not self.withheld and self.coverage.share >= self.min_coverage
        return self.agreed and enough and self.integrity.passed

    def add(self, other: "VerifyResult") -> None:
        """Merges the result for other sites of the same log into this result.

        The log of a rerun contains some sites that were copied from an older log. These sites
        are checked against that log, which gives a separate result.

        Counts are added, and lists are concatenated. In the merged result, `whole_run` is True
        only if it is True in both results, and `integrity` passes only if it passes in both.

        Args:
            other: Result for the other sites. It is not modified.
        """
        self.records += other.records
        self.identical += other.identical
        self.unjudged += other.unjudged
        self.differing += other.differing
        self.gaps = self.gaps + other.gaps
        self.absences = self.absences + other.absences
        self.withheld = self.withheld + other.withheld
        # No ticks are expected from sites that may not be executed.
        for name in other.withheld:
            self.coverage.expected.pop(name, None)
        self.whole_run &= other.whole_run
        # This coverage expects the ticks of all sites already. Only the judged ticks are new.
        self.coverage.judged.update(other.coverage.judged)
        self._keep_first(other.first)
        if not other.integrity.passed:
            self.integrity = other.integrity  # one failed log suffices to fail the whole check

    def add_difference(self, difference: RecordDifference) -> None:
        """Counts one more record that differs from the re-execution of its tick.

        Args:
            difference: The difference. It is stored as `first` if it is the earliest one.
        """
        self.differing += 1
        self._keep_first(difference)

    def _keep_first(self, difference: RecordDifference | None) -> None:
        """Stores a difference as `first` if its tick is the earliest so far."""
        if difference is not None and (self.first is None or difference.tick < self.first.tick):
            self.first = difference


PROGRESS_EVERY = 256
"""Number of records between two progress reports."""
_MOST_SINGLE_RECORDS = 1 << 12
"""Maximum number of records examined one by one before the compiled loop is tried."""


class _SiteVerifier:
    """Re-executes the recorded ticks of one site, and compares each record with the result.

    The state of the site is certain as long as it follows from the previous records. It becomes
    uncertain at a gap in the log, and if the site uses a sample that the log does not contain.
    Two consecutive records make it certain again.

    The log does not show which samples arrived during a gap. A sample that no record lists is
    assumed to have arrived during the gap. While such a sample is in use, a deviating record is
    counted as impossible to judge rather than as different. The same applies to a sample that
    arrived, but whose content is missing from the log.

    Most records are plain: their state is certain, and all of their inputs are in the log.
    Their ticks are executed by a compiled loop, which stops before the first record that
    differs. That record, and every record that is not plain, is examined with `Site.step`.

    Args:
        log: The log.
        site: Name of the site.
        samples: Samples of all sites for the compiled loop. None if the loop cannot be used.
        result: Object to which the counts and differences are added.
        resume_every: Interval, in ticks, at which the site is restored from the records, see
            `verify_log`. 0 means never.
    """

    def __init__(
        self,
        log: Log,
        site: str,
        samples: SampleTable | None,
        result: VerifyResult,
        resume_every: int = 0,
    ) -> None:
        self._result = result
        self._scenario = log.scenario
        self._log = log[site]
        self._setup = setup = log.scenario.setup(site)
        self._channel = setup.channel
        self._site = Site(setup)
        self._external = site in log.scenario.external
        # Under the stale rule "glide", the reference of a holding site does not depend on the
        # peers, unless its law reflects forces.
        reflects = setup.law_factory is not None or any(setup.gains.k_f)
        self._detached = setup.on_stale.glides and not reflects
        self._starts = {boot: first for first, boot in log.starts.get(site, ())}
        self._absences = {last + 1: first for first, last in log.absences.get(site, ())}
        self._last_tick = log.last_ticks[site]
        self._boot: int | None = None
        # Row of the first record, first tick and applied changes of the current start (boot).
        self._start_row = 0
        self._start_tick = 0
        self._applied: list[CoreChange] = []
        self._resume_every = resume_every
        self._equal = _equal_bits if result.whole_run else _equal_to_tolerance
        self._certain = True
        self._law_failed = False
        self._plain_rows: PlainRows | None = None
        self._repeater: TickRepeater | None = None
        # Number of records to examine one by one before the compiled loop is tried again, now
        # and after its next failure.
        self._single_records = 0
        self._next_single_records = 1
        indexed = self._log.indexed
        # Compiled code cannot call a user's own control law.
        has_user_law = self._site.parts.has_user_law
        if samples is not None and indexed is not None and not has_user_law:
            self._plain_rows = PlainRows(self._log, indexed, samples, resume_every)
        is_plain = self._plain_rows is not None
        self._states = self._log.lazy_states if is_plain else self._log.states
        self._inputs = RecordedInputs(
            site_log=log[site],
            samples=_map_records(log, lazy=is_plain),
            ends=log.last_ticks,
            changes=log.changes(site),
            links=setup.links,
            states=self._states,
        )

    def run(self, report: Callable[[int], None] | None = None) -> None:
        """Re-executes every recorded tick of the site, and compares the results with the log.

        Long sequences of ticks whose inputs are all in the log are executed by a compiled loop,
        and all other ticks one by one. The counts of identical, differing and missing records
        are added to the `VerifyResult` of this object.

        Args:
            report: Function that is called from time to time with the number of examined
                records of all sites. If None, progress is not reported.
        """
        result = self._result
        name = self._log.name
        judged_before = result.records - result.unjudged  # of sites that were executed before
        next_tick = 0  # the tick whose record is expected next
        row = 0
        if len(self._log):
            next_tick = self._change_start(row, next_tick)
        while row < len(self._log):
            identical = self._repeat_plain(row, next_tick)
            if identical:
                if report is not None:
                    report(result.records)
                result.records += identical
                result.identical += identical
                row += identical
                next_tick += identical
                continue

            # The compiled loop cannot execute the next tick, or its record differs.
            if report is not None and row % PROGRESS_EVERY == 0:
                report(result.records)
            next_tick = self._examine_record(row, next_tick)
            row += 1

        result.coverage.judged[name] = result.records - result.unjudged - judged_before
        if next_tick <= self._last_tick:
            result.gaps.append((name, next_tick, self._last_tick))

    def _repeat_plain(self, row: int, next_tick: int) -> int:
        """Re-executes the ticks of plain records in compiled code, which is fast.

        A record is plain if the state before it is known, and the log contains all of its
        inputs. Execution stops before the first record that differs.

        Args:
            row: Index of the first record.
            next_tick: Tick whose record is expected next.

        Returns:
            The number of records that are identical to the re-execution. 0 if the next record
            must be examined individually.
        """
        plain_rows = self._plain_rows
        if plain_rows is None or not self._certain or self._law_failed:
            return 0
        if self._single_records:
            self._single_records -= 1
            return 0
        is_expected = (
            int(self._log.tick[row]) == next_tick and plain_rows.read_boot(row) == self._boot
        )
        plain_count = (
            plain_rows.count_plain(row, self._inputs.next_change_tick) if is_expected else 0
        )
        if plain_count < LEAST_ROWS:
            return 0

        if self._repeater is None:
            self._repeater = TickRepeater(self._site)
        repeated_count = plain_rows.repeat(
            self._repeater, row, plain_count, external=self._external
        )
        # If the loop ends early, because records differ or its memory must grow, the next
        # records are examined one by one. The number of these records is doubled each time,
        # because starting the loop again and again would be slower than not using it.
        if repeated_count == plain_count:
            self._next_single_records = 1
        elif repeated_count < _MOST_SINGLE_RECORDS:
            self._single_records = self._next_single_records
            self._next_single_records = min(2 * self._next_single_records, _MOST_SINGLE_RECORDS)
        return repeated_count

    def _examine_record(self, row: int, next_tick: int) -> int:
        """Checks that one record has the expected tick, and that its results can be reproduced.

        Gaps and differences are added to the result.

        Args:
            row: Index of the record.
            next_tick: Tick whose record is expected next.

        Returns:
            Tick whose record is expected after this record.
        """
        result = self._result
        state = self._states[row]
        result.records += 1

        # Two records of the same tick cannot come from one run of the site.
        is_known_boot = state.boot in self._starts
        is_repeated = state.tick == next_tick - 1
        if is_repeated and not is_known_boot:
            result.add_difference(self._make_difference(state, "tick", state.tick, next_tick))
            return next_tick

        # A site that left and returned has a new start (boot).
        is_other_boot = state.boot != self._boot and is_known_boot
        if is_other_boot:
            next_tick = self._change_start(row, next_tick)
        # A site that was late skipped ticks, which is no gap. Its record states how many.
        expected_tick = next_tick + count_skipped_ticks(state.cmd)
        if state.tick != expected_tick:
            result.gaps.append((self._log.name, next_tick, state.tick - 1))
            self._certain = False
        self._execute_record(row, state)
        return state.tick + 1

    def _execute_record(self, row: int, state: State) -> None:
        """Judges a record by re-executing its tick and comparing the result with the record.

        The tick can be executed if the state of the site before it is certain, that is, if it
        follows from the previous tick. An uncertain state is restored from the two preceding
        records if possible. Otherwise, only the sender of the record is checked.

        The record is counted in the result as identical, different or unjudged. After a control
        law has failed, no further tick of the site is executed.

        Args:
            row: Row of the record.
            state: The record.
        """
        result = self._result
        try:
            # If requested, the site is replaced regularly, to find state outside the records.
            if self._resume_every and state.tick % self._resume_every == 0:
                self._replace_site(row, state)
            if not self._certain and self._can_resume(row):
                changes_in_gap, _ = self._parse_changes(state.tick - 1)
                self._inputs.resume(self._site, row, changes_in_gap)
                self._certain = True

            if self._certain and not self._law_failed:
                self._verify_record(row, state)
            elif difference := self._find_other_sender(state):
                result.add_difference(difference)
            else:
                result.unjudged += 1
        except LawFailed as failure:
            self._law_failed = True
            result.add_difference(
                RecordDifference.of_law_failure(failure)._replace(tick=state.tick)
            )
        except ValueError as error:
            # The log lists more changes ("cmd") than a site accepts.
            self._certain = False
            difference = RecordDifference(
                site=self._log.name,
                tick=state.tick,
                field="cmd",
                logged="here",
                computed=str(error),
            )
            result.add_difference(difference)

    def _can_resume(self, row: int) -> bool:
        """Returns True if the records before a row suffice to restore the state of the site."""
        if self._law_failed or row - 2 < self._start_row:
            return False
        return self._inputs.can_resume(row, detached=self._detached)

    def _change_start(self, row: int, next_tick: int) -> int:
        """Continues with another start (boot) of the site, to which a record belongs.

        A site that left the session and returned has several starts, each with a new boot
        number. Between the last record of the previous start and the first tick of this start,
        there may be two ranges of ticks:

        - A gap: the site executed these ticks, but their records are missing from the log.
        - An absence, after the gap: the site did not execute these ticks, because it had left.

        Both are added to the result. The site of this start begins in its initial state.

        Args:
            row: Row of the first record of the start.
            next_tick: Tick that was expected next.

        Returns:
            Tick that is expected next, which is the first tick of the start. If the log does
            not state this tick, or if it has already been examined, the site is not restarted,
            and the result is `next_tick`.
        """
        name = self._log.name
        self._boot = self._read_boot(row)
        self._start_row = row
        first_tick = self._starts.get(self._boot)
        if first_tick is None or first_tick < next_tick:
            return next_tick

        # An absence ends right before the first tick of a start.
        absence_start = self._absences.get(first_tick, first_tick)
        first_absent_tick = max(absence_start, next_tick)
        if next_tick < first_absent_tick:
            self._result.gaps.append((name, next_tick, first_absent_tick - 1))
        if first_absent_tick < first_tick:
            self._result.absences.append((name, first_absent_tick, first_tick - 1))

        # The remaining changes before this tick concern the previous start, so drop them.
        self._inputs.pop_changes(first_tick - 1)
        self._applied.clear()
        self._set_site(Site(self._setup))
        self._site.start_at(first_tick)
        self._start_tick = first_tick
        self._certain = True  # the initial state of a site is known
        return first_tick

    def _read_boot(self, row: int) -> int:
        """Returns the boot in a record (the number that identifies a start of the site)."""
        if self._plain_rows is not None:
            return self._plain_rows.read_boot(row)
        return self._states[row].boot

    def _set_site(self, site: Site) -> None:
        """Replaces the simulated site with another one."""
        self._site = site
        self._repeater = None

    def _replace_site(self, row: int, state: State) -> None:
        """Replaces the simulated site with a new one, to reveal control laws with hidden state.

        A control law must keep all its state in its `memory`, which the records contain. Any
        other state is lost in the replacement, so the following records differ and the fault is
        found.

        This method only marks the state as uncertain. The caller then restores the state from
        the two preceding records, as after a gap in the log. Nothing happens if the state is
        already uncertain, or cannot be restored.

        Args:
            row: Row of the next record.
            state: The next record.
        """
        if not self._certain or not self._can_resume(row):
            return
        self._set_site(Site(self._setup))
        self._certain = False
        # Settings are not part of the state. The new site receives the same changes of
        # settings.
        if self._start_tick:
            self._site.start_at(self._start_tick)
        for change in self._applied:
            self._site.apply_change(change, state.t_ns)

    def _make_difference(
        self, state: State, field: str, logged: Any, computed: Any
    ) -> RecordDifference:
        """Describes the difference between a field of a record and its computed value."""
        return RecordDifference(
            site=state.site, tick=state.tick, field=field, logged=logged, computed=computed
        )

    def _find_other_sender(self, state: State) -> RecordDifference | None:
        """Reports a record that was not written by the process whose ticks are re-executed.

        Returns:
            The difference if the record names another start of the process (boot) or another
            site, otherwise None.
        """
        name = self._log.name
        if state.boot != self._boot:
            difference = self._make_difference(state, "boot", state.boot, self._boot)
            return difference._replace(site=name)
        if state.site != name:
            return self._make_difference(state, "site", state.site, name)._replace(site=name)
        return None

    def _verify_record(self, row: int, state: State) -> None:
        """Executes the tick of a record again, and compares the results.

        Args:
            row: Row of the record.
            state: The record.
        """
        result = self._result
        states = self._states
        peers = self._log.peers
        difference = self._find_other_sender(state)

        # On another platform, each tick is computed from the two records before it.
        follows_two = row - 2 >= self._start_row and states[row - 2].tick == state.tick - 2
        if follows_two and not result.whole_run:
            before = states[row - 2].to_tick_record(peers)
            last = states[row - 1].to_tick_record(peers)
            self._site.restore_state(before, last)

        arrivals, missing = self._inputs.find_arrivals(state.rx)
        invalid_arrival = None
        if missing:
            entries, invalid_arrival = self._check_arrivals(state)
            arrivals, missing = self._inputs.find_arrivals(entries)
            self._inputs.add_lacking(missing)
        changes, invalid_change = self._parse_changes(state.tick)

        plant_state = None
        if self._external:
            plant_state = PlantState(state.q, state.qd, state.tau_x, state.bodies)
        tick_input = TickInput(
            k=state.tick,
            arrivals=arrivals[:MAX_ARRIVALS],
            commands=changes,
            measured=plant_state,
            hand=state.hand,
        )
        output = self._site.step(tick_input)
        if missing:
            # The checksum includes samples that the log lacks, so it cannot be checked.
            output = output._replace(rx_crc=state.rx_crc)

        difference = invalid_change or invalid_arrival or difference
        if difference is None and not equal_record(state, output, peers):
            difference = RecordDifference.find(
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
        """Returns the changes up to a tick that have not been applied yet.

        A change is a new link model, a new set of dominance factors, or a command to the site,
        such as a stop. The log contains it as text. An invalid text proves that the log is not
        that of a real run, and is reported as a difference.

        At most `MAX_RAMPS` changes can be pending at a site. Further changes are left out. The
        changes are also stored in `_applied`, so that `_replace_site` can repeat them.

        Args:
            tick: Last tick whose changes are returned.

        Returns:
            The changes before the first invalid change, and the difference that reports the
            invalid change, which is None if all changes are valid.
        """
        changes: list[CoreChange] = []
        for change_tick, text in self._inputs.pop_changes(tick):
            try:
                changes.append(self._scenario.parse_core_change(self._log.name, text))
            except ScenarioError:
                difference = RecordDifference(
                    site=self._log.name,
                    tick=change_tick,
                    field="cmd",
                    logged=text,
                    computed="a change of one of its links or of its shares",
                )
                return changes, difference
        accepted_changes = changes[:MAX_RAMPS]
        self._applied += accepted_changes
        return accepted_changes, None

    def _check_arrivals(
        self, state: State
    ) -> tuple[Sequence[ArrivalEntry], RecordDifference | None]:
        """Checks the arrivals of samples that a record lists, and returns the possible ones.

        An arrival is impossible if there is no such peer, or if the peer never executed the
        tick in which the sample is said to have been sent.

        Returns:
            The arrivals before the first impossible arrival, and the difference that reports
            the impossible arrival, which is None if all arrivals are possible.
        """
        samples = self._inputs.samples
        ends = self._inputs.ends
        for n, (peer, tick, _) in enumerate(state.rx):
            if not 0 <= peer < len(samples):
                valid = "an index of a peer"
                return state.rx[:n], self._make_difference(state, "rx (peer)", peer, valid)
            if tick not in samples[peer] and not 0 <= tick <= ends[peer]:
                valid = f"a tick from 0 to {ends[peer]}"
                field_name = f"rx[{self._log.peers[peer]}]"
                return state.rx[:n], self._make_difference(state, field_name, tick, valid)
        return state.rx, None


def verify_log(
    log: Log,
    progress: Progress | None = None,
    *,
    min_coverage: float = MIN_COVERAGE,
    resume_every: int = 0,
) -> VerifyResult:
    """Re-executes every recorded tick of a log, and compares each record with the result.

    If all records agree, the log contains exactly what its scenario and its recorded inputs
    produce. The log of a rerun contains some sites that were run again with changed settings,
    and others whose records were copied from a source log. The copied records are compared with
    the source log, and their ticks are re-executed with the inputs in the source log, which
    must be in the same folder.

    Args:
        log: Log of a run or rerun.
        progress: Function that is called from time to time with the number of examined records
            and their total.
        min_coverage: Smallest fraction of every site's ticks that must be compared.
        resume_every: In every tick that is divisible by this number, the site is replaced by a
            new site restored from the records. This reveals whether a law keeps any state
            outside its `memory`. 0 means never.

    Raises:
        LogError: A record cannot be read.
        ScenarioError: A user's control law that is allowed to run cannot be created.
    """
    result = _make_result(log, min_coverage)
    with process.pause_gc():
        sites = log.executed_sites
        total = sum(len(log[name]) for name in sites)
        report = None if progress is None else lambda done: progress(done, total)
        _execute_sites(
            log=log, sites=sites, result=result, report=report, resume_every=resume_every
        )

        copied_sites = [name for name in log.sites if name not in sites]
        source = _open_rerun_source(log) if copied_sites else None
        if source is not None:
            for name in copied_sites:
                _compare_with_source(log[name], source[name], result)
            source_result = _make_result(source, min_coverage)
            source_sites = [name for name in source.executed_sites if name in copied_sites]
            _execute_sites(source, source_sites, source_result)
            result.add(source_result)
    return result


def _make_result(log: Log, min_coverage: float) -> VerifyResult:
    """Returns an empty result for a log, in which only its integrity has been judged."""
    return VerifyResult(
        whole_run=log.session.get("fingerprint") == compute_fingerprint(),
        coverage=Coverage({}, {site: log.expected_ticks(site) for site in log.sites}),
        min_coverage=min_coverage,
        integrity=log.judge_integrity(),
    )


def _execute_sites(
    log: Log,
    sites: Sequence[str],
    result: VerifyResult,
    report: Callable[[int], None] | None = None,
    resume_every: int = 0,
) -> None:
    """Re-executes the ticks of given sites, and adds the counts and differences to a result.

    Sites whose control law is not allowed to run are left out.

    Args:
        log: The log.
        sites: Names of the sites.
        result: Object to which the counts and differences are added.
        report: Function that is called from time to time with the number of records so far.
        resume_every: See `verify_log`.
    """
    # On another platform, each tick is computed from the two records before it.
    samples = SampleTable.of_log(log) if result.whole_run else None
    if samples is None:
        _map_records(log, lazy=False)  # raises an error if a record cannot be read
    withheld_laws = [law for law in log.scenario.inspect_user_laws() if not law.allowed]
    withheld_sites = [name for law in withheld_laws for name in law.sites if name in sites]
    result.withheld += withheld_sites
    for name in withheld_sites:
        result.coverage.expected.pop(name, None)

    for name in sites:
        if name in withheld_sites:
            continue
        verifier = _SiteVerifier(
            log=log, site=name, samples=samples, result=result, resume_every=resume_every
        )
        verifier.run(report)


def _map_records(log: Log, *, lazy: bool) -> dict[str, Mapping[int, State]]:
    """Returns the records of all sites of a log, keyed by site and tick.

    When a tick is re-executed, the samples that arrived in it are looked up in these records.

    Args:
        log: The log.
        lazy: True if only a few records will be accessed. They are then decoded on access
            instead of all at once.
    """
    return {
        name: site_log.lazy_by_tick if lazy else site_log.by_tick
        for name, site_log in log.items()
    }


def _compare_with_source(recorded: SiteLog, source: SiteLog, result: VerifyResult) -> None:
    """Checks that the records of a site in a rerun are copies of those in the source log.

    The first difference is added to the result.

    Args:
        recorded: Records of the site in the rerun.
        source: Records of the site in the source log.
        result: Object to which the difference is added.
    """
    if recorded.payloads == source.payloads:
        return
    for copied, original in zip_longest(recorded.states, source.states):
        is_pair = copied is not None and original is not None
        # The rerun may have written records in a newer version.
        if is_pair and copied == msgspec.structs.replace(original, v=copied.v):
            continue
        difference = RecordDifference(
            site=recorded.name,
            tick=(copied or original).tick,
            field="record",
            logged="here",
            computed="in its log",
        )
        result.add_difference(difference)
        return


def _open_rerun_source(log: Log) -> Log | None:
    """Opens the source log of a rerun, which must be in the same folder.

    Args:
        log: Log of the rerun, which states the hashes of the files of its source.

    Returns:
        The source log, or None if its files are missing or have other hashes.
    """
    names = log.session.get("rerun_of", "").split()
    digests = log.session.get("rerun_of_sha256", "").split()
    rerun_path = Path(log.sources[0])
    files = [rerun_path.with_name(Path(name).name) for name in names]
    if not files or len(files) != len(digests):
        return None
    if not all(file.is_file() for file in files):
        return None
    if [digest_file(file) for file in files] != digests:
        return None
    source = open_log(*files)
    return source if source.sites == log.sites else None
