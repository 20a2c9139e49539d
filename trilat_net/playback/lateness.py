"""How late messages were published: a histogram of whole microseconds.

Law (L6): bounded, however long the play; counting one costs no more than adding to a list.
"""

from dataclasses import dataclass
from itertools import accumulate

LIMIT_US = 100_000
"""Later ones are counted together; the latest is known all the same."""


@dataclass(frozen=True, slots=True)
class Lateness:
    """What came of it, us; a message is late by the time from its deadline to the call that publishes it.

    Attributes:
        p50_us: half of the messages were no later.
        p99_us: 99 of 100 were no later; `max_us` where that is more than `LIMIT_US`.
        max_us: the latest one.
    """

    p50_us: int
    p99_us: int
    max_us: int


class Latenesses:
    """Counts how late messages were."""

    def __init__(self) -> None:
        self._counts = [0] * (LIMIT_US + 1)
        self._max_us = 0

    def add(self, late_ns: int) -> None:
        """Counts one, ns."""
        late_us = late_ns // 1000
        self._counts[late_us if late_us < LIMIT_US else LIMIT_US] += 1
        if late_us > self._max_us:
            self._max_us = late_us

    @property
    def max_us(self) -> int:
        """The latest so far, us."""
        return self._max_us

    def summary(self) -> Lateness | None:
        """Returns what came of it; None where nothing was counted."""
        sums = list(accumulate(self._counts))
        if not sums[-1]:
            return None
        return Lateness(self._quantile(sums, 50), self._quantile(sums, 99), self._max_us)

    def _quantile(self, sums: list[int], percent: int) -> int:
        """Returns the least lateness that so many per cent of the messages do not exceed, us."""
        late_us = next(us for us, count in enumerate(sums) if count * 100 >= percent * sums[-1])
        return late_us if late_us < LIMIT_US else self._max_us
