"""What the doctor finds: each trouble by itself, made here, against a machine without it."""

import json
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from sites import doctor
from sites.doctor import examine_clock, examine_keys, examine_links, examine_machine, examine_room
from tests.cli.running import trilat
from tests.net.manual_clock import ManualClock
from trilat_net.net.clock import SystemClock
from trilat_net.net.connection import Connection, find_free_endpoints
from trilat_net.net.member_keys import create_keys, read_member_keys
from trilat_net.net.zenoh_bus import ZenohBus

MEMBERS = ("m1", "s", "recorder")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("deployment") / "keys"
    create_keys(made, MEMBERS, [], 30)
    shutil.move(made / "authority", made.parent / "safe")
    return made


def states(findings: Iterator[doctor.DoctorFinding]) -> list[str]:
    return [finding.state for finding in findings]


def test_keys_that_are_well_are_well(folder: Path) -> None:
    (found,) = examine_keys(folder / "m1")
    assert found.state == "ok"
    assert "m1 of m1, s, recorder, until" in found.text
    assert states(examine_keys(None)) == ["ok"]


def test_keys_that_end_soon_or_lie_open_are_told(tmp_path: Path) -> None:
    create_keys(tmp_path / "keys", MEMBERS, [], 3)
    (tmp_path / "keys" / "m1").chmod(0o755)
    found = list(examine_keys(tmp_path / "keys" / "m1"))
    assert [one.state for one in found] == ["warn"] * 3
    assert ["soon" in found[0].text, "chmod 700" in found[1].text, "authority" in found[2].text] == [True] * 3
    (tmp_path / "keys" / "m1" / "private.key").chmod(0o640)
    (refused,) = examine_keys(tmp_path / "keys" / "m1")
    assert refused.state == "fail"
    assert "chmod 600" in refused.text


def links(folder: Path | None, listen: list[str], connect: list[str], *, insecure: bool = False) -> list[str]:
    owned = None if folder is None else read_member_keys(folder)
    return states(examine_links(Connection(listen, connect), folder, owned, insecure=insecure))


@contextmanager
def member(folder: Path, place: str) -> Iterator[None]:
    bus = ZenohBus([place], own=read_member_keys(folder).settings)
    try:
        yield
    finally:
        bus.close()


def test_member_with_keys_answers_one_with_keys_of_same_authority(folder: Path, tmp_path: Path) -> None:
    create_keys(tmp_path / "others", MEMBERS, [], 30)
    (place, nobody) = (one.replace("tcp", "tls") for one in find_free_endpoints(2))
    with member(folder / "m1", place):
        assert links(folder / "s", [], [place]) == ["ok"]
        assert links(tmp_path / "others" / "s", [], [place]) == ["fail"]  # another authority
        assert links(folder / "s", [place], []) == ["fail"]  # the port is taken
    assert links(folder / "s", [], [nobody]) == ["fail"]
    assert links(folder / "s", [nobody], []) == ["ok"]


@pytest.mark.long
def test_so_it_is_over_quic(folder: Path, tmp_path: Path) -> None:
    create_keys(tmp_path / "others", MEMBERS, [], 30)
    (place, nobody) = (one.replace("tcp", "quic") for one in find_free_endpoints(2))
    with member(folder / "m1", place):
        assert links(folder / "s", [], [place]) == ["ok"]
        assert links(tmp_path / "others" / "s", [], [place]) == ["fail"]
        assert links(None, [], [place]) == ["warn"]
        assert links(folder / "s", [place], []) == ["fail"]
    assert links(folder / "s", [], [nobody]) == ["fail"]
    assert links(folder / "s", [nobody], []) == ["ok"]


def test_endpoints_that_are_open_to_a_network_are_told() -> None:
    assert links(None, ["tcp/0.0.0.0:0"], []) == ["fail"]
    assert links(None, ["tcp/0.0.0.0:0"], [], insecure=True) == ["warn"]
    assert links(None, ["tcp/127.0.0.1:0"], []) == ["ok"]
    assert links(None, [], ["quic/127.0.0.1:1"]) == ["warn"]  # not tried
    with socket.create_server(("127.0.0.1", 0)) as there:
        assert links(None, [], [f"tcp/127.0.0.1:{there.getsockname()[1]}"]) == ["ok"]


class OddClock(ManualClock):
    """A clock that goes on by itself, and does something odd once."""

    def __init__(self, odd_ns: int = 0, wall_step_ns: int = 0) -> None:
        super().__init__()
        self._reads, self._now, self._odd, self._step = 0, 0, odd_ns, wall_step_ns

    def monotonic_ns(self) -> int:
        self._reads += 1
        self._now += 1_000_000 + (self._odd if self._reads == 9 else 0)
        return self._now

    def unix_ns(self) -> int:
        return self._now + (self._step if self._reads > 9 else 0)


@pytest.mark.parametrize(("clock", "state"), [((), "ok"), ((-5_000_000,), "fail"), ((0, 1 << 30), "warn")])
def test_a_clock_that_goes_back_or_steps_is_told(clock: tuple[int, ...], state: str) -> None:
    assert states(examine_clock(OddClock(*clock))) == [state]


@pytest.mark.parametrize(("free", "state"), [(50 << 20, "fail"), (1 << 30, "warn"), (1 << 40, "ok")])
def test_a_disk_that_is_nearly_full_is_told(
    free: int, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    found = [one for one in examine_room(tmp_path / "not" / "there") if one.check == "disk"]
    assert [one.state for one in found] == [state]


def test_rights_that_are_not_obtained_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    obtained = {"scheduling": "normal (not permitted)", "memory": "locked", "timer_slack": "1 ns"}
    done = SimpleNamespace(returncode=0, stdout=json.dumps(obtained))
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: done)
    assert states(doctor.examine_rights()) == ["warn", "ok", "ok"]


def test_the_command_exits_with_1_if_something_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "examine_rights", lambda: iter(()))
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    done = trilat("doctor", "--json", cwd=tmp_path)
    assert {one["check"] for one in json.loads(done.out)} >= {"keys", "links", "clock", "disk", "processors"}
    done = trilat("doctor", "--listen", "tcp/0.0.0.0:7447", cwd=tmp_path)
    assert done.code == 1
    assert "fail links" in done.out
    assert "--insecure" in done.out


def test_a_session_that_nobody_answers_for_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CONNECT_S", 0.2)
    connection = Connection((), find_free_endpoints(1))
    found = list(examine_machine(connection, None, tmp_path, "x", SystemClock(), insecure=False))
    assert ("clock", "fail") in {(one.check, one.state) for one in found}
