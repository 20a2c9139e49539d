"""The page of a map: everything in it is in the results, the lines or the commands."""

from pathlib import Path

import numpy as np
import pytest

from trilat_net.studies.sweep.cell_result import CellClass
from trilat_net.studies.sweep.map_page import build_map_page, tabulate_classes, tabulate_edges, write_map
from trilat_net.studies.sweep.stability_map import StabilityMap, TheoryLine

from .maps import DAMPINGS, DELAYS_MS, drawn

SPARE = np.array(DAMPINGS)[:, np.newaxis] - 5e-3 * np.array(DELAYS_MS)
EXACT = TheoryLine("$d$", "d = 5 T", "the condition", SPARE, 0)
HALF = TheoryLine("half", "half of it", "half of the condition", SPARE + 2.5e-3 * np.array(DELAYS_MS), 1)


@pytest.fixture
def chart() -> StabilityMap:
    plane = drawn(link__playout_ms=(0.0, 400.0))
    return StabilityMap(
        plane, ((EXACT, HALF), (EXACT,)), ("a remark",), ("trilat sweep a", "trilat map"), "P+d"
    )


def test_the_folder_has_a_picture_a_vector_and_a_page(chart: StabilityMap, tmp_path: Path) -> None:
    paths = write_map(chart, tmp_path)
    assert [path.name for path in paths] == ["map.png", "map.svg", "map.md"]
    assert int.from_bytes(paths[0].read_bytes()[16:20], "big") == 1050  # 3.5 in, 300 pixels to the inch
    assert paths[1].read_text().startswith("<?xml")


def test_the_same_results_give_the_same_bytes(chart: StabilityMap, tmp_path: Path) -> None:
    again = tmp_path / "again"
    again.mkdir()
    for one, other in zip(write_map(chart, tmp_path), write_map(chart, again), strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_the_page_tells_commands_lines_and_remarks(chart: StabilityMap) -> None:
    text = build_map_page(chart, "map.png")
    assert text.startswith("# P+d\n")
    assert "trilat sweep a\ntrilat map\n```" in text
    assert "![map](map.png)" in text
    assert text.count("d = 5 T: the condition") == 1
    assert "- a remark" in text
    assert "## playout 0 ms" in text


def test_counts_are_of_all_runs() -> None:
    plane = drawn(lambda _x, _y, seed: list(CellClass)[seed - 1], seeds=3)
    assert tabulate_classes(plane).rows == [("all", "25", "25", "25", "0")]


def test_an_edge_stands_beside_each_line_with_its_difference() -> None:
    plane = drawn()
    table = tabulate_edges(plane, plane.panels[0], (EXACT, HALF))
    heads = ["delay (ms)", "edge of d (N m s/rad)", "stable is", "d = 5 T", "difference", "half of it"]
    assert table.headers == (*heads, "difference")
    assert [row[0] for row in table.rows] == ["100", "200", "300", "400"]
    for row in table.rows:
        low, high = map(float, row[1].split(" to "))
        assert row[2] == "above"
        assert low <= float(row[3]) <= high
        assert row[4] == "within"
        half, middle = 2.5e-3 * float(row[0]), 0.5 * (low + high)
        expected = "within" if low <= half <= high else f"{100 * (half / middle - 1):+.1f} %"
        assert row[6] == expected


def test_a_line_that_is_not_there_has_no_difference() -> None:
    plane = drawn()
    table = tabulate_edges(plane, plane.panels[0], (EXACT._replace(spare=np.full((5, 5), np.nan)),))
    assert all(row[-2:] == ("-", "-") for row in table.rows)


def test_a_map_without_an_edge_has_no_table() -> None:
    plane = drawn(lambda *_: CellClass.CONVERGED)
    assert tabulate_edges(plane, plane.panels[0], (EXACT,)).rows == []
