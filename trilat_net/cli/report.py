"""`trilat report`: figures, page and summary of a log."""

from pathlib import Path
from typing import Annotated

import typer

from ..reporting.terminal_output import (
    open_with_progress,
    print_conclusion,
    progress_bar,
    warn_user_laws,
)
from .options import ForceOption, LogsArgument

app = typer.Typer()


@app.command("report", epilog="Example: trilat report run.mcap -o report")
def report_command(
    files: LogsArgument,
    folder: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Default: FILE without .mcap.")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Writes the figures, the page and the summary of a log."""
    from ..files import make_results_folder
    from ..reporting.conclude import conclude

    log = open_with_progress(*files)  # before its folder is made
    warn_user_laws(log, needed=False)
    results = make_results_folder(folder if folder is not None else files[0].with_suffix(""), "", force=force)
    with progress_bar("drawing") as progress:
        conclusion = conclude(log, results, progress)
    print_conclusion(conclusion)
    if not conclusion.agreed:
        raise typer.Exit(1)
