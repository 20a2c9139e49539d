"""The recorder of a live session: stopped, killed, started again; the log is whole all the same."""

import signal
from pathlib import Path

import pytest

from tests.live.processes import assert_executed_again, open_whole_log
from tests.net.free_endpoints import find_free_endpoints
from tests.net.waiting import sleep_for_ns, until
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_layout import active_path
from trilat_net.log.log_reader import Log, open_log
from trilat_net.net.clock import SystemClock

from .processes import Process, Session, Stage

S = 1_000_000_000


def pause(for_ns: int) -> None:
    clock = SystemClock()
    sleep_for_ns(clock, for_ns)


def one_more(session: Session, log: Path) -> Process:
    """One more recorder of a session, with a file of its own, once it is in."""
    session.recorder_endpoint = find_free_endpoints(1)[0]
    recorder = session.recorder(called=log.stem, log=log)
    recorder.prints("joins the session")
    return recorder


def interrupt_sites(session: Session) -> dict[str, int]:
    """Ends the sites after a while, however long it took to come here; how every site ended."""
    pause(S)
    for name in session.sites:
        session.processes[name].signal(signal.SIGINT)
    return {name: session.processes[name].code() for name in session.sites}


def from_the_start(path: Path) -> Log:
    """A log that has every record that was made, and everything else."""
    log = open_whole_log(path, in_full=False)
    accounts = [text for topic, text in log.accounts.items() if topic.startswith("/trilat")]
    assert all("missing 0, duplicate 0" in text for text in accounts)
    assert_executed_again(log)
    return log


@pytest.mark.long
def test_frozen_recorders_finally_have_every_record(stage: Stage) -> None:
    """With small buffers on the way, so that the network drops what it cannot deliver."""
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "7")
    session.endpoints = [
        f"{endpoint}#so_sndbuf=8192;so_rcvbuf=8192" for endpoint in session.endpoints
    ]
    session.all()
    session.recording()
    recorder = session.processes["recorder"]
    recorder.signal(signal.SIGSTOP)
    pause(4 * S)
    recorder.signal(signal.SIGCONT)
    session.is_reproduced()
    assert recorder.text().count(" from its memory") == 2


def test_a_killed_recorders_successor_has_all_records(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "50")
    session.all()
    session.recording()
    killed = session.processes["recorder"]
    killed.signal(signal.SIGKILL)
    until(killed.ended, 10.0)
    later = one_more(session, stage.folder / "later.mcap")
    assert interrupt_sites(session) == {"m": 130, "s": 130}
    assert later.code() == 0
    log = from_the_start(stage.folder / "later.mcap")
    (late,) = [event for event in log.events if event.kind == "late"]
    assert late.t_ns > 0
    events = {event.kind for event in log.events if event.member == "m"}
    assert {"epoch", "start", "setup", "lost", "back", "end"} <= events
    torn = open_log(active_path(session.log))
    assert not torn.complete
    assert verify_log(torn).agreed


@pytest.mark.long
def test_two_recorders_at_once_have_the_same_records(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "50")
    session.all()
    session.begun()
    twin = one_more(session, stage.folder / "twin.mcap")
    assert interrupt_sites(session) == {"m": 130, "s": 130}
    assert (session.processes["recorder"].code(), twin.code()) == (0, 0)
    logs = [from_the_start(path) for path in (session.log, stage.folder / "twin.mcap")]
    for name in session.sites:
        assert logs[0][name].states == logs[1][name].states
