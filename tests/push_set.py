"""Which tests a push waits for: those that take little processor time, and of every file the cheapest.

    python -m tests.push_set

It measures all tests that no mark leaves to `make test-long`, and writes `long_tests.txt`: those that a push
leaves to it as well, because they are dear. A test marked `push` is never left. What is new is tried on every
push until this is run again.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LONG_TESTS = Path(__file__).with_name("long_tests.txt")
DEAR_S = 0.1
"""Processor time, including child processes, from which a test is expensive."""
COSTLY = ("core", "execution", "log", "golden", "analysis", "certificate")
COSTLY_DEAR_S = 0.3
"""The same limit for tests of bits, logs and verdicts, where an error costs most."""
MOST_S = 2.5
"""The cheapest test of a file stays in the push set if it takes no more than this time."""
_TIMES = "TRILAT_TEST_TIMES"


def read_long_tests() -> frozenset[str]:
    return frozenset(LONG_TESTS.read_text(encoding="utf-8").splitlines())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Notes the processor time of a test, as a plugin of the run that measures."""
    before = sum(os.times()[:4])
    result = yield
    with Path(os.environ[_TIMES]).open("a", encoding="utf-8") as stream:
        stream.write(f"{sum(os.times()[:4]) - before:.2f}\t{item.nodeid}\n")
    return result


def choose_long_tests(times_s: dict[str, float]) -> list[str]:
    """Returns the tests that a push leaves to the long run, by their processor times."""
    files: defaultdict[str, list[str]] = defaultdict(list)
    for name in sorted(times_s, key=lambda name: times_s[name]):
        files[name.partition("::")[0]].append(name)
    return sorted(
        name
        for names in files.values()
        for place, name in enumerate(names)
        if times_s[name] > (_dear_s(name) if place else MOST_S)
    )


def _dear_s(name: str) -> float:
    return COSTLY_DEAR_S if name.split("/")[1] in COSTLY else DEAR_S


def main() -> int:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    ).parse_args()
    pytest_options = ["-q", "-n", "auto", "--dist", "worksteal", "-m", "not live and not long"]
    with tempfile.TemporaryDirectory() as folder:
        times = Path(folder, "times.tsv")
        command = [sys.executable, "-m", "pytest", "-p", "tests.push_set", *pytest_options]
        code = subprocess.run(
            command, cwd=ROOT, env={**os.environ, _TIMES: str(times)}, check=False
        ).returncode
        rows = [line.partition("\t") for line in times.read_text(encoding="utf-8").splitlines()]
    if code == 0:
        long_tests = choose_long_tests({name: float(seconds) for seconds, _tab, name in rows})
        LONG_TESTS.write_text("".join(f"{name}\n" for name in long_tests), encoding="utf-8")
        print(
            f"{len(long_tests)} of {len(rows)} tests are left to make test-long: {LONG_TESTS.relative_to(ROOT)}"
        )
    return code


if __name__ == "__main__":
    sys.exit(main())
