"""MCAP records in a file and in its chunks; the `mcap` package parses their content.

Invariant: no number in a file is trusted. Nothing outside the file is read, a chunk is unpacked
to at most what its size allows, and only if its head agrees with its data. Where the file makes
no sense, the scan resumes at the next chunk that does. What makes no sense is an
`UnreadableRecord` to every function.

A record is an opcode (1 byte), the length of its content (8 bytes) and the content; see the
specification at mcap.dev. A chunk is a record that holds packed records.
"""

import os
import re
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from ..errors import count_nouns

MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a file."""
RECORD_HEAD = struct.Struct("<BQ")
RECORD_HEAD_BYTES = RECORD_HEAD.size
"""Bytes of a record before its content: opcode and length."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""What precedes the payload of a message: channel, sequence, log time, publish time."""
OP_MESSAGE = int(Opcode.MESSAGE)  # a member of an enumeration compares slowly
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
FOOTER_BYTES = RECORD_HEAD_BYTES + 20 + len(MAGIC)
"""Bytes of a finished file's end: its last record and the end mark."""
MAX_DAMAGED_PARTS = 100
"""Damaged parts of a file after which reading ends."""

MAX_UNPACKED_BYTES = 32 << 20
MAX_UNPACKED_RATIO = 32
"""A chunk unpacks to at most so many bytes, or to so many times its own where that is more."""
MAX_WINDOW_BYTES = 32 << 20
"""Largest window that Zstandard may ask for."""
COMPRESSIONS = (b"zstd", b"lz4")
"""How a chunk may be packed, besides not at all."""
COMPRESSION_NAME_OFFSET = 28
"""Where in a chunk's content the name of its compression is, with its length (4 bytes) before
it.
"""
MAX_HEAD_BYTES = COMPRESSION_NAME_OFFSET + 4 + 32 + 8
"""A chunk's head is no longer; a name of a compression is at most 32 bytes."""

_FIXED_HEAD = struct.Struct("<QQQII")
_SIZE = struct.Struct("<Q")
_SCAN_BYTES = 1 << 20
_COMPRESSION_NAME = re.compile(
    b"|".join(re.escape(struct.pack("<I", len(name)) + name) for name in COMPRESSIONS)
)


class UnreadableRecord(Exception):  # noqa: N818 - describes a part of a file
    """A part of a file that makes no sense; the text says why. Never leaves this package."""


