"""What the doctor finds: each trouble by itself, made here, against a machine without it."""

import json
import os
import platform
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.cli.running import trilat
from tests.net.manual_clock import ManualClock
from tests.other_systems import replace_os
from trilat_net.app import doctor
from trilat_net.app.doctor import (
    examine_clock,
    examine_keys,
    examine_links,
    examine_machine,
    examine_room,
)
from trilat_net.net.clock import SystemClock
from trilat_net.net.connection import Connection, find_free_endpoints
from trilat_net.net.member_keys import create_keys, read_member_keys
from trilat_net.net.zenoh_bus import ZenohBus

MEMBERS = ("m1", "s", "recorder")


def test_a_measurement_that_fails_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    failing = "raise MemoryError('no more pages')"
    monkeypatch.setattr(doctor, "_RATES_CODE", failing)
    monkeypatch.setattr(doctor, "_RIGHTS_CODE", failing)
    monkeypatch.setattr(doctor, "is_core_cached", lambda: True)
    for found in (doctor.examine_rate(), *doctor.examine_rights()):
        assert found.state == "warn"
        assert found.text.endswith("failed (exit code 1: MemoryError: no more pages)")


def test_processes_of_their_own_measure() -> None:
    short = "from trilat_net.app import doctor; doctor.RATES_HZ = (100,); doctor.REHEARSAL_S = 0.05\n"
    ((rate_hz, late_us, largest_us),) = doctor._run_in_process(short + doctor._RATES_CODE)
    assert rate_hz == 100
    assert 0 <= late_us <= largest_us
    assert {"scheduling", "memory", "timer_slack"} <= set(
        doctor._run_in_process(doctor._RIGHTS_CODE)
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("deployment") / "keys"
    create_keys(made, MEMBERS, [], 30)
    shutil.move(made / "authority", made.parent / "safe")
    return made


class UnpunctualClock(ManualClock):
    """A clock that only sleeping moves, and on which some sleeps end late."""

    def __init__(self, late_ns: int, every: int) -> None:
        super().__init__()
        self._late_ns, self._every, self._sleeps = late_ns, every, 0

    def sleep_until(self, deadline_ns: int) -> None:
        self._sleeps += 1
        super().sleep_until(
            deadline_ns + (self._late_ns if self._sleeps % self._every == 0 else 0)
        )


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
    assert [
        "soon" in found[0].text,
        "chmod 700" in found[1].text,
        "authority" in found[2].text,
    ] == [True] * 3
    (tmp_path / "keys" / "m1" / "private.key").chmod(0o640)
    (refused,) = examine_keys(tmp_path / "keys" / "m1")
    assert refused.state == "fail"
    assert "chmod 600" in refused.text


def links(
    folder: Path | None, listen: list[str], connect: list[str], *, insecure: bool = False
) -> list[str]:
    owned = None if folder is None else read_member_keys(folder)
    return states(examine_links(Connection(listen, connect), folder, owned, insecure=insecure))


@contextmanager
def member(folder: Path, place: str) -> Iterator[None]:
    bus = ZenohBus([place], settings=read_member_keys(folder).settings)
    try:
        yield
    finally:
        bus.close()


def test_member_with_keys_answers_one_with_keys_of_same_authority(
    folder: Path, tmp_path: Path
) -> None:
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


@pytest.mark.parametrize(
    ("clock", "state"), [((), "ok"), ((-5_000_000,), "fail"), ((0, 1 << 30), "warn")]
)
def test_a_clock_that_goes_back_or_steps_is_told(clock: tuple[int, ...], state: str) -> None:
    assert states(examine_clock(OddClock(*clock))) == [state]


@pytest.mark.parametrize(
    ("free", "state"), [(50 << 20, "fail"), (1 << 30, "warn"), (1 << 40, "ok")]
)
def test_a_disk_that_is_nearly_full_is_told(
    free: int, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    found = [one for one in examine_room(tmp_path / "not" / "there") if one.check == "disk"]
    assert [one.state for one in found] == [state]


def test_rights_that_are_not_obtained_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    obtained = {
        "scheduling": "normal (not permitted)",
        "memory": "locked",
        "timer_slack": "1 ns",
    }
    done = SimpleNamespace(returncode=0, stdout=json.dumps(obtained))
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: done)
    assert states(doctor.examine_rights()) == ["warn", "ok", "ok"]


@pytest.mark.parametrize(
    ("late_ns", "every", "held"),
    [
        (400_000, 10, [True]),
        (
            600_000,
            10,
            [False, True],
        ),  # more than half a period of 1000 Hz, and less than half of 500 Hz
        (10_000_000, 10, [False] * 4),
        (2_000_000, 400, [True]),
    ],
)
def test_a_rate_is_held_if_ticks_begin_in_time(
    late_ns: int, every: int, held: list[bool]
) -> None:
    """One tick in a hundred may begin in the second half of its period, or later."""
    found = doctor.rehearse_rates(UnpunctualClock(late_ns, every))
    assert [doctor.is_held(*one[:2]) for one in found] == held
    assert [rate_hz for rate_hz, _, _ in found] == list(doctor.RATES_HZ[: len(held)])
    assert found[0][2] == late_ns // 1000


@pytest.mark.parametrize(
    ("rates", "state", "text"),
    [
        (
            [(1000, 90, 4000)],
            "ok",
            "holds 1000 Hz: 99% of the ticks began within 0.09 ms of their time",
        ),
        ([(1000, 700, 900), (500, 700, 900)], "warn", "holds 500 Hz"),
        ([(100, 9000, 12000)], "fail", "holds not even 100 Hz"),
    ],
)
def test_the_rate_is_told_with_how_late_ticks_were(
    rates: list[tuple[int, int, int]], state: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = SimpleNamespace(returncode=0, stdout=json.dumps(rates))
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: done)
    found = doctor.examine_rate()
    assert found.state == state
    assert text in found.text


@pytest.mark.push
def test_a_real_loop_is_measured_in_its_own_process() -> None:
    assert doctor.examine_rate().text.startswith("a site alone ")


@pytest.mark.parametrize(
    ("kernel", "name"), [("Windows", "Windows"), ("Darwin", "macOS"), ("Linux", "")]
)
def test_what_is_promised_here_is_told(
    kernel: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "system", lambda: kernel)
    found = doctor.examine_system()
    assert found.state == ("warn" if name else "ok")
    assert name in found.text


def test_open_rights_are_no_finding_on_windows(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Windows lets a mode tell nothing but whether a file can be written."""
    (folder / "m1" / "private.key").chmod(0o666)
    try:
        monkeypatch.setattr("trilat_net.net.member_keys.sys", SimpleNamespace(platform="win32"))
        monkeypatch.setattr("trilat_net.files.os", replace_os())
        assert states(examine_keys(folder / "m1")) == ["ok"]
    finally:
        (folder / "m1" / "private.key").chmod(0o600)


def test_the_command_exits_with_1_if_something_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "examine_rights", lambda: iter(()))
    monkeypatch.setattr(doctor, "examine_rate", lambda: doctor.DoctorFinding("rate", "ok", ""))
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    done = trilat("doctor", "--json", cwd=tmp_path)
    assert {one["check"] for one in json.loads(done.out)} >= {
        "keys",
        "links",
        "clock",
        "disk",
        "processors",
    }
    done = trilat("doctor", "--listen", "tcp/0.0.0.0:7447", cwd=tmp_path)
    assert done.code == 1
    assert "fail links" in done.out
    assert "--insecure" in done.out


def test_a_session_that_nobody_answers_for_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(doctor, "CONNECT_S", 0.2)
    connection = Connection((), find_free_endpoints(1))
    found = list(
        examine_machine(connection, None, tmp_path, "x", SystemClock(), insecure=False)
    )
    assert ("clock", "fail") in {(one.check, one.state) for one in found}
