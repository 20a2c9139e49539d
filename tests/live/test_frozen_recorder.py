"""Ctrl-C while the recorder is behind: every record that a site made is in the file or counted as missing."""

import os
import random
import re
import signal
from collections.abc import Mapping

import pytest

from tests.live.processes import wait_for_records
from trilat_net.log.log_reader import Log, open_log

from .processes import PAPER, Process, Session, Stage, pause

LONGEST_FREEZE_S = 5.0
LEASE_S = 5.0
"""Time after which a connection to a process that is silent breaks."""
MADE = re.compile(r"^(\w+): (\d+) ticks, \d+ of them late", re.MULTILINE)


def assert_accounted(log: Log, tick_counts: Mapping[str, int]) -> None:
    """Every record is in the file or counted as missing; of an unknown end the log says that."""
    for site in log.sites:
        ticks = log[site].tick.tolist()
        assert len(ticks) == len(set(ticks))
        if site in log.unknown_ends:
            assert "is unknown" in log.headline()
            continue
        assert len(ticks) + log.missing(site) == tick_counts[site], site
        received = f"received {len(ticks)}, missing {log.missing(site)},"
        assert received in log.account(site), log.account(site)


def ticks_made(*texts: str) -> dict[str, int]:
    """Returns the number of ticks that each site states at its end."""
    return {site: int(ticks) for text in texts for site, ticks in MADE.findall(text)}


class Freeze:
    """A freeze of the recorder that begins before a Ctrl-C, and ends with it or after it."""

    def __init__(self, draw: random.Random) -> None:
        whole_s = draw.uniform(0.0, LONGEST_FREEZE_S)
        self.run_s = draw.uniform(0.0, 3.0)
        self.before_s = draw.uniform(0.0, whole_s)
        self.after_s = whole_s - self.before_s


def interrupt_members(stage: Stage, freeze: Freeze) -> tuple[Log, dict[str, int]]:
    """Members in one terminal each, all of which get the signal."""
    session = Session(stage, "paper", PAPER, "--duration", "60")
    session.all()
    session.recording()
    pause(freeze.run_s)
    recorder = session.processes["recorder"]
    recorder.signal(signal.SIGSTOP)
    pause(freeze.before_s)
    for process in session.processes.values():
        process.signal(signal.SIGINT)
    pause(freeze.after_s)
    recorder.signal(signal.SIGCONT)
    assert session.codes() == dict.fromkeys(session.processes, 130)
    return open_log(session.log), ticks_made(
        *(session.processes[site].text() for site in PAPER)
    )


def interrupt_demo(stage: Stage, freeze: Freeze) -> tuple[Log, dict[str, int]]:
    """Interrupts the command that started all members, and returns the log and the number of ticks by site."""
    folder = stage.folder / "run"
    demo = stage.start("demo", "demo", "paper", "--duration", "60", "-o", str(folder))
    wait_for_records(folder / "run.mcap")
    pause(freeze.run_s)
    recorder = find_recorder(demo)
    os.kill(recorder, signal.SIGSTOP)
    pause(freeze.before_s)
    demo.signal(signal.SIGINT)
    pause(freeze.after_s)
    os.kill(recorder, signal.SIGCONT)
    assert demo.code() == 130
    printed = [(folder / "processes" / f"{site}.txt").read_text() for site in PAPER]
    return open_log(folder / "run.mcap"), ticks_made(*printed)


def find_recorder(demo: Process) -> int:
    (pid,) = (pid for pid, command in demo.children().items() if " record " in command)
    return pid


@pytest.mark.long
@pytest.mark.parametrize("moment", range(40))
def test_ctrl_c_with_frozen_recorder_loses_nothing(moment: int, stage: Stage) -> None:
    freeze = Freeze(random.Random(5300 + moment))
    interrupt = interrupt_demo if moment % 2 else interrupt_members
    log, tick_counts = interrupt(stage, freeze)
    assert set(tick_counts) == set(PAPER)
    assert_accounted(log, tick_counts)
    print(
        moment,
        {site: (tick_counts[site], log.missing(site)) for site in PAPER},
        log.unknown_ends,
    )


@pytest.mark.long
def test_a_second_ctrl_c_ends_logs_openly(stage: Stage) -> None:
    session = Session(stage, "paper", PAPER, "--duration", "60")
    session.all()
    session.recording()
    recorder = session.processes["recorder"]
    recorder.signal(signal.SIGSTOP)
    pause(LEASE_S + 1.0)  # until then the recorder has what the sites sent, without asking
    for site in PAPER:
        session.processes[site].signal(signal.SIGINT)
    for site in PAPER:
        session.processes[site].prints("Ctrl-C a second time ends it at once")
        session.processes[site].signal(signal.SIGINT)
    assert [session.processes[site].code() for site in PAPER] == [130, 130, 130]
    recorder.signal(signal.SIGCONT)
    recorder.signal(signal.SIGINT)
    recorder.prints("Ctrl-C a second time ends it at once")
    recorder.signal(signal.SIGINT)
    assert recorder.code() == 130
    log = open_log(session.log)
    assert log.unknown_ends == PAPER
    assert "the end of m1, m2 and s is unknown" in log.headline()
