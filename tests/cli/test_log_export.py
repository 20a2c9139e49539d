"""`trilat log export`: one sentence on success, one on failure, and no incomplete files."""

import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np
import polars as pl
import pytest

from tests.log.builders import make_log_bytes, write_log
from tests.log.split_logs import make_bytes_of_messages, make_parts, read_messages

from .running import trilat

FORMS = {
    "ros2": "run-ros2.mcap",
    "csv": "run-csv",
    "parquet": "run-parquet",
    "npz": "run.npz",
    "mat": "run.mat",
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_log(tmp_path, make_log_bytes("paper"))
    return tmp_path


@pytest.mark.parametrize("form", FORMS)
def test_a_log_is_exported_beside_itself(form: str, folder: Path) -> None:
    text = trilat("log", "export", "run.mcap", "--to", form, cwd=folder).succeeds()
    assert text == f"{FORMS[form]}: 360 records of m1, m2, s\n"
    assert sorted(path.name for path in folder.iterdir()) == sorted(["run.mcap", FORMS[form]])


def test_exports_replace_only_their_own_kind(folder: Path) -> None:
    command = ("log", "export", "run.mcap", "--to", "csv", "-o", "tables")
    trilat(*command, cwd=folder).succeeds()
    trilat(*command, cwd=folder).refuses("tables already exists", "--force")
    trilat(*command, "--force", cwd=folder).succeeds()
    assert pl.read_csv(folder / "tables" / "s_state.csv").height == 120
    done = trilat("log", "export", "run.mcap", "--to", "npz", "-o", "run.mcap", cwd=folder)
    done.refuses("run.mcap already exists")
    assert (folder / "run.mcap").read_bytes() == make_log_bytes("paper")


def test_parts_of_a_log_are_exported_as_one(folder: Path) -> None:
    count = len(read_messages(make_log_bytes("paper")))
    for n, data in enumerate(
        make_parts(make_log_bytes("paper"), [range(150), range(100, count)])
    ):
        (folder / f"run-00{n + 1}.mcap").write_bytes(data)
    files = ("run-002.mcap", "run-001.mcap")
    trilat("log", "export", *files, "--to", "npz", "-o", "out.npz", cwd=folder).succeeds()
    assert np.load(folder / "out.npz")["m1/tick"].tolist() == list(range(120))


def test_a_folder_of_logs_becomes_episodes(folder: Path) -> None:
    """The parts of one log are one episode: 0.12 s at 1 kHz are four frames of 30 Hz, or six of 50 Hz."""
    count = len(read_messages(make_log_bytes("paper")))
    (folder / "logs").mkdir()
    for n, data in enumerate(
        make_parts(make_log_bytes("paper"), [range(150), range(100, count)])
    ):
        (folder / "logs" / f"run-00{n + 1}.mcap").write_bytes(data)
    (folder / "logs" / "other.mcap").write_bytes(
        make_log_bytes("paper", {"seed": 9, "duration_s": 0.12})
    )
    command = ("log", "export", "logs", "--to", "lerobot")
    text = trilat(*command, cwd=folder).succeeds()
    assert (
        text == "logs-lerobot: 8 frames in 2 episodes; 0 frames lie in gaps and are left out; "
        "no program moved an arm, so there is no column intervention\n"
    )
    trilat(*command, cwd=folder).refuses("logs-lerobot already exists", "--force")
    assert (
        "12 frames in 2"
        in trilat(*command, "--set", "fps=50", "--force", cwd=folder).succeeds()
    )
    trilat(*command, "--set", "log=x", cwd=folder).refuses(
        "no setting 'log'; the settings of lerobot are fps, program, actions, observations"
    )
    (folder / "none").mkdir()
    trilat("log", "export", "none", "--to", "lerobot", cwd=folder).refuses(
        "this directory contains no log"
    )


@pytest.mark.parametrize(
    ("form", "module", "name"),
    [
        ("parquet", "polars", "frames"),
        ("mat", "scipy.io", "mat"),
        ("lerobot", "pyarrow.parquet", "lerobot"),
    ],
)
def test_missing_packages_are_named_with_their_installation(
    form: str, module: str, name: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    done = trilat("log", "export", "run.mcap", "--to", form, cwd=folder)
    done.refuses("need", f"extras EXTRAS={name}")
    assert [path.name for path in folder.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("form", ["csv", "npz"])
def test_csv_and_npz_need_no_extra(
    form: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("polars", "scipy", "scipy.io"):
        monkeypatch.setitem(sys.modules, module, None)
    trilat("log", "export", "run.mcap", "--to", form, cwd=folder).succeeds()


def test_an_unreadable_record_leaves_no_files(folder: Path) -> None:
    all_messages = read_messages(make_log_bytes("paper"))
    topic = next(m[0] for m in all_messages if m[0].endswith("/s/state"))
    (folder / "bad.mcap").write_bytes(
        make_bytes_of_messages(
            make_log_bytes("paper"), [*all_messages, (topic, b"\x80", 0, 0, 0)]
        )
    )
    done = trilat("log", "export", "bad.mcap", "--to", "csv", cwd=folder)
    done.refuses("bad.mcap: a record of s cannot be")
    assert sorted(path.name for path in folder.iterdir()) == ["bad.mcap", "run.mcap"]


@contextmanager
def no_file_longer_than(size: int) -> Iterator[None]:
    """Emulates a full disk for every library that writes, but keeps Python from caching
    truncated modules.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with mock.patch.object(sys, "dont_write_bytecode", True):
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("form", FORMS)
def test_a_full_disk_is_one_sentence_without_files(form: str, folder: Path) -> None:
    with no_file_longer_than(10_000):
        done = trilat("log", "export", "run.mcap", "--to", form, cwd=folder)
    done.refuses("cannot be written: File too large", code=5)
    assert [path.name for path in folder.iterdir()] == ["run.mcap"]
