"""What a channel has delivered, and what it owes: counted by number, not by time.

A message's number is its tick for a record, its place from 0 for statistics and events. Law: a number is
received once, missing, or not known to exist; so expected = received + missing, always.
"""

from .ranges import Ranges

MAX_GAPS = 50_000
"""Gaps that an account keeps apart: of those before, it knows how many are missing, and no more which."""
SHOWN = 20
"""Gaps that are named in a text."""


class Account:
    """The account of one channel.

    Attributes:
        received: messages that there are, each number once.
        duplicate: those that came though their number was there.
        reordered: those that came after one with a higher number had come.
        refilled: those that came from the sender's memory, after they had been missing.
        last: largest number that is known to exist, -1 before the first.
        hopeless: numbers below this one that are missing can be had from nobody.
        silence_ns: the longest time between two that came, ns; 0 where nobody stamps them.
    """

    __slots__ = (
        "_came_ns",
        "_gaps",
        "_newest",
        "duplicate",
        "hopeless",
        "last",
        "received",
        "refilled",
        "reordered",
        "silence_ns",
    )

    def __init__(self) -> None:
        self.received = self.duplicate = self.reordered = self.refilled = 0
        self.last = -1
        self.hopeless = 0
        self.silence_ns = 0
        self._newest = -1  # of those that came by themselves
        self._came_ns: int | None = None
        self._gaps = Ranges(MAX_GAPS)

    def take(self, number: int, came_ns: int | None = None) -> bool:
        """Books one message; False where its number is there already.

        Args:
            number: its number, 0 or more.
            came_ns: when it came, on a clock that never steps.
        """
        if came_ns is not None:
            if self._came_ns is not None and came_ns - self._came_ns > self.silence_ns:
                self.silence_ns = came_ns - self._came_ns
            self._came_ns = came_ns
        passed = number <= self._newest
        self._newest = max(self._newest, number)
        if not self._is_new(number):
            self.duplicate += 1
            return False
        self.reordered += passed
        self.received += 1
        return True

    def refill(self, number: int) -> bool:
        """Books one message from the sender's memory; False where its number is there already."""
        new = self._is_new(number)
        self.refilled += new
        self.received += new
        return new

    def expect(self, made: int) -> None:
        """Books what is missing, where it is known how many there are at least."""
        if made > self.last + 1:
            self._gaps.append(self.last + 1, made - 1)
            self.last = made - 1

    def give_up(self, below: int) -> None:
        """Books what is missing below a number as lost for good; should it come yet, it is welcome."""
        self.hopeless = max(self.hopeless, below)

    def wanted(self, number: int = 0) -> tuple[int, int] | None:
        """Returns the first gap at or above a number that is not hopeless; None where there is none."""
        return self._gaps.from_(max(number, self.hopeless))

    @property
    def expected(self) -> int:
        """How many are known to exist."""
        return self.last + 1

    @property
    def missing(self) -> int:
        """How many of them are missing."""
        return self.last + 1 - self.received

    @property
    def gaps(self) -> list[list[int]]:
        """Numbers that are missing, as [first, last] pairs; the newest MAX_GAPS of them."""
        return [list(gap) for gap in self._gaps]

    @property
    def largest_gap(self) -> int:
        """How many the largest gap has."""
        return self._gaps.longest()

    def as_text(self) -> str:
        """Returns the account in one line, for the file and for people."""
        gaps = self.gap_texts(SHOWN)
        named = f" ({' '.join(gaps)}{' ...' if len(self._gaps) > len(gaps) else ''})" if gaps else ""
        silence = f", longest silence {self.silence_ns / 1e6:.1f} ms" if self.silence_ns else ""
        return (
            f"expected {self.expected}, received {self.received}, missing {self.missing}, "
            f"duplicate {self.duplicate}, reordered {self.reordered}, refilled {self.refilled}, "
            f"largest gap {self.largest_gap}{named}{silence}"
        )

    def gap_texts(self, most: int) -> list[str]:
        """Returns the gaps as "first-last", the first ones of them."""
        return [f"{first}-{last}" for (first, last), _ in zip(self._gaps, range(most), strict=False)]

    def _is_new(self, number: int) -> bool:
        """Takes a number out of what is missing; False where it was not."""
        if number > self.last:
            self.expect(number)
            self.last = number
            return True
        return self._gaps.remove(number)
