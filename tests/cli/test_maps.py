"""`trilat sweep --map`, `--margin`, `--confirm`: what they leave, print and refuse."""

import json
from pathlib import Path

import pytest

from tests.studies.sweep.quick import SHORT

from .running import trilat

OVER = ("--over", "link.delay_ms=0:40:20", "--over", "control.Kd=1:4:1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a quick scenario and the results of a sweep of it."""
    path = tmp_path_factory.mktemp("maps")
    (path / "trio.toml").write_text(SHORT)
    trilat("sweep", "trio.toml", *OVER, "--map", "-o", "done", "--jobs", "1", cwd=path).succeeds()
    return path


def test_a_map_lies_beside_the_results_and_names_the_command_that_makes_it(folder: Path) -> None:
    names = sorted(path.name for path in (folder / "done").iterdir())
    assert {"map.md", "map.png", "map.svg", "results.parquet"} <= set(names)
    text = (folder / "done" / "map.md").read_text()
    assert f"trilat sweep trio.toml {' '.join(OVER)} --map\n" in text


def test_results_are_drawn_once_more_the_same(folder: Path) -> None:
    before = {name: (folder / "done" / name).read_bytes() for name in ("map.md", "map.png", "map.svg")}
    text = trilat("sweep", "done", "--map", "--jobs", "1", cwd=folder).succeeds()
    assert "done/map.png" in text
    for name, data in before.items():
        assert (folder / "done" / name).read_bytes() == data
    trilat("sweep", "done/results.parquet", "--map", "--width", "7", "--jobs", "1", cwd=folder).succeeds()
    assert (folder / "done" / "map.png").read_bytes() != before["map.png"]


def test_margins_are_printed_and_kept(folder: Path) -> None:
    asked = ("--over", "link.delay_ms=0,40", "--margin", "control.Kd=1:4", "--jobs", "1", "-o", "edges")
    text = trilat("sweep", "trio.toml", *asked, cwd=folder).succeeds()
    assert "edge of Kd (N m s/rad)" in text
    facts = json.loads((folder / "edges" / "margin.json").read_text())
    assert [place["link.delay_ms"] for place in facts["places"]] == [0.0, 40.0]
    assert (folder / "edges" / "margin.md").read_text().startswith("# ")
    words = facts["command"].split()
    assert words[:3] == ["trilat", "sweep", "trio.toml"]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("done", "--map", "--confirm", "1"), "--map and --confirm exclude each other"),
        (("done", "--map", "--cell", "1"), "--map and --cell exclude each other"),
        (("done", "--width", "7"), "--width is of a map"),
        (("done", "--map", "--width", "5"), "a figure is 3.5 or 7 in wide, not 5"),
        (("done", "--margin", "control.Kd=1:4"), "--margin is of a scenario"),
        (("trio.toml", *OVER, "--tolerance", "0.1"), "--tolerance is of an edge"),
        (("trio.toml", *OVER, "--confirm", "2"), "--confirm is of results"),
        (("trio.toml", *OVER, "--margin", "control.Kp=4"), "--margin reads KEY=FROM:TO"),
        (("trio.toml", *OVER, "--margin", "control.Kx=1:4"), "did you mean"),
        (("trio.toml", *OVER, "--margin", "control.Kd=1:4"), "control.Kd: is swept twice"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(folder: Path, words: tuple[str, ...], problem: str) -> None:
    trilat("sweep", *words, cwd=folder).refuses(problem)
