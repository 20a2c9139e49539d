"""Supplies the player of a log with messages, so that it never waits for the disk.

To play a log means to publish its messages again, at the times of the original session. A short
log is loaded into memory beforehand. A long log is read by a second process, the reader. It
reads ahead and sends the messages through a pipe, in the order in which they are played.

Invariant:
    - The method that returns the next messages never waits. If no messages are available yet,
      it returns `None`.
    - The memory of the reader is bounded by two constants. `LIMIT_BYTES` is the largest size of
      the messages that it stores for sorting. `HORIZON_NS` is the largest delay of a message in
      the file, measured in the log, that the reader can correct.
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
    """Message from the process that reads a log: all messages of a round were sent.

    A round is one pass through the log. A log that is replayed in a loop has several rounds.

    Attributes:
        strays: Number of messages that could not be played in order, because their position in
            the file was too far from their turn.
        torn: The damaged files, with the reason.
    """

    strays: int
    torn: dict[Path, str]


class _ReadPiece(NamedTuple):
    """A piece of a log that the process that reads the file sends to the player.

    A separate process reads, so that decompression does not delay published messages.

    Attributes:
        topics: Topics of all channels that were found so far. The index of a topic is the
            number of its channel.
        batch: The messages of the piece, in the order in which they are played.
    """

    topics: list[str]
    batch: MessageBatch


class MessageSource:
    """Supplies the messages of a log in the order in which they are replayed.

    A round is one pass through the log. If the log is replayed in a loop, its messages are
    supplied round after round.

    Args:
        header: Description of the files. The topics and damages that are found during reading
            are added to it.
        batch: All messages of the log. `None` if they are too many for the memory. In this case
            `start_reader` must be called.

    Attributes:
        ended: True if `poll` has returned all messages of this round.
        whole: True if all messages are in memory.
        strays: Number of messages that were so late in the file that they are played out of
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
        """Starts the process that reads a long log from the disk while the log is played.

        The player must publish each message at its time, and therefore cannot wait for the
        disk.

        Args:
            paths: The files of the log.
            selection: Which messages are played, by channel and time.
            loop: True if the process reads the files again and again.
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
        """Returns the next messages to play, if any are available. It never waits.

        Each call removes one item from the queue `_ahead`. The item is either a piece of the
        log, the end of the round, or the error of the process that reads the log. The end of
        the round also reports the strays, messages that are played out of order, and the
        damaged ("torn") files. `restart` begins the next round.

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
        """Fetches messages in advance from the process that reads the log, without waiting.

        The player calls it while there is time before the next message. The bytes are read from
        the pipe and decoded. `poll` then returns the messages.

        Returns:
            True if bytes were read. False if no bytes are available now, or if enough messages
            have been fetched in advance.

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
        """Supplies the messages of the log again from the start, for replaying in a loop.

        A log in memory is queued once more. For a long log, the reader process begins again on
        its own.
        """
        self.ended = False
        if self._batch is not None:
            self._ahead.append(_ReadPiece(self._header.topics, self._batch))
            self._ahead.append(_RoundEnd(0, {}))

    def close(self) -> None:
        """Ends the process that reads the log file. Further calls have no effect."""
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
    """Sorts the messages of a log into the order in which they are played.

    A message may be late in the file, because a site sent it again after a loss. Therefore
    messages are stored for some time before they are yielded. The memory for this is limited.

    A stored message is yielded when a message arrives that is later by the horizon. Messages
    are yielded at most once per step of the log, so that larger parts are sorted. The first
    part is yielded when the horizon and one step have been read, and then one part after each
    further step.

    Args:
        messages: The messages, in the order of the file.
        horizon_ns: Largest delay of a message in the file that is corrected, in ns of the log.
        step_ns: Duration of the part of the log that is sorted at a time, in ns.
        limit_bytes: Largest memory of the stored messages, in bytes. If it is exceeded, the
            earlier half is yielded at once.

    Yields:
        Messages in playback order, and the number of messages among them that were too late in
        the file to be put in order.
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
        """Memory of the waiting messages, in bytes."""
        return self._waiting.memory

    def add(self, message: PlayedMessage) -> None:
        """Stores the next message of the file until it can be released in the right order.

        Args:
            message: The next message in the order of the file.
        """
        t_ns, channel, number, payload = message
        self._waiting.add(t_ns, channel, number, payload)

    def release_until(self, until_ns: int) -> tuple[MessageBatch, int]:
        """Removes the messages that are due up to a time, so that they can be played.

        They are put in playback order, which may differ from the order of the file.

        Args:
            until_ns: The time, in ns after the start of the session.

        Returns:
            The messages in play order, and the number of strays: messages that came too late,
            after one with a higher number in the same channel had been released.
        """
        sorted_messages = self._waiting.ordered()
        times_ns = sorted_messages.times_ns
        due_count = int(np.searchsorted(times_ns, until_ns, side="right"))
        return self._release(sorted_messages, due_count)

    def release_half(self) -> tuple[MessageBatch, int]:
        """Releases the earlier half of the waiting messages, because they need too much memory.

        Returns:
            The messages in play order, and the number of strays: messages that came too late,
            after one with a higher number in the same channel had been released.
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
    """Sends the messages of a log to the player, until all are read or the player has ended.

    This is the main function of the reader process. It reads a log that is too long for the
    memory, while another process, the player, publishes its messages. Each pass through the log
    is followed by a report of the damaged files and of the strays. These are messages so late
    in the file that they could not be put in order.

    Args:
        pipe: Pipe to the player.
        paths: The files.
        selection: Which messages are played.
        loop: True if the files are read again and again.
    """
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)

    def send(item: _ReadPiece | _RoundEnd | LogError) -> None:
        """Writes an item to the pipe, and waits until the player has made room.

        The wait limits how far the reader runs ahead, and thus the memory that it needs. Each
        item is preceded by its size, so that the player knows where it ends.
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
