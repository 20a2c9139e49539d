"""The lab sheet: what it runs goes through, shortened."""

import re
import shlex
from pathlib import Path

import pytest

import trilat_net
from tests.cli.running import trilat

SHEET = (Path(__file__).parents[1] / "docs" / "lab.md").read_text()
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
        elif command in ("certify", "metrics"):
            assert rest[0] in logs
            assert trilat(command, *rest, cwd=tmp_path).code in (0, 1)
        elif command == "report":
            assert rest[0] in logs
        elif command == "scenario":
            trilat(command, *rest, cwd=tmp_path).succeeds()
    trilat("report", "free.mcap", cwd=tmp_path).succeeds()


@pytest.mark.parametrize("words", [w for w in COMMANDS if w[1] == "test"], ids=shlex.join)
def test_every_trial_is_of_a_scenario_that_expects_something(words: list[str]) -> None:
    source, *options = words[2:]
    changes = options[1::2]
    assert options[::2] == ["--set"] * len(changes)
    (trial,) = trilat_net.trials(source, set=changes)
    assert trial.scenario.expect.windows or trial.scenario.expect.has_expectations
