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
    """What a check of a log showed, in words.

    Attributes:
        label: what was checked.
        text: how it came out.
        passed: whether it is as it should be.
    """

    label: str
    text: str
    passed: bool


MAX_GAPS_NAMED = 60
"""Gaps that a line names."""
RECORDS_LABEL = "records"
"""The label of the line that says how many records there are."""


class LogCheckReport(NamedTuple):
    """What executing a log again showed.

    Attributes:
        verdict: every site executed from its records.
        lines: that and the other checks, a line each.
    """

    verdict: VerifyResult
    lines: list[CheckLine]

    @property
    def passed(self) -> bool:
        """True where every execution agreed with the log, complete or not."""
        return all(line.passed for line in self.lines)

    def facts(self) -> dict[str, Any]:
        """Returns the same for a program: every gap, and the first difference with both values."""
        verdict, first = self.verdict, self.verdict.first
        return {
            "passed": self.passed,
            "whole_run": verdict.whole_run,
            "records": verdict.records,
            "identical": verdict.identical,
            "differing": verdict.differing,
            "unjudged": verdict.unjudged,
            "gaps": [{"site": site, "first": a, "last": b} for site, a, b in verdict.gaps],
            "first_difference": None
            if first is None
            else {
                "site": first.site,
                "tick": first.tick,
                "field": first.field,
                "logged": repr(first.logged),
                "computed": repr(first.computed),
            },
            "checks": [line._asdict() for line in self.lines],
        }


def run_log_checks(log: Log, *, virtual: bool, progress: Progress | None = None) -> LogCheckReport:
    """Returns what executing a log again showed.

    Args:
        log: the log.
        virtual: whether to compare it with virtual time as well.
        progress: told how many records are done, and how many there are.

    Raises:
        LogError: a record cannot be read.
        ScenarioError: a law from outside is not there.
    """
    verdict = verify(log, progress)
    lines = list(_checks(log, verdict, virtual=virtual, progress=progress))
    # whether a log is complete is not what its execution shows: reported, and no failure of it
    return LogCheckReport(
        verdict, [line._replace(passed=True) if line.label == RECORDS_LABEL else line for line in lines]
    )


def check_log_files(sources: Sequence[str]) -> list[CheckLine]:
    """Returns a line per check of a log in files; a law from outside that is not there is one that failed."""
    log = open_log(*sources)
    try:
        return list(_checks(log, verify(log), virtual=True))
    except ScenarioError as error:  # a law from outside that is not there
        return [_records_line(log), CheckLine("executed again", f"cannot be: {error}", False)]


def _checks(
    log: Log, verdict: VerifyResult, *, virtual: bool, progress: Progress | None = None
) -> Iterator[CheckLine]:
    yield _records_line(log)
    yield from (CheckLine("law from outside", str(law), True) for law in find_user_laws(log.scenario))
    yield _verify_line(verdict, _recorded_sites(log))
    if log.session.get("scenario_sha256") != log.scenario_sha256:
        yield CheckLine("scenario", "is not the one whose hash the log names: it was changed", False)
    if virtual and (standing := _recorded_sites(log)):
        yield CheckLine("virtual time", f"is another run: {standing} as recorded, and did not react", True)
    elif virtual:
        twins = compare_with_virtual(log, progress)
        yield _virtual_line("virtual time fed with the log's arrivals", twins.fed, None)
        why = "a link was measured, not modelled" if log.scenario.measured else ""
        why = "an arm was outside of the program" if log.scenario.external else why
        if why and log.driver != "virtual":
            yield CheckLine("plain virtual time", f"is another run: {why}", True)
            return
        late = f"{len(twins.late)} late samples" + (f", the first: {twins.late[0]}" if twins.late else "")
        yield _virtual_line(
            f"plain virtual time ({late})", twins.plain, twins.late[0].due_tick if twins.late else None
        )


def _records_line(log: Log) -> CheckLine:
    """Says how many records there are of how many."""
    made = {event.member: event.ticks for event in log.events if event.kind == "end"}
    have = sum(len(log[name]) for name in log.sites)
    want = sum(made.get(name, 0) for name in log.sites)
    silent = [name for name in log.sites if name not in made]
    text = f"{have}/{want} in the file" if not silent else f"{have} in the file"
    if silent:
        text += f"; {', '.join(silent)} never said how many ticks were made"
    if log.damaged:
        text += f"; damaged in {len(log.damaged)} place{'s' * (len(log.damaged) > 1)}"
    elif not log.complete:
        text += "; the file was not finished"
    return CheckLine(RECORDS_LABEL, text, not silent and have == want and log.complete)


def _recorded_sites(log: Log) -> str:
    """Says which sites an open-loop rerun did not execute, if the log is one; "" where all can be."""
    others = [name for name in log.sites if name not in find_executed_sites(log)]
    return f"{' and '.join(others)} {'stand' if len(others) > 1 else 'stands'}" if others else ""


def _verify_line(verdict: VerifyResult, standing: str) -> CheckLine:
    how = "whole runs, bit for bit" if verdict.whole_run else "tick by tick to 1e-9: another platform made it"
    text = f"{verdict.identical}/{verdict.records} records identical ({how})"
    if verdict.gaps:
        text += f"; no records of {_gaps_text(verdict.gaps)}"
    if standing:
        text += f"; {standing} as recorded, against other samples than the file has"
    if verdict.unjudged:
        text += f"; {verdict.unjudged} behind gaps could not be judged"
    if verdict.first:
        text += f"; {verdict.differing} differ, the first: {verdict.first}"
    if not verdict.records:
        return CheckLine("executed again", "no records to execute", False)
    return CheckLine("executed again", text, verdict.passed)


def _gaps_text(gaps: Sequence[tuple[str, int, int]]) -> str:
    """Names every gap, by site; of very many the first ones."""
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
    """A difference is excused only from the tick at which the first late sample was due."""
    first = comparison.first
    text = f"{comparison.identical}/{comparison.records} records identical"
    if first is None:
        return CheckLine(label, text, True)
    excused = late_from is not None and first.tick >= late_from
    return CheckLine(label, f"{text}; the first that differs: {first}", excused)
