"""Bounded queue of inbound messages, stamped on arrival, for the one thread that writes.

Invariant (L6): the queue is bounded; overflow is counted and reported.
"""

from collections import Counter, deque
from collections.abc import Iterator
from typing import NamedTuple

from trilat_net.net.clock import Clock

CAPACITY = 60_000
"""Capacity in messages: minutes of three sites at 1 kHz, whose records come in blocks."""
KEYS = 1_000
"""Keys whose losses are counted separately."""


class InboundMessage(NamedTuple):
    """One message: its key, its bytes, and its arrival on the monotonic clock."""

    key: str
    payload: bytes
    mono_ns: int


class InboundQueue:
    """A queue between the bus's thread, which takes, and the writer's, which drains.

    Attributes:
        overflowed: messages lost because the queue was full, by key.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._queue: deque[InboundMessage] = deque()
        self.overflowed: Counter[str] = Counter()

    def __len__(self) -> int:
        """Returns the number of waiting messages."""
        return len(self._queue)

    def take(self, key: str, payload: bytes) -> None:
        """Stamps and appends one message; called by the bus."""
        if len(self._queue) >= CAPACITY:
            self.overflowed[key if len(self.overflowed) < KEYS else "others"] += 1
            return
        self._queue.append(InboundMessage(key, payload, self._clock.monotonic_ns()))

    def drain(self, until_ns: int | None = None) -> Iterator[InboundMessage]:
        """Yields the waiting messages that arrived until an instant, oldest first; all without one."""
        queue = self._queue
        while queue and (until_ns is None or queue[0].mono_ns <= until_ns):
            yield queue.popleft()
