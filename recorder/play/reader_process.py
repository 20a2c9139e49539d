"""Message sources of the player: memory, or a process that reads ahead and sorts.

    python -m recorder.play.reader_process '{"paths": ["run.mcap"], ...}'

Invariant: polling a source never waits. The reader process is bounded (L6) by `HORIZON_NS` of the log, the
farthest that a message may stand from its turn, and by `LIMIT_BYTES`; it blocks on the pipe when the player
does not read, and the two share nothing else.
"""

import json
import os
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np

from trilat_net import process
from trilat_net.errors import LogError, RuntimeFault

from .batch import BatchBuilder, MessageBatch, unpack_batch
from .session_reader import HORIZON_NS, PlaySelection, SessionHeader, SessionReader

FRAME_HEADER = struct.Struct("<cQ")
"""What goes before everything that the process says: what it is, and how many bytes it has."""
BATCH_FRAME, TOPIC_FRAME, END_FRAME, ERROR_FRAME = b"B", b"T", b"E", b"X"
PORTION_BYTES = 131_072
"""Payload of a block: so little that taking one in does not hold the player up."""
_READ_BYTES = 65_536
_AHEAD_BYTES = 16 * 1024 * 1024


class MessageSource(Protocol):
    """Messages in the order of play, round after round."""

    @property
    def ended(self) -> bool:
        """True once all messages of this round have been given."""

    @property
    def whole(self) -> bool:
        """True where one block is the whole round."""

    @property
    def strays(self) -> int:
        """How many messages stood in the file so far from their turn that they are not played in it."""

    def poll(self) -> MessageBatch | None:
        """Returns the next messages, or None where there are none, or none yet; never waits."""

    def fill(self) -> bool:
        """Takes in a little of what is to come; False where there is nothing to take in now."""

    def again(self) -> None:
        """Begins another round."""

    def close(self) -> None:
        """Ends; safe to call again."""


class MemorySource:
    """Messages that lie in memory.

    Args:
        block: all of them.
    """

    whole = True
    strays = 0

    def __init__(self, block: MessageBatch) -> None:
        self._block, self.ended = block, False

    def poll(self) -> MessageBatch | None:
        """See `Source`."""
        if self.ended:
            return None
        self.ended = True
        return self._block

    def fill(self) -> bool:
        """See `Source`."""
        return False

    def again(self) -> None:
        """See `Source`."""
        self.ended = False

    def close(self) -> None:
        """See `Source`."""


class ProcessSource:
    """Messages that another process reads while they are played.

    Args:
        paths: the files.
        selection: what is played.
        facts: what the files say; takes in what the process finds besides.
        loop: whether there is another round after each.

    """

    whole = False

    def __init__(
        self, paths: Sequence[Path], selection: PlaySelection, facts: SessionHeader, *, loop: bool
    ) -> None:
        self.strays = 0
        self.ended = False
        self._facts, self._loop = facts, loop
        facts.topics.clear()  # numbered anew by the process
        order = {"paths": [str(path) for path in paths], "loop": loop, **_fields(selection)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "recorder.play.reader_process", json.dumps(order)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is the player's, who ends it
        )
        assert self._process.stdout is not None
        self._pipe = self._process.stdout.fileno()
        os.set_blocking(self._pipe, False)
        self._bytes = bytearray()
        self._frames: deque[tuple[bytes, bytes]] = deque()
        self._waiting = 0

    def poll(self) -> MessageBatch | None:
        """See `Source`.

        Raises:
            LogError: a file cannot be read any more.
        """
        while self._frames and not self.ended:
            kind, body = self._frames.popleft()
            self._waiting -= len(body)
            if kind == BATCH_FRAME:
                return unpack_batch(body)
            if kind == TOPIC_FRAME:
                self._facts.topics.append(body.decode())
            elif kind == ERROR_FRAME:
                raise LogError(body.decode())
            else:
                end = json.loads(body)
                self.strays += end["strays"]
                self._facts.torn.update({Path(path): text for path, text in end["torn"].items()})
                self.ended = True
        return None

    def fill(self) -> bool:
        """See `Source`."""
        if self._waiting + len(self._bytes) > _AHEAD_BYTES:
            return False
        try:
            read = os.read(self._pipe, _READ_BYTES)
        except BlockingIOError:
            return False
        if not read:
            return self._over()
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

    def _over(self) -> bool:
        """The process has ended: in order, with an END behind all, or not."""
        if self._process.wait() != 0 and not (
            self.ended or any(kind == END_FRAME for kind, _ in self._frames)
        ):
            raise RuntimeFault(f"the process that reads the log has ended with {self._process.returncode}")
        return False

    def again(self) -> None:
        """See `Source`."""
        self.ended = not self._loop

    def close(self) -> None:
        """See `Source`."""
        if self._process.stdout is not None and not self._process.stdout.closed:
            self._process.terminate()
            self._process.stdout.close()
            self._process.wait()


