"""An emulated service of a Haply Inverse3 moves an arm of a real session."""

import math
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from tests.live.processes import PAPER, Process, Session, Stage, connection_options
from tests.net.waiting import until
from tests.sites.devices import HaplyService, Vector
from trilat_net.log.log_reader import Log

HANDS = 'sites.m1.hands=[{kind="live", device={force_limit_n=1.5}}]'
LET_GO_S = 0.2
"""Longest time from the last state of a service to the tick that lets go of the arm."""
CIRCLE_M = 0.04
"""Radius of the circles of the device."""
TURN_S = 2.0
"""Duration of a circle."""


@dataclass
class DeviceSession:
    """A session in which a Haply device moves m1, and the process of the device."""

    session: Session
    service: HaplyService
    process: Process

    def move_in_circles(self) -> None:
        """Presses the first button of the device, and moves the device in circles."""
        self.service.place_m = compute_circle_m
        self.service.pressed = {"a"}

    def reproduce(self) -> Log:
        """Returns the log of the session after an exact re-execution."""
        return self.session.is_reproduced()

    @property
    def lines(self) -> list[str]:
        """Lines that the process of the device has printed."""
        return self.process.text().splitlines()


def compute_circle_m() -> Vector:
    """Returns the present position on the circle."""
    angle = 2.0 * math.pi * time.perf_counter() / TURN_S
    return CIRCLE_M * math.cos(angle), -0.12, 0.15 + CIRCLE_M * math.sin(angle)


@pytest.fixture
def held(stage: Stage) -> Iterator[DeviceSession]:
    with HaplyService() as service:
        # The low rate suits a machine of two cores, which runs six processes here.
        settings = ["--set", HANDS, "--set", "rate_hz=250"]
        session = Session(stage, "play", PAPER, "--duration", "20", *settings)
        session.all()
        session.begun()
        session.recording()
        arguments = (
            "hand",
            "m1",
            "--session",
            "t",
            "--device",
            f"haply_inverse3={service.address}",
        )
        process = stage.start("device", *arguments, *connection_options(session.endpoints))
        session.processes["device"] = process
        process.prints("button 'a' holds the arm")
        yield DeviceSession(session, service, process)


def find_release_s(log: Log) -> tuple[float, float]:
    """Returns the arrival of the last message that moved m1, and the following release, in s."""
    part = log["m1"]
    message_tick = int(np.flatnonzero(np.diff(part.hand[:, 1]) > 0)[-1]) + 1
    release_tick = message_tick + int(np.argmax(part.hand[message_tick:, 2] == 0.0))
    assert part.hand[release_tick, 2] == 0.0
    return float(part.t_s[message_tick]), float(part.t_s[release_tick])


@pytest.mark.long
def test_a_haply_leads_and_renders_its_reaction(held: DeviceSession) -> None:
    """The target follows the device, which receives the limited reaction force of the arm."""
    # A busy machine may be silent for a while, and lose the hold.
    held.service.presses_anew = True
    held.move_in_circles()
    begun_s = time.perf_counter()
    until(
        lambda: held.service.asked and held.service.asked[-1][0] - begun_s > 2.0 * TURN_S, 60.0
    )
    held.service.pressed = {"b"}
    held.service.presses_anew = False
    until(lambda: held.service.forces[-1] == (0.0, 0.0, 0.0), 10.0)
    log = held.reproduce()
    part = log["m1"]
    is_held = part.hand[:, 2] > 0.0
    target = part.hand[is_held, 3:5]
    radii_m = (target.max(axis=0) - target.min(axis=0)) / 2.0
    assert radii_m == pytest.approx([CIRCLE_M, CIRCLE_M], rel=0.5)
    message_numbers = part.hand[is_held, 1]
    messages_per_s = np.ptp(message_numbers) / np.ptp(part.t_s[is_held])
    assert messages_per_s > 100.0  # about 1000 on an idle machine
    forces = np.array(held.service.forces)
    assert np.linalg.norm(forces, axis=1).max() == pytest.approx(1.5)
    assert np.abs(forces[:, 1]).max() == 0.0
    assert np.abs(part.tau_x[is_held]).max() > 1.0
    assert "round trip from device position to rendered force: p50" in held.lines[-1]
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert (texts[0], texts[-1]) == (
        "m1: HaplyInverse3 takes hold",
        "m1: HaplyInverse3 lets go",
    )


@pytest.mark.long
def test_silent_haply_lets_go_until_its_button(held: DeviceSession) -> None:
    """The program lets go of the arm 150 ms after the last state of the service."""
    held.move_in_circles()
    until(lambda: len(held.service.asked) > 500, 60.0)
    held.service.silent.set()
    held.process.prints("is silent; the arm is released")
    held.service.silent.clear()
    until(lambda: sum("holds the arm" in line for line in held.lines) == 2, 30.0)
    log = held.reproduce()
    message_s, release_s = find_release_s(log)
    assert release_s - message_s <= LET_GO_S
    assert not log["m1"].tau_x[log["m1"].t_s > release_s + 0.11].any()  # the grip has faded
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert texts == ["m1: HaplyInverse3 takes hold", "m1: HaplyInverse3 lets go"]


@pytest.mark.long
def test_a_killed_service_leads_again_after_return(held: DeviceSession) -> None:
    held.move_in_circles()
    until(lambda: len(held.service.asked) > 500, 60.0)
    held.service.kill()
    held.process.prints("the arm is released, and the device is tried again")
    with HaplyService(held.service.port) as again:
        until(lambda: len(again.asked) > 100, 60.0)
        again.place_m = compute_circle_m
        again.pressed = {"a"}
        until(lambda: any(force != (0.0, 0.0, 0.0) for force in again.forces), 30.0)
        log = held.reproduce()
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert texts[:3] == [
        f"m1: HaplyInverse3 {action}" for action in ("takes hold", "lets go", "takes hold")
    ]
    closed = f"m1: the service at {held.service.address} has closed the connection"
    assert f"{closed}; the arm is released, and the device is tried again" in held.lines


@pytest.mark.long
def test_a_killed_device_program_lets_go(held: DeviceSession) -> None:
    """Without messages of the stopped program, the site lets go of the arm."""
    held.move_in_circles()
    until(lambda: len(held.service.asked) > 500, 60.0)
    held.process.signal(signal.SIGSTOP)
    del held.session.processes["device"]
    log = held.reproduce()
    message_s, release_s = find_release_s(log)
    assert release_s - message_s <= LET_GO_S + 0.01
    assert (
        "is silent: let go" in [event.text for event in log.events if event.kind == "hand"][-1]
    )
