"""Defines the interface of a process's network connection, and the queues of waiting messages.

The control loop of an arm must never wait for the network, and should spend little time on it.
The network connection, the `Bus`, therefore puts arriving messages into queues, from which the
loop removes them when it has time. It also publishes messages under keys, and sends and answers
queries. `zenoh_bus` implements the interface over Eclipse Zenoh. Tests implement it within one
process.

Invariant:
    - When a message arrives, the network thread only reads the time, decodes the message and
      appends it to a queue, or sends a short reply.
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
    """Interface of a queue of limited length, from which entries are removed one by one.

    A control loop reads the messages that have arrived from such queues, because reading them
    never waits. `BoundedRing` and the queues of Zenoh implement this interface.
    """

    def poll(self) -> Polled | None:
        """Removes the oldest received message from the queue and returns it, without waiting.

        Returns:
            The message. None if the queue is empty.
        """


Inbox = PolledRing[tuple[str, bytes]]
"""Queue of messages: the key and the payload of each message."""
PresenceInbox = PolledRing[tuple[str, bool]]
"""Queue of changes of presence: the key of a token, and True if the token has appeared."""
StampedInbox = PolledRing[tuple[Polled, int]]
"""Queue of decoded messages, each with its time of arrival in ns."""


class Query(Protocol):
    """Interface of a query that has arrived over the network, and that waits for a reply.

    A member (process that takes part in a session) sends a query under a key, a text that names
    the receivers. Each receiver can reply with one payload of bytes.
    """

    @property
    def payload(self) -> bytes:
        """Content of a request, as its sender encoded it. Empty if it has no content."""

    def reply(self, payload: bytes) -> None:
        """Sends the answer to the member that asked. A query can be answered once.

        Args:
            payload: The encoded reply.
        """


QueryInbox = PolledRing[Query]
"""Queue of queries that have arrived."""


class Bus(Protocol):
    """Interface of the network connection of a member, a process that takes part in a session.

    All messages, queries and signs of life of a member pass through one such connection. A
    message is a payload of bytes under a key, which is a text of parts between slashes. Keys
    that are passed for receiving may contain wildcards: `*` stands for one part, and `**` for
    any number of parts. `ZenohBus` implements this interface for a real network.
    """

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """Returns a function that publishes payloads under a key.

        Args:
            key: The key, without wildcards.
            patient: False if a payload is dropped when the network is too slow. True if the
                function waits instead, for some seconds at most. Senders that have no control
                loop and must not lose messages use True.
        """

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """Returns a queue of the messages that other processes publish under a key.

        Args:
            key: The key, which may contain wildcards.
            capacity: Number of messages that the queue holds. If it is full, the oldest message
                is dropped.
        """

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        """Returns a queue whose messages are decoded on arrival, with their times of arrival.

        The time of arrival is read in the network thread that receives the message. It is
        therefore correct even if the owner of the queue reads the message much later.

        Args:
            key: The key, which may contain wildcards.
            now_ns: Function that reads the local clock, in ns.
            read: Function that decodes a payload, in a network thread. It must not raise an
                error. `bytes` leaves the payload as it is.
            capacity: Number of messages that the queue holds. If it is full, the oldest message
                is dropped.
        """

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Calls a function for every message under a key, as soon as the message arrives.

        Args:
            key: The key, which may contain wildcards.
            callback: Function that receives the key and the payload of each message. It is
                called in a network thread, and must be fast.
        """

    def query_inbox(self, key: str) -> QueryInbox:
        """Returns a queue of the requests that other processes send under a key.

        The caller removes the queries from the queue, and replies to them when it has time. In
        contrast, `respond` replies at once.

        Args:
            key: The key, which may contain wildcards.
        """

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Replies to requests under a key at once, in a network thread.

        The calculation of the reply must therefore be short.

        Args:
            key: The key, which may contain wildcards.
            answer: Function that receives the payload of a query, and returns the payload of
                the reply. It returns None to send no reply. It must be fast, because messages
                wait meanwhile, and must not raise an error.
        """

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """Sends a request to all processes that serve a matching key, and collects the replies.

        Args:
            key: The key, which may contain wildcards.
            payload: Payload of the query.

        Returns:
            A queue into which the replies are put as they arrive. It stays empty if no member
            replies.
        """

    def announce(self, key: str) -> None:
        """Shows other processes that this one is present, by a liveliness token of Zenoh.

        The token disappears when the connection is closed or lost.

        Args:
            key: Key of the token, which contains the name of this member.
        """

    def presence(self, key: str) -> PresenceInbox:
        """Returns a queue that tells which other members have appeared or disappeared.

        Each member is represented by a liveliness token, see `announce`. An entry of the queue
        is the key of a token, and True if the token has appeared, or False if it has
        disappeared. The first entries are the tokens that exist already.

        Args:
            key: Key of the tokens, which may contain wildcards.
        """

    def close(self) -> None:
        """Closes the network connection, so that other processes see that this one is gone.

        Calling it again has no effect.
        """


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
    """A queue of limited length between two threads, which drops its oldest entry if full.

    A control loop, for example, needs the newest messages rather than all. One thread may call
    `put` while another thread calls `poll`.

    Args:
        capacity: Number of entries that the queue holds.
    """

    def __init__(self, capacity: int = RING_CAPACITY) -> None:
        self._entries: deque[T] = deque(maxlen=capacity)

    def put(self, entry: T) -> None:
        """Adds an entry to the queue without waiting. A full queue drops its oldest entry."""
        self._entries.append(entry)

    def poll(self) -> T | None:
        """Removes the oldest entry from the queue and returns it, without waiting.

        Returns:
            The entry. None if the queue is empty.
        """
        return self._entries.popleft() if self._entries else None


class StampingRing(BoundedRing[tuple[T, int]]):
    """A queue of messages that are decoded on arrival, with their times of arrival.

    One thread may call `receive` while another thread calls `poll`.

    The time is read before a message is decoded, so that the time of decoding does not count as
    a delay of the network.

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
        """Decodes a message, and adds it to the queue with its time of arrival.

        The clock is read before the message is decoded. If the queue is full, the oldest
        message is dropped.

        Args:
            payload: The encoded message.
        """
        now_ns = self._now_ns()
        self._entries.append((self._read(payload), now_ns))
