"""Defines the interface of a member's network connection, and the queues of waiting messages.

A member is a process that takes part in a session. Its network connection, the bus, publishes
messages under keys, receives the messages of other members, and sends and answers queries.
`zenoh_bus` implements the interface over Eclipse Zenoh. Tests implement it within one process.

Invariant:
    - When a message arrives, the network thread of a site only reads the time, decodes the
      message and appends it to a queue, or sends a short reply. The control loop therefore
      loses little time to network threads.
    - Messages wait in queues of limited length until the control loop polls them. If a queue is
      full, the oldest message is dropped. The receiver notices the gap because messages are
      numbered.
    - Only the recorder receives messages by a callback (`Bus.tap`).
"""

import re
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import Generic, Protocol, TypeVar

RING_CAPACITY = 16_384
"""Number of messages that a queue holds: those of one peer in sixteen seconds at 1 kHz."""

T = TypeVar("T")
Polled = TypeVar("Polled", covariant=True)


class PolledRing(Protocol[Polled]):
    """A queue of limited length, for entries that have arrived."""

    def poll(self) -> Polled | None:
        """Removes the oldest entry and returns it, or None if the queue is empty.

        It never waits.
        """


Inbox = PolledRing[tuple[str, bytes]]
"""Queue of messages: the key and the payload of each message."""
PresenceInbox = PolledRing[tuple[str, bool]]
"""Queue of changes of presence: the key of a token, and True if the token has appeared."""
StampedInbox = PolledRing[tuple[Polled, int]]
"""Queue of decoded messages, each with its time of arrival in ns."""


class Query(Protocol):
    """A query that has arrived and waits for a reply."""

    @property
    def payload(self) -> bytes:
        """Payload of the query. Empty if there is none."""

    def reply(self, payload: bytes) -> None:
        """Sends the reply to the query."""


QueryInbox = PolledRing[Query]
"""Queue of queries that have arrived."""


class Bus(Protocol):
    """Network connection of one member.

    Keys that are passed for receiving may contain wildcards: `*` for one part of a key, `**`
    for any number of parts.
    """

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """Returns a function that publishes payloads under a key.

        Args:
            key: The key.
            patient: False if a payload is dropped when the network is too slow. True if the
                function waits instead, for some seconds at most. That is for senders without a
                control loop that must not lose messages.
        """

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """Returns a queue of the messages that other members publish under a key.

        Args:
            key: The key.
            capacity: Number of messages that the queue holds.
        """

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        """Returns a queue whose messages are decoded on arrival, with their times of arrival.

        Args:
            key: The key.
            now_ns: Function that reads the local clock, in ns.
            read: Function that decodes a payload, in a network thread. It must not raise an
                error. `bytes` leaves the payload as it is.
            capacity: Number of messages that the queue holds.
        """

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Calls `callback(key, payload)` for every message under a key, in a network thread."""

    def query_inbox(self, key: str) -> QueryInbox:
        """Returns a queue of the queries that other members send under a key."""

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Replies to the queries under a key at once, in a network thread.

        Args:
            key: The key.
            answer: Function that returns the payload of the reply to a payload, or None for no
                reply. It must be fast, because messages wait meanwhile, and must not raise an
                error.
        """

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """Sends a query to all members that serve a matching key.

        Args:
            key: The key.
            payload: Payload of the query.

        Returns:
            A queue for the replies.
        """

    def announce(self, key: str) -> None:
        """Declares a liveliness token, which shows other members that this member is present.

        The token disappears when the connection is closed or lost.

        Args:
            key: Key of the token.
        """

    def presence(self, key: str) -> PresenceInbox:
        """Returns a queue of the tokens that appear and disappear under a key.

        The first entries are the tokens that exist already.

        Args:
            key: The key.
        """

    def close(self) -> None:
        """Closes the connection. Calling it again has no effect."""


@lru_cache(256)
def _compile_expression(expression: str) -> re.Pattern[str]:
    """Converts a key with wildcards to a regular expression, see `matches_key`.

    The regular expression matches keys with a leading slash, so that every part of a key has
    the same form: a slash and some characters.
    """
    one_part = "/[^/]+"
    pattern = ""
    for part in expression.split("/"):
        if part == "**":
            pattern += f"(?:{one_part})*"
        elif part == "*":
            pattern += one_part
        else:
            literals = map(re.escape, part.split("$*"))
            pattern += "/" + "[^/]*".join(literals)
    return re.compile(pattern)


def matches_key(expression: str, key: str) -> bool:
    """Returns True if a key with wildcards matches a key, by the rules of Zenoh.

    Keys consist of parts between slashes. The wildcard `*` stands for one part, `**` for any
    number of parts, and `$*` for any characters within a part.

    Args:
        expression: Key with wildcards.
        key: Key without wildcards.
    """
    return _compile_expression(expression).fullmatch("/" + key) is not None


class BoundedRing(Generic[T]):
    """A queue of limited length, which drops its oldest entry if it is full.

    One thread may call `put` while another thread calls `poll`.

    Args:
        capacity: Number of entries that the queue holds.
    """

    def __init__(self, capacity: int = RING_CAPACITY) -> None:
        self._entries: deque[T] = deque(maxlen=capacity)

    def put(self, entry: T) -> None:
        """Adds an entry. If the queue is full, the oldest entry is dropped."""
        self._entries.append(entry)

    def poll(self) -> T | None:
        """Removes the oldest entry and returns it, or None if the queue is empty."""
        return self._entries.popleft() if self._entries else None


class StampingRing(BoundedRing[tuple[T, int]]):
    """A queue of messages that are decoded on arrival, with their times of arrival.

    One thread may call `receive` while another thread calls `poll`.

    Args:
        now_ns: Function that reads the local clock, in ns.
        read: Function that decodes a payload. It must not raise an error.
        capacity: Number of messages that the queue holds.
    """

    def __init__(
        self, now_ns: Callable[[], int], read: Callable[[bytes], T], capacity: int
    ) -> None:
        super().__init__(capacity)
        self._now_ns = now_ns
        self._read = read

    def receive(self, payload: bytes) -> None:
        """Adds a message. The time is read before the message is decoded."""
        now_ns = self._now_ns()
        self._entries.append((self._read(payload), now_ns))
