"""The command `trilat log export`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from .opening import opened
from .options import ForceOption, out
from .progress import bar

app = typer.Typer()
_FORMS = ("ros2", "parquet", "csv", "npz", "mat")


@app.command(epilog="Example: trilat log export run.mcap --to parquet")
def export(
    files: Annotated[
        list[Path], typer.Argument(help="An MCAP log, or all the parts of one.", metavar="FILE...")
    ],
    form: Annotated[
        str,
        typer.Option(
            "--to",
            metavar="|".join(_FORMS),
            help="ros2: an MCAP file of standard messages at full rate; parquet, csv: a folder with a file "
            "per site and kind; npz, mat: one file with an array per column.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--out", metavar="OUT", help="File or folder. Default: beside FILE, by its name."),
    ] = None,
    force: ForceOption = False,
) -> None:
    """Makes files for other tools of a log: names end in their units, numbers are exact."""
    from ..errors import UsageError
    from ..export.export import Exporter, Form, default_path

    if form not in _FORMS:
        raise UsageError(f"--to is one of {', '.join(_FORMS)}, not {form!r}")
    chosen = Form(form)
    path = output if output is not None else default_path(chosen, files[0])
    exporter = Exporter(chosen, path, force=force)
    log = opened(*files)
    with bar(f"writing {path}") as progress:
        exporter.export(log, progress)
    records = sum(len(log[site]) for site in log.sites)
    out.print(f"{escape(str(path))}: {records} records of {', '.join(log.sites)}", soft_wrap=True)
