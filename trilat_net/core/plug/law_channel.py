"""Layout of the values that a control law sends to other arms, as stored in a record.

Each arm sends its motion to its peers. Some control laws send additional vectors, for example
wave variables or energies. A vector is either sent to all peers, or is different for each peer.

In each tick, the site stores all these values in the field `ch` of its record, and each peer
receives the part addressed to it. The records of the sender therefore show what each peer was
sent.

Invariant:
    - The field contains the vectors for all peers first, followed by the vectors for individual
      peers, ordered by peer as in the scenario.
"""

import keyword
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ...errors import ScenarioError, count_nouns

MAX_SENT = 16
"""Largest number of values per joint that a law sends to a peer."""
_MAX_RECORD_SENT = 1024
"""Largest number of values that a law sends to all its peers in one tick, as stored in a
record.
"""


class SentVector(NamedTuple):
    """A vector that a control law sends to other arms in every tick, for example energies.

    The vector is part of the network message that carries the motion of the arm.

    Attributes:
        name: Name of the vector, as used by the law.
        unit: Unit of its entries.
        length: Number of its entries.
        per_peer: True if each peer gets a different vector, False if all peers get the same
            vector.
    """

    name: str
    unit: str
    length: int
    per_peer: bool = False


class _SentEntry(NamedTuple):
    """One of the values that a control law sends to other arms, with its name and unit.

    Attributes:
        vector: Vector that contains the value.
        peer: The only receiver of the vector, or "" if it is sent to all peers.
        position: Index of the value in the vector.
    """

    vector: SentVector
    peer: str
    position: int

    @property
    def key(self) -> str:
        """Label of the vector that contains the value, for example "E" or "u[m2]".

        The label is the name of the vector. If the vector is sent to a single peer, the name of
        this peer follows in brackets.
        """
        return f"{self.vector.name}[{self.peer}]" if self.peer else self.vector.name

    def __str__(self) -> str:
        return f"{self.key}[{self.position}]"


