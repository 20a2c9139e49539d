"""People at the arms of real processes: programs that lead two arms, one that is killed, a flood."""

import math
import signal
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import trilat_net
from tests.cli.running import trilat
from tests.live.browsers import wait_until_page
from tests.live.namespaces import connect_by_bridge
from tests.live.processes import connection_options
from tests.net.waiting import until
from trilat_net.analysis.certificate.stability_certificate import BROKEN_BALANCE_SHARE
from trilat_net.log.log_reader import Log

from .browsers import browser_page, needs_browser, page_address, take_hold
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


def hold_session(
    session: Session, seconds: float, orders: Sequence[Sequence[str]], page_moves: int = 0
) -> Log:
    """A session whose masters two programs hold, while links and shares are changed; it is reproduced.

    A page holds the slave for so many moves of its pointer, if for any.
    """
    session.all()
    session.begun()
    session.recording()
    hands = [Circling(session, "m1", seconds, 2.0), Circling(session, "m2", seconds, 3.1)]
    for hand in hands:
        hand.start()
    to = ("set", "--session", "t", *connection_options(session.endpoints))
    for order in orders:
        trilat(*to, *order, cwd=session.log.parent).succeeds()
    if page_moves:
        hold_by_page(session, page_moves)
    for hand in hands:
        hand.join()
        assert hand.felt_n > 1.0
    log = session.is_reproduced()
    said = [event.text for event in log.events if event.kind == "hand"]
    for site in ("m1", "m2"):
        assert any(text.startswith(f"{site}: hand at {site} takes hold") for text in said)
        assert np.abs(log[site].tau_x).max() > 1.0
    return log


def hold_by_page(session: Session, moves: int) -> None:
    server = session.stage.start(
        "page", "live", "--session", "t", "--no-browser", *connection_options(session.endpoints)
    )
    with browser_page(page_address(server)) as page:
        wait_until_page(page, "trilat.frame && trilat.takesPart")
        x, y = take_hold(page, 2, 20.0, 0.0)
        wait_until_page(page, "trilat.frame.holds.includes('s')")
        for n in range(moves):
            page.mouse.move(x + 20.0 * math.cos(0.2 * n), y + 20.0 * math.sin(0.2 * n))
        page.mouse.up()
    server.signal(signal.SIGINT)
    server.code()


DELAY = ("link", "m1->s", "--delay", "120ms")
SHARES = ("dominance", "s", "m1=0.8", "m2=0.2", "--ramp", "1s")


@pytest.mark.long
def test_sessions_of_two_programs_verify_and_repeat(stage: Stage) -> None:
    log = hold_session(Session(stage, "play", PAPER, "--duration", "6"), 2.5, [DELAY, SHARES])
    assert [len(log.changes(name)) for name in PAPER] == [0, 0, 2]


@needs_browser
@pytest.mark.long
def test_a_minute_of_hands_verifies_and_repeats(stage: Stage) -> None:
    """The certificate books what the hands gave: V never rises by more.

    At 500 Hz two processors have room for the page too, in a browser that draws by software.
    """
    orders = [
        ("link", f"{a}->{b}", "--delay", f"{20 * n + 20}ms") for n, (a, b) in enumerate(LINKS)
    ]
    orders += [
        ("dominance", "s", f"m1={share}", f"m2={1 - share:.1f}", "--ramp", "0s")
        for share in SHARED
    ]
    log = hold_session(
        Session(stage, "play", PAPER, "--duration", "60", "--set", "rate_hz=500"),
        40.0,
        orders,
        300,
    )
    said = [event.text for event in log.events if event.kind == "hand"]
    assert any(text.startswith("s: page 1 takes hold") for text in said)
    assert np.abs(log["s"].hand[:, 0]).max() == 1.0
    assert sum(len(log.changes(name)) for name in PAPER) == 10
    certificate = trilat_net.certify(log)
    assert certificate.balance is not None
    assert (
        np.abs(certificate.balance.residual).max()
        < BROKEN_BALANCE_SHARE * certificate.balance.scale
    )


LINKS = [("m1", "s"), ("m2", "s"), ("s", "m1"), ("s", "m2"), ("m1", "m2"), ("m2", "m1")]
SHARED = (0.9, 0.1, 0.7, 0.5)


@pytest.mark.long
def test_a_killed_program_leaves_no_force(stage: Stage, tmp_path: Path) -> None:
    """The log shows the time from the last message to the last force, and the event that reports it."""
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
