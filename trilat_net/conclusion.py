"""What there is to say of a log at the end: checked, drawn, in a few lines and a table.

Law: nothing is claimed that was not executed again just now.
"""

import itertools
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .analysis.notes import run_lines
from .analysis.tables import VerdictLine
from .errors import LawFailed, RunFailed, ScenarioError, UsageError
from .experiment import compare_with_virtual, twin_without_hands
from .log.chunks import Progress
from .log.reader import Log, open_log
from .replay.comparison import Comparison
from .replay.outside import outside_laws
from .replay.verify import Verdict, executed_sites, last_ticks, verify
from .scenario import Scenario
from .workers import deaf, workers


class Conclusion(NamedTuple):
    """A log, judged.

    Attributes:
        columns: heads of the table.
        rows: a row per site.
        notes: what links did and what happened, a line each.
        lines: what was checked and how it came out.
        paths: the files that were made.
    """

    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    notes: list[str]
    lines: list[VerdictLine]
    paths: list[Path]

    @property
    def passed(self) -> bool:
        """True where every check passed."""
        return all(line.passed for line in self.lines)

    @property
    def agreed(self) -> bool:
        """True where every execution agreed with the log, complete or not."""
        return all(line.passed for line in self.lines if line.label != _RECORDS)


class Checked(NamedTuple):
    """What executing a log again showed.

    Attributes:
        verdict: every site executed from its records.
        lines: that and the other checks, a line each.
    """

    verdict: Verdict
    lines: list[VerdictLine]

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


def conclude(log: Log, folder: Path, progress: Progress | None = None) -> Conclusion:
    """Verifies a log, compares it with virtual time, and writes figures, page and summary.

    Args:
        log: the log, from a file.
        folder: where the results go; exists.
        progress: told how many figures are drawn, and how many there are.

    Raises:
        LogError: a record cannot be read.
        RunFailed: the process that executes the log was ended.
    """
    # Matplotlib takes a second, and `verify` needs none of it
    from .analysis.report import write_report
    from .certificate.section import section

    lines: list[VerdictLine] = []
    with workers(1) as pool:  # two cores: the log is executed while its figures are drawn
        with deaf():
            checking = pool.submit(_check_files, log.sources)
        twin = _twin(log)
        certified = section(log)
        notes = [*run_lines(log), f"certificate: {certified.facts['text']}"]

        def verdicts() -> Iterator[VerdictLine]:
            try:
                lines.extend(checking.result())
            except BrokenProcessPool:
                raise RunFailed("the process that executes the log again was ended; try again") from None
            yield from lines

        made = write_report(
            log, folder, twin=twin, verdicts=verdicts(), progress=progress, sections=[certified]
        )
    rows = [_row(log, site) for site in log.sites]
    return Conclusion(_COLUMNS, rows, notes, lines, [*map(Path, log.sources), *made])


def _twin(log: Log) -> Log | None:
    """Returns the same run without hands; None where it would be the same, or cannot be run."""
    broke_off = any(event.kind == "failed" for event in log.events)  # so would the twin, or hang
    pushed = any(site.hands for site in log.scenario.sites.values())
    if broke_off or log.scenario.external or not pushed:
        return None
    try:
        return twin_without_hands(log)
    except (ScenarioError, LawFailed):  # a law from outside that is not there, or fails: the check says so
        return None


def _check_files(sources: Sequence[str]) -> list[VerdictLine]:
    log = open_log(*sources)
    try:
        return list(_checks(log, verify(log), virtual=True))
    except ScenarioError as error:  # a law from outside that is not there
        return [_records_line(log), VerdictLine("executed again", f"cannot be: {error}", False)]


def checked(log: Log, *, virtual: bool, progress: Progress | None = None) -> Checked:
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
    return Checked(
        verdict, [line._replace(passed=True) if line.label == _RECORDS else line for line in lines]
    )


def results_folder(folder: Path | None, name: str, *, force: bool) -> Path:
    """Makes a folder for results.

    Args:
        folder: which one, or None for the next free `runs/NAME-N`.
        name: what the run is called.
        force: whether a folder that holds something may be used.

    Raises:
        UsageError: it holds something, or cannot be made.
    """
    chosen = folder if folder is not None else _next_free(Path("runs"), name)
    try:
        if not force and chosen.exists() and any(chosen.iterdir()):
            raise UsageError(f"{chosen}: holds something; choose another folder, or use --force")
        chosen.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{chosen}: cannot be made or read: {error.strerror}") from None
    return chosen


def _next_free(parent: Path, name: str) -> Path:
    return next(path for n in itertools.count(1) if not (path := parent / f"{name}-{n:03d}").exists())


