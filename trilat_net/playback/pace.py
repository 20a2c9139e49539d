"""When each message is due, as a pure function of its time; and how to be there.

Law: deadlines are absolute, from one origin; a late message makes no later one late. Sleep to shortly before,
then look at the clock until it is time.
"""

import math
from dataclasses import dataclass

from ..core.grid import NS_PER_S
from ..errors import UsageError
from ..net.clock import Clock

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


def chosen_rate(text: str) -> float:
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


def wait(clock: Clock, due_ns: int, spin_ns: int) -> int:
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


def seconds(t_ns: int) -> float:
    """Returns nanoseconds as seconds, for people."""
    return t_ns / NS_PER_S
