"""A log on the network once more: recorded again it is the same log, and others find a session that runs."""

import signal
from pathlib import Path

import pytest

from tests.live.processes import assert_executed_again
from tests.log.builders import make_log_bytes, write_log
from tests.net.free_endpoints import find_free_endpoints
from tests.recorder.play.logs import read_session_payloads
from tests.sites.sessions import Session as Sites
from tests.sites.sessions import make_gliding_scenario
from trilat_net.log.log_reader import open_log

from .processes import Process, Session, Stage


class Again:
    """A replay on an endpoint of its own, and those who listen to it."""

    def __init__(self, stage: Stage, log: Path) -> None:
        self._stage = stage
        self._log = log
        (self.endpoint,) = find_free_endpoints(1)

    def replay(self, *options: str, called: str = "replay", listen: str = "") -> Process:
        return self._stage.start(
            called,
            "replay",
            str(self._log),
            "--session",
            "again",
            "--listen",
            listen or self.endpoint,
            *options,
        )

    def recorder(self, log: Path) -> Process:
        return self._stage.start(
            "second recorder",
            "record",
            "--session",
            "again",
            "-o",
            str(log),
            "--connect",
            self.endpoint,
        )


def sort_payloads(log: Path) -> dict[str, list[bytes]]:
    """Returns the payloads of sites by channel, sorted, because their order in the file may differ."""
    return {key: sorted(payloads) for key, payloads in read_session_payloads(log).items()}


@pytest.mark.parametrize("live", [False, pytest.param(True, marks=pytest.mark.long)])
def test_replayed_and_recorded_logs_are_equal_bytewise(live: bool, stage: Stage) -> None:
    path = write_virtual_log(stage.folder)
    if live:
        session = Session(stage, "two_sites", ("m", "s"), "--duration", "1.5")
        session.all()
        session.ends_well()
        path = session.log
    again = Again(stage, path)
    second = stage.folder / "second.mcap"
    recorder = again.recorder(second)
    replay = again.replay("--needs-recorder")
    assert (replay.code(), recorder.code()) == (0, 0)
    assert "none dropped" in replay.text()
    assert "the recorder has everything" in replay.text()
    assert read_session_payloads(second) == read_session_payloads(path)
    log = open_log(second)
    assert_executed_again(log)
    assert "missing 0" in log.account("s")


def write_virtual_log(folder: Path) -> Path:
    return write_log(folder, make_log_bytes("two_sites", {"duration_s": 1.0}), "virtual.mcap")


@pytest.mark.long
def test_latecomers_to_a_replay_get_everything(stage: Stage) -> None:
    """Round after round, so that nobody is too late; until Ctrl-C."""
    path = write_virtual_log(stage.folder)
    again = Again(stage, path)
    replay = again.replay("--loop")
    replay.prints("playing")
    ping = stage.start(
        "ping", "ping", "--session", "again", "--connect", again.endpoint, "--count", "5"
    )
    (elsewhere,) = find_free_endpoints(1)
    other = again.replay("--connect", again.endpoint, called="other replay", listen=elsewhere)
    second = stage.folder / "second.mcap"
    recorder = again.recorder(second)
    assert ping.code() == 0
    assert "session again runs" in ping.text()
    assert other.code() == 2
    assert "session 'again' already exists and is running" in other.text()
    assert recorder.code() == 0
    assert sort_payloads(second) == sort_payloads(path)
    replay.signal(signal.SIGINT)
    assert replay.code() == 130
    assert "interrupted" in replay.text()


@pytest.mark.long
def test_a_fast_replay_to_another_process_loses_nothing(stage: Stage) -> None:
    path = write_virtual_log(stage.folder)
    again = Again(stage, path)
    second = stage.folder / "second.mcap"
    recorder = again.recorder(second)
    replay = again.replay("--rate", "max", "--preload", "0", "--needs-recorder")
    assert (replay.code(), recorder.code()) == (0, 0)
    assert sort_payloads(second) == sort_payloads(path)


@pytest.mark.long
def test_logs_of_restarted_sites_are_played_whole(stage: Stage) -> None:
    """Each start numbers its events from 0; they are played start after start, and none is lost."""
    session = Sites.whole(make_gliding_scenario(5.0), stage.folder, ends={})
    session.clocks["m"].dies_ns = 3_000_000_000
    session.site("m", at_ns=4_000_000_000)
    path = session.run().source
    again = Again(stage, Path(path))
    second = stage.folder / "second.mcap"
    recorder = again.recorder(second)
    replay = again.replay("--needs-recorder")
    assert (replay.code(), recorder.code()) == (0, 0), (replay, recorder)
    assert sort_payloads(second) == sort_payloads(Path(path))
    assert open_log(second).starts["m"] == open_log(path).starts["m"]
    assert_executed_again(open_log(second))
