"""Defines the network connection of a process, and the queues for its incoming messages.

The control loop of an arm must never wait for the network, and should spend little time on it.
The network connection (`Bus`) therefore puts incoming messages into queues, which the loop
reads when it has time. A bus also publishes messages under keys, and sends and answers queries.
`zenoh_bus` implements the interface with Eclipse Zenoh; the tests implement it within a single
process.

Invariant:
    - When a message arrives, the network thread only reads the clock, decodes the message and
      appends it to a queue, or sends a short reply.
    - Messages wait in queues of limited length until the control loop polls them. If a queue is
      full, the oldest message is dropped. The receiver detects the gap from the message
      numbers.
    - Only the recorder receives messages through a callback (`Bus.tap`).
"""

import re
from collections import deque
from collections.abc import Callable
from functools import lru_cache
from typing import Generic, Protocol, TypeVar

RING_CAPACITY = 16_384
"""Number of messages that a queue can hold: those of one peer in sixteen seconds at 1 kHz."""

T = TypeVar("T")
Polled = TypeVar("Polled", covariant=True)


class PolledRing(Protocol[Polled]):
    """Interface of a bounded queue that is read one entry at a time, without waiting.

    Control loops read incoming messages from such queues. `BoundedRing` and the queues of Zenoh
    implement this interface.
    """

    def poll(self) -> Polled | None:
        """Removes and returns the oldest message, or returns None if the queue is empty.

        Never waits.
        """


Inbox = PolledRing[tuple[str, bytes]]
"""Queue of messages, each given by its key and payload."""
PresenceInbox = PolledRing[tuple[str, bool]]
"""Queue of presence changes: the key of a token, and True if the token has appeared."""
StampedInbox = PolledRing[tuple[Polled, int]]
"""Queue of decoded messages, each with its time of arrival in ns."""


class Query(Protocol):
    """Interface of a query that has arrived over the network and is waiting for a reply.

    A member sends a query under a key that selects the receivers. Each receiver can reply once,
    with a payload of bytes.
    """

    @property
    def payload(self) -> bytes:
        """Content of the query, as encoded by its sender. Empty if the query has no content."""

    def reply(self, payload: bytes) -> None:
        """Sends a reply to the member that made the query. A query can be answered only once.

        Args:
            payload: The encoded reply.
        """


QueryInbox = PolledRing[Query]
"""Queue of queries that have arrived."""


