"""Supplies the player of a log with messages, without ever making it wait for the disk.

Playing a log means publishing its messages again, with the timing of the original session. A
short log is loaded into memory beforehand. A long log is read by a second process, the reader,
which reads ahead and sends the messages through a pipe in playback order.

Invariant:
    - The method that returns the next messages never waits. If no messages are available yet,
      it returns `None`.
    - The memory of the reader is bounded by two constants. `LIMIT_BYTES` is the largest total
      size of the messages held for sorting. `HORIZON_NS` is the largest delay of a message in
      the file, measured in log time, that the reader can correct.
    - The reader waits while the pipe is full. The two processes share nothing except this pipe.
"""

import multiprocessing
import os
import pickle
import struct
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

import numpy as np

from trilat_net import process, signals
from trilat_net.errors import LogError, RuntimeFault

from .batch import BatchBuilder, MessageBatch, PlayedMessage
from .session_reader import HORIZON_NS, PlaySelection, SessionHeader, SessionReader

SIZE = struct.Struct("<Q")
"""Encoding of the length that precedes each pickled item in the pipe."""
READ_BYTES = 65_536
"""Largest number of bytes that are read from the pipe at once."""
AHEAD_BYTES = 16 * 1024 * 1024
"""Payloads that the player receives in advance, in bytes."""
STEP_NS = 10_000_000_000
"""Duration of the part of a log that is sorted at a time, in ns."""
LIMIT_BYTES = 512 * 1024 * 1024
"""Largest memory of the messages that wait for their turn, in bytes."""
NICENESS = -5
"""Priority of the reader process, if permitted. It is below the priority of the player, which
waits for the reader, and above that of other processes.
"""


class _RoundEnd(NamedTuple):
    """Item by which the reader process reports that it has sent all messages of a round.

    A round is one pass through the log. A log that is replayed in a loop has several rounds.

    Attributes:
        strays: Number of messages that appear too late in the file to be played in order.
        torn: The damaged files, each with a description of the damage.
    """

    strays: int
    torn: dict[Path, str]


class _ReadPiece(NamedTuple):
    """Piece of a log that the reader process sends to the player.

    A separate process reads, so that decompression does not delay published messages.

    Attributes:
        topics: Topics of all channels that were found so far. The index of a topic is the
            number of its channel.
        batch: The messages of the piece, in the order in which they are played.
    """

    topics: list[str]
    batch: MessageBatch


