"""Whole numbers as ranges: what is missing of a channel, in little memory however much it is.

Law: the ranges are sorted, apart, and at most as many as one says; of more, the lowest are forgotten.
"""

from bisect import bisect_right
from collections.abc import Iterator


class Ranges:
    """A set of whole numbers that grows at its upper end.

    Args:
        most: ranges that are kept apart.

    Attributes:
        count: how many numbers are in it.
    """

    __slots__ = ("_firsts", "_lasts", "_most", "count")

    def __init__(self, most: int) -> None:
        self.count = 0
        self._most = most
        self._firsts: list[int] = []
        self._lasts: list[int] = []

    def __iter__(self) -> Iterator[tuple[int, int]]:
        """Yields (first, last) of every range, lowest first."""
        return zip(self._firsts, self._lasts, strict=True)

    def __len__(self) -> int:
        """Returns how many ranges there are."""
        return len(self._firsts)

    def append(self, first: int, last: int) -> None:
        """Adds numbers that lie above all that are in it."""
        if self._lasts and self._lasts[-1] == first - 1:
            self._lasts[-1] = last
        else:
            self._firsts.append(first)
            self._lasts.append(last)
        self.count += last - first + 1
        self._bound()

    def remove(self, number: int) -> bool:
        """Takes one number out; False where it is not in."""
        place = bisect_right(self._firsts, number) - 1
        if place < 0 or number > self._lasts[place]:
            return False
        first, last = self._firsts[place], self._lasts[place]
        parts = [(a, b) for a, b in ((first, number - 1), (number + 1, last)) if a <= b]
        self._firsts[place : place + 1] = [a for a, _ in parts]
        self._lasts[place : place + 1] = [b for _, b in parts]
        self.count -= 1
        self._bound()
        return True

    def from_(self, number: int) -> tuple[int, int] | None:
        """Returns the first range at or above a number, cut off below it; None where there is none."""
        place = max(0, bisect_right(self._firsts, number) - 1)
        if place < len(self._lasts) and self._lasts[place] < number:
            place += 1
        if place >= len(self._firsts):
            return None
        return max(number, self._firsts[place]), self._lasts[place]

    def longest(self) -> int:
        """Returns how many numbers the longest range has."""
        return max((last - first + 1 for first, last in self), default=0)

    def _bound(self) -> None:
        if len(self._firsts) > self._most:
            self.count -= self._lasts.pop(0) - self._firsts.pop(0) + 1