class ChunkHead(NamedTuple):
    """Head of a chunk: first and last log time; of its records, unpacked, size and CRC-32 (0
    for none).

    They are packed by `compression`, and begin at `data_offset` in the chunk's content.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_offset: int


def parse_chunk_head(content: bytes, length: int) -> ChunkHead:
    """Returns the head of a chunk of `length` bytes; its first `MAX_HEAD_BYTES` suffice as
    content.
    """
    try:
        start_ns, end_ns, size, crc, letters = _FIXED_HEAD.unpack_from(content)
        (packed,) = _SIZE.unpack_from(content, _FIXED_HEAD.size + letters)
        compression = content[_FIXED_HEAD.size : _FIXED_HEAD.size + letters].decode()
    except (struct.error, UnicodeDecodeError):
        raise UnreadableRecord("a chunk has no head") from None
    data_offset = _FIXED_HEAD.size + letters + _SIZE.size
    if data_offset + packed != length:
        raise UnreadableRecord(
            f"a chunk of {count_nouns(length, 'byte')} says that it has {data_offset + packed}"
        )
    return ChunkHead(
        start_ns=start_ns,
        end_ns=end_ns,
        size=size,
        crc=crc,
        compression=compression,
        data_offset=data_offset,
    )


def unpack_chunk(content: bytes) -> bytes:
    """Returns the records in a chunk."""
    head = parse_chunk_head(content, len(content))
    limit = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * len(content))
    if head.size > limit:
        text = f"a chunk says that it unpacks to {count_nouns(head.size, 'byte')}, at most {limit} are taken"
        raise UnreadableRecord(text)
    data = _unpack(head, memoryview(content)[head.data_offset :])
    if len(data) != head.size:
        raise UnreadableRecord(
            f"a chunk of {count_nouns(head.size, 'byte')} unpacks to {len(data)}"
        )
    if head.crc and zlib.crc32(data) != head.crc:
        raise UnreadableRecord("a chunk's CRC differs")
    return data


def _unpack(head: ChunkHead, data: memoryview) -> bytes:
    try:
        if head.compression == "zstd":
            declared = zstandard.get_frame_parameters(data).content_size
            # the library would believe it
            if declared not in (
                head.size,
                zstandard.CONTENTSIZE_UNKNOWN,
            ):
                raise UnreadableRecord(
                    f"a chunk of {count_nouns(head.size, 'byte')} unpacks to {declared}"
                )
            return zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES).decompress(
                data, head.size
            )
        if head.compression == "lz4":
            # one byte more, so that one that is too long shows
            unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(
                data, max_length=head.size + 1
            )
            return unpacked
    except (zstandard.ZstdError, RuntimeError, ValueError, OverflowError, MemoryError) as error:
        raise UnreadableRecord(f"a chunk cannot be unpacked: {error}") from None
    if head.compression:
        raise UnreadableRecord(
            f"a chunk is packed by {head.compression!r}, which is not supported"
        )
    return bytes(data)


def iterate_records(data: bytes | bytearray) -> Iterator[tuple[int, int, int]]:
    """Yields the records in an unpacked chunk: opcode, where the content begins, where it ends."""
    unpack = RECORD_HEAD.unpack_from
    size = len(data)
    end = 0
    while end + RECORD_HEAD_BYTES <= size:
        opcode, length = unpack(data, end)
        begin = end + RECORD_HEAD_BYTES
        end = begin + length
        if end > size:
            raise UnreadableRecord("a record reaches beyond its chunk")
        yield opcode, begin, end
    if end < size:
        raise UnreadableRecord("a record in a chunk is cut off")


class RecordFrame(NamedTuple):
    """Place of a record: its first byte in the file, its opcode, and the length of its content."""

    offset: int
    opcode: int
    length: int

    @property
    def size(self) -> int:
        """Bytes of the record with its head."""
        return RECORD_HEAD_BYTES + self.length

    @property
    def end(self) -> int:
        """The first byte after it."""
        return self.offset + self.size


class Damage(NamedTuple):
    """An unreadable part of a file: its first byte, its length, and what is wrong."""

    offset: int
    length: int
    problem: str

    def __str__(self) -> str:
        return f"{count_nouns(self.length, 'byte')} from byte {self.offset} on: {self.problem}"


class RecordScanner:
    """Scanner of the records of a file.

    Args:
        stream: the file, opened for reading; it begins at the current position.

    Attributes:
        size: bytes of the file. begins, ends: True if it begins as an MCAP file does, and ends
        as a finished one: with the end mark.
        finished: True once all was read, to the end of a file that was finished.
        trailing: bytes that follow its end mark, once that was read.
        damaged: parts that could not be read, so far; a torn end is none of them.
        torn: the end that was cut off, once all before it was read; None if there is none.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._base = stream.tell()
        self.size = stream.seek(0, os.SEEK_END) - self._base
        self.begins = self.read(0, len(MAGIC)) == MAGIC
        end = self.read(max(0, self.size - FOOTER_BYTES), FOOTER_BYTES)
        self.ends = end.startswith(RECORD_HEAD.pack(Opcode.FOOTER, 20)) and end.endswith(MAGIC)
        self.finished = False
        self.trailing = 0
        self.damaged: list[Damage] = []
        self.torn: Damage | None = None

    def read(self, offset: int, length: int) -> bytes:
        """Returns the bytes of a part of the file, as far as they are there."""
        self._stream.seek(self._base + offset)
        return self._stream.read(max(0, min(length, self.size - offset)))

    def frames(self) -> Iterator[RecordFrame]:
        """Yields the place of every record, anew on every call; skips what makes no sense
        (`damaged`).
        """
        self.damaged = []
        self.torn = None
        self.finished = False
        offset = sure = len(MAGIC)
        while len(self.damaged) < MAX_DAMAGED_PARTS:
            try:
                frame = self._frame_at(offset)
                if frame.opcode == Opcode.CHUNK:
                    self.head(frame)
                elif frame.opcode == Opcode.FOOTER and frame.size + len(MAGIC) != FOOTER_BYTES:
                    raise UnreadableRecord(
                        f"a record (footer) of {count_nouns(frame.length, 'byte')} is none"
                    )
            except UnreadableRecord as error:
                # the length of the record before may be what is wrong: search what it hid, too
                found = self._resume(sure, offset, str(error))
                if found is None:
                    return
                offset = sure = found
                continue
            yield frame
            if frame.opcode == Opcode.FOOTER:
                self.finished = self.read(frame.end, len(MAGIC)) == MAGIC
                self.trailing = (
                    max(0, self.size - frame.end - len(MAGIC)) if self.finished else 0
                )
                if not self.finished:
                    self.torn = Damage(
                        frame.end, self.size - frame.end, "its last mark is cut off"
                    )
                return
            sure = frame.end if frame.opcode == Opcode.CHUNK else frame.offset + 1
            offset = frame.end
        self.torn = Damage(
            offset, self.size - offset, f"it is damaged in {MAX_DAMAGED_PARTS} places before"
        )

    def _resume(self, sure: int, offset: int, problem: str) -> int | None:
        """Returns where reading resumes, or None at the end of the file."""
        found = self._find_chunk(sure)
        if found is not None:
            first = offset if found >= offset else sure - 1
            self.damaged.append(Damage(first, found - first, problem))
        elif self.ends:
            self.damaged.append(
                Damage(offset, max(0, self.size - FOOTER_BYTES - offset), problem)
            )
            self.finished = True
        else:
            self.torn = Damage(offset, self.size - offset, problem)
        return found

    def _frame_at(self, offset: int) -> RecordFrame:
        """Returns the record that begins at an offset; raises if it does not lie within the
        file.
        """
        head = self.read(offset, RECORD_HEAD_BYTES)
        if len(head) < RECORD_HEAD_BYTES:
            raise UnreadableRecord("the file ends within a record")
        opcode, length = RECORD_HEAD.unpack(head)
        if not opcode:
            raise UnreadableRecord("there is no record")
        if length > self.size - offset - RECORD_HEAD_BYTES:
            name = _opcode_name(opcode)
            raise UnreadableRecord(
                f"a record ({name}) of {count_nouns(length, 'byte')} reaches beyond the end of the file"
            )
        return RecordFrame(offset, opcode, length)

    def content(self, frame: RecordFrame) -> bytes:
        """Returns the content of a record."""
        return self.read(frame.offset + RECORD_HEAD_BYTES, frame.length)

    def head(self, frame: RecordFrame) -> ChunkHead:
        """Returns the head of a chunk."""
        content = self.read(frame.offset + RECORD_HEAD_BYTES, min(frame.length, MAX_HEAD_BYTES))
        return parse_chunk_head(content, frame.length)

    def _find_chunk(self, offset: int) -> int | None:
        lead = RECORD_HEAD_BYTES + COMPRESSION_NAME_OFFSET
        for at in range(offset, self.size, _SCAN_BYTES):
            # holds the name of one that begins in it
            window = self.read(at, _SCAN_BYTES + lead + 8)
            for match in _COMPRESSION_NAME.finditer(window):
                start = at + match.start() - lead
                with suppress(UnreadableRecord):
                    if (
                        start >= offset
                        and (frame := self._frame_at(start)).opcode == Opcode.CHUNK
                    ):
                        self.head(frame)
                        return start
        return None

    def crc(self, begin: int, end: int) -> int:
        """Returns the CRC-32 of a part of the file, from one byte to before another."""
        crc = 0
        for at in range(begin, end, _SCAN_BYTES):
            crc = zlib.crc32(self.read(at, min(_SCAN_BYTES, end - at)), crc)
        return crc

    def footer(self) -> records.Footer | None:
        """Returns the footer of a finished file; None for another."""
        content = self.read(max(0, self.size - FOOTER_BYTES) + RECORD_HEAD_BYTES, 20)
        return parse_record(Opcode.FOOTER, content) if self.ends else None

    def is_summary_intact(self, footer: records.Footer) -> bool:
        """True if the summary has the checksum that the footer states."""
        begin = footer.summary_start
        last = self.size - FOOTER_BYTES
        if not 0 <= begin <= last:
            return False
        return self.crc(begin or last, self.size - len(MAGIC) - 4) == footer.summary_crc


