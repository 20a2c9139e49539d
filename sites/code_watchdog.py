"""Limits the computing time of a user's code: a control law, an operator or an arm model.

The control loop of an arm calls such code, and slow code would delay its ticks. Each call may
take 75 % (`SHARE`) of the time between two calls. If a call takes longer, the excess is added
to the overtime; if it takes less, the unused time is subtracted. If the overtime exceeds
`OVERTIME_LIMIT_NS`, the code is too slow, and the run ends with an error. A single call counts
for at most `HICCUP_NS`, so one slow call, for example during garbage collection, does not end
the run.

If the operating system has interrupted the thread during a call, the computing time of the
thread is used instead of the elapsed time. Load caused by other programs is therefore not
counted against the code.

Code that does not return at all is interrupted by a signal, see `CodeWatchdog`.
"""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, TypeVar

from trilat_net.errors import count_nouns
from trilat_net.net import Clock
from trilat_net.records import NS_PER_S

try:
    import resource

    _THREAD: int | None = getattr(resource, "RUSAGE_THREAD", None)
except ImportError:  # this platform lacks the module: elapsed time counts
    _THREAD = None

T = TypeVar("T")
SHARE = 0.75
"""Fraction of the time between two calls that the code may use."""
OVERTIME_LIMIT_NS = 500_000_000
"""Overtime above which the code is too slow, in ns."""
HICCUP_NS = 50_000_000
"""Maximum time that one call adds to the overtime, in ns."""
_CHECK_S = 1.0
"""Interval between checks of whether the code still hangs in the same call, in s."""
CHECKS = 3
"""Number of consecutive checks that must see the same call before it is interrupted."""
FIRST_CHECKS = 61
"""Number of consecutive checks for the first tick, when code may still be compiled."""


def _read_thread_usage() -> tuple[int, int]:
    """Returns the computing time of this thread, and how often the system interrupted it.

    Two readings show whether a slow call has really been computing for long, or whether the
    operating system was running other programs in the meantime.

    Returns:
        The computing time in ns, and the number of involuntary context switches. The values are
        0 and -1 if the platform does not report them.
    """
    if _THREAD is None:
        return 0, -1
    usage = resource.getrusage(_THREAD)
    return round((usage.ru_utime + usage.ru_stime) * NS_PER_S), usage.ru_nivcsw


