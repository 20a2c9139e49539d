"""Progress of a test run in lines, with an estimate of what is left: `pytest -p tests.progress`.

Several runs of `make test` share a terminal, so that each says in whole lines how far it is. The name of a
run is `TRILAT_TEST_RUN`. How long a run took is kept in `.pytest_cache`, for the estimate of the next one.

Invariant: passed tests print nothing; failures and the summary are those of pytest.
"""

import os
import time
from typing import Any

import pytest

EVERY_S = 10.0
_KEY = "trilat/duration_of_"


def format_duration(seconds: float) -> str:
    """Returns a duration for people, as in "40 s" and "3 min 20 s"."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


class Progress:
    """Counts the tests that are done, and prints lines.

    Args:
        config: of the run.
        name: what the lines call the run.
    """

    def __init__(self, config: pytest.Config, name: str) -> None:
        self._config = config
        self._name = name
        self._total = 0
        self._done = 0
        self._failed = 0
        self._began_s = self._printed_s = time.monotonic()
        self._expected_s: float | None = (
            config.cache.get(_KEY + name, None) if config.cache else None
        )

    def begin(self, total: int) -> None:
        """Prints the number of tests, and the duration of the previous run."""
        if self._total:
            return  # of another worker: all have the same tests
        self._total = total
        self._began_s = time.monotonic()
        known = (
            "" if self._expected_s is None else f", about {format_duration(self._expected_s)}"
        )
        self._print(f"{total} tests{known}")

    def count(self, report: pytest.TestReport) -> None:
        """Counts a test at its end, and prints a line if the last one was some time ago."""
        self._failed += report.failed
        if report.when != "teardown":
            return
        self._done += 1
        now_s = time.monotonic()
        if now_s - self._printed_s < EVERY_S or self._done >= self._total:
            return
        self._printed_s = now_s
        spent_s = now_s - self._began_s
        left_s = spent_s / self._done * (self._total - self._done)
        failed = f", {self._failed} failed" if self._failed else ""
        share = (
            f"{100 * self._done // self._total} %, {self._done} of {self._total} tests{failed}"
        )
        self._print(
            f"{share}, {format_duration(spent_s)}, about {format_duration(left_s)} left"
        )

    def end(self) -> None:
        """Prints the duration of the run, and stores it."""
        spent_s = time.monotonic() - self._began_s
        self._print(f"{self._done} tests in {format_duration(spent_s)}")
        if self._config.cache and self._done == self._total:
            self._config.cache.set(_KEY + self._name, spent_s)

    def _print(self, text: str) -> None:
        reporter: Any = self._config.pluginmanager.get_plugin("terminalreporter")
        reporter.ensure_newline()
        reporter.write_line(f"{self._name}: {text}")


_PROGRESS = pytest.StashKey[Progress]()


def pytest_configure(config: pytest.Config) -> None:
    """Makes the counter of a run; the workers of a run in processes have none."""
    if not hasattr(config, "workerinput"):
        config.stash[_PROGRESS] = Progress(config, os.environ.get("TRILAT_TEST_RUN", "tests"))
        config.pluginmanager.register(_Hooks(config.stash[_PROGRESS]))
        if config.pluginmanager.hasplugin("dsession") or config.pluginmanager.hasplugin(
            "xdist"
        ):
            config.pluginmanager.register(_HooksOfWorkers(config.stash[_PROGRESS]))


class _Hooks:
    """The hooks of pytest that feed the counter."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    def pytest_collection_finish(self, session: pytest.Session) -> None:
        """Begins a run in this process."""
        if session.items:
            self._progress.begin(len(session.items))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Counts a part of a test."""
        self._progress.count(report)

    def pytest_sessionfinish(self) -> None:
        """Ends the run."""
        self._progress.end()

    @pytest.hookimpl(tryfirst=True)
    def pytest_report_teststatus(self, report: Any) -> tuple[str, str, str] | None:
        """Prints no letter for a test that passed."""
        if (
            report.passed
            and getattr(report, "when", "") == "call"
            and not hasattr(report, "wasxfail")
        ):
            return "passed", "", ""
        return None


class _HooksOfWorkers:
    """The hooks of pytest that feed the counter in a run of several processes."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids: list[str]) -> None:
        """Begins a run in several processes."""
        self._progress.begin(len(ids))
