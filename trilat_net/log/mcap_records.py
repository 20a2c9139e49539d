"""Finds and decodes the records of MCAP files, including damaged files.

An MCAP file is a sequence of records. A record consists of an opcode (1 byte), the length of
its content (8 bytes) and the content, as specified at mcap.dev. A chunk is a record whose
content is a sequence of compressed records. All other record contents are decoded by the `mcap`
package.

Invariant:
    - No number in a file is trusted. Nothing outside the file is read. A chunk is decompressed
      only if its header is consistent with its data, and only up to a size that is plausible
      for its compressed size.
    - Every function raises `UnreadableRecord` for bytes that are not a valid record.
    - After such bytes, the scan of a file continues at the next readable chunk.
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
"""Magic bytes at the beginning and end of every file."""
RECORD_HEAD = struct.Struct("<BQ")
"""Header that precedes the content of a record: opcode and length of the content."""
RECORD_HEAD_BYTES = RECORD_HEAD.size
"""Size of the header of a record, in bytes."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Header that precedes the payload of a message: channel, sequence, log time, publish time."""
OP_MESSAGE = int(Opcode.MESSAGE)
"""Opcode of a message as an int, because comparing members of an enumeration is slow."""
DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
"""Kinds of records that define schemas and channels."""
_FOOTER_BYTES = RECORD_HEAD_BYTES + 20 + len(MAGIC)
"""Size of the footer and end mark of a finished file, in bytes."""
MAX_DAMAGED_PARTS = 100
"""Number of damaged parts after which reading of a file is abandoned."""

MAX_UNPACKED_BYTES = 32 << 20
"""Uncompressed size that is accepted for any chunk, in bytes."""
MAX_UNPACKED_RATIO = 32
"""For large chunks, uncompressed sizes up to this multiple of the compressed size are accepted,
if that is more.
"""
MAX_WINDOW_BYTES = 32 << 20
"""Largest window size that a Zstandard frame may require, in bytes."""
_COMPRESSIONS = (b"zstd", b"lz4")
"""Supported compression methods for chunks. Chunks may also be uncompressed."""
_COMPRESSION_NAME_OFFSET = 28
"""Offset in the content of a chunk of the name of the compression method, which is preceded by
its length.
"""
_MAX_HEAD_BYTES = _COMPRESSION_NAME_OFFSET + 4 + 32 + 8
"""Maximum size of a chunk's header, for a compression name of at most 32 bytes."""

# Fields of a chunk's head: first log time, last log time, unpacked size, checksum, and the
# length of the compression's name. The name and the compressed size follow.
_FIXED_HEAD = struct.Struct("<QQQII")
_SIZE = struct.Struct("<Q")
# Number of bytes that are read at once in the search for a chunk.
_SCAN_BYTES = 1 << 20
# Name of a supported compression, preceded by its length.
_COMPRESSION_NAME = re.compile(
    b"|".join(re.escape(struct.pack("<I", len(name)) + name) for name in _COMPRESSIONS)
)


class UnreadableRecord(Exception):  # noqa: N818 - describes a part of a file
    """Raised if a part of an MCAP file cannot be read. The message states the reason.

    Used only within the package `log`: a scan catches the error and continues at the next
    readable part, and a check reports it.
    """


class ChunkHead(NamedTuple):
    """Header of a chunk, a compressed block of records: sizes, times and compression.

    Attributes:
        start_ns: Arrival time of the earliest message in the chunk, in ns.
        end_ns: Arrival time of the latest message in the chunk, in ns.
        size: Size of the uncompressed records, in bytes.
        crc: CRC-32 checksum of the uncompressed records; 0 if there is no checksum.
        compression: Name of the compression method. Empty if the records are not compressed.
        data_offset: Offset of the compressed records in the content of the chunk, in bytes.
    """

    start_ns: int
    end_ns: int
    size: int
    crc: int
    compression: str
    data_offset: int

    @classmethod
    def parse(cls, content: bytes, length: int) -> "ChunkHead":
        """Decodes the header of a chunk, and checks that its lengths are consistent.

        Args:
            content: Content of the chunk, or at least its first `_MAX_HEAD_BYTES` bytes.
            length: Length of the complete content, in bytes.

        Raises:
            UnreadableRecord: The header is incomplete or contradicts the length.
        """
        try:
            start_ns, end_ns, size, crc, name_bytes = _FIXED_HEAD.unpack_from(content)
            (packed_bytes,) = _SIZE.unpack_from(content, _FIXED_HEAD.size + name_bytes)
            compression = content[_FIXED_HEAD.size : _FIXED_HEAD.size + name_bytes].decode()
        except (struct.error, UnicodeDecodeError):
            raise UnreadableRecord("a chunk has no valid header") from None

        # The compressed records, which follow the head, extend to the end of the chunk.
        data_offset = _FIXED_HEAD.size + name_bytes + _SIZE.size
        stated_length = data_offset + packed_bytes
        if stated_length != length:
            raise UnreadableRecord(
                f"a chunk of {count_nouns(length, 'byte')} states a length of "
                f"{count_nouns(stated_length, 'byte')}"
            )
        return cls(
            start_ns=start_ns,
            end_ns=end_ns,
            size=size,
            crc=crc,
            compression=compression,
            data_offset=data_offset,
        )