class WatchedCode:
    """Calls a user's own code, such as a control law, and limits its computing time.

    The control loop of the arm calls the code in every tick, for example every millisecond. If
    the code is too slow, the run ends with an error, because slow code would make the arm
    unsafe.

    Args:
        name: Name of the code, such as "the law mylaw:MyLaw".
        rate_hz: How often the code is called, in 1/s.
        fail: Function that receives a tick and the description of a problem, and returns the
            error to raise.
        clock: Clock of this process.
        usage: Function that returns the computing time and the context switches of the thread.

    Attributes:
        hiccups: Number of calls that took longer than the period between two calls.
        longest_ns: Duration of the longest call, in ns.
        longest_tick: Tick of the longest call. -1 before the first call.
    """

    def __init__(
        self,
        name: str,
        rate_hz: int,
        fail: Callable[[int, str], Exception],
        clock: Clock,
        usage: Callable[[], tuple[int, int]] = _read_thread_usage,
    ) -> None:
        self.hiccups = 0
        self.longest_ns = 0
        self.longest_tick = -1

        self._name = name
        self._fail = fail
        self._clock = clock
        self._usage = usage
        self._period_ns = NS_PER_S // rate_hz

        self._overtime_ns = 0
        self._total_ns = 0  # duration of all calls
        self._calls = 0

        # State of the checks for a call that does not return.
        self._same_call_checks = 0  # checks in a row that have seen the same call
        self._running_tick = -1  # the tick of the running call
        self._first_tick = -1
        self._checked_count = -1  # the number of finished calls at the last check

    def run(self, tick: int, call: Callable[[], T]) -> T:
        """Calls the user's code once, measures its computing time and returns its result.

        Time that the operating system gave to other programs is not counted.

        Args:
            tick: Number of the tick in which the code is called.
            call: Function that calls the code.

        Raises:
            Exception: If the code is too slow, the error returned by `fail`. Otherwise, any
                error that the code raises.
        """
        computed_ns, switches = self._usage()
        begun_ns = self._clock.monotonic_ns()
        self._running_tick = tick
        if self._first_tick < 0:
            self._first_tick = tick
        try:
            result = call()
        finally:
            self._running_tick = -1

        elapsed_ns = self._clock.monotonic_ns() - begun_ns
        if elapsed_ns > SHARE * self._period_ns:
            # If the number of involuntary switches has changed, the thread was interrupted.
            computed_after_ns, switches_after = self._usage()
            if switches_after != switches:
                elapsed_ns = min(elapsed_ns, computed_after_ns - computed_ns)
        self._count_call(tick, elapsed_ns)
        return result

    def _count_call(self, tick: int, elapsed_ns: int) -> None:
        """Adds the duration of a call to the statistics, and fails if the code is too slow.

        Each call may take a share of the time between two calls. Any excess is added up as
        overtime, which shorter calls reduce again, so occasional slow calls are tolerated.

        Args:
            tick: Tick of the call.
            elapsed_ns: Duration of the call, in ns.

        Raises:
            Exception: The code is too slow.
        """
        self.hiccups += elapsed_ns > self._period_ns
        self._total_ns += elapsed_ns
        self._calls += 1
        if elapsed_ns > self.longest_ns:
            self.longest_ns = elapsed_ns
            self.longest_tick = tick

        permitted_ns = int(SHARE * self._period_ns)
        self._overtime_ns += min(elapsed_ns, HICCUP_NS) - permitted_ns
        self._overtime_ns = max(self._overtime_ns, 0)
        if self._overtime_ns > OVERTIME_LIMIT_NS:
            mean_ms = self._total_ns / self._calls * 1e-6
            period_ms = self._period_ns * 1e-6
            problem = (
                f"the code is too slow: a call takes {mean_ms:.3g} ms on average, but may take "
                f"only {SHARE:.0%} of the {period_ms:.3g} ms between two calls; make the code "
                "faster, or lower rate_hz"
            )
            raise self._fail(tick, problem)

    def describe_hiccups(self) -> str:
        """Returns a sentence about slow calls of the user's code, for the end of the run.

        A call is slow if it takes longer than one tick, for example 1 ms at 1 kHz. The arm then
        receives its torque too late.

        Returns:
            A sentence with the number of slow calls and the duration of the slowest. Empty if
            no call was slow.
        """
        if not self.hiccups:
            return ""
        return (
            f"{self._name} took longer than the time between two calls in "
            f"{count_nouns(self.hiccups, 'call')}; the longest call took "
            f"{self.longest_ns * 1e-6:.3g} ms, at tick {self.longest_tick}"
        )

    def check(self) -> None:
        """Interrupts user code that does not return, such as a law with an endless loop.

        A timer signal calls this method every second (`_CHECK_S`) while the code runs. If
        several consecutive checks see the same call, an error is raised inside the call,
        because otherwise the arm would never receive another torque. A call is identified by
        the number of calls completed before it. Checks that were missed while the process was
        suspended do not count.

        Raises:
            Exception: The error returned by the constructor's argument `fail`.
        """
        tick = self._running_tick
        is_running = tick >= 0
        is_same_call = is_running and self._calls == self._checked_count
        if is_same_call:
            self._same_call_checks += 1
        else:
            self._same_call_checks = 0
        self._checked_count = self._calls if is_running else -1

        # The first check that sees a call does not count: the call may have just begun.
        checks = FIRST_CHECKS if tick == self._first_tick else CHECKS
        limit = checks - 1
        if self._same_call_checks >= limit:
            raise self._fail(tick, f"the code did not return within {limit * _CHECK_S:g} s")


class CodeWatchdog:
    """Context manager that interrupts a user's code if it hangs, as in an endless loop.

    The code is monitored inside the `with` block. The timer uses the signal SIGALRM, which
    Python handles only in the main thread. In other threads, and on Windows, nothing is
    interrupted.

    Args:
        *codes: The user's code to monitor.

    Attributes:
        codes: The code to monitor. More can be added before the `with` block.
    """

    def __init__(self, *codes: WatchedCode) -> None:
        self.codes = list(codes)
        self._handler_before: Any = None

    def __enter__(self) -> "CodeWatchdog":
        is_main_thread = threading.current_thread() is threading.main_thread()
        if self.codes and is_main_thread and hasattr(signal, "setitimer"):
            self._handler_before = signal.signal(signal.SIGALRM, self._check)
            signal.setitimer(signal.ITIMER_REAL, _CHECK_S, _CHECK_S)
        return self

    def __exit__(self, *_: object) -> None:
        if self._handler_before is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._handler_before)
            self._handler_before = None

    def _check(self, _number: int, _frame: FrameType | None) -> None:
        """Handles the timer signal SIGALRM by raising an error in user code that hangs.

        The signal arrives every `_CHECK_S`, even while the code is in an endless loop.
        """
        for code in self.codes:
            code.check()
