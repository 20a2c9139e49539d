"""What has been played of late, for recorders that missed it: as a site would answer.

Law (L6): bounded by what a site remembers, a minute, where the log is read while it plays; a log that lies in
memory as a whole is answered from as a whole. What has not been played yet is not told.
"""

from bisect import bisect_left
from collections import deque
from typing import NamedTuple

import numpy as np

from ..net.answers import CHUNK, CHUNK_BYTES
from .block import Block
from .order import Ints


class _Stretch(NamedTuple):
    """Messages of one channel that lie in one block: their numbers, ascending, and their places in it."""

    numbers: Ints
    places: Ints
    block: Block


class Memory:
    """Per channel the messages that have been given to the player.

    Args:
        kept_ns: how much of the log to remember, ns; None: everything.

    Attributes:
        made: per channel the number of its last message played, and one.
    """

    def __init__(self, kept_ns: int | None = None) -> None:
        self.made: dict[int, int] = {}
        self._kept_ns = kept_ns
        self._stretches: dict[int, deque[_Stretch]] = {}

    def add(self, block: Block) -> None:
        """Takes messages that are about to be played, and forgets the oldest."""
        for channel in np.unique(block.channels).tolist():
            places = np.flatnonzero(block.channels == channel)
            stretches = self._stretches.setdefault(channel, deque())
            stretches.append(_Stretch(block.numbers[places], places, block))
            while self._kept_ns is not None and self._old(stretches[0], int(block.times_ns[-1])):
                stretches.popleft()

    def _old(self, stretch: _Stretch, now_ns: int) -> bool:
        assert self._kept_ns is not None
        return int(stretch.block.times_ns[-1]) < now_ns - self._kept_ns

    def forget(self) -> None:
        """Forgets everything but how much was played: another round begins."""
        self._stretches.clear()

    def chunk(self, channel: int, first: int, last: int) -> tuple[int, list[bytes]]:
        """Returns consecutive messages of a channel, as many as one answer takes, and the first one's number.

        Args:
            channel: which.
            first: number of the first one wanted; where there is none of that number, the next one that
                there is comes first.
            last: number of the last one wanted.
        """
        stretches = self._stretches.get(channel, deque())
        made = self.made.get(channel, 0)
        payloads: list[bytes] = []
        size, wanted, begun = 0, first, first
        for stretch in list(stretches)[bisect_left(stretches, first, key=lambda s: int(s.numbers[-1])) :]:
            begin = int(np.searchsorted(stretch.numbers, wanted))
            for number, place in zip(
                stretch.numbers[begin : begin + CHUNK + 1].tolist(),
                stretch.places[begin : begin + CHUNK + 1].tolist(),
                strict=True,
            ):
                if not payloads:
                    begun = wanted = max(first, min(number, made))
                if number < wanted:
                    continue  # the same number once more
                payload = stretch.block.payload(place)
                size += len(payload)
                full = len(payloads) == CHUNK or (payloads and size > CHUNK_BYTES)
                if number > min(last, made - 1) or number > wanted or full:
                    return begun, payloads
                payloads.append(payload)
                wanted = number + 1
        return (begun if payloads or first >= made else made), payloads
