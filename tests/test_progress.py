"""A test run prints lines with its progress and its remaining time."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.progress import format_duration

ROOT = Path(__file__).parents[1]
TESTS = """
import pytest

@pytest.mark.parametrize("n", range(6))
def test_number(n):
    assert n != 4
"""


def run_tests(folder: Path, *options: str) -> str:
    """Runs six tests, of which one fails; returns the output."""
    (folder / "test_numbers.py").write_text(TESTS)
    (folder / "sitecustomize.py").write_text(
        "import tests.progress\ntests.progress.EVERY_S = 0.0\n"
    )
    paths = os.pathsep.join([str(folder), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": paths, "TRILAT_TEST_RUN": "numbers"}
    command = [sys.executable, "-m", "pytest", "-q", "-c", os.devnull, "--rootdir", str(folder)]
    command += ["-p", "tests.progress", *options, "test_numbers.py"]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done
    return done.stdout


@pytest.mark.parametrize("options", [[], pytest.param(["-n", "2"], marks=pytest.mark.long)])
def test_a_run_prints_lines_with_an_estimate(options: list[str], tmp_path: Path) -> None:
    output = run_tests(tmp_path, *options)
    assert "numbers: 6 tests\n" in output
    assert re.search(r"numbers: \d+ %, 2 of 6 tests, \d+ s, about \d+ s left", output)
    assert re.search(r"numbers: 6 tests in \d+ s", output)
    assert "1 failed, 5 passed" in output
    assert "....F" not in output  # no letters of what passed
    assert re.search(r"numbers: 6 tests, about \d+ s\n", run_tests(tmp_path, *options))


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (59.0, "59 s"), (200.0, "3 min 20 s")]
)
def test_durations_are_for_people(seconds: float, text: str) -> None:
    assert format_duration(seconds) == text
