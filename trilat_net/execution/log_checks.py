"""The checks of a log, one line each: complete, executed again, scenario hash, compared with
virtual time.

Invariant: every claim rests on an execution made just now.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import ScenarioError, count_nouns
from ..log.accounting import MIN_COVERAGE, describe_unknown_ends
from ..log.findings import CheckReport, Finding
from ..log.log_reader import Log, open_log
from ..log.mcap_reader import Progress
from ..scenario.code_consent import find_user_laws
from ..scenario.imported_code import CodeConsents, allowed_code
from .verify import VerifyResult, verify
from .virtual_comparison import RecordComparison, compare_with_virtual

MAX_GAPS_NAMED = 60
"""Gaps that a line names."""


@dataclass(frozen=True, repr=False)
class LogCheckReport(CheckReport):
    """The result of executing a log again, and a finding for that and for every other check.

    It passed if the log is as it was made, enough of it was judged, and every execution agreed
    with it.
    """

    log: Log
    result: VerifyResult
    findings: list[Finding]

    @property
    def records(self) -> int:
        """How many records were executed again."""
        return self.result.records

    @property
    def identical(self) -> int:
        """How many of them agree in every computed field."""
        return self.result.identical

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat verify --json`: every gap, the first
        difference.
        """
        result = self.result
        first = self.result.first
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
            "gaps": [{"site": site, "first": a, "last": b} for site, a, b in result.gaps],
            "not_made": [
                {"site": site, "first": a, "last": b} for site, a, b in result.absences
            ],
            "first_difference": None
            if first is None
            else {
                **first._asdict(),
                "logged": repr(first.logged),
                "computed": repr(first.computed),
            },
            "checks": self.to_rows(),
        }


def run_log_checks(
    log: Log,
    *,
    virtual: bool,
    progress: Progress | None = None,
    min_coverage: float = MIN_COVERAGE,
    resume_every: int = 0,
) -> LogCheckReport:
    """Executes a log again, and compares it with virtual time if `virtual` is set.

    A log of which too little can be judged fails, though its execution shows nothing wrong.

    Raises:
        LogError: a record cannot be read.
        ScenarioError: a user law that may run cannot be made.
    """
    result = verify(log, progress, min_coverage=min_coverage, resume_every=resume_every)
    return LogCheckReport(
        log, result, list(_checks(log, result, virtual=virtual, progress=progress))
    )


def check_log_files(
    sources: Sequence[str], min_coverage: float, allowed: CodeConsents
) -> list[Finding]:
    """Returns a line per check of a log in files, in a worker where `allowed` laws may run.

    A user law that cannot be made fails one.
    """
    allowed_code.update(allowed)
    log = open_log(*sources)
    try:
        return run_log_checks(log, virtual=True, min_coverage=min_coverage).findings
    except ScenarioError as error:
        return [Finding("executed again", f"cannot be: {error}", False)]


