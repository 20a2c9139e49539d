"""`trilat report`: figures, page and summary of a log."""

from pathlib import Path
from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options


def report_command(
    files: options.LogsArgument,
    folder: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Default: FILE without .mcap.")
    ] = None,
    law: options.LawFilesOption = None,
    other_version: options.OtherVersionOption = False,
    remember: options.RememberOption = False,
    min_coverage: options.MinCoverageOption = options.MIN_COVERAGE,
    force: options.ForceOption = False,
    png: options.PngOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Writes the page and the summary of a log, with --png its figures as well."""
    from ..execution.log_checks import choose_exit_code
    from ..files import make_results_folder
    from ..reporting.conclude import conclude

    log = terminal.open_with_progress(
        *files, law=law, other_version=other_version, remember=remember
    )  # before its folder is made
    terminal.warn_user_laws(log)
    results = make_results_folder(folder if folder is not None else files[0].with_suffix(""), "", force=force)
    with terminal.progress_bar("drawing") as progress:
        conclusion = conclude(log, results, progress, min_coverage=min_coverage, png=png)
    terminal.print_result(conclusion, as_json=as_json)
    raise typer.Exit(choose_exit_code(conclusion.lines))
