"""`trilat sim`: runs a scenario in virtual time into a log."""

from pathlib import Path
from typing import Annotated

import typer

from ..process import Interrupt
from ..reporting import terminal_output as terminal
from . import options


def sim_command(
    scenario: options.ScenarioArgument,
    output: Annotated[Path | None, options.value("-o --out --output", "FILE", "Default: NAME.mcap.")] = None,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
    views: options.ViewsOption = "100",
    force: options.ForceOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Runs an experiment in virtual time, and writes the same kind of log as a live session."""
    from ..execution.virtual import record_virtual
    from ..log.ros2.viz_channels import parse_viz_rate

    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    path = output if output is not None else Path(f"{chosen.name}.mcap")
    views_hz = parse_viz_rate(views)
    with Interrupt(compiles=True) as interrupt:
        within = record_virtual(chosen, path, force=force, stopped=interrupt.requested, views_hz=views_hz)
    if interrupt.requested():
        terminal.err.print(f"interrupted; {path} holds the records so far", markup=False, soft_wrap=True)
        raise typer.Exit(interrupt.exit_code)
    if as_json:
        from ..log.log_reader import open_log

        terminal.print_json(open_log(path).to_dict())
    else:
        terminal.print_text(f"{path}: {chosen.duration_s:g} s of {', '.join(chosen.names)}")
    if not within:
        chains = any(spec.arm.urdf for spec in chosen.sites.values())
        terminal.print_error(
            f"{path}: the run diverged: a joint passed its qd_limit_rad_s, and the run ended there"
            + ("; a urdf states such limits, and limits.qd_limit_rad_s others" if chains else "")
        )
        raise typer.Exit(1)
