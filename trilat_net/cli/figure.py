"""`trilat figure`: single figures of a log for a paper."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from ..log.log_reader import Log


def figure_command(
    file: options.LogArgument,
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Names of figures, see --list; default: all that FILE has.",
            metavar="NAME",
            autocompletion=options.complete_figures,
        ),
    ] = None,
    width_in: Annotated[
        float, typer.Option("--width", metavar="3.5|7", help="Width of one or two columns of a paper, in.")
    ] = 3.5,
    formats: Annotated[
        str, typer.Option("--format", metavar="pdf,png,svg", help="One or more formats.")
    ] = "pdf,png",
    folder: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Default: FILE without .mcap, -figures.")
    ] = None,
    others: Annotated[
        list[Path] | None,
        typer.Option(
            "--with", metavar="FILE", help="Draw this log over FILE, as the figure overlay; repeatable."
        ),
    ] = None,
    law: options.LawFilesOption = None,
    other_version: options.OtherVersionOption = False,
    remember: options.RememberOption = False,
    listed: Annotated[bool, typer.Option("--list", help="Only list the figures.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list or the paths as JSON.")] = False,
    force: options.ForceOption = False,
) -> None:
    """Draws figures of a log for a paper: vectors, type 8 pt, fonts embedded, the same bytes every time."""
    log = terminal.open_with_progress(file, law=law, other_version=other_version, remember=remember)
    terminal.warn_user_laws(log)
    if listed:
        _list_figures(log, as_json=as_json)
        return
    from ..reporting.figures.registry import write_figures, write_overlay

    place = folder if folder is not None else file.with_name(f"{file.stem}-figures")
    kinds = _formats(formats)
    shape: dict[str, Any] = {"width_in": width_in, "formats": kinds, "force": force}
    if others:
        if names:
            raise UsageError("--with draws the figure overlay, and no other: leave the names out")
        logs = {file.stem: log, **{one.stem: terminal.open_with_progress(one) for one in others}}
        if len(logs) <= len(others):
            raise UsageError("logs that are drawn over one another need names of their own")
        paths = write_overlay(logs, place, **shape)
    else:
        with terminal.progress_bar("drawing") as progress:
            paths = write_figures(log, place, names or (), progress=progress, **shape)
    if as_json:
        terminal.print_json([str(path) for path in paths])
        return
    terminal.print_paths(paths)


def _formats(text: str) -> list[str]:
    kinds = [kind.strip().lower() for kind in text.split(",") if kind.strip()]
    if not kinds:
        raise UsageError("--format names no format, as in --format pdf,png")
    return kinds


def _list_figures(log: "Log", *, as_json: bool) -> None:
    """Prints every figure, and for which of them a log has nothing to show."""
    from ..reporting.figures.registry import FIGURES

    absent = {name: plate.absent(log) for name, plate in FIGURES.items()}
    if as_json:
        rows = [{"name": n, "about": FIGURES[n].about, "absent": why or None} for n, why in absent.items()]
        terminal.print_json(rows)
        return
    drawable = [(name, FIGURES[name].about) for name, why in absent.items() if not why]
    terminal.print_table(TextTable(("figure", "shows"), drawable))
    for name, why in absent.items():
        if why:
            terminal.out.print(f"[dim]{name}: nothing to show: {escape(why)}[/dim]", soft_wrap=True)
