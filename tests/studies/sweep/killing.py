"""A sweep in a process of its own that is killed when its journal has so many lines."""

import os
import signal
import subprocess
from pathlib import Path

from tests.cli.running import COMMAND, PLAIN
from tests.net.waiting import until
from trilat_net.studies.sweep.sweep_folder import JOURNAL_FILE


def begun(folder: Path, *arguments: str | Path) -> "subprocess.Popen[str]":
    """Starts `trilat sweep` with its processes as a group of their own."""
    return subprocess.Popen(
        [*COMMAND, "sweep", *map(str, arguments)],
        cwd=folder,
        env=PLAIN,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def lines(results: Path) -> int:
    """How many runs the journal has."""
    journal = results / JOURNAL_FILE
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def ended_at(process: "subprocess.Popen[str]", results: Path, count: int, number: int) -> str:
    """Sends a signal once the journal has so many runs, unless the sweep ends before; returns its errors.

    SIGKILL goes to all of its processes, as when a machine is switched off.
    """
    until(lambda: lines(results) >= count or process.poll() is not None, 120.0)
    if process.poll() is None:
        if number == signal.SIGKILL:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
    return process.communicate(timeout=120)[1]