def unpack_chunk(content: bytes) -> bytes:
    """Decompresses the records of a chunk, and checks them against its header.

    The size stated in the header may be wrong. A size beyond reasonable limits is rejected, and
    data that decompress to another size are rejected too.

    Args:
        content: Content of the chunk, consisting of its header and the compressed records.

    Returns:
        The uncompressed records.

    Raises:
        UnreadableRecord: The chunk cannot be decompressed, or its size or checksum is wrong.
    """
    head = ChunkHead.parse(content, len(content))
    limit = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * len(content))
    if head.size > limit:
        raise UnreadableRecord(
            f"a chunk states an unpacked size of {count_nouns(head.size, 'byte')}, but at most "
            f"{limit} are allowed"
        )
    data = _unpack(head, memoryview(content)[head.data_offset :])
    if len(data) != head.size:
        # Unpacking of longer data may end early, so their length is not known.
        actual_size = "more" if len(data) > head.size else str(len(data))
        raise UnreadableRecord(
            f"a chunk states an unpacked size of {count_nouns(head.size, 'byte')}, but unpacks "
            f"to {actual_size}"
        )
    if head.crc and zlib.crc32(data) != head.crc:
        raise UnreadableRecord("the CRC of a chunk does not match its data")
    return data


def _unpack(head: ChunkHead, data: memoryview) -> bytes:
    """Decompresses the records of a chunk.

    The memory is limited to the size stated in the header of the chunk, even if damaged data
    would decompress to more.

    Raises:
        UnreadableRecord: The data are damaged, or the compression method is not supported.
    """
    try:
        if head.compression == "zstd":
            declared = zstandard.get_frame_parameters(data).content_size
            # The library would allocate the size that the frame declares, however large.
            if declared not in (head.size, zstandard.CONTENTSIZE_UNKNOWN):
                raise UnreadableRecord(
                    f"a chunk states an unpacked size of {count_nouns(head.size, 'byte')}, but "
                    f"its zstd data state {declared}"
                )
            unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES)
            return unpacker.decompress(data, head.size)
        if head.compression == "lz4":
            # One byte more than the head states reveals data that are too long.
            unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(
                data, max_length=head.size + 1
            )
            return unpacked
    except (zstandard.ZstdError, RuntimeError, ValueError, OverflowError, MemoryError) as error:
        raise UnreadableRecord(f"a chunk cannot be unpacked: {error}") from None

    if head.compression:
        raise UnreadableRecord(
            f"a chunk is compressed with {head.compression!r}, which is not supported"
        )
    return bytes(data)


def iterate_records(data: bytes | bytearray, offset: int = 0) -> Iterator[tuple[int, int, int]]:
    """Finds the records in an uncompressed chunk one after another, without decoding them.

    Args:
        data: The uncompressed chunk.
        offset: Offset of the first record to find.

    Yields:
        The opcode of the record, the offset of its content, and the offset after its content.

    Raises:
        UnreadableRecord: The last record is incomplete.
    """
    unpack = RECORD_HEAD.unpack_from
    size = len(data)
    end = offset
    while end + RECORD_HEAD_BYTES <= size:
        opcode, length = unpack(data, end)
        begin = end + RECORD_HEAD_BYTES
        end = begin + length
        if end > size:
            raise UnreadableRecord("a record reaches beyond the end of its chunk")
        yield opcode, begin, end
    if end < size:
        raise UnreadableRecord("a record in a chunk is cut off")


