"""The checks of a log, one line each: complete, executed again, scenario hash, compared with virtual time.

Invariant: every claim rests on an execution made just now.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from ..errors import ScenarioError
from ..log.log_reader import Log, open_log
from ..log.mcap_reader import Progress
from .verify import VerifyResult, find_executed_sites, find_user_laws, verify
from .virtual_comparison import RecordComparison, compare_with_virtual


class CheckLine(NamedTuple):
    """The result of one check of a log, in words: its subject, its outcome, and whether it passed."""

    label: str
    text: str
    passed: bool


MAX_GAPS_NAMED = 60
"""Gaps that a line names."""
RECORDS_LABEL = "records"
"""Label of the line with the number of records."""


class LogCheckReport(NamedTuple):
    """The result of executing a log again, and a line for that and for every other check."""

    result: VerifyResult
    lines: list[CheckLine]

    @property
    def passed(self) -> bool:
        """True if every execution agreed with the log, complete or not."""
        return all(line.passed for line in self.lines)

    def to_json(self) -> dict[str, Any]:
        """Returns the report for a program: every gap, and the first difference with both values."""
        result, first = self.result, self.result.first
        return {
            "passed": self.passed,
            "whole_run": result.whole_run,
            "records": result.records,
            "identical": result.identical,
            "differing": result.differing,
            "unjudged": result.unjudged,
            "gaps": [{"site": site, "first": a, "last": b} for site, a, b in result.gaps],
            "first_difference": None
            if first is None
            else {**first._asdict(), "logged": repr(first.logged), "computed": repr(first.computed)},
            "checks": [line._asdict() for line in self.lines],
        }


def run_log_checks(log: Log, *, virtual: bool, progress: Progress | None = None) -> LogCheckReport:
    """Executes a log again, and compares it with virtual time if `virtual` is set.

    An incomplete log is reported and does not fail: its execution shows nothing wrong.

    Raises:
        LogError: a record cannot be read.
        ScenarioError: the file of a user law does not exist.
    """
    result = verify(log, progress)
    lines = list(_checks(log, result, virtual=virtual, progress=progress))
    return LogCheckReport(
        result, [line._replace(passed=True) if line.label == RECORDS_LABEL else line for line in lines]
    )


def check_log_files(sources: Sequence[str]) -> list[CheckLine]:
    """Returns a line per check of a log in files; a user law whose file does not exist fails one."""
    log = open_log(*sources)
    try:
        return list(_checks(log, verify(log), virtual=True))
    except ScenarioError as error:
        return [_records_line(log), CheckLine("executed again", f"cannot be: {error}", False)]


def _checks(
    log: Log, result: VerifyResult, *, virtual: bool, progress: Progress | None = None
) -> Iterator[CheckLine]:
    others = [name for name in log.sites if name not in find_executed_sites(log)]  # of an open-loop rerun
    recorded = f"{' and '.join(others)} {'stand' if len(others) > 1 else 'stands'}" if others else ""
    yield _records_line(log)
    yield from (CheckLine("user law", str(law), True) for law in find_user_laws(log.scenario))
    yield _verify_line(result, recorded)
    if log.session.get("scenario_sha256") != log.scenario_sha256:
        yield CheckLine("scenario", "is not the one whose hash the log names: it was changed", False)
    if virtual and recorded:
        yield CheckLine("virtual time", f"is another run: {recorded} as recorded, and did not react", True)
    elif virtual:
        twins = compare_with_virtual(log, progress)
        yield _virtual_line("virtual time fed with the log's arrivals", twins.fed, None)
        why = "a link was measured, not modelled" if log.scenario.measured else ""
        why = "an arm was external" if log.scenario.external else why
        if why and log.driver != "virtual":
            yield CheckLine("plain virtual time", f"is another run: {why}", True)
            return
        late = f"{len(twins.late)} late samples" + (f", the first: {twins.late[0]}" if twins.late else "")
        yield _virtual_line(
            f"plain virtual time ({late})", twins.plain, twins.late[0].due_tick if twins.late else None
        )


def _records_line(log: Log) -> CheckLine:
    made = {event.member: event.ticks for event in log.events if event.kind == "end"}
    have = sum(len(log[name]) for name in log.sites)
    want = sum(made.get(name, 0) for name in log.sites)
    silent = [name for name in log.sites if name not in made]
    text = f"{have}/{want} in the file" if not silent else f"{have} in the file"
    if silent:
        text += f"; {', '.join(silent)} did not report the number of its ticks"
    if log.damaged:
        text += f"; damaged in {len(log.damaged)} place{'s' * (len(log.damaged) > 1)}"
    elif not log.complete:
        text += "; the file was not finished"
    return CheckLine(RECORDS_LABEL, text, not silent and have == want and log.complete)


def _verify_line(result: VerifyResult, recorded: str) -> CheckLine:
    how = "whole runs, bit for bit" if result.whole_run else "tick by tick to 1e-9: another platform made it"
    text = f"{result.identical}/{result.records} records identical ({how})"
    if result.gaps:
        text += f"; no records of {_gaps_text(result.gaps)}"
    if recorded:
        text += f"; {recorded} as recorded, against other samples than the file has"
    if result.unjudged:
        text += f"; {result.unjudged} behind gaps could not be judged"
    if result.first:
        text += f"; {result.differing} differ, the first: {result.first}"
    if not result.records:
        return CheckLine("executed again", "no records to execute", False)
    return CheckLine("executed again", text, result.passed)


def _gaps_text(gaps: Sequence[tuple[str, int, int]]) -> str:
    """Names every gap by site, up to MAX_GAPS_NAMED."""
    texts = []
    left = MAX_GAPS_NAMED
    for site, group in itertools.groupby(gaps, key=lambda gap: gap[0]):
        ranges = [f"{first}-{last}" if last > first else f"{first}" for _, first, last in group]
        if left > 0:
            texts.append(f"{site} {', '.join(ranges[:left])}")
        left -= len(ranges)
    more = f" and {-left} more ranges, which --json names" if left < 0 else ""
    return "; ".join(texts) + more


def _virtual_line(label: str, comparison: RecordComparison, late_from: int | None) -> CheckLine:
    """Excuses a difference only from the tick at which the first late sample was due."""
    first = comparison.first
    text = f"{comparison.identical}/{comparison.records} records identical"
    if first is None:
        return CheckLine(label, text, True)
    excused = late_from is not None and first.tick >= late_from
    return CheckLine(label, f"{text}; the first that differs: {first}", excused)
