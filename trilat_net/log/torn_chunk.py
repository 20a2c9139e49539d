"""Recovers messages from a truncated compressed chunk of a log.

An MCAP file stores messages in compressed chunks. If a recording is interrupted, the last chunk
may be incomplete. Its checksum is then useless, because it covers all messages of the chunk,
including those in the missing part. But the compressed data consist of blocks that can be
decompressed one by one, so the messages of all complete blocks can be used.

Invariant:
    - The messages of a block are used together or not at all, because damage to the compressed
      bytes of a block may falsify any of its messages, including messages that still look
      correct.
    - Compressed bytes are read up to the first doubtful page. A page that contains only zeros
      was never written to the disk. A page that equals another page of the file was written to
      the wrong place.
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
)

PAGE_BYTES = 4096
"""Size of a page, in bytes. Operating systems and disks lose or misplace entire pages of a
file.
"""
_MAX_SALVAGE_BYTES = 64 << 20
"""Maximum number of bytes read from an incomplete chunk."""
# Blocks of a Zstandard frame, from RFC 8878, section 3.1.1.2.
_BLOCK_HEAD_BYTES = 3
_RUN_LENGTH_BLOCK = 1
_MAX_BLOCK_BYTES = 1 << 17

InnerRecord = tuple[int, bytes]
"""A record inside a chunk, as its opcode and content."""


class TornChunk(NamedTuple):
    """A compressed chunk of messages whose end is missing from its file.

    This happens when a recording is interrupted. The messages in the remaining part can still
    be recovered.

    Attributes:
        head: Header of the chunk, which describes the compressed records.
        packed: Compressed bytes of the chunk that are in the file and can be trusted.
        offset: Offset of the first compressed byte in the file.
    """

    head: ChunkHead
    packed: bytes
    offset: int

    @classmethod
    def read(cls, scanner: RecordScanner, offset: int) -> "TornChunk":
        """Reads the remaining part of a truncated chunk.

        Args:
            scanner: Scanner of the file.
            offset: Offset of the chunk in the file.

        Returns:
            The header of the chunk, and its compressed bytes. The bytes end before the first
            page of the file that was probably not written correctly, see `_find_doubtful_page`.

        Raises:
            UnreadableRecord: The header of the chunk contains impossible values.
        """
        # Missing bytes are replaced by zeros, so that the code below refuses an incomplete
        # head.
        record_head = scanner.read(offset, RECORD_HEAD_BYTES).ljust(RECORD_HEAD_BYTES, b"\0")
        _, length = RECORD_HEAD.unpack(record_head)
        begin = offset + RECORD_HEAD_BYTES
        content = scanner.read(begin, _MAX_SALVAGE_BYTES)
        head = ChunkHead.parse(content, length)
        if head.end_ns < head.start_ns:
            raise UnreadableRecord("the end time of a chunk is before its start time")

        trusted_bytes = _find_doubtful_page(scanner, begin, begin + len(content)) - begin
        packed = content[head.data_offset : max(head.data_offset, trusted_bytes)]
        return cls(head, packed, begin + head.data_offset)

    def iterate_blocks(self) -> Iterator[list[InnerRecord]]:
        """Decompresses the intact part of the chunk block by block.

        A block is a piece of the compressed data that is decompressed as a unit. A record that
        continues in the next block is yielded with the block that contains its end.

        Yields:
            The records of each block. Nothing if the first block is damaged or incomplete.

        Raises:
            UnreadableRecord: The decompressed bytes are not a record.
        """
        unpacked = bytearray()
        for block in self._unpack():
            unpacked += block
            complete_records, complete_bytes = _split_records(unpacked)
            del unpacked[:complete_bytes]
            yield complete_records

    def _unpack(self) -> Iterator[bytes]:
        """Yields the decompressed blocks, until a block is damaged or incomplete.

        Also stops if the total size of the blocks exceeds the size stated in the header of the
        chunk. If the chunk is not compressed, a block is a page of the file.
        """
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


def _find_doubtful_page(scanner: RecordScanner, begin: int, end: int) -> int:
    """Finds the first page in a part of a file that was probably not written correctly.

    A page is a block of `PAGE_BYTES` that the operating system writes as a unit. If a computer
    loses power, some pages of a file may be missing or in the wrong place. A page of the part
    is therefore doubtful in two cases:

    - It contains only zeros: it was never written.
    - It equals another page, in the part or before it. Compressed data hardly ever repeat an
      entire page by chance, so the page was probably written to the wrong place.

    Args:
        scanner: Scanner of the file.
        begin: Offset of the part's first byte.
        end: Offset after the part's last byte.

    Returns:
        The offset of the page, or `end` if no page is doubtful.
    """
    # The first boundary of a page in the part: -(-a // b) rounds a / b up.
    first_page = -(-begin // PAGE_BYTES) * PAGE_BYTES
    first_doubtful = end
    # Offset of each whole page of the part, by its content. The last page may be incomplete. It
    # is left out, because it cannot be equal to a whole page.
    offsets: dict[bytes, int] = {}
    for offset in range(first_page, end, PAGE_BYTES):
        page = scanner.read(offset, min(PAGE_BYTES, end - offset))
        is_unwritten = not any(page)
        if is_unwritten or page in offsets:
            first_doubtful = offset
            break
        if len(page) == PAGE_BYTES:
            offsets[page] = offset

    # A page of the part that is equal to a page before the part is doubtful as well.
    for offset in range(0, min(first_page, scanner.size), PAGE_BYTES):
        page_before_part = scanner.read(offset, PAGE_BYTES)
        equal_page = offsets.get(page_before_part)
        if equal_page is not None:
            first_doubtful = min(first_doubtful, equal_page)
    return first_doubtful


def _split_records(data: bytearray) -> tuple[list[InnerRecord], int]:
    """Splits decompressed bytes into the complete records at their beginning.

    Args:
        data: The decompressed bytes, which begin with a record.

    Raises:
        UnreadableRecord: The bytes are not a record.
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
    """Splits bytes at the page boundaries of their file, since disks lose entire pages.

    Args:
        packed: The bytes.
        offset: Offset of the first byte in the file.
    """
    start = 0
    while start < len(packed):
        end = start + PAGE_BYTES - (offset + start) % PAGE_BYTES
        yield packed[start:end]
        start = end


