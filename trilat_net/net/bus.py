"""The bus: the protocol of a member's network connection, and the rings of waiting messages.

`zenoh_bus` implements the protocol over Eclipse Zenoh.

Invariant:
    - For an arriving message, a site's bus thread does no more than stamp and decode the
      message, and append it or send a short reply. The decoding function raises nothing.
    - Messages wait in bounded rings until the loop polls them. On overflow the oldest message
      is dropped; the receiver notices the gap by the numbers of the messages.
    - Only the recorder uses callbacks (`Bus.tap`).
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
    """A bounded ring of entries that have arrived."""

    def poll(self) -> Polled | None:
        """Returns the oldest entry, or None; never waits."""


Inbox = PolledRing[tuple[str, bytes]]
"""Messages: (key, payload)."""
PresenceInbox = PolledRing[tuple[str, bool]]
"""Liveliness changes: (key, True if the token is alive now)."""
StampedInbox = PolledRing[tuple[Polled, int]]
"""Messages with their arrival times: (decoded message, ns)."""


class Query(Protocol):
    """A query that waits for a reply."""

    @property
    def payload(self) -> bytes:
        """The payload of the query; b"" if the query has no payload."""

    def reply(self, payload: bytes) -> None:
        """Replies to the query."""


QueryInbox = PolledRing[Query]


class Bus(Protocol):
    """Network connection of one member."""

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """Returns a function that publishes payloads under a key.

        Args:
            key: the key.
            patient: False to drop a payload rather than wait for room. True to wait for room,
                for at most some seconds: for senders without ticks that must lose nothing.
        """

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """Returns a ring of the messages that other members publish under a key expression."""

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        """Returns a ring whose messages are stamped and decoded on arrival, in a bus thread.

        Args:
            key: key expression of the messages.
            now_ns: clock that stamps the arrivals.
            read: decodes a payload, and raises nothing; `bytes` keeps the payload as it is.
            capacity: number of messages that the ring holds.
        """

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Calls `callback(key, payload)` for every arriving message, in a thread of the bus."""

    def query_inbox(self, key: str) -> QueryInbox:
        """Returns a ring of the queries that other members send under a key."""

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Replies to queries under a key at once, in a thread of the bus.

        Args:
            key: the key.
            answer: returns the reply to a payload, or None for no reply. The function must be
                short, because messages wait meanwhile, and must raise nothing.
        """

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """Queries all members under a key expression, and returns the ring of their replies."""

    def announce(self, key: str) -> None:
        """Declares a liveliness token, which disappears together with this member."""

    def presence(self, key: str) -> PresenceInbox:
        """Returns a ring of the tokens that appear and disappear; present tokens come first."""

    def close(self) -> None:
        """Closes the connection; repeated calls have no effect."""


@lru_cache(256)
def _compile_expression(expression: str) -> re.Pattern[str]:
    """Returns the regular expression of a key expression, for keys behind a slash."""
    pattern = ""
    for chunk in expression.split("/"):
        if chunk == "**":
            pattern += "(?:/[^/]+)*"
        elif chunk == "*":
            pattern += "/[^/]+"
        else:
            literals = map(re.escape, chunk.split("$*"))
            pattern += "/" + "[^/]*".join(literals)
    return re.compile(pattern)


def matches_key(expression: str, key: str) -> bool:
    """Returns True if a key expression matches a key.

    In an expression, `*` stands for one chunk, `**` for any number of chunks, and `$*` for any
    part of a chunk.
    """
    return _compile_expression(expression).fullmatch("/" + key) is not None


class BoundedRing(Generic[T]):
    """A bounded ring, which drops its oldest entry on overflow.

    One thread may call `put` while another thread calls `poll`.

    Args:
        capacity: largest number of entries.
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
    """The `StampedInbox` of every bus.

    One thread may call `receive` while another thread calls `poll`.

    Args:
        now_ns: clock that stamps the arrivals.
        read: decodes a payload, and raises nothing.
        capacity: largest number of entries.
    """

    def __init__(
        self, now_ns: Callable[[], int], read: Callable[[bytes], T], capacity: int
    ) -> None:
        super().__init__(capacity)
        self._now_ns = now_ns
        self._read = read

    def receive(self, payload: bytes) -> None:
        """Stamps an arriving message, decodes it and appends it."""
        now_ns = self._now_ns()
        self._entries.append((self._read(payload), now_ns))
