"""Deadline budget and watchdog of a user's control law.

Invariant: the watchdog judges the law's own computing time, never the machine's lateness, and enters no
number of the run. A single hiccup is only counted; a law that is too slow, or does not return, ends the run
in order.

A law may use `SHARE` of a tick period. Time beyond that adds to its overtime, which faster ticks pay back; a
law that owes `MOST_NS` is too slow. One tick counts for at most `HICCUP_NS`, so no single tick can end a
run. If the machine preempted the thread, the thread's computing time counts instead of the elapsed time.
"""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

from trilat_net.core.site_step import Site
from trilat_net.core.ticks import NS_PER_S, TickInput, TickRecord
from trilat_net.errors import LawFailed
from trilat_net.net.clock import Clock

try:
    import resource

    _THREAD: int | None = getattr(resource, "RUSAGE_THREAD", None)
except ImportError:  # not on this platform: elapsed time counts
    _THREAD = None

SHARE = 0.75
MOST_NS = 500_000_000
HICCUP_NS = 50_000_000
CHECK_S = 1.0
CHECKS = 3
"""A law in the same tick at so many checks in a row, one every `CHECK_S`, hangs."""


def read_thread_usage() -> tuple[int, int]:
    """Returns this thread's computing time, ns, and its involuntary switches; (0, -1) if unknown."""
    if _THREAD is None:
        return 0, -1
    usage = resource.getrusage(_THREAD)
    return round((usage.ru_utime + usage.ru_stime) * NS_PER_S), usage.ru_nivcsw


class LawWatchdog:
    """Steps a site under a user's law; a context within which a law that hangs is stopped.

    Attributes:
        hiccups: number of ticks at which the law took longer than a tick period.
    """

    def __init__(
        self, site: Site, law: str, clock: Clock, usage: Callable[[], tuple[int, int]] = read_thread_usage
    ) -> None:
        self.hiccups = self.longest_ns = 0
        self.longest_tick = -1
        self._site, self._law, self._clock, self._usage = site, law, clock, usage
        self._period_ns = NS_PER_S // site.rate_hz
        self._owed_ns = self._sum_ns = self._count = 0
        self._stepping = -1  # the tick that is being stepped
        self._checked, self._checks = -1, 0
        self._handler_before: Any = None

    def step(self, tick: TickInput) -> TickRecord:
        """Steps the site.

        Raises:
            LawFailed: the law failed, or is too slow.
        """
        computed_ns, switches = self._usage()
        began_ns = self._clock.monotonic_ns()
        self._stepping = tick.k
        try:
            output = self._site.step(tick)
        finally:
            self._stepping = -1
        took_ns = self._clock.monotonic_ns() - began_ns
        if took_ns > SHARE * self._period_ns:  # else the reason does not matter
            computed_after_ns, switches_after = self._usage()
            if switches_after != switches:
                took_ns = min(took_ns, computed_after_ns - computed_ns)
        self._account(tick.k, took_ns)
        return output

    def _account(self, k: int, took_ns: int) -> None:
        self.hiccups += took_ns > self._period_ns
        self._sum_ns += took_ns
        self._count += 1
        if took_ns > self.longest_ns:
            self.longest_ns, self.longest_tick = took_ns, k
        self._owed_ns += min(took_ns, HICCUP_NS) - int(SHARE * self._period_ns)
        self._owed_ns = max(self._owed_ns, 0)
        if self._owed_ns > MOST_NS:
            mean_ms, period_ms = self._sum_ns / self._count * 1e-6, self._period_ns * 1e-6
            raise self._failed(
                k,
                f"it is too slow: {mean_ms:.3g} ms a tick, of {period_ms:.3g} ms between two of them it may "
                f"take {SHARE:.0%}; make it faster, or lower rate_hz",
            )

    def describe_hiccups(self) -> str:
        """Returns a sentence about the ticks at which the law was late for the next one; "" without any."""
        if not self.hiccups:
            return ""
        return (
            f"the law {self._law} took longer than from one tick to the next at {self.hiccups} ticks, "
            f"at most {self.longest_ns * 1e-6:.3g} ms, at tick {self.longest_tick}"
        )

    def __enter__(self) -> "LawWatchdog":
        if hasattr(signal, "setitimer") and threading.current_thread() is threading.main_thread():
            self._handler_before = signal.signal(signal.SIGALRM, self._check)
            signal.setitimer(signal.ITIMER_REAL, CHECK_S, CHECK_S)
        return self

    def __exit__(self, *_: object) -> None:
        if self._handler_before is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._handler_before)
            self._handler_before = None

    def _check(self, _number: int, _frame: FrameType | None) -> None:
        """Stops a law that is in the same tick as at the checks before; a process that slept had none."""
        stepping = self._stepping
        self._checks = self._checks + 1 if stepping >= 0 and stepping == self._checked else 0
        self._checked = stepping
        if self._checks >= CHECKS - 1:
            raise self._failed(stepping, f"it did not come back within {(CHECKS - 1) * CHECK_S:g} s")

    def _failed(self, k: int, problem: str) -> LawFailed:
        return LawFailed(problem, site=self._site.name, law=self._law, tick=k)
