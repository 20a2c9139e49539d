"""MCAP records in a file and in its chunks; the `mcap` package parses their content.

Invariant: no number in a file is trusted. Nothing outside the file is read, a chunk is unpacked to at
most what its size allows, and only if its head agrees with its data. Where the file makes no sense, the
scan resumes at the next chunk that does.

A record is an opcode (1 byte), the length of its content (8 bytes) and the content; see the specification
at mcap.dev.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAX_UNPACKED_BYTES = 32 << 20
MAX_UNPACKED_RATIO = 32
"""A chunk unpacks to at most so many bytes, or to so many times its own where that is more."""
COMPRESSIONS = (b"zstd", b"lz4")
"""How a chunk may be packed, besides not at all."""
COMPRESSION_NAME_OFFSET = 28
"""Where in a chunk's content the name of its compression stands, with its length (4 bytes) before it."""
MAX_HEAD_BYTES = COMPRESSION_NAME_OFFSET + 4 + 32 + 8
"""A chunk's head is no longer; a name of a compression is at most 32 bytes."""

_FIXED = struct.Struct("<QQQII")
_SIZE = struct.Struct("<Q")
_WINDOW_BYTES = 32 << 20


class UnreadableRecord(Exception):  # noqa: N818 - what it says of a part of a file
    """A part of a file that makes no sense; its text says why. Never leaves this package."""


class ChunkHead(NamedTuple):
    """What a chunk says of itself.

    Attributes:
        start_ns: earliest log time in it.
        end_ns: latest one.
        size: bytes of its records, unpacked.
        crc: CRC-32 of those bytes; 0 where nobody computed it.
        compression: how they are packed.
        data_offset: where they begin, in the chunk's content.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_offset: int


def parse_chunk_head(content: bytes, length: int) -> ChunkHead:
    """Returns what a chunk says of itself.

    Args:
        content: its content, or the first `MAX_HEAD_BYTES` of it.
        length: bytes of its content.

    Raises:
        Unreadable: it contradicts itself.
    """
    try:
        start_ns, end_ns, size, crc, letters = _FIXED.unpack_from(content)
        (packed,) = _SIZE.unpack_from(content, _FIXED.size + letters)
        compression = content[_FIXED.size : _FIXED.size + letters].decode()
    except (struct.error, UnicodeDecodeError):
        raise UnreadableRecord("a chunk has no head") from None
    data_offset = _FIXED.size + letters + _SIZE.size
    if data_offset + packed != length:
        raise UnreadableRecord(f"a chunk of {length} bytes says that it has {data_offset + packed}")
    return ChunkHead(start_ns, end_ns, size, crc, compression, data_offset)


def unpack_chunk(content: bytes) -> bytes:
    """Returns the records in a chunk.

    Args:
        content: the chunk's content.

    Raises:
        Unreadable: it is damaged, or unpacks to more than it may.
    """
    head = parse_chunk_head(content, len(content))
    limit = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * len(content))
    if head.size > limit:
        raise UnreadableRecord(
            f"a chunk says that it unpacks to {head.size} bytes, at most {limit} are taken"
        )
    data = _unpack(head, memoryview(content)[head.data_offset :])
    if len(data) != head.size:
        raise UnreadableRecord(f"a chunk of {head.size} bytes unpacks to {len(data)}")
    if head.crc and zlib.crc32(data) != head.crc:
        raise UnreadableRecord("a chunk's CRC differs")
    return data


def _unpack(head: ChunkHead, data: memoryview) -> bytes:
    try:
        if head.compression == "zstd":
            said = zstandard.get_frame_parameters(data).content_size
            if said not in (head.size, zstandard.CONTENTSIZE_UNKNOWN):  # the library would believe it
                raise UnreadableRecord(f"a chunk of {head.size} bytes unpacks to {said}")
            return zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES).decompress(data, head.size)
        if head.compression == "lz4":
            # one byte more, so that one that is too long shows
            unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=head.size + 1)
            return unpacked
    except (zstandard.ZstdError, RuntimeError, ValueError, OverflowError, MemoryError) as error:
        raise UnreadableRecord(f"a chunk cannot be unpacked: {error}") from None
    if head.compression:
        raise UnreadableRecord(f"a chunk is packed by {head.compression!r}, which nobody here can unpack")
    return bytes(data)


MAGIC = b"\x89MCAP0\r\n"
RECORD_HEAD_BYTES = 9
"""Bytes of a record before its content."""
FOOTER_BYTES = RECORD_HEAD_BYTES + 20 + len(MAGIC)
"""Bytes of a finished file's end: its last record and the mark behind it."""
MAX_DAMAGED_PARTS = 100
"""Damaged parts of a file behind which nobody reads on."""

