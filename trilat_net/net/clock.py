"""Clocks: the only reader of time.

Law (L1): whoever needs the time gets a clock as an argument; integer nanoseconds, never a float.
"""

import time
from pathlib import Path
from typing import Protocol


class Clock(Protocol):
    """What a driver may ask of time."""

    def monotonic_ns(self) -> int:
        """Returns nanoseconds of a clock that never steps; its zero means nothing."""

    def unix_ns(self) -> int:
        """Returns nanoseconds since 1970, by the machine's wall clock, which may step."""

    def sleep_until(self, deadline_ns: int) -> None:
        """Returns at `deadline_ns` of the monotonic clock, or at once where that has passed."""

    def identity(self) -> str:
        """Names the monotonic clock: equal only where two processes can compare its readings."""


class SystemClock:
    """The machine's clocks."""

    def monotonic_ns(self) -> int:
        """See `Clock`."""
        return time.monotonic_ns()

    def unix_ns(self) -> int:
        """See `Clock`."""
        return time.time_ns()

    def sleep_until(self, deadline_ns: int) -> None:
        """See `Clock`. CPython sleeps to an absolute deadline of its own, so signals do not shorten it."""
        rest_ns = deadline_ns - time.monotonic_ns()
        if rest_ns > 0:
            time.sleep(rest_ns * 1e-9)

    def identity(self) -> str:
        """See `Clock`. On Linux: the boot of the kernel and the time namespace of the process."""
        try:
            boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
            namespace = Path("/proc/self/ns/time").readlink().name
        except OSError:
            return f"process-{time.get_clock_info('monotonic').implementation}"
        return f"{boot}/{namespace}"


class ManualClock:
    """A clock that a test moves by hand; sleeping moves it to the deadline.

    Args:
        start_ns: its first reading.
        epoch_unix_ns: what the wall clock shows at reading 0.
    """

    def __init__(self, start_ns: int = 0, epoch_unix_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._epoch_unix_ns = epoch_unix_ns

    def monotonic_ns(self) -> int:
        """See `Clock`."""
        return self._now_ns

    def unix_ns(self) -> int:
        """See `Clock`."""
        return self._epoch_unix_ns + self._now_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """See `Clock`."""
        self._now_ns = max(self._now_ns, deadline_ns)

    def identity(self) -> str:
        """See `Clock`."""
        return "manual"
