"""What is left of a chunk whose end was cut off: its records, as far as they are complete.

Law: it is unpacked piece by piece, to at most what a whole chunk may hold, as far as it makes sense.
"""

import struct
from collections.abc import Iterator

import lz4.frame
import zstandard

from .packed import NAME_OFFSET, UNPACKED_BYTES, UNPACKED_RATIO

READ_BYTES = 64 << 20
"""No more of a cut chunk is looked at."""
_PIECE_BYTES = 1 << 16
_WINDOW_BYTES = 32 << 20
_LETTERS = struct.Struct("<I")
_RECORD = struct.Struct("<BQ")
_SIZE_BYTES = 8


def salvaged(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields the records of a chunk that are complete: opcode and content.

    Args:
        content: what is left of the chunk's content.
    """
    limit = max(UNPACKED_BYTES, UNPACKED_RATIO * len(content))
    waiting = bytearray()
    for piece in _pieces(content):
        waiting += piece
        limit -= len(piece)
        at = 0
        while len(waiting) - at >= _RECORD.size:
            opcode, length = _RECORD.unpack_from(waiting, at)
            if not opcode or length > limit + len(waiting):
                return
            end = at + _RECORD.size + length
            if end > len(waiting):
                break
            yield opcode, bytes(waiting[at + _RECORD.size : end])
            at = end
        del waiting[:at]
        if limit <= 0:
            return


def _pieces(content: bytes) -> Iterator[bytes]:
    """Yields what is left of a chunk's records, unpacked."""
    name_at = NAME_OFFSET + _LETTERS.size
    if len(content) < name_at:
        return
    (letters,) = _LETTERS.unpack_from(content, NAME_OFFSET)
    if letters > len(content):
        return
    compression = content[name_at : name_at + letters]
    data = content[name_at + letters + _SIZE_BYTES :]
    if not compression:
        yield data
    elif compression == b"zstd":
        yield from _zstd(data)
    elif compression == b"lz4":
        yield from _lz4(data)


def _zstd(data: bytes) -> Iterator[bytes]:
    try:
        with zstandard.ZstdDecompressor(max_window_size=_WINDOW_BYTES).stream_reader(data) as reader:
            while piece := reader.read(_PIECE_BYTES):
                yield piece
    except (zstandard.ZstdError, MemoryError):
        return


def _lz4(data: bytes) -> Iterator[bytes]:
    unpacker = lz4.frame.LZ4FrameDecompressor()
    try:
        piece = unpacker.decompress(data, max_length=_PIECE_BYTES)
        while piece:
            yield piece
            if unpacker.eof or unpacker.needs_input:
                return
            piece = unpacker.decompress(b"", max_length=_PIECE_BYTES)
    except (RuntimeError, ValueError, MemoryError, EOFError):
        return
