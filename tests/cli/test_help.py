import re

import pytest
import typer
from typer.testing import CliRunner

from trilat_net.cli import app

COMMANDS = [
    ["demo"], ["site"], ["record"], ["ping"], ["router"], ["sim"], ["test"], ["sweep"], ["linear"], ["rerun"],
    ["verify"], ["report"], ["replay"], ["certify"], ["metrics"], ["compare"], ["figure"],
    ["log", "info"], ["log", "check"], ["log", "recover"], ["log", "export"], ["log", "view"],
    ["set", "link"], ["set", "dominance"],
    ["scenario", "list"], ["scenario", "show"], ["scenario", "check"], ["scenario", "new"],
]  # fmt: skip

GROUPS = ("scenario", "set", "log")


def printed(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments), env={"NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_an_example_and_explains_its_options(command: list[str]) -> None:
    text = printed(*command, "-h")
    assert text == printed(*command, "--help")
    assert re.search(f"Example: trilat {'.* '.join(command)}", text)
    for line in text.splitlines():
        option = re.match(r"[│| ]*(--[a-z-]+)", line)
        if option and "--install" not in line and "--show" not in line:
            assert re.search(r"[a-z]{3,}[ :,]", line.split(option[1], 1)[1], re.IGNORECASE), line
    if command[-1] in ("demo", "site", "sim", "test", "sweep", "show", "check") and command[0] != "log":
        assert "--set" in text  # whatever takes a scenario takes overrides


def test_these_are_all_the_commands() -> None:
    root = typer.main.get_command(app)
    named = {
        (*path, name)
        for path, group in (((), root), *(((name,), root.commands[name]) for name in GROUPS))
        for name in group.commands
        if name not in GROUPS
    }
    assert named == {tuple(command) for command in COMMANDS}


def test_the_main_help_names_what_to_begin_with() -> None:
    assert "trilat demo paper" in printed("--help")