class LawChannel(NamedTuple):
    """All vectors that the control law of one arm sends to the laws of other arms.

    These are sent in addition to the motion of the arm, for example waves or energies.

    Attributes:
        vectors: The vectors in the order in which the log stores them: those that are the same
            for all peers, then those that are different for each peer.
        peers: Number of peers.
    """

    vectors: tuple[SentVector, ...] = ()
    peers: int = 0

    def select_vectors(self, *, per_peer: bool) -> tuple[SentVector, ...]:
        """Returns the vectors that are the same for all peers, or those that differ by peer.

        Args:
            per_peer: True for the vectors that are different for each peer, False for the
                vectors that are the same for all peers.
        """
        return tuple(vector for vector in self.vectors if vector.per_peer is per_peer)

    def count_numbers(self, *, per_peer: bool) -> int:
        """Counts the values that the law sends to every peer alike, or only to a single peer.

        Args:
            per_peer: True to count the values for one peer in the vectors that differ between
                peers. False to count the values that are the same for all peers.
        """
        return sum(vector.length for vector in self.select_vectors(per_peer=per_peer))

    @property
    def received_size(self) -> int:
        """Number of values that one peer receives from the law with each message.

        These are the values of the vectors that are the same for all peers, and of the vectors
        for this peer alone.
        """
        return sum(vector.length for vector in self.vectors)

    @property
    def record_size(self) -> int:
        """Number of floats that the law sends to all peers together in one tick.

        This is the length of the field `ch` in the log. A vector that differs between peers
        counts once per peer.
        """
        if not self.vectors:
            return 0
        to_all = self.count_numbers(per_peer=False)
        to_each = self.count_numbers(per_peer=True)
        return to_all + self.peers * to_each

    def find_columns(self, vectors: Sequence[SentVector]) -> list[int]:
        """Locates, in the messages of this law, the values that another control law reads.

        The other law may read fewer vectors than this law sends, and in a different order.

        Args:
            vectors: The vectors that the other law reads.

        Returns:
            For each value of these vectors, its index among the values that this law sends to a
            peer, or -1 if this law does not send the vector.
        """
        first_column = 0
        first_columns = {}
        for vector in self.vectors:
            first_columns[vector.name] = first_column
            first_column += vector.length

        columns: list[int] = []
        for vector in vectors:
            if vector.name in first_columns:
                first = first_columns[vector.name]
                columns += range(first, first + vector.length)
            else:
                columns += [-1] * vector.length
        return columns

    def entries(self, peers: Sequence[str]) -> Iterator[_SentEntry]:
        """Yields a description of each value that the law sends in one tick.

        The order is that of the field `ch` in the log.

        Args:
            peers: Names of the peers, in scenario order.

        Yields:
            The vector that contains the value, the receiver, and the position of the value in
            the vector.
        """
        to_each = self.select_vectors(per_peer=True)
        vectors_by_receiver = [("", self.select_vectors(per_peer=False))]
        vectors_by_receiver += [(peer, to_each) for peer in peers]
        for peer, vectors in vectors_by_receiver:
            for vector in vectors:
                for n in range(vector.length):
                    yield _SentEntry(vector, peer, n)

    def select_for_peer(self, sent: Sequence[float], peer_index: int) -> Sequence[float]:
        """Selects the values that one peer receives from all values sent by a control law.

        These are the values for all peers, and the values for this peer alone.

        Args:
            sent: All values that the law sent in a tick, as in its record.
            peer_index: Index of the peer among the sender's peers.
        """
        to_all = self.count_numbers(per_peer=False)
        to_each = self.count_numbers(per_peer=True)
        if not to_each:
            return sent
        start = to_all + peer_index * to_each
        return [*sent[:to_all], *sent[start : start + to_each]]

    def check_vectors(self, joints: int, path: str) -> None:
        """Raises ScenarioError if the vectors have invalid names or are too long.

        The vectors are part of each network message between arms, and a long message would take
        too much time.

        Args:
            joints: Number of joints of the site's arm.
            path: Path of the law's settings in the scenario file, for error messages.

        Raises:
            ScenarioError: A name is not allowed, or the vectors have more entries than a
                message or a log entry can hold.
        """
        sends_path = f"{path}.sends"
        for vector in self.vectors:
            problem = _find_name_problem(vector.name)
            if problem:
                raise ScenarioError(problem, path=f"{sends_path}.{vector.name}")

        largest_count = MAX_SENT * joints
        if self.received_size > largest_count:
            count = count_nouns(self.received_size, "number")
            problem = (
                f"sends {count} to each peer, but a law may send at most {largest_count}, "
                f"{MAX_SENT} per joint"
            )
            raise ScenarioError(problem, path=sends_path)

        if self.record_size > _MAX_RECORD_SENT:
            count = count_nouns(self.record_size, "number")
            receivers = count_nouns(self.peers, "peer")
            problem = (
                f"sends {count} to {receivers} together, but a record holds at most "
                f"{_MAX_RECORD_SENT}"
            )
            raise ScenarioError(problem, path=sends_path)

    @staticmethod
    def join_received(channels: "Sequence[LawChannel]") -> tuple[SentVector, ...]:
        """Returns all vectors that the control law of an arm may receive from the other laws.

        A vector sent by several laws, such as the energy E, appears once.

        Args:
            channels: Vectors that each of the other laws sends.

        Raises:
            ValueError: Two peers send vectors with the same name and different lengths.
        """
        by_name: dict[str, SentVector] = {}
        for channel in channels:
            for vector in channel.vectors:
                first = by_name.setdefault(vector.name, vector)
                if first.length != vector.length:
                    count = count_nouns(vector.length, "number")
                    problem = f"peers send {vector.name} with different lengths"
                    raise ValueError(f"{problem}, {first.length} and {count}")
        return tuple(by_name.values())


def _find_name_problem(name: str) -> str:
    """Returns the reason why a name is unsuitable for a vector.

    A law reads the vector as an attribute of its input, so the name must be an identifier, and
    must not be an existing attribute of the input.

    Returns:
        The reason. Empty if the name is suitable.
    """
    is_identifier = name.isidentifier() and not keyword.iskeyword(name)
    is_public = not name.startswith("_") and len(name) <= 24
    if not (is_identifier and is_public):
        return (
            "is not a valid name for a vector: the name must start with a letter, contain only "
            "letters, digits and _, have at most 24 characters, and not be a Python keyword"
        )
    is_record_attribute = hasattr(np.record, name)
    if is_record_attribute or hasattr(tuple, name):
        return (
            "is reserved, because every record of numbers has an attribute of that name: "
            "choose another name"
        )
    return ""
