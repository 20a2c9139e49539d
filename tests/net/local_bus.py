"""A `Bus` inside one process, without delay or loss; it passes the same contract tests as `ZenohBus`."""

from collections.abc import Callable
from typing import NamedTuple

from trilat_net.net.bus import (
    RING_CAPACITY,
    BoundedRing,
    Inbox,
    PresenceInbox,
    Query,
    QueryInbox,
    StampedInbox,
    StampingRing,
    T,
    matches_key,
)


class _LocalQuery(NamedTuple):
    key: str
    payload: bytes
    replies: BoundedRing[tuple[str, bytes]]

    def reply(self, payload: bytes) -> None:
        self.replies.put((self.key, payload))


class LocalNetwork:
    def __init__(self) -> None:
        self.members: list[LocalBus] = []

    def join(self) -> "LocalBus":
        member = LocalBus(self)
        self.members.append(member)
        return member


class LocalBus:
    def __init__(self, network: LocalNetwork) -> None:
        self._network = network
        self._sinks: list[tuple[str, Callable[[str, bytes], None]]] = []
        self._responders: list[tuple[str, Callable[[_LocalQuery], None]]] = []
        self._presence_rings: list[tuple[str, BoundedRing[tuple[str, bool]]]] = []
        self._tokens: list[str] = []

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:  # noqa: ARG002
        """See `Bus`; the queue always has room."""

        def publish(payload: bytes) -> None:
            for member in self._network.members:
                for expression, sink in member._sinks:
                    if member is not self and matches_key(expression, key):
                        sink(key, payload)

        return publish

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        ring = BoundedRing[tuple[str, bytes]](capacity)
        self._sinks.append((key, lambda key, payload: ring.put((key, payload))))
        return ring

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        ring = StampingRing(now_ns, read, capacity)
        self._sinks.append((key, lambda _, payload: ring.receive(payload)))
        return ring

    def tap(self, key: str, callback: Callable[[str, bytes], None]) -> None:
        self._sinks.append((key, callback))

    def query_inbox(self, key: str) -> QueryInbox:
        ring = BoundedRing[Query]()
        self._responders.append((key, ring.put))
        return ring

    def respond(self, key: str, answer: Callable[[bytes], bytes | None]) -> None:
        def answer_at_once(query: _LocalQuery) -> None:
            answered = answer(query.payload)
            if answered is not None:
                query.reply(answered)

        self._responders.append((key, answer_at_once))

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        replies = BoundedRing[tuple[str, bytes]]()
        for member in self._network.members:
            for answered, take in member._responders:
                if member is not self and matches_key(key, answered):
                    take(_LocalQuery(answered, payload, replies))
        return replies

    def announce(self, key: str) -> None:
        self._tokens.append(key)
        self._notify(key, True)

    def presence(self, key: str) -> PresenceInbox:
        ring = BoundedRing[tuple[str, bool]]()
        for member in self._network.members:
            for token in member._tokens:
                if member is not self and matches_key(key, token):
                    ring.put((token, True))
        self._presence_rings.append((key, ring))
        return ring

    def close(self) -> None:
        if self in self._network.members:
            self._network.members.remove(self)
            for token in self._tokens:
                self._notify(token, False)

    def _notify(self, token: str, alive: bool) -> None:
        for member in self._network.members:
            if member is not self:
                member.tell_presence(token, alive)

    def tell_presence(self, token: str, alive: bool) -> None:
        for expression, ring in self._presence_rings:
            if matches_key(expression, token):
                ring.put((token, alive))
