"""The end of a site: with `stay_s` the recorder leaves first, and nothing but the wait hangs on it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from recorder.record_process import Recorder
from sites.site_parts import SiteOptions, SiteParts
from sites.site_process import take_part
from trilat_net.log.log_writer import LogStorage
from trilat_net.net.connection import Connection
from trilat_net.process import Interrupt
from trilat_net.scenario import load_scenario

from .relay import RelayClock
from .sessions import RECORDER_BOOT, SESSION, Session

pytestmark = pytest.mark.usefixtures("unprepared")
S = 1_000_000_000


class Ending:
    """A session of two sites whose recorder works on for a while when it has all."""

    def __init__(self, path: Path, stay_s: float, works_ns: int) -> None:
        self.session = Session(load_scenario("two_sites", {"duration_s": 0.2}), path)
        self.left_ns: dict[str, int] = {}
        self.interrupts = {name: Interrupt() for name in ("m", "s")}
        self._stay_s, self._works_ns = stay_s, works_ns
        for name in ("m", "s"):
            self.session.relay.add(name, self._site(name))
        self.session.relay.add("recorder", self._recorder)

    def _site(self, name: str) -> Callable[[RelayClock], int]:
        def run(clock: RelayClock) -> int:
            bus = self.session.network.join()
            options = SiteOptions(SESSION, Connection(), 10.0, needs_recorder=True, stay_s=self._stay_s)
            interrupt = self.interrupts[name]
            scenario = self.session.scenario
            parts = SiteParts(scenario, name, options, bus, clock, interrupt, lambda _text: None)
            try:
                return take_part(parts)
            finally:
                bus.close()
                self.left_ns[name] = clock.monotonic_ns()

        return run

    def _recorder(self, clock: RelayClock) -> None:
        bus = self.session.network.join()
        path = self.session.path
        recorder = Recorder(
            bus, clock, SESSION, RECORDER_BOOT, LogStorage(path), lambda: False, lambda _text: None
        )
        epoch = recorder.join(30.0)
        assert epoch is not None
        recorder.record(epoch)
        self.left_ns["log"] = clock.monotonic_ns()
        clock.sleep_until(clock.monotonic_ns() + self._works_ns)
        self.left_ns["recorder"] = clock.monotonic_ns()
        bus.close()

    def run(self) -> dict[str, object]:
        self.session.run()
        return {name: self.session.relay.results[name] for name in ("m", "s")}


def test_a_site_that_stays_leaves_when_the_recorder_has_left(tmp_path: Path) -> None:
    ending = Ending(tmp_path / "run.mcap", stay_s=120.0, works_ns=30 * S)
    assert ending.run() == {"m": 0, "s": 0}
    for name in ("m", "s"):  # a process needs a moment to end: the recorder's shall be the first
        assert S < ending.left_ns[name] - ending.left_ns["recorder"] < 3 * S


def test_without_a_wish_to_stay_a_site_leaves_when_its_records_are_stored(tmp_path: Path) -> None:
    ending = Ending(tmp_path / "run.mcap", stay_s=0.0, works_ns=30 * S)
    assert ending.run() == {"m": 0, "s": 0}
    assert max(ending.left_ns["m"], ending.left_ns["s"]) - ending.left_ns["log"] < S


def test_a_site_stays_no_longer_than_it_shall(tmp_path: Path) -> None:
    ending = Ending(tmp_path / "run.mcap", stay_s=4.0, works_ns=30 * S)
    assert ending.run() == {"m": 0, "s": 0}
    for name in ("m", "s"):
        assert 3 * S < ending.left_ns[name] - ending.left_ns["log"] < 5 * S


def test_a_signal_ends_the_wait_and_spoils_no_run_that_was_complete(tmp_path: Path) -> None:
    ending = Ending(tmp_path / "run.mcap", stay_s=120.0, works_ns=30 * S)

    def ask(clock: RelayClock) -> None:
        clock.sleep_until(clock.monotonic_ns() + 10 * S)
        for interrupt in ending.interrupts.values():
            interrupt.number = 15

    ending.session.relay.add("somebody", ask)
    assert ending.run() == {"m": 0, "s": 0}
    assert max(ending.left_ns["m"], ending.left_ns["s"]) < ending.left_ns["recorder"]
