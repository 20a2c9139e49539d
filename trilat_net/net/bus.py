"""The bus: the Protocol of a member's network connection, and the rings in which messages wait.

Invariant: an arriving message triggers no more in a site than a stamp, its reading, an append
or a short reply; what reads it raises nothing. Messages wait in bounded rings until the loop
polls them; on overflow the oldest is dropped, which the receiver sees in the numbers of the
messages. Only the recorder takes callbacks.

`zenoh_bus` implements it.
"""

import re
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import Generic, Protocol, TypeVar

RING_CAPACITY = 16_384
"""Capacity of a ring in messages: sixteen seconds of one peer at 1 kHz."""

T = TypeVar("T")
Polled = TypeVar("Polled", covariant=True)


class PolledRing(Protocol[Polled]):
    """A bounded ring of what has arrived."""

    def poll(self) -> Polled | None:
        """Returns the oldest entry, or None; never waits."""


Inbox = PolledRing[tuple[str, bytes]]
"""Messages: (key, payload)."""
PresenceInbox = PolledRing[tuple[str, bool]]
"""Liveliness changes: (key, whether it is alive now)."""
StampedInbox = PolledRing[tuple[Polled, int]]
"""Messages with the instants of their arrival: (what was read, ns)."""


class Query(Protocol):
    """A query that waits for an answer."""

    @property
    def payload(self) -> bytes:
        """The payload of the query; b"" without one."""

    def reply(self, payload: bytes) -> None:
        """Answers it."""


QueryInbox = PolledRing[Query]


class Bus(Protocol):
    """One member's connection."""

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """Returns a function that publishes a payload under a key and drops it rather than
        wait.

        A patient one waits for room, some seconds at most: for a sender without ticks that must
        lose nothing.
        """

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """Returns a ring of the messages that others publish under a key expression."""

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        """Returns a ring whose messages are stamped by `now_ns` on arrival, and then read, in a
        bus thread.

        `read` turns a payload into the entry (`bytes`: itself); it is short, and raises
        nothing.
        """

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Calls back with (key, payload) on arrival, in a thread of the bus."""

    def query_inbox(self, key: str) -> QueryInbox:
        """Returns a ring of the queries of others under a key."""

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Answers queries under a key at once, in a thread of the bus; None is no answer.

        `answer` is short, because messages wait meanwhile, and raises nothing.
        """

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """Queries all who answer under a key expression; returns the ring of their answers."""

    def announce(self, key: str) -> None:
        """Declares a liveliness token, which disappears with the member."""

    def presence(self, key: str) -> PresenceInbox:
        """Returns a ring of tokens that appear and disappear, beginning with the present ones."""

    def close(self) -> None:
        """Leaves; may be called again."""


@lru_cache(256)
def _compile_expression(expression: str) -> re.Pattern[str]:
    chunks = []
    for chunk in expression.split("/"):
        literals = map(re.escape, chunk.split("$*"))
        chunks.append(
            {"**": "(?:/[^/]+)*", "*": "/[^/]+"}.get(chunk, "/" + "[^/]*".join(literals))
        )
    return re.compile("".join(chunks))


def matches_key(expression: str, key: str) -> bool:
    """True if a key expression includes a key: `*` is one chunk, `**` any number, `$*` part of
    one.
    """
    return _compile_expression(expression).fullmatch("/" + key) is not None


class BoundedRing(Generic[T]):
    """A bounded ring; on overflow it drops the oldest entry. `put` may run in another thread
    than `poll`.
    """

    def __init__(self, capacity: int = RING_CAPACITY) -> None:
        self._entries: deque[T] = deque(maxlen=capacity)

    def put(self, entry: T) -> None:
        """Adds the newest entry."""
        self._entries.append(entry)

    def poll(self) -> T | None:
        """See `PolledRing`."""
        return self._entries.popleft() if self._entries else None


class StampingRing(BoundedRing[tuple[T, int]]):
    """The `StampedInbox` of every bus; `take` may run in another thread than `poll`."""

    def __init__(
        self, now_ns: Callable[[], int], read: Callable[[bytes], T], capacity: int
    ) -> None:
        super().__init__(capacity)
        self._now_ns = now_ns
        self._read = read

    def receive(self, payload: bytes) -> None:
        """Stamps a message, reads it and appends it."""
        now_ns = self._now_ns()
        self._entries.append((self._read(payload), now_ns))
