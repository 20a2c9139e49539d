"""The folder of a sweep resumes its own sweep only; a torn line of its journal costs no other line."""

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import DAMPING, SHORT, make_cell_result, plan_quick_sweep
from trilat_studies import measure_run
from trilat_studies.sweep.sweep_cell import CellRun
from trilat_studies.sweep.sweep_run import PLAN_FILE, open_sweep_folder, prepare_sweep_folder

from trilat_net.core.step.fingerprint import compute_fingerprint
from trilat_net.errors import LogRefused, UsageError
from trilat_net.log.provenance import collect_provenance
from trilat_net.work import run_journal as folders
from trilat_net.work.run_journal import RunJournal


def refused(path: Path, *overrides: str, **settings: Any) -> str:
    """Returns the message with which a sweep is refused in a folder."""
    with pytest.raises(UsageError) as error:
        prepare_sweep_folder(plan_quick_sweep(path.parent, *overrides, **settings), path)
    assert error.value.exit_code == 2
    return str(error.value)


@pytest.fixture
def sweep_folder(tmp_path: Path) -> Path:
    """Returns the folder of a sweep that was begun."""
    return prepare_sweep_folder(plan_quick_sweep(tmp_path), tmp_path / "o").path


def test_the_same_sweep_resumes_in_its_folder(sweep_folder: Path) -> None:
    plan = (sweep_folder / PLAN_FILE).read_bytes()
    again = prepare_sweep_folder(plan_quick_sweep(sweep_folder.parent), sweep_folder)
    assert open_sweep_folder(sweep_folder).facts == again.facts == json.loads(plan)
    assert (sweep_folder / PLAN_FILE).read_bytes() == plan
    assert [path.name for path in sweep_folder.iterdir()] == [PLAN_FILE]


@pytest.mark.parametrize(
    ("overrides", "settings", "phrases"),
    [
        (["control.Kp=2"], {}, ("another scenario", "trio (sha256 ")),
        (["control.Kd=3"], {}, ("other settings", "none in the folder, control.Kd=3 now")),
        (
            [],
            {"over": [DAMPING]},
            ("other axes", "axes: link.delay_ms=0:40:20, control.Kd=1:4:1 in the folder, "),
        ),
        ([], {"seeds": 3}, ("other seeds", "1..1 in the folder, 1..3 now")),
        ([], {"seeds": [5, 1]}, ("other seeds", "5, 1 now")),
        ([], {"laws": ["adaptive"]}, ("other laws", "none in the folder, adaptive now")),
        ([], {"longest_s": 2.0}, ("another longest time", "4 s in the folder, 2 s now")),
    ],
)
def test_another_sweep_is_refused_with_its_differences(
    sweep_folder: Path,
    overrides: list[str],
    settings: dict[str, Any],
    phrases: tuple[str, ...],
) -> None:
    problem = refused(sweep_folder, *overrides, **settings)
    for word in (
        str(sweep_folder),
        "results cannot be mixed",
        "choose another folder",
        *phrases,
    ):
        assert word in problem


def test_an_edited_scenario_is_refused(sweep_folder: Path) -> None:
    (sweep_folder.parent / "trio.toml").write_text(
        SHORT.replace("delay_ms = 50.0", "delay_ms = 50.0 # ms")
    )
    assert "another text of the scenario" in refused(sweep_folder)


