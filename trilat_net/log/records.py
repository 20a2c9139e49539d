"""The records of a site, decoded: at once where they are few, when they are looked at where they are many.

Law: memory stays bounded however long a log is; who reads on from record to record does not notice.
"""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from .. import collector
from ..net.messages import State

HELD = 1 << 16
"""Records of a site that are held decoded, at most: a minute at 1 kHz, some 150 MB."""
BLOCK = 1 << 11
"""Records that are decoded together."""


HEAVY_BYTES = 12 << 20
HEAVY_RATIO = 10
"""Records whose decoded form takes more than this, and than so many times their payloads, are held few at a
time: they were made to take much."""
HEAVY_BLOCK, HEAVY_BLOCKS = 128, 8
"""Heavy records that are decoded together, and how many times that many are held."""


class Records(Sequence[State]):
    """Records decoded a block at a time; the blocks looked at last are held.

    Args:
        payloads: the records as published.
        decoded: decodes some of them.
        heavy: whether they take much each.
    """

    def __init__(
        self,
        payloads: Sequence[bytes],
        decoded: Callable[[Sequence[bytes]], list[State]],
        *,
        heavy: bool = False,
    ) -> None:
        self._size, self._held = (HEAVY_BLOCK, HEAVY_BLOCKS) if heavy else (BLOCK, HELD // BLOCK)
        self._payloads = payloads
        self._decoded = decoded
        self._blocks: OrderedDict[int, list[State]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._payloads)

    def __iter__(self) -> Iterator[State]:
        for number in range(-(-len(self._payloads) // self._size)):
            yield from self._block(number)

    @overload
    def __getitem__(self, place: int) -> State: ...
    @overload
    def __getitem__(self, place: slice) -> list[State]: ...
    def __getitem__(self, place: int | slice) -> State | list[State]:
        if isinstance(place, slice):
            return [self[n] for n in range(*place.indices(len(self)))]
        index = place + len(self) if place < 0 else place
        if not 0 <= index < len(self):
            raise IndexError(f"record {place} of {len(self)}")
        return self._block(index // self._size)[index % self._size]

    def _block(self, number: int) -> list[State]:
        block = self._blocks.get(number)
        if block is None:
            block = self._decoded(self._payloads[number * self._size : (number + 1) * self._size])
            self._blocks[number] = block
            if len(self._blocks) > self._held:
                self._blocks.popitem(last=False)
        else:
            self._blocks.move_to_end(number)
        return block


def records(payloads: Sequence[bytes], decoded: Callable[[Sequence[bytes]], list[State]]) -> Sequence[State]:
    """Returns the records of a site, in the order of their payloads.

    Args:
        payloads: the records as published.
        decoded: decodes some of them, or raises what is to be raised where one is none.
    """
    if len(payloads) > HELD:
        return Records(payloads, decoded)
    room = max(HEAVY_BYTES, HEAVY_RATIO * sum(map(len, payloads)))
    held: list[State] = []
    with collector.paused():
        for first in range(0, len(payloads), BLOCK):
            block = decoded(payloads[first : first + BLOCK])
            room -= sum(map(_weight, block))
            if room < 0:
                return Records(payloads, decoded, heavy=True)
            held += block
    return held


def _weight(state: State) -> int:
    """Returns how many bytes a record takes, about."""
    lists = len(state.rx) + len(state.echo) + len(state.cmd)
    return 2_000 + 130 * lists + 100 * len(state.used) + 32 * len(state.mem)


class ByTick(Mapping[int, State]):
    """Records by their tick; of several with one tick, the last.

    Args:
        states: the records in order of their ticks.
        ticks: those, shape (K,).
    """

    def __init__(self, states: Sequence[State], ticks: NDArray[np.int64]) -> None:
        self._states = states
        self._ticks = ticks.tolist()

    def __getitem__(self, tick: int) -> State:
        place = bisect_right(self._ticks, tick) - 1
        if place < 0 or self._ticks[place] != tick:
            raise KeyError(tick)
        return self._states[place]

    def __iter__(self) -> Iterator[int]:
        return iter(dict.fromkeys(self._ticks))

    def __len__(self) -> int:
        return len(set(self._ticks))
