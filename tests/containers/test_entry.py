"""The first program of a container: the owner of the results, and refusals where it may not write."""

import os
import runpy
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

ENTRY = Path(__file__).parents[2] / "containers" / "entry.py"
entry = SimpleNamespace(**runpy.run_path(str(ENTRY)))
Owner = entry.Owner
SOMEBODY = Owner(4321, 4322)

needs_root = pytest.mark.skipif(os.getuid() != 0, reason="only root gives files away")


@pytest.fixture
def mark(tmp_path: Path) -> Path:
    path = tmp_path / "compose.yaml"
    path.touch()
    return path


def user_map(folder: Path, text: str) -> Path:
    path = folder / "uid_map"
    path.write_text(text, encoding="ascii")
    return path


def read_owner(path: Path) -> object:
    facts = path.lstat()
    return Owner(facts.st_uid, facts.st_gid)


@needs_root
def test_results_go_to_the_marks_owner(mark: Path) -> None:
    os.chown(mark, *SOMEBODY)
    assert entry.find_results_owner(mark) == SOMEBODY


@needs_root
def test_commands_never_run_as_the_hosts_root(mark: Path, tmp_path: Path) -> None:
    nowhere = user_map(tmp_path, "         0          0 4294967295\n")
    assert entry.find_results_owner(mark, nowhere) == Owner(entry.SERVANT, entry.SERVANT)


@needs_root
def test_root_in_rootless_engine_is_the_starter(mark: Path, tmp_path: Path) -> None:
    rootless = user_map(tmp_path, "0 1000 1\n1 100000 65536\n")
    assert entry.find_results_owner(mark, rootless) == Owner(0, 0)


@needs_root
@pytest.mark.parametrize("exists", [False, True])
def test_folders_made_by_the_engine_are_given_away(tmp_path: Path, exists: bool) -> None:
    results = tmp_path / "runs" / "compose"
    results.parent.mkdir()
    if exists:
        results.mkdir()
        (results / "report.html").touch()
    entry.give_folder(results, SOMEBODY)
    assert {read_owner(path) for path in (results.parent, results, *results.iterdir())} == {
        SOMEBODY
    }


@needs_root
def test_root_keeps_its_own_folder(tmp_path: Path) -> None:
    results = tmp_path / "runs" / "compose"
    results.parent.mkdir()
    entry.give_folder(results, Owner(entry.SERVANT, entry.SERVANT))
    assert read_owner(results.parent) == Owner(0, 0)
    assert read_owner(results) == Owner(entry.SERVANT, entry.SERVANT)


@needs_root
def test_nobody_loses_ownership(tmp_path: Path) -> None:
    """A folder and its contents keep their owners, and a link is changed instead of its target."""
    theirs = tmp_path / "theirs"
    results = tmp_path / "runs" / "compose"
    results.mkdir(parents=True)
    secret = tmp_path / "secret"
    link = results / "link"
    kept = results / "kept"
    secret.touch()
    kept.touch()
    link.symlink_to(secret)
    os.chown(kept, 99, 99)
    entry.give_folder(results, SOMEBODY)
    assert (read_owner(secret), read_owner(kept), read_owner(link)) == (
        Owner(0, 0),
        Owner(99, 99),
        SOMEBODY,
    )
    theirs.mkdir()
    (theirs / "kept").touch()
    os.chown(theirs, 99, 99)
    entry.give_folder(theirs, SOMEBODY)
    assert (read_owner(theirs), read_owner(theirs / "kept")) == (Owner(99, 99), Owner(0, 0))


def test_an_unwritable_folder_is_named_with_owner(
    tmp_path: Path,
    mark: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 1234)
    monkeypatch.setattr(os, "getgid", lambda: 1235)
    monkeypatch.setattr(os, "access", lambda *_, **__: False)
    with pytest.raises(SystemExit) as end:
        entry.prepare_results(tmp_path, mark)
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: user 1234:1235 cannot write into {tmp_path}: ")
    assert f"sudo chown -R 1234:1235 {tmp_path}" in said
    assert len(said.splitlines()) == 1


def test_a_missing_mark_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "getuid", lambda: 0)
    with pytest.raises(SystemExit):
        entry.prepare_results(tmp_path, tmp_path / "missing")
    assert "No such file" in capsys.readouterr().err


