"""A chunk that was cut off: its records, block by block, as far as its packed bytes can be
trusted.

Invariant:
- A block is what the compression unpacks as one piece. Its records are taken together or not at
  all: damage in the packed bytes of a block falsifies any part of it, and of its records
  perhaps some that still look right.
- Of packed bytes none is read from the first page on that holds nothing but zeros, or the same
  as another page of the file: such a page was never written, or was written to the wrong place.

The checksum of a chunk covers all of its records, so it proves nothing once the end is missing.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import lz4.frame
import zstandard

from .mcap_records import (
    MAX_UNPACKED_BYTES,
    MAX_UNPACKED_RATIO,
    MAX_WINDOW_BYTES,
    RECORD_HEAD,
    RECORD_HEAD_BYTES,
    ChunkHead,
    RecordScanner,
    UnreadableRecord,
    parse_chunk_head,
)

PAGE_BYTES = 4096
"""Unit in which memory and disks keep a file: what is lost or misplaced is a number of whole
pages.
"""
MAX_SALVAGE_BYTES = 64 << 20
"""No more of a cut chunk is read."""
_BLOCK_HEAD_BYTES = 3
_RUN_LENGTH_BLOCK = 1
_MAX_BLOCK_BYTES = 1 << 17

InnerRecord = tuple[int, bytes]
"""A record of a chunk: its opcode and its content."""


class TornChunk(NamedTuple):
    """A chunk that reaches beyond the end of its file.

    Attributes:
        head: its head.
        packed: its packed bytes, as far as they are there and can be trusted.
        offset: offset of the first of these in the file.
    """

    head: ChunkHead
    packed: bytes
    offset: int

    @classmethod
    def read(cls, scanner: RecordScanner, offset: int) -> "TornChunk":
        """Returns the chunk at an offset of a file.

        Raises:
            UnreadableRecord: its head makes no sense.
        """
        _, length = RECORD_HEAD.unpack(
            scanner.read(offset, RECORD_HEAD_BYTES).ljust(RECORD_HEAD_BYTES, b"\0")
        )
        begin = offset + RECORD_HEAD_BYTES
        content = scanner.read(begin, MAX_SALVAGE_BYTES)
        head = parse_chunk_head(content, length)
        if head.end_ns < head.start_ns:
            raise UnreadableRecord("a chunk ends before it begins")
        trusted = find_doubtful_page(scanner, begin, begin + len(content)) - begin
        packed = content[head.data_offset : max(head.data_offset, trusted)]
        return cls(head, packed, begin + head.data_offset)

    def iterate_blocks(self) -> Iterator[list[InnerRecord]]:
        """Yields the records that end in each block; ends where the rest cannot be unpacked.

        Raises:
            UnreadableRecord: what was unpacked last is no record.
        """
        waiting = bytearray()
        for block in self._unpack():
            waiting += block
            found, done = _split_records(waiting)
            del waiting[:done]
            yield found

    def _unpack(self) -> Iterator[bytes]:
        unpackers: dict[str, Callable[[bytes], Iterator[bytes]]] = {
            "": partial(_iterate_pages, offset=self.offset),
            "zstd": _unpack_zstd,
            "lz4": _unpack_lz4,
        }
        unpack = unpackers.get(self.head.compression)
        room = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * len(self.packed))
        room = min(room, self.head.size)
        if unpack is None:
            return
        with suppress(zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError):
            for block in unpack(self.packed):
                room -= len(block)
                if room < 0:
                    return
                yield block


def find_doubtful_page(scanner: RecordScanner, begin: int, end: int) -> int:
    """Returns the offset of the first page of a part of a file that is empty or stands
    elsewhere in it too.

    Without such a page that is the end of the part.

    Args:
        scanner: reads the file.
        begin: first byte of the part.
        end: first byte after it.
    """
    first_page = -(-begin // PAGE_BYTES) * PAGE_BYTES
    places: dict[bytes, int] = {}
    for offset in range(first_page, end, PAGE_BYTES):
        page = scanner.read(offset, min(PAGE_BYTES, end - offset))
        if not any(page) or page in places:
            end = offset
            break
        if len(page) == PAGE_BYTES:
            places[page] = offset
    doubtful = end
    for offset in range(0, min(first_page, scanner.size), PAGE_BYTES):
        page = scanner.read(offset, PAGE_BYTES)
        doubtful = min(doubtful, places.get(page, doubtful))
    return doubtful


def _split_records(data: bytearray) -> tuple[list[InnerRecord], int]:
    """Returns the complete records at the beginning of unpacked bytes, and the bytes that they
    take.

    Raises:
        UnreadableRecord: there is something that is no record.
    """
    found: list[InnerRecord] = []
    end = 0
    while end + RECORD_HEAD_BYTES <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, end)
        if not opcode or length > MAX_UNPACKED_BYTES:
            raise UnreadableRecord("there is no record")
        begin = end + RECORD_HEAD_BYTES
        if begin + length > len(data):  # the rest comes with the next block
            break
        end = begin + length
        found.append((opcode, bytes(data[begin:end])))
    return found, end


def _iterate_pages(packed: bytes, offset: int = 0) -> Iterator[bytes]:
    """Yields bytes that begin at an offset of the file, page by page of the file."""
    place = 0
    while place < len(packed):
        end = place + PAGE_BYTES - (offset + place) % PAGE_BYTES
        yield packed[place:end]
        place = end


def _unpack_zstd(packed: bytes) -> Iterator[bytes]:
    """Yields what each complete block of a Zstandard frame unpacks to (RFC 8878, section
    3.1.1.2).
    """
    unpacker: Any = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES).decompressobj()
    place = zstandard.frame_header_size(packed)
    unpacker.decompress(packed[:place])
    is_last = False
    while not is_last and place + _BLOCK_HEAD_BYTES <= len(packed):
        block_head = int.from_bytes(packed[place : place + _BLOCK_HEAD_BYTES], "little")
        is_last = bool(block_head & 1)
        kind = block_head >> 1 & 3
        size = block_head >> 3
        end = place + _BLOCK_HEAD_BYTES + (1 if kind == _RUN_LENGTH_BLOCK else size)
        if size > _MAX_BLOCK_BYTES or end > len(packed):
            return
        yield unpacker.decompress(packed[place:end])
        place = end


def _unpack_lz4(packed: bytes) -> Iterator[bytes]:
    unpacker = lz4.frame.LZ4FrameDecompressor()
    for page in _iterate_pages(packed):
        yield unpacker.decompress(page)
        if unpacker.eof:
            return
