"""The lab sheet: what it runs goes through, shortened."""

import re
import shlex
from pathlib import Path

import pytest

import trilat_net
from tests.cli.running import trilat
from trilat_net.analysis.theory import iterate_linear_edges

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


def test_no_command_of_the_sheet_tells_results_before_they_are_predicted() -> None:
    """`test` prints the limits that a scenario expects, and `show` and `list` print its text, which tells them."""
    named = {tuple(words[1:3]) for words in COMMANDS}
    assert not {words for words in named if words[0] == "test"}
    assert not {("scenario", "show"), ("scenario", "list")} & named


@pytest.mark.long
@pytest.mark.parametrize("k_nm_rad", [7.0, 21.0])
@pytest.mark.parametrize(("scenario", "sites"), [("p_d_margin", 3), ("p_d_margin_two", 2)])
def test_every_group_finds_its_prediction_at_most_10_percent_above_the_edge(
    scenario: str, sites: int, k_nm_rad: float
) -> None:
    """The least eigenvalue of equal factors is -1 / (sites - 1); links have 200 ms."""
    predicted = k_nm_rad * 0.2 / (sites - 1)
    loaded = trilat_net.load_scenario(scenario, {"control.K": k_nm_rad})
    edges = [edge.value for edge in iterate_linear_edges(loaded, "control.d", 0.1, 10.0)]
    assert len(edges) == 1
    assert edges[0] <= predicted <= 1.1 * edges[0]