_HEAD = struct.Struct("<BQ")
_SCAN_BYTES = 1 << 20


class RecordFrame(NamedTuple):
    """Where a record lies.

    Attributes:
        offset: its first byte in the file.
        opcode: its kind.
        length: bytes of its content.
    """

    offset: int
    opcode: int
    length: int

    @property
    def end(self) -> int:
        """The first byte behind it."""
        return self.offset + RECORD_HEAD_BYTES + self.length


class Damage(NamedTuple):
    """A part of a file that nobody can read.

    Attributes:
        offset: its first byte.
        length: how many bytes.
        problem: what is wrong.
    """

    offset: int
    length: int
    problem: str

    def __str__(self) -> str:
        return f"{self.length} bytes from byte {self.offset} on: {self.problem}"


class RecordScanner:
    """The records of a file.

    Args:
        stream: the file, opened for reading; from where it stands.

    Attributes:
        size: bytes of the file.
        begins: True where it begins as an MCAP file does.
        ends: True where its last bytes are those of a finished one: its last record and the mark behind it.
        finished: True once all was read, to the end of a file that was finished.
        damaged: parts that could not be read, so far; a torn end is none of them.
        torn: the end that was cut off, once all before it was read; None where there is none.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._base = stream.tell()
        self.size = stream.seek(0, os.SEEK_END) - self._base
        self.begins = self._at(0, len(MAGIC)) == MAGIC
        end = self._at(max(0, self.size - FOOTER_BYTES), FOOTER_BYTES)
        self.ends = end.startswith(_HEAD.pack(Opcode.FOOTER, 20)) and end.endswith(MAGIC)
        self.finished = False
        self.damaged: list[Damage] = []
        self.torn: Damage | None = None

    def frames(self) -> Iterator[RecordFrame]:
        """Yields every record to the end, or to where the file was cut off.

        Parts that make no sense are left out and booked as `damaged`.
        """
        offset = sure = len(MAGIC)
        while len(self.damaged) < MAX_DAMAGED_PARTS:
            try:
                frame = self.at(offset)
                if frame.opcode == Opcode.CHUNK:
                    self.head(frame)
                elif frame.opcode == Opcode.FOOTER and frame.end + len(MAGIC) != frame.offset + FOOTER_BYTES:
                    raise UnreadableRecord(f"a record (footer) of {frame.length} bytes is none")
            except UnreadableRecord as error:
                # the length of the record before may be what is wrong: what it hid is looked at, too
                found = self._resume(sure, offset, str(error))
                if found is None:
                    return
                offset = sure = found
                continue
            yield frame
            if frame.opcode == Opcode.FOOTER:
                self.finished = self._at(frame.end, len(MAGIC)) == MAGIC
                if not self.finished:
                    self.torn = Damage(frame.end, self.size - frame.end, "its last mark is cut off")
                return
            sure = frame.end if frame.opcode == Opcode.CHUNK else frame.offset + 1
            offset = frame.end
        self.torn = Damage(offset, self.size - offset, f"it is damaged in {MAX_DAMAGED_PARTS} places before")

    def _resume(self, sure: int, offset: int, problem: str) -> int | None:
        """Returns where reading goes on, or None at the end of the file."""
        found = self.next_chunk(sure)
        if found is not None:
            first = offset if found >= offset else sure - 1
            self.damaged.append(Damage(first, found - first, problem))
        elif self.ends:
            self.damaged.append(Damage(offset, max(0, self.size - FOOTER_BYTES - offset), problem))
            self.finished = True
        else:
            self.torn = Damage(offset, self.size - offset, problem)
        return found

    def _at(self, offset: int, length: int) -> bytes:
        self._stream.seek(self._base + offset)
        return self._stream.read(max(0, min(length, self.size - offset)))

    def at(self, offset: int) -> RecordFrame:
        """Returns the record that begins at an offset.

        Raises:
            Unreadable: none that lies within the file does.
        """
        head = self._at(offset, RECORD_HEAD_BYTES)
        if len(head) < RECORD_HEAD_BYTES:
            raise UnreadableRecord("the file ends within a record")
        opcode, length = _HEAD.unpack(head)
        if not opcode:
            raise UnreadableRecord("there is no record")
        if length > self.size - offset - RECORD_HEAD_BYTES:
            kind = Opcode(opcode).name.lower().replace("_", " ") if opcode in _OPCODES else f"kind {opcode}"
            raise UnreadableRecord(f"a record ({kind}) of {length} bytes reaches beyond the end of the file")
        return RecordFrame(offset, opcode, length)

    def content(self, frame: RecordFrame) -> bytes:
        """Returns the content of a record."""
        return self._at(frame.offset + RECORD_HEAD_BYTES, frame.length)

    def crc(self, begin: int, end: int) -> int:
        """Returns the CRC-32 of a part of the file, from one byte to before another."""
        crc = 0
        for at in range(begin, end, _SCAN_BYTES):
            crc = zlib.crc32(self._at(at, min(_SCAN_BYTES, end - at)), crc)
        return crc

    def head(self, frame: RecordFrame) -> ChunkHead:
        """Returns what a chunk says of itself.

        Raises:
            Unreadable: it contradicts itself.
        """
        return parse_chunk_head(
            self._at(frame.offset + RECORD_HEAD_BYTES, min(frame.length, MAX_HEAD_BYTES)), frame.length
        )

    def next_chunk(self, offset: int) -> int | None:
        """Returns where the next chunk begins at or behind an offset, by what every chunk says at its start.

        Only compressed ones can be told from other bytes.
        """
        lead = RECORD_HEAD_BYTES + COMPRESSION_NAME_OFFSET
        marks = [_LETTERS.pack(len(name)) + name for name in COMPRESSIONS]
        at = offset
        while at < self.size:
            window = self._at(at, _SCAN_BYTES + lead + 8)  # the mark of one that begins in it
            found = sorted(place for mark in marks for place in _places(window, mark))
            for place in found:
                start = at + place - lead
                if start >= offset and self._is_chunk(start):
                    return start
            at += _SCAN_BYTES
        return None

    def _is_chunk(self, offset: int) -> bool:
        try:
            frame = self.at(offset)
            return frame.opcode == Opcode.CHUNK and bool(self.head(frame))
        except UnreadableRecord:
            return False


def parse_record(opcode: int, content: bytes) -> Any:
    """Returns a record of the `mcap` package from its content.

    Args:
        opcode: its kind: any but a message, a message index or a chunk.
        content: its bytes.

    Raises:
        Unreadable: the bytes are none of that kind.
    """
    try:
        return _KINDS[opcode].read(_Content(BytesIO(content)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        name = Opcode(opcode).name.lower().replace("_", " ")
        raise UnreadableRecord(f"a record ({name}) cannot be read: {error or type(error).__name__}") from None


class _Content(ReadDataStream):
    """The content of a record, from which no more can be read than there is."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise ValueError("it is cut off")
        return data


def _places(window: bytes, mark: bytes) -> Iterator[int]:
    place = window.find(mark)
    while place >= 0:
        yield place
        place = window.find(mark, place + 1)


_LETTERS = struct.Struct("<I")
_OPCODES = frozenset(Opcode)
_KINDS: dict[int, Any] = {
    Opcode.HEADER: records.Header,
    Opcode.FOOTER: records.Footer,
    Opcode.SCHEMA: records.Schema,
    Opcode.CHANNEL: records.Channel,
    Opcode.ATTACHMENT: records.Attachment,
    Opcode.METADATA: records.Metadata,
    Opcode.DATA_END: records.DataEnd,
    Opcode.STATISTICS: records.Statistics,
    Opcode.CHUNK_INDEX: records.ChunkIndex,
    Opcode.ATTACHMENT_INDEX: records.AttachmentIndex,
    Opcode.METADATA_INDEX: records.MetadataIndex,
    Opcode.SUMMARY_OFFSET: records.SummaryOffset,
}
