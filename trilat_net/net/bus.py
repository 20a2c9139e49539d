"""The bus: the Protocol of a member's network connection, and an in-process implementation for tests.

Invariant: an arriving message triggers no more in a site than a stamp, an append or a short reply. Messages
wait in bounded rings until the loop polls them; on overflow the oldest is dropped. Stamped rings count the
loss; elsewhere the receiver sees it in the tick numbers. Only the recorder takes callbacks.

`zenoh_bus` is the real implementation; `LocalBus` joins members of one process. Both pass the same contract
tests.
"""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, Protocol, TypeVar

RING_CAPACITY = 16_384
"""Messages that a ring holds: sixteen seconds of one peer at 1 kHz."""


T = TypeVar("T")


class Inbox(Protocol):
    """A bounded ring of messages."""

    def poll(self) -> tuple[str, bytes] | None:
        """Returns the oldest message (key, payload), or None; never waits."""


class StampedInbox(Protocol):
    """A bounded ring of messages with the instants at which they arrived."""

    @property
    def overflowed(self) -> int:
        """How many messages the full ring has lost, oldest first."""

    def poll(self) -> tuple[bytes, int] | None:
        """Returns the oldest message (payload, instant of its arrival in ns), or None; never waits."""


class PresenceInbox(Protocol):
    """A bounded ring of liveliness changes."""

    def poll(self) -> tuple[str, bool] | None:
        """Returns the oldest change (key, whether it is alive now), or None; never waits."""


class Query(Protocol):
    """A question that waits for an answer."""

    @property
    def payload(self) -> bytes:
        """What the asker sent with it; b"" if nothing."""

    def answer(self, payload: bytes) -> None:
        """Answers it."""


class QueryInbox(Protocol):
    """A bounded ring of questions."""

    def poll(self) -> Query | None:
        """Returns the oldest question, or None; never waits."""


class Bus(Protocol):
    """One member's connection."""

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:
        """Returns what publishes a payload under a key; it drops rather than waits.

        Args:
            key: without wildcards.
            patient: wait for room rather than drop, seconds at most: for who has no tick to meet and must
                not lose what it publishes, as a replay.
        """

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """Returns a ring that fills with what others publish under a key expression."""

    def stamped(self, key: str, now_ns: Callable[[], int], capacity: int = RING_CAPACITY) -> StampedInbox:
        """Returns a ring whose messages are stamped by `now_ns` as they come, in a thread of the bus."""

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """Calls back with (key, payload) as messages come, in a thread of the bus."""

    def questions(self, key: str) -> QueryInbox:
        """Returns a ring of the questions that others ask under a key."""

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """Answers questions under a key at once, in a thread of the bus.

        Args:
            key: without wildcards.
            answer: takes what the asker sent and returns what to answer, or None for no answer; short,
                because what arrives meanwhile waits, and without exceptions.
        """

    def ask(self, key: str, payload: bytes = b"") -> Inbox:
        """Asks everyone who answers under a key expression; answers come into the ring as they come."""

    def announce(self, key: str) -> None:
        """Declares a liveliness token, which disappears with the member."""

    def presence(self, key: str) -> PresenceInbox:
        """Returns a ring of the tokens that appear and disappear, those that stand already first."""

    def close(self) -> None:
        """Leaves; safe to call again."""


def matches_key(expression: str, key: str) -> bool:
    """True where a key expression includes a key: `*` is one chunk, `**` any number, `$*` part of one."""
    return _match(expression.split("/"), key.split("/"))


def _match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    if pattern[0] == "**":
        return any(_match(pattern[1:], chunks[n:]) for n in range(len(chunks) + 1))
    return bool(chunks) and _match_chunk(pattern[0], chunks[0]) and _match(pattern[1:], chunks[1:])


def _match_chunk(pattern: str, chunk: str) -> bool:
    if "$*" not in pattern:
        return pattern in ("*", chunk)
    first, *rest = pattern.split("$*")
    if not chunk.startswith(first):
        return False
    at = len(first)
    for part in rest[:-1]:
        at = chunk.find(part, at) + len(part)
        if at < len(part):
            return False
    return len(chunk) - at >= len(rest[-1]) and chunk.endswith(rest[-1])


class _Ring(Generic[T]):
    """A bounded ring of anything; what overflows is lost oldest first."""

    def __init__(self, capacity: int = RING_CAPACITY) -> None:
        self._entries: deque[T] = deque(maxlen=capacity)

    def put(self, entry: T) -> None:
        """Adds an entry."""
        self._entries.append(entry)

    def poll(self) -> T | None:
        """Returns the oldest entry, or None."""
        return self._entries.popleft() if self._entries else None


