"""Bounded queue of inbound messages, stamped on arrival, for the one thread that writes.

Invariant (L6): the queue is bounded, in messages and in bytes, and each key in its share of the bytes, so
that one member's flood does not displace what the others send; overflow is counted and reported.
"""

import threading
from collections import Counter, deque
from collections.abc import Iterator
from typing import NamedTuple

from trilat_net.net.clock import Clock

CAPACITY = 60_000
"""Capacity in messages: minutes of three sites at 1 kHz, whose records come in blocks."""
CAPACITY_BYTES, KEY_BYTES = 96 << 20, 32 << 20
"""Capacity in bytes, and of messages of one key: a planar arm at 1 kHz makes half a megabyte a second."""
OVERHEAD_BYTES = 200
"""What a message takes besides its payload."""
KEYS = 1_000
"""Keys whose losses, and whose shares, are counted separately."""


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
        self._taken, self._drained = Counter[str](), Counter[str]()  # each of one thread, bytes by key
        self._taken_bytes = self._drained_bytes = 0
        self._taking = threading.Lock()  # a bus may have several threads
        self.overflowed: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._queue)

    def take(self, key: str, payload: bytes) -> None:
        """Stamps and appends one message; called by the bus."""
        size = len(payload) + OVERHEAD_BYTES
        with self._taking:
            of = key if key in self._taken or len(self._taken) < KEYS else "others"
            waiting = self._taken_bytes - self._drained_bytes, self._taken[of] - self._drained[of]
            if len(self._queue) >= CAPACITY or waiting[0] >= CAPACITY_BYTES or waiting[1] >= KEY_BYTES:
                self.overflowed[of] += 1
                return
            self._taken[of] += size
            self._taken_bytes += size
            self._queue.append(InboundMessage(key, payload, self._clock.monotonic_ns()))

    def drain(self, until_ns: int | None = None) -> Iterator[InboundMessage]:
        """Yields the waiting messages that arrived until an instant, oldest first; all without one."""
        queue = self._queue
        while queue and (until_ns is None or queue[0].mono_ns <= until_ns):
            message = queue.popleft()
            size = len(message.payload) + OVERHEAD_BYTES
            self._drained[message.key if message.key in self._taken else "others"] += size
            self._drained_bytes += size
            yield message
