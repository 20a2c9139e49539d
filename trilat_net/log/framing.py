"""The records of an MCAP file as they lie in it, one behind the other; the `mcap` package says what one is.

Law: no number in a file is believed. Nothing is read that does not lie within the file, and where the file
makes no sense, reading goes on at the next chunk that does.

A record is an opcode (1 byte), the length of its content (8 bytes) and the content; see the MCAP
specification at mcap.dev.
"""

import os
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import Any, BinaryIO, NamedTuple

from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from .packed import COMPRESSIONS, MAX_HEAD_BYTES, NAME_OFFSET, ChunkHead, Unreadable, chunk_head

MAGIC = b"\x89MCAP0\r\n"
HEAD = 9
"""Bytes of a record before its content."""
FOOTER_BYTES = HEAD + 20 + len(MAGIC)
"""Bytes of a finished file's end: its last record and the mark behind it."""
MAX_DAMAGED = 100
"""Damaged parts of a file behind which nobody reads on."""

_HEAD = struct.Struct("<BQ")
_SCAN_BYTES = 1 << 20


class Frame(NamedTuple):
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
        return self.offset + HEAD + self.length


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


class Framing:
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

    def frames(self) -> Iterator[Frame]:
        """Yields every record to the end, or to where the file was cut off.

        Parts that make no sense are left out and booked as `damaged`.
        """
        offset = sure = len(MAGIC)
        while len(self.damaged) < MAX_DAMAGED:
            try:
                frame = self.at(offset)
                if frame.opcode == Opcode.CHUNK:
                    self.head(frame)
                elif frame.opcode == Opcode.FOOTER and frame.end + len(MAGIC) != frame.offset + FOOTER_BYTES:
                    raise Unreadable(f"a record (footer) of {frame.length} bytes is none")
            except Unreadable as error:
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
        self.torn = Damage(offset, self.size - offset, f"it is damaged in {MAX_DAMAGED} places before")

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

    def at(self, offset: int) -> Frame:
        """Returns the record that begins at an offset.

        Raises:
            Unreadable: none that lies within the file does.
        """
        head = self._at(offset, HEAD)
        if len(head) < HEAD:
            raise Unreadable("the file ends within a record")
        opcode, length = _HEAD.unpack(head)
        if not opcode:
            raise Unreadable("there is no record")
        if length > self.size - offset - HEAD:
            kind = Opcode(opcode).name.lower().replace("_", " ") if opcode in _OPCODES else f"kind {opcode}"
            raise Unreadable(f"a record ({kind}) of {length} bytes reaches beyond the end of the file")
        return Frame(offset, opcode, length)

    def content(self, frame: Frame) -> bytes:
        """Returns the content of a record."""
        return self._at(frame.offset + HEAD, frame.length)

    def crc(self, begin: int, end: int) -> int:
        """Returns the CRC-32 of a part of the file, from one byte to before another."""
        crc = 0
        for at in range(begin, end, _SCAN_BYTES):
            crc = zlib.crc32(self._at(at, min(_SCAN_BYTES, end - at)), crc)
        return crc

    def head(self, frame: Frame) -> ChunkHead:
        """Returns what a chunk says of itself.

        Raises:
            Unreadable: it contradicts itself.
        """
        return chunk_head(self._at(frame.offset + HEAD, min(frame.length, MAX_HEAD_BYTES)), frame.length)

    def next_chunk(self, offset: int) -> int | None:
        """Returns where the next chunk begins at or behind an offset, by what every chunk says at its start.

        Only compressed ones can be told from other bytes.
        """
        lead = HEAD + NAME_OFFSET
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
        except Unreadable:
            return False


def parsed(opcode: int, content: bytes) -> Any:
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
        raise Unreadable(f"a record ({name}) cannot be read: {error or type(error).__name__}") from None


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
