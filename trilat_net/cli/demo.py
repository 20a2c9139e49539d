"""`trilat demo`: runs a scenario live on this machine, a process per site and recorder, and reports."""

import typer

from ..reporting import terminal_output as terminal
from . import options


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
    from sites.demo_session import run_demo
    from sites.monitor import SessionDisplay

    from ..files import make_results_folder

    chosen = options.load_chosen_scenario(scenario, overrides, duration, seed)
    results = make_results_folder(folder, chosen.name, force=force)
    with terminal.lines_aside(as_json):
        terminal.print_text(chosen.title or chosen.name)
        members = f"{', '.join(chosen.names)} and a recorder, session {chosen.name}"
        terminal.print_text(f"{chosen.duration_s:g} s live: {members}; Ctrl-C ends it")
        with SessionDisplay(chosen, terminal.out) as display:
            outcome = run_demo(chosen, results, display)
    for problem in outcome.problems:
        terminal.print_error(problem)
    if outcome.interrupted:
        kept = f"; {outcome.log} holds what there was" if outcome.log.exists() else ""
        terminal.err.print(f"interrupted{kept}", markup=False, soft_wrap=True)
        raise typer.Exit(128 + outcome.interrupted)
    if not outcome.log.exists():
        raise typer.Exit(outcome.exit_code)
    _, conclusion = terminal.conclude_files([outcome.log], results, as_json=as_json, png=png)
    if outcome.problems or not conclusion.passed:
        raise typer.Exit(outcome.exit_code)
