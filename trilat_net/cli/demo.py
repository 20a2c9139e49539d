"""`trilat demo`: runs a scenario live on this machine, a process per site and recorder, and reports."""

from pathlib import Path
from typing import Annotated

import typer

from ..reporting.terminal_output import conclude_files, err, out, print_error, print_text
from .options import (
    DurationOption,
    ForceOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    load_chosen_scenario,
)

app = typer.Typer()


@app.command("demo", epilog="Example: trilat demo paper --duration 10 --set control.Kd=5")
def demo_command(
    scenario: ScenarioArgument = "paper",
    duration: DurationOption = None,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder of the results; default: runs/NAME-N.")
    ] = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Runs a scenario live: each site and a recorder as a process over Zenoh, then verifies and reports."""
    from sites.demo_session import demo_session_name, run_demo
    from sites.monitor import SessionDisplay

    from ..files import make_results_folder

    chosen = load_chosen_scenario(scenario, overrides, duration, seed)
    results = make_results_folder(folder, chosen.name, force=force)
    print_text(chosen.title or chosen.name)
    members = f"{', '.join(chosen.names)} and a recorder, session {demo_session_name(chosen)}"
    print_text(f"{chosen.duration_s:g} s live: {members}; Ctrl-C ends it")
    with SessionDisplay(chosen, out) as display:
        outcome = run_demo(chosen, results, display)
    for problem in outcome.problems:
        print_error(problem)
    if outcome.interrupted:
        kept = f"; {outcome.log} holds what there was" if outcome.log.exists() else ""
        err.print(f"interrupted{kept}", markup=False, soft_wrap=True)
        raise typer.Exit(128 + outcome.interrupted)
    if not outcome.log.exists():
        raise typer.Exit(1)
    _, conclusion = conclude_files([outcome.log], results)
    if outcome.problems or not conclusion.passed:
        raise typer.Exit(1)
