"""The process that reads a log while it is played, and puts its messages in order.

    python -m trilat_net.playback.feeding '{"paths": ["run.mcap"], ...}'

Law (L6): bounded by `HORIZON_NS` of the log, which is how far a message may stand from its turn, and by
`LIMIT_BYTES`. It writes what the player takes, and waits where the player does not: the pipe between them is
all that they share.
"""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from .. import collector
from ..errors import LogError
from .block import Block, Gathering
from .reading import HORIZON_NS, Reading
from .selection import Selection
from .source import BLOCK, BLOCK_BYTES, END, ERROR, FRAME, TOPIC

STEP_NS = 10_000_000_000
"""How much of the log is put in order at a time."""
LIMIT_BYTES = 512 * 1024 * 1024
NICENESS = -5
"""Better than others where that is permitted, because the player waits for it; worse than the player."""


class Sorter:
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
        reading: Reading,
        horizon_ns: int = HORIZON_NS,
        step_ns: int = STEP_NS,
        limit_bytes: int = LIMIT_BYTES,
    ) -> None:
        self.strays = 0
        self._reading, self._horizon_ns, self._step_ns = reading, horizon_ns, step_ns
        self._limit_bytes = limit_bytes
        self._gathering = Gathering()
        self._given: dict[int, int] = {}

    def blocks(self) -> Iterator[Block]:
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

    def _released(self, until_ns: int | None) -> Block:
        """Returns what is due until then, or half of all, and keeps the rest."""
        ordered = self._gathering.ordered()
        count = (len(ordered) + 1) // 2
        if until_ns is not None:
            count = int(np.searchsorted(ordered.times_ns, until_ns, side="right"))
        self._gathering = Gathering()
        self._gathering.keep(ordered.part(slice(count, None)))
        return self._note(ordered.part(slice(count)))

    def _note(self, block: Block) -> Block:
        """Notes what is given, per channel the last number."""
        for channel in np.unique(block.channels).tolist():
            last = int(block.numbers[block.channels == channel].max())
            self._given[channel] = max(last, self._given.get(channel, -1))
        return block


def portions(block: Block, size: int = BLOCK_BYTES) -> Iterator[Block]:
    """Yields the messages in portions of some bytes, one message at least."""
    filled = np.cumsum(block.ends - block.starts) // size
    edges = [0, *(np.flatnonzero(np.diff(filled)) + 1).tolist(), len(block)]
    for begin, end in pairwise(edges):
        if end > begin:
            yield block.part(slice(begin, end))


def feed(order: dict[str, Any], sink: BinaryIO) -> None:
    """Writes rounds of messages, as `source.Feed` takes them."""
    paths = [Path(path) for path in order.pop("paths")]
    loop = order.pop("loop")
    selection = Selection(tuple(order.pop("include")), tuple(order.pop("exclude")), **order)
    told = 0

    def tell(kind: bytes, body: bytes) -> None:
        sink.write(FRAME.pack(kind, len(body)) + body)
        sink.flush()

    try:
        while True:
            reading = Reading(paths, selection)
            sorter = Sorter(reading)
            for ordered in sorter.blocks():
                topics = reading.facts.topics if reading.facts else []
                for topic in topics[told:]:
                    tell(TOPIC, topic.encode())
                told = max(told, len(topics))
                for portion in portions(ordered):
                    tell(BLOCK, portion.packed())
            torn = reading.facts.torn if reading.facts else {}
            end = {"strays": sorter.strays, "torn": {str(path): text for path, text in torn.items()}}
            tell(END, json.dumps(end).encode())
            if not loop:
                return
    except LogError as error:
        tell(ERROR, str(error).encode())


def main() -> None:
    """Feeds until it is done, or nobody takes it any more."""
    with suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICENESS)
    collector.off_for_good()
    try:
        feed(json.loads(sys.argv[1]), sys.stdout.buffer)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
