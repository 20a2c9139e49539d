"""Programs that tests run as processes, and readers of MCAP files by other people among them."""

import os
import subprocess
import sys
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path

RERUN = (sys.executable, "-m", "rerun")
PYMCAP = (str(Path(sys.executable).with_name("pymcap-cli")),)
"""A program under the GPL, which must not be imported."""


def run_program(
    *command: object,
    cwd: Path | None = None,
    environment: Mapping[str, str] | None = None,
    timeout_s: float | None = 300.0,
) -> str:
    """Returns the output of a program, which must succeed in time."""
    done = subprocess.run(
        [str(word) for word in command],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=timeout_s,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def run_python(program: str, *, compiled: bool) -> str:
    """Returns the standard output of Python code in a process with or without the compiler."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "0" if compiled else "1"}
    command = [sys.executable, "-c", program]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout


def list_rerun_faults(path: Path, *options: str) -> list[str]:
    """Returns the lines in which `rerun mcap check` reports faulty channels."""
    printed = run_program(*RERUN, "mcap", "check", *options, path)
    table = printed.partition("Status")[2].splitlines()[2:]
    rows = list(takewhile(str.strip, table))  # its first run on a machine says more below
    assert rows
    return [row for row in rows if row.split()[0] != "ok"]