class Bus(Protocol):
    """Interface of a member's connection to the network.

    All messages, queries and liveliness tokens of a member pass through one connection. A
    message is a payload of bytes published under a key, which is a string of parts separated by
    slashes. Keys used for receiving may contain wildcards: `*` matches one part, and `**` any
    number of parts. `ZenohBus` implements this interface for a real network.
    """

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """Returns a function that publishes payloads under a key.

        Args:
            key: The key, without wildcards.
            patient: If False, a payload is dropped when the network cannot keep up. If True,
                the function waits instead, for a few seconds at most. Use True for senders that
                have no control loop and must not lose messages.
        """

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """Returns a queue of the messages that other processes publish under a key.

        Args:
            key: The key, which may contain wildcards.
            capacity: Number of messages that the queue can hold. If it is full, the oldest
                message is dropped.
        """

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        """Returns a queue whose messages are decoded and time-stamped on arrival.

        The time of arrival is taken in the network thread that receives the message, so it is
        correct even if the queue is read much later.

        Args:
            key: The key, which may contain wildcards.
            now_ns: Function that reads the local clock, in ns.
            read: Function that decodes a payload in a network thread. It must not raise an
                error. Pass `bytes` to leave the payload unchanged.
            capacity: Number of messages that the queue can hold. If it is full, the oldest
                message is dropped.
        """

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Calls a function for every message under a key, as soon as the message arrives.

        Args:
            key: The key, which may contain wildcards.
            callback: Function that receives the key and payload of each message. It is called
                in a network thread and must return quickly.
        """

    def query_inbox(self, key: str) -> QueryInbox:
        """Returns a queue of the queries that other processes send under a key.

        The caller polls the queue and replies when it has time. Use `respond` to reply
        immediately.

        Args:
            key: The key, which may contain wildcards.
        """

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Answers queries under a key immediately, in a network thread.

        Args:
            key: The key, which may contain wildcards.
            answer: Function that receives the payload of a query and returns the payload of the
                reply, or None to send no reply. It must return quickly, since it blocks
                incoming messages, and must not raise an error.
        """

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """Sends a query to all processes that serve a matching key, and collects the replies.

        Args:
            key: The key, which may contain wildcards.
            payload: Payload of the query.

        Returns:
            A queue that receives the replies as they arrive. It stays empty if no member
            replies.
        """

    def announce(self, key: str) -> None:
        """Announces this process to the other members by declaring a Zenoh liveliness token.

        The token disappears when the connection is closed or lost.

        Args:
            key: Key of the token, which contains the name of this member.
        """

    def presence(self, key: str) -> PresenceInbox:
        """Returns a queue that reports which other members have appeared or disappeared.

        Each member is represented by a liveliness token, see `announce`. An entry of the queue
        consists of the key of a token and a flag, which is True if the token has appeared and
        False if it has disappeared. Tokens that already exist are reported first.

        Args:
            key: Key of the tokens, which may contain wildcards.
        """

    def close(self) -> None:
        """Closes the network connection. Other processes then see that this process has left.

        Repeated calls have no effect.
        """


@lru_cache(256)
def _compile_expression(expression: str) -> re.Pattern[str]:
    """Converts a key with wildcards to a regular expression, see `matches_key`.

    The regular expression matches keys with a leading slash, which gives every part of a key
    the same form: a slash followed by characters.
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
    """Returns True if a key matches an expression with wildcards, by the rules of Zenoh.

    Keys consist of parts separated by slashes. The wildcard `*` matches one part, `**` any
    number of parts, and `$*` any characters within a part.

    Args:
        expression: Key with wildcards.
        key: Key without wildcards.
    """
    return _compile_expression(expression).fullmatch("/" + key) is not None


class BoundedRing(Generic[T]):
    """A bounded queue between two threads that drops its oldest entry when full.

    Suited to control loops, which need the newest messages rather than all of them. One thread
    may call `put` while another calls `poll`.

    Args:
        capacity: Number of entries that the queue can hold.
    """

    def __init__(self, capacity: int = RING_CAPACITY) -> None:
        self._entries: deque[T] = deque(maxlen=capacity)

    def put(self, entry: T) -> None:
        """Appends an entry without waiting, dropping the oldest one if the queue is full."""
        self._entries.append(entry)

    def poll(self) -> T | None:
        """Removes and returns the oldest entry, or returns None if the queue is empty.

        Never waits.
        """
        return self._entries.popleft() if self._entries else None


class StampingRing(BoundedRing[tuple[T, int]]):
    """A bounded queue of messages that are decoded and time-stamped on arrival.

    One thread may call `receive` while another calls `poll`.

    Args:
        now_ns: Function that reads the local clock, in ns.
        read: Function that decodes a payload. It must not raise an error.
        capacity: Number of messages that the queue can hold.
    """

    def __init__(
        self, now_ns: Callable[[], int], read: Callable[[bytes], T], capacity: int
    ) -> None:
        super().__init__(capacity)
        self._now_ns = now_ns
        self._read = read

    def receive(self, payload: bytes) -> None:
        """Decodes a message and appends it to the queue with its time of arrival.

        The clock is read before decoding, so that the decoding time is not counted as network
        delay. If the queue is full, the oldest message is dropped.

        Args:
            payload: The encoded message.
        """
        now_ns = self._now_ns()
        self._entries.append((self._read(payload), now_ns))
