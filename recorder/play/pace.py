"""Playback deadlines as a pure function of log time, waiting for them, and a histogram of lateness.

Invariant: deadlines are absolute, from one origin; a late message delays no later one. Sleep until shortly
before the deadline, then poll the clock. The histogram (whole microseconds) is bounded for any length of
play (L6).
"""

import math
from dataclasses import dataclass
from itertools import accumulate

from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import UsageError
from trilat_net.net.clock import Clock

SPIN_NS = 150_000
"""How long before a deadline sleep must end: it oversleeps by some 60 us as a rule."""
SLOWEST, FASTEST = 1e-3, 1e3


@dataclass(frozen=True, slots=True)
class Pace:
    """A line from the time in the log to the clock.

    Attributes:
        origin_ns: the clock when `start_ns` is played.
        start_ns: where the play begins, ns since the epoch of the log.
        rate: seconds of the log in a second; `math.inf`: everything is due at the origin.
    """

    origin_ns: int
    start_ns: int
    rate: float = 1.0

    def due_ns(self, t_ns: int) -> int:
        """Returns when an instant of the log is due, on the clock."""
        return self.origin_ns + round((t_ns - self.start_ns) / self.rate)

    def position_ns(self, now_ns: int) -> int:
        """Returns which instant of the log is due now; at the start for ever where all is due at once."""
        passed_ns = now_ns - self.origin_ns
        return self.start_ns + (round(passed_ns * self.rate) if math.isfinite(self.rate) else 0)

    def later(self, length_ns: int) -> "Pace":
        """Returns the pace of the next round, which begins when so much of the log has been played."""
        return Pace(self.origin_ns + round(length_ns / self.rate), self.start_ns, self.rate)


def parse_rate(text: str) -> float:
    """Returns a rate that a person gives; "max" and 0 mean as fast as can be.

    Raises:
        UsageError: it is none.
    """
    try:
        rate = math.inf if text.strip().lower() == "max" else float(text)
    except ValueError:
        rate = math.nan
    if rate == 0 or (rate == math.inf and text.strip().lower() == "max"):
        return math.inf
    if not SLOWEST <= rate <= FASTEST:
        raise UsageError(
            f"--rate is how much faster than it was, from {SLOWEST:g} to {FASTEST:g}, or max; not {text!r}"
        )
    return rate


def wait_until(clock: Clock, due_ns: int, spin_ns: int) -> int:
    """Returns the clock's reading at a deadline, or at once where that has passed.

    Args:
        clock: the time.
        due_ns: the deadline.
        spin_ns: how long before it to stop sleeping and look on; 0 sleeps to the end.
    """
    if spin_ns:
        clock.sleep_until(due_ns - spin_ns)
        while (now_ns := clock.monotonic_ns()) < due_ns:
            pass
        return now_ns
    clock.sleep_until(due_ns)
    return clock.monotonic_ns()


def to_seconds(t_ns: int) -> float:
    """Returns nanoseconds as seconds, for people."""
    return t_ns / NS_PER_S


LATENESS_LIMIT_US = 100_000
"""Later ones are counted together; the latest is known all the same."""


@dataclass(frozen=True, slots=True)
class LatenessSummary:
    """What came of it, us; a message is late by the time from its deadline to the call that publishes it.

    Attributes:
        p50_us: half of the messages were no later.
        p99_us: 99 of 100 were no later; `max_us` where that is more than `LIMIT_US`.
        max_us: the latest one.
    """

    p50_us: int
    p99_us: int
    max_us: int


class LatenessHistogram:
    """Counts how late messages were."""

    def __init__(self) -> None:
        self._counts = [0] * (LATENESS_LIMIT_US + 1)
        self._max_us = 0

    def add(self, late_ns: int) -> None:
        """Counts one, ns."""
        late_us = late_ns // 1000
        self._counts[late_us if late_us < LATENESS_LIMIT_US else LATENESS_LIMIT_US] += 1
        if late_us > self._max_us:
            self._max_us = late_us

    @property
    def max_us(self) -> int:
        """The latest so far, us."""
        return self._max_us

    def summary(self) -> LatenessSummary | None:
        """Returns what came of it; None where nothing was counted."""
        sums = list(accumulate(self._counts))
        if not sums[-1]:
            return None
        return LatenessSummary(self._quantile(sums, 50), self._quantile(sums, 99), self._max_us)

    def _quantile(self, sums: list[int], percent: int) -> int:
        """Returns the least lateness that so many per cent of the messages do not exceed, us."""
        late_us = next(us for us, count in enumerate(sums) if count * 100 >= percent * sums[-1])
        return late_us if late_us < LATENESS_LIMIT_US else self._max_us
