"""`trilat sim`: runs a scenario in virtual time into a log."""

from pathlib import Path
from typing import Annotated, NoReturn

import typer
from rich.markup import escape

from ..process import Interrupt
from ..reporting.terminal_output import err, out
from .options import (
    DurationOption,
    ForceOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    ViewsOption,
    load_chosen_scenario,
)

app = typer.Typer()


@app.command("sim", epilog="Example: trilat sim free -o free.mcap --set link.delay_ms=400")
def sim_command(
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
    from ..execution.virtual import record_virtual
    from ..log.ros2.viz_channels import parse_viz_rate

    chosen = load_chosen_scenario(scenario, overrides, duration, seed)
    path = output if output is not None else Path(f"{chosen.name}.mcap")
    views_hz = parse_viz_rate(views)
    with Interrupt() as interrupt:
        within = record_virtual(chosen, path, force=force, stopped=interrupt.requested, views_hz=views_hz)
    if interrupt.requested():
        err.print(f"interrupted; {escape(str(path))} holds what there was", soft_wrap=True)
        raise typer.Exit(interrupt.exit_code)
    out.print(f"{escape(str(path))}: {chosen.duration_s:g} s of {', '.join(chosen.names)}")
    if not within:
        _fail(f"{path}: the run diverged: a joint passed its qd_limit_rad_s, and the run ended there")


def _fail(text: str) -> NoReturn:
    err.print(f"error: {escape(text)}", soft_wrap=True)
    raise typer.Exit(1)
