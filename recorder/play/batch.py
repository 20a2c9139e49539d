"""Hold messages in play order: a table of numbers over a few large byte buffers.

A minute of 9000 messages/s takes some 100 MiB in this form, a third of its size as Python
objects.

Invariant:
    - Messages play in order of time, and within a channel in order of their numbers.
    - A message that is later in the file than its number says (a backfilled message) plays at
      the latest together with the next message of its channel.
    - Messages of the same time keep the order of the file.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from trilat_net.log.record_columns import Ints

PlayedMessage = tuple[int, int, int, bytes]
"""A message: time in ns since the epoch, channel, number in the channel, and payload.

The number is the tick of a record and the number from 0 of statistics or an event of a site.
The events of two successive starts differ by `NUMBERS_OF_A_START`. For other messages it is the
time.
"""
PIECE_BYTES = 65_536
"""Payload of a piece, bytes: small enough that preparing or receiving it does not delay the
player.
"""


def order_for_play(times_ns: Ints, channels: Ints, numbers: Ints) -> tuple[Ints, Ints]:
    """Returns the play order of messages, and their deadlines.

    Args:
        times_ns: time of sending or of arrival, ns, shape (K,), in file order.
        channels: channel of each message, shape (K,).
        numbers: number of each message in its channel, shape (K,). Messages with equal numbers
            stay in file order.

    Returns:
        The indices of the messages in play order, shape (K,), and their deadlines in that
        order, ns, shape (K,). The deadlines ascend, and no deadline is later than the time of
        its message.
    """
    indices = np.arange(len(times_ns), dtype=np.int64)
    due_ns = times_ns.copy()
    file_order = indices.copy()
    for channel in np.unique(channels):
        members = np.flatnonzero(channels == channel)
        members = members[np.argsort(numbers[members], kind="stable")]
        # no message plays after the next message of its channel: not at a later time, and among
        # messages of the same time not at a later position
        due_ns[members] = np.minimum.accumulate(times_ns[members][::-1])[::-1]
        file_order[members] = np.minimum.accumulate(indices[members][::-1])[::-1]
    order = np.lexsort((numbers, file_order, due_ns)).astype(np.int64)
    return order, due_ns[order]


@dataclass(frozen=True, slots=True)
class MessageBatch:
    """Messages: a table of numbers, and the bytes of the payloads.

    Attributes:
        rows: per message the time in ns since the epoch, the channel, the number in the
            channel, and start and end of the payload in `data`; shape (K, 5).
        data: the payloads.
    """

    rows: Ints
    data: bytes | bytearray

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def times_ns(self) -> Ints:
        """Deadline of each message, ns since the epoch of its log, shape (K,)."""
        return self.rows[:, 0]

    @property
    def channels(self) -> Ints:
        """Channel of each message, shape (K,)."""
        return self.rows[:, 1]

    @property
    def numbers(self) -> Ints:
        """Number of each message in its channel, shape (K,)."""
        return self.rows[:, 2]

    @property
    def _sizes(self) -> Ints:
        """Size of each payload, bytes, shape (K,)."""
        return self.rows[:, 4] - self.rows[:, 3]

    def payload(self, index: int) -> bytes:
        """Returns the payload of the message at an index."""
        start, end = self.rows[index, 3:].tolist()
        return bytes(self.data[start:end])

    def messages(self) -> Iterator[PlayedMessage]:
        """Yields every message."""
        view = memoryview(self.data)
        for t_ns, channel, number, start, end in self.rows.tolist():
            yield t_ns, channel, number, bytes(view[start:end])

    def part(self, indices: slice | Ints) -> "MessageBatch":
        """Returns the messages at some indices, over the same bytes."""
        return MessageBatch(self.rows[indices], self.data)

    def pieces(self, size: int = PIECE_BYTES) -> Iterator["MessageBatch"]:
        """Yields the messages in pieces of about `size` bytes, over the same bytes.

        A piece has at least one message.
        """
        piece_numbers = np.cumsum(self._sizes) // size
        changes = np.flatnonzero(np.diff(piece_numbers)) + 1
        for start, end in pairwise([0, *changes.tolist(), len(self)]):
            if end > start:
                yield self.part(slice(start, end))

    def compact(self) -> "MessageBatch":
        """Returns the messages over a copy of only their bytes, without gaps."""
        view = memoryview(self.data)
        payloads = [view[start:end] for start, end in self.rows[:, 3:].tolist()]
        rows = self.rows.copy()
        rows[:, 4] = np.cumsum(self._sizes)
        rows[1:, 3] = rows[:-1, 4]
        rows[:1, 3] = 0
        return MessageBatch(rows, b"".join(payloads))


class BatchBuilder:
    """Collects messages in the order of a file and puts them in play order.

    Args:
        kept: messages that were put in order before; they come first.
    """

    def __init__(self, kept: MessageBatch | None = None) -> None:
        self._payloads = bytearray()
        self._rows = array("q")
        if kept is not None:
            file_order = np.argsort(kept.rows[:, 3], kind="stable")
            kept = kept.part(file_order).compact()
            self._payloads += kept.data
            self._rows.frombytes(kept.rows.tobytes())

    @property
    def memory(self) -> int:
        """Memory of all messages, bytes."""
        return len(self._payloads) + 8 * len(self._rows)

    def add(self, t_ns: int, channel: int, number: int, payload: bytes) -> None:
        """Adds a message, see `PlayedMessage`."""
        start = len(self._payloads)
        self._payloads += payload
        self._rows.extend((t_ns, channel, number, start, len(self._payloads)))

    def ordered(self) -> MessageBatch:
        """Returns the messages in play order, without repeated messages."""
        rows = np.array(self._rows, dtype=np.int64).reshape(-1, 5)
        repeats = self._find_repeats(rows)
        if repeats:
            rows = np.delete(rows, repeats, axis=0)
        order, due_ns = order_for_play(rows[:, 0], rows[:, 1], rows[:, 2])
        rows = rows[order]
        rows[:, 0] = due_ns
        return MessageBatch(rows, self._payloads)

    def _find_repeats(self, rows: Ints) -> list[int]:
        """Returns the indices of repeated messages, as in two parts of a session."""
        order = np.lexsort((rows[:, 2], rows[:, 1]))
        # only messages with equal channel and number are compared
        is_equal = (np.diff(rows[order, 1:3], axis=0) == 0).all(axis=1)
        candidates = np.union1d(order[1:][is_equal], order[:-1][is_equal])
        seen: set[tuple[int, int, bytes]] = set()
        repeats = []
        for index in candidates.tolist():
            _, channel, number, start, end = rows[index].tolist()
            message = (channel, number, bytes(self._payloads[start:end]))
            if message in seen:
                repeats.append(index)
            seen.add(message)
        return repeats
