"""The demo ends in order whatever happens: it says what, its children are gone, its log is valid."""

import os
import re
import shlex
import signal
from pathlib import Path

import pytest

import trilat_net
from tests.cli.running import trilat
from tests.live.processes import is_gone, wait_for_records
from tests.net.waiting import until
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import open_log

from .processes import Process, Stage


def start_demo(stage: Stage, duration: str = "3") -> Process:
    return stage.start(
        "demo", "demo", "two_sites", "--duration", duration, "--out", str(stage.folder / "out")
    )


def find_child(demo: Process, words: str) -> int:
    return until(
        lambda: next((pid for pid, line in demo.children().items() if words in line), 0), 30
    )


def wait_for_recording(stage: Stage) -> Path:
    log = stage.folder / "out" / "run.mcap"
    wait_for_records(log)
    return log


@pytest.mark.long
def test_a_killed_site_is_named_with_its_signal(stage: Stage) -> None:
    running = start_demo(stage)
    log_file = wait_for_recording(stage)
    children = running.children()
    assert len(children) == 4  # two sites, a recorder, and what starts them
    os.kill(find_child(running, "site s "), signal.SIGKILL)
    assert running.code() == 1
    errors = [line for line in running.text().splitlines() if line.startswith("error: ")]
    assert errors == ["error: s was killed by SIGKILL"]
    assert all(is_gone(pid) for pid in children)
    log = open_log(log_file)
    assert log.complete
    verdict = verify_log(log)
    assert verdict.passed
    assert verdict.identical > 0
    assert [event.about for event in log.events if event.kind == "lost"] == ["s"]


def test_ctrl_c_ends_everything_and_finishes_file(stage: Stage) -> None:
    """A demo bears the name of its scenario, so that `tn.hand` finds the session while it runs."""
    running = stage.start(
        "demo", "demo", "play", "--duration", "30", "--out", str(stage.folder / "out")
    )
    log_file = wait_for_recording(stage)
    children = running.children()
    with trilat_net.hand("play", "m1", source="test", timeout_s=30.0) as hand:
        hand.move(*hand.pose)
    running.prints("; late ")
    running.signal(signal.SIGINT)
    assert running.code() == 130
    assert all(is_gone(pid) for pid in children)
    log = open_log(log_file)
    assert log.complete
    assert {event.member for event in log.events if event.kind == "end"} == {"m1", "m2", "s"}
    assert verify_log(log).passed
    assert "session play; Ctrl-C ends it" in running.text()
    assert re.search(r"; torque \d+\.\d\d N m; age .*; late ", running.text())
    assert "run.mcap holds the records so far" in running.text()


@pytest.mark.parametrize(
    ("number", "when"),
    [
        pytest.param(signal.SIGINT, "site m ", id="SIGINT"),
        pytest.param(signal.SIGTERM, "record ", id="SIGTERM", marks=pytest.mark.long),
        pytest.param(signal.SIGINT, "", id="before any child", marks=pytest.mark.long),
    ],
)
def test_signals_before_sessions_leave_no_log(number: int, when: str, stage: Stage) -> None:
    running = start_demo(stage)
    running.prints("s live: ")
    if when:
        find_child(running, when)  # that child has been started just now
    children = running.children()
    running.signal(number)
    assert running.code() == 128 + number
    assert all(is_gone(pid) for pid in children)
    assert not (stage.folder / "out" / "run.mcap").exists()


@pytest.mark.long
def test_ctrl_c_while_drawing_keeps_the_log(stage: Stage) -> None:
    running = start_demo(stage, duration="0.5")
    running.prints("checking the log and drawing")
    children = running.children()
    running.signal(signal.SIGINT)
    assert running.code() == 130
    assert not children
    log = open_log(stage.folder / "out" / "run.mcap")
    assert log.complete
    assert verify_log(log).identical == 1000
    words = next(line for line in running.text().splitlines() if "drawn later: " in line)
    assert f"the log is kept: {log.source}" in words
    later = shlex.split(words.partition("drawn later: trilat ")[2])
    done = trilat(*later, cwd=stage.folder)
    assert (done.code, (stage.folder / "out" / "report.html").exists()) == (0, True), done
