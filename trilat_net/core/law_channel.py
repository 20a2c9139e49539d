"""Describes the vectors that a control law sends to its peers besides the motion of its arm.

A peer is a site (a process that runs one arm) that exchanges its state with this site. A law
may send for example waves or energies. Some vectors go to all peers, others to one peer alone.
All these numbers stand one after another in a single row. The record of a tick, its stored
result, contains the row in the field `ch`. A peer receives the part of the row that is meant
for it, so what a site received can be found in the sender's record.

Invariant:
    - The row contains first the vectors that go to all peers. The vectors for a single peer
      follow, peer by peer in the order of the scenario, the file that describes the experiment.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from ..errors import count_nouns

MAX_SENT = 16
"""Largest count of numbers per joint that a law sends to a peer."""
MAX_RECORD_SENT = 1024
"""Largest count of numbers that a law sends to all its peers together; each record has them."""


class SentVector(NamedTuple):
    """Vector that a law sends at every tick.

    Attributes:
        name: Name of the vector, as the law uses it.
        unit: Unit of its numbers.
        length: Count of its numbers.
        per_peer: True: each peer gets its own vector; false: all peers get the same vector.
    """

    name: str
    unit: str
    length: int
    per_peer: bool = False


class SentEntry(NamedTuple):
    """One number that a law sends.

    Attributes:
        vector: Vector of the number.
        peer: Peer that alone gets the vector, or "" if all peers get it.
        position: Position of the number in the vector, from 0.
    """

    vector: SentVector
    peer: str
    position: int

    @property
    def key(self) -> str:
        """Name of the vector, followed by its receiver in brackets: "E", "u[m2]".

        There are no brackets if all peers receive the vector.
        """
        return f"{self.vector.name}[{self.peer}]" if self.peer else self.vector.name

    def __str__(self) -> str:
        return f"{self.key}[{self.position}]"


class LawChannel(NamedTuple):
    """All vectors that the law of a site sends, in the order of the record.

    Attributes:
        vectors: The vectors, those for all peers before those for each peer.
        peers: Number of the site's peers.
    """

    vectors: tuple[SentVector, ...] = ()
    peers: int = 0

    def select_vectors(self, *, per_peer: bool) -> tuple[SentVector, ...]:
        """Returns the vectors that go to all peers, or those that go to each peer alone.

        Args:
            per_peer: True: the vectors that go to each peer alone; false: those that go to all.
        """
        return tuple(vector for vector in self.vectors if vector.per_peer is per_peer)

    def count_numbers(self, *, per_peer: bool) -> int:
        """Returns how many numbers the vectors of one kind have together.

        Args:
            per_peer: True: numbers that go to each peer alone; false: numbers that go to all.
        """
        return sum(vector.length for vector in self.select_vectors(per_peer=per_peer))

    @property
    def received_size(self) -> int:
        """Count of the numbers that one peer receives with each sample."""
        return sum(vector.length for vector in self.vectors)

    @property
    def record_size(self) -> int:
        """Count of the numbers that the law sends in one tick, which its record contains."""
        to_all = self.count_numbers(per_peer=False)
        to_each = self.count_numbers(per_peer=True)
        return to_all + self.peers * to_each

    def find_columns(self, vectors: Sequence[SentVector]) -> list[int]:
        """Returns where the numbers that a peer's law reads stand among those that it receives.

        Args:
            vectors: The vectors that the law of the peer reads.

        Returns:
            An index per number. It is -1 for a vector that this law does not send.
        """
        start = 0
        starts = {}
        for vector in self.vectors:
            starts[vector.name] = start
            start += vector.length
        columns = []
        for vector in vectors:
            for n in range(vector.length):
                is_sent = vector.name in starts
                columns.append(starts[vector.name] + n if is_sent else -1)
        return columns

    def entries(self, peers: Sequence[str]) -> Iterator[SentEntry]:
        """Yields a description of each number that a record of this law contains, in order.

        Args:
            peers: Names of the site's peers, in scenario order.
        """
        to_each = self.select_vectors(per_peer=True)
        groups = [("", self.select_vectors(per_peer=False))]
        groups += [(peer, to_each) for peer in peers]
        for peer, vectors in groups:
            for vector in vectors:
                for n in range(vector.length):
                    yield SentEntry(vector, peer, n)

    def select_for_peer(self, sent: Sequence[float], peer_index: int) -> Sequence[float]:
        """Returns those of the sent numbers that one peer receives.

        Args:
            sent: All numbers that the law sent in a tick, as the record contains them.
            peer_index: Index of the peer among the sender's peers.
        """
        to_all = self.count_numbers(per_peer=False)
        to_each = self.count_numbers(per_peer=True)
        if not to_each:
            return sent
        start = to_all + peer_index * to_each
        return [*sent[:to_all], *sent[start : start + to_each]]


def join_received(channels: Sequence[LawChannel]) -> tuple[SentVector, ...]:
    """Returns all vectors that a law may receive from its peers, each name once.

    Args:
        channels: Vectors that the laws of the peers send.

    Raises:
        ValueError: Two peers send vectors with the same name and different lengths.
    """
    by_name: dict[str, SentVector] = {}
    for channel in channels:
        for vector in channel.vectors:
            other = by_name.setdefault(vector.name, vector)
            if other.length != vector.length:
                count = count_nouns(vector.length, "number")
                raise ValueError(f"peers send {vector.name} of {other.length} and of {count}")
    return tuple(by_name.values())
