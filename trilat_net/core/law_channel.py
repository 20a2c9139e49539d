"""What a control law sends to its peers besides the motion and the exogenous torque of its
record.

Invariant: a law declares its vectors once; their numbers stand one behind the other in the
field `ch` of its record and of its sample: first the vectors that go to all peers, then per
peer, in scenario order, those that go to that peer alone. A receiver takes the first part and
its own; what it took in is thereby found in the sender's record.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from ..errors import count_nouns

MAX_SENT = 16
"""Most numbers per joint that a law sends to a peer."""
MAX_RECORD_SENT = 1024
"""Most numbers that a law sends to all its peers together, which are in the record of every
tick.
"""


class SentVector(NamedTuple):
    """A vector that a law sends at every tick.

    Attributes:
        name: its name, as the law uses it.
        unit: of its numbers.
        length: how many numbers it has.
        per_peer: true: another one for each peer; false: the same for all.
    """

    name: str
    unit: str
    length: int
    per_peer: bool = False


class SentEntry(NamedTuple):
    """One number of what a law sends.

    Attributes:
        vector: the vector that it belongs to.
        peer: the peer that it goes to, or "": to all.
        place: its place in the vector.
    """

    vector: SentVector
    peer: str
    place: int

    @property
    def key(self) -> str:
        """The vector's name, and in brackets the peer that it goes to alone: "E", "u[m2]"."""
        return f"{self.vector.name}[{self.peer}]" if self.peer else self.vector.name

    def __str__(self) -> str:
        return f"{self.key}[{self.place}]"


class LawChannel(NamedTuple):
    """All that the law of a site sends.

    Attributes:
        vectors: those for all peers before those of each peer.
        peers: how many peers the site has.
    """

    vectors: tuple[SentVector, ...] = ()
    peers: int = 0

    def select_vectors(self, *, per_peer: bool) -> tuple[SentVector, ...]:
        """Returns the vectors that go to each peer alone, or to all."""
        return tuple(vector for vector in self.vectors if vector.per_peer is per_peer)

    def count_numbers(self, *, per_peer: bool) -> int:
        """Returns how many numbers go to each peer alone, or to all."""
        return sum(vector.length for vector in self.select_vectors(per_peer=per_peer))

    @property
    def received_size(self) -> int:
        """How many numbers one peer gets."""
        return sum(vector.length for vector in self.vectors)

    @property
    def record_size(self) -> int:
        """How many numbers stand in a record."""
        return self.count_numbers(per_peer=False) + self.peers * self.count_numbers(
            per_peer=True
        )

    def find_columns(self, vectors: Sequence[SentVector]) -> list[int]:
        """Returns where each number of some vectors stands in a peer's part; -1: it is not
        sent.
        """
        first = 0
        firsts = {}
        for vector in self.vectors:
            firsts[vector.name] = first
            first += vector.length
        return [
            firsts[vector.name] + n if vector.name in firsts else -1
            for vector in vectors
            for n in range(vector.length)
        ]

    def entries(self, peers: Sequence[str]) -> Iterator[SentEntry]:
        """Yields what each number of a record is, in order; `peers` are the names of the site's
        peers.
        """
        for per_peer, places in ((False, ("",)), (True, peers)):
            for peer in places:
                for vector in self.vectors:
                    if vector.per_peer is per_peer:
                        yield from (SentEntry(vector, peer, n) for n in range(vector.length))

    def select_for_peer(self, sent: Sequence[float], place: int) -> Sequence[float]:
        """Returns what the peer at a place among the sender's peers gets of a record's numbers."""
        own = self.count_numbers(per_peer=True)
        common = self.count_numbers(per_peer=False)
        if not own:
            return sent
        first = common + place * own
        return [*sent[:common], *sent[first : first + own]]


def join_received(channels: Sequence[LawChannel]) -> tuple[SentVector, ...]:
    """Returns the vectors that a law may receive from any of its peers, each name once.

    Raises:
        ValueError: two peers send vectors of one name and of different lengths.
    """
    found: dict[str, SentVector] = {}
    for vector in (vector for channel in channels for vector in channel.vectors):
        other = found.setdefault(vector.name, vector)
        if other.length != vector.length:
            raise ValueError(
                f"peers send {vector.name} of {other.length} and of {count_nouns(vector.length, 'number')}"
            )
    return tuple(found.values())
