"""Chunks: what one says of itself, and the records packed in it.

Law: a chunk is not believed. It is unpacked to at most what its size allows, and only if what it says of
itself agrees with what it is.
"""

import struct
import zlib
from typing import NamedTuple

import lz4.frame
import zstandard

UNPACKED_BYTES = 32 << 20
UNPACKED_RATIO = 32
"""A chunk unpacks to at most so many bytes, or to so many times its own where that is more."""
COMPRESSIONS = (b"zstd", b"lz4")
"""How a chunk may be packed, besides not at all."""
NAME_OFFSET = 28
"""Where in a chunk's content the name of its compression stands, with its length (4 bytes) before it."""
MAX_HEAD_BYTES = NAME_OFFSET + 4 + 32 + 8
"""A chunk's head is no longer; a name of a compression is at most 32 bytes."""

_FIXED = struct.Struct("<QQQII")
_SIZE = struct.Struct("<Q")
_WINDOW_BYTES = 32 << 20


class Unreadable(Exception):  # noqa: N818 - what it says of a part of a file
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


def chunk_head(content: bytes, length: int) -> ChunkHead:
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
        raise Unreadable("a chunk has no head") from None
    data_offset = _FIXED.size + letters + _SIZE.size
    if data_offset + packed != length:
        raise Unreadable(f"a chunk of {length} bytes says that it has {data_offset + packed}")
    return ChunkHead(start_ns, end_ns, size, crc, compression, data_offset)


def unpacked(content: bytes) -> bytes:
    """Returns the records in a chunk.

    Args:
        content: the chunk's content.

    Raises:
        Unreadable: it is damaged, or unpacks to more than it may.
    """
    head = chunk_head(content, len(content))
    limit = max(UNPACKED_BYTES, UNPACKED_RATIO * len(content))
    if head.size > limit:
        raise Unreadable(f"a chunk says that it unpacks to {head.size} bytes, at most {limit} are taken")
    data = _unpack(head, memoryview(content)[head.data_offset :])
    if len(data) != head.size:
        raise Unreadable(f"a chunk of {head.size} bytes unpacks to {len(data)}")
    if head.crc and zlib.crc32(data) != head.crc:
        raise Unreadable("a chunk's CRC differs")
    return data


def _unpack(head: ChunkHead, data: memoryview) -> bytes:
    try:
        if head.compression == "zstd":
            said = zstandard.get_frame_parameters(data).content_size
            if said not in (head.size, zstandard.CONTENTSIZE_UNKNOWN):  # the library would believe it
                raise Unreadable(f"a chunk of {head.size} bytes unpacks to {said}")
            return zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES).decompress(data, head.size)
        if head.compression == "lz4":
            # one byte more, so that one that is too long shows
            unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=head.size + 1)
            return unpacked
    except (zstandard.ZstdError, RuntimeError, ValueError, OverflowError, MemoryError) as error:
        raise Unreadable(f"a chunk cannot be unpacked: {error}") from None
    if head.compression:
        raise Unreadable(f"a chunk is packed by {head.compression!r}, which nobody here can unpack")
    return bytes(data)
