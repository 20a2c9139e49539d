"""A network in one process with faulty ways: cut, one-way, slow, lossy, doubling, disordering,
corrupting.

A way leads from one member to another. A cut way keeps the messages, like a transport that
sends again. If the way is mended soon, the messages arrive in one burst. A cut as long as a
lease ends the connection: the kept messages are lost, and each side sees the other's liveliness
token disappear until the way is mended. A flipped bit ends the connection at once, because TLS
finds the bit and delivers nothing (tests/net/test_member_keys.py). An invalid message of a
member itself arrives as it was sent.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from random import Random

from tests.net.local_bus import LocalBus, LocalNetwork
from tests.sites.relay import Relay
from trilat_net.net.bus import RING_CAPACITY, Inbox, StampedInbox, T, matches_key

LEASE_NS = 1_000_000_000
"""A fifth of what `trilat_net.net.zenoh_config` sets, so that connections end within a session of 5 s."""
KEPT = 4096
"""Messages that a transport keeps while its way is cut."""

Deliver = Callable[[str, bytes], None]


@dataclass
class Way:
    """The treatment of messages from one member to another.

    Attributes:
        cut_ns: Time since which no message passes; None if the way is open.
        ended: True once a lease has passed since the cut.
        delay_ns: Delay of every message.
        jitter_ns: Largest additional delay, so that messages overtake each other.
        loss, doubled, wrong: Shares of the sites' messages that are lost, doubled or
            corrupted; in a corrupted message one bit differs.
        tokens: Liveliness tokens of the sender that the receiver knows, while the way is cut.
        kept: Messages since the cut.
        touched: True once any of these settings was changed.
    """

    cut_ns: int | None = None
    ended: bool = False
    delay_ns: int = 0
    jitter_ns: int = 0
    loss: float = 0.0
    doubled: float = 0.0
    wrong: float = 0.0
    tokens: frozenset[str] = frozenset()
    kept: deque[Callable[[], None]] = field(default_factory=lambda: deque(maxlen=KEPT))
    touched: bool = False


class FaultyNetwork(LocalNetwork):
    """The network of some members on a relay's time; random draws follow a seed."""

    def __init__(self, relay: Relay, seed: int) -> None:
        super().__init__()
        self._relay = relay
        self._chance = Random(seed)
        self._ways: dict[tuple[str, str], Way] = {}
        self.changes = 0
        """Counts how often a member has joined, left or subscribed."""

    def join_as(self, name: str) -> "FaultyBus":
        member = FaultyBus(self, name)
        self.changes += 1
        self.members.append(member)
        return member

    def way(self, sender: str, receiver: str) -> Way:
        """Returns the way between two members, for a change of its settings; later starts keep
        the way.
        """
        way = self._way(sender, receiver)
        way.touched = True
        return way

    def _way(self, sender: str, receiver: str) -> Way:
        if (sender, receiver) not in self._ways:
            self._ways[sender, receiver] = Way()
        return self._ways[sender, receiver]

    def open(self, sender: str, receiver: str) -> bool:
        return self._way(sender, receiver).cut_ns is None

    def find_takers(
        self, sender: LocalBus, name: str, key: str
    ) -> Iterator[tuple[Way, Deliver]]:
        """Yields the ways and sinks of all members that receive a message under a key."""
        for member in self.members:
            if member is not sender:
                for expression, sink in member._sinks:
                    if matches_key(expression, key):
                        yield self._way(name, _name(member)), sink

    def carry(self, way: Way, key: str, payload: bytes, sink: Deliver) -> None:
        chance = self._chance
        if way.cut_ns is not None:
            if not way.ended:
                way.kept.append(lambda: sink(key, payload))
            return
        # the others are sent again by the transport
        often = key.endswith(("/sample", "/state", "/link"))
        if often and way.loss and chance.random() < way.loss:
            return
        if often and way.wrong and chance.random() < way.wrong:
            index = chance.randrange(len(payload))
            flipped = bytes([payload[index] ^ (1 << chance.randrange(8))])
            payload = payload[:index] + flipped + payload[index + 1 :]
        for _ in range(2 if way.doubled and chance.random() < way.doubled else 1):
            late_ns = way.delay_ns + (chance.randrange(way.jitter_ns) if way.jitter_ns else 0)
            if late_ns:
                at_ns = self._relay.now_ns + late_ns
                self._relay.happens(at_ns, lambda payload=payload: sink(key, payload))
            else:
                sink(key, payload)

    def cut(self, sender: str, receiver: str) -> None:
        """Blocks a way from now on; after a lease the connection ends in both directions."""
        way = self.way(sender, receiver)
        if way.cut_ns is not None:
            return
        way.cut_ns = since_ns = self._relay.now_ns
        way.tokens = self._tokens_of(sender)

        def end() -> None:
            if way.cut_ns == since_ns and not way.ended:
                self._end(way, receiver)

        self._relay.happens(since_ns + LEASE_NS, end)

    def disconnect(self, first: str, other: str) -> None:
        """Ends the connection of two members at once; mending their ways makes a new
        connection.
        """
        for sender, receiver in ((first, other), (other, first)):
            self.cut(sender, receiver)
            self._end(self.way(sender, receiver), receiver)

    def _end(self, way: Way, receiver: str) -> None:
        way.ended = True
        way.kept.clear()
        self._tell_presence(way.tokens, receiver, False)
        way.tokens = frozenset()

    def mend(self, sender: str, receiver: str) -> None:
        way = self.way(sender, receiver)
        kept = list(way.kept)
        now = self._tokens_of(sender)
        known = way.tokens
        way.kept.clear()
        way.cut_ns = None
        way.ended = False
        for deliver in kept:
            deliver()
        self._tell_presence(known - now, receiver, False)
        self._tell_presence(now - known, receiver, True)

    def _tokens_of(self, sender: str) -> frozenset[str]:
        return frozenset(token for member in self._named(sender) for token in member._tokens)

    def _tell_presence(self, tokens: frozenset[str], receiver: str, alive: bool) -> None:
        for token in sorted(tokens):
            for member in self._named(receiver):
                member.tell_presence(token, alive)

    def _named(self, name: str) -> Iterator["FaultyBus"]:
        return (
            member
            for member in self.members
            if isinstance(member, FaultyBus) and member.name == name
        )


