"""Deadline budget and watchdog of a user's own code: a law, a hand, a plant.

The code may use `SHARE` of the period at which it is called. Time beyond that adds to its
overtime, which faster calls pay back; code whose overtime exceeds `OVERTIME_LIMIT_NS` is too
slow. One call counts for at most `HICCUP_NS`, so that no single call fails. If the machine has
preempted the thread, the thread's computing time counts instead of the elapsed time.

Invariant:
    - The watchdog judges the code's own computing time, never the lateness of the machine.
    - It enters no number of the run.
    - A single slow call is only counted. Code that is too slow, or does not return, fails and
      is reported.
"""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, TypeVar

from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import count_nouns
from trilat_net.net.clock import Clock

try:
    import resource

    _THREAD: int | None = getattr(resource, "RUSAGE_THREAD", None)
except ImportError:  # not on this platform: elapsed time counts
    _THREAD = None

T = TypeVar("T")
SHARE = 0.75
OVERTIME_LIMIT_NS = 500_000_000
HICCUP_NS = 50_000_000
CHECK_S = 1.0
CHECKS = 3
FIRST_CHECKS = 61
"""Code hangs if it is in the same call at `CHECKS` checks in a row, one every `CHECK_S`.

In its first tick, in which it may compile, the limit is `FIRST_CHECKS`.
"""


def read_thread_usage() -> tuple[int, int]:
    """Returns this thread's computing time, ns, and its involuntary context switches.

    Returns (0, -1) if they are unknown.
    """
    if _THREAD is None:
        return 0, -1
    usage = resource.getrusage(_THREAD)
    return round((usage.ru_utime + usage.ru_stime) * NS_PER_S), usage.ru_nivcsw


class WatchedCode:
    """A user's own code, called `rate_hz` times a second.

    Args:
        name: the name of the code, as in "the law mylaw:MyLaw".
        rate_hz: how often the code is called, 1/s.
        fail: returns the error to raise, from a tick and a problem.
        clock: the clock of this process.
        usage: returns the thread's computing time and context switches.

    Attributes:
        hiccups: the number of calls that took longer than a period.
        longest_ns: the duration of the longest call.
        longest_tick: the tick of that call.
    """

    def __init__(
        self,
        name: str,
        rate_hz: int,
        fail: Callable[[int, str], Exception],
        clock: Clock,
        usage: Callable[[], tuple[int, int]] = read_thread_usage,
    ) -> None:
        self.hiccups = 0
        self.longest_ns = 0
        self.longest_tick = -1
        self._name = name
        self._fail = fail
        self._clock = clock
        self._usage = usage
        self._period_ns = NS_PER_S // rate_hz
        self._owed_ns = 0
        self._total_ns = 0
        self._calls = 0
        self._same_call_checks = 0
        self._running_tick = -1  # the tick of the running call
        self._first_tick = -1
        self._checked_count = -1  # the number of finished calls at the last check

    def run(self, k: int, call: Callable[[], T]) -> T:
        """Returns the result of a call at tick `k`.

        Raises:
            Exception: the error of `fail` if the code is too slow; otherwise what the call
                raises.
        """
        computed_ns, switches = self._usage()
        begun_ns = self._clock.monotonic_ns()
        self._running_tick = k
        self._first_tick = k if self._first_tick < 0 else self._first_tick
        try:
            result = call()
        finally:
            self._running_tick = -1
        elapsed_ns = self._clock.monotonic_ns() - begun_ns
        if elapsed_ns > SHARE * self._period_ns:
            # The thread was preempted if it was switched involuntarily.
            computed_after_ns, switches_after = self._usage()
            if switches_after != switches:
                elapsed_ns = min(elapsed_ns, computed_after_ns - computed_ns)
        self._count_call(k, elapsed_ns)
        return result

    def _count_call(self, k: int, elapsed_ns: int) -> None:
        """Counts a call and its overtime; raises an error if the code is too slow."""
        self.hiccups += elapsed_ns > self._period_ns
        self._total_ns += elapsed_ns
        self._calls += 1
        if elapsed_ns > self.longest_ns:
            self.longest_ns = elapsed_ns
            self.longest_tick = k
        self._owed_ns += min(elapsed_ns, HICCUP_NS) - int(SHARE * self._period_ns)
        self._owed_ns = max(self._owed_ns, 0)
        if self._owed_ns > OVERTIME_LIMIT_NS:
            mean_ms = self._total_ns / self._calls * 1e-6
            period_ms = self._period_ns * 1e-6
            problem = (
                f"it is too slow: {mean_ms:.3g} ms a call, of {period_ms:.3g} ms between two "
                f"of them it may take {SHARE:.0%}; make it faster, or lower rate_hz"
            )
            raise self._fail(k, problem)

    def describe_hiccups(self) -> str:
        """Returns a sentence about the calls that took longer than a period, else ""."""
        if not self.hiccups:
            return ""
        return (
            f"{self._name} took longer than from one tick to the next at "
            f"{count_nouns(self.hiccups, 'tick')}, at most "
            f"{self.longest_ns * 1e-6:.3g} ms, at tick {self.longest_tick}"
        )

    def check(self) -> None:
        """Interrupts user code that is still in the call seen at the previous checks.

        Checks missed while the process was suspended do not count.

        Raises:
            Exception: the error of `fail`, out of the user's code.
        """
        tick = self._running_tick
        is_same_call = tick >= 0 and self._calls == self._checked_count
        self._same_call_checks = self._same_call_checks + 1 if is_same_call else 0
        self._checked_count = self._calls if tick >= 0 else -1
        limit = (FIRST_CHECKS if tick == self._first_tick else CHECKS) - 1
        if self._same_call_checks >= limit:
            raise self._fail(tick, f"it did not come back within {limit * CHECK_S:g} s")


class CodeWatchdog:
    """A context manager within which user code that hangs is interrupted.

    It uses SIGALRM, so it works in the main thread only.
    """

    def __init__(self, *codes: WatchedCode) -> None:
        self.codes = list(codes)
        self._handler_before: Any = None

    def __enter__(self) -> "CodeWatchdog":
        is_main_thread = threading.current_thread() is threading.main_thread()
        if self.codes and is_main_thread and hasattr(signal, "setitimer"):
            self._handler_before = signal.signal(signal.SIGALRM, self._check)
            signal.setitimer(signal.ITIMER_REAL, CHECK_S, CHECK_S)
        return self

    def __exit__(self, *_: object) -> None:
        if self._handler_before is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._handler_before)
            self._handler_before = None

    def _check(self, _number: int, _frame: FrameType | None) -> None:
        for code in self.codes:
            code.check()
