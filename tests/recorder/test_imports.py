"""The recorder needs little of the program: it stores bytes."""

import subprocess
import sys

from tests import house

MOST_FILES = 45
PROGRAM = """
import sys
from recorder import backfill, record_process, session_recording, site_reception
print(*sys.modules)
"""


def test_recorder_loads_few_files_and_no_compiler() -> None:
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=house.ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    modules = result.stdout.split()
    own_modules = [name for name in modules if name.partition(".")[0] in house.TOPS]
    assert "recorder.record_process" in own_modules
    assert len(own_modules) <= MOST_FILES, own_modules
    assert not {"numba", "scipy", "matplotlib"} & set(modules)
