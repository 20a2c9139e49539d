"""A session that is ended in order, and watched in a terminal meanwhile."""

import io
import re
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from rich.console import Console
from trilat_people.live_page.session_frames import SessionFrames
from trilat_people.live_page.terminal_watch import SessionWatch

from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.net.waiting import sleep_for_ns
from tests.sites.sessions import reach_session
from trilat_net.app.monitor import SessionDisplay, StatusRow
from trilat_net.core.step.ticks import LifeAlarm, LifeReason
from trilat_net.errors import SessionError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log
from trilat_net.net.bus import Bus
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import SESSION, Session

LIVE = {"sites.m1.hands": [{"kind": "live"}]}


def test_stop_ends_all_sites_at_one_time(tmp_path: Path) -> None:
    session = Session.whole(
        load_scenario("paper", {"duration_s": 30.0, **LIVE}), tmp_path, ends={}
    )
    printed_lines: list[str] = []
    displayed_rows: list[list[StatusRow]] = []
    titles: list[str] = []

    def stop(bus: Bus, clock: RelayClock) -> None:
        sleep_for_ns(clock, 2_500_000_000)
        printed_lines.extend(reach_session(bus, clock).end())

    def look(bus: Bus, clock: RelayClock) -> None:
        watch = SessionWatch(bus, clock, SESSION)
        while not watch.view.ended:
            watch.update()
            displayed_rows.append(watch.rows())
            titles.append(watch.title)
            sleep_for_ns(clock, 20_000_000)

    session.stranger(stop)
    session.stranger(look)
    log = session.run()
    assert session.ends == {"m1": 0, "m2": 0, "s": 0}
    (ticks,) = {log.expected_ticks(name) for name in log.sites}
    assert 1500 < ticks < 4000
    assert printed_lines == [f"{name} ends at t = {ticks / 1000:.3f} s" for name in log.sites]
    assert log.complete
    assert verify_log(log).identical == 3 * ticks
    last = displayed_rows[-1]
    assert [row["site"] for row in last] == ["m1", "m2", "s"]
    assert last[0]["angles"] == " ".join(f"{q:+.3f}" for q in log["m1"].q[-1]) + " rad"
    assert [row["held"] for row in last] == ["free", "", ""]
    assert displayed_rows[-1][0].describe().startswith(f"m1 {(ticks - 1) / 1000:.1f} s ")
    assert titles[0].endswith("waits for its members")
    assert " V = " in titles[-1]


GLIDES = {"on_stale.action": "glide", "on_stale.align_limit_rad": 3.0, "link.delay_ms": 20.0}


class StoppedArm(NamedTuple):
    """A session of two arms, of which s is stopped, reset in vain, and enabled with m.

    Attributes:
        session: The session.
        log: Its log.
        answers: For each order, whether it was accepted, and the text of the answer.
        alarms: Alarms in a terminal, as they change.
        screen: What the terminal printed of them.
        frames: Frames of a page.
        changes: Sentences about orders on a page, without their time.
    """

    session: Session
    log: Log
    answers: list[tuple[bool, str]]
    alarms: list[tuple[str, LifeAlarm]]
    screen: str
    frames: list[dict[str, Any]]
    changes: list[str]


