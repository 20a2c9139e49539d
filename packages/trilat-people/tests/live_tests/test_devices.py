"""Haply's Inverse3 at the arm of a real session, by a service of the test that speaks as the maker's."""

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
"""From the last state of a service to the tick in which the arm is let go."""
CIRCLE_M, TURN_S = 0.04, 2.0


@dataclass
class Held:
    """A session of which Haply's device leads m1, and the process that does so."""

    session: Session
    service: HaplyService
    process: Process

    def circles(self) -> None:
        """Whoever holds the device presses its first button, and leads it in circles."""
        self.service.place_m = circle
        self.service.pressed = {"a"}

    def led(self) -> Log:
        """Returns the log of the session, which is reproduced bit for bit."""
        return self.session.is_reproduced()

    @property
    def said(self) -> list[str]:
        return self.process.text().splitlines()


def circle() -> Vector:
    angle = 2.0 * math.pi * time.perf_counter() / TURN_S
    return CIRCLE_M * math.cos(angle), -0.12, 0.15 + CIRCLE_M * math.sin(angle)


@pytest.fixture
def held(stage: Stage) -> Iterator[Held]:
    with HaplyService() as service:
        busy = "--set", "rate_hz=250"  # a machine of two cores has six processes here
        session = Session(stage, "play", PAPER, "--duration", "20", "--set", HANDS, *busy)
        session.all()
        session.begun()
        session.recording()
        words = (
            "hand",
            "m1",
            "--session",
            "t",
            "--device",
            f"haply_inverse3={service.address}",
        )
        process = stage.start("device", *words, *connection_options(session.endpoints))
        session.processes["device"] = process
        process.prints("button 'a' takes hold")
        yield Held(session, service, process)


def last_moved(log: Log) -> tuple[float, float]:
    """When the newest message came in that moved m1, and when its arm was let go after that, s."""
    part = log["m1"]
    newest = int(np.flatnonzero(np.diff(part.hand[:, 1]) > 0)[-1]) + 1
    gone = newest + int(np.argmax(part.hand[newest:, 2] == 0.0))
    assert part.hand[gone, 2] == 0.0
    return float(part.t_s[newest]), float(part.t_s[gone])


@pytest.mark.long
def test_a_haply_leads_and_renders_its_reaction(held: Held) -> None:
    """The target turns as the device does, and the service got the reaction of the arm, within its limit."""
    held.service.presses_anew = True  # a busy machine may be silent, and let go, in between
    held.circles()
    begun_s = time.perf_counter()
    until(
        lambda: held.service.asked and held.service.asked[-1][0] - begun_s > 2.0 * TURN_S, 60.0
    )
    held.service.pressed, held.service.presses_anew = {"b"}, False
    until(lambda: held.service.forces[-1] == (0.0, 0.0, 0.0), 10.0)
    log = held.led()
    part = log["m1"]
    mine = part.hand[:, 2] > 0.0
    target = part.hand[mine, 3:5]
    across = (target.max(axis=0) - target.min(axis=0)) / 2.0
    assert across == pytest.approx([CIRCLE_M, CIRCLE_M], rel=0.5)
    numbers = part.hand[mine, 1]
    per_s = np.ptp(numbers) / np.ptp(part.t_s[mine])
    assert per_s > 100.0  # a thousand where the machine is idle
    forces = np.array(held.service.forces)
    assert np.linalg.norm(forces, axis=1).max() == pytest.approx(1.5)
    assert np.abs(forces[:, 1]).max() == 0.0
    assert np.abs(part.tau_x[mine]).max() > 1.0
    assert "round trip from device position to rendered force: p50" in held.said[-1]
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert (texts[0], texts[-1]) == (
        "m1: HaplyInverse3 takes hold",
        "m1: HaplyInverse3 lets go",
    )


@pytest.mark.long
def test_silent_haply_lets_go_until_its_button(held: Held) -> None:
    """150 ms after the last state of the service the program lets go."""
    held.circles()
    until(lambda: len(held.service.asked) > 500, 60.0)
    held.service.silent.set()
    held.process.prints("is silent; the arm is released")
    held.service.silent.clear()
    until(lambda: sum("takes hold" in line for line in held.said) == 2, 30.0)
    log = held.led()
    moved_s, gone_s = last_moved(log)
    assert gone_s - moved_s <= LET_GO_S
    assert not log["m1"].tau_x[log["m1"].t_s > gone_s + 0.11].any()  # its grip has faded
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert texts == ["m1: HaplyInverse3 takes hold", "m1: HaplyInverse3 lets go"]


@pytest.mark.long
def test_a_killed_service_leads_again_after_return(held: Held) -> None:
    held.circles()
    until(lambda: len(held.service.asked) > 500, 60.0)
    held.service.kill()
    held.process.prints("the arm is released, and the device is tried again")
    with HaplyService(held.service.port) as again:
        until(lambda: len(again.asked) > 100, 60.0)
        again.place_m, again.pressed = circle, {"a"}
        until(lambda: any(force != (0.0, 0.0, 0.0) for force in again.forces), 30.0)
        log = held.led()
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert texts[:3] == [
        f"m1: HaplyInverse3 {what}" for what in ("takes hold", "lets go", "takes hold")
    ]
    closed = f"m1: the service at {held.service.address} has closed the connection"
    assert f"{closed}; the arm is released, and the device is tried again" in held.said


@pytest.mark.long
def test_a_killed_device_program_lets_go(held: Held) -> None:
    """It has no heartbeat but the states of its device: the site hears it no more."""
    held.circles()
    until(lambda: len(held.service.asked) > 500, 60.0)
    held.process.signal(signal.SIGSTOP)
    del held.session.processes["device"]
    log = held.led()
    moved_s, gone_s = last_moved(log)
    assert gone_s - moved_s <= LET_GO_S + 0.01
    assert (
        "is silent: let go" in [event.text for event in log.events if event.kind == "hand"][-1]
    )
