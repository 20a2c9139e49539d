"""The findings of the doctor: each trouble alone, made here, against a machine without trouble."""

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
from tests.net.free_endpoints import find_free_endpoints
from tests.net.manual_clock import ManualClock
from tests.other_systems import replace_os
from trilat_net.app import doctor
from trilat_net.app.doctor import MachineExamination
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import Connection
from trilat_net.net.member_keys import create_keys, read_member_keys
from trilat_net.net.zenoh_bus import ZenohBus

MEMBERS = ("m1", "s", "recorder")
NO_ENDPOINTS = Connection((), ())


def test_a_failing_measurement_gives_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    failing = "raise MemoryError('no more pages')"
    monkeypatch.setattr(doctor, "_RATES_CODE", failing)
    monkeypatch.setattr(doctor, "_RIGHTS_CODE", failing)
    monkeypatch.setattr(doctor, "is_core_cached", lambda: True)
    for finding in (MachineExamination.check_rate(), *MachineExamination.check_rights()):
        assert finding.state == "warn"
        assert finding.text.endswith("failed (exit code 1: MemoryError: no more pages)")


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
    keys_folder = tmp_path_factory.mktemp("deployment") / "keys"
    create_keys(keys_folder, MEMBERS, [], 30)
    shutil.move(keys_folder / "authority", keys_folder.parent / "safe")
    return keys_folder


class UnpunctualClock(ManualClock):
    """A clock that only sleeping moves, and on which some sleeps end late."""

    def __init__(self, late_ns: int, every: int) -> None:
        super().__init__()
        self._late_ns = late_ns
        self._every = every
        self._sleeps = 0

    def sleep_until(self, deadline_ns: int) -> None:
        self._sleeps += 1
        super().sleep_until(
            deadline_ns + (self._late_ns if self._sleeps % self._every == 0 else 0)
        )


def examine_machine(
    connection: Connection = NO_ENDPOINTS,
    keys: Path | None = None,
    clock: Clock | None = None,
    session: str | None = None,
    *,
    folder: Path = Path(),
    insecure: bool = False,
) -> MachineExamination:
    return MachineExamination(
        connection=connection,
        keys=keys,
        folder=folder,
        session=session,
        clock=clock or SystemClock(),
        insecure=insecure,
    )


def list_states(findings: Iterator[doctor.DoctorFinding]) -> list[str]:
    return [finding.state for finding in findings]


def test_valid_keys_pass(folder: Path) -> None:
    (finding,) = examine_machine(keys=folder / "m1").check_keys()
    assert finding.state == "ok"
    assert "keys of m1 for m1, s, recorder, valid until" in finding.text
    assert list_states(examine_machine().check_keys()) == ["ok"]


def test_keys_ending_soon_or_open_are_reported(tmp_path: Path) -> None:
    create_keys(tmp_path / "keys", MEMBERS, [], 3)
    (tmp_path / "keys" / "m1").chmod(0o755)
    findings = list(examine_machine(keys=tmp_path / "keys" / "m1").check_keys())
    assert [finding.state for finding in findings] == ["warn"] * 3
    assert [
        "soon" in findings[0].text,
        "chmod 700" in findings[1].text,
        "authority" in findings[2].text,
    ] == [True] * 3
    (tmp_path / "keys" / "m1" / "private.key").chmod(0o640)
    (refused,) = examine_machine(keys=tmp_path / "keys" / "m1").check_keys()
    assert refused.state == "fail"
    assert "chmod 600" in refused.text


def examine_connection(
    folder: Path | None, listen: list[str], connect: list[str], *, insecure: bool = False
) -> list[str]:
    examination = examine_machine(Connection(listen, connect), folder, insecure=insecure)
    return list_states(examination.check_links())


@contextmanager
def open_member(folder: Path, place: str) -> Iterator[None]:
    bus = ZenohBus([place], settings=read_member_keys(folder).settings)
    try:
        yield
    finally:
        bus.close()


def test_members_answer_keys_of_their_authority(folder: Path, tmp_path: Path) -> None:
    create_keys(tmp_path / "others", MEMBERS, [], 30)
    (endpoint, nobody) = (
        free_endpoint.replace("tcp", "tls") for free_endpoint in find_free_endpoints(2)
    )
    with open_member(folder / "m1", endpoint):
        assert examine_connection(folder / "s", [], [endpoint]) == ["ok"]
        assert examine_connection(tmp_path / "others" / "s", [], [endpoint]) == [
            "fail"
        ]  # another authority
        assert examine_connection(folder / "s", [endpoint], []) == ["fail"]  # the port is taken
    assert examine_connection(folder / "s", [], [nobody]) == ["fail"]
    assert examine_connection(folder / "s", [nobody], []) == ["ok"]


@pytest.mark.long
def test_members_answer_over_quic(folder: Path, tmp_path: Path) -> None:
    create_keys(tmp_path / "others", MEMBERS, [], 30)
    (endpoint, nobody) = (
        free_endpoint.replace("tcp", "quic") for free_endpoint in find_free_endpoints(2)
    )
    with open_member(folder / "m1", endpoint):
        assert examine_connection(folder / "s", [], [endpoint]) == ["ok"]
        assert examine_connection(tmp_path / "others" / "s", [], [endpoint]) == ["fail"]
        assert examine_connection(None, [], [endpoint]) == ["warn"]
        assert examine_connection(folder / "s", [endpoint], []) == ["fail"]
    assert examine_connection(folder / "s", [], [nobody]) == ["fail"]
    assert examine_connection(folder / "s", [nobody], []) == ["ok"]


