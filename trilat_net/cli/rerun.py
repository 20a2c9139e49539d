"""`trilat rerun`: executes sites of a log again with changed settings and prints the effect."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options


def rerun_command(
    files: options.LogsArgument,
    replace: Annotated[
        list[str] | None,
        typer.Option(
            "--replace",
            metavar="SITE",
            help="Execute this site again; repeatable.",
            autocompletion=options.complete_sites,
        ),
    ] = None,
    closed_loop: Annotated[
        bool, typer.Option("--closed-loop", help="Execute all sites, over the network of the log.")
    ] = False,
    overrides: options.SetOption = None,
    law: options.LawFilesOption = None,
    other_version: options.OtherVersionOption = False,
    remember: options.RememberOption = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", "--output", metavar="FILE", help="Write the result as a log."),
    ] = None,
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Executes sites of a log again with changed settings, and compares the result with the log.

    Without --closed-loop the other sites stay as recorded and do not react.
    """
    from ..execution.rerun import rerun

    if output is not None:
        _check_output(output, files, force=force)
    log = terminal.open_with_progress(*files, law=law, other_version=other_version, remember=remember)
    terminal.warn_user_laws(log)
    with terminal.progress_bar("executing") as progress:
        again = rerun(log, replace or [], overrides or [], closed_loop=closed_loop, progress=progress)
    if output is not None:
        again.save(output, force=force)
    if as_json:
        terminal.print_json({**again.to_dict(), "file": str(output) if output else None})
    else:
        terminal.print_result(again)
        terminal.print_paths([output] if output else [])
    if again.diverged or again.broken:
        raise typer.Exit(1)


def _check_output(output: Path, files: list[Path], *, force: bool) -> None:
    """Refuses a file that may not be written, before anything is executed."""
    from ..files import refuse_existing
    from ..log.log_layout import active_path

    if any(output.exists() and file.exists() and output.samefile(file) for file in files):
        raise UsageError(f"{output}: is the log itself; choose another name")
    refuse_existing(output, force=force, unfinished=active_path(output))
