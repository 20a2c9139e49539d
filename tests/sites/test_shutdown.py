"""The end of a site: with `stay_s` the recorder leaves first, and only the wait depends on `stay_s`."""

from pathlib import Path

import pytest

from tests.net.waiting import sleep_for_ns
from trilat_net.net import topics
from trilat_net.net.bus import Bus
from trilat_net.net.messages import Event
from trilat_net.net.wire import encode
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import SESSION, Session

S = 1_000_000_000


def make_slow_session(folder: Path, stay_s: float) -> Session:
    """A session of two sites whose recorder works on for half a minute when it has every record."""
    scenario = load_scenario("two_sites", {"duration_s": 0.2})
    return Session.whole(scenario, folder, stay_s=stay_s, works_ns=30 * S, ends={})


@pytest.mark.parametrize(
    ("stay_s", "after", "least_s", "most_s"),
    [
        (
            120.0,
            "recorder",
            1,
            3,
        ),  # a process needs a moment to end: the recorder's shall be the first
        (0.0, "log", -1, 1),
        (4.0, "log", 3, 5),
    ],
    ids=[
        "it stays until the recorder has left",
        "until its records are stored",
        "no longer than it shall",
    ],
)
def test_how_long_a_site_stays(
    stay_s: float, after: str, least_s: int, most_s: int, tmp_path: Path
) -> None:
    session = make_slow_session(tmp_path, stay_s)
    session.run()
    assert session.ends == {"m": 0, "s": 0}
    for name in ("m", "s"):
        assert least_s * S < session.left_ns[name] - session.left_ns[after] < most_s * S


def test_signals_end_waits_without_spoiling_complete_runs(tmp_path: Path) -> None:
    session = make_slow_session(tmp_path, 120.0)

    def ask(clock: RelayClock) -> None:
        sleep_for_ns(clock, 10 * S)
        for interrupt in session.interrupts.values():
            interrupt.number = 15

    session.relay.add("somebody", ask)
    session.run()
    assert session.ends == {"m": 0, "s": 0}
    assert max(session.left_ns["m"], session.left_ns["s"]) < session.left_ns["recorder"]


def test_interrupted_sites_wait_for_all_recorders(tmp_path: Path) -> None:
    """One recorder has every record at once; another, which has come late, still asks for earlier ones."""
    scenario = load_scenario("two_sites", {"duration_s": 9.0})
    session = Session.whole(scenario, tmp_path, ends={})

    def come_late(bus: Bus, clock: RelayClock) -> None:
        bus.announce(topics.presence_token(SESSION, topics.RECORDER, 78))
        sleep_for_ns(clock, S)
        for interrupt in session.interrupts.values():
            interrupt.number = 2
        sleep_for_ns(clock, 3 * S)
        session.left_ns["late"] = clock.monotonic_ns()
        say = bus.publisher(topics.key(SESSION, topics.RECORDER, topics.EVENT))
        for n, name in enumerate(("m", "s")):
            event = Event(
                member=topics.RECORDER,
                boot=78,
                t_ns=0,
                n=n,
                kind="stored",
                text="",
                about=name,
                ticks=9000,
            )
            say(encode(event))

    session.stranger(come_late, at_ns=2 * S)
    session.run()
    assert session.ends == {"m": 130, "s": 130}
    assert min(session.left_ns["m"], session.left_ns["s"]) >= session.left_ns["late"]
