"""Playback deadlines as a pure function of log time, waiting for them, and a histogram of lateness.

Invariant: deadlines are absolute, from one origin; a late message delays no later one. Sleep until shortly
before the deadline, then poll the clock. The histogram (whole microseconds) is bounded for any length of
play (L6).
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from trilat_net.errors import UsageError
from trilat_net.net.clock import Clock

SPIN_NS = 150_000
"""Time before a deadline at which sleep must end: it oversleeps by some 60 us as a rule."""
SLOWEST, FASTEST = 1e-3, 1e3


@dataclass(frozen=True, slots=True)
class Pace:
    """A line from log time to the clock.

    Attributes:
        origin_ns: the clock at `start_ns`.
        start_ns: beginning of the play, ns since the epoch of the log.
        rate: seconds of the log per second; `math.inf`: everything is due at the origin.
    """

    origin_ns: int
    start_ns: int
    rate: float = 1.0

    def due_ns(self, t_ns: int) -> int:
        """Returns the deadline of an instant of the log, on the clock."""
        return self.origin_ns + round((t_ns - self.start_ns) / self.rate)

    def later(self, length_ns: int) -> "Pace":
        """Returns the pace of the next round, which begins after such a length of the log."""
        return Pace(self.due_ns(self.start_ns + length_ns), self.start_ns, self.rate)


def parse_rate(text: str) -> float:
    """Returns a rate that a user gives; "max" and 0 mean as fast as possible.

    Raises:
        UsageError: it is no rate.
    """
    if text.strip().lower() == "max":
        return math.inf
    try:
        rate = float(text)
    except ValueError:
        rate = math.nan
    if rate == 0:
        return math.inf
    if not SLOWEST <= rate <= FASTEST:
        raise UsageError(
            f"--rate is how much faster than it was, from {SLOWEST:g} to {FASTEST:g}, or max; not {text!r}"
        )
    return rate


def wait_until(clock: Clock, due_ns: int, spin_ns: int) -> int:
    """Returns the clock's reading at a deadline, or at once if that has passed.

    It stops sleeping `spin_ns` before and polls the clock; with 0 it sleeps to the end.
    """
    clock.sleep_until(due_ns - spin_ns)
    now_ns = clock.monotonic_ns()
    while spin_ns and now_ns < due_ns:
        now_ns = clock.monotonic_ns()
    return now_ns


LATENESS_LIMIT_US = 100_000
"""Higher values share one bin; the maximum is exact all the same."""


class LatenessSummary(NamedTuple):
    """Median, 99th percentile and maximum of the lateness, us; a quantile above the limit is the maximum."""

    p50_us: int
    p99_us: int
    max_us: int


class LatenessHistogram:
    """Counts messages by lateness: from their deadline to the call that publishes them."""

    def __init__(self) -> None:
        self.max_us = 0
        self._counts = [0] * (LATENESS_LIMIT_US + 1)

    def add(self, late_ns: int) -> None:
        """Counts one message by its lateness, ns."""
        late_us = late_ns // 1000
        self._counts[late_us if late_us < LATENESS_LIMIT_US else LATENESS_LIMIT_US] += 1
        if late_us > self.max_us:
            self.max_us = late_us

    def summary(self) -> LatenessSummary | None:
        """Returns the quantiles; None without a message."""
        sums = np.cumsum(self._counts)
        if not sums[-1]:
            return None
        bins = np.searchsorted(100 * sums, sums[-1] * np.array([50, 99])).tolist()
        p50_us, p99_us = (us if us < LATENESS_LIMIT_US else self.max_us for us in bins)
        return LatenessSummary(p50_us, p99_us, self.max_us)
