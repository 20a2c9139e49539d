"""Message sources of the player: memory, or a process that reads ahead and sorts.

Invariant: polling a source never waits. The reader process is bounded (L6) by `HORIZON_NS` of the log, the
farthest that a message may stand from its turn, and by `LIMIT_BYTES`; it blocks on the pipe when the player
does not read, and the two share nothing else.
"""

import os
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np

from trilat_net import process
from trilat_net.errors import LogError, RuntimeFault

from .batch import BatchBuilder, MessageBatch, unpack_batch
from .session_reader import HORIZON_NS, PlaySelection, SessionHeader, SessionReader

FRAME_HEADER = struct.Struct("<cQ")
"""Head of everything that the process writes: its kind, and its number of bytes."""
BATCH_FRAME, TOPIC_FRAME, END_FRAME, ERROR_FRAME = b"B", b"T", b"E", b"X"
PORTION_BYTES = 131_072
"""Payload of a portion: small enough that receiving one does not delay the player."""
_READ_BYTES = 65_536
_AHEAD_BYTES = 16 * 1024 * 1024


class ReaderOrder(msgspec.Struct):
    """The task of a reader process: files, selection, and whether to read them again and again."""

    paths: list[str]
    selection: PlaySelection
    loop: bool


class RoundEnd(msgspec.Struct):
    """The end of a round: messages that stood too far from their turn, and damaged files with the reason."""

    strays: int
    torn: dict[str, str]


class MessageSource:
    """Messages in play order, round after round: here, a preloaded batch.

    Args:
        batch: all messages.

    Attributes:
        ended: True once all messages of this round were given.
        whole: True if one batch is the whole round.
        strays: messages that stood so far from their turn in the file that they are not played in it.
    """

    def __init__(self, batch: MessageBatch | None) -> None:
        self._batch = batch
        self.whole = batch is not None
        self.ended = False
        self.strays = 0

    def poll(self) -> MessageBatch | None:
        """Returns the next messages, or None if there are none, or none yet; never waits."""
        if self.ended:
            return None
        self.ended = True
        return self._batch

    def fill(self) -> bool:
        """Reads a little ahead; False if there is nothing to read now."""
        return False

    def restart(self) -> None:
        """Begins another round."""
        self.ended = False

    def close(self) -> None:
        """Ends the source; safe to call again."""


class ProcessSource(MessageSource):
    """Messages that another process reads while they are played.

    Args:
        paths: the files.
        selection: the messages to play.
        header: content of the files; gets the topics and damages that the process finds.
        loop: whether each round is followed by another.
    """

    def __init__(
        self, paths: Sequence[Path], selection: PlaySelection, header: SessionHeader, *, loop: bool
    ) -> None:
        super().__init__(None)
        self._header, self._loop = header, loop
        header.topics.clear()  # numbered anew by the process
        order = msgspec.json.encode(ReaderOrder([str(path) for path in paths], selection, loop))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "recorder.play.reader_process", order.decode()],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is the player's, which ends this process
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout.fileno()
        os.set_blocking(self._pipe, False)
        self._bytes = bytearray()
        self._frames: deque[tuple[bytes, bytes]] = deque()
        self._waiting = 0

    def poll(self) -> MessageBatch | None:
        """See `MessageSource`.

        Raises:
            LogError: a file cannot be read any more.
        """
        while self._frames and not self.ended:
            kind, body = self._frames.popleft()
            self._waiting -= len(body)
            if kind == BATCH_FRAME:
                return unpack_batch(body)
            if kind == TOPIC_FRAME:
                self._header.topics.append(body.decode())
            elif kind == ERROR_FRAME:
                raise LogError(body.decode())
            else:
                end = msgspec.json.decode(body, type=RoundEnd)
                self.strays += end.strays
                self._header.torn.update({Path(path): text for path, text in end.torn.items()})
                self.ended = True
        return None

    def fill(self) -> bool:
        """See `MessageSource`.

        Raises:
            RuntimeFault: the process failed.
        """
        if self._waiting + len(self._bytes) > _AHEAD_BYTES:
            return False
        try:
            read = os.read(self._pipe, _READ_BYTES)
        except BlockingIOError:
            return False
        if not read:
            finished = self.ended or any(kind == END_FRAME for kind, _ in self._frames)
            if self._process.wait() != 0 and not finished:
                raise RuntimeFault(f"the process that reads the log ended with {self._process.returncode}")
            return False
        self._bytes += read
        while len(self._bytes) >= FRAME_HEADER.size:
            kind, size = FRAME_HEADER.unpack_from(self._bytes)
            end = FRAME_HEADER.size + size
            if len(self._bytes) < end:
                break
            self._frames.append((kind, bytes(self._bytes[FRAME_HEADER.size : end])))
            self._waiting += size
            del self._bytes[:end]
        return True

    def restart(self) -> None:
        """See `MessageSource`."""
        self.ended = not self._loop

    def close(self) -> None:
        """See `MessageSource`."""
        if self._process.stdout is not None and not self._process.stdout.closed:
            self._process.terminate()
            self._process.stdout.close()
            self._process.wait()


