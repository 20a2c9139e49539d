"""Programs that print their results, with the compiler and without it."""

import os
import subprocess
import sys


def run_python(program: str, *, compiled: bool) -> str:
    """Returns the output of a program in a process of its own."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "0" if compiled else "1"}
    command = [sys.executable, "-c", program]
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, check=True
    ).stdout