class MessageSource:
    """Supplies the messages of a log in playback order.

    A round is one pass through the log. When a log is played in a loop, its messages are
    supplied round after round.

    Args:
        header: Description of the files. Topics and damaged files discovered during reading are
            added to it.
        batch: All messages of the log. `None` if they do not fit in memory, in which case
            `start_reader` must be called.

    Attributes:
        ended: True if `poll` has returned all messages of this round.
        whole: True if all messages are in memory.
        strays: Number of messages that appear so late in the file that they are played out of
            order.
    """

    def __init__(self, header: SessionHeader, batch: MessageBatch | None) -> None:
        self.whole = batch is not None
        self.ended = False
        self.strays = 0
        self._header = header
        self._batch = batch
        # Items that were fetched in advance and not returned yet: pieces of the log, the end of
        # a round, or the error that ended the reading.
        self._ahead: deque[_ReadPiece | _RoundEnd | LogError] = deque()
        # Size of the payloads in these pieces, in bytes.
        self._ahead_bytes = 0
        # Bytes of the pipe that do not form a complete item yet.
        self._received = bytearray()
        self._process: multiprocessing.process.BaseProcess | None = None
        self.restart()

    def start_reader(
        self, paths: Sequence[Path], selection: PlaySelection, *, loop: bool
    ) -> None:
        """Starts the process that reads a long log from the disk during playback.

        The player must publish each message on time, and therefore cannot wait for the disk.

        Args:
            paths: The files of the log.
            selection: Which messages are played, by channel and time.
            loop: True to read the files repeatedly.
        """
        context = multiprocessing.get_context("spawn")
        self._pipe, reader_pipe = context.Pipe(duplex=False)
        # The methods of the pipe would wait for the rest of an item. Therefore the bytes are
        # read without waiting.
        os.set_blocking(self._pipe.fileno(), False)
        self._process = context.Process(
            target=feed_player, args=(reader_pipe, paths, selection, loop), daemon=True
        )
        with signals.hold_sigint():  # on Ctrl-C the player ends the reader process
            self._process.start()
        reader_pipe.close()

    def poll(self) -> MessageBatch | None:
        """Returns the next messages to play, if any are available, without waiting.

        Each call takes one item from the queue `_ahead`. The item is a piece of the log, the
        end of the round, or an error of the process that reads the log. The item for the end of
        the round also contains the number of strays (messages that are played out of order) and
        the damaged files. `restart` begins the next round.

        Returns:
            The messages. `None` if no messages are available now, or if the round has ended
            (`ended`).

        Raises:
            LogError: A file can no longer be read.
        """
        if self.ended or not self._ahead:
            return None

        item = self._ahead.popleft()
        if isinstance(item, LogError):
            raise item
        if isinstance(item, _ReadPiece):
            # The list is changed in place, because other objects refer to the same header.
            self._header.topics[:] = item.topics
            self._ahead_bytes -= len(item.batch.data)
            return item.batch

        round_end: _RoundEnd = item
        self.strays += round_end.strays
        self._header.torn.update(round_end.torn)
        self.ended = True
        return None

    def fill(self) -> bool:
        """Prefetches messages from the process that reads the log, without waiting.

        The player calls this method when there is time before the next message. The method
        reads bytes from the pipe and decodes them, so that `poll` can return the messages.

        Returns:
            True if bytes were read. False if no bytes are available now, or if enough messages
            have already been prefetched.

        Raises:
            RuntimeFault: The process that reads the log has failed.
        """
        if self._process is None or self._ahead_bytes > AHEAD_BYTES:
            return False

        try:
            data = os.read(self._pipe.fileno(), READ_BYTES)
        except BlockingIOError:
            return False
        if not data:
            # The exit code is None while the process is ending. The player has no time to wait.
            if self._process.exitcode:
                raise RuntimeFault(
                    "the process that reads the log ended with exit code "
                    f"{self._process.exitcode}"
                )
            return False

        self._received += data
        self._unpickle_received()
        return True

    def _unpickle_received(self) -> None:
        """Decodes the items that were received completely, and adds them to the queue."""
        while len(self._received) >= SIZE.size:
            end = SIZE.size + SIZE.unpack_from(self._received)[0]
            if len(self._received) < end:
                break
            item = pickle.loads(self._received[SIZE.size : end])
            del self._received[:end]
            self._ahead.append(item)
            if isinstance(item, _ReadPiece):
                self._ahead_bytes += len(item.batch.data)

    def restart(self) -> None:
        """Starts supplying the messages from the beginning again, for playback in a loop.

        A log in memory is queued again. For a long log, nothing needs to be done, since the
        reader process starts over by itself.
        """
        self.ended = False
        if self._batch is not None:
            self._ahead.append(_ReadPiece(self._header.topics, self._batch))
            self._ahead.append(_RoundEnd(0, {}))

    def close(self) -> None:
        """Ends the process that reads the log. May be called more than once."""
        if self._process is not None:
            self._process.terminate()
            self._process.join()
            self._pipe.close()


def sort_messages(
    messages: Iterable[PlayedMessage],
    horizon_ns: int = HORIZON_NS,
    step_ns: int = STEP_NS,
    limit_bytes: int = LIMIT_BYTES,
) -> Iterator[tuple[MessageBatch, int]]:
    """Sorts the messages of a log into playback order.

    A message may appear late in the file, because a site sent it again after a loss. Messages
    are therefore buffered for a while before they are yielded, within a memory limit.

    The messages are sorted and yielded in large parts. The first part is yielded when the
    horizon and one step of log time have been read, and another part after each further step. A
    part contains the messages that are older than the newest message by at least the horizon.

    Args:
        messages: The messages, in file order.
        horizon_ns: Largest delay with which a message may appear in the file and still be put
            in order, in ns of log time.
        step_ns: Duration of the part of the log that is sorted at a time, in ns.
        limit_bytes: Memory limit for buffered messages, in bytes. If it is exceeded, the
            earlier half is yielded at once.

    Yields:
        Messages in playback order, and how many of them appeared too late in the file to be put
        in order.
    """
    sorter = _MessageSorter()
    before_all_messages_ns = -(2**62)
    after_all_messages_ns = 1 << 62
    newest_ns = before_all_messages_ns
    next_release_ns = None
    for message in messages:
        sorter.add(message)
        message_ns = message[0]
        newest_ns = max(newest_ns, message_ns)
        if next_release_ns is None:
            next_release_ns = newest_ns + horizon_ns + step_ns
        if newest_ns >= next_release_ns:
            yield sorter.release_until(newest_ns - horizon_ns)
            # The horizon is full from now on, so that a step completes the next part.
            next_release_ns = newest_ns + step_ns
        elif sorter.memory > limit_bytes:
            yield sorter.release_half()
    yield sorter.release_until(after_all_messages_ns)


