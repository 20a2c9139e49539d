"""`trilat scenario`: list, show, check, new."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options


def scenario_list_command(as_json: options.JsonOption = False) -> None:
    """Lists the shipped scenarios."""
    from ..scenario import list_shipped, load_scenario

    chosen = [(name, load_scenario(name)) for name in list_shipped()]
    if as_json:
        facts = [
            {"name": name, "sites": one.names, "duration_s": one.duration_s, "title": one.title}
            for name, one in chosen
        ]
        return terminal.print_json(facts)
    rows = [(name, str(len(one.names)), f"{one.duration_s:g} s", one.title) for name, one in chosen]
    return terminal.print_table(TextTable(("name", "sites", "time", "what it is"), rows, align="lrrl"))


def scenario_show_command(
    name: options.ScenarioArgument,
    duration: options.DurationOption = None,
    seed: options.SeedOption = None,
    overrides: options.SetOption = None,
) -> None:
    """Prints the resolved text of a scenario: every value of every site and link."""
    sys.stdout.write(options.load_chosen_scenario(name, overrides, duration, seed).text)


def scenario_check_command(
    file: options.ScenarioArgument,
    overrides: options.SetOption = None,
    as_json: options.JsonOption = False,
) -> None:
    """Checks a scenario, and prints what follows from it."""
    from ..scenario.describe import describe_scenario
    from ..scenario.validate import check_outside_arms

    scenario = options.load_chosen_scenario(file, overrides, None, None)
    check_outside_arms(scenario)
    lines = describe_scenario(scenario)
    if as_json:
        facts = {"name": scenario.name, "sha256": scenario.sha256, "consequences": lines}
        return terminal.print_json(facts)
    for line in lines:
        terminal.print_text(line)
    return None


def scenario_new_command(
    file: Annotated[Path, typer.Argument(help="File to write.")], force: options.ForceOption = False
) -> None:
    """Writes a commented template, with the unit of every key."""
    from ..files import write_whole
    from ..scenario import read_template

    write_whole(file, read_template(), force=force)
    terminal.print_text(f"{file}: a template; check it with: trilat scenario check {file}")