def has_right_crc(attachment: bytes) -> bool:
    """True if the content of an attachment agrees with the checksum at its end; 0 stands for
    none.
    """
    crc = int.from_bytes(attachment[-4:], "little")
    return not crc or zlib.crc32(memoryview(attachment)[:-4]) == crc


def parse_record(opcode: int, content: bytes) -> Any:
    """Returns a record of the `mcap` package: any but a message, a message index or a chunk."""
    try:
        return KINDS[opcode].read(_Content(BytesIO(content)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        why = str(error) or type(error).__name__
        raise UnreadableRecord(
            f"a record ({_opcode_name(opcode)}) cannot be read: {why}"
        ) from None


class _Content(ReadDataStream):
    """Content of a record; reading beyond its end is an error."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise ValueError("it is cut off")
        return data


def _opcode_name(opcode: int) -> str:
    return (
        Opcode(opcode).name.lower().replace("_", " ")
        if opcode in _OPCODES
        else f"kind {opcode}"
    )


_OPCODES = frozenset(Opcode)
KINDS: dict[int, Any] = {
    kind: getattr(records, kind.name.title().replace("_", ""))
    for kind in _OPCODES - {OP_MESSAGE, Opcode.MESSAGE_INDEX, Opcode.CHUNK}
}
"""Kinds of records that `parse_record` reads."""
