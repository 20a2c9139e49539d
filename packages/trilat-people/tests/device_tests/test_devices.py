"""Devices, each against a stand-in with its protocol: the common contract, and the features of each."""

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from trilat_people.devices import open_device
from trilat_people.devices.haply_inverse3 import HaplyInverse3
from trilat_people.devices.spacemouse import SpaceMouse

from tests.cli.running import trilat
from tests.net.manual_clock import ManualClock
from tests.net.waiting import until
from tests.sites.devices import ZERO, CapReports, HaplyService
from trilat_net.app.input_device import Device, DeviceState
from trilat_net.errors import UsageError

FORCE = (0.5, -1.0, 1.5)


@pytest.fixture
def service() -> Iterator[HaplyService]:
    """A service that speaks the protocol of Haply's Inverse3."""
    with HaplyService() as haply_service:
        yield haply_service


@pytest.fixture
def cap() -> Iterator[CapReports]:
    """A file with the reports of a SpaceMouse."""
    reports = CapReports()
    yield reports
    reports.close()


@pytest.fixture(params=["haply_inverse3", "spacemouse"])
def removable_device(
    request: pytest.FixtureRequest, service: HaplyService, cap: CapReports
) -> tuple[Device, Callable[[], None]]:
    """Returns a device by its name and address, and a function that removes the device."""
    address, lose = {
        "haply_inverse3": (service.address, service.kill),
        "spacemouse": (cap.path, cap.unplug),
    }[request.param]
    return open_device(f"{request.param}={address}"), lose


def test_device_reads_renders_and_is_entered_again(
    removable_device: tuple[Device, Callable[[], None]],
) -> None:
    """A device gives finite states and takes forces, also when it is entered a second time."""
    device, _ = removable_device
    assert 50 <= device.rate_hz <= 1000
    for _ in range(2):
        with device:
            for _ in range(3):
                state = device.read()
                assert len(state.position_m) == len(state.velocity_m_s) == 3
                assert all(map(math.isfinite, (*state.position_m, *state.velocity_m_s)))
                assert {"a", "b"} <= state.buttons.keys()
                assert not any(state.buttons.values())
                device.render(FORCE)


def test_lost_devices_raise_a_system_error(
    removable_device: tuple[Device, Callable[[], None]],
) -> None:
    """A device that is removed while it is used raises an error of the system."""
    device, lose = removable_device
    with device:
        device.read()
        lose()
        with pytest.raises(OSError, match=r"service|SpaceMouse"):
            use_device(device)


def use_device(device: Device) -> None:
    """Renders and reads a few times."""
    for _ in range(3):
        device.render(ZERO)
        device.read()


def test_devices_are_known_by_name() -> None:
    with pytest.raises(UsageError, match="one of haply_inverse3, spacemouse"):
        open_device("phantom")


def test_the_command_names_its_missing_device(tmp_path: Path) -> None:
    for options, problem in (
        (("--session", "play"), "needs --scenario"),
        (("--session", "play", "--device", "spacemouse", "--set", "seed=2"), "leave out --set"),
        (("--device", "spacemouse"), "a session's name must"),
    ):
        trilat("hand", "m1", *options, cwd=tmp_path).refuses(problem)


# --- Haply's Inverse3 -------------------------------------------------------------------------------------


def test_every_state_follows_a_force(service: HaplyService) -> None:
    """The first message names the program; all others hold nothing but the force."""
    with HaplyInverse3(service.address) as device:
        for n in range(4):
            service.place_m = lambda n=n: (0.001 * n, 0.0, 0.0)  # type: ignore[misc]
            device.read()
            device.render(FORCE)
        until(lambda: len(service.asked) == 4)
    messages = [message for _, message in service.asked]
    assert messages[0]["session"] == {"configure": {"profile": {"name": "trilat-net"}}}
    force = {"vector": dict(zip("xyz", FORCE, strict=True))}
    command = {"device_id": "049D", "commands": {"set_cursor_force": force}}
    assert messages[1:4] == [{"inverse3": [command]}] * 3


@pytest.mark.parametrize("key", ["vector", "values"])
def test_force_uses_the_services_own_key(key: str) -> None:
    with HaplyService(force_key=key) as service:
        fragment = "#values" if key == "values" else ""
        with HaplyInverse3(service.address + fragment) as device:
            device.read()
            device.render(FORCE)
            device.read()
        until(lambda: len(service.asked) == 2)
        assert service.forces == [FORCE, ZERO]  # the last one as it is left


def test_buttons_are_those_of_its_grip(service: HaplyService) -> None:
    service.pressed = {"b"}
    with HaplyInverse3(service.address) as device:
        state = device.read()
    assert state == DeviceState((0.0, -0.12, 0.15), ZERO, {"a": False, "b": True, "c": False})