def _checks(
    log: Log, result: VerifyResult, *, virtual: bool, progress: Progress | None
) -> Iterator[Finding]:
    # of an open-loop rerun
    others = [name for name in log.sites if name not in log.executed_sites]
    recorded = (
        f"{' and '.join(others)} {'stand' if len(others) > 1 else 'stands'}" if others else ""
    )
    yield _records_line(log, result)
    yield Finding("integrity", result.integrity.text, result.integrity.passed)
    for law in find_user_laws(log.scenario):
        yield Finding("user law", str(law), law.allowed, law.allowed)
    yield _verify_line(result, recorded)
    if log.scenario.external:
        arms = " and ".join(log.scenario.external)
        yield Finding(
            "plant",
            f"the motion of {arms} was measured and is not judged, its control is",
            True,
        )
    if log.session.get("scenario_sha256") != log.scenario_sha256:
        yield Finding(
            "scenario", "is not the one whose hash the log names: it was changed", False
        )
    if virtual and result.withheld:
        why = f"the law of {' and '.join(result.withheld)} may not run"
        yield Finding("virtual time", f"not compared: {why}", False, judged=False)
    elif virtual and recorded:
        yield Finding(
            "virtual time", f"is another run: {recorded} as recorded, and did not react", True
        )
    elif virtual and log.absences:
        away = " and ".join(log.absences)
        yield Finding(
            "virtual time", f"is another run: {away} left, or came while it ran", True
        )
    elif virtual:
        twins = compare_with_virtual(log, progress)
        # what arrived there is unknown
        gap = min((first for _, first, _ in result.gaps), default=None)
        yield _virtual_line("virtual time fed with the log's arrivals", twins.fed, gap)
        why = "a link was measured, not modelled" if log.scenario.measured else ""
        why = "an arm was external" if log.scenario.external else why
        if why and log.driver != "virtual":
            yield Finding("plain virtual time", f"is another run: {why}", True)
            return
        late = twins.late
        gone = twins.lost
        came = f"{count_nouns(len(late), 'late sample')}" + (
            f", the first: {late[0]}" if late else ""
        )
        lost = f"; {len(gone)} lost on the way, the first: {gone[0]}" if gone else ""
        yield _virtual_line(
            f"plain virtual time ({came}{lost})", twins.plain, twins.excused_from
        )


def _records_line(log: Log, result: VerifyResult) -> Finding:
    have = sum(len(log[name]) for name in result.coverage.expected)
    coverage = result.coverage
    text = f"{have}/{sum(coverage.expected.values())} in the file"
    text += f"; {coverage.describe(result.min_coverage)}" if coverage.expected else ""
    text += f"; {', '.join(result.withheld)} not judged" if result.withheld else ""
    if log.unknown_ends:
        text += f"; {describe_unknown_ends(log.unknown_ends)}"
    if log.damaged:
        text += f"; damaged in {len(log.damaged)} place{'s' * (len(log.damaged) > 1)}"
    elif not log.complete:
        text += "; the file was not finished"
    passed = (
        not coverage.expected or coverage.share >= result.min_coverage
    ) and not log.damaged
    return Finding("records", text, passed)


def _verify_line(result: VerifyResult, recorded: str) -> Finding:
    how = (
        "whole runs, bit for bit"
        if result.whole_run
        else "tick by tick to 1e-9: another platform made it"
    )
    text = f"{result.identical}/{count_nouns(result.records, 'record')} identical ({how})"
    if result.gaps:
        text += f"; no records of {_gaps_text(result.gaps)}"
    if result.absences:
        text += f"; not made, between two starts: {_gaps_text(result.absences)}"
    if recorded:
        text += f"; {recorded} as recorded"
        if result.coverage.share < result.min_coverage:
            text += ", not judged: the log that the rerun was made of is not beside it"
    if result.unjudged:
        text += f"; {result.unjudged} behind gaps could not be judged"
    if result.first:
        text += f"; {result.differing} differ, the first: {result.first}"
    if not result.records:
        return Finding("executed again", "no records to execute", False, not result.withheld)
    return Finding("executed again", text, result.agreed)


def _gaps_text(gaps: Sequence[tuple[str, int, int]]) -> str:
    texts = []
    left = MAX_GAPS_NAMED
    for site, group in itertools.groupby(gaps, key=lambda gap: gap[0]):
        ranges = [f"{first}-{last}" if last > first else f"{first}" for _, first, last in group]
        if left > 0:
            texts.append(f"{site} {', '.join(ranges[:left])}")
        left -= len(ranges)
    more = f" and {count_nouns(-left, 'more range')}, which --json names" if left < 0 else ""
    return "; ".join(texts) + more


def _virtual_line(
    label: str, comparison: RecordComparison, excused_from: int | None
) -> Finding:
    """Excuses a difference only from the tick at which the first late or lost sample was due."""
    first = comparison.first
    text = f"{comparison.identical}/{count_nouns(comparison.records, 'record')} identical"
    if first is None:
        return Finding(label, text, True)
    excused = excused_from is not None and first.tick >= excused_from
    return Finding(label, f"{text}; the first that differs: {first}", excused)
