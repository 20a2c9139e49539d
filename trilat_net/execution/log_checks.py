"""Checks a log by re-executing its run, and reports one finding per check.

A log contains the inputs and the results of every tick, so the results can be computed again.
The checks answer these questions:

- Are records missing, and is the file unchanged since it was written?
- Does the scenario match the hash stated in the log?
- Which control laws written by users does the scenario name?
- Does re-execution give the same records?
- Does a simulation of the whole session, without clocks or a network, give the same records?
- Was an arm moved by something outside this program, such as a real robot?

Invariant:
    - Every finding about an execution is based on an execution in this process.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..errors import ScenarioError, count_nouns, join_arguments
from ..log import (
    MIN_COVERAGE,
    CheckReport,
    Finding,
    Log,
    Progress,
    describe_unknown_ends,
    open_log,
)
from ..own_code import CodeConsents, allowed_code
from .verification import VerifyResult, verify_log
from .virtual_comparison import compare_with_virtual

_MAX_GAPS_NAMED = 60
"""Maximum number of gaps that a finding lists."""


@dataclass(frozen=True, repr=False)
class LogCheckReport(CheckReport):
    """Findings of all checks of a log, which show whether the log can be trusted.

    The report passes if the log is unchanged since it was written, enough of its records have
    been compared, and every re-execution agrees with the log.

    Attributes:
        findings: One finding per check, in display order.
        log: The checked log.
        result: Result of re-executing the ticks of the log.
    """

    log: Log
    result: VerifyResult

    @property
    def records(self) -> int:
        """Number of records that were checked by re-executing their ticks."""
        return self.result.records

    @property
    def identical(self) -> int:
        """Number of records that were reproduced bit for bit in every computed field."""
        return self.result.identical

    def to_dict(self) -> dict[str, Any]:
        """Converts the report to plain JSON values, with the keys of `trilat verify --json`."""
        result = self.result
        first_difference = None
        if result.first is not None:
            first_difference = {
                **result.first._asdict(),
                "logged": repr(result.first.logged),
                "computed": repr(result.first.computed),
            }
        return {
            "files": list(self.log.sources),
            "passed": self.passed,
            "whole_run": result.whole_run,
            "records": result.records,
            "identical": result.identical,
            "differing": result.differing,
            "unjudged": result.unjudged,
            "withheld": result.withheld,
            "coverage": result.coverage.share,
            "min_coverage": result.min_coverage,
            "judged": result.coverage.to_json(),
            "integrity": result.integrity.state.name.lower(),
            "gaps": list(map(_to_range, result.gaps)),
            "not_made": list(map(_to_range, result.absences)),
            "first_difference": first_difference,
            "checks": self.to_rows(),
        }

    @classmethod
    def of_log(
        cls,
        log: Log,
        *,
        virtual: bool,
        progress: Progress | None = None,
        min_coverage: float = MIN_COVERAGE,
        resume_every: int = 0,
    ) -> "LogCheckReport":
        """Re-executes the ticks of a log, and checks the log against the results.

        Args:
            log: Log of a run or rerun.
            virtual: If True, the log is also compared with a simulation of its scenario in
                virtual time, see `compare_with_virtual`.
            progress: Function that is called from time to time with the amount of work done and
                the total. If None, progress is not reported.
            min_coverage: Smallest fraction of every site's ticks that must be compared. A log
                with a smaller fraction fails even if all compared records agree.
            resume_every: Interval, in ticks, at which a site is restored from the records, see
                `verify_log`. 0 means never.

        Returns:
            The findings of all checks.

        Raises:
            LogError: A record cannot be read.
            ScenarioError: A user's control law that is allowed to run cannot be created.
        """
        result = verify_log(log, progress, min_coverage=min_coverage, resume_every=resume_every)
        findings = list(_check_log(log, result, virtual=virtual, progress=progress))
        if not resume_every:
            findings = [_add_memory_advice(finding, log, result) for finding in findings]
        return LogCheckReport(findings, log, result)

    @classmethod
    def check_files(
        cls, sources: Sequence[str], min_coverage: float, allowed: CodeConsents
    ) -> CheckReport:
        """Checks one log, possibly in a worker process of a pool.

        The arguments and the result can be sent to another process, so many logs can be checked
        in parallel. If a user's control law cannot be created, no error is raised, but the
        report contains a failed finding.

        Args:
            sources: Paths of the files that make up the log.
            min_coverage: Smallest fraction of every site's ticks that must be compared.
            allowed: Permissions to run users' code, in addition to the permissions of this
                process.

        Returns:
            The findings of all checks, without the log.
        """
        allowed_code.update(allowed)
        log = open_log(*sources)
        try:
            report = cls.of_log(log, virtual=True, min_coverage=min_coverage)
        except ScenarioError as error:
            return CheckReport([Finding("executed again", f"cannot be: {error}", False)])
        return CheckReport(report.findings)


def _to_range(gap: tuple[str, int, int]) -> dict[str, Any]:
    """Converts a range of ticks to plain values."""
    site, first, last = gap
    return {"site": site, "first": first, "last": last}


def _check_log(
    log: Log, result: VerifyResult, *, virtual: bool, progress: Progress | None
) -> Iterator[Finding]:
    """Yields one finding for each check that applies to a log.

    A finding states what was checked, the result, and whether the log passes.

    Args:
        log: The log.
        result: Result of re-executing the ticks of the log.
        virtual: If True, the log is also compared with virtual time.
        progress: Function that reports the progress of this comparison.
    """
    # A log may be the result of a rerun in which only some sites were executed. The records of
    # the others were copied.
    copied_sites = [name for name in log.sites if name not in log.executed_sites]
    recorded = ""
    if copied_sites:
        verb = "stand" if len(copied_sites) > 1 else "stands"
        recorded = f"{' and '.join(copied_sites)} {verb}"

    yield _check_coverage(log, result)
    yield Finding("integrity", result.integrity.text, result.integrity.passed)
    for law in log.scenario.inspect_user_laws():
        yield Finding("user law", str(law), law.allowed, law.allowed)
    yield _check_execution(result, recorded)
    if log.scenario.external:
        arms = " and ".join(log.scenario.external)
        yield Finding(
            "plant",
            f"the motion of {arms} was measured and is not judged, but its control is",
            True,
        )
    if log.session.get("scenario_sha256") != log.scenario_sha256:
        yield Finding(
            "scenario", "does not have the hash stated in the log: it was changed", False
        )

    if not virtual:
        return
    if result.withheld:
        reason = f"the law of {_join_names(result.withheld)} may not run"
        yield Finding("virtual time", f"not compared: {reason}", False, judged=False)
    elif recorded:
        yield Finding(
            "virtual time",
            f"is a different run: {recorded} as recorded, and did not react",
            True,
        )
    elif log.absences:
        sites = " and ".join(log.absences)
        yield Finding(
            "virtual time", f"is a different run: {sites} left or joined during the run", True
        )
    else:
        yield from _check_virtual_time(log, result, progress)


def _check_virtual_time(
    log: Log, result: VerifyResult, progress: Progress | None
) -> Iterator[Finding]:
    """Yields the findings of the comparison of a log with two simulations of its scenario.

    The simulations run in virtual time, without real clocks or a network. They differ in how
    samples arrive:

    - "virtual time fed with the log's arrivals": each sample arrives when it did in the log.
      All records must be equal, up to the first gap in the log.
    - "plain virtual time": each sample arrives without delay. The records must be equal up to
      the first sample that the real network lost or delivered too late. This simulation is
      omitted if the run necessarily differs from it, for example because an arm was external.
      This is not a fault of the log, so the finding passes.

    Args:
        log: The log.
        result: Result of re-executing the ticks of the log.
        progress: Function that reports the progress of the comparison. If None, progress is not
            reported.
    """
    comparison = compare_with_virtual(log, progress)
    # The arrivals in a gap are unknown, so a difference after the first gap is excused.
    first_gap_tick = min((first for _, first, _ in result.gaps), default=None)
    label = "virtual time fed with the log's arrivals"
    yield comparison.fed.to_finding(label, first_gap_tick)

    reason = ""
    if log.scenario.external:
        reason = "an arm was external"
    elif log.scenario.measured:
        reason = "a link was measured, not modelled"
    if reason and log.driver != "virtual":
        passed = True
        yield Finding("plain virtual time", f"is a different run: {reason}", passed)
        return

    late_samples = comparison.late
    lost_samples = comparison.lost
    description = count_nouns(len(late_samples), "late sample")
    if late_samples:
        description += f", the first: {late_samples[0]}"
    if lost_samples:
        description += f"; {len(lost_samples)} lost on the way, the first: {lost_samples[0]}"
    label = f"plain virtual time ({description})"
    first_affected_tick = comparison.excused_from
    yield comparison.plain.to_finding(label, first_affected_tick)


def _check_coverage(log: Log, result: VerifyResult) -> Finding:
    """Returns the finding about records that are missing from the log.

    The log fails if too small a fraction of the ticks of any site could be compared.

    Args:
        log: The log.
        result: Result of re-executing the ticks of the log.
    """
    coverage = result.coverage
    if coverage.expected:
        records_in_file = sum(len(log[name]) for name in coverage.expected)
        expected_records = sum(coverage.expected.values())
        clauses = [
            f"{records_in_file}/{expected_records} in the file",
            coverage.describe(result.min_coverage),
        ]
    else:
        # If no site may be executed, the expected number of records is unknown.
        clauses = [f"{sum(map(len, log.values()))} in the file"]
    if result.withheld:
        clauses.append(f"{', '.join(result.withheld)} not judged")
    if log.unknown_ends:
        clauses.append(describe_unknown_ends(log.unknown_ends))
    if log.damaged:
        plural = "s" if len(log.damaged) > 1 else ""
        clauses.append(f"damaged in {len(log.damaged)} place{plural}")
    elif not log.complete:
        clauses.append("the file was not finished")

    has_coverage = not coverage.expected or coverage.share >= result.min_coverage
    return Finding("records", "; ".join(clauses), has_coverage and not log.damaged)


def _check_execution(result: VerifyResult, recorded: str) -> Finding:
    """Returns the finding on whether re-executing the ticks of a log gave the same records.

    The text of the finding begins with the number of identical records. Everything that limits
    the comparison is appended: missing records, ticks that a site did not execute because it
    had left the session, sites that were not run again, records that could not be judged, and
    differences.

    Args:
        result: Result of re-executing the ticks of the log.
        recorded: Subject and verb of a sentence about sites whose records were copied, such as
            "m1 stands". Empty if no records were copied.
    """
    withheld = ""
    if result.withheld:
        was = "was" if len(result.withheld) == 1 else "were"
        withheld = (
            f"{_join_names(result.withheld)} {was} not executed, because the law may not run: "
            "permit the file of the law with --law FILE"
        )
    if not result.records:
        # Without permission for the laws, the check was not possible.
        text = withheld or "no records to execute"
        return Finding("executed again", text, False, judged=not result.withheld)

    if result.whole_run:
        method = "whole runs, bit for bit"
    else:
        # Another platform rounds differently, so numbers agree only within a tolerance.
        method = "tick by tick to 1e-9: another platform wrote it"
    text = f"{result.identical}/{count_nouns(result.records, 'record')} identical ({method})"
    if result.gaps:
        text += f"; no records of {_describe_gaps(result.gaps)}"
    if result.absences:
        text += f"; not executed, between two starts: {_describe_gaps(result.absences)}"
    if recorded:
        text += f"; {recorded} as recorded"
        # Copied records can only be judged with the log from which they were copied.
        source_is_missing = result.coverage.share < result.min_coverage
        if source_is_missing:
            text += ", not judged: the source log of the rerun is not in the same folder"
    if result.unjudged:
        text += f"; {result.unjudged} after gaps could not be judged"
    if withheld:
        text += f"; {withheld}"
    if result.first:
        text += f"; {result.differing} differ, the first: {result.first}"
    return Finding("executed again", text, result.agreed)


def _add_memory_advice(finding: Finding, log: Log, result: VerifyResult) -> Finding:
    """Adds advice to a finding about user-defined control laws that may have hidden state.

    A law may store something outside the records, such as an attribute of its object. If an
    entire run is re-executed, the hidden state is reproduced, so all records agree. Only a site
    that is restored from its records lacks the hidden state. The recommended command tests
    this.

    Args:
        finding: Finding of a check.
        log: Log of the run.
        result: Result of re-executing the ticks of the log, without restoring sites from
            records.

    Returns:
        The finding, with the advice if it states that whole runs of users' laws agree.
    """
    files = list(dict.fromkeys(str(law.file) for law in log.scenario.inspect_user_laws()))
    have_runs_agreed = finding.check == "executed again" and finding.passed and result.whole_run
    if not files or not have_runs_agreed or result.withheld:
        return finding

    arguments = ["trilat", "verify", *log.sources]
    for file in files:
        arguments += ["--law", file]
    command = join_arguments([*arguments, "--resume-every", "100"])
    advice = (
        f"this check cannot find memory of your law outside the records; to find it: {command}"
    )
    return replace(finding, text=f"{finding.text}; {advice}")


def _join_names(names: Sequence[str]) -> str:
    """Joins the names of sites for use in a sentence, such as "m1, m2 and s"."""
    *before, last = names
    return f"{', '.join(before)} and {last}" if before else last


def _describe_gaps(gaps: Sequence[tuple[str, int, int]]) -> str:
    """Lists the ranges of missing ticks of each site, such as "m1 3-7, 12; s 5".

    At most `_MAX_GAPS_NAMED` ranges are listed. The rest are only counted.

    Args:
        gaps: Site, first tick and last tick of each range.
    """
    texts = []
    remaining = _MAX_GAPS_NAMED
    for site, site_gaps in itertools.groupby(gaps, key=lambda gap: gap[0]):
        ranges = []
        for _, first_tick, last_tick in site_gaps:
            is_range = last_tick > first_tick
            ranges.append(f"{first_tick}-{last_tick}" if is_range else f"{first_tick}")
        if remaining > 0:
            texts.append(f"{site} {', '.join(ranges[:remaining])}")
        remaining -= len(ranges)

    text = "; ".join(texts)
    if remaining < 0:
        text += f" and {count_nouns(-remaining, 'more range')}, which --json names"
    return text
