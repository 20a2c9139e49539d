"""The command that draws figures of a log for a paper: figure."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from ..errors import UsageError
from .opening import opened
from .options import ForceOption, LogArgument, out
from .progress import bar

if TYPE_CHECKING:
    from ..log.reader import Log

app = typer.Typer()


@app.command(epilog="Example: trilat figure run.mcap positions settling --width 3.5 --format pdf --out paper")
def figure(
    file: LogArgument,
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Which figures, see --list; none: all that FILE has.", metavar="NAME"),
    ] = None,
    width_in: Annotated[
        float, typer.Option("--width", metavar="3.5|7", help="One column of a paper or two, in.")
    ] = 3.5,
    formats: Annotated[
        str, typer.Option("--format", metavar="pdf,png,svg", help="One or more of them.")
    ] = "pdf,png",
    folder: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Default: FILE without .mcap, -figures.")
    ] = None,
    listed: Annotated[bool, typer.Option("--list", help="Only say which figures there are.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the list or the paths as JSON.")] = False,
    force: ForceOption = False,
) -> None:
    """Draws figures of a log for a paper: vectors, type 8 pt, fonts embedded, the same bytes every time."""
    log = opened(file)
    if listed:
        _list(log, as_json=as_json)
        return
    from ..drawing.figure import write_figures

    place = folder if folder is not None else file.with_name(f"{file.stem}-figures")
    kinds = _formats(formats)
    with bar("drawing") as progress:
        paths = write_figures(
            log, place, names or (), width_in=width_in, formats=kinds, force=force, progress=progress
        )
    if as_json:
        typer.echo(json.dumps([str(path) for path in paths], indent=2))
        return
    for path in paths:
        out.print(f"  {escape(str(path))}", soft_wrap=True)


def _formats(text: str) -> list[str]:
    kinds = [kind.strip().lower() for kind in text.split(",") if kind.strip()]
    if not kinds:
        raise UsageError("--format names no format, as in --format pdf,png")
    return kinds


def _list(log: "Log", *, as_json: bool) -> None:
    """Prints every figure, and for which of them a log has nothing to show."""
    from ..drawing.plates import PLATES

    absent = {name: plate.absent(log) for name, plate in PLATES.items()}
    if as_json:
        rows = [{"name": n, "about": PLATES[n].about, "absent": why or None} for n, why in absent.items()]
        typer.echo(json.dumps(rows, indent=2, ensure_ascii=False))
        return
    table = Table("figure", "shows", box=None, pad_edge=False)
    for name in (name for name, why in absent.items() if not why):
        table.add_row(name, escape(PLATES[name].about))
    out.print(table)
    for name, why in absent.items():
        if why:
            out.print(f"[dim]{name}: nothing to show: {escape(why)}[/dim]", soft_wrap=True)