class RecordFrame(NamedTuple):
    """Kind, position and length of a record in an MCAP file, without its content.

    Attributes:
        offset: Offset of the record's first byte in the file.
        opcode: Identifies the kind of record, such as chunk or metadata.
        length: Length of the record's content, in bytes.
    """

    offset: int
    opcode: int
    length: int

    @property
    def size(self) -> int:
        """Total size of the MCAP record in bytes: opcode, length field and content."""
        return RECORD_HEAD_BYTES + self.length

    @property
    def end(self) -> int:
        """Offset of the first byte after this record, where the next record begins."""
        return self.offset + self.size


class Damage(NamedTuple):
    """A part of a file that cannot be read, and the reason.

    A scan continues after the part. Checks report it, and a recovery counts its bytes as lost.

    Attributes:
        offset: Offset of the part's first byte in the file.
        length: Length of the part, in bytes.
        problem: Description of the problem for the user.
    """

    offset: int
    length: int
    problem: str

    def __str__(self) -> str:
        return f"{count_nouns(self.length, 'byte')} from byte {self.offset} on: {self.problem}"


class ScannedRecord:
    """A record found in an MCAP file, whose content is read only when needed.

    Args:
        scanner: Scanner that found the record.
        frame: Kind and position of the record.

    Attributes:
        frame: Kind and position of the record.
    """

    __slots__ = ("_content", "_problem", "_scanner", "_unpacked", "frame")

    def __init__(self, scanner: "RecordScanner", frame: RecordFrame) -> None:
        self.frame = frame
        self._scanner = scanner
        self._content: bytes | None = None
        self._unpacked: bytes | None = None
        self._problem: UnreadableRecord | None = None

    @property
    def content(self) -> bytes:
        """Bytes of the record's content, without the opcode and the length field.

        Read from the file on first access, so that scanning a large file is fast.
        """
        if self._content is None:
            self._content = self._scanner.content(self.frame)
        return self._content

    def head(self) -> "ChunkHead":
        """Returns the header of a chunk, without decompressing its messages.

        The header states the times of the messages, and how they are compressed.

        Raises:
            UnreadableRecord: The header is incomplete, or contains impossible values.
        """
        return self._scanner.head(self.frame)

    def unpack(self) -> bytes:
        """Returns the uncompressed records of a chunk.

        The chunk is decompressed only in the first call.

        Raises:
            UnreadableRecord: The chunk cannot be decompressed, or its checksum is wrong.
        """
        if self._problem is not None:
            raise self._problem
        if self._unpacked is None:
            try:
                self._unpacked = unpack_chunk(self.content)
            except UnreadableRecord as error:
                self._problem = error
                raise
        return self._unpacked


