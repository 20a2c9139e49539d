"""Users' own hands and plants in a live session: the same numbers as in virtual time, bit for bit."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sites.hand_process import HandProcess
from tests.net.waiting import sleep_for_ns
from tests.own_code import Circle, Failing, Follower
from trilat_net.core.life.own_hand import HandProgram, HandView
from trilat_net.errors import PlantFailed, RunFailed
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual import SimulatedLog
from trilat_net.log.log_reader import Log
from trilat_net.net.bus import Bus
from trilat_net.net.requests import HandMessage
from trilat_net.net.topics import HAND, key
from trilat_net.net.wire import encode
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.operators.program_hand import HandSite

from .relay import RelayClock
from .sessions import SESSION, Session

SIGNALS = ("q", "qd", "tau", "q_des", "hand")
MS_NS = 1_000_000


def make_hand_scenario(kind: str, **keys: Any) -> Scenario:
    hand = {"kind": "own", "class": f"tests.own_code:{kind}", **keys}
    return load_scenario(
        "paper", {"sites.m2.hands": [hand], "link.delay_ms": 50, "duration_s": 1.0}
    )


def make_hand_session(scenario: Scenario, folder: Path) -> tuple[HandSite, Session]:
    """Returns a session whose hand at m2 runs in a process of its own."""
    at = HandSite.find(scenario, "m2")
    assert at is not None
    return at, Session.whole(scenario, folder)


class Thinking:
    """A program that takes a time over each view."""

    def __init__(self, program: HandProgram, clock: RelayClock, thinks_ns: int) -> None:
        self._program = program
        self._clock = clock
        self._thinks_ns = thinks_ns

    def act(self, now: HandView) -> Any:
        self._clock.sleep_until(self._clock.monotonic_ns() + self._thinks_ns)
        return self._program.act(now)


def add_program(
    session: Session, program: HandProgram, thinks_ns: int = 0, dies_ns: int | None = None
) -> None:
    """Adds a program at m2 in a process of its own, which computes for a time over each view."""

    def run(clock: RelayClock) -> None:
        at = HandSite.find(session.scenario, "m2")
        assert at is not None
        thinking = Thinking(program, clock, thinks_ns)
        with HandProcess(at, thinking, session.network.join(), clock, SESSION) as hand:
            while not hand.over and (dies_ns is None or clock.monotonic_ns() < dies_ns):
                hand.serve()
                sleep_for_ns(clock, MS_NS)

    session.relay.add("hand", run)


def assert_same(log: Log, other: Log) -> None:
    for name in log.scenario.names:
        for signal in SIGNALS:
            assert np.array_equal(getattr(log[name], signal), getattr(other[name], signal)), (
                name,
                signal,
            )


@pytest.mark.parametrize("kind", [Circle, Follower])
def test_records_are_alike_wherever_a_hand_runs(kind: type[Any], tmp_path: Path) -> None:
    """The hand runs in virtual time, live in the process of its site, and live in its own process."""
    alone = make_hand_scenario(kind.__name__, process=True)
    at, session = make_hand_session(alone, tmp_path)
    add_program(session, kind(at.describe()))
    log = session.run()
    assert_same(log, SimulatedLog(alone))
    (tmp_path / "within").mkdir()
    within = make_hand_scenario(kind.__name__)
    inner_log = Session.whole(within, tmp_path / "within").run()
    assert_same(inner_log, SimulatedLog(within))
    assert_same(log, inner_log)
    assert verify_log(log).passed


def test_thinking_within_the_delay_changes_nothing(tmp_path: Path) -> None:
    scenario = make_hand_scenario("Follower", process=True, delay_ms=20.0)
    at, session = make_hand_session(scenario, tmp_path)
    add_program(session, Follower(at.describe()), thinks_ns=15 * MS_NS)
    assert_same(session.run(), SimulatedLog(scenario))
    assert not any("hand:" in text for text in session.said)


def test_a_program_that_is_too_slow_is_counted(tmp_path: Path) -> None:
    scenario = make_hand_scenario("Circle", process=True, delay_ms=20.0)
    at, session = make_hand_session(scenario, tmp_path)
    add_program(session, Circle(at.describe()), thinks_ns=70 * MS_NS)
    log = session.run()
    assert any("hand: late" in text for text in session.said)
    assert log["m2"].hand[-1, 2] == 1.0
    assert verify_log(log).passed


def test_killed_programs_let_go_without_harm(tmp_path: Path) -> None:
    scenario = make_hand_scenario("Circle", process=True)
    at, session = make_hand_session(scenario, tmp_path)
    add_program(session, Circle(at.describe()), dies_ns=2_100 * MS_NS)
    log = session.run()
    assert log.complete
    held = log["m2"].hand[:, 2] > 0.0
    assert held.any()
    assert not held[-1]
    assert {state.mode for name in log.sites for state in log[name].states} == {"run"}
    assert verify_log(log).passed


def test_a_program_that_fails_lets_go_and_ends(tmp_path: Path) -> None:
    scenario = make_hand_scenario("Failing", process=True)
    at, session = make_hand_session(scenario, tmp_path)
    failing = Failing(at.describe(), at_s=0.4)
    ended: list[str] = []

    def serve(clock: RelayClock) -> None:
        with HandProcess(at, failing, session.network.join(), clock, SESSION) as hand:
            try:
                while not hand.over:
                    hand.serve()
                    sleep_for_ns(clock, MS_NS)
            except RunFailed as failed:
                ended.append(str(failed))

    session.relay.add("hand", serve)
    log = session.run()
    assert len(ended) == 1
    assert re.fullmatch(
        r"the hand tests\.own_code:Failing of m2 failed at tick 400: RuntimeError: no idea "
        r"\(own_code\.py, line \d+\); the hand has released the arm",
        ended[0],
    )
    assert log["m2"].hand[430, 2] == 0.0
    assert verify_log(log).passed


def test_strangers_move_no_own_hand(tmp_path: Path) -> None:
    scenario = make_hand_scenario("Circle", process=True)
    at, session = make_hand_session(scenario, tmp_path)
    add_program(session, Circle(at.describe()))

    def meddle(clock: RelayClock) -> None:
        bus: Bus = session.network.join()
        publish = bus.publisher(key(SESSION, "m2", HAND))
        for n in range(400):
            moved = HandMessage(
                site="m2",
                boot=7,
                source="page",
                n=n,
                target=[9.0, 9.0],
                sent_ns=clock.monotonic_ns(),
            )
            publish(encode(moved))
            publish(b"\x00 nothing")
            sleep_for_ns(clock, 5 * MS_NS)

    session.relay.add("stranger", meddle)
    assert_same(session.run(), SimulatedLog(scenario))
    assert any("hand: stranger" in text for text in session.said)


def test_announcements_decide_nothing(tmp_path: Path) -> None:
    """A message of a program before its first view may arrive after the site's request."""
    scenario = make_hand_scenario("Circle", process=True)
    at, session = make_hand_session(scenario, tmp_path)
    add_program(session, Circle(at.describe()), thinks_ns=3 * MS_NS)

    def say(clock: RelayClock) -> None:
        publish = session.network.join().publisher(key(SESSION, "m2", HAND))
        for _ in range(2_000):
            publish(
                encode(
                    HandMessage(site="m2", boot=9, source=at.source, n=0, grip=False, sent_ns=1)
                )
            )
            sleep_for_ns(clock, MS_NS)

    session.relay.add("here", say)
    assert_same(session.run(), SimulatedLog(scenario))


