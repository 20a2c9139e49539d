"""`trilat verify`: executes a log again and compares every computed field."""

from typing import Annotated

import typer

from ..reporting.terminal_output import (
    err,
    open_with_progress,
    out,
    print_json,
    print_text,
    progress_bar,
    sanitize,
    warn_user_laws,
)
from .options import JsonOption, LogsArgument

app = typer.Typer()


@app.command("verify", epilog="Example: trilat verify run.mcap")
def verify_command(
    files: LogsArgument,
    virtual: Annotated[
        bool,
        typer.Option("--virtual", help="Compare with virtual time too, with and without the log's arrivals."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Executes every site again from a log and compares every computed field of every record."""
    from ..execution.log_checks import run_log_checks
    from ..reporting.summary_text import format_run_lines

    log = open_with_progress(*files)
    warn_user_laws(log)
    with progress_bar(f"executing {files[0]}") as progress:
        result = run_log_checks(log, virtual=virtual, progress=progress)
    if as_json:
        print_json({"files": [str(file) for file in files], **result.to_json()})
    else:
        for line in result.lines:
            text = sanitize(f"{line.label}: {line.text}", 4000)
            (out if line.passed else err).print(text, markup=False, soft_wrap=True)
    if not result.passed:
        raise typer.Exit(1)
    if as_json:
        return
    for note in format_run_lines(log):
        print_text(note)
