"""The recorder of a live session: stopped, killed, started again; the log is whole all the same."""

import signal
from pathlib import Path

import pytest

from tests.live.processes import assert_executed_again, open_whole_log, pause
from tests.net.waiting import until
from trilat_net.execution.verification import verify
from trilat_net.log.log_layout import active_path
from trilat_net.log.log_reader import Log, open_log
from trilat_net.net.connection import find_free_endpoints

from .processes import TALKING, Process, Session, Stage


def start_second_recorder(session: Session, log: Path) -> Process:
    """Starts a second recorder of a session, and returns the process once it has joined."""
    session.recorder_endpoint = find_free_endpoints(1)[0]
    recorder = session.recorder(called=log.stem, log=log)
    recorder.prints("joins the session")
    return recorder


def interrupt_sites(session: Session) -> dict[str, int]:
    """Interrupts all sites after a second, and returns their exit codes."""
    pause(1.0)
    for name in session.sites:
        session.processes[name].signal(signal.SIGINT)
    return {name: session.processes[name].code() for name in session.sites}


def open_complete_log(path: Path) -> Log:
    """Returns a log after checking that it has every record and message."""
    log = open_whole_log(path, in_full=False)
    accounts = [text for topic, text in log.accounts.items() if topic.startswith("/trilat")]
    assert all("missing 0, duplicate 0" in text for text in accounts)
    assert_executed_again(log)
    return log


@pytest.mark.long
def test_frozen_recorders_finally_have_every_record(stage: Stage) -> None:
    """The buffers on the way are small, so that the network drops what it cannot deliver."""
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "7")
    session.endpoints = [
        f"{endpoint}#so_sndbuf=8192;so_rcvbuf=8192" for endpoint in session.endpoints
    ]
    session.all()
    session.recording()
    recorder = session.processes["recorder"]
    recorder.signal(signal.SIGSTOP)
    pause(4.0)
    recorder.signal(signal.SIGCONT)
    session.is_reproduced()
    assert recorder.text().count(" from its memory") == 2


@pytest.mark.parametrize("law", [(), pytest.param(TALKING, marks=pytest.mark.long)])
def test_a_killed_recorders_successor_has_all_records(
    law: tuple[str, ...], stage: Stage
) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "50", *law)
    session.all()
    session.recording()
    killed = session.processes["recorder"]
    killed.signal(signal.SIGKILL)
    until(killed.ended, 10.0)
    later = start_second_recorder(session, stage.folder / "later.mcap")
    assert interrupt_sites(session) == {"m": 130, "s": 130}
    assert later.code() == 0
    log = open_complete_log(stage.folder / "later.mcap")
    (late,) = [event for event in log.events if event.kind == "late"]
    assert late.t_ns > 0
    events = {event.kind for event in log.events if event.member == "m"}
    assert {"epoch", "start", "setup", "lost", "back", "end"} <= events
    torn = open_log(active_path(session.log))
    assert not torn.complete
    assert verify(torn).agreed


@pytest.mark.long
def test_two_recorders_at_once_have_the_same_records(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "50")
    session.all()
    session.begun()
    twin = start_second_recorder(session, stage.folder / "twin.mcap")
    assert interrupt_sites(session) == {"m": 130, "s": 130}
    assert (session.processes["recorder"].code(), twin.code()) == (0, 0)
    logs = [open_complete_log(path) for path in (session.log, stage.folder / "twin.mcap")]
    for name in session.sites:
        assert logs[0][name].states == logs[1][name].states
