"""What a channel has delivered, and what it owes: counted by tick, not by time."""

from dataclasses import dataclass, field


@dataclass(slots=True)
class Account:
    """The account of one channel of records.

    Attributes:
        received: messages, duplicates not counted.
        duplicate: messages whose tick had come before.
        reordered: messages whose tick is below one that had come before.
        last: largest tick so far, -1 before the first.
        gaps: ticks that are missing, as [first, last] pairs; at most `MAX_GAPS` are kept apart.
    """

    received: int = 0
    duplicate: int = 0
    reordered: int = 0
    last: int = -1
    gaps: list[list[int]] = field(default_factory=list)

    def take(self, tick: int) -> bool:
        """Books one message; False where its tick had come before."""
        if tick == self.last + 1:
            self.last = tick
        elif tick > self.last:
            self._open_gap(self.last + 1, tick - 1)
            self.last = tick
        elif self._close(tick):
            self.reordered += 1
        else:
            self.duplicate += 1
            return False
        self.received += 1
        return True

    def expect(self, ticks: int) -> None:
        """Books what is missing at the end, once the number of ticks is known."""
        if ticks > self.last + 1:
            self._open_gap(self.last + 1, ticks - 1)
            self.last = ticks - 1

    @property
    def missing(self) -> int:
        """How many ticks are missing."""
        return sum(last - first + 1 for first, last in self.gaps)

    @property
    def largest_gap(self) -> int:
        """How many ticks the largest gap has."""
        return max((last - first + 1 for first, last in self.gaps), default=0)

    def _open_gap(self, first: int, last: int) -> None:
        if len(self.gaps) < MAX_GAPS:
            self.gaps.append([first, last])
        else:  # bounded: the newest gap takes the rest, so that `missing` is never too small
            self.gaps[-1][1] = last

    def _close(self, tick: int) -> bool:
        """Takes a tick out of the gap that it lies in; False where it lies in none."""
        for n, (first, last) in enumerate(self.gaps):
            if first <= tick <= last:
                parts = [[first, tick - 1], [tick + 1, last]]
                self.gaps[n : n + 1] = [part for part in parts if part[0] <= part[1]]
                return True
        return False

    def as_text(self) -> str:
        """Returns the account in one line, for the file and for people."""
        gaps = " ".join(f"{first}-{last}" for first, last in self.gaps[:20])
        return (
            f"received {self.received}, missing {self.missing}, duplicate {self.duplicate}, "
            f"reordered {self.reordered}, largest gap {self.largest_gap}" + (f" ({gaps})" if gaps else "")
        )


MAX_GAPS = 10_000
"""Gaps that an account keeps apart."""
