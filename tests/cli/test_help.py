import inspect
import re
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer.main
from trilat_studies.tuning.search_space import SEARCH_SPACES
from typer.testing import CliRunner

from tests.cli.running import simulate_by_command
from tests.golden.surface import all_options
from trilat_net.app.cli import app
from trilat_net.app.cli.options import list_laws
from trilat_net.presentation.exports import list_export_formats

from .running import trilat

ROOT = Path(__file__).parents[2]
PANELS = {
    "Start here": "demo live sim",
    "Analyse a log": "report verify certify metrics figure compare log twin rerun replay",
    "Study": "sweep tune linear bench experiment test",
    "Control a running session": "watch stop enable reset set ping",
    "Machines and bridges": "site record hand router keys ros2 doctor",
    "Make your own": "new scenario trace identify",
}
"""The panels of `trilat --help`, and their commands in order."""

NAMES = [name.removeprefix("trilat ") for name in list(all_options())[1:]]
GROUPS = [name for name in NAMES if any(other.startswith(f"{name} ") for other in NAMES)]
COMMANDS = [
    name.split() for name in NAMES if not any(other.startswith(f"{name} ") for other in NAMES)
]


@cache
def print_help(*arguments: str) -> str:
    result = CliRunner().invoke(
        app, list(arguments), env={"NO_COLOR": "1", "TERM": "dumb", "COLUMNS": "200"}
    )
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_commands_have_help_examples_and_explained_options(
    command: list[str],
) -> None:
    text = print_help(*command, "-h")
    assert text == print_help(*command, "--help")
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


def test_the_main_help_names_first_steps() -> None:
    assert "Start with: trilat live play" in print_help("--help")


def test_the_main_help_has_six_panels() -> None:
    panels: dict[str, list[str]] = {}
    for line in print_help("--help").splitlines():
        if title := re.match(r"╭─ (.+?) ─+╮", line):
            panels[title[1]] = []
        elif command := re.match(r"│ ([a-z]\S*) ", line):
            panels[list(panels)[-1]].append(command[1])
    assert panels.pop("Options") == []
    assert panels == {title: names.split() for title, names in PANELS.items()}
    assert {name for names in panels.values() for name in names} == {
        name.split()[0] for name in NAMES
    }


@pytest.mark.parametrize("name", sorted({name.split()[0] for name in NAMES}))
def test_purposes_fit_one_line_of_main_help(name: str) -> None:
    (line,) = re.findall(rf"^│ {name} +(.+?) +│$", print_help("--help"), re.MULTILINE)
    assert len(line) <= 64
    assert re.fullmatch(r"[A-Z].*[.?]", line)
    assert ". " not in line


@pytest.mark.parametrize("command", [*map(" ".join, COMMANDS), *GROUPS])
def test_help_ends_with_an_example_and_page(command: str) -> None:
    *_, example, page = (
        line for line in print_help(*command.split(), "-h").splitlines() if line.strip()
    )
    assert example.split()[0] == "Example:"
    assert page.startswith(" Docs: ")
    names = page.removeprefix(" Docs: ").strip().split(", ")
    assert all((ROOT / name).is_file() for name in names), page


@pytest.mark.parametrize("command", [*map(" ".join, COMMANDS), *GROUPS])
def test_help_starts_with_one_sentence(command: str) -> None:
    command_found: Any = typer.main.get_command(app)
    for word in command.split():
        command_found = command_found.commands[word]
    purpose = command_found.help.split("\n\n")[0]
    assert re.fullmatch(r"[A-Z][^\n]*[.?]", purpose)
    assert not re.search(r"[.?] [A-Z]", purpose)


def test_help_lists_all_tunable_laws() -> None:
    listed = {*list_laws(), "known"}
    assert listed == set(SEARCH_SPACES)
    text = " ".join(re.sub("[│|]", " ", print_help("compare", "--help")).split())
    assert all(re.search(rf"\b{law}\b", text) for law in listed)


def test_only_folder_commands_offer_folders_of_logs(tmp_path: Path) -> None:
    """The other commands name the logs in the folder."""
    simulate_by_command(tmp_path, "paper", seconds="0.05")
    (tmp_path / "logs").mkdir()
    (tmp_path / "run.mcap").rename(tmp_path / "logs" / "one.mcap")
    for command in COMMANDS:
        text = print_help(*command, "--help")
        if "MCAP log" not in text or command[0] in ("record", "identify"):
            continue
        accepts = "folders with MCAP logs" in text
        assert accepts == (command == ["log", "export"])
        key_options = ["--key", "x.key"] if command == ["log", "sign"] else []
        if accepts:
            key_options = ["--to", "csv", "-o", "tables"]
        if command == ["log", "view"]:
            key_options = ["--save", "view.rrd"]
        count = 2 if command == ["compare"] else 1
        done = trilat(*command, *["logs"] * count, *key_options, cwd=tmp_path)
        assert (done.code == 0) == accepts, done
        if not accepts and command != ["log", "sign"]:
            assert "is a folder, not a file" in done.err, (command, done)
            assert str(Path("logs") / "one.mcap") in done.err, (command, done)


def test_export_help_names_every_format_and_setting() -> None:
    text = " ".join(print_help("log", "export", "--help").replace("│", " ").split())
    for form in list_export_formats():
        module = import_module(f"trilat_net.presentation.exports.{form}")
        assert form in text
        for parameter in inspect.signature(module.FORMAT.write).parameters.values():
            if parameter.kind is parameter.KEYWORD_ONLY:
                assert re.search(rf"\b{parameter.name}(=|, as --{parameter.name})", text)
