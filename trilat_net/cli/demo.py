"""`trilat demo`: runs a scenario live on this machine, a process per site and recorder, and reports."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from ..reporting.terminal_output import err, open_with_progress, out, print_conclusion, progress_bar
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
        Path | None, typer.Option("--out", metavar="DIR", help="Where results go; default runs/NAME-N.")
    ] = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
    force: ForceOption = False,
) -> None:
    """Runs a scenario live: every site and a recorder as processes over Zenoh, then verifies and reports."""
    from sites.demo_session import demo_session_name, run_demo
    from sites.monitor import SessionDisplay

    from ..files import make_results_folder
    from ..reporting.conclude import conclude

    chosen = load_chosen_scenario(scenario, overrides, duration, seed)
    results = make_results_folder(folder, chosen.name, force=force)
    out.print(f"{escape(chosen.title or chosen.name)}")
    out.print(
        f"{chosen.duration_s:g} s live: {', '.join(chosen.names)} and a recorder, "
        f"session {demo_session_name(chosen)}; Ctrl-C ends it"
    )
    with SessionDisplay(chosen, out) as display:
        outcome = run_demo(chosen, results, display)
    for problem in outcome.problems:
        err.print(f"error: {escape(problem)}", soft_wrap=True)
    if outcome.interrupted:
        kept = f"; {outcome.log} holds what there was" if outcome.log.exists() else ""
        err.print(f"interrupted{escape(kept)}", soft_wrap=True)
        raise typer.Exit(128 + outcome.interrupted)
    if not outcome.log.exists():
        raise typer.Exit(1)
    out.print("checking the log and drawing ...")
    log = open_with_progress(outcome.log)
    with progress_bar("executing and drawing") as progress:
        conclusion = conclude(log, results, progress)
    print_conclusion(conclusion)
    if outcome.problems or not conclusion.passed:
        raise typer.Exit(1)
