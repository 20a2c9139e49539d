"""`trilat stop` of a session on this machine: its processor time, and how long it takes from start to end."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from unittest import mock

import numpy as np

from tests.cli.running import PLAIN
from tests.live.processes import PAPER, Session, Stage

STOPS, CPU_S = 20, 0.25


def run() -> list[str]:
    """Returns the figures of stops of one session of `play`, three sites at 1 kHz and a recorder."""
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(PLAIN, XDG_STATE_HOME=folder):
        stage = Stage(Path(folder))
        try:
            session = Session(stage, "play", PAPER, "--duration", "600")
            session.all()
            session.begun()
            cpu_s, took_s = np.array([_stop_once() for _ in range(STOPS)]).T
        finally:
            stage.clear()
    return [
        f"trilat stop of three arms, {STOPS} times: processor time p50 {np.median(cpu_s):.3f} s, "
        f"most {cpu_s.max():.3f} s (at most {CPU_S:g})",
        f"  from its start to its end: p50 {np.median(took_s):.3f} s, most {took_s.max():.3f} s",
    ]


def _stop_once() -> tuple[float, float]:
    """Processor time of a stop, with all its threads, and its duration, s."""
    began_s = time.monotonic()
    command = [sys.executable, "-m", "trilat_net", "stop", "--session", "t"]
    stop = subprocess.Popen(command, env=PLAIN, stdout=subprocess.PIPE)
    assert stop.stdout is not None
    answers = stop.stdout.read().decode()
    _, status, used = os.wait4(stop.pid, 0)
    stop.returncode = os.waitstatus_to_exitcode(status)
    assert (stop.returncode, answers.count(": stop at tick")) == (0, len(PAPER)), answers
    return used.ru_utime + used.ru_stime, time.monotonic() - began_s
