"""The command `trilat log view`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from .opening import opened
from .options import ForceOption, out

app = typer.Typer()


@app.command(epilog="Example: trilat log view run.mcap")
def view(
    files: Annotated[
        list[Path], typer.Argument(help="An MCAP log, or all the parts of one.", metavar="FILE...")
    ],
    full: Annotated[
        bool, typer.Option("--full", help="Every record, not the decimated channels beside them.")
    ] = False,
    web: Annotated[
        bool, typer.Option("--web", help="In a browser: serves the viewer on this machine.")
    ] = False,
    save: Annotated[
        Path | None,
        typer.Option("--save", metavar="OUT.rrd", help="Do not open it; write what Rerun would show."),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Opens a log in Rerun: every curve with its name, a column per site.

    Of a log without standard channels (--views off), of one that was not finished and of parts it makes them
    first, in a temporary file.
    """
    from ..errors import UsageError
    from ..viewing.viewer import Show, open_viewer

    if save is not None and save.exists() and not force:
        raise UsageError(f"{save}: exists; choose another name, or replace it with --force")
    open_viewer(
        files,
        lambda: opened(*files),
        Show(full=full, web=web, save=save),
        lambda text: out.print(escape(text), soft_wrap=True),
    )
    if save is not None:
        out.print(f"{escape(str(save))}: open it with: rerun {escape(str(save))}", soft_wrap=True)
