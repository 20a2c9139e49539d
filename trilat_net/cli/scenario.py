"""`trilat scenario`: list, show, check, new."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from ..reporting.terminal_output import print_table, print_text
from ..reporting.text_table import TextTable
from .options import (
    DurationOption,
    ForceOption,
    ScenarioArgument,
    SeedOption,
    SetOption,
    load_chosen_scenario,
)

app = typer.Typer(no_args_is_help=True, help="The shipped scenarios and your own.")


@app.command("list", epilog="Example: trilat scenario list")
def scenario_list_command() -> None:
    """Lists the shipped scenarios."""
    from ..scenario import list_shipped, load_scenario

    chosen = [(name, load_scenario(name)) for name in list_shipped()]
    rows = [(name, str(len(one.names)), f"{one.duration_s:g} s", one.title) for name, one in chosen]
    print_table(TextTable(("name", "sites", "time", "what it is"), rows, align="lrrl"))


@app.command("show", epilog="Example: trilat scenario show paper --set control.Kd=5")
def scenario_show_command(
    name: ScenarioArgument,
    duration: DurationOption = None,
    seed: SeedOption = None,
    overrides: SetOption = None,
) -> None:
    """Prints the resolved text of a scenario: every value of every site and link."""
    sys.stdout.write(load_chosen_scenario(name, overrides, duration, seed).text)


@app.command("check", epilog="Example: trilat scenario check mine.toml")
def scenario_check_command(
    file: ScenarioArgument,
    overrides: SetOption = None,
) -> None:
    """Checks a scenario, and prints its consequences."""
    from ..scenario.describe import describe_scenario

    for line in describe_scenario(load_chosen_scenario(file, overrides, None, None)):
        print_text(line)


@app.command("new", epilog="Example: trilat scenario new mine.toml")
def scenario_new_command(
    file: Annotated[Path, typer.Argument(help="File to write.")], force: ForceOption = False
) -> None:
    """Writes a commented template, with the unit of every key."""
    from ..files import write_whole
    from ..scenario import read_template

    write_whole(file, read_template(), force=force)
    print_text(f"{file}: a template; check it with: trilat scenario check {file}")
