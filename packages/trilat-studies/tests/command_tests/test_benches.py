"""`trilat bench`: output, files and refusals."""

import csv
import json
import shlex
from pathlib import Path

from tests.cli.running import trilat
from tests.json_outline import is_documented

SOME = (
    "--study",
    "round-trips",
    "--task",
    "contact",
    "--law",
    "p_d",
    "--link",
    "rtt8,rtt68-loss10",
)


def test_part_of_suite_leaves_results_and_resumes(tmp_path: Path) -> None:
    """A benchmark writes its table, page and picture, and a second call changes no result."""
    done = trilat("bench", *SOME, "--seeds", "2", "--jobs", "1", "--json", cwd=tmp_path)
    assert done.code == 0
    assert "note: 2 cells, 3 runs, into runs/bench-round-trips" in done.err
    facts = json.loads(done.out)
    assert is_documented("bench", facts)
    assert [cell["runs"] for cell in facts["places"]] == [1, 2]

    folder = tmp_path / "runs" / "bench-round-trips"
    with (folder / "places.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["error_rad"]) for row in rows] == [
        place["error_rad"] for place in facts["places"]
    ]

    page = (folder / "bench.md").read_text()
    assert f"    trilat bench {shlex.join(SOME)} --seeds 2" in page
    assert "## Delay against loss" in page
    assert (folder / "bench-error.png").stat().st_size > 5000

    before = (folder / "runs.csv").read_bytes()
    again = trilat("bench", *SOME, "--seeds", "2", "--jobs", "1", cwd=tmp_path)
    assert "contact: RMS distance of the slave from its users, rad" in again.out
    assert (folder / "runs.csv").read_bytes() == before


def test_a_cell_is_a_command_that_runs(tmp_path: Path) -> None:
    name = "contact/p_d/rtt68-loss10"
    text = trilat("bench", *SOME, "--seeds", "2", "--cell", name, cwd=tmp_path).succeeds()
    lines = text.splitlines()
    assert len(lines) == 2
    short = lines[1].replace("duration_s=20", "duration_s=0.1")
    trilat(*shlex.split(short)[1:], cwd=tmp_path).succeeds()
    assert (tmp_path / "contact-p_d-rtt68-loss10-2.mcap").exists()
