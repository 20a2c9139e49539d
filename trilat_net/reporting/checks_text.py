"""What was checked of a log, as text: executed again, well-formed and complete, recovered."""

from collections.abc import Iterator

from ..execution.log_checks import LogCheckReport
from ..log.recover import Recovery
from ..log.session_check import LogCheckResult
from .result_text import Block, MarkedText
from .summary_text import format_run_lines
from .text_table import TextTable

_MAX_PLACES = 10
"""Places of a failed check that are listed; the JSON has all."""
_MAX_LOSSES = 10
"""Losses that are listed."""


def compose_verification(found: LogCheckReport) -> Iterator[Block]:
    """Yields a line per check, and of a log that passed those of its run."""
    for line in found.lines:
        yield MarkedText("", f"{line.check}: {line.text}", failed=not line.passed)
    if found.passed:
        yield from format_run_lines(found.log)


def compose_log_check(found: LogCheckResult) -> Iterator[Block]:
    """Yields a line per check, and the places where it failed."""
    for finding in found.findings:
        mark = "[green]ok[/green]  " if finding.passed else "[red]FAIL[/red]"
        yield MarkedText(mark, f"{finding.check:<9}  {finding.text}")
        if finding.wrong == 1 and str(finding.places[0]) in finding.text:
            continue
        for place in finding.places[:_MAX_PLACES]:
            where = f"{place.file}: " if len(found.files) > 1 and place.file else ""
            yield f"       {where}{place}"
        if finding.wrong > _MAX_PLACES:
            yield f"       and {finding.wrong - _MAX_PLACES} more; --json names {len(finding.places)}"


def compose_recovery(found: Recovery) -> Iterator[Block]:
    """Yields what was recovered and what was lost."""
    how = "was finished" if found.finished else "was not finished"
    yield f"{found.output}: made of {found.path}, which {how}"
    rows = []
    if there := found.coverage.judged:
        rows.append(("records", ", ".join(f"{site} {count}" for site, count in there.items())))
        rows.append(("of the run", str(found.coverage)))
        rows.append(("source", f"digest chain {found.chain}"))
    rows.append(("messages", f"{found.messages} in {found.duration_s:.3f} s"))
    for name, lines in (("lost", found.lost), ("missing", found.missing)):
        rows += [("" if n else name, text) for n, text in enumerate(lines[:_MAX_LOSSES] or ["nothing"])]
        if len(lines) > _MAX_LOSSES:
            rows.append(("", f"and {len(lines) - _MAX_LOSSES} more; --json lists all"))
    yield TextTable(("", ""), [(f"  {name}", text) for name, text in rows])
