"""Records of MCAP files: scanning a file, and unpacking its chunks.

A record is an opcode (1 byte), the length of its content (8 bytes) and the content; see the
specification at mcap.dev. A chunk is a record whose content is packed records. The `mcap`
package parses the content of other records.

Invariant:
    - No number in a file is trusted. Nothing outside the file is read. A chunk is unpacked to
      at most the size that its packed size allows, and only if its head agrees with its data.
    - Every function raises `UnreadableRecord` for bytes that make no sense.
    - After such bytes, the scan of a file resumes at the next readable chunk.
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
"""Size of a record before its content, in bytes: opcode and length."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Head of a message before its payload: channel, sequence, log time, publish time."""
OP_MESSAGE = int(Opcode.MESSAGE)  # a member of an enumeration compares slowly
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
FOOTER_BYTES = RECORD_HEAD_BYTES + 20 + len(MAGIC)
"""Size of a finished file's footer and end mark, in bytes."""
MAX_DAMAGED_PARTS = 100
"""Number of damaged parts of a file after which reading ends."""

MAX_UNPACKED_BYTES = 32 << 20
"""Largest size to which any chunk may unpack, in bytes."""
MAX_UNPACKED_RATIO = 32
"""Larger chunks may unpack to this many times their packed size."""
MAX_WINDOW_BYTES = 32 << 20
"""Largest window that a Zstandard frame may require, in bytes."""
COMPRESSIONS = (b"zstd", b"lz4")
"""Supported compressions of chunks; chunks may also be uncompressed."""
COMPRESSION_NAME_OFFSET = 28
"""Offset of the compression's name in the content of a chunk.

The length of the name (4 bytes) precedes the name.
"""
MAX_HEAD_BYTES = COMPRESSION_NAME_OFFSET + 4 + 32 + 8
"""Largest size of a chunk's head, with a compression name of at most 32 bytes."""

_FIXED_HEAD = struct.Struct("<QQQII")
_SIZE = struct.Struct("<Q")
_SCAN_BYTES = 1 << 20
_COMPRESSION_NAME = re.compile(
    b"|".join(re.escape(struct.pack("<I", len(name)) + name) for name in COMPRESSIONS)
)


class UnreadableRecord(Exception):  # noqa: N818 - describes a part of a file
    """A part of a file makes no sense; the text states the reason. Raised within `log` only."""


