"""`trilat trace`: imports delays that other programs measured, for links."""

from pathlib import Path
from typing import Annotated

import typer

from ..files import refuse_existing, write_whole
from ..reporting import terminal_output as terminal
from . import options


def trace_import_command(
    form: Annotated[str, typer.Argument(help="irtt, ping or csv.", metavar="FORM")],
    file: Annotated[
        Path, typer.Argument(help="JSON of irtt, lines of ping -D, or a table with a header.", metavar="FILE")
    ],
    out: Annotated[
        Path | None, options.value("--out -o", "CSV", "Default: FILE as -trace.csv, here.")
    ] = None,
    way: Annotated[
        str,
        options.value(
            "--way",
            "half|send|receive|whole",
            "Half a round trip, one way of irtt (send or receive), or delays as they are. "
            "Default: half of a round trip, a one-way delay as it is.",
        ),
    ] = "",
    column: Annotated[str, options.value("--column", "NAME", "Column of the delays in a table.")] = "",
    every_s: Annotated[float, options.value("--every", "S", "Interval of a ping without -D, s.")] = 1.0,
    as_json: options.JsonOption = False,
    force: options.ForceOption = False,
) -> None:
    """Makes a trace for links from what another program measured, and prints statistics of the network."""
    from ..scenario.measured_traces import import_trace

    place = out if out is not None else Path(f"{file.name.split('.')[0]}-trace.csv")
    refuse_existing(place, force=force)
    found = import_trace(file, form, way=way, column=column, every_s=every_s)
    write_whole(place, found.write_rows())
    if as_json:
        terminal.print_json({**found.to_dict(), "file": str(place)})
        return
    terminal.print_line(found.summary())
    terminal.print_line(f"{place}: use it with --set link.model=trace --set link.file={place}")