def _unpack_zstd(packed: bytes) -> Iterator[bytes]:
    """Yields the decompressed data of each complete block of a Zstandard frame.

    A frame consists of a header and blocks (RFC 8878, section 3.1.1.2). The header of a block
    has 3 bytes: bit 0 marks the last block, bits 1 and 2 are the kind, and the others the size.
    """
    unpacker: Any = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW_BYTES).decompressobj()
    start = zstandard.frame_header_size(packed)
    unpacker.decompress(packed[:start])
    is_last = False
    while not is_last and start + _BLOCK_HEAD_BYTES <= len(packed):
        block_head = int.from_bytes(packed[start : start + _BLOCK_HEAD_BYTES], "little")
        is_last = bool(block_head & 1)
        kind = block_head >> 1 & 3
        size = block_head >> 3
        # A run-length block contains one byte, and `size` is the number of repetitions.
        content_bytes = 1 if kind == _RUN_LENGTH_BLOCK else size
        end = start + _BLOCK_HEAD_BYTES + content_bytes
        if size > _MAX_BLOCK_BYTES or end > len(packed):
            return
        yield unpacker.decompress(packed[start:end])
        start = end


def _unpack_lz4(packed: bytes) -> Iterator[bytes]:
    """Yields the decompressed data of an LZ4 frame in pages, up to an incomplete part."""
    unpacker = lz4.frame.LZ4FrameDecompressor()
    for page in _iterate_pages(packed):
        yield unpacker.decompress(page)
        if unpacker.eof:
            return