@pytest.fixture(scope="module")
def stopped_arm(tmp_path_factory: pytest.TempPathFactory) -> StoppedArm:
    session = Session.whole(
        load_scenario("two_sites", {"duration_s": 4.0, **GLIDES}),
        tmp_path_factory.mktemp("stopped"),
        ends={},
    )
    answers: list[tuple[bool, str]] = []
    alarms: list[tuple[str, LifeAlarm]] = []
    frames: list[dict[str, Any]] = []
    changes: list[str] = []
    screen = io.StringIO()

    def order(bus: Bus, clock: RelayClock) -> None:
        for name, sites in (("stop", ["s"]), ("reset", ["s"]), ("enable", [])):
            sleep_for_ns(clock, 1_200_000_000)
            answers.extend(
                (answer.accepted, answer.text)
                for answer in reach_session(bus, clock).send_order(sites, name)
            )

    def look(bus: Bus, clock: RelayClock) -> None:
        watch = SessionWatch(bus, clock, SESSION)
        pages = SessionFrames(watch.view)
        console = Console(file=screen, width=100, force_terminal=True, color_system=None)
        with SessionDisplay(console, clock) as display:
            while not watch.view.ended:
                watch.update()
                frames.extend([frame] if (frame := pages.make_frame()) else [])
                if watch.alarms and watch.alarms != alarms[-1:]:
                    alarms.extend(watch.alarms)
                    display.show("", [], watch.alarms)
                sleep_for_ns(clock, 50_000_000)
        changes.extend(
            re.sub(r"[\d.]+ s$", "", event["text"])
            for event in pages.list_events(0, 400)
            if event["kind"] == "change"
        )

    session.stranger(order)
    session.stranger(look)
    log = session.run()
    return StoppedArm(session, log, answers, alarms, screen.getvalue(), frames, changes)


def test_one_arm_stops_and_continues_alone(stopped_arm: StoppedArm) -> None:
    log = stopped_arm.log
    assert stopped_arm.session.ends == {"m": 0, "s": 0}
    stopped, enabled = (int(stopped_arm.answers[n][1].rpartition(" ")[2]) for n in (0, 3))
    assert set(log["s"].mode[stopped:enabled]) == {"stopped"}
    assert log["s"].mode[enabled] == "return"
    assert "stopped" not in set(log["m"].mode)
    assert verify_log(log).identical == 8000


def test_orders_that_fit_no_mode_are_explained(stopped_arm: StoppedArm) -> None:
    answers = stopped_arm.answers
    assert [accepted for accepted, _ in answers] == [True, False, False, True]
    assert answers[1][1] == "s is in mode stopped; reset is possible only in mode fault"
    assert answers[2][1].startswith("m is in ")


def test_a_stop_is_an_alarm_everywhere(stopped_arm: StoppedArm) -> None:
    """In a terminal, on a page until the arm is enabled, and at the site, which knows no names
    of people.
    """
    stop = LifeAlarm(
        "STOPPED", "ordered by the operator", f"trilat enable --session {SESSION} s", "enable"
    )
    assert ("s", stop) in stopped_arm.alarms
    assert "s STOPPED" in stopped_arm.screen
    assert stop.advice in stopped_arm.screen
    on_page = {
        "word": "STOPPED",
        "reason": "ordered by the operator",
        "advice": "",
        "order": "enable",
    }
    assert on_page in [frame["sites"]["s"]["alarm"] for frame in stopped_arm.frames]
    assert stopped_arm.frames[-1]["sites"]["s"]["alarm"] is None
    at_site = stop._replace(reason="it was ordered to stop")
    assert any(f"s: *** {at_site}" in line for line in stopped_arm.session.said)


def test_orders_are_events_with_their_orderer(stopped_arm: StoppedArm) -> None:
    assert stopped_arm.changes == [
        "s was stopped by the operator at ",
        "s was enabled by the operator at ",
    ]
    texts = [event.text for event in stopped_arm.log.events]
    assert any(text.endswith("s: it was ordered to stop") for text in texts)


