"""`trilat test`: exit codes in every direction, output, refusals and Ctrl-C."""

import signal
import sys
import xml.etree.ElementTree as Xml
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import QUICK
from trilat_studies.study_commands import parse_seeds

from tests.cli.running import start_command, trilat
from tests.net.waiting import until
from trilat_net.scenario import list_shipped, load_scenario

TOO_MUCH = ("--set", "expect.mean_age_max_ms=1.0")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "quick.toml").write_text(QUICK)
    return tmp_path


def test_met_expectations_exit_0_with_a_table(folder: Path) -> None:
    text = trilat(
        "test", "./quick.toml", "--seeds", "1..3", "--jobs", "1", cwd=folder
    ).succeeds()
    assert "ok  ./quick.toml  peak_error_max_rad" in text
    assert "3/3" in text
    assert "3 runs, 1.5 s simulated in " in text


def test_failed_expectations_exit_1_with_their_commands(folder: Path) -> None:
    """A failed trial prints two commands: one repeats the trial, the other writes its log."""
    options = ("--seeds", "4,6", "--jobs", "1", *TOO_MUCH)
    done = trilat("test", "./quick.toml", *options, cwd=folder)
    assert done.code == 1, done
    assert done.err == ""
    assert "0/2" in done.out
    lines = done.out.splitlines()

    again = "trilat test ./quick.toml --seeds 6 --set expect.mean_age_max_ms=1.0"
    assert f"  again: {again}" in lines
    repeated = trilat(*again.split()[1:], cwd=folder)
    assert repeated.code == 1, repeated
    (figures,) = (line for line in lines if "seed 6: mean_age_max_ms" in line)
    assert figures in repeated.out

    (look,) = (line for line in lines if "trilat sim" in line and "--seed 6" in line)
    trilat(*look.split()[2:], cwd=folder).succeeds()
    assert (folder / "quick-seed6.mcap").exists()


def test_one_failing_scenario_among_others_exits_1(folder: Path) -> None:
    (folder / "bad.toml").write_text(QUICK.replace("100.0", "1.0"))
    done = trilat("test", "./quick.toml", "./bad.toml", "--jobs", "1", cwd=folder)
    assert done.code == 1, done
    marks = [line[:4] for line in done.out.splitlines() if ".toml  " in line]
    assert marks == ["ok  ", "ok  ", "ok  ", "FAIL"]


def test_junit_is_written_for_any_outcome(folder: Path) -> None:
    command = ("test", "./quick.toml", "--seeds", "1..2", "--jobs", "1", "--junit", "o.xml")
    for more, failures in (((), "0"), (TOO_MUCH, "2")):
        trilat(*command, *more, cwd=folder)
        root = Xml.parse(folder / "o.xml").getroot()
        assert (root.get("tests"), root.get("failures")) == ("2", failures)


def test_default_is_every_shipped_scenario_with_expectations() -> None:
    """Without a name the command runs each shipped scenario that states expectations."""
    from trilat_studies.study_commands import _list_trials

    named = [trial.source for trial in _list_trials([], [1, 2], [], live=False)]
    assert set(named) == {
        name for name in list_shipped() if load_scenario(name).expect.has_expectations
    }
    assert "paper" in named


@given(
    first=st.integers(0, 500),
    count=st.integers(0, 30),
    others=st.lists(st.integers(0, 10**17), max_size=5),
)
def test_seeds_are_read_as_they_are_written(first: int, count: int, others: list[int]) -> None:
    text = ",".join([f"{first}..{first + count}", *map(str, others)])
    assert parse_seeds(text) == [*range(first, first + count + 1), *others]


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_ctrl_c_exits_130_and_leaves_no_process(folder: Path) -> None:
    """Ctrl-C ends the program and its worker processes without a traceback."""
    (folder / "long.toml").write_text(QUICK.replace("duration_s = 0.5", "duration_s = 20000.0"))
    process = start_command("test", "long.toml", "--seeds", "1..9", "--jobs", "2", cwd=folder)

    def list_workers() -> list[Path]:
        """Returns the folders in /proc of the program's worker processes."""
        threads = Path(f"/proc/{process.pid}/task").glob("*/children")
        children = [
            Path("/proc", pid) for thread in threads for pid in thread.read_text().split()
        ]
        return [
            child for child in children if b"LokyProcess" in (child / "cmdline").read_bytes()
        ]

    try:
        until(lambda: len(list_workers()) == 2, timeout_s=60)
        workers = list_workers()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
        assert process.returncode == 130, err
        assert "Traceback" not in err
        until(lambda: not any(path.exists() for path in workers), timeout_s=20)
    finally:
        process.kill()
