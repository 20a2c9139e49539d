"""People at the arms of real processes: programs that lead two arms, one that is killed, a flood."""

import math
import threading
from pathlib import Path

import numpy as np
import pytest

import trilat_net
from tests.cli.running import trilat
from tests.live.namespaces import connect_by_bridge
from tests.live.processes import connection_options
from tests.net.waiting import until

from .namespaces import Machines
from .processes import PAPER, Holder, Session, Stage, assert_let_go


class Circling(threading.Thread):
    """A program that leads an arm in circles, sixty times a second, for some time."""

    def __init__(self, session: Session, site: str, seconds: float, turn_s: float) -> None:
        super().__init__(name=f"hand at {site}", daemon=True)
        self._places = session.endpoints
        self._site = site
        self._rounds = round(60.0 * seconds)
        self._turn = 2.0 * math.pi / (60.0 * turn_s)
        self.felt_n = 0.0
        self._wait = threading.Event()

    def run(self) -> None:
        connected = trilat_net.hand(
            "t", self._site, connect=self._places, source=self.name, timeout_s=60.0
        )
        with connected as hand:
            x, y = hand.pose
            for n in range(self._rounds):
                angle = self._turn * n
                hand.move(x - 0.1 + 0.1 * math.cos(angle), y + 0.1 * math.sin(angle))
                self.felt_n = max(self.felt_n, math.hypot(*hand.force))
                self._wait.wait(1.0 / 60.0)


DELAY = ("link", "m1->s", "--delay", "120ms")
SHARES = ("dominance", "s", "m1=0.8", "m2=0.2", "--ramp", "1s")


@pytest.mark.long
def test_sessions_of_two_programs_verify_and_repeat(stage: Stage) -> None:
    """Programs hold both masters while a link and the shares are changed."""
    session = Session(stage, "play", PAPER, "--duration", "6")
    session.all()
    session.begun()
    session.recording()
    hands = [Circling(session, "m1", 2.5, 2.0), Circling(session, "m2", 2.5, 3.1)]
    for hand in hands:
        hand.start()
    to = ("set", "--session", "t", *connection_options(session.endpoints))
    for order in (DELAY, SHARES):
        trilat(*to, *order, cwd=session.log.parent).succeeds()
    for hand in hands:
        hand.join()
        assert hand.felt_n > 1.0
    log = session.is_reproduced()
    said = [event.text for event in log.events if event.kind == "hand"]
    for site in ("m1", "m2"):
        assert any(text.startswith(f"{site}: hand at {site} takes hold") for text in said)
        assert np.abs(log[site].tau_x).max() > 1.0
    assert [len(log.changes(name)) for name in PAPER] == [0, 0, 2]


@pytest.mark.long
def test_a_killed_program_leaves_no_force(stage: Stage, tmp_path: Path) -> None:
    """By the log: from its last message to the last force, and the event that says so."""
    session = Session(stage, "play", PAPER, "--duration", "15")
    session.all()
    holder = Holder(session, tmp_path)
    try:
        until(holder.holds, 60.0)
    finally:
        holder.end()
    log = session.is_reproduced()
    assert_let_go(log)


@pytest.mark.long
def test_a_program_cut_off_leaves_no_force(
    stage: Stage, tmp_path: Path, apart: Machines
) -> None:
    """The session is on one machine, the program on another; no tick is missing because of the cut."""
    connect_by_bridge(apart, ("lab", "holder"))
    session = Session(stage, "play", PAPER, "--duration", "15", "--insecure")
    session.before = dict.fromkeys((*PAPER, "recorder"), apart.on("lab"))
    session.endpoints = [
        place.replace("127.0.0.1", apart.address["lab"]) for place in session.endpoints
    ]
    session.all()
    holder = Holder(session, tmp_path, apart.on("holder"))
    try:
        until(holder.holds, 60.0)
        apart.part("lab", "holder")
        log = session.is_reproduced()
    finally:
        holder.end()
    assert_let_go(log)
    assert all(log.missing(site) == 0 for site in log.sites)
