"""Where the player gets its messages from: memory, or a process that reads ahead.

Law: asking for more never waits.
"""

import json
import os
import struct
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from ..errors import LogError, RuntimeFault
from .block import Block, unpacked
from .reading import Facts
from .selection import Selection

FRAME = struct.Struct("<cQ")
"""What goes before everything that the process says: what it is, and how many bytes it has."""
BLOCK, TOPIC, END, ERROR = b"B", b"T", b"E", b"X"
BLOCK_BYTES = 131_072
"""Payload of a block: so little that taking one in does not hold the player up."""
_READ_BYTES = 65_536
_AHEAD_BYTES = 16 * 1024 * 1024


class Source(Protocol):
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

    def poll(self) -> Block | None:
        """Returns the next messages, or None where there are none, or none yet; never waits."""

    def fill(self) -> bool:
        """Takes in a little of what is to come; False where there is nothing to take in now."""

    def again(self) -> None:
        """Begins another round."""

    def close(self) -> None:
        """Ends; safe to call again."""


class Held:
    """Messages that lie in memory.

    Args:
        block: all of them.
    """

    whole = True
    strays = 0

    def __init__(self, block: Block) -> None:
        self._block, self.ended = block, False

    def poll(self) -> Block | None:
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


class Feed:
    """Messages that another process reads while they are played.

    Args:
        paths: the files.
        selection: what is played.
        facts: what the files say; takes in what the process finds besides.
        loop: whether there is another round after each.

    """

    whole = False

    def __init__(self, paths: Sequence[Path], selection: Selection, facts: Facts, *, loop: bool) -> None:
        self.strays = 0
        self.ended = False
        self._facts, self._loop = facts, loop
        facts.topics.clear()  # numbered anew by the process
        order = {"paths": [str(path) for path in paths], "loop": loop, **_fields(selection)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "trilat_net.playback.feeding", json.dumps(order)],
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

    def poll(self) -> Block | None:
        """See `Source`.

        Raises:
            LogError: a file cannot be read any more.
        """
        while self._frames and not self.ended:
            kind, body = self._frames.popleft()
            self._waiting -= len(body)
            if kind == BLOCK:
                return unpacked(body)
            if kind == TOPIC:
                self._facts.topics.append(body.decode())
            elif kind == ERROR:
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
        while len(self._bytes) >= FRAME.size:
            kind, size = FRAME.unpack_from(self._bytes)
            end = FRAME.size + size
            if len(self._bytes) < end:
                break
            self._frames.append((kind, bytes(self._bytes[FRAME.size : end])))
            self._waiting += size
            del self._bytes[:end]
        return True

    def _over(self) -> bool:
        """The process has ended: in order, with an END behind all, or not."""
        if self._process.wait() != 0 and not (self.ended or any(kind == END for kind, _ in self._frames)):
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


def _fields(selection: Selection) -> dict[str, object]:
    return {
        "include": list(selection.include),
        "exclude": list(selection.exclude),
        "start_ns": selection.start_ns,
        "stop_ns": selection.stop_ns,
        "time": selection.time,
    }
