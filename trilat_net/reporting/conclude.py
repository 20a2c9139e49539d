"""Conclude a finished run: check its log, and write its figures, page and summary.

`conclude` is the work of `trilat report`. Its result, a `Conclusion`, is the text that commands
print after a run.

Invariant:
    - Every claim rests on a new execution of the log, made for this conclusion.
    - The execution runs in another process while the figures are drawn.
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
    """The conclusion of a finished run.

    Attributes:
        verdict: the judgement of the run's stability.
        table: a row per site.
        notes: lines on user laws, arms, links, changes, modes and clocks, and on the
            certificate.
        findings: the checks of the log.
        paths: the files of the log, and the files that were written.
    """

    verdict: CertificateLine
    table: TextTable
    notes: list[str]
    findings: list[Finding]
    paths: list[Path]

    def blocks(self) -> Iterator[Block]:
        """Yields the verdict, the checks, the table of sites, the notes and the files."""
        yield MarkedText(MARKS[self.verdict.mark], f"stability: {self.verdict.text}")
        for finding in self.findings:
            failed = "FAIL" if finding.judged else "open"
            mark = "ok" if finding.passed else failed
            yield MarkedText(MARKS[mark], f"{finding.check}: {finding.text}")
        yield self.table
        yield from self.notes
        yield from (f"  {path}" for path in self.paths if path != self.page)
        yield f"open first: {self.page}"

    @property
    def page(self) -> Path:
        """The page of the report; without a page, the first path."""
        pages = [path for path in self.paths if path.suffix == ".html"]
        return pages[0] if pages else self.paths[0]

    def headline(self) -> str:
        """Returns the result of the checks, and the path of the page."""
        results = {0: "passed", CodeWithheld.exit_code: "not all was judged"}
        result = results.get(self.exit_code, "FAILED")
        return f"{result}; {self.page}"

    def to_rows(self) -> list[dict[str, str]]:
        """Returns a row per site."""
        headers = self.table.headers
        return [dict(zip(headers, row, strict=False)) for row in self.table.rows]

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat report --json`."""
        return {
            "passed": self.passed,
            "verdict": self.verdict.text,
            "notes": self.notes,
            "checks": [finding.to_row() for finding in self.findings],
            "paths": [path.as_posix() for path in self.paths],
        }


def conclude(
    log: Log,
    folder: Path,
    progress: Progress | None = None,
    *,
    min_coverage: float = MIN_COVERAGE,
    png: bool = False,
) -> Conclusion:
    """Verifies a log, and writes its page and summary into a folder.

    Args:
        log: a log that was opened from files.
        folder: an existing folder.
        progress: called with (done, total) while figures are drawn.
        min_coverage: smallest share of every site's ticks that must be judged.
        png: True to write the figures as PNG files too.

    Raises:
        LogError: a record cannot be read.
        RunFailed: the process that executes the log was terminated.
    """
    # Matplotlib takes a second, and `verify` needs none of it
    from .figures.registry import write_report_figures
    from .page import write_report

    findings: list[Finding] = []
    # uses two cores: the log is executed while its figures are drawn
    with worker_pool(1) as pool:
        allowed = dict(allowed_code)
        check = pool.submit(check_log_files, log.sources, min_coverage, allowed)
        twin = _run_without_operators(log)
        certificate = certify_run(log, min_coverage=min_coverage)
        # raises, if at all, before anything is written
        run_lines = format_run_lines(log)
        figures: list[Path] = []
        if png:
            figures = write_report_figures(
                log=log,
                folder=folder,
                twin=twin,
                progress=progress,
                pushed=certificate.twins,
            )

        def wait_for_findings() -> Iterator[Finding]:
            try:
                findings.extend(check.result())
            except BrokenProcessPool:
                raise RunFailed(
                    "the process that executes the log again was ended; try again"
                ) from None
            yield from findings

        report = write_report(
            log,
            folder,
            twin=twin,
            certificate=certificate,
            verdicts=wait_for_findings(),
        )
    return Conclusion(
        verdict=describe_certificate(certificate)[0],
        table=_tabulate_sites(log),
        notes=[*run_lines, f"certificate: {certificate.verdict.text}"],
        findings=findings,
        paths=[*map(Path, log.sources), *report, *figures],
    )


def _run_without_operators(log: Log) -> Log | None:
    """Returns the same run without operators; None if it would not differ, or cannot run."""
    # the twin of a run that failed would fail too, or hang
    has_failed = any(event.kind == "failed" for event in log.events)
    has_operators = any(site.hands for site in log.scenario.sites.values())
    if has_failed or log.scenario.external or not has_operators:
        return None
    try:
        return simulate_without_operators(log)
    # a user law fails or is not allowed to run: the check of the log reports this
    except (ScenarioError, LawFailed):
        return None


_HEADERS = (
    "site",
    "records",
    "missing",
    "late p50 us",
    "p99",
    "max",
    "busy p50 us",
    "p99",
)


def _tabulate_sites(log: Log) -> TextTable:
    """Returns a table with a row per site: records, timing of the loop, and last error."""
    headers = (*_HEADERS, f"max|e| end {shared_unit(log)}")
    rows = [_list_site_cells(log, site) for site in log.sites]
    return TextTable(headers, rows, align="lr")


def _list_site_cells(log: Log, site: str) -> list[str]:
    """Returns the cells of a site; those after the number of records are "" without records."""
    records = log[site]
    if not len(records):
        empty = [""] * (len(_HEADERS) - 1)
        return [site, "0", *empty]
    ticks = max(log.last_ticks[site], records.last_tick) + 1
    missing = ticks - len(records) - log.absent_ticks(site)
    late_us = np.percentile(records.late_us, (50, 99, 100))
    busy_us = np.zeros(2)
    # a record holds the computing time of the tick before, so that the first record has none
    if len(records) > 1:
        busy_us = np.percentile(records.busy_us, (50, 99))
    times = [f"{time_us:.0f}" for time_us in (*late_us, *busy_us)]
    last_error = np.abs(records.e[-1]).max()
    return [site, str(len(records)), str(missing), *times, f"{last_error:.2e}"]
