"""A running session from Python: the present shares of a site."""

from pathlib import Path

import pytest

from tests.net.waiting import sleep_for_ns, until
from tests.sites.sessions import reach_session
from trilat_net.net.bus import Bus
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import Session


def test_shares_are_current_for_latecomers_too(tmp_path: Path) -> None:
    """More than half of the ramp from 0.5 to 0.9 is over when a member asks that has heard of no change."""
    scenario = load_scenario("play", {"duration_s": 4.0, "rate_hz": 200})
    session = Session.whole(scenario, tmp_path)
    shares = dict[str, dict[str, float]]()

    def act(bus: Bus, clock: RelayClock) -> None:
        def wait_s(time_s: float) -> None:
            sleep_for_ns(clock, round(time_s * 1e9))

        wait_s(1.0)
        running = reach_session(bus, clock)
        with running.shares("s") as find:
            shares["before"] = find()
            running.set_dominance("s", {"m1": 0.9, "m2": 0.1}, 1.0)
            until(lambda: find()["m1"] > 0.7, clock=clock)
            shares["half"] = find()
            with reach_session(session.join("late"), clock).shares("s") as look:
                until(lambda: look()["m1"] > 0.7, clock=clock)
                shares["late"] = look()
                shares["early"] = find()
            wait_s(1.0)
            shares["after"] = find()

    session.stranger(act)
    session.run()
    assert shares["before"] == {"m1": 0.5, "m2": 0.5}
    assert shares["half"]["m1"] == pytest.approx(0.7, abs=0.02)
    assert shares["late"] == shares["early"]
    assert 0.7 < shares["late"]["m1"] < 0.9
    assert shares["after"] == {"m1": 0.9, "m2": 0.1}
