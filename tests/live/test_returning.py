"""Sites that are killed in a running session and started again, and one that leaves as it hangs up."""

import signal
from collections.abc import Sequence

import numpy as np
import pytest

from tests.faults.invariants import SILENT_TICKS, count_silence, stretches
from trilat_net.execution.verify import verify
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.session_check import check_log
from trilat_net.net.clock import SystemClock

from .processes import PAPER, Session, Stage

GLIDE = (
    *("--set", 'on_stale.action="glide"'),
    *("--set", "on_stale.align_speed_rad_s=1.0"),
    *("--set", "on_stale.align_limit_rad=3.0"),
)
JOINS, FOLLOWS = "joins the running session", " s, run, "


def pause(time_s: float) -> None:
    """Lets a session go on for a time."""
    clock = SystemClock()
    clock.sleep_until(clock.monotonic_ns() + round(time_s * 1e9))


def ticks_to_hold(log: Log) -> dict[str, list[int]]:
    """Of every hold of each site, how many ticks after its last sample in use it began."""
    found: dict[str, list[int]] = {site: [] for site in log.sites}
    for site, holds in found.items():
        for stretch in stretches(log[site].states):
            before = ""
            for state, silent in count_silence(stretch):
                assert state.mode not in ("run", "return") or silent <= SILENT_TICKS, (site, state.tick)
                if state.mode == "hold" != before:
                    holds.append(silent)
                before = state.mode
    return found


def killed_and_started_again(stage: Stage, victims: Sequence[str]) -> tuple[Session, Log]:
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


def engaged_after_s(log: Log) -> list[float]:
    """Of each start that joined, how long after its first tick it followed its peers, s."""
    found = []
    for site, starts in log.starts.items():
        part = log[site]
        for first, _ in starts:
            engaged = (part.tick >= first) & (part.mode == "run")
            assert engaged.any(), (site, first)
            found.append(float(part.tick[np.argmax(engaged)] - first) / part.rate_hz)
    return found


@pytest.mark.long
@pytest.mark.parametrize("victims", [("m1", "s", "m1")])
def test_a_killed_site_started_again_follows_within_two_seconds(victims: Sequence[str], stage: Stage) -> None:
    session, log = killed_and_started_again(stage, victims)
    took_s = engaged_after_s(log)
    assert len(took_s) == len(victims)
    assert max(took_s) <= 2.0, took_s
    holds = ticks_to_hold(log)
    assert len(holds["m2"]) >= len(victims) + 1  # and once for who was stopped
    assert min(map(len, holds.values())) >= 2
    assert max(max(found) for found in holds.values()) <= SILENT_TICKS + 1
    for site in log.sites:
        assert log.missing(site) == 0
        if site not in victims:
            assert log[site].tick.tolist() == list(range(len(log[site])))
    result = verify(log)
    assert result.passed
    assert (result.differing, result.gaps) == (0, [])
    assert len(result.absences) == len(victims)
    check = check_log([session.log])
    assert check.passed, check.findings


@pytest.mark.long
def test_a_site_that_hangs_up_is_named_by_the_others(stage: Stage) -> None:
    session = Session(stage, "two_sites", ("m", "s"), "--duration", "6", *GLIDE)
    session.all()
    session.begun()
    session.recording()
    session.processes["s"].signal(signal.SIGHUP)
    assert session.codes() == {"recorder": 0, "m": 3, "s": 128 + signal.SIGHUP}
    assert "ended by SIGHUP, and did not come back" in session.processes["m"].text()
    log = open_log(session.log)
    assert len(log["m"]) == 6000
    assert verify(log).passed
