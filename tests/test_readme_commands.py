"""The list of commands that `.ci/readme` runs covers README.md's table and docs/commands.md."""

import re
import shlex
from pathlib import Path

from tests.cli.running import trilat
from tests.documentation import ROOT, find_blocks
from tests.golden.surface import all_options
from tests.readme_commands import (
    list_all,
    list_missing_commands,
    list_unlike_commands,
    read_listed_commands,
    read_wishes,
)


def list_commands() -> set[str]:
    """Returns all commands of the program, as in "log info"."""
    names = [name.removeprefix("trilat ") for name in all_options() if name != "trilat"]
    return {name for name in names if not any(other.startswith(f"{name} ") for other in names)}


def test_every_command_of_the_page_is_run() -> None:
    assert len(read_listed_commands()) > 40
    assert list_missing_commands(list_commands()) == set()


def test_every_command_of_the_readme_is_run() -> None:
    assert len(read_wishes()) == 8
    assert list_unlike_commands() == []


def test_the_readme_shows_its_first_judgement(tmp_path: Path) -> None:
    (readme_output,) = (block.text for block in find_blocks("README.md") if not block.language)
    trilat("sim", "two_people", "-o", "run.mcap", cwd=tmp_path).succeeds()
    printed = trilat("certify", "run.mcap", cwd=tmp_path).succeeds().splitlines()
    assert printed[0] == readme_output.strip()
    assert len([line for line in printed if line.startswith(("ok ", "note "))]) == 9
    page = (ROOT / "docs/tutorials/first-result.md").read_text(encoding="utf-8")
    explained = re.findall(r"^\| `(.+?)` \|", page, re.MULTILINE)
    assert len(explained) == 9
    for line, explanation in zip(printed, explained, strict=False):
        assert line.partition(" ")[2].strip().startswith(explanation)


def test_the_page_lists_nearly_every_command() -> None:
    named = read_listed_commands()
    absent = {
        command
        for command in list_commands()
        if command not in named and not any(command.startswith(f"{name} ") for name in named)
    }
    assert absent == {"hand", "identify hand", "ros2", "trace import"}


def test_options_of_these_commands_exist() -> None:
    options = all_options()
    for command in list_all():
        arguments = shlex.split(command)
        if arguments[0] != "trilat":
            continue
        name = max(
            (option for option in options if " ".join(arguments).startswith(option)), key=len
        )
        if name == "trilat set":
            continue  # the options of its commands follow their words
        unknown = {word.partition("=")[0] for word in arguments if word.startswith("-")} - {
            *options[name]
        }
        assert not {word for word in unknown if not word.startswith("--no-")}, command
