"""Commands that make a log in virtual time, or look into one: sim, verify, report."""

from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.markup import escape

from ..interrupt import Interrupt
from .options import (
    DurationOption,
    ForceOption,
    LogArgument,
    ScenarioArgument,
    SeedOption,
    SetOption,
    chosen_scenario,
    err,
    out,
)
from .show import show_conclusion

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
    force: ForceOption = False,
) -> None:
    """Runs the same experiment in virtual time, into the same kind of log."""
    from ..experiment import record_virtual

    chosen = chosen_scenario(scenario, overrides, duration, seed)
    path = output if output is not None else Path(f"{chosen.name}.mcap")
    with Interrupt() as interrupt:
        within = record_virtual(chosen, path, force=force, stopped=interrupt.requested)
    if interrupt.requested():
        err.print(f"interrupted; {escape(str(path))} holds what there was", soft_wrap=True)
        raise typer.Exit(interrupt.exit_code)
    out.print(f"{escape(str(path))}: {chosen.duration_s:g} s of {', '.join(chosen.names)}")
    if not within:
        _fail(f"{path}: the run diverged: a joint passed its qd_limit_rad_s, and the run ended there")


@app.command(epilog="Example: trilat verify run.mcap")
def verify(
    file: LogArgument,
    virtual: Annotated[
        bool, typer.Option("--virtual", help="Compare with virtual time as well, with and without arrivals.")
    ] = False,
) -> None:
    """Executes every site again from a log, and compares every computed field of every record."""
    from ..analysis.notes import run_lines
    from ..conclusion import check_lines
    from ..experiment import open_log

    log = open_log(file)
    passed = True
    for line in check_lines(log, virtual=virtual):
        passed &= line.passed
        (out if line.passed else err).print(escape(f"{line.label}: {line.text}"), soft_wrap=True)
    if not passed:
        raise typer.Exit(1)
    for note in run_lines(log):
        out.print(escape(note), soft_wrap=True)


@app.command(epilog="Example: trilat report run.mcap -o report")
def report(
    file: LogArgument,
    folder: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="DIR", help="Default: FILE without .mcap.")
    ] = None,
    force: ForceOption = False,
) -> None:
    """Makes the figures, the page and the summary of a log."""
    from ..conclusion import conclude, results_folder
    from ..experiment import open_log

    log = open_log(file)  # before a folder is made for it
    results = results_folder(folder if folder is not None else file.with_suffix(""), "", force=force)
    conclusion = conclude(log, results)
    show_conclusion(conclusion)
    if not conclusion.agreed:
        raise typer.Exit(1)


def _fail(text: str) -> NoReturn:
    err.print(f"error: {escape(text)}", soft_wrap=True)
    raise typer.Exit(1)
