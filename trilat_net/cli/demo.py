"""`trilat demo`: runs a scenario live on this machine, a process per site and recorder, and reports."""

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ..reporting import terminal_output as terminal
from . import options

if TYPE_CHECKING:
    from sites.demo_session import SessionAttendant

    from ..scenario import Scenario


def demo_command(
    scenario: options.ScenarioArgument = "paper",
    duration: options.DurationOption = None,
    folder: options.ResultsOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
    force: options.ForceOption = False,
    png: options.PngOption = False,
    as_json: options.JsonOption = False,
) -> None:
    """Runs a scenario live over Zenoh, a process per site and a recorder; then verifies and reports."""
    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    run_and_report(chosen, folder, force=force, png=png, as_json=as_json)


def run_and_report(
    chosen: "Scenario",
    folder: Path | None,
    attend: "SessionAttendant | None" = None,
    *,
    force: bool,
    png: bool,
    as_json: bool,
) -> None:
    """Runs a scenario live, then verifies and reports; what `attend` yields may end it as planned."""
    from sites.demo_session import run_demo

    from ..files import make_results_folder

    results = make_results_folder(folder, chosen.name, force=force)
    with terminal.lines_aside(as_json):
        terminal.print_text(chosen.title or chosen.name)
        members = f"{', '.join(chosen.names)} and a recorder, session {chosen.name}"
        terminal.print_text(f"{chosen.duration_s:g} s live: {members}; Ctrl-C ends it")
        outcome = run_demo(chosen, results, terminal.out, attend)
    for problem in outcome.problems:
        terminal.print_error(problem)
    there = outcome.log.exists()
    if outcome.interrupted and not (attend and there):
        kept = f"; {outcome.log} holds what there was" if there else ""
        terminal.err.print(f"interrupted{kept}", markup=False, soft_wrap=True)
        raise typer.Exit(128 + outcome.interrupted)
    if not there:
        raise typer.Exit(outcome.exit_code)
    _, conclusion = terminal.conclude_files([outcome.log], results, as_json=as_json, png=png)
    if outcome.problems or not conclusion.passed:
        raise typer.Exit(outcome.exit_code)
