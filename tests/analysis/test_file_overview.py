"""What `info` counts: messages, gaps and the time between them, without decoding any."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.log_editing import edited, recorded, without
from trilat_net.analysis.file_overview import FileInventory, describe_files
from trilat_net.errors import LogError

WHOLE = recorded("paper")
STATE = "/trilat/paper/m1/state"
RATES = {"m1": 1000, "m2": 1000, "s": 1000}


def written(folder: Path, data: bytes) -> Path:
    path = folder / "run.mcap"
    path.write_bytes(data)
    return path


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sets(st.integers(0, 119), max_size=100))
def test_gaps_are_the_records_that_are_not_there(tmp_path: Path, lost: set[int]) -> None:
    """But for those behind the last one, which no number tells of."""
    path = written(tmp_path, edited(WHOLE, record=without("m1", lost)))
    facts = FileInventory([path]).channels("paper", RATES)[STATE]
    last = max(set(range(120)) - lost)
    named = {n for first, end in facts["gaps"] for n in range(first, end + 1)}
    assert named == {n for n in lost if n < last}
    assert facts["missing"] == len(named)
    assert facts["messages"] == 120 - len(lost)


def test_parts_are_counted_together(tmp_path: Path) -> None:
    halves = [lambda r: r if r["tick"] < 50 else None, lambda r: r if r["tick"] >= 50 else None]
    paths = []
    for n, half in enumerate(halves):
        paths.append(tmp_path / f"{n}.mcap")
        paths[-1].write_bytes(edited(WHOLE, record=half))
    inventory = FileInventory(paths)
    facts = inventory.channels("paper", RATES)[STATE]
    assert (facts["messages"], facts["missing"]) == (120, 0)
    assert [file["finished"] for file in inventory.files] == [True, True]
    assert describe_files(paths)["sites"]["m1"]["missing"] == 0


def test_progress_runs_once_through_all(tmp_path: Path) -> None:
    told: list[float] = []
    describe_files([written(tmp_path, WHOLE)], lambda done, total: told.append(done / total))
    assert told == sorted(told)
    assert 0.0 < told[0] < 0.5 < told[-1] <= 1.0


def test_a_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read"):
        FileInventory([tmp_path])