class StampingRing:
    """The `StampedInbox` of every bus; `take` may run in another thread than `poll`.

    Args:
        now_ns: the time.
        capacity: how many messages it holds, 1 or more.

    Attributes:
        overflowed: see `StampedInbox`; every message taken is polled, waits, or is counted here.
    """

    def __init__(self, now_ns: Callable[[], int], capacity: int) -> None:
        self.overflowed = 0
        self._now_ns, self._capacity = now_ns, capacity
        self._entries: deque[tuple[bytes, int]] = deque()

    def take(self, payload: bytes) -> None:
        """Stamps a message and appends it."""
        self._entries.append((payload, self._now_ns()))
        # not `maxlen`: what a full deque pushes out could not be told from what `poll` has just taken
        if len(self._entries) > self._capacity:
            with suppress(IndexError):  # polled empty since the line before
                self._entries.popleft()
                self.overflowed += 1

    def poll(self) -> tuple[bytes, int] | None:
        """See `StampedInbox`."""
        try:
            return self._entries.popleft()
        except IndexError:
            return None


class _LocalQuery:
    """A question inside one process."""

    def __init__(self, key: str, payload: bytes, replies: _Ring[tuple[str, bytes]]) -> None:
        self.payload = payload
        self._key = key
        self._replies = replies

    def answer(self, payload: bytes) -> None:
        """See `Question`."""
        self._replies.put((self._key, payload))


class LocalNetwork:
    """What the `LocalBus`es of one process have in common."""

    def __init__(self) -> None:
        self.members: list[LocalBus] = []

    def join(self) -> "LocalBus":
        """Returns the connection of a new member."""
        member = LocalBus(self)
        self.members.append(member)
        return member


class LocalBus:
    """A `Bus` inside one process, without delay and without loss; made by `LocalNetwork.join`."""

    def __init__(self, network: LocalNetwork) -> None:
        self._network = network
        self._sinks: list[tuple[str, Callable[[str, bytes], None]]] = []
        self._answering: list[tuple[str, Callable[[_LocalQuery], None]]] = []
        self._watching: list[tuple[str, _Ring[tuple[str, bool]]]] = []
        self._tokens: list[str] = []

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:  # noqa: ARG002
        """See `Bus`; here is always room."""

        def publish(payload: bytes) -> None:
            for member in self._network.members:
                for expression, sink in member._sinks:
                    if member is not self and matches_key(expression, key):
                        sink(key, payload)

        return publish

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        """See `Bus`."""
        ring = _Ring[tuple[str, bytes]](capacity)
        self._sinks.append((key, lambda key, payload: ring.put((key, payload))))
        return ring

    def stamped(self, key: str, now_ns: Callable[[], int], capacity: int = RING_CAPACITY) -> StampedInbox:
        """See `Bus`."""
        ring = StampingRing(now_ns, capacity)
        self._sinks.append((key, lambda _, payload: ring.take(payload)))
        return ring

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        """See `Bus`."""
        self._sinks.append((key, callback))

    def questions(self, key: str) -> QueryInbox:
        """See `Bus`."""
        ring = _Ring[Query]()
        self._answering.append((key, ring.put))
        return ring

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        """See `Bus`."""

        def at_once(question: _LocalQuery) -> None:
            answered = answer(question.payload)
            if answered is not None:
                question.answer(answered)

        self._answering.append((key, at_once))

    def ask(self, key: str, payload: bytes = b"") -> Inbox:
        """See `Bus`."""
        replies = _Ring[tuple[str, bytes]]()
        for member in self._network.members:
            for answered, take in member._answering:
                if member is not self and matches_key(key, answered):
                    take(_LocalQuery(answered, payload, replies))
        return replies

    def announce(self, key: str) -> None:
        """See `Bus`."""
        self._tokens.append(key)
        self._tell(key, True)

    def presence(self, key: str) -> PresenceInbox:
        """See `Bus`."""
        ring = _Ring[tuple[str, bool]]()
        for member in self._network.members:
            for token in member._tokens:
                if member is not self and matches_key(key, token):
                    ring.put((token, True))
        self._watching.append((key, ring))
        return ring

    def close(self) -> None:
        """See `Bus`."""
        if self in self._network.members:
            self._network.members.remove(self)
            for token in self._tokens:
                self._tell(token, False)

    def _tell(self, token: str, alive: bool) -> None:
        for member in self._network.members:
            for expression, ring in member._watching:
                if member is not self and matches_key(expression, token):
                    ring.put((token, alive))
