"""Provides the clocks that all other modules use to read the time and to sleep.

Code that needs the time takes a `Clock` as an argument, which lets tests and simulations supply
their own clock, such as one that drifts (law L1 of docs/develop/design.md). Times are integers
in ns; floating-point seconds would lose precision after a few months.

Invariant:
    - No other module reads a clock of the operating system.
"""

import platform
import time
from pathlib import Path
from typing import Protocol

from ..records import NS_PER_S


class Clock(Protocol):
    """Interface of the clocks used by this program.

    A clock provides a monotonic time, which never steps and is used for timing control loops,
    and the time of day, which may step. Tests replace the system clock with clocks of their
    own.
    """

    def monotonic_ns(self) -> int:
        """Returns a monotonic time in ns, for measuring durations.

        The zero point is arbitrary, so only differences between readings are meaningful.
        """

    def unix_ns(self) -> int:
        """Returns the time of day of the machine, in ns since 1970.

        The value may step at any moment, for example when the machine synchronises its clock.
        Use `monotonic_ns` to measure durations.
        """

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleeps until the monotonic clock reaches a given time, such as the next tick.

        Args:
            deadline_ns: Time on the monotonic clock, in ns. If it has already passed, the
                method returns immediately.
        """

    def identity(self) -> str:
        """Returns a string that is equal in two processes if they share a monotonic clock.

        Processes on one machine normally share a monotonic clock. The readings of two processes
        can be compared directly only if they share the clock.
        """


class SystemClock:
    """The monotonic clock and the time of day of the operating system.

    This is the clock of live processes; tests substitute other clocks.
    """

    monotonic_ns = staticmethod(time.perf_counter_ns)
    """The clock of `time.monotonic_ns`, except on Windows, where that clock steps by 16 ms."""
    unix_ns = staticmethod(time.time_ns)

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleeps until the monotonic clock reaches a given time, such as the next tick.

        Args:
            deadline_ns: Time on the monotonic clock, in ns. If it has already passed, the
                method returns immediately.
        """
        remaining_ns = deadline_ns - self.monotonic_ns()
        if remaining_ns > 0:
            # CPython sleeps until an absolute deadline, so signals do not shorten the sleep.
            time.sleep(remaining_ns * 1e-9)

    def identity(self) -> str:
        """Returns a string that identifies the monotonic clock of this machine.

        On Linux, the string combines the kernel's boot identifier with the time namespace,
        since a container may have its own clock. On other systems it contains the name of the
        machine.
        """
        try:
            boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
            namespace = Path("/proc/self/ns/time").readlink().name
        except OSError:
            return f"{platform.node()}/{time.get_clock_info('perf_counter').implementation}"
        return f"{boot}/{namespace}"

    @classmethod
    def with_error(cls, offset_s: float, drift_ppm: float) -> Clock:
        """Returns the system clock, or a test clock with an offset and a drift relative to it.

        Args:
            offset_s: Offset from the system clock, in s.
            drift_ppm: Drift relative to the system clock, in parts per million.
        """
        if not offset_s and not drift_ppm:
            return cls()
        return SkewedClock(cls(), round(offset_s * NS_PER_S), round(drift_ppm * 1000))


class SkewedClock:
    """A clock with an offset and a drift relative to a base clock, for tests on one machine.

    It simulates the clock of another machine and reads

        start + offset + (reading - start) (1 + drift),

    where `reading` is the current reading of the base clock, and `start` is its reading when
    this object was created. The time of day is not changed. The identity of the clock is unique
    and contains the offset, the drift and the start, which allows readers of a log to convert
    the times.

    Args:
        clock: The base clock.
        offset_ns: Offset from the base clock, in ns.
        drift_ppb: Drift relative to the base clock, in ns/s.
    """

    def __init__(self, clock: Clock, offset_ns: int, drift_ppb: int) -> None:
        self._clock = clock
        self._offset_ns = offset_ns
        self._drift_ppb = drift_ppb
        self._start_ns = clock.monotonic_ns()

    def monotonic_ns(self) -> int:
        """Returns the time of this deliberately inaccurate clock, in ns.

        This is the time of the base clock, plus the offset, plus the drift multiplied by the
        time since this clock was created.
        """
        passed_ns = self._clock.monotonic_ns() - self._start_ns
        drift_ns = passed_ns * self._drift_ppb // NS_PER_S
        return self._start_ns + self._offset_ns + passed_ns + drift_ns

    def unix_ns(self) -> int:
        """Returns the true time of day in ns since 1970, with no offset or drift.

        This class simulates clock errors only in its monotonic time.
        """
        return self._clock.unix_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleeps until this clock reaches a given time.

        The deadline is converted to a time of the base clock, whose `sleep_until` is then
        called. When the base clock has advanced by p since the start, this clock reads

            start + offset + p (1 + drift).

        Solving for p gives the time for which the base clock must run:

            p = (deadline - start - offset) / (1 + drift).

        The drift is stored in ns/s, so 1 + drift is (NS_PER_S + drift_ppb) / NS_PER_S.

        Args:
            deadline_ns: Time on this clock, in ns. If it has already passed, the method returns
                immediately.
        """
        # Time from the start to the deadline, as this clock and as the base clock measure it.
        skewed_duration_ns = deadline_ns - self._start_ns - self._offset_ns
        skewed_ns_per_base_s = NS_PER_S + self._drift_ppb
        # -(-a // b) is a / b rounded up, so that the sleep does not end before the deadline.
        base_duration_ns = -(-skewed_duration_ns * NS_PER_S // skewed_ns_per_base_s)
        self._clock.sleep_until(self._start_ns + base_duration_ns)

    def identity(self) -> str:
        """Returns a string that identifies this clock by its offset, drift and start.

        Readers of a log use these values to convert the clock's readings to true times.
        """
        return (
            f"{self._clock.identity()}, skewed by {self._offset_ns} ns "
            f"and {self._drift_ppb} ns/s since {self._start_ns} ns"
        )
