"""`trilat verify`: executes a log again and compares every computed field."""

from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options


def verify_command(
    files: options.LogsArgument,
    virtual: Annotated[
        bool,
        typer.Option("--virtual", help="Compare with virtual time too, with and without the log's arrivals."),
    ] = False,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    as_json: options.JsonOption = False,
) -> None:
    """Executes every site again from a log and compares every computed field of every record.

    Exit code 0: all agrees, the log is as it was made, and enough of every site was judged. 1: something
    differs, was changed, or is missing. 2: no log.
    """
    from ..execution.log_checks import run_log_checks
    from ..reporting.summary_text import format_run_lines

    log = terminal.open_with_progress(*files)
    terminal.warn_user_laws(log)
    with terminal.progress_bar(f"executing {files[0]}") as progress:
        result = run_log_checks(log, virtual=virtual, progress=progress, min_coverage=min_coverage)
    if as_json:
        terminal.print_json({"files": [str(file) for file in files], **result.to_json()})
    else:
        for line in result.lines:
            text = terminal.sanitize(f"{line.label}: {line.text}", 4000)
            (terminal.out if line.passed else terminal.err).print(text, markup=False, soft_wrap=True)
    if not result.passed:
        raise typer.Exit(1)
    if as_json:
        return
    for note in format_run_lines(log):
        terminal.print_text(note)
