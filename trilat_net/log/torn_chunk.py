"""Records of a chunk that was cut off, block by block.

The checksum of a chunk covers all of its records, so it proves nothing once the end is missing.
A block is a piece of data that the compression unpacks as a whole.

Invariant:
    - The records of a block are used together or not at all: damage in the packed bytes of a
      block may falsify any of its records, including records that still look right.
    - Packed bytes are read up to the first doubtful page: a page that holds nothing but zeros
      was never written, and one that equals another page of the file was written to the wrong
      place.
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
"""Size of a page, in bytes. Memory and disks lose or misplace whole pages of a file."""
MAX_SALVAGE_BYTES = 64 << 20
"""Largest part of a cut chunk that is read, in bytes."""
_BLOCK_HEAD_BYTES = 3
_RUN_LENGTH_BLOCK = 1
_MAX_BLOCK_BYTES = 1 << 17

InnerRecord = tuple[int, bytes]
"""A record of a chunk: its opcode and its content."""


class TornChunk(NamedTuple):
    """A chunk that reaches beyond the end of its file.

    Attributes:
        head: head of the chunk.
        packed: packed bytes of the chunk that are present and can be trusted.
        offset: offset of the first packed byte in the file.
    """

    head: ChunkHead
    packed: bytes
    offset: int

    @classmethod
    def read(cls, scanner: RecordScanner, offset: int) -> "TornChunk":
        """Returns the chunk at an offset of a file.

        Raises:
            UnreadableRecord: the head of the chunk makes no sense.
        """
        record_head = scanner.read(offset, RECORD_HEAD_BYTES).ljust(RECORD_HEAD_BYTES, b"\0")
        _, length = RECORD_HEAD.unpack(record_head)
        begin = offset + RECORD_HEAD_BYTES
        content = scanner.read(begin, MAX_SALVAGE_BYTES)
        head = parse_chunk_head(content, length)
        if head.end_ns < head.start_ns:
            raise UnreadableRecord("a chunk ends before it begins")
        trusted = find_doubtful_page(scanner, begin, begin + len(content)) - begin
        packed = content[head.data_offset : max(head.data_offset, trusted)]
        return cls(head, packed, begin + head.data_offset)

    def iterate_blocks(self) -> Iterator[list[InnerRecord]]:
        """Yields the records that end in each block, until a block cannot be unpacked.

        Raises:
            UnreadableRecord: the bytes that were unpacked last are not a record.
        """
        unpacked = bytearray()
        for block in self._unpack():
            unpacked += block
            complete_records, complete_bytes = _split_records(unpacked)
            del unpacked[:complete_bytes]
            yield complete_records

    def _unpack(self) -> Iterator[bytes]:
        """Yields the unpacked blocks, until one is damaged or the size exceeds the limit."""
        unpackers: dict[str, Callable[[bytes], Iterator[bytes]]] = {
            "": partial(_iterate_pages, offset=self.offset),
            "zstd": _unpack_zstd,
            "lz4": _unpack_lz4,
        }
        unpack = unpackers.get(self.head.compression)
        if unpack is None:
            return
        limit = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * len(self.packed))
        remaining = min(limit, self.head.size)
        with suppress(zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError):
            for block in unpack(self.packed):
                remaining -= len(block)
                if remaining < 0:
                    return
                yield block


def find_doubtful_page(scanner: RecordScanner, begin: int, end: int) -> int:
    """Returns the offset of the first doubtful page in a part of a file.

    A page is doubtful if it is empty, or if the file also contains it elsewhere before the end
    of the part.

    Args:
        scanner: reads the file.
        begin: offset of the part's first byte.
        end: offset of the first byte after the part.

    Returns:
        The offset of the page; `end` if no page is doubtful.
    """
    first_page = -(-begin // PAGE_BYTES) * PAGE_BYTES
    offsets: dict[bytes, int] = {}
    for offset in range(first_page, end, PAGE_BYTES):
        page = scanner.read(offset, min(PAGE_BYTES, end - offset))
        if not any(page) or page in offsets:
            end = offset
            break
        if len(page) == PAGE_BYTES:
            offsets[page] = offset
    first_doubtful = end
    for offset in range(0, min(first_page, scanner.size), PAGE_BYTES):
        page = scanner.read(offset, PAGE_BYTES)
        first_doubtful = min(first_doubtful, offsets.get(page, first_doubtful))
    return first_doubtful


def _split_records(data: bytearray) -> tuple[list[InnerRecord], int]:
    """Returns the complete records at the beginning of unpacked bytes, and their total size.

    Raises:
        UnreadableRecord: the bytes are not a record.
    """
    complete: list[InnerRecord] = []
    end = 0
    while end + RECORD_HEAD_BYTES <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, end)
        if not opcode or length > MAX_UNPACKED_BYTES:
            raise UnreadableRecord("there is no record")
        begin = end + RECORD_HEAD_BYTES
        if begin + length > len(data):  # the next block contains the rest
            break
        end = begin + length
        complete.append((opcode, bytes(data[begin:end])))
    return complete, end


def _iterate_pages(packed: bytes, offset: int = 0) -> Iterator[bytes]:
    """Yields bytes that begin at an offset of the file, split at the pages of the file."""
    start = 0
    while start < len(packed):
        end = start + PAGE_BYTES - (offset + start) % PAGE_BYTES
        yield packed[start:end]
        start = end


def _unpack_zstd(packed: bytes) -> Iterator[bytes]:
    """Yields the unpacked complete blocks of a Zstandard frame (RFC 8878, section 3.1.1.2)."""
    unpacker: Any = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES).decompressobj()
    start = zstandard.frame_header_size(packed)
    unpacker.decompress(packed[:start])
    is_last = False
    while not is_last and start + _BLOCK_HEAD_BYTES <= len(packed):
        block_head = int.from_bytes(packed[start : start + _BLOCK_HEAD_BYTES], "little")
        is_last = bool(block_head & 1)
        kind = block_head >> 1 & 3
        size = block_head >> 3
        # A run-length block holds one byte, and `size` is the length of the run.
        end = start + _BLOCK_HEAD_BYTES + (1 if kind == _RUN_LENGTH_BLOCK else size)
        if size > _MAX_BLOCK_BYTES or end > len(packed):
            return
        yield unpacker.decompress(packed[start:end])
        start = end


def _unpack_lz4(packed: bytes) -> Iterator[bytes]:
    """Yields the unpacked data of an LZ4 frame, page by page."""
    unpacker = lz4.frame.LZ4FrameDecompressor()
    for page in _iterate_pages(packed):
        yield unpacker.decompress(page)
        if unpacker.eof:
            return
