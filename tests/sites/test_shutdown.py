"""The end of a site: with `stay_s` the recorder leaves first, and nothing but the wait hangs on it."""

from pathlib import Path

import pytest

from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import Session

pytestmark = pytest.mark.usefixtures("unprepared")
S = 1_000_000_000


def ending(folder: Path, stay_s: float) -> Session:
    """A session of two sites whose recorder works on for half a minute when it has all."""
    scenario = load_scenario("two_sites", {"duration_s": 0.2})
    return Session.whole(scenario, folder, stay_s=stay_s, works_ns=30 * S, ends={})


def test_a_site_that_stays_leaves_when_the_recorder_has_left(tmp_path: Path) -> None:
    session = ending(tmp_path, 120.0)
    session.run()
    assert session.ends == {"m": 0, "s": 0}
    for name in ("m", "s"):  # a process needs a moment to end: the recorder's shall be the first
        assert S < session.left_ns[name] - session.left_ns["recorder"] < 3 * S


def test_without_a_wish_to_stay_a_site_leaves_when_its_records_are_stored(tmp_path: Path) -> None:
    session = ending(tmp_path, 0.0)
    session.run()
    assert session.ends == {"m": 0, "s": 0}
    assert max(session.left_ns["m"], session.left_ns["s"]) - session.left_ns["log"] < S


def test_a_site_stays_no_longer_than_it_shall(tmp_path: Path) -> None:
    session = ending(tmp_path, 4.0)
    session.run()
    assert session.ends == {"m": 0, "s": 0}
    for name in ("m", "s"):
        assert 3 * S < session.left_ns[name] - session.left_ns["log"] < 5 * S


def test_a_signal_ends_the_wait_and_spoils_no_run_that_was_complete(tmp_path: Path) -> None:
    session = ending(tmp_path, 120.0)

    def ask(clock: RelayClock) -> None:
        clock.sleep_until(clock.monotonic_ns() + 10 * S)
        for interrupt in session.interrupts.values():
            interrupt.number = 15

    session.relay.add("somebody", ask)
    session.run()
    assert session.ends == {"m": 0, "s": 0}
    assert max(session.left_ns["m"], session.left_ns["s"]) < session.left_ns["recorder"]
