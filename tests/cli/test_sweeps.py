"""`trilat sweep`: what it prints, what it leaves, what it refuses."""

from pathlib import Path

import pytest

from tests.studies.sweep.quick import SHORT
from trilat_net.cli.sweep import parse_seed_count
from trilat_net.errors import UsageError

from .running import trilat

OVER = ("--over", "link.delay_ms=0:40:20", "--over", "control.Kd=1:4:1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a quick scenario and the results of a sweep of it."""
    path = tmp_path_factory.mktemp("sweeps")
    (path / "trio.toml").write_text(SHORT)
    trilat("sweep", "trio.toml", *OVER, "-o", "done", "--jobs", "1", cwd=path).succeeds()
    return path


def test_a_sweep_says_what_it_does_what_came_of_it_and_what_is_next(folder: Path, tmp_path: Path) -> None:
    text = trilat("sweep", folder / "trio.toml", *OVER, "--jobs", "1", cwd=tmp_path).succeeds()
    lines = text.splitlines()
    assert lines[0] == "trio: 12 cells (3 x 4), seed 1"
    assert "  over link.delay_ms=0:40:20: 0, 20, 40" in lines
    (verdicts,) = (line for line in lines if line.startswith("12 runs of 12 cells: "))
    assert sum(int(part.split()[0]) for part in verdicts.partition(": ")[2].split(", ")) == 12
    assert "times real time per process" in text
    assert "results: runs/sweep-trio-001/results.parquet" in lines
    again = trilat("sweep", "runs/sweep-trio-001", cwd=tmp_path).succeeds().splitlines()
    assert verdicts in again
    for line in (line for line in again if line.startswith("  trilat sweep ")):
        words = line.partition("#")[0].split()
        trilat(*words[1:], cwd=tmp_path).succeeds()


def test_a_cell_is_a_command_that_runs(folder: Path) -> None:
    for source in ("done", "done/results.parquet"):
        text = trilat("sweep", source, "--cell", "6", cwd=folder).succeeds()
    assert text.startswith("trilat sim trio.toml --set link.delay_ms=20 --set control.Kd=3 --seed 1 ")
    trilat(*text.split()[1:], cwd=folder).succeeds()
    assert (folder / "cell-6.mcap").exists()


def test_what_is_done_is_gone_on_with_and_not_made_again(folder: Path) -> None:
    before = (folder / "done" / "results.parquet").read_bytes()
    for how in (("trio.toml", *OVER, "-o", "done"), ("--resume", "done")):
        text = trilat("sweep", *how, cwd=folder).succeeds()
        assert "12 runs are done already" in text
        assert "nothing was left to run" in text
    assert (folder / "done" / "results.parquet").read_bytes() == before


def test_a_folder_that_is_called_as_a_scenario_is_none(folder: Path) -> None:
    (folder / "free").mkdir(exist_ok=True)
    trilat("sweep", "free", "--over", "control.Kx=1,2", cwd=folder).refuses(
        "free: control.Kx", "did you mean"
    )


def test_seeds_are_a_number_or_a_list() -> None:
    assert parse_seed_count(None) == 1
    assert parse_seed_count("10") == 10
    assert parse_seed_count("1..3,8") == [1, 2, 3, 8]
    assert parse_seed_count("7..7") == parse_seed_count("7,") == [7]
    with pytest.raises(UsageError, match=r"1\.\.20"):
        parse_seed_count("x")


BAD = {
    "no key of that name": (["--over", "link.dely_ms=0:1:1"], ["link.dely_ms", "did you mean 'delay_ms'?"]),
    "an empty range": (["--over", "link.delay_ms=40:0:20"], ["is empty", "did you mean 0:40:20?"]),
    "a range without end": (["--over", "link.delay_ms=0:inf:20"], ["finite", "'inf'"]),
    "a live scenario": (
        ["--over", "control.Kd=1,2", "--set", "sites.s.plant=external"],
        ["sites.s.plant", "is external", "live"],
    ),
    "a measured link": (
        ["--over", "control.Kd=1,2", "--set", "link.model=measured"],
        ["model", "measured"],
    ),
    "another sweep's folder": (
        ["--over", "control.Kd=1,2", "-o", "done"],
        ["done", "a sweep of other axes", "results are not mixed"],
    ),
    "another scenario's folder": (
        [*OVER, "--set", "control.Kp=2", "-o", "done"],
        ["done", "a sweep of another scenario", "(sha256 ", "results are not mixed"],
    ),
    "somebody else's folder": (["--over", "control.Kd=1,2", "-o", "."], ["holds something"]),
    "nothing to sweep": ([], ["--over"]),
    "no law": (["--law", "pd"], ["--law", "did you mean"]),
    "no seeds": (["--over", "control.Kd=1,2", "--seeds", "5..1"], ["1..20"]),
    "no time": (["--over", "control.Kd=1,2", "--longest", "0.1"], ["--longest", "0.5 s"]),
    "a cell of a scenario": (["--cell", "3"], ["trio.toml", "Parquet"]),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_cannot_be_right_is_one_line_and_leaves_nothing(kind: str, folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    arguments, facts = BAD[kind]
    trilat("sweep", "trio.toml", *arguments, cwd=folder).refuses(*facts)
    assert sorted(folder.rglob("*")) == before


def test_an_enormous_sweep_is_refused_with_count_and_time(folder: Path) -> None:
    before = sorted(folder.rglob("*"))
    done = trilat("sweep", "trio.toml", "--over", "control.Kd=1:2:1e-6", "--over", OVER[1], cwd=folder)
    assert done.code == 2, done
    (problem,) = done.err.splitlines()
    for fact in ("error: 3000003 cells (1000001 x 3) would take about ", " on ", "--yes"):
        assert fact in problem
    assert sorted(folder.rglob("*")) == before


def test_results_and_a_sweep_of_ones_own_do_not_go_together(folder: Path) -> None:
    def refused(*words: str) -> None:
        *arguments, fact = words
        trilat("sweep", *arguments, cwd=folder).refuses(fact)

    refused("done", "--over", "control.Kd=1,2", "--over is of the sweep already")
    refused("--resume", "done", "--seeds", "3", "--seeds is of the sweep already")
    refused("trio.toml", "--resume", "done", "--resume goes on with the sweep of its folder")
    refused("done", "--cell", "12", "numbered from 0 to 11")
    refused("--cell", "1", "--cell is of results")
    refused("--resume", "none", "no sweep was begun there")
    refused("none.parquet", "no results of a sweep")
    refused("--over", "control.Kd=1,2", "name a scenario")
