"""Looks at every byte of an MCAP file: whether it is built as the specification says.

Law: what is wrong is told with the place where it is; what follows from it is not told again. A file of
anybody is judged, not only a log of ours.
"""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from .chunks import Progress
from .directory import ChunkFacts, Directory
from .framing import HEAD, MAGIC, Frame, Framing, parsed
from .packed import Unreadable, unpacked

_MESSAGE = struct.Struct("<HIQQ")
_INDEX = struct.Struct("<HI")
MAX_PROBLEMS = 1000
"""Problems that are kept; more are counted."""


class Problem(NamedTuple):
    """Something wrong in a file.

    Attributes:
        check: what it is a matter of: "whole", "crc", "records", "index".
        offset: at which byte.
        text: what is wrong.
    """

    check: str
    offset: int
    text: str


class Raw(NamedTuple):
    """A message as the file has it.

    Attributes:
        channel: number of its channel.
        sequence: its number, modulo 2^32.
        log_ns: when it came, Unix ns.
        publish_ns: when it was sent, Unix ns.
        payload: its bytes.
        offset: where its chunk begins, or itself where it is in none.
    """

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    payload: bytes
    offset: int


class Structure:
    """One pass over a file.

    Args:
        stream: the file, opened for reading.
        progress: told after every record how many bytes are read, and how many there are.

    Attributes:
        schemas: by number, as the `mcap` package has them.
        channels: by number, likewise.
        metadata: entries by name.
        attachments: data by name.
        chunks: how many.
        messages: how many, per channel.
        crcs: how many checksums were compared.
        problems: what is wrong; the first of it.
        wrong: how many things are wrong, by check.
    """

    def __init__(self, stream: BinaryIO, progress: Progress | None = None) -> None:
        self.schemas: dict[int, Any] = {}
        self.channels: dict[int, Any] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.chunks = self.crcs = 0
        self.messages: Counter[int] = Counter()
        self.problems: list[Problem] = []
        self.wrong: Counter[str] = Counter()
        self._framing = Framing(stream)
        self._directory = Directory(self._tell)
        self._progress = progress
        self._chunk: ChunkFacts | None = None
        self._entries: dict[int, NDArray[np.uint64]] = {}
        self._hidden = False  # whether something that cannot be read may have named a channel

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._framing.size

    @property
    def finished(self) -> bool:
        """True once all was read, to the end of a file that was finished."""
        return self._framing.finished

    def _tell(self, check: str, offset: int, text: str) -> None:
        self.wrong[check] += 1
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(Problem(check, offset, text))

    def read(self) -> Iterator[Raw]:
        """Looks at everything, and yields every message that can be read, in the order of the file."""
        framing = self._framing
        if not framing.begins:
            self._tell("whole", 0, "does not begin as an MCAP file does" if framing.size else "is empty")
            return
        before = 0
        frame = None
        for frame in framing.frames():
            if frame.offset == len(MAGIC) and frame.opcode != Opcode.HEADER:
                self._tell("records", frame.offset, "the first record is no header")
            try:
                yield from self._look(frame)
            except Unreadable as error:
                text = str(error)
                self._tell("crc" if "CRC" in text else "records", frame.offset, text)
                self._chunk = None
                self._hidden = True
            for damage in framing.damaged[before:]:
                self._tell("whole", damage.offset, str(damage))
                self._hidden = True
            before = len(framing.damaged)
            if self._progress is not None:
                self._progress(frame.end, framing.size)
        self._end(frame, before)

    def _end(self, last: Frame | None, before: int) -> None:
        framing = self._framing
        for damage in framing.damaged[before:]:
            self._tell("whole", damage.offset, str(damage))
        if framing.torn is not None:
            self._tell("whole", framing.torn.offset, f"is cut off: {framing.torn.problem}")
        elif last is not None and last.opcode == Opcode.FOOTER and last.end + len(MAGIC) != framing.size:
            more = framing.size - last.end - len(MAGIC)
            self._tell("whole", last.end + len(MAGIC), f"{more} bytes follow the end mark")
        if framing.finished and not framing.damaged:
            counted = None if self.wrong["crc"] or self.wrong["records"] else self.messages
            self.crcs += self._directory.compare(framing, counted, self.schemas, self.channels)

    def _look(self, frame: Frame) -> Iterator[Raw]:
        content = self._framing.content(frame)
        opcode = frame.opcode
        if opcode == Opcode.CHUNK:
            yield from self._in_chunk(frame, content)
            return
        if opcode == Opcode.MESSAGE_INDEX:
            self._message_index(frame, content)
            return
        self._chunk = None
        if opcode == Opcode.MESSAGE:
            self._directory.data(frame)
            yield self._message(content, 0, len(content), frame.offset)
        elif opcode in _KNOWN:
            if opcode == Opcode.ATTACHMENT:
                self._check_attachment(content)
            record = parsed(opcode, content)
            self._directory.take(frame, record)
            self._keep(opcode, record, frame.offset)
        elif opcode < 0x80:
            self._tell("records", frame.offset, f"a record of kind {opcode} is none of the format")

    def _keep(self, opcode: int, record: Any, offset: int) -> None:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, record, offset)
        elif opcode == Opcode.METADATA:
            self.metadata.setdefault(record.name, record.metadata)
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.setdefault(record.name, record.data)

    def _define(self, opcode: int, record: Any, offset: int) -> None:
        """Takes in a schema or a channel; one that came before must be the same."""
        known, what = (self.schemas, "schema") if opcode == Opcode.SCHEMA else (self.channels, "channel")
        if known.setdefault(record.id, record) != record:
            self._tell("records", offset, f"{what} {record.id} is not what it was before")
        if opcode == Opcode.SCHEMA and not record.id:
            self._tell("records", offset, "a schema has the number 0, which means none")
        unknown = opcode == Opcode.CHANNEL and record.schema_id and record.schema_id not in self.schemas
        if unknown and not self._hidden:
            self._tell(
                "records",
                offset,
                f"channel {record.id} names schema {record.schema_id}, which comes nowhere before",
            )

    def _check_attachment(self, content: bytes) -> None:
        crc = int.from_bytes(content[-4:], "little")
        self.crcs += bool(crc)
        if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
            raise Unreadable("an attachment's CRC differs")

    def _message(self, data: bytes, start: int, end: int, offset: int) -> Raw:
        if end - start < _MESSAGE.size:
            raise Unreadable("a message is shorter than its head")
        channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, start)
        if channel not in self.channels and not self.messages[channel] and not self._hidden:
            self._tell("records", offset, f"messages of channel {channel}, which comes nowhere before")
        self.messages[channel] += 1
        return Raw(channel, sequence, log_ns, publish_ns, data[start + _MESSAGE.size : end], offset)

    def _in_chunk(self, frame: Frame, content: bytes) -> Iterator[Raw]:
        head = self._framing.head(frame)
        self.chunks += 1
        chunk = self._directory.chunk(frame, head)
        data = unpacked(content)
        self.crcs += bool(head.crc)
        places: dict[int, array[int]] = {}
        for opcode, start, end in _inner(data):
            if opcode == Opcode.MESSAGE:
                message = self._message(data, start, end, frame.offset)
                entries = places.get(message.channel)
                if entries is None:
                    entries = places[message.channel] = array("Q")
                entries.append(message.log_ns)
                entries.append(start - HEAD)
                yield message
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, parsed(opcode, data[start:end]), frame.offset)
            else:
                self._tell("records", frame.offset, f"a chunk holds a record of kind {opcode}")
        self._entries = {
            channel: np.frombuffer(entries, dtype=np.uint64).reshape(-1, 2)
            for channel, entries in places.items()
        }
        span = [int(ends) for a in self._entries.values() for ends in (a[:, 0].min(), a[:, 0].max())]
        first_ns, last_ns = min(span, default=0), max(span, default=0)
        if span and (head.start_ns, head.end_ns) != (first_ns, last_ns):
            told = f"{head.start_ns} to {head.end_ns}"
            self._tell("index", frame.offset, f"a chunk of log times {first_ns} to {last_ns} says {told} ns")
        self._chunk = chunk

    def _message_index(self, frame: Frame, content: bytes) -> None:
        if self._chunk is None:
            self._directory.skip(frame)
            return  # of a chunk that could not be read
        try:
            channel, length = _INDEX.unpack_from(content)
        except struct.error:
            raise Unreadable("a message index is cut off") from None
        self._chunk.indexes[channel] = frame.offset
        self._chunk.indexes_end = frame.end
        body = memoryview(content)[_INDEX.size :]
        if length != len(body) or length % 16:
            raise Unreadable(f"a message index of {len(body)} bytes says that it has {length}")
        told = np.frombuffer(body, dtype="<u8").reshape(-1, 2)
        there = self._entries.get(channel, np.empty((0, 2), dtype=np.uint64))
        if len(told) != len(there) or (_sorted(told) != _sorted(there)).any():
            self._tell(
                "index", frame.offset, f"the index of channel {channel} in a chunk is not what is there"
            )


def _sorted(entries: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Returns entries of an index in the order of their places."""
    return entries[np.argsort(entries[:, 1], kind="stable")]


def _inner(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields the records inside a chunk: opcode, where the content begins, where it ends."""
    offset, end = 0, len(data)
    head = struct.Struct("<BQ")
    while offset < end:
        if end - offset < HEAD:
            raise Unreadable("a chunk ends within a record")
        opcode, length = head.unpack_from(data, offset)
        offset += HEAD
        if length > end - offset:
            raise Unreadable("a record reaches beyond its chunk")
        yield opcode, offset, offset + length
        offset += length


_KNOWN = frozenset(Opcode) - {Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX}