def scenario_facts(scenario: Scenario) -> list[str]:
    """Returns what a valid scenario says, and what follows from it."""
    beta = scenario.beta
    weights = (
        "none: alpha is reducible, some site's weight is zero"
        if beta is None
        else ", ".join(f"{name} {weight:.4g}" for name, weight in zip(scenario.names, beta, strict=True))
    )
    return [
        f"{scenario.name}: valid, sha256 {scenario.sha256[:16]}",
        f"sites: {', '.join(scenario.names)}; {scenario.duration_s:g} s, "
        + ", ".join(f"{scenario.ticks(name)} ticks of {name}" for name in scenario.names),
        *_link_facts(scenario),
        f"beta, the left null vector of Upsilon: {weights}",
        *(f"assumed: {text}" for text in scenario.assumed),
    ]


def _link_facts(scenario: Scenario) -> Iterator[str]:
    """Yields what the links do: in one line where all do the same."""
    words = {name: link.describe() for name, link in scenario.links.items()}
    if len(set(words.values())) == 1:
        yield f"every link: {next(iter(words.values()))}"
        return
    for name, text in words.items():
        yield f"link {name}: {text}"


def _checks(
    log: Log, verdict: Verdict, *, virtual: bool, progress: Progress | None = None
) -> Iterator[VerdictLine]:
    yield _records_line(log)
    yield from (VerdictLine("law from outside", str(law), True) for law in outside_laws(log.scenario))
    yield _verify_line(verdict, _standing(log))
    if log.session.get("scenario_sha256") != log.scenario_sha256:
        yield VerdictLine("scenario", "is not the one whose hash the log names: it was changed", False)
    if virtual and (standing := _standing(log)):
        yield VerdictLine("virtual time", f"is another run: {standing} as recorded, and did not react", True)
    elif virtual:
        twins = compare_with_virtual(log, progress)
        yield _twin_line("virtual time fed with the log's arrivals", twins.fed, None)
        why = "a link was measured, not modelled" if log.scenario.measured else ""
        why = "an arm was outside of the program" if log.scenario.external else why
        if why and log.driver != "virtual":
            yield VerdictLine("plain virtual time", f"is another run: {why}", True)
            return
        late = f"{len(twins.late)} late samples" + (f", the first: {twins.late[0]}" if twins.late else "")
        yield _twin_line(
            f"plain virtual time ({late})", twins.plain, twins.late[0].due_tick if twins.late else None
        )


def _records_line(log: Log) -> VerdictLine:
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
    return VerdictLine(_RECORDS, text, not silent and have == want and log.complete)


def _standing(log: Log) -> str:
    """Says which sites an open-loop rerun did not execute, if the log is one; "" where all can be."""
    others = [name for name in log.sites if name not in executed_sites(log)]
    return f"{' and '.join(others)} {'stand' if len(others) > 1 else 'stands'}" if others else ""


def _verify_line(verdict: Verdict, standing: str) -> VerdictLine:
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
        return VerdictLine("executed again", "no records to execute", False)
    return VerdictLine("executed again", text, verdict.passed)


def _gaps_text(gaps: Sequence[tuple[str, int, int]]) -> str:
    """Names every gap, by site; of very many the first ones."""
    texts = []
    left = MOST_GAPS
    for site, group in itertools.groupby(gaps, key=lambda gap: gap[0]):
        ranges = [f"{first}-{last}" if last > first else f"{first}" for _, first, last in group]
        if left > 0:
            texts.append(f"{site} {', '.join(ranges[:left])}")
        left -= len(ranges)
    more = f" and {-left} more ranges, which --json names" if left < 0 else ""
    return "; ".join(texts) + more


def _twin_line(label: str, comparison: Comparison, late_from: int | None) -> VerdictLine:
    """A difference is excused only from the tick at which the first late sample was due."""
    first = comparison.first
    text = f"{comparison.identical}/{comparison.records} records identical"
    if first is None:
        return VerdictLine(label, text, True)
    excused = late_from is not None and first.tick >= late_from
    return VerdictLine(label, f"{text}; the first that differs: {first}", excused)


MOST_GAPS = 60
"""Gaps that a line names."""
_RECORDS = "records"
_COLUMNS = ("site", "records", "missing", "late p50 us", "p99", "max", "busy p50 us", "p99", "max|e| end rad")


def _row(log: Log, site: str) -> tuple[str, ...]:
    part = log[site]
    if not len(part):
        return (site, "0", *("",) * (len(_COLUMNS) - 2))
    missing = max(last_ticks(log)[site], int(part.tick[-1])) + 1 - len(part)
    late = np.percentile(part.late_us, (50, 99, 100))
    busy = np.percentile(part.busy_us, (50, 99)) if len(part) > 1 else (0, 0)
    numbers = (*(f"{value:.0f}" for value in (*late, *busy)), f"{np.abs(part.e[-1]).max():.2e}")
    return (site, str(len(part)), str(missing), *numbers)