@pytest.mark.parametrize("how", ["raise", "nan"])
def test_hands_failing_within_sites_let_go(how: str, tmp_path: Path) -> None:
    scenario = make_hand_scenario("Failing", settings={"how": how})
    log = Session.whole(scenario, tmp_path).run()
    assert_same(log, SimulatedLog(scenario))
    assert [
        event.text
        for event in log.events
        if event.kind == "hand" and "failed at tick 300" in event.text
    ]
    assert log.complete


def test_plants_move_alike_live_and_virtually(tmp_path: Path) -> None:
    scenario = load_scenario(
        "paper", {"sites.s.plant": "tests.own_code:Arm", "duration_s": 1.0}
    )
    log = Session.whole(scenario, tmp_path).run()
    assert_same(log, SimulatedLog(scenario))
    assert verify_log(log).passed


def test_failing_live_plants_are_named_and_end(tmp_path: Path) -> None:
    scenario = load_scenario(
        "paper", {"sites.s.plant": "tests.own_code:Torn", "duration_s": 1.0}
    )
    ends: dict[str, object] = {}
    log = Session.whole(scenario, tmp_path, ends=ends).run()
    assert isinstance(ends["s"], PlantFailed)
    assert "the belt is torn" in str(ends["s"])
    assert [
        event.text for event in log.events if event.kind == "failed" and event.member == "s"
    ]
    assert verify_log(log).passed
