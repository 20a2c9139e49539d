"""Provides the clocks that all other modules use to read the time and to sleep.

Code that needs the time receives a `Clock` as an argument, so that tests and simulations can
use a clock of their own, for example one that drifts (law L1 of docs/develop/design.md). Times
are integers in ns, because floating-point numbers would lose precision after a few months.

Invariant:
    - No other module reads a clock of the operating system.
"""

import platform
import time
from pathlib import Path
from typing import Protocol

from ..records import NS_PER_S


class Clock(Protocol):
    """Interface of the clocks that this program uses.

    A clock reads a monotonic time, which never steps, and the time of day, which may step.
    Control loops are timed by the monotonic time. Tests replace the clock of the machine by
    clocks of their own.
    """

    def monotonic_ns(self) -> int:
        """Returns the reading of a clock that never steps, in ns, to measure durations.

        The zero of this clock is arbitrary, so only differences between readings have a
        meaning.
        """

    def unix_ns(self) -> int:
        """Returns the time of day of the machine, as the time since 1970 in ns.

        It may step at any moment, for example when the machine synchronises its clock with
        others. Durations are therefore computed from `monotonic_ns`.
        """

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleeps until the monotonic clock has reached a time, such as the next control period.

        Args:
            deadline_ns: The time on the monotonic clock, in ns. If it has passed already, the
                method returns at once.
        """

    def identity(self) -> str:
        """Returns a string that is equal in two processes if they share a monotonic clock.

        This is the case on one machine. Only then can readings of both processes be compared.
        """


class SystemClock:
    """The monotonic clock and the time of day of the operating system.

    Live processes use this class. Tests replace it by other clocks.
    """

    monotonic_ns = staticmethod(time.perf_counter_ns)
    """The clock of `time.monotonic_ns`, except on Windows, where that clock steps by 16 ms."""
    unix_ns = staticmethod(time.time_ns)

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleeps until the monotonic clock has reached a time, such as the next control period.

        Args:
            deadline_ns: The time on the monotonic clock, in ns. If it has passed already, the
                method returns at once.
        """
        remaining_ns = deadline_ns - self.monotonic_ns()
        if remaining_ns > 0:
            # CPython sleeps until an absolute deadline, so signals do not shorten the sleep.
            time.sleep(remaining_ns * 1e-9)

    def identity(self) -> str:
        """Returns a string that identifies the monotonic clock of this machine.

        On Linux it consists of the kernel's boot identifier and the time namespace, because
        containers may have a clock of their own. On other systems it contains the name of the
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
        """Returns the clock of this machine, or for tests a clock with an offset and a drift.

        Args:
            offset_s: Offset relative to the machine's clock, in s.
            drift_ppm: Drift relative to the machine's clock, in parts per million.
        """
        if not offset_s and not drift_ppm:
            return cls()
        return SkewedClock(cls(), round(offset_s * NS_PER_S), round(drift_ppm * 1000))


class SkewedClock:
    """A clock with an offset and a drift relative to a base clock, for tests on one machine.

    The clock behaves like the clock of another machine. It reads

        start + offset + (reading - start) (1 + drift),

    where `reading` is the present reading of the base clock, and `start` was its reading when
    this object was created. The time of day is not changed. The identity of the clock is
    unique. It states the offset, the drift and the start, so that readers of a log can convert
    the readings.

    Args:
        clock: The base clock.
        offset_ns: Offset relative to the base clock, in ns.
        drift_ppb: Drift relative to the base clock, in ns/s.
    """

    def __init__(self, clock: Clock, offset_ns: int, drift_ppb: int) -> None:
        self._clock = clock
        self._offset_ns = offset_ns
        self._drift_ppb = drift_ppb
        self._start_ns = clock.monotonic_ns()

    def monotonic_ns(self) -> int:
        """Returns the time of a deliberately wrong clock, in ns, to test synchronisation.

        true time + offset + drift * (time since the clock was created)
        """
        passed_ns = self._clock.monotonic_ns() - self._start_ns
        drift_ns = passed_ns * self._drift_ppb // NS_PER_S
        return self._start_ns + self._offset_ns + passed_ns + drift_ns

    def unix_ns(self) -> int:
        """Returns the correct time of day in ns since 1970, without offset and drift.

        Only the monotonic time of this class is deliberately wrong.
        """
        return self._clock.unix_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """Sleeps until this clock has reached a time.

        The deadline is converted to a time of the base clock, which then sleeps. When the base
        clock has advanced by p since the start, this clock reads

            start + offset + p (1 + drift).

        Solving this for p gives the time for which the base clock must run:

            p = (deadline - start - offset) / (1 + drift).

        The drift is stored in ns/s, so that 1 + drift is (NS_PER_S + drift_ppb) / NS_PER_S.

        Args:
            deadline_ns: The time on this clock, in ns. If it has passed already, the method
                returns at once.
        """
        # Time from the start to the deadline, as this clock and as the base clock measure it.
        skewed_duration_ns = deadline_ns - self._start_ns - self._offset_ns
        skewed_ns_per_base_s = NS_PER_S + self._drift_ppb
        # -(-a // b) is a / b rounded up, so that the sleep does not end before the deadline.
        base_duration_ns = -(-skewed_duration_ns * NS_PER_S // skewed_ns_per_base_s)
        self._clock.sleep_until(self._start_ns + base_duration_ns)

    def identity(self) -> str:
        """Returns a string that identifies this wrong clock by its offset, drift and start.

        From these numbers, a reader of a log can convert its readings to those of the correct
        clock.
        """
        return (
            f"{self._clock.identity()}, skewed by {self._offset_ns} ns "
            f"and {self._drift_ppb} ns/s since {self._start_ns} ns"
        )
