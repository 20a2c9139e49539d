"""The journal: whatever is torn, no other line is lost, and nothing of another sweep counts."""

import math
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.errors import LogRefused
from trilat_net.studies.sweep.sweep_cell import CellRun
from trilat_net.studies.sweep.sweep_folder import SweepJournal

from .quick import outcome_of

NAME = "the sweep"


def entry(cell: int, seed: int = 1) -> CellRun:
    return CellRun(
        cell, seed, bool(cell % 2), "p_d", "ab" * 32, ((0, 4), f"é = {cell}"), outcome_of(str(cell))
    )


def written(path: Path, entries: list[CellRun], sweep: str = NAME) -> bytes:
    with SweepJournal(path, sweep) as journal:
        for one in entries:
            journal.add(one)
    return path.read_bytes()


def read(path: Path, sweep: str = NAME) -> list[CellRun]:
    with SweepJournal(path, sweep) as journal:
        return list(journal.done.values())


FIVE = [entry(cell) for cell in range(5)]


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return written(tmp_path_factory.mktemp("journal") / "j", FIVE)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "j"


def test_what_is_written_is_read_number_for_number(path: Path) -> None:
    odd = msgspec.structs.replace(
        FIVE[0], cell=9, outcome=msgspec.structs.replace(FIVE[0].outcome, peak_error_rad=math.inf)
    )
    written(path, [*FIVE, odd])
    assert read(path) == [*FIVE, odd]


@given(data=st.data())
def test_a_file_cut_anywhere_keeps_every_whole_line_and_takes_more(
    five: bytes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    cut = data.draw(st.integers(0, len(five)))
    path = tmp_path_factory.mktemp("cut") / "j"
    path.write_bytes(five[:cut])
    whole = five[:cut].count(b"\n")
    kept = read(path)
    assert kept[:whole] == FIVE[:whole]
    assert len(kept) <= whole + 1  # a line that lacks its line feed alone is whole
    written(path, FIVE)
    assert sorted(read(path), key=lambda one: one.cell) == FIVE


@given(data=st.data())
def test_a_byte_that_is_wrong_loses_its_line_alone(
    five: bytes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    at = data.draw(st.integers(0, len(five) - 1))
    flipped = data.draw(st.integers(0, 255).filter(lambda byte: byte != five[at]))
    path = tmp_path_factory.mktemp("flip") / "j"
    path.write_bytes(five[:at] + bytes([flipped]) + five[at + 1 :])
    kept = read(path)
    line = five[:at].count(b"\n")
    lost = {line, line + 1} if five[at : at + 1] == b"\n" else {line}
    assert [one for one in FIVE if one.cell not in lost] == [one for one in kept if one.cell not in lost]
    assert all(one in FIVE for one in kept)


def test_lines_of_another_sweep_count_for_nothing(path: Path) -> None:
    written(path, FIVE, "another sweep")
    assert read(path) == []
    written(path, FIVE[:2])
    assert read(path) == FIVE[:2]
    assert read(path, "another sweep") == FIVE


def test_a_run_that_a_full_disk_refuses_is_not_done_and_says_how_to_go_on(path: Path) -> None:
    """`/dev/full` answers as a disk does that is full."""
    with SweepJournal(path, "sweep") as journal:
        journal.add(FIVE[0])
        whole = journal._file
        with Path("/dev/full").open("ab", buffering=0) as full:
            journal._file = full
            with pytest.raises(
                LogRefused, match=r"No space left on device.*make room, and go on with"
            ) as found:
                journal.add(FIVE[1])
        journal._file = whole
        assert [entry.cell for entry in journal.done.values()] == [FIVE[0].cell]
    assert found.value.exit_code == 5
