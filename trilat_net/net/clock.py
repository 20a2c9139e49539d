"""Clocks: the only module that reads the time.

Invariant:
    - Rule L1: code that needs the time takes a clock as an argument.
    - Times are integer nanoseconds, never floating-point numbers.
"""

import platform
import time
from pathlib import Path
from typing import Protocol

# Also in `core.ticks`, which loads the compiler; a router does not need the compiler.
NS_PER_S = 1_000_000_000


class Clock(Protocol):
    """Interface of the clocks that drivers use."""

    def monotonic_ns(self) -> int:
        """Returns the reading of a clock that never steps, in ns; its zero is arbitrary."""

    def unix_ns(self) -> int:
        """Returns the time since 1970 in ns, by the machine's wall clock, which may step."""

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleeps until `deadline_ns` of the monotonic clock, if that has not passed."""

    def identity(self) -> str:
        """Returns the identity of the monotonic clock.

        Two processes may compare their readings only if their identities are equal.
        """


class SystemClock:
    """The machine's clocks."""

    monotonic_ns = staticmethod(time.perf_counter_ns)
    """The clock of `time.monotonic_ns`, except on Windows, where that clock steps by 16 ms."""
    unix_ns = staticmethod(time.time_ns)

    def sleep_until(self, deadline_ns: int) -> None:
        """See `Clock`."""
        remaining_ns = deadline_ns - self.monotonic_ns()
        if remaining_ns > 0:
            # CPython sleeps until an absolute deadline, so signals do not shorten the sleep.
            time.sleep(remaining_ns * 1e-9)

    def identity(self) -> str:
        """See `Clock`.

        On Linux, the identity is the boot of the kernel and the time namespace; elsewhere, it
        is the machine's name.
        """
        try:
            boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
            namespace = Path("/proc/self/ns/time").readlink().name
        except OSError:
            return f"{platform.node()}/{time.get_clock_info('perf_counter').implementation}"
        return f"{boot}/{namespace}"


class SkewedClock:
    """A clock with an offset and a drift against another clock, for tests.

    The clock stands for that of another machine. It reads

        start + offset + (reading - start) (1 + drift),

    where `start` is the reading of the other clock at the construction of this one. The wall
    clock is not changed. The identity is unique and states the offset, the drift and the start,
    so that readers of a log can convert the readings.

    Args:
        clock: the other clock.
        offset_ns: offset against the other clock.
        drift_ppb: drift against the other clock, ns/s.
    """

    def __init__(self, clock: Clock, offset_ns: int, drift_ppb: int) -> None:
        self._clock = clock
        self._offset_ns = offset_ns
        self._drift_ppb = drift_ppb
        self._start_ns = clock.monotonic_ns()

    def monotonic_ns(self) -> int:
        """See `Clock`."""
        passed_ns = self._clock.monotonic_ns() - self._start_ns
        return (
            self._start_ns
            + self._offset_ns
            + passed_ns
            + passed_ns * self._drift_ppb // NS_PER_S
        )

    def unix_ns(self) -> int:
        """See `Clock`."""
        return self._clock.unix_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """See `Clock`."""
        passed_ns = deadline_ns - self._start_ns - self._offset_ns
        self._clock.sleep_until(
            self._start_ns - -passed_ns * NS_PER_S // (NS_PER_S + self._drift_ppb)
        )

    def identity(self) -> str:
        """See `Clock`."""
        return (
            f"{self._clock.identity()}, skewed by {self._offset_ns} ns "
            f"and {self._drift_ppb} ns/s since {self._start_ns} ns"
        )


def make_system_clock(offset_s: float = 0.0, drift_ppm: float = 0.0) -> Clock:
    """Returns the machine's clock, for tests with an offset (s) and a drift (ppm)."""
    if not offset_s and not drift_ppm:
        return SystemClock()
    return SkewedClock(SystemClock(), round(offset_s * NS_PER_S), round(drift_ppm * 1000))