class RecordScanner:
    """Finds the records of an MCAP file one after another, skipping damaged parts.

    All code that checks or recovers a file finds its records with this scanner.

    Args:
        stream: The file, opened for reading. The file begins at the current position of the
            stream.

    Attributes:
        size: Size of the file, in bytes.
        begins: True if the file begins with the magic bytes of MCAP.
        ends: True if the file ends with a footer and the end mark.
        finished: True if the file was finished and has been read to its end.
        trailing: Number of bytes after the end mark, once the mark has been read.
        damaged: Damaged parts found so far, except a missing end.
        torn: The incomplete part at the end of the file. None if the file is not truncated, or
            if its end has not been reached yet.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._base = stream.tell()
        self.size = stream.seek(0, os.SEEK_END) - self._base
        self.begins = self.read(0, len(MAGIC)) == MAGIC
        end = self.read(max(0, self.size - _FOOTER_BYTES), _FOOTER_BYTES)
        self.ends = end.startswith(RECORD_HEAD.pack(Opcode.FOOTER, 20)) and end.endswith(MAGIC)
        self.finished = False
        self.trailing = 0
        self.damaged: list[Damage] = []
        self.torn: Damage | None = None

    def read(self, offset: int, length: int) -> bytes:
        """Reads bytes of the file at a given offset.

        Args:
            offset: Offset of the first byte in the file.
            length: Number of bytes to read.

        Returns:
            The bytes, fewer than `length` if the end of the file comes first.
        """
        self._stream.seek(self._base + offset)
        return self._stream.read(max(0, min(length, self.size - offset)))

    def frames(self) -> Iterator[RecordFrame]:
        """Yields the kind and position of every readable record of an MCAP file.

        Unreadable parts of the file are skipped.
        """
        for item in self.scan():
            if isinstance(item, ScannedRecord):
                yield item.frame

    def scan(self) -> Iterator[ScannedRecord | Damage]:
        """Yields the records and the damaged parts of the file, sorted by offset.

        Bytes that cannot be a record are skipped, added to `damaged`, and yielded as a damaged
        part. If the end of the file is missing, `torn` is set. Every call starts at the
        beginning of the file.
        """
        self.damaged = []
        self.torn = None
        self.finished = False
        offset = len(MAGIC)
        # Offset at which the search for a chunk starts after a damaged record.
        search_start = offset
        while len(self.damaged) < MAX_DAMAGED_PARTS:
            try:
                frame = self._frame_at(offset)
                if frame.opcode == Opcode.CHUNK:
                    self.head(frame)
                elif frame.opcode == Opcode.FOOTER and frame.size + len(MAGIC) != _FOOTER_BYTES:
                    raise UnreadableRecord(
                        f"a footer record has {count_nouns(frame.length, 'byte')}, which is "
                        "not the length of a footer"
                    )
            except UnreadableRecord as error:
                # The length of the previous record may be wrong, so the search includes that
                # record.
                damaged_before = len(self.damaged)
                resumed_at = self._resume(search_start, offset, str(error))
                yield from self.damaged[damaged_before:]
                if resumed_at is None:
                    return
                offset = resumed_at
                search_start = resumed_at
                continue

            yield ScannedRecord(self, frame)
            if frame.opcode == Opcode.FOOTER:
                self._end_at(frame.end)
                return
            # The length of a readable chunk is trusted. The length of any other record may be
            # wrong.
            search_start = frame.end if frame.opcode == Opcode.CHUNK else frame.offset + 1
            offset = frame.end
        self.torn = Damage(
            offset,
            self.size - offset,
            f"the file is damaged in {MAX_DAMAGED_PARTS} places before",
        )

    def _end_at(self, footer_end: int) -> None:
        """Checks that an MCAP file has its end mark after the footer, its last record.

        Sets the attributes that describe the end of the file.

        Args:
            footer_end: Offset of the first byte after the footer.
        """
        rest = self.size - footer_end
        self.finished = self.read(footer_end, len(MAGIC)) == MAGIC
        self.trailing = max(0, rest - len(MAGIC)) if self.finished else 0
        if not self.finished:
            self.torn = Damage(footer_end, rest, "its last mark is cut off")

    def _resume(self, search_start: int, offset: int, problem: str) -> int | None:
        """Records a damaged part, and finds the next readable chunk.

        If no readable chunk follows, the rest of the file is damaged. The end of the file still
        counts as present if the file ends with a footer.

        Args:
            search_start: Offset at which the search for a chunk starts.
            offset: Offset of the unreadable record.
            problem: Description of the problem.

        Returns:
            The offset of the chunk, or None if no readable chunk follows.
        """
        chunk_offset = self._find_chunk(search_start)
        if chunk_offset is not None:
            damage_start = offset if chunk_offset >= offset else search_start - 1
            self.damaged.append(Damage(damage_start, chunk_offset - damage_start, problem))
        elif self.ends:
            self.damaged.append(
                Damage(offset, max(0, self.size - _FOOTER_BYTES - offset), problem)
            )
            self.finished = True
        else:
            self.torn = Damage(offset, self.size - offset, problem)
        return chunk_offset

    def _frame_at(self, offset: int) -> RecordFrame:
        """Returns the kind, position and length of the MCAP record that begins at an offset.

        Raises:
            UnreadableRecord: There is no record, or it extends beyond the end of the file.
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
        """Reads the content of a record, without the opcode and the length field.

        Args:
            frame: Position of the record in the file.

        Returns:
            The content, shorter than `frame.length` if the end of the file comes first.
        """
        return self.read(frame.offset + RECORD_HEAD_BYTES, frame.length)

    def head(self, frame: RecordFrame) -> ChunkHead:
        """Reads the header of a chunk, but not its compressed messages.

        Args:
            frame: Position of the chunk in the file.

        Returns:
            The header, which states the times, the size, the compression and the checksum.

        Raises:
            UnreadableRecord: The header is incomplete, or contains impossible values.
        """
        content = self.read(
            frame.offset + RECORD_HEAD_BYTES, min(frame.length, _MAX_HEAD_BYTES)
        )
        return ChunkHead.parse(content, frame.length)

    def _find_chunk(self, offset: int) -> int | None:
        """Finds the first readable chunk at or after an offset.

        A chunk is recognised by the name of its compression method, which has a fixed offset in
        its header. Uncompressed chunks are therefore not found.

        Returns:
            The offset of the chunk, or None if there is no such chunk.
        """
        lead_bytes = RECORD_HEAD_BYTES + _COMPRESSION_NAME_OFFSET
        for window_offset in range(offset, self.size, _SCAN_BYTES):
            # The window includes the head of a chunk that begins at the end of the searched
            # bytes.
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
        """Computes the CRC-32 checksum of a part of the file, to detect modified bytes.

        Args:
            begin: Offset of the first byte of the part.
            end: Offset after the last byte of the part.
        """
        crc = 0
        for offset in range(begin, end, _SCAN_BYTES):
            crc = zlib.crc32(self.read(offset, min(_SCAN_BYTES, end - offset)), crc)
        return crc

    def footer(self) -> records.Footer | None:
        """Reads the footer of the file, its last record, which states where the index is.

        Returns:
            The footer, or None if the file is unfinished and therefore has no footer.
        """
        content = self.read(max(0, self.size - _FOOTER_BYTES) + RECORD_HEAD_BYTES, 20)
        return parse_record(Opcode.FOOTER, content) if self.ends else None

    def is_summary_intact(self, footer: records.Footer) -> bool:
        """Returns True if the summary at the end of the file matches its checksum.

        The summary contains the index of the file.

        Args:
            footer: Footer of the file, which states the checksum.
        """
        summary_start = footer.summary_start
        footer_start = self.size - _FOOTER_BYTES
        if not 0 <= summary_start <= footer_start:
            return False
        # The checksum covers the summary and the footer up to the checksum itself, which is the
        # last field of the footer. A start of 0 means that there is no summary. Then only the
        # footer is covered.
        crc_bytes = 4
        covered_start = summary_start or footer_start
        covered_end = self.size - len(MAGIC) - crc_bytes
        return self.crc(covered_start, covered_end) == footer.summary_crc


