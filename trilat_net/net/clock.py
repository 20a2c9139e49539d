"""Clocks: the only module that reads the time.

Invariant (L1): code that needs the time takes a clock as an argument; times are integer
nanoseconds, never floats.
"""

import platform
import time
from pathlib import Path
from typing import Protocol

NS_PER_S = 1_000_000_000  # `core.ticks` has it too, but loads the compiler, which a router does not need


class Clock(Protocol):
    """The time, as every driver gets it."""

    def monotonic_ns(self) -> int:
        """Returns nanoseconds of a clock that never steps; its zero is arbitrary."""

    def unix_ns(self) -> int:
        """Returns nanoseconds since 1970, by the machine's wall clock, which may step."""

    def sleep_until(self, deadline_ns: int) -> None:
        """Returns at `deadline_ns` of the monotonic clock, or at once if that has passed."""

    def identity(self) -> str:
        """Names the monotonic clock: equal only where two processes can compare its readings."""


class SystemClock:
    """The machine's clocks."""

    monotonic_ns = staticmethod(time.perf_counter_ns)
    """The same clock as `time.monotonic_ns`, but on Windows, where that one may go in steps of
    16 ms.
    """
    unix_ns = staticmethod(time.time_ns)

    def sleep_until(self, deadline_ns: int) -> None:
        """See `Clock`. CPython sleeps to an absolute deadline of its own, so signals do not
        shorten it.
        """
        rest_ns = deadline_ns - self.monotonic_ns()
        if rest_ns > 0:
            time.sleep(rest_ns * 1e-9)

    def identity(self) -> str:
        """See `Clock`. On Linux: boot of the kernel and time namespace; elsewhere the machine's
        name.
        """
        try:
            boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
            namespace = Path("/proc/self/ns/time").readlink().name
        except OSError:
            return f"{platform.node()}/{time.get_clock_info('perf_counter').implementation}"
        return f"{boot}/{namespace}"


class SkewedClock:
    """Another clock with an offset and a drift: test injection of another machine's clock.

    It reads start + offset + (other - start) (1 + drift), where start is the other's reading
    when this one was made. Its identity states all of it and is unique, so that a reader of a
    log can undo it. The wall clock stays; the drift is in ns/s.
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
    """Returns the machine's clock, with an offset (s) and a drift if they are injected."""
    if not offset_s and not drift_ppm:
        return SystemClock()
    return SkewedClock(SystemClock(), round(offset_s * NS_PER_S), round(drift_ppm * 1000))
