"""Sites that are killed in a running session and started again, and one that leaves as it hangs up."""

import signal
from collections.abc import Sequence

import pytest

from tests.faults.invariants import SILENT_TICKS
from tests.live.processes import list_engagements_s
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.session_check import check_file

from .processes import FOLLOWS, GLIDE, JOINS, PAPER, Session, Stage, pause, ticks_to_hold


def kill_and_restart_sites(stage: Stage, victims: Sequence[str]) -> tuple[Session, Log]:
    """The paper's session: one site after the other is killed and started again, then one stopped for 1 s."""
    session = Session(stage, "paper", PAPER, "--duration", "600", *GLIDE)
    session.all()
    session.begun()
    for name in PAPER:
        session.processes[name].prints(FOLLOWS)
    for n, victim in enumerate(victims):
        killed = session.processes[victim]
        killed.signal(signal.SIGKILL)
        assert killed.code() == -signal.SIGKILL
        started = session.site(victim, called=f"{victim}, start {n + 2}")
        session.processes[victim] = started
        started.prints(JOINS)
        started.prints(FOLLOWS)
    session.processes["s"].signal(signal.SIGSTOP)
    pause(1.0)
    session.processes["s"].signal(signal.SIGCONT)
    pause(4.0)
    for name in PAPER:
        session.processes[name].signal(signal.SIGINT)
    assert [session.processes[name].code() for name in PAPER] == [130] * 3
    assert session.processes["recorder"].code() == 0, session.processes["recorder"]
    return session, open_log(session.log)


@pytest.mark.long
@pytest.mark.parametrize("victims", [("m1", "s", "m1")])
def test_restarted_sites_follow_within_two_seconds(
    victims: Sequence[str], stage: Stage
) -> None:
    session, log = kill_and_restart_sites(stage, victims)
    took_s = list_engagements_s(log)
    assert len(took_s) == len(victims)
    assert max(took_s) <= 2.0, took_s
    holds = ticks_to_hold(log)
    assert len(holds["m2"]) >= len(victims) + 1  # and once for who was stopped
    assert min(map(len, holds.values())) >= 2
    assert max(max(ticks) for ticks in holds.values()) <= SILENT_TICKS + 1
    for site in log.sites:
        assert log.missing(site) == 0
        if site not in victims:
            assert log[site].tick.tolist() == list(range(len(log[site])))
    result = verify_log(log)
    assert result.passed
    assert (result.differing, result.gaps) == (0, [])
    assert len(result.absences) == len(victims)
    check = check_file(session.log)
    assert check.passed, check.findings


@pytest.mark.long
def test_leaving_sites_are_named_by_the_others(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "6", *GLIDE)
    session.all()
    session.begun()
    session.recording()
    session.processes["s"].signal(signal.SIGHUP)
    assert session.codes() == {"recorder": 0, "m": 3, "s": 128 + signal.SIGHUP}
    assert "ended by SIGHUP; s did not rejoin the session" in session.processes["m"].text()
    log = open_log(session.log)
    assert len(log["m"]) == 6000
    assert verify_log(log).passed
