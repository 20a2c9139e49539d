"""`trilat log recover`: makes a whole file of one that is torn or damaged."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from .options import ForceOption, LogArgument, out
from .progress import bar

if TYPE_CHECKING:
    from ..log.recover import Recovery

app = typer.Typer()
LOSSY = 3
"""Exit code where something was lost."""


@app.command(epilog="Example: trilat log recover run.mcap.active")
def recover(
    file: LogArgument,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="OUT", help="Default: FILE without .active, or FILE.recovered.mcap."
        ),
    ] = None,
    force: ForceOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print what came of it as JSON.")] = False,
) -> None:
    """Makes a whole file of one that is torn or damaged; that one stays as it is.

    Works on every MCAP file. Exit code 0: nothing was lost; 3: something was, and it says what; 1: there was
    nothing to save.
    """
    from ..log.recover import recover as make_whole

    with bar(f"reading {file}") as progress:
        result = make_whole(file, output, force=force, progress=progress)
    if as_json:
        out.print_json(json.dumps(_facts(result)))
    else:
        _show(result)
    if not result.lossless:
        raise typer.Exit(LOSSY)


def _facts(result: "Recovery") -> dict[str, object]:
    return {
        "file": str(result.path),
        "output": str(result.output),
        "finished": result.finished,
        "lossless": result.lossless,
        "messages": result.messages,
        "records": result.sites,
        "duration_s": result.duration_s,
        "salvaged_messages": result.salvaged,
        "lost_bytes": result.lost_bytes,
        "lost": result.lost,
        "missing": result.missing,
    }


def _show(result: "Recovery") -> None:
    how = "was finished" if result.finished else "was not finished"
    out.print(f"{escape(f'{result.output}: made of {result.path}')}, which {how}", soft_wrap=True)
    table = Table(box=None, pad_edge=False, show_header=False, padding=(0, 2))
    table.add_column()
    table.add_column(overflow="fold")
    if result.sites:
        table.add_row("records", ", ".join(f"{site} {count}" for site, count in result.sites.items()))
    table.add_row("messages", f"{result.messages} in {result.duration_s:.3f} s")
    for name, told in (("lost", result.lost), ("missing", result.missing)):
        for n, text in enumerate(told[:MOST] or ["nothing"]):
            table.add_row("" if n else name, escape(text))
        if len(told) > MOST:
            table.add_row("", f"and {len(told) - MOST} more; --json tells all")
    out.print(table)


MOST = 10
"""Losses that are printed."""