def test_another_arithmetic_or_program_is_refused(
    sweep_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(measure_run, "compute_fingerprint", lambda: "0" * 16)
        reason = f"another kind of arithmetic: {compute_fingerprint()} in the folder, 0000"
        assert reason in refused(sweep_folder)
    older = {**collect_provenance(), "version_numba": "0.1"}
    monkeypatch.setattr(measure_run, "collect_provenance", lambda: older)
    with pytest.raises(UsageError, match=r"another version of the program: .*numba 0\.1"):
        open_sweep_folder(sweep_folder)


def test_a_folder_with_other_contents_is_left_alone(tmp_path: Path) -> None:
    other = tmp_path / "o"
    other.mkdir()
    (other / "precious").write_text("precious")
    assert "is not empty; choose another folder" in refused(other)
    assert [path.name for path in other.iterdir()] == ["precious"]


@pytest.mark.parametrize(
    ("content", "phrase"),
    [
        (None, "contains no sweep: plan.json is missing"),
        ("{", "is not JSON"),
        ("[]", "is not the plan"),
        ("{}", "is not the plan"),
    ],
)
def test_a_folder_without_a_plan_is_refused(
    tmp_path: Path, content: str | None, phrase: str
) -> None:
    if content is not None:
        (tmp_path / PLAN_FILE).write_text(content)
    with pytest.raises(UsageError, match=phrase):
        open_sweep_folder(tmp_path)


NAME = "the sweep"


def entry(cell: int, seed: int = 1) -> CellRun:
    """Returns a run of a sweep as its journal stores it."""
    return CellRun(
        cell,
        seed,
        bool(cell % 2),
        "p_d",
        "ab" * 32,
        ((0, 4), f"é = {cell}"),
        make_cell_result(str(cell)),
    )


def opened(path: Path, sweep: str) -> RunJournal[CellRun]:
    """Opens the journal of a sweep."""
    return RunJournal(
        path,
        sweep,
        CellRun,
        folders.RunJournal.build_resume_hint("sweep", "--resume", str(path.parent)),
    )


def write_journal(path: Path, entries: list[CellRun], sweep: str = NAME) -> bytes:
    """Appends runs to a journal, and returns the bytes of the file."""
    with opened(path, sweep) as journal:
        for run in entries:
            journal.add(run)
    return path.read_bytes()


def read(path: Path, sweep: str = NAME) -> list[CellRun]:
    """Returns all runs that a journal contains."""
    with opened(path, sweep) as journal:
        return list(journal.done.values())


FIVE = [entry(cell) for cell in range(5)]


@pytest.fixture(scope="module")
def five(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write_journal(tmp_path_factory.mktemp("journal") / "j", FIVE)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "j"


def test_written_numbers_are_read_back_exactly(path: Path) -> None:
    odd = msgspec.structs.replace(
        FIVE[0],
        cell=9,
        outcome=msgspec.structs.replace(FIVE[0].outcome, peak_error_rad=math.inf),
    )
    write_journal(path, [*FIVE, odd])
    assert read(path) == [*FIVE, odd]


@given(data=st.data())
def test_a_cut_file_keeps_whole_lines_and_grows(
    five: bytes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """A journal that ends within a line keeps the lines before, and takes further runs."""
    cut = data.draw(st.integers(0, len(five)))
    path = tmp_path_factory.mktemp("cut") / "j"
    path.write_bytes(five[:cut])
    whole = five[:cut].count(b"\n")
    kept = read(path)
    assert kept[:whole] == FIVE[:whole]
    assert len(kept) <= whole + 1  # a line that lacks its line feed alone is whole
    write_journal(path, FIVE)
    assert sorted(read(path), key=lambda run: run.cell) == FIVE


@given(data=st.data())
def test_a_wrong_byte_loses_only_its_line(
    five: bytes, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """One damaged byte loses its line, or two lines if it was the line feed between them."""
    at = data.draw(st.integers(0, len(five) - 1))
    flipped = data.draw(st.integers(0, 255).filter(lambda byte: byte != five[at]))
    path = tmp_path_factory.mktemp("flip") / "j"
    path.write_bytes(five[:at] + bytes([flipped]) + five[at + 1 :])
    kept = read(path)
    line = five[:at].count(b"\n")
    lost = {line, line + 1} if five[at : at + 1] == b"\n" else {line}
    undamaged = [run for run in FIVE if run.cell not in lost]
    assert [run for run in kept if run.cell not in lost] == undamaged
    assert all(run in FIVE for run in kept)


def test_lines_of_another_sweep_are_ignored(path: Path) -> None:
    write_journal(path, FIVE, "another sweep")
    assert read(path) == []
    write_journal(path, FIVE[:2])
    assert read(path) == FIVE[:2]
    assert read(path, "another sweep") == FIVE


def test_a_run_refused_by_full_disk_is_pending(path: Path) -> None:
    """`/dev/full` answers like a full disk."""
    with opened(path, "sweep") as journal:
        journal.add(FIVE[0])
        whole = journal._file
        with Path("/dev/full").open("ab", buffering=0) as full:
            journal._file = full
            with pytest.raises(
                LogRefused, match=r"No space left on device.*make room, and continue with"
            ) as error:
                journal.add(FIVE[1])
        journal._file = whole
        assert [entry.cell for entry in journal.done.values()] == [FIVE[0].cell]
    assert error.value.exit_code == 5