class ChunkHead(NamedTuple):
    """Head of a chunk.

    Attributes:
        start_ns: first log time of the chunk's messages.
        end_ns: last log time of the chunk's messages.
        size: size of the unpacked records, in bytes.
        crc: CRC-32 of the unpacked records; 0 if there is no checksum.
        compression: name of the compression; "" if the records are not compressed.
        data_offset: offset of the packed records in the content of the chunk.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_offset: int


def parse_chunk_head(content: bytes, length: int) -> ChunkHead:
    """Returns the head of a chunk.

    Args:
        content: content of the chunk, of which the first `MAX_HEAD_BYTES` suffice.
        length: length of the whole content.
    """
    try:
        start_ns, end_ns, size, crc, name_bytes = _FIXED_HEAD.unpack_from(content)
        (packed_bytes,) = _SIZE.unpack_from(content, _FIXED_HEAD.size + name_bytes)
        compression = content[_FIXED_HEAD.size : _FIXED_HEAD.size + name_bytes].decode()
    except (struct.error, UnicodeDecodeError):
        raise UnreadableRecord("a chunk has no head") from None
    data_offset = _FIXED_HEAD.size + name_bytes + _SIZE.size
    stated_length = data_offset + packed_bytes
    if stated_length != length:
        raise UnreadableRecord(
            f"a chunk of {count_nouns(length, 'byte')} says that it has {stated_length}"
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
    """Returns the unpacked records of a chunk, whose checksum is right if it has one."""
    head = parse_chunk_head(content, len(content))
    limit = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * len(content))
    if head.size > limit:
        raise UnreadableRecord(
            f"a chunk says that it unpacks to {count_nouns(head.size, 'byte')}, "
            f"at most {limit} are taken"
        )
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
            # The library would allocate the declared size, whatever it is.
            if declared not in (head.size, zstandard.CONTENTSIZE_UNKNOWN):
                raise UnreadableRecord(
                    f"a chunk of {count_nouns(head.size, 'byte')} unpacks to {declared}"
                )
            unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
            return unpacker.decompress(data, head.size)
        if head.compression == "lz4":
            # One byte more than stated reveals data that is too long.
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
    """Yields (opcode, begin, end) of the contents of the records in an unpacked chunk."""
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
    """Place of a record in a file.

    Attributes:
        offset: offset of the record's first byte in the file.
        opcode: kind of the record.
        length: length of the record's content, in bytes.
    """

    offset: int
    opcode: int
    length: int

    @property
    def size(self) -> int:
        """Size of the record including opcode and length, in bytes."""
        return RECORD_HEAD_BYTES + self.length

    @property
    def end(self) -> int:
        """Offset of the first byte after the record."""
        return self.offset + self.size


class Damage(NamedTuple):
    """An unreadable part of a file.

    Attributes:
        offset: offset of the part's first byte.
        length: length of the part, in bytes.
        problem: description of the problem.
    """

    offset: int
    length: int
    problem: str

    def __str__(self) -> str:
        return f"{count_nouns(self.length, 'byte')} from byte {self.offset} on: {self.problem}"


class RecordScanner:
    """Scanner of the records of a file.

    Args:
        stream: the file, opened for reading; the file begins at the current position.

    Attributes:
        size: size of the file, in bytes.
        begins: True if the file begins with the mark of MCAP files.
        ends: True if the file ends with a footer and the end mark.
        finished: True once a finished file has been read to its end.
        trailing: number of bytes after the end mark, once the mark has been read.
        damaged: parts that could not be read so far, without a torn end.
        torn: the end that was cut off, once everything before it has been read; else None.
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
        """Returns the bytes of a part of the file; fewer at the end of the file."""
        self._stream.seek(self._base + offset)
        return self._stream.read(max(0, min(length, self.size - offset)))

    def frames(self) -> Iterator[RecordFrame]:
        """Yields the place of every record; every call starts anew.

        Parts that make no sense are skipped, and added to `damaged`.
        """
        self.damaged = []
        self.torn = None
        self.finished = False
        offset = len(MAGIC)
        search_start = offset  # where the search for a chunk starts after a damaged record
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
                # The length of the previous record may be wrong: search that record, too.
                resumed_at = self._resume(search_start, offset, str(error))
                if resumed_at is None:
                    return
                offset = resumed_at
                search_start = resumed_at
                continue
            yield frame
            if frame.opcode == Opcode.FOOTER:
                self._end_at(frame.end)
                return
            # A readable chunk is trusted; the length of any other record may be wrong.
            search_start = frame.end if frame.opcode == Opcode.CHUNK else frame.offset + 1
            offset = frame.end
        self.torn = Damage(
            offset, self.size - offset, f"it is damaged in {MAX_DAMAGED_PARTS} places before"
        )

    def _end_at(self, footer_end: int) -> None:
        """Notes whether the end mark follows the footer."""
        rest = self.size - footer_end
        self.finished = self.read(footer_end, len(MAGIC)) == MAGIC
        self.trailing = max(0, rest - len(MAGIC)) if self.finished else 0
        if not self.finished:
            self.torn = Damage(footer_end, rest, "its last mark is cut off")

    def _resume(self, search_start: int, offset: int, problem: str) -> int | None:
        """Notes a damaged part, and returns the offset of the next readable chunk.

        Args:
            search_start: offset at which the search for a chunk starts.
            offset: offset of the unreadable record.
            problem: description of the problem.

        Returns:
            The offset; None if no readable chunk follows.
        """
        chunk_offset = self._find_chunk(search_start)
        if chunk_offset is not None:
            damage_start = offset if chunk_offset >= offset else search_start - 1
            self.damaged.append(Damage(damage_start, chunk_offset - damage_start, problem))
        elif self.ends:
            self.damaged.append(
                Damage(offset, max(0, self.size - FOOTER_BYTES - offset), problem)
            )
            self.finished = True
        else:
            self.torn = Damage(offset, self.size - offset, problem)
        return chunk_offset

    def _frame_at(self, offset: int) -> RecordFrame:
        """Returns the place of the record that begins at an offset.

        Raises:
            UnreadableRecord: there is no record within the file.
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
                f"a record ({name}) of {count_nouns(length, 'byte')} reaches beyond the end "
                "of the file"
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
        """Returns the offset of the first readable chunk at or after an offset, or None.

        Chunks are found by the name of their compression.
        """
        lead_bytes = RECORD_HEAD_BYTES + COMPRESSION_NAME_OFFSET
        for window_offset in range(offset, self.size, _SCAN_BYTES):
            # The window also holds the compression's name of a chunk that begins at its end.
            window = self.read(window_offset, _SCAN_BYTES + lead_bytes + 8)
            for match in _COMPRESSION_NAME.finditer(window):
                start = window_offset + match.start() - lead_bytes
                if start < offset:
                    continue
                with suppress(UnreadableRecord):
                    frame = self._frame_at(start)
                    if frame.opcode == Opcode.CHUNK:
                        self.head(frame)
                        return start
        return None

    def crc(self, begin: int, end: int) -> int:
        """Returns the CRC-32 of the file from offset `begin` to before offset `end`."""
        crc = 0
        for offset in range(begin, end, _SCAN_BYTES):
            crc = zlib.crc32(self.read(offset, min(_SCAN_BYTES, end - offset)), crc)
        return crc

    def footer(self) -> records.Footer | None:
        """Returns the footer of a finished file, or None if the file is not finished."""
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
    """True if the content of an attachment agrees with the checksum at its end.

    A checksum of 0 stands for no checksum.
    """
    crc = int.from_bytes(attachment[-4:], "little")
    return not crc or zlib.crc32(memoryview(attachment)[:-4]) == crc


def parse_record(opcode: int, content: bytes) -> Any:
    """Returns a parsed record of the `mcap` package, for the kinds in `KINDS`."""
    try:
        return KINDS[opcode].read(_Content(BytesIO(content)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        reason = str(error) or type(error).__name__
        raise UnreadableRecord(
            f"a record ({_opcode_name(opcode)}) cannot be read: {reason}"
        ) from None


class _Content(ReadDataStream):
    """Stream of a record's content, for which reading beyond the end is an error."""

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