STEP_NS = 10_000_000_000
"""Length of log that is put in order at a time."""
LIMIT_BYTES = 512 * 1024 * 1024
NICENESS = -5
"""Priority over others if permitted, because the player waits for it; below the player's."""


class MessageSorter:
    """Puts messages in order that stand in the file at most a horizon from their turn.

    Args:
        reader: the messages in file order.
        horizon_ns: that horizon.
        step_ns: length of log that is put in order at a time.
        limit_bytes: most memory; a longer horizon is shortened.

    Attributes:
        strays: messages that stood further from their turn.
    """

    def __init__(
        self,
        reader: SessionReader,
        horizon_ns: int = HORIZON_NS,
        step_ns: int = STEP_NS,
        limit_bytes: int = LIMIT_BYTES,
    ) -> None:
        self.strays = 0
        self._reader, self._horizon_ns, self._step_ns = reader, horizon_ns, step_ns
        self._limit_bytes = limit_bytes
        self._waiting = BatchBuilder()
        self._given: dict[int, int] = {}  # per channel the last number

    def batches(self) -> Iterator[MessageBatch]:
        """Yields the messages in play order."""
        newest_ns, next_ns = -(2**62), None
        for message in self._reader.messages():
            self._waiting.add(*message)
            self.strays += message.number < self._given.get(message.channel, -1)
            newest_ns = max(newest_ns, message.t_ns)
            if next_ns is None:
                next_ns = message.t_ns + self._horizon_ns + self._step_ns
            if newest_ns >= next_ns:
                yield self._release(newest_ns - self._horizon_ns)
                next_ns = newest_ns + self._step_ns
            elif self._waiting.memory > self._limit_bytes:
                yield self._release(None)
        yield self._release(1 << 62)

    def _release(self, until_ns: int | None) -> MessageBatch:
        """Returns the messages that are due until then, or half of all, and keeps the rest."""
        ordered = self._waiting.ordered()
        count = (len(ordered) + 1) // 2
        if until_ns is not None:
            count = int(np.searchsorted(ordered.times_ns, until_ns, side="right"))
        self._waiting = BatchBuilder()
        self._waiting.keep(ordered.part(slice(count, None)))
        released = ordered.part(slice(count))
        for channel in np.unique(released.channels).tolist():
            last = int(released.numbers[released.channels == channel].max())
            self._given[channel] = max(last, self._given.get(channel, -1))
        return released


def split_batch(batch: MessageBatch, size: int = PORTION_BYTES) -> Iterator[MessageBatch]:
    """Yields the messages in portions of some bytes, one message at least."""
    filled = np.cumsum(batch.sizes) // size
    edges = [0, *(np.flatnonzero(np.diff(filled)) + 1).tolist(), len(batch)]
    for begin, end in pairwise(edges):
        if end > begin:
            yield batch.part(slice(begin, end))


def feed_player(order: ReaderOrder, sink: BinaryIO) -> None:
    """Writes rounds of messages in the frames that `ProcessSource` reads."""
    paths = [Path(path) for path in order.paths]
    written_topics = 0

    def write(kind: bytes, body: bytes) -> None:
        sink.write(FRAME_HEADER.pack(kind, len(body)) + body)
        sink.flush()

    try:
        while True:
            reader = SessionReader(paths, order.selection)
            sorter = MessageSorter(reader)
            for batch in sorter.batches():
                topics = reader.header.topics if reader.header else []
                for topic in topics[written_topics:]:
                    write(TOPIC_FRAME, topic.encode())
                written_topics = max(written_topics, len(topics))
                for portion in split_batch(batch):
                    write(BATCH_FRAME, portion.packed())
            torn = reader.header.torn if reader.header else {}
            end = RoundEnd(sorter.strays, {str(path): text for path, text in torn.items()})
            write(END_FRAME, msgspec.json.encode(end))
            if not order.loop:
                return
    except LogError as error:
        write(ERROR_FRAME, str(error).encode())


def run_reader() -> None:
    """Feeds the player until everything is read or the player has ended."""
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    process.disable_gc()
    try:
        feed_player(msgspec.json.decode(sys.argv[1], type=ReaderOrder), sys.stdout.buffer)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    run_reader()
