"""Commands that look into a log without executing it: `trilat log info`, `trilat log check`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.markup import escape

from .log_tables import show_overview
from .opening import warn_if_torn
from .options import JsonOption, LogsArgument, err, out
from .progress import bar
from .show import shown

if TYPE_CHECKING:
    from ..log.soundness import Soundness

app = typer.Typer()

_MOST = 10
"""Places that a failed check names; all of them are in the JSON."""


@app.command(epilog="Example: trilat log info run.mcap")
def info(files: LogsArgument, as_json: JsonOption = False) -> None:
    """Tells what is in a log: its session, sites, links and channels, with what is missing."""
    from ..analysis.overview import overview

    with bar(f"reading {files[0]}") as progress:
        facts = overview(files, progress)
    if as_json:
        _print_json(facts)
        return
    show_overview(facts)
    for path in files:
        warn_if_torn(path)


@app.command(epilog="Example: trilat log check run.mcap")
def check(files: LogsArgument, as_json: JsonOption = False) -> None:
    """Checks how a log is built and whether all of it is there and right; executes nothing.

    Exit code 0: sound; 1: not; 2: no such file. Of an MCAP file of others only how it is built is checked.
    """
    from ..log.soundness import soundness

    with bar(f"checking {files[0]}") as progress:
        found = soundness(files, progress)
    if as_json:
        _print_json(_facts(files, found))
    else:
        _show(files, found)
    if not found.passed:
        raise typer.Exit(1)


def _facts(files: list[Path], found: "Soundness") -> dict[str, Any]:
    return {
        "files": [str(path) for path in files],
        "kind": "trilat" if found.ours else "mcap",
        "sound": found.passed,
        "checks": [
            {**finding._asdict(), "places": [place._asdict() for place in finding.places]}
            for finding in found.findings
        ],
    }


def _show(files: list[Path], found: "Soundness") -> None:
    """Prints a line per check, and where it failed."""
    for finding in found.findings:
        mark = "[green]ok[/green]  " if finding.passed else "[red]FAIL[/red]"
        out.print(f"{mark} {finding.check:<9}  {escape(shown(finding.text))}", soft_wrap=True)
        if finding.wrong == 1 and str(finding.places[0]) in finding.text:
            continue
        for place in finding.places[:_MOST]:
            where = f"{place.file}: " if len(files) > 1 and place.file else ""
            out.print(f"       {escape(shown(f'{where}{place}'))}", soft_wrap=True)
        if finding.wrong > _MOST:
            out.print(f"       and {finding.wrong - _MOST} more; --json names {len(finding.places)}")
    if not found.ours:
        err.print("note: this is no log of trilat-net: only how it is built was checked", soft_wrap=True)
    for path in files:
        warn_if_torn(path)


def _print_json(facts: dict[str, Any]) -> None:
    typer.echo(json.dumps(facts, indent=2, allow_nan=False))
