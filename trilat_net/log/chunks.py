"""Walks through an MCAP file, chunk by chunk, as far as it is whole.

Law: bounded memory, one chunk at a time; a torn tail ends the walk and is reported, never hidden. The
`mcap` package parses the file; only the messages inside a chunk are taken apart here, because that loop is
what reading a log costs.
"""

import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, Footer, Message, Metadata
from mcap.stream_reader import StreamReader

from ..errors import LogError

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHANNEL = struct.Struct("<HHI")
_OP_CHANNEL, _OP_MESSAGE = 0x04, 0x05
_RECORD_LIMIT = 1 << 30


class Item(NamedTuple):
    """One message: its topic, its bytes, and when it was logged, Unix ns."""

    topic: str
    payload: bytes
    log_time_ns: int


class Walk:
    """One pass over a file.

    Args:
        stream: the file, opened for reading.
        name: what errors call it.

    Attributes:
        metadata: metadata records seen so far, by name.
        attachments: attachments seen so far, by name.
        complete: True once all was read, to the end mark's last byte: the file was finished.
    """

    def __init__(self, stream: BinaryIO, name: str) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.complete = False
        self._stream = stream
        self._name = name
        self._topics: dict[int, str] = {}

    def messages(self) -> Iterator[Item]:
        """Yields every message in file order.

        Raises:
            LogError: the file is no MCAP file, or a chunk is damaged.
        """
        records = StreamReader(self._stream, emit_chunks=True, record_size_limit=_RECORD_LIMIT).records
        finished = False
        while True:
            try:
                record = next(records, None)
            except (McapError, EOFError, struct.error, ValueError, OverflowError) as error:
                if not self.metadata and not self._topics:
                    raise LogError(f"{self._name}: is no MCAP file ({type(error).__name__})") from None
                return  # torn: what came before is whole
            if record is None:
                self.complete = finished
                return
            if isinstance(record, Chunk):
                data = self._uncompressed(record)
                try:
                    yield from self._in_chunk(data)
                except (struct.error, UnicodeDecodeError) as error:
                    raise LogError(f"{self._name}: a chunk is damaged: {error}") from None
            elif isinstance(record, Message):
                yield Item(self._topics.get(record.channel_id, ""), record.data, record.log_time)
            elif isinstance(record, Channel):
                self._topics[record.id] = record.topic
            elif isinstance(record, Metadata):
                self.metadata[record.name] = record.metadata
            elif isinstance(record, Attachment):
                self.attachments[record.name] = record.data
            elif isinstance(record, Footer):
                finished = True

    def _uncompressed(self, chunk: Chunk) -> bytes:
        """Returns a chunk's records.

        Raises:
            LogError: the chunk is damaged.
        """
        try:
            if chunk.compression == "zstd":
                data = zstandard.ZstdDecompressor().decompress(chunk.data, chunk.uncompressed_size)
            elif chunk.compression == "lz4":
                data = lz4.frame.decompress(chunk.data)
            else:
                data = chunk.data
        except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
            raise LogError(f"{self._name}: a chunk is damaged: {error}") from None
        if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
            raise LogError(f"{self._name}: a chunk is damaged: its CRC differs")
        return data

    def _in_chunk(self, data: bytes) -> Iterator[Item]:
        offset, end = 0, len(data)
        while offset < end:
            opcode, length = _RECORD.unpack_from(data, offset)
            offset += _RECORD.size
            if opcode == _OP_MESSAGE:
                channel, _, log_time_ns, _ = _MESSAGE.unpack_from(data, offset)
                payload = data[offset + _MESSAGE.size : offset + length]
                yield Item(self._topics.get(channel, ""), payload, log_time_ns)
            elif opcode == _OP_CHANNEL:
                channel, _, size = _CHANNEL.unpack_from(data, offset)
                start = offset + _CHANNEL.size
                self._topics[channel] = data[start : start + size].decode()
            offset += length