def has_right_crc(attachment: bytes) -> bool:
    """Returns True if an attachment of a log, such as its scenario, matches its checksum.

    A checksum of 0 means that there is none, and also counts as a match.

    Args:
        attachment: Content of the attachment record.
    """
    crc = int.from_bytes(attachment[-4:], "little")
    return not crc or zlib.crc32(memoryview(attachment)[:-4]) == crc


def parse_record(opcode: int, content: bytes) -> Any:
    """Decodes the content of a record with the `mcap` package.

    The various errors that the package raises for damaged content are converted to a single
    error type.

    Args:
        opcode: Opcode of the record, which must be in `KINDS`.
        content: Content of the record.

    Returns:
        The record as an object of that package.

    Raises:
        UnreadableRecord: The content cannot be decoded.
    """
    try:
        return KINDS[opcode].read(_Content(BytesIO(content)))
    except (McapError, struct.error, ValueError, OverflowError) as error:
        reason = str(error) or type(error).__name__
        raise UnreadableRecord(
            f"a record ({_opcode_name(opcode)}) cannot be read: {reason}"
        ) from None


class _Content(ReadDataStream):
    """Stream of a record's content that raises an error if it is read beyond its end."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) != length:
            raise ValueError("it is cut off")
        return data


def _opcode_name(opcode: int) -> str:
    """Returns the name of a kind of record, such as "chunk index", for error messages."""
    if opcode not in _OPCODES:
        return f"kind {opcode}"
    return Opcode(opcode).name.lower().replace("_", " ")


_OPCODES = frozenset(Opcode)
KINDS: dict[int, Any] = {
    kind: getattr(records, kind.name.title().replace("_", ""))
    for kind in _OPCODES - {OP_MESSAGE, Opcode.MESSAGE_INDEX, Opcode.CHUNK}
}
"""Maps each kind of record that `parse_record` decodes to its class in the `mcap` package."""
