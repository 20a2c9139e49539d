"""Runs many trials in virtual time, on all cores.

Invariant: results come in the order of the trials, whatever the number of processes; on return, by whatever
way, all worker processes are gone.
"""

import contextlib
import os
import queue
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import msgspec

from ...core.jit import is_core_cached
from ...execution import virtual
from ...net.clock import SystemClock
from ...process import count_cores
from ...scenario import Scenario
from .trial import Trial, TrialResult, trials
from .trial_report import TrialReport
from .trial_worker import TrialReply

POLL_S = 0.5
"""How often who waits looks up: Ctrl-C is heard then at the latest, whichever thread it reached."""
_IMPORT_ROOT = str(Path(__file__).resolve().parents[3])


def run_trials(
    batch: Sequence[Trial],
    jobs: int | None = None,
    done: Callable[[TrialResult], None] = lambda _: None,
) -> TrialReport:
    """Runs trials in virtual time and returns their results.

    Args:
        batch: what to run.
        jobs: in how many processes; None for one per core. One trial, or one job, runs in this process.
        done: is told of every result as it comes.
    """
    clock = SystemClock()
    start_ns = clock.monotonic_ns()
    count = min(jobs or count_cores(), len(batch))
    if count <= 1:
        results = []
        for trial in batch:
            results.append(trial.run())
            done(results[-1])
    else:
        if not is_core_cached():
            next(virtual.execute_virtual(batch[0].scenario))  # compiles, once for all processes
        with _TrialPool(batch, count) as crew:
            results = crew.results(done)
    return TrialReport(results, (clock.monotonic_ns() - start_ns) * 1e-9)


def check(
    source: str | Path | Scenario,
    seeds: Iterable[int] = (),
    set: Mapping[str, Any] | Sequence[str] = (),  # noqa: A002 - the command's --set, by its name
    *,
    jobs: int | None = None,
) -> TrialReport:
    """Runs a scenario in virtual time, once per seed, and returns the results if all of [expect] held.

    Args:
        source: the name of a shipped scenario, a path, or a scenario.
        seeds: which seeds; none means the scenario's own.
        set: overrides, as in `{"link.delay_ms": 400}`.
        jobs: in how many processes; None for one per core.

    Raises:
        ScenarioError: the scenario or an override is not valid, or there is no [expect] in it.
        AssertionError: something did not hold; it says what, by how much, and how to repeat it.
    """
    report = run_trials(trials(source, seeds, set), jobs)
    if not report.held:
        raise AssertionError(f"not as expected\n{report.text()}")
    return report


class _TrialPool:
    """Some processes and, for each, a thread of this one that gives it work and waits for it.

    Args:
        trials: what there is to do.
        count: how many processes.
    """

    def __init__(self, trials: Sequence[Trial], count: int) -> None:
        self._trials = trials
        self._waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
        by_length = sorted(range(len(trials)), key=lambda n: -trials[n].scenario.duration_s)
        for n in by_length:  # the longest first, so that none is left for the end
            self._waiting.put(n)
        self._done: queue.SimpleQueue[tuple[int, TrialResult | Exception]] = queue.SimpleQueue()
        self._hands = [_Worker() for _ in range(count)]
        self._threads = [
            threading.Thread(target=self._work, args=(hand,), daemon=True) for hand in self._hands
        ]

    def __enter__(self) -> "_TrialPool":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for hand in self._hands:
            hand.dismiss()
        for thread in self._threads:
            if thread.ident is not None:
                thread.join()

    def _work(self, hand: "_Worker") -> None:
        while True:
            try:
                n = self._waiting.get_nowait()
            except queue.Empty:
                return
            try:
                self._done.put((n, hand.run(self._trials[n])))
            except Exception as error:  # raised again where the results are waited for
                self._done.put((n, error))
                return

    def results(self, done: Callable[[TrialResult], None]) -> list[TrialResult]:
        """Returns every result, in the order of the trials."""
        for (
            thread
        ) in self._threads:  # not before the context is entered: who is interrupted here is dismissed
            thread.start()
        found: dict[int, TrialResult] = {}
        while len(found) < len(self._trials):
            try:
                n, result = self._done.get(timeout=POLL_S)
            except queue.Empty:
                continue
            if isinstance(result, Exception):
                raise result
            found[n] = result
            done(result)
        return [found[n] for n in range(len(self._trials))]


class _Worker:
    """One worker process, started when it is first needed and again where it was lost."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._printed: IO[bytes] | None = None
        self._lock = threading.Lock()
        self._dismissed = False

    def run(self, trial: Trial) -> TrialResult:
        """Runs a trial in the worker."""
        process = self._started()
        if process is None or process.stdin is None or process.stdout is None:
            return TrialResult(trial, [], 0.0, 0.0, "was not run")
        try:
            process.stdin.write(msgspec.json.encode(trial.scenario.text) + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except (OSError, ValueError):  # it is gone; ValueError: dismissed in this very moment
            line = b""
        if not line.endswith(b"\n"):
            return TrialResult(trial, [], 0.0, 0.0, self._lost())
        answer = msgspec.json.decode(line, type=TrialReply)
        if answer.figures is None:
            return TrialResult(trial, [], 0.0, answer.wall_s, answer.error)
        return trial.judged(answer.figures, answer.wall_s)

    def _started(self) -> subprocess.Popen[bytes] | None:
        with self._lock:
            if self._process is None and not self._dismissed:
                self._printed = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the process
                path = os.pathsep.join(filter(None, (_IMPORT_ROOT, os.environ.get("PYTHONPATH"))))
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "trilat_net.studies.trials.trial_worker"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=self._printed,
                    env={**os.environ, "PYTHONPATH": path},
                    start_new_session=True,  # Ctrl-C is this process's business
                )
            return self._process

    def _lost(self) -> str:
        """Returns how the worker ended, and forgets it."""
        with self._lock:
            process, printed = self._process, self._printed
            self._process = self._printed = None
            if process is None or printed is None:
                return "was ended"
            code = _wait_for_exit(process)
            printed.seek(0)
            lines = printed.read().decode(errors="replace").strip().splitlines()
            printed.close()
            return f"its process ended with code {code}" + (f": {lines[-1]}" if lines else "")

    def dismiss(self) -> None:
        """Ends the worker at once; it has nothing that needs to be kept."""
        with self._lock:
            self._dismissed = True
            process, printed = self._process, self._printed
            self._process = self._printed = None
            if process is not None:
                process.kill()
                _wait_for_exit(process)
            if printed is not None:
                printed.close()


def _wait_for_exit(process: subprocess.Popen[bytes]) -> int:
    """Waits for a process, closes its pipes, and returns its exit code."""
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(OSError):  # what it was sent and did not read
                pipe.close()
    return process.wait()
