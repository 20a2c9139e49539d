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
    resume_every: Annotated[
        int,
        typer.Option(
            "--resume-every",
            metavar="N",
            min=0,
            help="Start sites afresh from the records every N ticks: shows what a law knows besides.",
        ),
    ] = 0,
    law: options.LawFilesOption = None,
    other_version: options.OtherVersionOption = False,
    remember: options.RememberOption = False,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    as_json: options.JsonOption = False,
) -> None:
    """Executes every site again from a log and compares every computed field of every record.

    Exit code 0: all agrees, the log is as it was made, and enough of every site was judged. 1: something
    differs, was changed, or is missing. 2: no log. 4: a site's law is code from outside that may not run
    without --law; all else agrees.
    """
    from ..execution.log_checks import choose_exit_code, run_log_checks

    log = terminal.open_with_progress(*files, law=law, other_version=other_version, remember=remember)
    terminal.warn_user_laws(log)
    with terminal.progress_bar(f"executing {files[0]}") as progress:
        result = run_log_checks(
            log, virtual=virtual, progress=progress, min_coverage=min_coverage, resume_every=resume_every
        )
    terminal.print_result(result, as_json=as_json)
    raise typer.Exit(choose_exit_code(result.lines))
