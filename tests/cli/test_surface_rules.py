"""Rules for every command: results as JSON, outputs by one option, completion, a version."""

import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import trilat_net as tn
from tests.golden.surface import all_options
from tests.json_outline import is_documented

from .running import PLAIN, trilat

OPTIONS = {name: names for name, names in all_options().items() if name != "trilat"}
COMMANDS = [
    name for name in OPTIONS if not any(other.startswith(f"{name} ") for other in OPTIONS)
]
GOLDEN_LOG = Path(__file__).parents[1] / "golden" / "live-paper.mcap"
NO_RESULT = {
    *(
        f"trilat {name}"
        for name in ("site", "hand", "record", "watch", "router", "ros2", "log view")
    ),  # run until they end
    *(
        f"trilat {name}" for name in ("stop", "enable", "reset", "set link", "set dominance")
    ),  # orders
    *(f"trilat new {kind}" for kind in ("law", "hand", "plant")),
    "trilat experiment new",
    *(f"trilat {name}" for name in ("scenario show", "scenario new")),  # files
    *(f"trilat keys {name}" for name in ("new", "add", "renew", "pair")),
}
"""Commands that print what they do, and find nothing."""


def test_every_command_with_results_prints_json() -> None:
    assert {name for name in COMMANDS if "--json" not in OPTIONS[name]} == NO_RESULT


def test_outputs_have_one_option_name() -> None:
    for name, names in OPTIONS.items():
        output_options = {"-o", "--out", "--output"} & set(names)
        assert not output_options or output_options >= {"-o", "--out"}, name


def test_the_version_is_that_of_the_package() -> None:
    assert trilat("--version", cwd=Path()).succeeds() == f"trilat-net {version('trilat-net')}\n"
    assert tn.__version__ == version("trilat-net")


@pytest.mark.parametrize(
    ("phrase", "completions"),
    [
        ("sim tw", {"two_people", "two_sites"}),
        ("scenario show p_d", {"p_d_margin", "p_d_margin_two"}),
        pytest.param("figure run.mcap se", {"settling"}, marks=pytest.mark.long),
        ("site --scenario two_sites ", {"m", "s"}),
        pytest.param(
            f"rerun {GOLDEN_LOG} --replace ", {"m1", "m2", "s"}, marks=pytest.mark.long
        ),
        pytest.param(f"twin {GOLDEN_LOG} --push m", {"m1", "m2"}, marks=pytest.mark.long),
    ],
)
def test_shells_complete_commands(phrase: str, completions: set[str]) -> None:
    environment = {
        "_TRILAT_COMPLETE": "complete_fish",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    code = "from trilat_net.app.cli import app; app(prog_name='trilat')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**PLAIN, **environment, "_TYPER_COMPLETE_ARGS": f"trilat {phrase}"},
        capture_output=True,
        text=True,
    )
    assert {line.split("\t")[0] for line in done.stdout.splitlines()} == completions, (
        done.stderr
    )


@pytest.mark.long
def test_created_files_are_named_in_json(tmp_path: Path) -> None:
    facts = json.loads(
        trilat("sim", "two_sites", "--duration", "0.1", "--json", cwd=tmp_path).succeeds()
    )
    assert facts["files"] == ["two_sites.mcap"]
    assert facts["sites"]["m"]["records"] == 100
    command = ("log", "export", "two_sites.mcap", "--to", "npz", "--json")
    assert json.loads(trilat(*command, cwd=tmp_path).succeeds())["records"] == {
        "m": 100,
        "s": 100,
    }
    shipped = json.loads(trilat("scenario", "list", "--json", cwd=tmp_path).succeeds())
    assert {"free", "paper"} < {scenario["name"] for scenario in shipped}
    check_facts = json.loads(
        trilat("scenario", "check", "paper", "--json", cwd=tmp_path).succeeds()
    )
    assert check_facts["sha256"] == tn.load_scenario("paper").sha256
    ran = json.loads(trilat("test", "free", "--jobs", "1", "--json", cwd=tmp_path).out)
    assert ran["held"]
    assert [run["seed"] for run in ran["runs"]] == [1]


@pytest.mark.long
def test_a_sweeps_json_keeps_progress_lines_aside(tmp_path: Path) -> None:
    over = ("--over", "control.d=0.3,3", "--duration", "2", "--jobs", "1", "-o", "grid")
    first = trilat("sweep", "p_d_margin", *over, "--json", cwd=tmp_path)
    again = trilat("sweep", "grid", "--json", cwd=tmp_path)
    assert json.loads(first.out) == json.loads(again.out)
    assert is_documented("sweep", json.loads(again.out))
    assert "2 runs of 2 cells" in first.err
    cell = json.loads(trilat("sweep", "grid", "--cell", "1", "--json", cwd=tmp_path).out)
    assert cell == json.loads(first.out)["runs"][1:]
