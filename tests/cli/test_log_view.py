"""`log view`, and `--views` where logs are made."""

from pathlib import Path

import pytest
from mcap.reader import make_reader

from .running import trilat


@pytest.mark.parametrize(
    ("views", "least", "most"), [("off", 0, 0), ("50", 13, 14), ("full", 250, 250)]
)
def test_a_simulation_has_views_at_the_asked_rate(
    tmp_path: Path, views: str, least: int, most: int
) -> None:
    duration = ("--duration", "0.25", "-o", "x.mcap")
    trilat("sim", "two_sites", *duration, "--views", views, cwd=tmp_path).succeeds()
    with (tmp_path / "x.mcap").open("rb") as stream:
        count = sum(1 for _ in make_reader(stream).iter_messages("/viz/m/joint_states"))
    assert least <= count <= most


@pytest.mark.long
def test_views_can_be_kept(log_file: Path, tmp_path: Path) -> None:
    """Views are kept also if the log itself has none."""
    text = trilat("log", "view", log_file, "--save", "run.rrd", cwd=tmp_path).succeeds()
    assert "run.rrd: open it with: rerun run.rrd" in text
    assert (tmp_path / "run.rrd").read_bytes().startswith(b"RRF2")
    trilat("log", "view", log_file, "--save", "run.rrd", cwd=tmp_path).refuses(
        "run.rrd already exists", "--force"
    )
