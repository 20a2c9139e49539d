"""A sweep that is killed and interrupted has the same results, and makes no run twice."""

import os
import re
import signal
import subprocess
from pathlib import Path

import msgspec
import pytest
from study_builders import SHORT
from trilat_studies.sweep.sweep_run import JOURNAL_FILE

from tests.cli.running import COMMAND, PLAIN, trilat
from tests.net.waiting import until

AXES = ("--over", "control.Kd=1:4:0.1", "--over", "link.loss=0,0.1")
OPTIONS = (*AXES, "--seeds", "2", "--longest", "8")
RUNS = 31 * 3
LONGER = SHORT.replace("rate_hz = 100", "rate_hz = 500").replace(
    "duration_s = 0.5", "duration_s = 8.0"
)


def lines(results: Path) -> int:
    """Returns the number of runs in the journal."""
    journal = results / JOURNAL_FILE
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def stopped(folder: Path, number: int, count: int, *arguments: str) -> tuple[int, str]:
    """Runs `trilat sweep` until its journal has `count` runs, and returns the exit code after
    the signal.

    SIGKILL goes to all of its processes, as when a machine is switched off.
    """
    process = subprocess.Popen(
        [*COMMAND, "sweep", *arguments, "--jobs", "2"],
        cwd=folder,
        env=PLAIN,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    until(lambda: lines(folder / "parts") >= count or process.poll() is not None, 120.0)
    send_signal = os.killpg if number == signal.SIGKILL else os.kill
    send_signal(process.pid, number)
    err = process.communicate(timeout=120)[1]
    return process.returncode, err


def keys(journal: Path) -> list[tuple[int, int]]:
    """Returns the keys of all whole lines, with repetitions."""
    whole = [
        line
        for line in journal.read_bytes().splitlines()
        if re.fullmatch(rb"{.*}\t[0-9a-f]{8}", line)
    ]
    entries = [msgspec.json.decode(line.partition(b"\t")[0]) for line in whole]
    return [(entry["cell"], entry["seed"]) for entry in entries]


@pytest.mark.long
def test_killed_and_interrupted_sweeps_resume_to_equal_bytes(tmp_path: Path) -> None:
    """SIGKILL to all processes, then Ctrl-C; the resumed sweep has two processes, the whole sweep one."""
    (tmp_path / "trio.toml").write_text(LONGER)
    sweep = ("trio.toml", *OPTIONS, "-o")
    trilat("sweep", *sweep, "whole", "--jobs", "1", cwd=tmp_path).succeeds()

    parts = tmp_path / "parts"
    code, err = stopped(tmp_path, signal.SIGKILL, 11, *sweep, "parts")
    assert (code, err) == (-signal.SIGKILL, "")

    done = lines(parts)
    code, err = stopped(tmp_path, signal.SIGINT, done + 10, "--resume", "parts")
    kept = len(keys(parts / JOURNAL_FILE))
    assert code == 130
    assert err.splitlines() == [
        f"{kept} runs are done and kept; continue with: trilat sweep --resume parts",
        "interrupted",
    ]
    assert done + 10 <= kept < RUNS
    assert not (parts / "results.csv").exists()

    text = trilat("sweep", *sweep, "parts", "--jobs", "2", cwd=tmp_path).succeeds()
    assert f"{kept} runs are done already" in text
    assert (parts / "results.csv").read_bytes() == (tmp_path / "whole/results.csv").read_bytes()
    run_keys = keys(parts / JOURNAL_FILE)
    assert len(run_keys) == len(set(run_keys)) == RUNS
