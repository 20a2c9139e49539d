"""`trilat sweep` with `--map`, `--margin`, `--cell`: output, files and refusals."""

import json
import re
from pathlib import Path

import pytest
from study_builders import SHORT
from trilat_studies.sweep_command import parse_seed_count

from tests.cli.running import trilat

OVER = ("--over", "link.delay_ms=0:40:20", "--over", "control.Kd=1:4:1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scenario and a finished sweep of twelve cells, with its map."""
    path = tmp_path_factory.mktemp("sweeps")
    (path / "trio.toml").write_text(SHORT)
    text = trilat(
        "sweep", "trio.toml", *OVER, "--map", "-o", "done", "--jobs", "1", cwd=path
    ).succeeds()
    (path / "printed.txt").write_text(text)
    return path


def test_a_sweep_prints_plan_outcome_and_next_step(folder: Path, tmp_path: Path) -> None:
    """The verdicts in the text count every run, and each proposed command runs."""
    text = trilat("sweep", folder / "trio.toml", *OVER, "--jobs", "1", cwd=tmp_path).succeeds()
    lines = text.splitlines()
    assert lines[0] == "trio: 12 cells (3 x 4), seed 1"
    assert "  over link.delay_ms=0:40:20: 0, 20, 40" in lines

    (verdicts,) = (line for line in lines if line.startswith("12 runs of 12 cells: "))
    counts = [int(part.split()[0]) for part in verdicts.partition(": ")[2].split(", ")]
    assert sum(counts) == 12
    assert "times real time per process" in text
    # without lines of progress
    assert len(re.findall(r"\d+ runs", text.replace("of 12 runs", ""))) == 1
    assert "results: runs/sweep-trio-001/results.csv" in lines

    again = trilat("sweep", "runs/sweep-trio-001", cwd=tmp_path).succeeds().splitlines()
    assert verdicts in again
    for line in (line for line in again if line.startswith("  trilat sweep ")):
        arguments = line.partition("#")[0].split()
        trilat(*arguments[1:], "--jobs", "1", cwd=tmp_path).succeeds()


def test_a_cell_is_a_command_that_runs(folder: Path) -> None:
    for source in ("done", "done/results.csv"):
        text = trilat("sweep", source, "--cell", "6", cwd=folder).succeeds()
    assert text.startswith(
        "trilat sim trio.toml --set link.delay_ms=20 --set control.Kd=3 --seed 1 "
    )
    trilat(*text.split()[1:], cwd=folder).succeeds()
    assert (folder / "cell-6.mcap").exists()


def test_a_finished_sweep_is_not_computed_again(folder: Path) -> None:
    before = (folder / "done" / "results.csv").read_bytes()
    for arguments in (("trio.toml", *OVER, "-o", "done"), ("--resume", "done")):
        text = trilat("sweep", *arguments, cwd=folder).succeeds()
        assert "12 runs are done already" in text
        assert "nothing was left to run" in text
    assert (folder / "done" / "results.csv").read_bytes() == before


def test_seeds_are_a_number_or_a_list() -> None:
    assert parse_seed_count(None) == 1
    assert parse_seed_count("10") == 10
    assert parse_seed_count("1..3,8") == [1, 2, 3, 8]
    assert parse_seed_count("7..7") == parse_seed_count("7,") == [7]


def test_enormous_sweeps_are_refused_with_count_and_time(folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    done = trilat(
        "sweep", "trio.toml", "--over", "control.Kd=1:2:1e-6", "--over", OVER[1], cwd=folder
    )
    assert done.code == 2, done
    (problem,) = done.err.splitlines()
    for fact in ("error: 3000003 cells (1000001 x 3) would take about ", " on ", "--yes"):
        assert fact in problem
    assert sorted(folder.rglob("*")) == before


def test_map_lies_beside_results_and_names_its_command(folder: Path) -> None:
    names = sorted(path.name for path in (folder / "done").iterdir())
    assert {"map.md", "map.png", "map.svg", "results.csv"} <= set(names)
    text = (folder / "done" / "map.md").read_text()
    assert f"trilat sweep trio.toml {' '.join(OVER)} --map\n" in text


def test_map_shows_progress_and_fixed_settings(folder: Path) -> None:
    lines = (folder / "printed.txt").read_text().splitlines()
    assert lines.index("map: the lines of theory ...") < lines.index("map: drawing ...")
    assert any(
        re.fullmatch(r"  \d+ of \d+ columns of the map, about .* left", line) for line in lines
    )
    assert "not swept: adaptive: Lambda 1, Kp 1, Gamma 1, theta_hat0 0" in lines
    page = (folder / "done" / "map.md").read_text()
    assert (
        "- gains that were not swept: adaptive: Lambda 1, Kp 1, Gamma 1, theta_hat0 0\n" in page
    )
    assert "- to compare laws at their best gains, use: `trilat compare --tune`\n" in page


@pytest.mark.long
def test_redrawn_results_are_the_same(folder: Path) -> None:
    """A map drawn again from its results has the same bytes, and another width changes them."""
    names = ("map.md", "map.png", "map.svg")
    before = {name: (folder / "done" / name).read_bytes() for name in names}
    text = trilat("sweep", "done", "--map", "--jobs", "1", cwd=folder).succeeds()
    assert "done/map.png" in text
    for name, data in before.items():
        assert (folder / "done" / name).read_bytes() == data

    width = ("--width", "7", "--jobs", "1")
    trilat("sweep", "done/results.csv", "--map", *width, cwd=folder).succeeds()
    assert (folder / "done" / "map.png").read_bytes() != before["map.png"]


@pytest.mark.long
def test_margins_are_printed_and_kept(folder: Path) -> None:
    """The edges of a gain for two delays appear in the text and in both files."""
    search = ("--margin", "control.Kd=1:4", "--tolerance", "0.1")
    arguments = ("--over", "link.delay_ms=0,40", *search, "--jobs", "1", "-o", "edges")
    text = trilat("sweep", "trio.toml", *arguments, cwd=folder).succeeds()
    assert "edge of Kd (N m s/rad)" in text
    facts = json.loads((folder / "edges" / "margin.json").read_text())
    assert [point["link.delay_ms"] for point in facts["places"]] == [0.0, 40.0]
    assert (folder / "edges" / "margin.md").read_text().startswith("# ")
    command = facts["command"].split()
    assert command[:3] == ["trilat", "sweep", "trio.toml"]
