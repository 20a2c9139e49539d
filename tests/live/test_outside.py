"""What comes from outside, in real processes: a law that cannot keep up, an arm that is no arm of ours."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.live.processes import assert_executed_again, open_whole_log
from trilat_net.execution.virtual import execute_virtual
from trilat_net.execution.virtual_comparison import compare_with_virtual
from trilat_net.log.log_reader import open_log
from trilat_net.scenario import load_scenario

from .processes import OUTSIDE, PATIENCE_S, PLAIN, TALKING, Session, Stage

ARM = Path(__file__).parents[2] / "examples" / "external_arm.py"
SLOW = """
import time
from tests.laws import Adaptive

class Law(Adaptive):
    def torque(self, now):
        if now.k > 400:
            begun_s = time.thread_time()
            while time.thread_time() - begun_s < 0.02:
                pass  # it computes
        return super().torque(now)
"""


@pytest.mark.long
def test_slow_laws_end_sessions_in_order(stage: Stage, monkeypatch: pytest.MonkeyPatch) -> None:
    (stage.folder / "slow_law.py").write_text(SLOW)
    monkeypatch.chdir(stage.folder)
    law = ("--set", "sites.s.control.law=slow_law:Law")
    session = Session(stage, "two_sites", ("m", "s"), *law, "--duration", "20")
    session.all()
    assert session.codes() == {"recorder": 0, "m": 1, "s": 1}
    (failure,) = (
        line
        for line in session.processes["s"].text().splitlines()
        if line.startswith("error: ")
    )
    assert "the law slow_law:Law of s failed at tick 4" in failure
    assert "the code is too slow" in failure
    assert failure.removeprefix("error: ") in session.processes["m"].text()
    log = open_log(session.log)
    assert log.complete
    assert [event.member for event in log.events if event.kind == "failed"] == ["s"]
    assert 400 < len(log["s"]) < 500
    assert_executed_again(log)


def test_external_arms_join_a_session_of_two(stage: Stage) -> None:
    """All with a law that is none of ours either, and that sends to all and to each."""
    options = (*OUTSIDE, *TALKING, "--duration", "4", "--set", "rate_hz=250")
    session = Session(stage, "paper", ("m1", "m2", "s"), *options)
    session.all()
    session.processes["s"].prints("waiting for its arm on trilat/t/s/measured")
    assert "over: the arm is at " in drive_arm(session, "two_sites")
    session.ends_well()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    assert compare_with_virtual(log).fed.identical == 3000 - log["s"].skipped
    assert log["m1"].sent["target[s]"].any()
    assert abs(log["s"].q - log["s"].q[0]).max() > 0.01  # it moved, and not by our equations
    assert not log["s"].tau_x.any()  # it measured none


def drive_arm(session: Session, scenario: str, *options: str) -> str:
    """Runs the program of the example until it ends; what it printed."""
    arguments = (
        "s",
        "--scenario",
        scenario,
        "--session",
        "t",
        "--connect",
        session.endpoints[-1],
        *options,
    )
    done = subprocess.run(
        [sys.executable, str(ARM), *arguments],
        env=PLAIN,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
    )
    return done.stdout


@pytest.mark.long
def test_refused_joints_leave_room_for_right_ones(stage: Stage) -> None:
    """The wrong arm goes on sending until it is ended; the right one may begin where it did not."""
    next(execute_virtual(load_scenario("seven_joints")))  # compiles, once for all processes
    options = (*OUTSIDE, "--duration", "3")
    session = Session(stage, "seven_joints", ("m1", "m2", "s"), *options)
    session.all()
    site = session.processes["s"]
    site.prints("waiting for its arm on trilat/t/s/measured")
    arguments = (
        "s",
        "--scenario",
        "six_joints",
        "--session",
        "t",
        "--connect",
        session.endpoints[-1],
    )
    wrong = subprocess.Popen([sys.executable, str(ARM), *arguments], env=PLAIN)
    try:
        site.prints("its arm sends measurements of 6 joints; the scenario has 7")
    finally:
        wrong.kill()
        wrong.wait()
    assert drive_arm(session, "seven_joints", "--sensor").count(",") == 6
    session.ends_well()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    assert compare_with_virtual(log).fed.identical == 9000 - log["s"].skipped
    felt = log["s"].tau_x
    # somebody leans on the first joint with a half sine of 0.5 N m
    assert -0.5 <= felt[:, 0].min() < -0.1
    assert not felt[:, 1:].any()
