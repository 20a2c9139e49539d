"""Sorts the messages of a log into playback order, and stores them compactly.

A recorder writes messages as they arrive. A message that it missed at first therefore comes
late in the file. Played messages must be in order. A `BatchBuilder` collects messages in the
order of a file and sorts them into a `MessageBatch`, a table of numbers with a buffer of bytes.
A minute of 9000 messages/s takes about 100 MiB in this form, a third of its size as Python
objects.

Invariant:
    - Messages are played in the order of their times, and within a channel in the order of
      their numbers.
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
    """Computes the order in which recorded messages are played, and the deadline of each.

    Messages are played in the order of their times. Within a channel they are also played in
    the order of their numbers, even if a message was recorded late.

    Args:
        times_ns: Sending or arrival time of each of K messages in the order of the file, shape
            (K,), in ns.
        channels: Number of the channel of each message, shape (K,).
        numbers: Number of each message in its channel, shape (K,). Messages with equal numbers
            stay in the order of the file.

    Returns:
        The indices of the messages in play order, shape (K,), and their deadlines in that
        order, shape (K,), in ns. The deadlines do not decrease, and no deadline is later than
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
    """K messages of a log in compact form: a table of numbers, and one buffer with contents.

    A Python object per message would need much more memory. Several batches may share the same
    buffer.

    Attributes:
        rows: Table with a row per message, shape (K, 5). The columns are the deadline after the
            start of the session in ns, the number of the channel, the number in the channel,
            and the first and the end index of the payload in `data`.
        data: The payloads, possibly with other bytes between them.
    """

    rows: Ints
    data: bytes | bytearray

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def times_ns(self) -> Ints:
        """Time of each message, in ns after the start of the session, shape (K,).

        The player publishes each message at this time, scaled by the speed of the replay.
        """
        return self.rows[:, _TIME]

    @property
    def end_ns(self) -> int:
        """Time of the last message of the batch, in ns after the start of the session.

        An empty batch has no such time, and raises IndexError.
        """
        return int(self.times_ns[-1])

    @property
    def channels(self) -> Ints:
        """Number of the channel of each message, shape (K,).

        A channel is a topic of the log, such as the records of one arm.
        """
        return self.rows[:, _CHANNEL]

    @property
    def numbers(self) -> Ints:
        """Number of each of the K messages in its channel, shape (K,).

        A channel contains the messages of one kind from one site. They are played in the order
        of their numbers. The meaning of a number is described at `PlayedMessage`.
        """
        return self.rows[:, _NUMBER]

    @property
    def _sizes(self) -> Ints:
        """Size of each payload, shape (K,), in bytes."""
        return self.rows[:, _END] - self.rows[:, _START]

    def payload(self, index: int) -> bytes:
        """Returns the encoded content of one message, exactly as it was first published.

        Args:
            index: Index of the message in this batch, 0 for the first one.
        """
        start, end = self.rows[index, _START:].tolist()
        return bytes(self.data[start:end])

    def messages(self) -> Iterator[PlayedMessage]:
        """Yields each recorded message of this batch as a tuple, in playback order.

        The tuple `PlayedMessage` contains the time in ns after the start of the session, the
        number of the channel, the number of the message in the channel, and the encoded
        content.
        """
        view = memoryview(self.data)
        for t_ns, channel, number, start, end in self.rows.tolist():
            yield t_ns, channel, number, bytes(view[start:end])

    def part(self, indices: slice | Ints) -> "MessageBatch":
        """Selects some of the messages, without copying their contents.

        Args:
            indices: Which messages are selected, and in which order.

        Returns:
            The messages, which share the buffer of this batch.
        """
        return MessageBatch(self.rows[indices], self.data)

    def pieces(self, size: int = PIECE_BYTES) -> Iterator["MessageBatch"]:
        """Divides the messages into pieces of limited size, without copying their payloads.

        A piece is sent at once, so its size limits the memory.

        Args:
            size: Approximate size of a piece, in bytes. A piece with one message may be larger.

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

        A batch may be a small part of a large buffer, which stays in memory as long as the
        batch. The copy frees the large buffer.
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
    """Collects messages in the order of a log file, and sorts them for replaying.

    To replay a log means to publish its messages again, each at its original time.

    Args:
        kept: Messages that were sorted in an earlier step but have not been played yet. They
            are treated as the first messages that were added. `None` if there are no such
            messages.
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
        """Memory that the messages added so far occupy, in bytes.

        The reader of a log limits it, because a log may be larger than the machine's memory.
        """
        return len(self._payloads) + 8 * len(self._rows)

    def add(self, t_ns: int, channel: int, number: int, payload: bytes) -> None:
        """Adds a message in the order of the log file.

        All messages are sorted later for playing.

        Args:
            t_ns: Time of the message after the start of the session, in ns.
            channel: Number of the channel.
            number: Number of the message in its channel.
            payload: Bytes of the message.
        """
        start = len(self._payloads)
        self._payloads += payload
        end = len(self._payloads)
        self._rows.extend((t_ns, channel, number, start, end))

    def ordered(self) -> MessageBatch:
        """Returns the added messages in the order in which they are replayed.

        Two files of a session may contain the same message, which is included only once.

        Returns:
            The sorted messages. The time of each message is its deadline: the time at which it
            is due, so that no message is later than the next message of its channel.
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
        The rows of these messages in ascending order, shape (R,). It includes every message
        that occurs more than once, also its first occurrence.
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
