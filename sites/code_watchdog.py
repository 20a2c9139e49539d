"""Deadline budget and watchdog of code of a user's own: a law, a hand, a plant.

Invariant: the watchdog judges the code's own computing time, never the machine's lateness, and
enters no number of the run. A single hiccup is only counted; code that is too slow, or does not
return, fails in order.

It may use `SHARE` of the period at which it is called. Time beyond that adds to its overtime,
which faster calls pay back; code that owes `MOST_NS` is too slow. One call counts for at most
`HICCUP_NS`, so that no single call fails. If the machine preempted the thread, the thread's
computing time counts instead of the elapsed time.
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
MOST_NS = 500_000_000
HICCUP_NS = 50_000_000
CHECK_S = 1.0
CHECKS = 3
FIRST_CHECKS = 61
"""Code in the same call at so many checks in a row, one every `CHECK_S`, hangs; the second is
of its first tick, in which it may compile.
"""


def read_thread_usage() -> tuple[int, int]:
    """Returns this thread's computing time, ns, and its involuntary switches; (0, -1) if
    unknown.
    """
    if _THREAD is None:
        return 0, -1
    usage = resource.getrusage(_THREAD)
    return round((usage.ru_utime + usage.ru_stime) * NS_PER_S), usage.ru_nivcsw


class WatchedCode:
    """Code of a user's own, called `rate_hz` times a second.

    Args:
        name: of it, as in "the law mylaw:MyLaw".
        fail: makes the error that is raised, of a tick and a problem.

    Attributes:
        hiccups: number of calls that took longer than a period.
    """

    def __init__(
        self,
        name: str,
        rate_hz: int,
        fail: Callable[[int, str], Exception],
        clock: Clock,
        usage: Callable[[], tuple[int, int]] = read_thread_usage,
    ) -> None:
        self.hiccups = self.longest_ns = 0
        self.longest_tick = -1
        self._name = name
        self._fail = fail
        self._clock = clock
        self._usage = usage
        self._period_ns = NS_PER_S // rate_hz
        self._owed_ns = self._sum_ns = self._count = self._checks = 0
        self._running = self._first = -1  # the ticks of the call under way and of the first one
        self._checked = -1  # how many calls there were before the one checked last

    def run(self, k: int, call: Callable[[], T]) -> T:
        """Returns what a call gives at a tick.

        Raises:
            Exception: of `fail`, if it is too slow; and what the call raises.
        """
        computed_ns, switches = self._usage()
        began_ns = self._clock.monotonic_ns()
        self._running = k
        self._first = k if self._first < 0 else self._first
        try:
            result = call()
        finally:
            self._running = -1
        took_ns = self._clock.monotonic_ns() - began_ns
        if took_ns > SHARE * self._period_ns:  # else the reason does not matter
            computed_after_ns, switches_after = self._usage()
            if switches_after != switches:
                took_ns = min(took_ns, computed_after_ns - computed_ns)
        self._account(k, took_ns)
        return result

    def _account(self, k: int, took_ns: int) -> None:
        self.hiccups += took_ns > self._period_ns
        self._sum_ns += took_ns
        self._count += 1
        if took_ns > self.longest_ns:
            self.longest_ns = took_ns
            self.longest_tick = k
        self._owed_ns += min(took_ns, HICCUP_NS) - int(SHARE * self._period_ns)
        self._owed_ns = max(self._owed_ns, 0)
        if self._owed_ns > MOST_NS:
            mean_ms = self._sum_ns / self._count * 1e-6
            period_ms = self._period_ns * 1e-6
            problem = (
                f"it is too slow: {mean_ms:.3g} ms a call, of {period_ms:.3g} ms between two of them it may "
                f"take {SHARE:.0%}; make it faster, or lower rate_hz"
            )
            raise self._fail(k, problem)

    def describe_hiccups(self) -> str:
        """Returns a sentence about the calls that were late for the next one; "" without any."""
        if not self.hiccups:
            return ""
        return (
            f"{self._name} took longer than from one tick to the next at "
            f"{count_nouns(self.hiccups, 'tick')}, at most "
            f"{self.longest_ns * 1e-6:.3g} ms, at tick {self.longest_tick}"
        )

    def check(self) -> None:
        """Stops code that is in the same call as at the checks before; a process that slept had
        none.

        Raises:
            Exception: of `fail`, out of the code.
        """
        running = self._running
        self._checks = self._checks + 1 if running >= 0 and self._count == self._checked else 0
        self._checked = self._count if running >= 0 else -1
        most = (FIRST_CHECKS if running == self._first else CHECKS) - 1
        if self._checks >= most:
            raise self._fail(running, f"it did not come back within {most * CHECK_S:g} s")


class CodeWatchdog:
    """A context within which code that hangs is stopped."""

    def __init__(self, *codes: WatchedCode) -> None:
        self.codes = list(codes)
        self._handler_before: Any = None

    def __enter__(self) -> "CodeWatchdog":
        alone = threading.current_thread() is threading.main_thread()
        if self.codes and alone and hasattr(signal, "setitimer"):
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