def test_silent_service_is_given_up(service: HaplyService) -> None:
    service.silent.set()
    with HaplyInverse3(service.address) as device:
        device.read()
        device.render(ZERO)
        with pytest.raises(TimeoutError, match="is silent"):
            device.read()
        service.silent.clear()


def test_service_without_a_device_says_so(service: HaplyService) -> None:
    service.devices = []
    with (
        HaplyInverse3(service.address) as device,
        pytest.raises(ConnectionError, match="has no Inverse3"),
    ):
        device.read()


@pytest.mark.parametrize("address", ["ws://127.0.0.1:9", "http://127.0.0.1:10001", "nonsense"])
def test_address_without_a_service_is_named(address: str) -> None:
    with pytest.raises(ConnectionError, match=f"at {address}"):
        HaplyInverse3(address).__enter__()


ORIGIN = dict.fromkeys("xyz", 0.0)


def message(position: Any = ORIGIN, velocity: Any = ORIGIN, **more: Any) -> str:
    state = {"cursor_position": position, "cursor_velocity": velocity}
    return json.dumps({"inverse3": [{"device_id": "049D", "state": state}]} | more)


MALFORMED = [
    *(
        " ",
        "[]",
        "7",
        '"x"',
        "{",
        '{"inverse3":7}',
        '{"inverse3":[[]]}',
        '{"inverse3":[{"device_id":"1"}]}',
    ),
    message(position={"x": 1.0}),
    message(position=ORIGIN | {"x": math.nan}),
    message(position=ORIGIN | {"x": 10**400}),
    message(velocity=None),
    message(wireless_verse_grip=[7]),
    message().replace("0.0", "1e999"),
]


@pytest.mark.parametrize("text", MALFORMED, ids=range(len(MALFORMED)))
def test_an_unreadable_message_gives_no_place(text: str, service: HaplyService) -> None:
    """The next message is requested all the same."""
    with HaplyInverse3(service.address) as device:
        device.read()
        service.raw = text
        device.render(ZERO)
        state = device.read()
        assert not all(map(math.isfinite, (*state.position_m, *state.velocity_m_s)))
        device.render(ZERO)
        assert device.read().position_m == (0.0, -0.12, 0.15)


# --- SpaceMouse -------------------------------------------------------------------------------------------


def test_a_pushed_cap_moves_at_its_speed(cap: CapReports) -> None:
    """To the right, ahead and up, of a cap that reports near and down; half a second of reports."""
    clock = ManualClock()
    with SpaceMouse(cap.path, clock) as device:
        for _ in range(50):
            cap.push(350, -350, -175)
            state = device.read()
            clock.sleep_until(clock.monotonic_ns() + 10_000_000)
    assert state.velocity_m_s == pytest.approx((0.2, 0.2, 0.1))
    assert state.position_m == pytest.approx((0.098, 0.098, 0.049))


def test_silent_cap_is_at_rest(cap: CapReports) -> None:
    """A pushed cap reports all the time, but a cap whose radio is gone does not."""
    clock = ManualClock()
    with SpaceMouse(cap.path, clock) as device:
        cap.push(350, 0, 0)
        device.read()
        clock.sleep_until(clock.monotonic_ns() + 150_000_000)
        place = device.read().position_m
        clock.sleep_until(clock.monotonic_ns() + 900_000_000)
        assert device.read() == DeviceState(place, ZERO, {"a": False, "b": False})


def test_buttons_and_reports_of_other_kinds(cap: CapReports) -> None:
    with SpaceMouse(cap.path) as device:
        for report in (b"\x01", b"\x03", b"\x17\x01\x02", b"\x02" + bytes(6)):
            cap.write(report)
        cap.press(2)
        assert device.read().buttons == {"a": False, "b": True}
        cap.press(1)
        assert device.read().buttons == {"a": True, "b": False}


@pytest.mark.parametrize("maker", ["0003:0000256F:0000C635", "0003:0000046D:0000C626"])
def test_a_spacemouse_is_found_by_its_maker(maker: str, tmp_path: Path) -> None:
    for name, made_by in {"hidraw0": "0003:0000046D:0000C52B", "hidraw1": maker}.items():
        (tmp_path / name / "device").mkdir(parents=True)
        (tmp_path / name / "device" / "uevent").write_text(
            f"DRIVER=hid-generic\nHID_ID={made_by}\n"
        )
    assert SpaceMouse.find(tmp_path) == "/dev/hidraw1"
    with pytest.raises(FileNotFoundError, match="no SpaceMouse"):
        SpaceMouse.find(tmp_path / "nothing")
