"""Stores the encoded messages of a channel one after another in one block of bytes.

Compiled code can read the block without creating a Python object per message. To all other code
it behaves like a list of `bytes`.
"""

from collections.abc import Iterator, Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

PADDING = 16
"""Number of bytes after the last message. They make it possible to load eight bytes at any
offset of a message, and after the header of a number at its end.
"""


class PackedMessages(Sequence[bytes]):
    """Immutable list of encoded messages, stored in one block of bytes.

    A message becomes a `bytes` object only when it is accessed, because thousands of objects
    would take much memory and time.

    Args:
        data: The messages, followed by `PADDING` bytes.
        starts: Offset of the first byte of each of the K messages, shape (K,).
        ends: Offset after the last byte of each message, shape (K,).

    Attributes:
        data: The bytes of all messages.
        starts: See Args.
        ends: See Args.
    """

    def __init__(self, data: Bytes, starts: Ints, ends: Ints) -> None:
        # Compiled code exists only for bytes that cannot be changed.
        self.data = data.view()
        self.data.setflags(write=False)
        self.starts = starts
        self.ends = ends

    @classmethod
    def pack(cls, payloads: Sequence[bytes]) -> "PackedMessages":
        """Packs encoded messages into one block of bytes to save memory.

        Args:
            payloads: The encoded messages. Packed messages are returned unchanged.
        """
        if isinstance(payloads, PackedMessages):
            return payloads
        data = np.frombuffer(b"".join([*payloads, bytes(PADDING)]), np.uint8)
        lengths = np.fromiter(map(len, payloads), np.int64, len(payloads))
        ends = np.cumsum(lengths)
        starts = ends - lengths
        return cls(data, starts, ends)

    def select(self, rows: Ints | slice) -> "PackedMessages":
        """Returns a selection of the messages, in any order, without copying their bytes.

        Args:
            rows: Indices of the messages in this sequence, or a slice.
        """
        return PackedMessages(self.data, self.starts[rows], self.ends[rows])

    def __len__(self) -> int:
        return len(self.starts)

    def __iter__(self) -> Iterator[bytes]:
        view = self.data.data
        for start, end in zip(self.starts.tolist(), self.ends.tolist(), strict=True):
            yield view[start:end].tobytes()

    @overload
    def __getitem__(self, index: int) -> bytes: ...
    @overload
    def __getitem__(self, index: slice) -> list[bytes]: ...
    def __getitem__(self, index: int | slice) -> bytes | list[bytes]:
        if isinstance(index, slice):
            return list(self.select(index))
        number = range(len(self))[index]  # raises IndexError, and resolves negative indices
        return self.data[self.starts[number] : self.ends[number]].tobytes()

    def __eq__(self, other: Any) -> bool:
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(
            mine == theirs for mine, theirs in zip(self, other, strict=True)
        )

    __hash__ = None  # type: ignore[assignment] # equal to lists, which have no hash
