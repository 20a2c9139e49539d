"""The files of the sites that run on this machine: hints for stopping the sites at once."""

import os
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.net.clock import SystemClock
from trilat_net.net.connection import Connection
from trilat_net.net.known_sites import (
    find_known_endpoints,
    find_known_sites,
    make_site_known,
    stop_at_once,
)

HERE = Connection(("tcp/127.0.0.1:1",), ("tcp/127.0.0.1:2",))
SITES = ("m", "s")


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "trilat-net" / "running"


def test_running_sites_are_known_to_their_user(state: Path) -> None:
    assert find_known_sites("t") == []
    with make_site_known("t", "s", SITES, 7, HERE, b"order"):
        (known_site,) = find_known_sites("t")
        assert (
            known_site.site,
            tuple(known_site.sites),
            known_site.stop,
            known_site.keyed,
        ) == (
            "s",
            SITES,
            b"order",
            False,
        )
        assert known_site.places == ["tcp/127.0.0.1:1", "tcp/127.0.0.1:2"]
        assert find_known_sites("another") == []
        (file,) = state.iterdir()
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert stat.S_IMODE(state.stat().st_mode) == 0o700
    assert list(state.iterdir()) == []


def test_dead_processes_and_machines_count_nothing(state: Path) -> None:
    with make_site_known("t", "s", SITES, 7, HERE, b"order"):
        (known_site,) = find_known_sites("t")
    gone = subprocess.Popen([sys.executable, "-S", "-c", ""])
    gone.wait()
    for n, stale in enumerate(
        (
            msgspec.structs.replace(known_site, pid=gone.pid),
            msgspec.structs.replace(known_site, machine=f"not {SystemClock().identity()}"),
        )
    ):
        (state / f"{n}.json").write_bytes(msgspec.json.encode(stale))
    assert find_known_sites("t") == []
    assert list(state.iterdir()) == []


@given(st.binary())
def test_invalid_site_files_are_ignored(data: bytes) -> None:
    folder = Path(os.environ["XDG_STATE_HOME"]) / "trilat-net" / "running"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "x.json").write_bytes(data)
    assert find_known_sites("t") == []


def test_sites_run_without_writable_files(state: Path) -> None:
    state.parent.write_text("no folder")
    with make_site_known("t", "s", SITES, 7, HERE, b"order"):
        assert find_known_sites("t") == []


def test_endpoints_are_known_as_reachable() -> None:
    with make_site_known("t", "m", SITES, 6, HERE, b"order"):
        assert find_known_endpoints("t", Connection(connect=None)) is None
        with make_site_known("t", "s", SITES, 7, Connection(("tcp/127.0.0.1:2",)), b"order"):
            assert find_known_endpoints("t", Connection(connect=None)) == [
                "tcp/127.0.0.1:1",
                "tcp/127.0.0.1:2",
            ]
            assert (
                find_known_endpoints("t", Connection(connect=None, keys_of="operator")) is None
            )
            assert find_known_endpoints("t", Connection(connect=None, mode="client")) is None


def test_sites_with_own_settings_are_private() -> None:
    with make_site_known("t", "s", SITES, 7, replace(HERE, settings={"x": 1}), b"order"):
        assert find_known_sites("t") == []


@pytest.mark.parametrize(
    "arguments", [[], ["--session"], ["--session", "t", "--end"], ["--help"], ["s"]]
)
def test_other_commands_take_the_normal_way_quietly(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert stop_at_once(arguments) == arguments
    assert capsys.readouterr().out == ""


@given(st.lists(st.text()))
def test_arbitrary_words_take_the_normal_way(arguments: list[str]) -> None:
    assert stop_at_once(arguments) == arguments


def test_stops_report_their_attempt_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert stop_at_once(["--session=t", "m", "s"]) == ["--session=t", "m", "s"]
    assert capsys.readouterr().out == "stopping m, s of session t ...\n"
    assert stop_at_once(["--session", "t", "--connect", "tcp/127.0.0.1:1"])
    assert capsys.readouterr().out == "stopping every arm of session t ...\n"


def test_missing_keys_are_reported(capsys: pytest.CaptureFixture[str]) -> None:
    with make_site_known(
        "t", "s", SITES, 7, replace(HERE, keys_of="operator", settings={"x": 1}), b"order"
    ):
        assert stop_at_once(["--session", "t"]) == 2
    assert "have keys: add --keys DIR" in capsys.readouterr().err


def test_stops_import_only_their_needs() -> None:
    code = (
        "import sys; from trilat_net.net.known_sites import stop_at_once; stop_at_once(['--session', 't']); "
        "print(*{'numba', 'numpy', 'scipy', 'typer', 'rich', 'cryptography', 'mcap'} & {*sys.modules})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], check=True, capture_output=True, text=True
    )
    assert done.stdout == "stopping every arm of session t ...\n\n"
