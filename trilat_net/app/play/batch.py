"""Sorts the messages of a log into playback order, and stores them compactly.

A recorder writes messages as they arrive, so a message that it missed at first appears late in
the file. Playback, however, must be in order. A `BatchBuilder` collects messages in file order
and sorts them into a `MessageBatch`, which consists of an integer table and a byte buffer. In
this form, a minute of 9000 messages/s takes about 100 MiB, a third of the size of the same
messages as Python objects.

Invariant:
    - Messages are played in order of time, and within a channel in order of their numbers.
    - A message that a site has sent again is played no later than the next message of its
      channel.
    - Messages with the same time keep the order of the file.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ...log import Ints

PlayedMessage = tuple[int, int, int, bytes]
"""A message: time after the start of the session in ns, number of the channel, number of the
message in the channel, and payload.

The number of a record is its tick. Statistics and events of a site are numbered from 0. If a
site was started again, `NUMBERS_OF_A_START` is added to the numbers of its events for each
earlier start. The number of any other message is its time.
"""
PIECE_BYTES = 65_536
"""Size of the payloads in a piece, in bytes.

Such a piece is received without delaying the player.

"""

# Columns of `MessageBatch.rows`.
_TIME = 0
_CHANNEL = 1
_NUMBER = 2
_START = 3
_END = 4
_COLUMNS = 5


def order_for_play(times_ns: Ints, channels: Ints, numbers: Ints) -> tuple[Ints, Ints]:
    """Computes the playback order of recorded messages, and the deadline of each, in ns.

    Messages are played in order of time, with one exception: a message whose time is later than
    that of a message with a higher number in the same channel is played before that message.

    Args:
        times_ns: Sending or arrival time of each of K messages in file order, shape (K,), in
            ns.
        channels: Channel index of each message, shape (K,).
        numbers: Number of each message within its channel, shape (K,). Messages with equal
            numbers stay in file order.

    Returns:
        The indices of the messages in playback order, shape (K,), and their deadlines in that
        order, shape (K,), in ns. The deadlines never decrease, and no deadline is later than
        the time of its message.
    """
    indices = np.arange(len(times_ns), dtype=np.int64)
    due_ns = times_ns.copy()
    positions = indices.copy()
    for channel in np.unique(channels):
        of_channel = np.flatnonzero(channels == channel)
        by_number = np.argsort(numbers[of_channel], kind="stable")
        of_channel = of_channel[by_number]

        # No message is played after the next message of its channel: neither at a later time,
        # nor at a later position among messages with the same time.
        due_ns[of_channel] = _limit_by_later(times_ns[of_channel])
        positions[of_channel] = _limit_by_later(indices[of_channel])

    # The last key of np.lexsort is the most important one.
    order = np.lexsort((numbers, positions, due_ns)).astype(np.int64)
    return order, due_ns[order]


def _limit_by_later(values: Ints) -> Ints:
    """Returns for each value the minimum of this value and all later values, shape (K,).

    For example, the values 1, 5, 3, 4 give 1, 3, 3, 4. A message must not be played after a
    message with a higher number, even if its time is later.
    """
    return np.minimum.accumulate(values[::-1])[::-1]


@dataclass(frozen=True, slots=True)
class MessageBatch:
    """K messages of a log in compact form: an integer table, and one buffer with the payloads.

    Storing one Python object per message would need much more memory. Several batches may share
    the same buffer.

    Attributes:
        rows: Table with one row per message, shape (K, 5). The columns are the deadline in ns
            after the start of the session, the channel index, the number within the channel,
            and the start and end index of the payload in `data`.
        data: The payloads, possibly with other bytes between them.
    """

    rows: Ints
    data: bytes | bytearray

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def times_ns(self) -> Ints:
        """Deadline of each message, in ns after the start of the session, shape (K,).

        The player publishes each message at this time, scaled by the playback speed.
        """
        return self.rows[:, _TIME]

    @property
    def end_ns(self) -> int:
        """Deadline of the last message of the batch, in ns after the start of the session.

        Raises IndexError if the batch is empty.
        """
        return int(self.times_ns[-1])

    @property
    def channels(self) -> Ints:
        """Channel index of each message, shape (K,).

        A channel is a topic of the log, such as the records of one arm.
        """
        return self.rows[:, _CHANNEL]

    @property
    def numbers(self) -> Ints:
        """Number of each of the K messages within its channel, shape (K,).

        A channel contains all messages of one kind from one site, and they are played in order
        of their numbers. See `PlayedMessage` for the meaning of a number.
        """
        return self.rows[:, _NUMBER]

    @property
    def _sizes(self) -> Ints:
        """Size of each payload, shape (K,), in bytes."""
        return self.rows[:, _END] - self.rows[:, _START]

    def payload(self, index: int) -> bytes:
        """Returns the encoded payload of one message, exactly as it was first published.

        Args:
            index: Index of the message in this batch, starting at 0.
        """
        start, end = self.rows[index, _START:].tolist()
        return bytes(self.data[start:end])

    def messages(self) -> Iterator[PlayedMessage]:
        """Yields each message of this batch as a `PlayedMessage` tuple, in playback order.

        The tuple contains the time in ns after the start of the session, the channel index, the
        number of the message within the channel, and the encoded payload.
        """
        view = memoryview(self.data)
        for t_ns, channel, number, start, end in self.rows.tolist():
            yield t_ns, channel, number, bytes(view[start:end])

    def part(self, indices: slice | Ints) -> "MessageBatch":
        """Selects some of the messages, without copying their payloads.

        Args:
            indices: Messages to select, in the desired order.

        Returns:
            A batch that shares the buffer of this batch.
        """
        return MessageBatch(self.rows[indices], self.data)

    def pieces(self, size: int = PIECE_BYTES) -> Iterator["MessageBatch"]:
        """Splits the batch into pieces of limited size, without copying the payloads.

        Each piece is sent in one go, so its size limits memory use.

        Args:
            size: Approximate size of a piece, in bytes. A piece that consists of a single
                message may be larger.

        Yields:
            The pieces, in order.
        """
        payload_ends = np.cumsum(self._sizes)
        piece_numbers = payload_ends // size
        first_rows = np.flatnonzero(np.diff(piece_numbers)) + 1
        # Row indices at which pieces begin and end.
        edges = [0, *first_rows.tolist(), len(self)]
        for start, end in pairwise(edges):
            if end > start:
                yield self.part(slice(start, end))

    def compact(self) -> "MessageBatch":
        """Copies the messages into a batch whose buffer contains only their payloads.

        A batch may use only a small part of a large buffer, but keeps the whole buffer in
        memory. Making a copy allows the large buffer to be freed.
        """
        buffer = memoryview(self.data)
        payload_spans = self.rows[:, _START:].tolist()
        payloads = [buffer[start:end] for start, end in payload_spans]

        sizes = self._sizes
        ends = np.cumsum(sizes)
        rows = self.rows.copy()
        rows[:, _END] = ends
        rows[:, _START] = ends - sizes
        return MessageBatch(rows, b"".join(payloads))


class BatchBuilder:
    """Collects messages in file order, and sorts them for playback.

    Args:
        kept: Messages that were sorted in an earlier step but have not been played yet. They
            are treated as if they had been added first. `None` if there are no such messages.
    """

    def __init__(self, kept: MessageBatch | None = None) -> None:
        self._payloads = bytearray()
        self._rows = array("q")
        if kept is not None:
            # The payloads are in the order in which their messages were added.
            file_order = np.argsort(kept.rows[:, _START], kind="stable")
            earlier = kept.part(file_order).compact()
            self._payloads += earlier.data
            self._rows.frombytes(earlier.rows.tobytes())

    @property
    def memory(self) -> int:
        """Memory used by the messages added so far, in bytes.

        The log reader limits this value, because a log may be larger than the machine's memory.
        """
        return len(self._payloads) + 8 * len(self._rows)

    def add(self, t_ns: int, channel: int, number: int, payload: bytes) -> None:
        """Adds the next message of the log file.

        Messages are added in file order and sorted later.

        Args:
            t_ns: Time of the message, in ns after the start of the session.
            channel: Channel index.
            number: Number of the message within its channel.
            payload: Payload bytes of the message.
        """
        start = len(self._payloads)
        self._payloads += payload
        end = len(self._payloads)
        self._rows.extend((t_ns, channel, number, start, end))

    def ordered(self) -> MessageBatch:
        """Returns the added messages in playback order.

        A message that is contained in two files of a session is included only once.

        Returns:
            The sorted messages, each with its deadline. The deadline of a message is never
            later than that of the next message in the same channel.
        """
        rows = np.array(self._rows, dtype=np.int64).reshape(-1, _COLUMNS)
        repeats = self._find_repeats(rows)
        if repeats:
            rows = np.delete(rows, repeats, axis=0)

        order, due_ns = order_for_play(
            times_ns=rows[:, _TIME],
            channels=rows[:, _CHANNEL],
            numbers=rows[:, _NUMBER],
        )
        rows = rows[order]
        rows[:, _TIME] = due_ns
        return MessageBatch(rows, self._payloads)

    def _find_repeats(self, rows: Ints) -> list[int]:
        """Finds messages that repeat an earlier message and need not be replayed.

        Two files of a session may contain the same message.

        Args:
            rows: The messages in the order of the file, see `MessageBatch.rows`.
        """
        earlier_messages: set[tuple[int, int, bytes]] = set()
        repeats = []
        for index in _find_equal_numbers(rows).tolist():
            _, channel, number, start, end = rows[index].tolist()
            message = (channel, number, bytes(self._payloads[start:end]))
            if message in earlier_messages:
                repeats.append(index)
            earlier_messages.add(message)
        return repeats


def _find_equal_numbers(rows: Ints) -> Ints:
    """Finds the messages that have the same channel (topic) and number as another message.

    Such messages may be copies of each other. The messages are sorted by channel and number, so
    that equal messages are neighbours, and each message is compared with the next.

    Args:
        rows: Table with a row per message, shape (K, 5), see `MessageBatch.rows`.

    Returns:
        Indices of the rows of these messages in ascending order, shape (R,). Every message that
        occurs more than once is included, also its first occurrence.
    """
    numbers = rows[:, _NUMBER]
    channels = rows[:, _CHANNEL]
    # The last key of np.lexsort is the most important one.
    order = np.lexsort((numbers, channels))
    # The columns of the channel and of the number are adjacent in the table.
    identities = rows[order, _CHANNEL : _NUMBER + 1]
    differences_to_next = np.diff(identities, axis=0)
    equals_next = (differences_to_next == 0).all(axis=1)
    later_rows = order[1:][equals_next]
    earlier_rows = order[:-1][equals_next]
    return np.union1d(later_rows, earlier_rows)
