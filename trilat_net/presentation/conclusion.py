"""Wraps up a finished run: checks its log, and writes its report and its summary.

`conclude` implements `trilat report`. To check the log, it recomputes the control loops from
the received data in the log and compares the results with the recorded ones bit for bit. It
returns a `Conclusion`, whose text the commands print after a run.

Invariant:
    - Every claim is based on a re-execution of the log made for this conclusion.
    - The re-execution runs in a separate process while the report is written, which makes use
      of two processor cores.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..analysis import JointError, certify_run
from ..errors import CodeWithheld, LawFailed, RunFailed, ScenarioError, join_arguments
from ..execution import LogCheckReport, SimulatedLog
from ..log import MIN_COVERAGE, CheckReport, Log, Progress, SiteLog
from ..own_code import allowed_code
from ..scenario import END_WINDOW_S
from ..workers import worker_pool
from . import terminal_output
from .certificate_text import (
    CertificateLine,
    describe_certificate,
    describe_in_words,
    describe_theorem,
)
from .log_text import format_run_lines
from .plot_signals import shared_unit
from .result_text import MARKS, Block, MarkedText, TextTable


@dataclass(frozen=True, repr=False)
class Conclusion(CheckReport):
    """Text and files that present a finished run to the user.

    Created by `conclude` after a run was recorded.

    Attributes:
        findings: Results of the log checks, one per check.
        verdict: The verdict on whether the run was stable.
        meaning: Lines that explain the verdict, with remarks about the run.
        table: Table with one row per arm.
        notes: Lines about the stability proof and about notable facts of the run, such as
            changed settings or messages from a user's control law.
        paths: Paths of the log files and of the files that were written.
    """

    verdict: CertificateLine
    table: TextTable
    notes: list[str]
    paths: list[Path]
    meaning: list[CertificateLine] = field(default_factory=list)

    def blocks(self) -> Iterator[Block]:
        """Yields the blocks of text that `trilat report` prints.

        These are the stability verdict and its explanation, the checks of the log, the table of
        sites, the notes, and the paths of the files.
        """
        for line in (self.verdict, *self.meaning):
            yield line.print_form
        for finding in self.findings:
            failure_mark = "FAIL" if finding.judged else "open"
            mark = "ok" if finding.passed else failure_mark
            yield MarkedText(MARKS[mark], f"{finding.check}: {finding.text}")
        yield self.table
        yield from self.notes
        yield from (f"  {path}" for path in self.paths if path != self.page)
        yield f"open first: {self.page}"

    @property
    def page(self) -> Path:
        """Path of the file that the user should open first: the HTML report of the run.

        If no report was written, this is the path of the first log file.
        """
        pages = [path for path in self.paths if path.suffix == ".html"]
        return pages[0] if pages else self.paths[0]

    def headline(self) -> str:
        """Returns a line with the outcome of the log checks and the path of the report.

        Checks that need the code of a user's control law are incomplete if that code is not
        allowed to run. In that case the line says that not everything was judged.
        """
        results = {0: "passed", CodeWithheld.exit_code: "not all was judged"}
        result = results.get(self.exit_code, "FAILED")
        return f"{result}; {self.page}"

    def to_rows(self) -> list[dict[str, str]]:
        """Returns the table of arms as a list of dictionaries, one per arm.

        Keys are the column headers. Values are strings, as in the terminal.
        """
        headers = self.table.headers
        return [dict(zip(headers, row, strict=False)) for row in self.table.rows]

    def to_dict(self) -> dict[str, Any]:
        """Converts the result to the plain values that `trilat report --json` prints.

        The entries are the outcome ("passed", "verdict"), its explanation for users ("meaning",
        "notes"), the individual checks, and the paths of the files.
        """
        return {
            "passed": self.passed,
            "verdict": self.verdict.text,
            "meaning": [line.text for line in self.meaning],
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
    """Checks the log of a finished run, judges the run, and writes its report to a folder.

    The log is re-executed in a second process while this process judges the run and draws the
    figures.

    Args:
        log: Log that was opened from files.
        folder: Existing folder for the report.
        progress: Function that is called with the number of drawn figures and the total number.
        min_coverage: Minimum fraction of each site's ticks that must be recorded and checked
            for the run to be judged.
        png: True to write the figures as PNG files too.

    Returns:
        The verdict, the results of the checks, and the paths of the written files.

    Raises:
        LogError: A record cannot be read.
        RunFailed: The process that re-executes the log was terminated.
    """
    # Importing Matplotlib takes a second, which `trilat verify` need not wait for.
    from .figures.age_and_lateness import explain_missing_loop_times
    from .figures.registry import write_report_figures
    from .page import write_report

    # Two processor cores are used: the log is executed while its figures are drawn.
    with worker_pool(1) as pool:
        allowed = dict(allowed_code)
        check = pool.submit(LogCheckReport.check_files, log.sources, min_coverage, allowed)
        twin = _run_without_operators(log)
        own_laws = log.may_run_user_laws
        certificate = certify_run(log, min_coverage=min_coverage, own_laws=own_laws)
        # A record that cannot be read raises here, before anything is written.
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

        def wait_for_checks() -> CheckReport:
            """Returns the results of the log checks once all checks have finished.

            The checks run in another process, which re-executes the log; `check` is the future
            for their results.

            Raises:
                RunFailed: The other process was terminated.
            """
            try:
                return check.result()
            except BrokenProcessPool:
                raise RunFailed(
                    "the process that reruns the log ended unexpectedly; try again"
                ) from None

        report = write_report(
            log,
            folder,
            twin=twin,
            certificate=certificate,
            wait_for_checks=wait_for_checks,
        )
        findings = wait_for_checks().findings
    untimed = explain_missing_loop_times(log)
    timing_lines = [untimed] if untimed else []
    verdict = describe_certificate(certificate)[0]
    meaning = describe_in_words(certificate)
    theorem = describe_theorem(certificate)
    if log.why_empty:
        verdict = CertificateLine("FAIL", f"nothing to judge: {log.why_empty}")
        meaning = []
        theorem = []
    return Conclusion(
        verdict=verdict,
        meaning=meaning,
        table=_tabulate_sites(log, is_timed=not untimed),
        notes=[*timing_lines, *run_lines, *theorem],
        findings=findings,
        paths=[*map(Path, log.sources), *report, *figures],
    )


def _run_without_operators(log: Log) -> Log | None:
    """Repeats the run of a log in simulation, without operators.

    The difference between the two runs shows how far the operators displaced the arms.

    Returns:
        The log of the simulation. `None` if the simulation would not differ from the run, or is
        not possible.
    """
    # A run that failed would fail again, or hang. External arms cannot be simulated.
    has_failed = any(event.kind == "failed" for event in log.events)
    has_operators = any(site.hands for site in log.scenario.sites.values())
    if has_failed or log.scenario.external or not has_operators:
        return None
    try:
        return SimulatedLog.without_operators(log)
    except (ScenarioError, LawFailed):
        # The control law of a user failed or may not run. The check of the log reports this.
        return None


_HEADERS = ("site", "records", "missing")
_TIMING_HEADERS = ("late p50 us", "p99", "max", "busy p50 us", "p99")


def _tabulate_sites(log: Log, *, is_timed: bool) -> TextTable:
    """Returns a table with one row per arm: number of records, timing, and largest final error.

    The error is the largest error of any joint in the last second, or in the whole run if it
    was shorter. The table names the joint.

    Args:
        log: Log of the run.
        is_timed: False to omit the timing, since loops in virtual time are never late.
    """
    timing_headers = _TIMING_HEADERS if is_timed else ()
    has_second = any(log[site].t_s[-1] >= END_WINDOW_S for site in log.sites if len(log[site]))
    error_interval = " last s" if has_second else ""
    headers = (*_HEADERS, *timing_headers, f"max|e|{error_interval}, {shared_unit(log)}", "of")
    rows = []
    for site in log.sites:
        records = log[site]
        if not len(records):
            empty = [""] * (len(headers) - 2)
            rows.append([site, "0", *empty])
            continue

        # The site may have executed ticks whose records were lost at the end of the log.
        ticks = max(log.last_ticks[site], records.last_tick) + 1
        missing = ticks - len(records) - log.absent_ticks(site)
        timing_cells = _list_timing_cells(records) if is_timed else []
        error = JointError.find_in_last_second(records)
        error_cells = ["", ""]
        if error is not None:
            error_cells = [f"{error.value:.3g}", error.joint.removeprefix(f"{site} ")]
        rows.append([site, str(len(records)), str(missing), *timing_cells, *error_cells])

    # Numbers are aligned to the right, and the names in the first and last column to the left.
    number_columns = "r" * (len(headers) - 2)
    return TextTable(headers, rows, align=f"l{number_columns}l")


def _list_timing_cells(records: SiteLog) -> list[str]:
    """Returns cells with percentiles of the lateness and computing time of a site's ticks."""
    late_us = np.percentile(records.late_us, (50, 99, 100))
    busy_us = np.zeros(2)
    # A record contains the computing time of the previous tick, so the first record has none.
    if len(records) > 1:
        busy_us = np.percentile(records.busy_us, (50, 99))
    return [f"{time_us:.0f}" for time_us in (*late_us, *busy_us)]


def conclude_files(
    paths: Sequence[Path], folder: Path, *, as_json: bool = False, png: bool = False
) -> tuple[Log, Conclusion]:
    """Checks a newly recorded log, writes its report, and prints the result.

    If the user interrupts the checks or the drawing, a note shows the command that writes the
    report later.

    Args:
        paths: Files of the log.
        folder: Folder for the report.
        as_json: True to print the result as JSON.
        png: True to write the figures as PNG files too.

    Returns:
        The log, and its conclusion with the paths of the report.
    """
    if not as_json:
        terminal_output.out.print("checking the log and drawing ...")
    try:
        log = terminal_output.open_with_progress(*paths)
        with terminal_output.progress_bar("executing and drawing") as progress:
            conclusion = conclude(log, folder, progress, png=png)
    except KeyboardInterrupt:
        files = join_arguments(map(str, paths))
        command = f"trilat report {files} -o {join_arguments([str(folder)])} --force"
        terminal_output.print_note(
            f"the log is kept: {files}; its report can be drawn later: {command}"
        )
        raise
    terminal_output.print_result(conclusion, as_json=as_json)
    return log, conclusion
