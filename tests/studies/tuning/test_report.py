"""What is written: the JSON that is the result, and its views."""

import json
import re
from pathlib import Path

import pytest

from trilat_net.studies.tuning import TuningResult
from trilat_net.studies.tuning.final_posture import CandidateClass
from trilat_net.studies.tuning.tuning_report import tabulate_front, tabulate_laws, write_tuning

from .experiments import asked


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> TuningResult:
    return asked(tmp_path_factory.mktemp("tuned"), laws=["p_d", "known"], budget=5).run(jobs=1)


def test_the_folder_holds_the_result_and_its_views(found: TuningResult, tmp_path: Path) -> None:
    paths = write_tuning(found, tmp_path)
    assert sorted(path.name for path in paths) == ["front.json", "front.md", "front.pdf", "front.png"]
    result = json.loads((tmp_path / "front.json").read_text())
    assert result["procedure"]["candidates_per_law"] == 5
    assert result["scenario"]["tau_limit_nm"] == {"m1": 60.0, "m2": 60.0, "s": 60.0}
    for law in ("p_d", "known"):
        assert len(result["laws"][law]["candidates"]) == sum(result["laws"][law]["outcomes"].values()) == 5
        for point in result["laws"][law]["front"]:
            assert point["command"].startswith("trilat sim ")
            assert point["outcome"] == "settled"


def test_the_figure_is_a_vector_one_column_wide(found: TuningResult, tmp_path: Path) -> None:
    """3.5 in are 252 pt, and 700 pixels at 200 to the inch."""
    write_tuning(found, tmp_path)
    box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ([\d.]+) \]", (tmp_path / "front.pdf").read_bytes())
    assert box is not None
    assert float(box[1]) == pytest.approx(252.0)
    header = (tmp_path / "front.png").read_bytes()[16:20]
    assert int.from_bytes(header, "big") == 700


def test_the_page_tells_procedure_search_and_commands(found: TuningResult, tmp_path: Path) -> None:
    write_tuning(found, tmp_path)
    text = (tmp_path / "front.md").read_text()
    assert "every law is told gravity exactly" in text
    assert "torques clamped at 60 N m" in text
    assert "| p_d | K | N m/rad | 1 | 1000 | gravity |" in text
    assert "AND inertia exactly: more than the others" in text
    assert text.count("trilat sim ") == sum(len(one.front) for one in found.found) + 2
    assert "as printed, told nothing" in text


def test_the_table_of_laws_counts_every_run(found: TuningResult) -> None:
    table = tabulate_laws(found)
    places = [table.headers.index(outcome.value) for outcome in CandidateClass]
    for row in table.rows:
        assert sum(int(row[place]) for place in places) == int(row[1]) == 5


def test_a_long_front_is_shortened_to_points_with_both_ends(found: TuningResult) -> None:
    one = found.found[0]._replace(front=[0, 1, 2, 3, 4])
    assert [row[0].rstrip("*") for row in tabulate_front(found, one, 3).rows] == ["p_d 1", "p_d 3", "p_d 5"]
    assert len(tabulate_front(found, one).rows) == 5
    assert tabulate_front(found, one._replace(front=[]), 3).rows == []
