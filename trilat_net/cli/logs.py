"""Commands that make a log in virtual time, or look into one: sim, verify, report."""

import json
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.markup import escape

from ..interrupt import Interrupt
from .opening import opened, tell_outside_laws
from .options import (
    DurationOption,
    ForceOption,
    JsonOption,
    LogsArgument,
    ScenarioArgument,
    SeedOption,
    SetOption,
    ViewsOption,
    chosen_scenario,
    err,
    out,
)
from .progress import bar
from .show import show_conclusion, shown

app = typer.Typer()


@app.command(epilog="Example: trilat sim free -o free.mcap --set link.delay_ms=400")
def sim(
    scenario: ScenarioArgument,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Default: NAME.mcap.")
    ] = None,
    duration: DurationOption = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
    views: ViewsOption = "100",
    force: ForceOption = False,
) -> None:
    """Runs the same experiment in virtual time, into the same kind of log."""
    from ..experiment import record_virtual
    from ..log.views import views_rate

    chosen = chosen_scenario(scenario, overrides, duration, seed)
    path = output if output is not None else Path(f"{chosen.name}.mcap")
    views_hz = views_rate(views)
    with Interrupt() as interrupt:
        within = record_virtual(chosen, path, force=force, stopped=interrupt.requested, views_hz=views_hz)
    if interrupt.requested():
        err.print(f"interrupted; {escape(str(path))} holds what there was", soft_wrap=True)
        raise typer.Exit(interrupt.exit_code)
    out.print(f"{escape(str(path))}: {chosen.duration_s:g} s of {', '.join(chosen.names)}")
    if not within:
        _fail(f"{path}: the run diverged: a joint passed its qd_limit_rad_s, and the run ended there")


@app.command(epilog="Example: trilat verify run.mcap")
def verify(
    files: LogsArgument,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Compare with virtual time as well, with and without arrivals.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Executes every site again from a log, and compares every computed field of every record."""
    from ..analysis.notes import run_lines
    from ..checking import checked

    log = opened(*files)
    tell_outside_laws(log)
    with bar(f"executing {files[0]}") as progress:
        result = checked(log, virtual=virtual, progress=progress)
    if as_json:
        typer.echo(json.dumps({"files": [str(file) for file in files], **result.facts()}, indent=2))
    else:
        for line in result.lines:
            console = out if line.passed else err
            console.print(escape(shown(f"{line.label}: {line.text}", 4000)), soft_wrap=True)
    if not result.passed:
        raise typer.Exit(1)
    if as_json:
        return
    for note in run_lines(log):
        out.print(escape(note), soft_wrap=True)


@app.command(epilog="Example: trilat report run.mcap -o report")
def report(
    files: LogsArgument,
    folder: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Default: FILE without .mcap.")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Makes the figures, the page and the summary of a log."""
    from ..conclusion import conclude
    from ..results import results_folder

    log = opened(*files)  # before a folder is made for it
    tell_outside_laws(log, needed=False)
    results = results_folder(folder if folder is not None else files[0].with_suffix(""), "", force=force)
    with bar("drawing") as progress:
        conclusion = conclude(log, results, progress)
    show_conclusion(conclusion)
    if not conclusion.agreed:
        raise typer.Exit(1)


def _fail(text: str) -> NoReturn:
    err.print(f"error: {escape(text)}", soft_wrap=True)
    raise typer.Exit(1)
