"""What a channel has delivered, and what it owes: counted by number, not by time.

A message's number is its tick for a record, its place from 0 for statistics and events.
"""

from dataclasses import dataclass, field


@dataclass(slots=True)
class Account:
    """The account of one channel.

    Attributes:
        received: messages, duplicates not counted.
        duplicate: messages whose number had come before.
        reordered: messages whose number is below one that had come before.
        last: largest number so far, -1 before the first.
        gaps: numbers that are missing, as [first, last] pairs; at most `MAX_GAPS` are kept apart.
    """

    received: int = 0
    duplicate: int = 0
    reordered: int = 0
    last: int = -1
    gaps: list[list[int]] = field(default_factory=list)

    def take(self, number: int) -> bool:
        """Books one message; False where its number had come before."""
        if number == self.last + 1:
            self.last = number
        elif number > self.last:
            self._open_gap(self.last + 1, number - 1)
            self.last = number
        elif self._close(number):
            self.reordered += 1
        else:
            self.duplicate += 1
            return False
        self.received += 1
        return True

    def expect(self, made: int) -> None:
        """Books what is missing, once it is known how many there are."""
        if made > self.last + 1:
            self._open_gap(self.last + 1, made - 1)
            self.last = made - 1

    @property
    def missing(self) -> int:
        """How many are missing."""
        return sum(last - first + 1 for first, last in self.gaps)

    @property
    def largest_gap(self) -> int:
        """How many the largest gap has."""
        return max((last - first + 1 for first, last in self.gaps), default=0)

    def _open_gap(self, first: int, last: int) -> None:
        if len(self.gaps) < MAX_GAPS:
            self.gaps.append([first, last])
        else:  # bounded: the newest gap takes the rest, so that `missing` is never too small
            self.gaps[-1][1] = last

    def _close(self, number: int) -> bool:
        """Takes a number out of the gap that it lies in; False where it lies in none."""
        for n, (first, last) in enumerate(self.gaps):
            if first <= number <= last:
                parts = [[first, number - 1], [number + 1, last]]
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