class FaultyBus(LocalBus):
    """The connection of a member to a `FaultyNetwork`."""

    def __init__(self, network: FaultyNetwork, name: str) -> None:
        super().__init__(network)
        self.name = name
        self._faulty = network

    def inbox(self, key: str, capacity: int = RING_CAPACITY) -> Inbox:
        self._faulty.changes += 1
        return super().inbox(key, capacity)

    def stamped_inbox(
        self,
        key: str,
        now_ns: Callable[[], int],
        read: Callable[[bytes], T],
        capacity: int = RING_CAPACITY,
    ) -> StampedInbox[T]:
        self._faulty.changes += 1
        return super().stamped_inbox(key, now_ns, read, capacity)

    def tap(self, key: str, callback: Deliver) -> None:
        self._faulty.changes += 1
        super().tap(key, callback)

    def close(self) -> None:
        self._faulty.changes += 1
        super().close()

    def publisher(self, key: str, *, patient: bool = False) -> Callable[[bytes], None]:  # noqa: ARG002
        takers: list[tuple[Way, Deliver]] = []
        known = -1

        def publish(payload: bytes) -> None:
            nonlocal known
            if known != self._faulty.changes:  # who takes a key is looked up once
                known = self._faulty.changes
                takers[:] = self._faulty.find_takers(self, self.name, key)
            for way, sink in takers:
                if way.touched:
                    self._faulty.carry(way, key, payload, sink)
                else:
                    sink(key, payload)

        return publish

    def query(self, key: str, payload: bytes = b"") -> Inbox:
        """See `Bus`; a member that is unreachable, or cannot reach the asker, does not answer."""
        everyone = self._faulty.members
        self._faulty.members = [
            member for member in everyone if member is self or self._meets(member)
        ]
        try:
            return super().query(key, payload)
        finally:
            self._faulty.members = everyone

    def _meets(self, member: LocalBus) -> bool:
        name = _name(member)
        return self._faulty.open(self.name, name) and self._faulty.open(name, self.name)

    def _notify(self, token: str, alive: bool) -> None:
        for member in self._faulty.members:
            if member is not self and self._faulty.open(self.name, _name(member)):
                member.tell_presence(token, alive)


def _name(member: LocalBus) -> str:
    return member.name if isinstance(member, FaultyBus) else ""