def _fields(selection: PlaySelection) -> dict[str, object]:
    return {
        "include": list(selection.include),
        "exclude": list(selection.exclude),
        "start_ns": selection.start_ns,
        "stop_ns": selection.stop_ns,
        "time": selection.time,
    }


STEP_NS = 10_000_000_000
"""How much of the log is put in order at a time."""
LIMIT_BYTES = 512 * 1024 * 1024
NICENESS = -5
"""Better than others where that is permitted, because the player waits for it; worse than the player."""


class MessageSorter:
    """Puts messages in order that stand in the file at most a horizon from their turn.

    Args:
        reading: where they come from.
        horizon_ns: that horizon.
        step_ns: how much to put in order at a time.
        limit_bytes: how much may be held; what would be more shortens the horizon.

    Attributes:
        strays: messages that stood further from it.
    """

    def __init__(
        self,
        reading: SessionReader,
        horizon_ns: int = HORIZON_NS,
        step_ns: int = STEP_NS,
        limit_bytes: int = LIMIT_BYTES,
    ) -> None:
        self.strays = 0
        self._reading, self._horizon_ns, self._step_ns = reading, horizon_ns, step_ns
        self._limit_bytes = limit_bytes
        self._gathering = BatchBuilder()
        self._given: dict[int, int] = {}

    def blocks(self) -> Iterator[MessageBatch]:
        """Yields the messages in the order of play."""
        newest_ns, next_ns = -(2**62), None
        for message in self._reading.messages():
            self._gathering.add(*message)
            self.strays += message.number < self._given.get(message.channel, -1)
            newest_ns = max(newest_ns, message.t_ns)
            if next_ns is None:
                next_ns = message.t_ns + self._horizon_ns + self._step_ns
            if newest_ns >= next_ns:
                yield self._released(newest_ns - self._horizon_ns)
                next_ns = newest_ns + self._step_ns
            elif self._gathering.memory > self._limit_bytes:
                yield self._released(None)
        yield self._note(self._gathering.ordered())

    def _released(self, until_ns: int | None) -> MessageBatch:
        """Returns what is due until then, or half of all, and keeps the rest."""
        ordered = self._gathering.ordered()
        count = (len(ordered) + 1) // 2
        if until_ns is not None:
            count = int(np.searchsorted(ordered.times_ns, until_ns, side="right"))
        self._gathering = BatchBuilder()
        self._gathering.keep(ordered.part(slice(count, None)))
        return self._note(ordered.part(slice(count)))

    def _note(self, block: MessageBatch) -> MessageBatch:
        """Notes what is given, per channel the last number."""
        for channel in np.unique(block.channels).tolist():
            last = int(block.numbers[block.channels == channel].max())
            self._given[channel] = max(last, self._given.get(channel, -1))
        return block


def split_batch(block: MessageBatch, size: int = PORTION_BYTES) -> Iterator[MessageBatch]:
    """Yields the messages in portions of some bytes, one message at least."""
    filled = np.cumsum(block.ends - block.starts) // size
    edges = [0, *(np.flatnonzero(np.diff(filled)) + 1).tolist(), len(block)]
    for begin, end in pairwise(edges):
        if end > begin:
            yield block.part(slice(begin, end))


def feed_player(order: dict[str, Any], sink: BinaryIO) -> None:
    """Writes rounds of messages, as `source.Feed` takes them."""
    paths = [Path(path) for path in order.pop("paths")]
    loop = order.pop("loop")
    selection = PlaySelection(tuple(order.pop("include")), tuple(order.pop("exclude")), **order)
    told = 0

    def tell(kind: bytes, body: bytes) -> None:
        sink.write(FRAME_HEADER.pack(kind, len(body)) + body)
        sink.flush()

    try:
        while True:
            reading = SessionReader(paths, selection)
            sorter = MessageSorter(reading)
            for ordered in sorter.blocks():
                topics = reading.facts.topics if reading.facts else []
                for topic in topics[told:]:
                    tell(TOPIC_FRAME, topic.encode())
                told = max(told, len(topics))
                for portion in split_batch(ordered):
                    tell(BATCH_FRAME, portion.packed())
            torn = reading.facts.torn if reading.facts else {}
            end = {"strays": sorter.strays, "torn": {str(path): text for path, text in torn.items()}}
            tell(END_FRAME, json.dumps(end).encode())
            if not loop:
                return
    except LogError as error:
        tell(ERROR_FRAME, str(error).encode())


def run_reader() -> None:
    """Feeds until it is done, or nobody takes it any more."""
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    process.disable_gc()
    try:
        feed_player(json.loads(sys.argv[1]), sys.stdout.buffer)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    run_reader()