def test_sites_too_far_apart_report_once(tmp_path: Path) -> None:
    """Their start poses are 0.4 rad apart."""
    rule = {**GLIDES, "on_stale.align_limit_rad": 0.05, "duration_s": 3.2}
    log = Session.whole(load_scenario("two_sites", rule), tmp_path).run()
    told = [event for event in log.events if event.kind == "waiting" and event.member == "s"]
    assert [event.t_ns // 1_000_000_000 for event in told] == [1, 2, 3]
    assert told[0].text.startswith("s waits for its peers from t = 1.000 s: ")
    assert told[0].text.endswith("its peers are farther away than align_limit_rad")
    assert set(log["s"].mode) == {"waiting"}


def test_arms_without_glide_name_the_command(tmp_path: Path) -> None:
    session = Session.whole(load_scenario("two_sites", {"duration_s": 2.0}), tmp_path, ends={})
    refusals: list[str] = []

    def order(bus: Bus, clock: RelayClock) -> None:
        sleep_for_ns(clock, 1_200_000_000)
        refusals.extend(
            reply.text
            for reply in reach_session(bus, clock).send_order(["s"], "stop")
            if not reply.accepted
        )

    session.stranger(order)
    session.run()
    assert "trilat stop --end" in refusals[0]


def test_an_absent_session_is_not_stopped() -> None:
    with pytest.raises(SessionError, match="no site of session"):
        reach_session(LocalNetwork().join(), ManualClock()).end()


@pytest.mark.long
def test_watching_sees_returns_and_stops_everything(tmp_path: Path) -> None:
    glide = {"on_stale.action": "glide", "on_stale.align_limit_rad": 3.0, "rate_hz": 200}
    session = Session.whole(
        load_scenario("paper", {"duration_s": 60.0, **glide}), tmp_path, ends={}
    )
    session.clocks["m1"].dies_ns = 4_000_000_000
    session.site("m1", at_ns=5_000_000_000)
    session.clocks["s"].dies_ns = 9_000_000_000
    printed_lines: list[str] = []
    seen: dict[str, int] = {}

    def stop(bus: Bus, clock: RelayClock) -> None:
        printed_lines.extend(reach_session(bus, clock).end())

    def look(bus: Bus, clock: RelayClock) -> None:
        watch = SessionWatch(bus, clock, SESSION)
        while clock.monotonic_ns() < 9_000_000_000:
            watch.update()
            sleep_for_ns(clock, 20_000_000)
        seen.update(
            {name: site.record.tick for name, site in watch.view.sites.items() if site.record}
        )

    session.stranger(look)
    session.stranger(stop, at_ns=10_000_000_000)
    log = session.run()
    assert [line.split()[0] for line in printed_lines] == ["m1", "m2"]
    ticks = log.expected_ticks("m2")
    assert ticks < 2200
    assert max(seen.values()) - seen["m1"] < 10
    ended = {name: str(end) for name, end in session.ends.items()} if session.ends else {}
    assert ended["s"] == "killed"
    assert "s has been gone since" in ended["m1"]
    assert verify_log(log).differing == 0


@pytest.mark.long
def test_killed_masters_are_replaced_and_return(tmp_path: Path) -> None:
    """The master dies 3 s after the beginning and is started again 4 s later; the others never hold."""
    rule = {**GLIDES, "on_stale.on_lost": "degrade", "rate_hz": 200, "duration_s": 12.0}
    session = Session.whole(load_scenario("paper", rule), tmp_path, ends={})
    session.clocks["m1"].dies_ns = 4_000_000_000
    session.site("m1", at_ns=8_000_000_000)
    raised: set[tuple[str, str]] = set()

    def look(bus: Bus, clock: RelayClock) -> None:
        watch = SessionWatch(bus, clock, SESSION)
        while not watch.view.ended:
            watch.update()
            raised.update((name, alarm.word) for name, alarm in watch.alarms)
            sleep_for_ns(clock, 50_000_000)

    session.stranger(look)
    log = session.run()
    assert {("m2", "WITHOUT m1"), ("s", "WITHOUT m1")} <= raised
    assert not [name for name, word in raised if word.startswith("WITHOUT") and name == "m1"]
    assert any("s: *** WITHOUT m1" in line for line in session.said)
    assert [end for _, end in session.start_ends] == ["killed", 0, 0, 0]
    for name in ("m2", "s"):
        reasons = [int(state.mem[5]) for state in log[name].states]
        assert "hold" not in set(log[name].mode)
        assert reasons.index(LifeReason.DROPPED) < reasons.index(LifeReason.RESTORED)
        assert log[name].mode[-1] == "run"
    assert log["m1"].mode[-1] == "run"
    assert verify_log(log).differing == 0