def test_endpoints_open_to_networks_are_reported() -> None:
    assert examine_connection(None, ["tcp/0.0.0.0:0"], []) == ["fail"]
    assert examine_connection(None, ["tcp/0.0.0.0:0"], [], insecure=True) == ["warn"]
    assert examine_connection(None, ["tcp/127.0.0.1:0"], []) == ["ok"]
    assert examine_connection(None, [], ["quic/127.0.0.1:1"]) == ["warn"]  # not tried
    with socket.create_server(("127.0.0.1", 0)) as listener:
        assert examine_connection(None, [], [f"tcp/127.0.0.1:{listener.getsockname()[1]}"]) == [
            "ok"
        ]


class OddClock(ManualClock):
    """A clock that advances by itself, and does something odd once."""

    def __init__(self, odd_ns: int = 0, wall_step_ns: int = 0) -> None:
        super().__init__()
        self._reads = 0
        self._now = 0
        self._odd = odd_ns
        self._step = wall_step_ns

    def monotonic_ns(self) -> int:
        self._reads += 1
        self._now += 1_000_000 + (self._odd if self._reads == 9 else 0)
        return self._now

    def unix_ns(self) -> int:
        return self._now + (self._step if self._reads > 9 else 0)


@pytest.mark.parametrize(
    ("clock", "state"), [((), "ok"), ((-5_000_000,), "fail"), ((0, 1 << 30), "warn")]
)
def test_clocks_that_go_back_are_reported(clock: tuple[int, ...], state: str) -> None:
    assert list_states(examine_machine(clock=OddClock(*clock)).check_clock()) == [state]


@pytest.mark.parametrize(
    ("free", "state"), [(50 << 20, "fail"), (1 << 30, "warn"), (1 << 40, "ok")]
)
def test_a_nearly_full_disk_is_reported(
    free: int, state: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    findings = [
        finding
        for finding in examine_machine(folder=tmp_path / "not" / "there").check_room()
        if finding.check == "disk"
    ]
    assert [found_item.state for found_item in findings] == [state]


def test_missing_rights_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    obtained = {
        "scheduling": "normal (not permitted)",
        "memory": "locked",
        "timer_slack": "1 ns",
    }
    done = SimpleNamespace(returncode=0, stdout=json.dumps(obtained))
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: done)
    assert list_states(MachineExamination.check_rights()) == ["warn", "ok", "ok"]


@pytest.mark.parametrize(
    ("late_ns", "stride", "held"),
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
def test_rates_hold_if_ticks_begin_in_time(late_ns: int, stride: int, held: list[bool]) -> None:
    """One tick in a hundred may begin in the second half of its period, or later."""
    rates = doctor.rehearse_rates(UnpunctualClock(late_ns, stride))
    assert [late_us <= 500_000 / rate_hz for rate_hz, late_us, _ in rates] == held
    assert [rate_hz for rate_hz, _, _ in rates] == list(doctor.RATES_HZ[: len(held)])
    assert rates[0][2] == late_ns // 1000


@pytest.mark.parametrize(
    ("rates", "state", "text"),
    [
        (
            [(1000, 90, 4000)],
            "ok",
            "achieves 1000 Hz: 99% of the ticks began within 0.09 ms of their time",
        ),
        ([(1000, 700, 900), (500, 700, 900)], "warn", "achieves 500 Hz"),
        ([(100, 9000, 12000)], "fail", "does not even achieve 100 Hz"),
    ],
)
def test_rates_are_reported_with_their_lateness(
    rates: list[tuple[int, int, int]], state: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = SimpleNamespace(returncode=0, stdout=json.dumps(rates))
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: done)
    finding = MachineExamination.check_rate()
    assert finding.state == state
    assert text in finding.text


@pytest.mark.push
def test_real_loops_are_measured_in_own_processes() -> None:
    assert MachineExamination.check_rate().text.startswith("a single site ")


@pytest.mark.parametrize(
    ("kernel", "name"), [("Windows", "Windows"), ("Darwin", "macOS"), ("Linux", "")]
)
def test_promised_findings_are_reported(
    kernel: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(platform, "system", lambda: kernel)
    finding = MachineExamination.check_system()
    assert finding.state == ("warn" if name else "ok")
    assert name in finding.text


def test_open_rights_are_no_finding_on_windows(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mode of a file on Windows only says whether the file can be written."""
    (folder / "m1" / "private.key").chmod(0o666)
    try:
        monkeypatch.setattr("trilat_net.net.member_keys.sys", SimpleNamespace(platform="win32"))
        monkeypatch.setattr("trilat_net.files.os", replace_os())
        assert list_states(examine_machine(keys=folder / "m1").check_keys()) == ["ok"]
    finally:
        (folder / "m1" / "private.key").chmod(0o600)


def test_the_command_exits_1_on_failures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MachineExamination, "check_rights", lambda _: iter(()))
    finding = doctor.DoctorFinding("rate", "ok", "")
    monkeypatch.setattr(MachineExamination, "check_rate", lambda _: finding)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.0, 0.0, 0.0))
    done = trilat("doctor", "--json", cwd=tmp_path)
    assert {finding["check"] for finding in json.loads(done.out)} >= {
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


def test_an_unanswering_session_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "CONNECT_S", 0.2)
    connection = Connection((), find_free_endpoints(1))
    findings = list(examine_machine(connection, session="x", folder=tmp_path).run())
    assert ("clock", "fail") in {(finding.check, finding.state) for finding in findings}
