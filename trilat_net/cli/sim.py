"""`trilat sim`: runs a scenario in virtual time into a log."""

from pathlib import Path
from typing import Annotated

import typer

from ..process import Interrupt
from ..reporting.terminal_output import err, print_error, print_text
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
        err.print(f"interrupted; {path} holds the records so far", markup=False, soft_wrap=True)
        raise typer.Exit(interrupt.exit_code)
    print_text(f"{path}: {chosen.duration_s:g} s of {', '.join(chosen.names)}")
    if not within:
        print_error(f"{path}: the run diverged: a joint passed its qd_limit_rad_s, and the run ended there")
        raise typer.Exit(1)
