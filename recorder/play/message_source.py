"""The source of a player's messages: a preloaded batch, or a process that reads ahead and
sorts.

Invariant: polling the source never waits. The reader process is bounded (L6) by `HORIZON_NS` of
the log, the farthest that a message may stand from its turn, and by `LIMIT_BYTES`; it blocks on
the pipe when the player does not read, and the two share nothing else.
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

from trilat_net import process
from trilat_net.errors import LogError, RuntimeFault

from .batch import BatchBuilder, MessageBatch, PlayedMessage
from .session_reader import HORIZON_NS, PlaySelection, SessionHeader, SessionReader

SIZE = struct.Struct("<Q")
"""Number of bytes of the pickle that follows, in the pipe of a reader process."""
READ_BYTES = 65_536
AHEAD_BYTES = 16 * 1024 * 1024
STEP_NS = 10_000_000_000
"""Length of log that is put in order at a time."""
LIMIT_BYTES = 512 * 1024 * 1024
NICENESS = -5
"""Priority over others if permitted, because the player waits for it; below the player's."""


class RoundEnd(NamedTuple):
    """The end of a round: messages that stood too far from their turn, and damaged files with
    the reason.
    """

    strays: int
    torn: dict[Path, str]


class ReadPiece(NamedTuple):
    """What the reader process sends: messages, and the topics of all channels so far."""

    topics: list[str]
    batch: MessageBatch


class MessageSource:
    """Messages in play order, round after round.

    Args:
        header: content of the files; gets the topics and damages that a reader process finds.
        batch: all messages; None: `read` starts a process that reads them.

    Attributes:
        ended: True once all messages of this round were given.
        whole: True if one batch is the whole round.
        strays: messages that stood so far from their turn in the file that they are not played
            in it.
    """

    def __init__(self, header: SessionHeader, batch: MessageBatch | None) -> None:
        self.whole = batch is not None
        self.ended = False
        self.strays = 0
        self._header = header
        self._batch = batch
        self._ahead: deque[ReadPiece | RoundEnd | LogError] = deque()
        self._ahead_bytes = 0
        self._received = bytearray()
        self._process: multiprocessing.process.BaseProcess | None = None
        self.restart()

    def read(self, paths: Sequence[Path], selection: PlaySelection, *, loop: bool) -> None:
        """Starts the reader process; `loop`: it reads round after round."""
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe(duplex=False)
        # as its own methods would wait for the rest of a piece
        os.set_blocking(self._pipe.fileno(), False)
        self._process = context.Process(
            target=feed_player, args=(theirs, paths, selection, loop), daemon=True
        )
        with process.hold_sigint():  # Ctrl-C is the player's, which ends this process
            self._process.start()
        theirs.close()

    def poll(self) -> MessageBatch | None:
        """Returns the next messages, or None if there are none, or none yet; never waits.

        Raises:
            LogError: a file cannot be read any more.
        """
        if self.ended or not self._ahead:
            return None
        item = self._ahead.popleft()
        if isinstance(item, LogError):
            raise item
        if isinstance(item, ReadPiece):
            self._header.topics[:] = item.topics
            self._ahead_bytes -= len(item.batch.data)
            return item.batch
        self.strays += item.strays
        self._header.torn.update(item.torn)
        self.ended = True
        return None

    def fill(self) -> bool:
        """Reads a little ahead; False if there is nothing to read now.

        Raises:
            RuntimeFault: the process failed.
        """
        if self._process is None or self._ahead_bytes > AHEAD_BYTES:
            return False
        try:
            read = os.read(self._pipe.fileno(), READ_BYTES)
        except BlockingIOError:
            return False
        if not read:
            # None while it ends, which takes time that the player does not have
            if self._process.exitcode:
                raise RuntimeFault(
                    f"the process that reads the log ended with {self._process.exitcode}"
                )
            return False
        self._received += read
        while len(self._received) >= SIZE.size:
            end = SIZE.size + SIZE.unpack_from(self._received)[0]
            if len(self._received) < end:
                break
            item = pickle.loads(self._received[SIZE.size : end])
            del self._received[:end]
            self._ahead.append(item)
            self._ahead_bytes += len(item.batch.data) if isinstance(item, ReadPiece) else 0
        return True

    def restart(self) -> None:
        """Begins another round."""
        self.ended = False
        if self._batch is not None:
            self._ahead.extend((ReadPiece(self._header.topics, self._batch), RoundEnd(0, {})))

    def close(self) -> None:
        """Ends the source; safe to call again."""
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
    """Yields messages in play order that stand in the file at most a horizon from their turn.

    Args:
        messages: in file order.
        horizon_ns: that horizon.
        step_ns: length of log that is put in order at a time.
        limit_bytes: most memory; a longer horizon is shortened.

    Yields:
        Messages, and how many of them stood further from their turn.
    """
    waiting = BatchBuilder()
    given: dict[int, int] = {}  # per channel the last number

    def release(until_ns: int | None) -> tuple[MessageBatch, int]:
        """Returns the messages that are due until then, or half of all, and keeps the rest."""
        nonlocal waiting
        ordered = waiting.ordered()
        strays = 0
        count = (len(ordered) + 1) // 2
        if until_ns is not None:
            count = int(np.searchsorted(ordered.times_ns, until_ns, side="right"))
        waiting = BatchBuilder(ordered.part(slice(count, None)))
        released = ordered.part(slice(count))
        for channel in np.unique(released.channels).tolist():
            numbers = released.numbers[released.channels == channel]
            last = given.get(channel, int(numbers.min()))
            strays += int(np.count_nonzero(numbers < last))
            given[channel] = max(last, int(numbers.max()))
        return released, strays

    newest_ns = -(2**62)
    next_ns = None
    for message in messages:
        waiting.add(*message)
        newest_ns = max(newest_ns, message[0])
        if next_ns is None:
            next_ns = newest_ns + horizon_ns + step_ns
        if newest_ns >= next_ns:
            yield release(newest_ns - horizon_ns)
            next_ns = newest_ns + step_ns
        elif waiting.memory > limit_bytes:
            yield release(None)
    yield release(1 << 62)


def feed_player(
    pipe: Connection, paths: Sequence[Path], selection: PlaySelection, loop: bool
) -> None:
    """Sends rounds of messages, until everything is read or the player has ended."""
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)

    def send(item: ReadPiece | RoundEnd | LogError) -> None:
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
                for batch, further in sort_messages(reader.messages()):
                    strays += further
                    for piece in batch.pieces():
                        assert reader.header is not None  # there was a message
                        send(ReadPiece(reader.header.topics, piece.compact()))
                send(RoundEnd(strays, reader.header.torn if reader.header else {}))
                if not loop:
                    return
        except LogError as error:
            send(LogError(str(error)))
