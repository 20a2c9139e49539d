"""States of a running session for programs: the newest states, the knowledge of one site, marks
and episodes.
"""

from pathlib import Path
from typing import Any

import numpy as np

from trilat_net.app.running_session import RunningSession
from trilat_net.log.log_reader import open_log
from trilat_net.net.connection import Connection
from trilat_net.net.messages import State
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import SESSION, Session

MS_NS = 1_000_000


def add_watcher(
    session: Session, what: Any, first_ms: int = 2_200, every_ms: int = 33, times: int = 20
) -> None:
    def run(clock: RelayClock) -> None:
        clock.sleep_until(first_ms * MS_NS)
        bus = session.network.join()
        with what(RunningSession(SESSION, Connection(), bus, clock)) as do:
            for n in range(times):
                clock.sleep_until((first_ms + every_ms * (n + 1)) * MS_NS)
                do()

    session.relay.add("watcher", run)


def test_states_as_one_site_knows_them(tmp_path: Path) -> None:
    scenario = load_scenario("paper", {"link.delay_ms": 120, "duration_s": 1.5})
    session = Session.whole(scenario, tmp_path)
    seen: list[dict[str, State]] = []
    newest: list[dict[str, State]] = []

    class Both:
        def __init__(self, running: RunningSession) -> None:
            self._ways = running.states(as_site="m1"), running.states()

        def __enter__(self) -> Any:
            known, true = (way.__enter__() for way in self._ways)
            return lambda: (seen.append(known()), newest.append(true()))

        def __exit__(self, *error: Any) -> None:
            for way in self._ways:
                way.__exit__(*error)

    add_watcher(session, Both)
    session.play()
    log = open_log(session.path)
    # it listens for longer than the delay
    for states, true in list(zip(seen, newest, strict=True))[5:]:
        own_state = states["m1"]
        for peer in ("m2", "s"):
            assert (
                states[peer].tick
                == own_state.used[peer]
                == log["m1"].states[own_state.tick].used[peer]
            )
            assert np.array_equal(states[peer].q, log[peer].q[own_state.used[peer]])
            assert true[peer].tick - states[peer].tick >= 120 - 11  # records come ten at a time
    assert seen


def test_marks_and_episodes_stand_in_the_log(tmp_path: Path) -> None:
    session = Session.whole(load_scenario("paper", {"duration_s": 3.0}), tmp_path)

    def run(clock: RelayClock) -> None:
        clock.sleep_until(1_800 * MS_NS)
        running = RunningSession(SESSION, Connection(), session.network.join(), clock)
        running.mark("look here")
        for name, success in (("one", True), ("two", False), ("three", None)):
            with running.episode(name) as judge:
                if success is not None:
                    judge(success)

    session.relay.add("program", run)
    session.play()
    texts = [event.text for event in open_log(session.path).events if event.kind == "mark"]
    ends = ["succeeded", "failed", "ended"]
    named = zip(("one", "two", "three"), ends, strict=True)
    marked = [f"episode {name} {what}" for name, end in named for what in ("begins", end)]
    assert texts == ["look here", *marked]
