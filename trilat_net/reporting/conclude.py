"""The report of a finished run: checks, figures, page, summary lines, a table with a row per
site.

Invariant: every claim rests on an execution made just now, in another process while figures are
drawn.
"""

from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..analysis.site_signals import shared_unit
from ..errors import CodeWithheld, LawFailed, RunFailed, ScenarioError
from ..execution.log_checks import check_log_files
from ..execution.virtual_comparison import simulate_without_operators
from ..log.accounting import MIN_COVERAGE
from ..log.findings import CheckReport, Finding
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from ..process import worker_pool
from ..scenario.imported_code import allowed_code
from ..theory.linear_analysis import certify_run
from .certificate_text import CertificateLine, describe_certificate
from .result_text import MARKS, Block, MarkedText, TextTable
from .summary_text import format_run_lines


@dataclass(frozen=True, repr=False)
class Conclusion(CheckReport):
    """A finished run: its judgement, checks, a row per site, lines on links, changes, modes and
    clocks.

    `paths` are the log's files, and those that were written.
    """

    verdict: CertificateLine
    table: TextTable
    notes: list[str]
    findings: list[Finding]
    paths: list[Path]

    def blocks(self) -> Iterator[Block]:
        """Yields its text."""
        yield MarkedText(MARKS[self.verdict.mark], f"stability: {self.verdict.text}")
        for line in self.findings:
            mark = "ok" if line.passed else "FAIL" if line.judged else "open"
            yield MarkedText(MARKS[mark], f"{line.check}: {line.text}")
        yield self.table
        yield from self.notes
        yield from (f"  {path}" for path in self.paths if path != self.page)
        yield f"open first: {self.page}"

    @property
    def page(self) -> Path:
        """The report, which is to be opened first."""
        return next((path for path in self.paths if path.suffix == ".html"), self.paths[0])

    def headline(self) -> str:
        """Returns whether every check passed, and where the page is."""
        words = {0: "passed", CodeWithheld.exit_code: "not all was judged"}
        return f"{words.get(self.exit_code, 'FAILED')}; {self.page}"

    def to_rows(self) -> list[dict[str, str]]:
        """Returns a row per site."""
        return [dict(zip(self.table.headers, row, strict=False)) for row in self.table.rows]

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat report --json`."""
        checks = [finding.to_row() for finding in self.findings]
        paths = [path.as_posix() for path in self.paths]
        found = {"passed": self.passed, "verdict": self.verdict.text, "notes": self.notes}
        return {**found, "checks": checks, "paths": paths}


def conclude(
    log: Log,
    folder: Path,
    progress: Progress | None = None,
    *,
    min_coverage: float = MIN_COVERAGE,
    png: bool = False,
) -> Conclusion:
    """Verifies a log from a file, and writes page and summary, with `png` figures, into a
    folder that exists.

    Raises:
        LogError: a record cannot be read.
        RunFailed: the process that executes the log was ended.
    """
    # Matplotlib takes a second, and `verify` needs none of it
    from .figures.registry import write_report_figures
    from .page import write_report

    lines: list[Finding] = []
    with worker_pool(1) as pool:  # two cores: the log is executed while its figures are drawn
        checking = pool.submit(check_log_files, log.sources, min_coverage, dict(allowed_code))
        twin = _run_without_operators(log)
        certificate = certify_run(log, min_coverage=min_coverage)
        notes = [*format_run_lines(log), f"certificate: {certificate.verdict.text}"]

        def verdicts() -> Iterator[Finding]:
            try:
                lines.extend(checking.result())
            except BrokenProcessPool:
                raise RunFailed(
                    "the process that executes the log again was ended; try again"
                ) from None
            yield from lines

        figures = (
            write_report_figures(
                log=log, folder=folder, twin=twin, progress=progress, pushed=certificate.twins
            )
            if png
            else []
        )
        made = write_report(
            log, folder, twin=twin, certificate=certificate, verdicts=verdicts()
        )
    heads = (*_HEADERS, f"max|e| end {shared_unit(log)}")
    table = TextTable(heads, [_site_row(log, site) for site in log.sites], align="lr")
    paths = [*map(Path, log.sources), *made, *figures]
    return Conclusion(describe_certificate(certificate)[0], table, notes, lines, paths)


def _run_without_operators(log: Log) -> Log | None:
    """Returns the same run without operators; None if it would be the same, or cannot be run."""
    # so would the twin, or hang
    broke_off = any(event.kind == "failed" for event in log.events)
    pushed = any(site.hands for site in log.scenario.sites.values())
    if broke_off or log.scenario.external or not pushed:
        return None
    try:
        return simulate_without_operators(log)
    # a law from outside that may not run, or fails: the check says so
    except (
        ScenarioError,
        LawFailed,
    ):
        return None


_HEADERS = ("site", "records", "missing", "late p50 us", "p99", "max", "busy p50 us", "p99")


def _site_row(log: Log, site: str) -> tuple[str, ...]:
    part = log[site]
    if not len(part):
        return (site, "0", *("",) * (len(_HEADERS) - 1))
    missing = max(log.last_ticks[site], part.last_tick) + 1 - len(part) - log.absent_ticks(site)
    late = np.percentile(part.late_us, (50, 99, 100))
    busy = np.percentile(part.busy_us, (50, 99)) if len(part) > 1 else (0, 0)
    numbers = (*(f"{value:.0f}" for value in (*late, *busy)), f"{np.abs(part.e[-1]).max():.2e}")
    return (site, str(len(part)), str(missing), *numbers)
