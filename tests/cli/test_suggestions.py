"""Suggestions for mistaken input: commands for their synonyms, and keys with their table."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.cli.running import build_command
from trilat_net.app.cli import _SUBJECTS, _SYNONYMS
from trilat_net.errors import find_nearest, join_arguments, suggest_nearest

from .running import trilat

ROOT = Path(__file__).resolve().parents[2]


def in_one_line(text: str) -> str:
    return " ".join(re.sub("[│╭╮╰╯─]", " ", text).split())


@pytest.mark.parametrize(
    ("arguments", "suggestion"),
    [
        (["simulate", "paper"], "trilat sim?"),
        (["run"], "trilat sim or trilat demo?"),
        (["Plot", "run.mcap"], "trilat figure?"),
        (["analyse"], "trilat certify or trilat metrics?"),
        (["stable"], "trilat certify?"),
        (["verfy"], "trilat verify?"),
        (["log", "inf"], "trilat log info?"),
        (["keys", "make"], "trilat keys new?"),
        (["set", "--session", "x", "delay"], "trilat set link?"),
    ],
)
def test_an_unknown_command_suggests_one(
    arguments: list[str], suggestion: str, tmp_path: Path
) -> None:
    done = trilat(*arguments, cwd=tmp_path)
    assert done.code == 2
    assert f"did you mean {suggestion}" in in_one_line(done.err)


def test_subjects_without_command_lead_to_pages(tmp_path: Path) -> None:
    text = in_one_line(trilat("lerobot", cwd=tmp_path).err)
    assert "trilat log export FILE --to lerobot" in text
    commands = build_command().commands
    for subject, hint in _SUBJECTS.items():
        assert subject not in {*commands, *_SYNONYMS["trilat"]}
        pages = re.findall(r"\((docs/.+?)\)", hint)
        assert pages
        assert all((ROOT / page).is_file() for page in pages)


def test_an_unrelated_word_lists_all_commands(tmp_path: Path) -> None:
    text = in_one_line(trilat("log", "zzzzzz", cwd=tmp_path).err)
    assert "trilat log has the commands info" in text


def test_every_synonym_leads_to_a_command() -> None:
    root = build_command()
    for group, synonyms in _SYNONYMS.items():
        holder = root if group == "trilat" else root.commands[group]
        for word, suggested in synonyms.items():
            assert word not in holder.commands
            for path in suggested.split(" or trilat "):
                if path.startswith("--"):
                    continue
                command = holder
                for name in path.split():
                    if hasattr(command, "commands"):
                        command = command.commands[name]


@pytest.mark.parametrize(
    "setting",
    [
        "dominance.m1={m2=0.1,s=0.9}",
        "sites.m1.q0_rad=[0.1, 0.2]",
        "dominance.m1={ m2 = 0.1, s = 0.9 }",
    ],
)
@pytest.mark.parametrize("command", ["sim", "linear"])
def test_a_setting_split_by_the_shell_needs_quotes(
    setting: str, command: str, tmp_path: Path
) -> None:
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("needs a shell that expands braces")
    line = f"printf '%s\\n' --set {setting}"
    shell = subprocess.run([bash, "-c", line], capture_output=True, text=True, check=True)
    arguments = shell.stdout.splitlines()
    assert len(arguments) > 2
    said = in_one_line(trilat(command, "paper", *arguments, cwd=tmp_path).err)
    quoted = join_arguments(["--set", setting])
    assert f"put it into quotes, as in {quoted}" in said
    said = trilat(command, "paper", "--set", setting, "--absent", cwd=tmp_path).err
    assert "put it into quotes" not in in_one_line(said)


@pytest.mark.parametrize(
    "arguments",
    [
        ["--set", "control.Kd=5", "--set", "control.Kp=1"],
        ["--set", "control.Kd=[3, 4]", "free"],
        ["--set", "sites.m1.hands=[]"],
        ["--set"],
        ["--set", "no form"],
    ],
)
def test_whole_settings_need_no_quotes(arguments: list[str], tmp_path: Path) -> None:
    said = trilat("sim", "paper", "--absent", *arguments, cwd=tmp_path).err
    assert "put it into quotes" not in in_one_line(said)


def test_faint_similarity_suggests_nothing() -> None:
    assert suggest_nearest("foo", ["name", "seed"], ["control.follows"]) == ""
    assert find_nearest("x" * 81, ["x" * 81]) == ""


SUM_OF_NOTHING = """
class Torques:
    def __init__(self, facts):
        pass

    def torque(self, now):
        return [sum_of_nothing for _ in now.q]
"""


def test_a_failing_law_is_reported_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "torques.py").write_text(SUM_OF_NOTHING, "utf-8")
    arguments = ("sim", "two_sites", "--set", "control.law=torques:Torques", "-o", "run.mcap")
    said = trilat(*arguments, "--duration", "0.1", cwd=tmp_path).err
    line = (
        SUM_OF_NOTHING.splitlines().index("        return [sum_of_nothing for _ in now.q]") + 1
    )
    assert f"'sum_of_nothing' is not defined (torques.py, line {line})" in said


def test_the_next_command_permits_the_law_that_ran(tmp_path: Path) -> None:
    text = SUM_OF_NOTHING.replace("sum_of_nothing", "0.0")
    (tmp_path / "torques.py").write_text(text, "utf-8")
    arguments = ("sim", "two_sites", "--set", "control.law=torques:Torques", "-o", "run.mcap")
    output = trilat(*arguments, "--duration", "0.1", cwd=tmp_path).succeeds()
    (law,) = re.findall(r"next: trilat report run\.mcap --law (\S+)", output)
    judged = trilat("verify", "run.mcap", "--law", law, cwd=tmp_path).out
    assert "200/200 records identical" in judged
