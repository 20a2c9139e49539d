"""Programs of other people that read MCAP files; run as processes, never imported."""

import subprocess
import sys
from itertools import takewhile
from pathlib import Path

RERUN = (sys.executable, "-m", "rerun")
PYMCAP = (str(Path(sys.executable).with_name("pymcap-cli")),)  # GPL


def run_program(*command: str) -> str:
    """What a program prints, if it ends well."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def rerun_faults(path: Path, *options: str) -> list[str]:
    """The channels with which `rerun mcap check` finds fault, and why."""
    table = (
        run_program(*RERUN, "mcap", "check", *options, str(path))
        .partition("Status")[2]
        .splitlines()[2:]
    )
    rows = list(takewhile(str.strip, table))  # its first run on a machine says more below
    assert rows
    return [row for row in rows if row.split()[0] != "ok"]
