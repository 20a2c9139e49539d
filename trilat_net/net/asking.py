"""A question that is asked again and again, over a network that may be slower than the one who asks.

Law: an answer counts however many questions later it comes, as long as it is one of the last CAPACITY.
"""

from collections import deque
from typing import NamedTuple

from .bus import Bus, Inbox
from .clock import Clock

CAPACITY = 128


class Answer(NamedTuple):
    """An answer: when it was asked for, ns of the asker's clock; its key; its payload."""

    asked_ns: int
    key: str
    payload: bytes


class Asking:
    """All that is asked under one key expression.

    Args:
        bus: the asker's connection.
        clock: its time.
        key: the key expression.
    """

    def __init__(self, bus: Bus, clock: Clock, key: str) -> None:
        self._bus, self._clock, self._key = bus, clock, key
        self._open: deque[tuple[int, Inbox]] = deque(maxlen=CAPACITY)

    def ask(self) -> int:
        """Asks once more, and returns when, ns."""
        asked_ns = self._clock.monotonic_ns()
        self._open.append((asked_ns, self._bus.ask(self._key)))
        return asked_ns

    def poll(self) -> Answer | None:
        """Returns an answer that has come, or None; never waits."""
        for asked_ns, inbox in self._open:
            if (reply := inbox.poll()) is not None:
                return Answer(asked_ns, *reply)
        return None
