"""`trilat figure`: files for a paper."""

import json
from pathlib import Path

import pytest

from trilat_net.presentation.figures.compared_runs import COMPARED_SIGNALS

from .running import trilat


@pytest.fixture
def folder(log_file: Path) -> Path:
    return log_file.parent


def test_figures_are_written_by_name(folder: Path) -> None:
    done = trilat(
        "figure",
        "run.mcap",
        "phase",
        "settling",
        "--format",
        "svg,pdf",
        "--out",
        "paper",
        cwd=folder,
    )
    names = ["phase.svg", "phase.pdf", "settling.svg", "settling.pdf"]
    assert done.succeeds().split() == [f"paper/{name}" for name in names]
    assert sorted(path.name for path in (folder / "paper").iterdir()) == sorted(names)
    assert b"MediaBox [ 0 0 252 " in (folder / "paper" / "phase.pdf").read_bytes()


@pytest.mark.long
def test_the_default_is_pdf_and_png(folder: Path) -> None:
    done = trilat("figure", "run.mcap", "control_torques", "--width", "7", "--json", cwd=folder)
    paths = json.loads(done.succeeds())
    assert paths == [f"run-figures/control_torques.{kind}" for kind in ("pdf", "png")]
    assert b"MediaBox [ 0 0 504 " in (folder / paths[0]).read_bytes()
    trilat("figure", "run.mcap", "control_torques", cwd=folder).refuses(
        "torques.pdf already exists", "--force"
    )


def test_the_list_names_impossible_figures(folder: Path) -> None:
    output = trilat("figure", "run.mcap", "--list", cwd=folder).succeeds()
    assert "settling times" in output
    assert "no site has a wall" in output
    rows = json.loads(trilat("figure", "run.mcap", "--list", "--json", cwd=folder).succeeds())
    absent = {row["name"]: row["absent"] for row in rows}
    assert absent["positions"] is None
    assert absent["contact"] == "no site has a wall in this run"
    assert not (folder / "run-figures").exists()


def test_figures_of_two_logs_are_written(folder: Path) -> None:
    """Without names, `--with` writes the overlay and the figures with a panel per site."""
    again = ("rerun", "run.mcap", "--closed-loop", "--set", "link.delay_ms=300", "-o", "b.mcap")
    trilat(*again, cwd=folder).succeeds()
    together = ("figure", "run.mcap", "--with", "b.mcap", "--format", "svg", "--out")
    names = ["overlay", *(f"overlay_{name}" for name in COMPARED_SIGNALS)]
    written = trilat(*together, "both", cwd=folder).succeeds().split()
    assert written == [f"both/{name}.svg" for name in names]
    overlaid = trilat(*together, "one", "positions", cwd=folder).succeeds().split()
    assert overlaid == ["one/overlay_positions.svg"]
    trilat(*together, "no", "phase", cwd=folder).refuses("'phase'", "tracking_errors")
