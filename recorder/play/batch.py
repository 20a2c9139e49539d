"""Batches of messages in play order: an array of numbers over a few large byte buffers.

Invariant: messages play by time and never out of order within a channel, whose order is that of
its numbers. A message that stands later in the file than its number says (a backfilled one)
plays in its place: at the latest together with the next one of its channel. Messages of one
instant keep the order of the file.

A minute of 9000 messages/s takes some 100 MiB in this form, a third of the size as Python
objects.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from trilat_net.log.record_columns import Ints

PlayedMessage = tuple[int, int, int, bytes]
"""Time in ns since the epoch, channel, number in it, and payload of a message.

The number is the tick of a record, the place from 0 of another message of a site (of its events
in each of its starts, which are `NUMBERS_OF_A_START` apart), else the time.
"""
PIECE_BYTES = 65_536
"""Payload of a piece: small enough that preparing or receiving one does not delay the player.
"""


def order_for_play(times_ns: Ints, channels: Ints, numbers: Ints) -> tuple[Ints, Ints]:
    """Returns the places of messages in play order, and their deadlines.

    Args:
        times_ns: time of sending or arrival, ns, shape (K,), in file order.
        channels: channel of each, shape (K,).
        numbers: number in its channel, shape (K,); equal ones stay in file order.

    Returns:
        The places, shape (K,), and the deadlines in that order, ns, shape (K,): ascending, and
        none later than the message's time.
    """
    places = np.arange(len(times_ns), dtype=np.int64)
    due_ns = times_ns.copy()
    file_places = places.copy()
    for channel in np.unique(channels):
        own = np.flatnonzero(channels == channel)
        own = own[np.argsort(numbers[own], kind="stable")]
        # no message after the next one of its channel, in time or, within an instant, in place
        due_ns[own] = np.minimum.accumulate(times_ns[own][::-1])[::-1]
        file_places[own] = np.minimum.accumulate(places[own][::-1])[::-1]
    order = np.lexsort((numbers, file_places, due_ns)).astype(np.int64)
    return order, due_ns[order]


@dataclass(frozen=True, slots=True)
class MessageBatch:
    """Messages: a row of numbers each, over the bytes of their payloads.

    Attributes:
        rows: time in ns since the epoch, channel, number in the channel, bounds of the payload;
            shape (K, 5).
    """

    rows: Ints
    data: bytes | bytearray

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def times_ns(self) -> Ints:
        """Deadline of each, ns since the epoch of its log, shape (K,)."""
        return self.rows[:, 0]

    @property
    def channels(self) -> Ints:
        """Channel of each, shape (K,)."""
        return self.rows[:, 1]

    @property
    def numbers(self) -> Ints:
        """Number of each in its channel, shape (K,)."""
        return self.rows[:, 2]

    def payload(self, index: int) -> bytes:
        """Returns a payload."""
        start, end = self.rows[index, 3:].tolist()
        return bytes(self.data[start:end])

    def messages(self) -> Iterator[PlayedMessage]:
        """Yields every message."""
        view = memoryview(self.data)
        for t_ns, channel, number, start, end in self.rows.tolist():
            yield t_ns, channel, number, bytes(view[start:end])

    def part(self, places: slice | Ints) -> "MessageBatch":
        """Returns some of the messages, over the same bytes."""
        return MessageBatch(self.rows[places], self.data)

    def pieces(self, size: int = PIECE_BYTES) -> Iterator["MessageBatch"]:
        """Yields the messages in pieces of some bytes, one message at least, over the same
        bytes.
        """
        filled = np.cumsum(self.rows[:, 4] - self.rows[:, 3]) // size
        edges = [0, *(np.flatnonzero(np.diff(filled)) + 1).tolist(), len(self)]
        for begin, end in pairwise(edges):
            if end > begin:
                yield self.part(slice(begin, end))

    def compact(self) -> "MessageBatch":
        """Returns the messages over bytes of their own, one payload behind the other."""
        rows = self.rows.copy()
        rows[:, 4] = np.cumsum(self.rows[:, 4] - self.rows[:, 3])
        rows[1:, 3] = rows[:-1, 4]
        rows[:1, 3] = 0
        view = memoryview(self.data)
        return MessageBatch(
            rows, b"".join(view[start:end] for start, end in self.rows[:, 3:].tolist())
        )


class BatchBuilder:
    """Messages as they are read from a file, until they are put in order.

    Args:
        kept: messages that were put in order before; they come first.
    """

    def __init__(self, kept: MessageBatch | None = None) -> None:
        self._payloads = bytearray()
        self._rows = array("q")
        if kept is not None:
            kept = kept.part(
                np.argsort(kept.rows[:, 3], kind="stable")
            ).compact()  # in the order of their file
            self._payloads += kept.data
            self._rows.frombytes(kept.rows.tobytes())

    @property
    def memory(self) -> int:
        """Bytes that all messages take."""
        return len(self._payloads) + 8 * len(self._rows)

    def add(self, t_ns: int, channel: int, number: int, payload: bytes) -> None:
        """Adds a message."""
        start = len(self._payloads)
        self._payloads += payload
        self._rows.extend((t_ns, channel, number, start, len(self._payloads)))

    def ordered(self) -> MessageBatch:
        """Returns the messages in play order, each once; the payloads stay in place."""
        rows = np.array(self._rows, dtype=np.int64).reshape(-1, 5)
        if repeats := self._find_repeats(rows):
            rows = np.delete(rows, repeats, axis=0)
        order, due_ns = order_for_play(rows[:, 0], rows[:, 1], rows[:, 2])
        rows = rows[order]
        rows[:, 0] = due_ns
        return MessageBatch(rows, self._payloads)

    def _find_repeats(self, rows: Ints) -> list[int]:
        """Returns the places of messages that are there before already, as in two parts of one
        session.
        """
        order = np.lexsort((rows[:, 2], rows[:, 1]))
        same = (np.diff(rows[order, 1:3], axis=0) == 0).all(axis=1)
        seen: set[tuple[int, int, bytes]] = set()
        repeats = []
        for place in np.union1d(order[1:][same], order[:-1][same]).tolist():
            _, channel, number, start, end = rows[place].tolist()
            message = channel, number, bytes(self._payloads[start:end])
            if message in seen:
                repeats.append(place)
            seen.add(message)
        return repeats
