"""The lab sheet: its commands run, shortened."""

import re
import shlex
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import trilat_net
from tests.cli.running import trilat
from trilat_net.analysis.theory import iterate_linear_edges

SHEET = (Path(__file__).parents[1] / "docs" / "tutorials" / "lab.md").read_text()
BLOCKS = re.findall(r"^```sh\n(.*?)^```", SHEET, re.S | re.M)
COMMANDS = [
    shlex.split(line)
    for block in BLOCKS
    for line in block.replace("\\\n", " ").splitlines()
    if line.strip()
]
SHORT_S = "0.2"


@pytest.mark.long
def test_every_experiment_of_the_lab_runs(tmp_path: Path) -> None:
    logs = set()
    for _, command, *rest in COMMANDS:
        if command == "sim":
            if "--duration" in rest:
                del rest[(n := rest.index("--duration")) : n + 2]
            trilat(command, *rest, "--duration", SHORT_S, cwd=tmp_path).succeeds()
            logs.add(rest[rest.index("-o") + 1])
        elif command in ("certify", "metrics", "compare"):
            assert logs.issuperset(word for word in rest if word.endswith(".mcap"))
            assert trilat(command, *rest, cwd=tmp_path).code in (0, 1)
        elif command == "report":
            assert rest[0] in logs
        elif command == "scenario":
            trilat(command, *rest, cwd=tmp_path).succeeds()
    trilat("report", "free.mcap", cwd=tmp_path).succeeds()


def test_no_command_reveals_results_before_predictions() -> None:
    """`test` prints the limits that a scenario expects, and `show` and `list` print its text,
    which contains them.
    """
    named = {tuple(command[1:3]) for command in COMMANDS}
    assert not {command for command in named if command[0] == "test"}
    assert not {("scenario", "show"), ("scenario", "list")} & named


@pytest.mark.long
def test_jitter_verdicts_are_those_of_the_key(tmp_path: Path) -> None:
    (block,) = (block for block in BLOCKS if "sim jitter -o jitter.mcap" in block)
    verdicts = []
    for _, command, *rest in map(shlex.split, block.splitlines()):
        if command == "sim":
            trilat(command, *rest, cwd=tmp_path)
            log = rest[rest.index("-o") + 1]
            first_line = trilat("certify", log, cwd=tmp_path).out.splitlines()[0]
            verdicts.append(re.split(r"[;,]| m\d", first_line)[0])
    assert verdicts == [
        "ok   settled: decaying",
        "FAIL not stable: growing",
        "FAIL not stable: diverged:",
        "FAIL not stable: diverged:",
        "open hardly decaying",
    ]


ANSWERS = (Path(__file__).parents[1] / "docs" / "tutorials" / "lab-answers.md").read_text()


def read_groups() -> list[list[float]]:
    """Runs the lecturer's code: per group its number, K, T in ms, a, 1 - a, and three margins."""
    (code,) = re.findall(r"^```python\n(.*?)^```", ANSWERS, re.S | re.M)
    stream = StringIO()
    with redirect_stdout(stream):
        exec(code, {})
    return [list(map(float, line.split())) for line in stream.getvalue().splitlines()[1:]]


def list_dominance(a: float) -> dict[str, dict[str, float]]:
    rest = round(1.0 - a, 2)
    return {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": a, "s": rest}, "s": {"m1": a, "m2": rest}}


def test_each_groups_key_is_its_eigenvalue_bound() -> None:
    groups = read_groups()
    assert len({tuple(group[1:4]) for group in groups}) == 15
    for _, K, T_ms, a, rest, three, two, unequal in groups:
        alpha = np.array([[0.0, 0.1, 0.9], [a, 0.0, rest], [a, rest, 0.0]])
        np.testing.assert_allclose(alpha.sum(axis=1), 1.0)
        for matrix, margin in (
            ((np.ones((3, 3)) - np.eye(3)) / 2.0, three),
            (np.ones((2, 2)) - np.eye(2), two),
            (alpha, unequal),
        ):
            least = np.linalg.eigvals(matrix).real.min()
            assert margin == pytest.approx(-least * K * T_ms / 1000.0, abs=6e-4)


def test_no_command_needs_a_unix_shell() -> None:
    """PowerShell and `cmd` know neither a backslash at the end of a line, nor quotes of `cmd` like '."""
    for block in BLOCKS:
        assert "\\\n" not in block
        assert "'" not in block


@pytest.mark.long
@pytest.mark.parametrize("group", [1, 5, 14, 15])
def test_predictions_lie_within_10_percent_of_edges(group: int) -> None:
    """The commands are those under "check yourself", about the rest of a run with d = 5."""
    _, K, T_ms, a, _, *margins = read_groups()[group - 1]
    checks = [arguments for arguments in COMMANDS if arguments[1] == "linear"]
    assert len(checks) == 3
    for arguments, predicted in zip(checks, margins, strict=True):
        keys: dict[str, Any] = {"control.K": K, "link.delay_ms": T_ms, "control.d": 5.0}
        assert {"control.d=5", "control.d=0.1:5"} <= set(arguments)
        if any(word.startswith("dominance") for word in arguments):
            keys["dominance"] = list_dominance(a)
        loaded = trilat_net.load_scenario(arguments[2], keys)
        edges = [edge.value for edge in iterate_linear_edges(loaded, "control.d", 0.1, 5.0)]
        assert len(edges) == 1
        assert edges[0] <= predicted <= 1.1 * edges[0]
