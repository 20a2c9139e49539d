"""Live sessions: real processes and Zenoh on loopback, equal to virtual time bit for bit."""

import signal

import pytest

from tests.cli.running import trilat
from tests.live.processes import (
    assert_equals_virtual_time,
    assert_executed_again,
    connection_options,
    open_whole_log,
)
from tests.net.waiting import sleep_for_ns
from trilat_net.execution.verification import verify_log
from trilat_net.execution.virtual_comparison import find_absent_samples
from trilat_net.log.log_reader import open_log
from trilat_net.net.clock import SystemClock

from .processes import BEGUN, PAPER, TALKING, Session, Stage


@pytest.mark.long  # on a push `make live` does the same with the commands
@pytest.mark.parametrize("law", [(), TALKING], ids=["its law", "a law that sends"])
def test_live_paper_experiment_equals_virtual_time(law: tuple[str, ...], stage: Stage) -> None:
    session = Session(stage, "paper", PAPER, "--duration", "3", *law)
    session.all()
    log = session.is_reproduced()
    assert sum(len(log[name]) for name in PAPER) == 9_000
    for name in PAPER:
        assert (
            f"{name}: 3000 of 3000 records, 0 missing" in session.processes["recorder"].text()
        )
        kinds = [event.kind for event in log.events if event.member == name]
        assert kinds.count("ready") + kinds.count("epoch") >= 1
        assert kinds[-1] == "end"
        assert "lost" not in kinds


@pytest.mark.long
def test_frozen_sites_on_slow_links_keep_bits(stage: Stage) -> None:
    session = Session(stage, "paper", PAPER, "--duration", "3", "--set", "link.delay_ms=2000")
    session.all()
    session.recording()
    clock = SystemClock()
    session.processes["m2"].signal(signal.SIGSTOP)
    sleep_for_ns(clock, 1_000_000_000)
    session.processes["m2"].signal(signal.SIGCONT)
    log = session.is_reproduced()
    assert max(log["m2"].late_us) > 800_000
    assert find_absent_samples(log) == []


def ping_waiting_session(session: Session) -> None:
    """Asserts that a ping is answered before the session begins; the ping joins nothing."""
    to = connection_options(session.endpoints)
    arguments = ("ping", "--session", "t", "--count", "10", *to)
    printed = trilat(*arguments, cwd=session.log.parent).succeeds()
    assert "session t waits for its members" in printed
    assert "the same clock" in printed
    assert "between the sites" not in printed


@pytest.mark.long
def test_needed_recorders_may_come_last(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "0.5")
    for name in ("s", "m", "recorder"):
        session.all(name)
        session.processes["s"].prints("waiting for")
        if name == "s":
            ping_waiting_session(session)
    session.ends_well()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    started = [event for event in log.events if event.kind == "start"]
    assert [event.member for event in started] == ["m"]
    assert set(started[0].boots) == {"recorder", "m", "s"}


@pytest.mark.long
def test_two_sessions_without_endpoints_do_not_meet(stage: Stage) -> None:
    seed = SystemClock().monotonic_ns()  # names of this test's own, hence ports of its own
    names = [f"terminals-{seed}", f"others-{seed}"]
    members = []
    for name in names:
        scenario = ("--scenario", "two_sites", "--session", name, "--duration", "1")
        members += [
            stage.start(f"{name} s", "site", "s", *scenario, "--needs-recorder"),
            stage.start(f"{name} recorder", "record", "--session", name),
            stage.start(f"{name} m", "site", "m", *scenario),
        ]
    for member in members:
        assert member.code() == 0, member
    for name in names:
        log = open_whole_log(stage.folder / f"{name}.mcap")
        assert log.session["session"] == name
        assert_executed_again(log)
        assert_equals_virtual_time(log)
        assert "lost" not in {event.kind for event in log.events}


@pytest.mark.long
def test_interrupted_recorders_finish_files_and_sites_continue(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "2")
    session.all()
    recorder = session.processes["recorder"]
    session.recording()
    recorder.signal(signal.SIGINT)
    assert recorder.code() == 130
    log = open_log(session.log)
    assert log.complete
    assert 0 < len(log["m"]) < 2000
    assert verify_log(log).agreed
    assert not verify_log(log).passed  # the rest of the run is not in it
    assert session.codes() == {"recorder": 130, "m": 0, "s": 0}
    assert "m: 2000 ticks" in session.processes["m"].text()


@pytest.mark.long
def test_waiting_in_vain_names_the_missing(stage: Stage) -> None:
    site = Session(stage, "paper", PAPER).site("m2", "--join-timeout", "1")
    apart = Session(stage, "paper", PAPER)
    recorder = apart.recorder("--join-timeout", "1")
    assert (site.code(), recorder.code()) == (2, 2)
    (error,) = (line for line in site.text().splitlines() if line.startswith("error: "))
    assert "m1, s did not join" in error
    assert BEGUN not in site.text()
    assert "members present: none" in recorder.text()
    assert not apart.log.exists()