def test_missing_caches_fail_nothing_and_others_copy(tmp_path: Path) -> None:
    held = tmp_path / "held"
    private = tmp_path / "own"
    entry.copy_cache(held, private)
    assert not private.exists()
    (held / "deep").mkdir(parents=True)
    (held / "deep" / "code").write_bytes(b"compiled")
    for _ in range(2):  # a container that is started again has it already
        entry.copy_cache(held, private)
        assert (private / "deep" / "code").read_bytes() == b"compiled"


def test_the_entry_becomes_the_command(
    tmp_path: Path, mark: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    became: list[Sequence[str]] = []
    monkeypatch.setattr(os, "getuid", lambda: 1234)
    monkeypatch.setattr(os, "execvp", lambda _file, arguments: became.append(arguments))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    results = tmp_path / "runs"
    entry.main(
        ["--results", str(results), "--heir", str(mark), "trilat", "record", "--session", "x"]
    )
    entry.main(["trilat", "sim", "-o", "x.mcap"])
    assert became == [["trilat", "record", "--session", "x"], ["trilat", "sim", "-o", "x.mcap"]]
    assert results.is_dir()


PROGRAM = """#!/usr/bin/env python3
import json, os, sys
folder, members = sys.argv[3], [word for word in sys.argv[4:] if word != "--host"]
for name in {*members, "authority"}:
    os.makedirs(os.path.join(folder, name), 0o700)
    for file in ("members.json", "private.key"):
        with open(os.path.join(folder, name, file), "w") as sink:
            sink.write(f"{name} by {os.getuid()}")
"""
"""Stands for `trilat keys new DIR MEMBER...`."""


@pytest.fixture
def volumes() -> Iterator[Path]:
    """The members' volumes, which any user may read, and the program's volume."""
    with tempfile.TemporaryDirectory() as name:
        volume_folder = Path(name)
        volume_folder.chmod(0o755)
        for folder in ("keys/recorder", "keys/m1", "keys/s", "scratch"):
            (volume_folder / folder).mkdir(parents=True)
            (volume_folder / folder).chmod(0o1777)
        (volume_folder / "program").write_text(PROGRAM)
        (volume_folder / "program").chmod(0o755)
        yield volume_folder / "keys"


def hand_out(volumes: Path, user: Any) -> None:
    entry.distribute_keys(
        volumes, str(volumes.with_name("program")), user, volumes.with_name("scratch")
    )


@needs_root
def test_members_get_own_keys_and_authority_disappears(volumes: Path) -> None:
    hand_out(volumes, SOMEBODY)
    for name, whose in (("recorder", SOMEBODY), ("m1", Owner(entry.SITES, entry.SITES))):
        for file in ("members.json", "private.key"):
            assert read_owner(volumes / name / file) == whose
            assert (volumes / name / file).stat().st_mode & 0o777 == 0o600
            assert (
                volumes / name / file
            ).read_text() == f"{name} by {SOMEBODY.user}"  # not by root
    assert list(volumes.with_name("scratch").iterdir()) == []
    assert entry.are_fresh(volumes / "s")


@needs_root
def test_valid_keys_are_kept_and_expired_ones_replaced(volumes: Path) -> None:
    def made_by(user: int) -> set[str]:
        hand_out(volumes, Owner(user, user))
        return {
            (volumes / name / "private.key").read_text().split()[-1]
            for name in ("recorder", "m1", "s")
        }

    assert made_by(4321) == {"4321"}
    assert made_by(4322) == {"4321"}
    os.utime(volumes / "s" / entry.MARK, (0, 0))
    assert not entry.are_fresh(volumes / "s")
    assert made_by(4323) == {"4323"}


def test_a_site_waits_for_its_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter(range(0, 1000, 10))
    waits = SimpleNamespace(monotonic=lambda: next(clock), time=time.time, sleep=lambda _: None)
    monkeypatch.setitem(entry.await_keys.__globals__, "time", waits)
    with pytest.raises(SystemExit):
        entry.await_keys(tmp_path)
    assert "no keys in" in capsys.readouterr().err
    (tmp_path / entry.MARK).touch()
    entry.await_keys(tmp_path)