class _MessageSorter:
    """Buffer that brings the messages of a log file into the order of their sending times.

    Log files have the order of arrival. A message is a stray if a later message of its channel
    was released before it. Strays are counted.
    """

    def __init__(self) -> None:
        self._waiting = BatchBuilder()
        # Largest number that was released, by channel.
        self._last_numbers: dict[int, int] = {}

    @property
    def memory(self) -> int:
        """Memory used by the buffered messages, in bytes."""
        return self._waiting.memory

    def add(self, message: PlayedMessage) -> None:
        """Buffers the next message of the file until it can be released in the right order.

        Args:
            message: The next message in file order.
        """
        t_ns, channel, number, payload = message
        self._waiting.add(t_ns, channel, number, payload)

    def release_until(self, until_ns: int) -> tuple[MessageBatch, int]:
        """Removes and returns the messages that are due up to a given time, in playback order.

        Args:
            until_ns: The time, in ns after the start of the session.

        Returns:
            The messages in playback order, and the number of strays (messages that came too
            late, after one with a higher number in the same channel had been released).
        """
        sorted_messages = self._waiting.ordered()
        times_ns = sorted_messages.times_ns
        due_count = int(np.searchsorted(times_ns, until_ns, side="right"))
        return self._release(sorted_messages, due_count)

    def release_half(self) -> tuple[MessageBatch, int]:
        """Releases the earlier half of the buffered messages, because they use too much memory.

        Returns:
            The messages in playback order, and the number of strays (messages that came too
            late, after one with a higher number in the same channel had been released).
        """
        ordered = self._waiting.ordered()
        return self._release(ordered, (len(ordered) + 1) // 2)

    def _release(self, ordered: MessageBatch, count: int) -> tuple[MessageBatch, int]:
        """Removes the first `count` messages, and returns them and their number of strays."""
        self._waiting = BatchBuilder(ordered.part(slice(count, None)))
        released = ordered.part(slice(count))
        strays = 0
        for channel in np.unique(released.channels).tolist():
            numbers = released.numbers[released.channels == channel]
            last = self._last_numbers.get(channel, int(numbers.min()))
            strays += int(np.count_nonzero(numbers < last))
            self._last_numbers[channel] = max(last, int(numbers.max()))
        return released, strays


def feed_player(
    pipe: Connection, paths: Sequence[Path], selection: PlaySelection, loop: bool
) -> None:
    """Sends the messages of a log to the player until all are sent or the player has ended.

    This is the main function of the reader process. It reads a log that does not fit in memory,
    while the player (another process) publishes its messages. After each pass through the log,
    it reports the damaged files and the number of strays, which are messages that appear too
    late in the file to be put in order.

    Args:
        pipe: Pipe to the player.
        paths: The files of the log.
        selection: Which messages are played.
        loop: True to read the files repeatedly.
    """
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)

    def send(item: _ReadPiece | _RoundEnd | LogError) -> None:
        """Writes an item to the pipe, and waits while the pipe is full.

        Waiting limits how far the reader runs ahead, and therefore its memory use. Each item is
        preceded by its size, which tells the player where the item ends.
        """
        pickled = pickle.dumps(item)
        sink.write(SIZE.pack(len(pickled)) + pickled)
        sink.flush()

    with (
        suppress(BrokenPipeError),
        process.pause_gc(),
        open(pipe.fileno(), "wb", closefd=False) as sink,
    ):
        try:
            while True:
                reader = SessionReader(paths, selection)
                strays = 0
                for batch, batch_strays in sort_messages(reader.messages()):
                    strays += batch_strays
                    for piece in batch.pieces():
                        assert reader.header is not None  # there was a message
                        send(_ReadPiece(reader.header.topics, piece.compact()))
                torn_files = reader.header.torn if reader.header else {}
                send(_RoundEnd(strays, torn_files))
                if not loop:
                    return
        except LogError as error:
            send(LogError(str(error)))
