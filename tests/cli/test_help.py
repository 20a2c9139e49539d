import re

import pytest
from typer.testing import CliRunner

from tests.golden.surface import all_options
from trilat_net.cli import app

NAMES = [name.removeprefix("trilat ") for name in list(all_options())[1:]]
COMMANDS = [
    name.split() for name in NAMES if not any(other.startswith(f"{name} ") for other in NAMES)
]


def printed(*arguments: str) -> str:
    result = CliRunner().invoke(
        app, list(arguments), env={"NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "200"}
    )
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_every_command_has_help_with_example_and_explains_its_options(
    command: list[str],
) -> None:
    text = printed(*command, "-h")
    assert text == printed(*command, "--help")
    assert re.search(f"Example: trilat {'.* '.join(command)}", text)
    for line in text.splitlines():
        option = re.match(r"[│| ]*(--[a-z-]+)", line)
        if option and "--install" not in line and "--show" not in line:
            assert re.search(r"[a-z]{3,}[ :,]", line.split(option[1], 1)[1], re.IGNORECASE), (
                line
            )
    if command[-1] in ("demo", "site", "sim", "test", "sweep", "show", "check") and command[
        0
    ] not in (
        "log",
        "experiment",
    ):
        # whatever takes a scenario takes overrides; a protocol has its own
        assert "--set" in text


def test_the_main_help_names_what_to_begin_with() -> None:
    assert "trilat demo paper" in printed("--help")
