"""Writer of an MCAP file: records into chunks, chunks into a stream, an index at the end.

Invariant: the same calls give the same bytes; memory grows only by the packed index of the
chunks; the length of the end of the file is known at any time, so that disk space for it can be
reserved.

Not `mcap.writer.Writer`: it keeps a dictionary per chunk, 46 MiB an hour at ten chunks a second
of twelve channels, and takes three times as long. The tests read this writer's files with that
package.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Protocol

import zstandard
from mcap.opcode import Opcode

from .mcap_records import MAGIC, OP_MESSAGE, RECORD_HEAD
from .running_digest import DIGESTS, RunningDigest

CHUNK_BYTES = 1 << 20

_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<BQQQI")
_STATISTICS = struct.Struct("<QHIIIIQQ")
_SUMMARY = (
    *(Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS),
    *(Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX),
)
"""Records of the end of a file, in their order."""
_COMPRESSION = "zstd"
_OWED_ALWAYS = (
    512  # statistics without its counts, offsets of six groups, data end, footer, end mark
)


class Sink(Protocol):
    """A file, or a buffer that keeps bytes until `flush`.

    One that has `reserve` is told how many bytes the end of the file will take.
    """

    def write(self, data: bytes, /) -> int:
        """Takes bytes and returns how many."""

    def flush(self) -> None:
        """Writes them."""


def pack_text(text: str) -> bytes:
    """Returns a text as a record holds it, after its length; a name of a file may be no text."""
    data = text.encode(errors="backslashreplace")
    return struct.pack("<I", len(data)) + data


def pack_text_map(texts: Mapping[str, str]) -> bytes:
    """Returns a map of texts as a record holds it."""
    data = b"".join(pack_text(key) + pack_text(value) for key, value in texts.items())
    return struct.pack("<I", len(data)) + data


def pack_record(opcode: int, body: bytes) -> bytes:
    """Returns a record: the content after opcode and length."""
    return RECORD_HEAD.pack(opcode, len(body)) + body


class McapWriter:
    """One file, from its first byte to its end mark.

    Args:
        stream: receives the bytes; it is flushed whenever a chunk is complete.
        library: name of the program.
        profile: the MCAP profile.
        chunk_bytes: a chunk is closed when its records are longer than this.

    Attributes:
        position: number of bytes written.
        messages: number of messages added.
    """

    def __init__(
        self, stream: Sink, library: str, profile: str = "", chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        self.position = 0
        self.messages = 0
        self._stream = stream
        self._reserve: Callable[[int], None] | None = getattr(stream, "reserve", None)
        self._chunk_bytes = chunk_bytes
        self._compressor = zstandard.ZstdCompressor()
        self._open = bytearray()
        self._entries: dict[
            int, list[int]
        ] = {}  # of the open chunk: per channel log time, offset, ...
        self._counts: dict[int, int] = {}
        self._span_ns: tuple[int, int] | None = (
            None  # first and last log time, once there is a chunk
        )
        self._summary = {opcode: bytearray() for opcode in _SUMMARY}
        self._records: Counter[Opcode] = Counter()  # in the summary, by kind
        self._chain = RunningDigest()
        header = pack_text(profile) + pack_text(library)
        self._chain.add_entry(Opcode.HEADER, header)
        self._put(MAGIC + pack_record(Opcode.HEADER, header))

    def _put(self, data: bytes) -> int:
        self._stream.write(data)
        offset = self.position
        self.position += len(data)
        return offset

    def _add_to_summary(self, opcode: Opcode, body: bytes) -> bytes:
        record = pack_record(opcode, body)
        self._summary[opcode] += record
        self._records[opcode] += 1
        return record

    @property
    def end_bytes(self) -> int:
        """Most bytes that `finish` will write besides the open chunk."""
        return sum(map(len, self._summary.values())) + 10 * len(self._counts) + _OWED_ALWAYS

    @property
    def open_chunk_bytes(self) -> int:
        """Most bytes that the open chunk will take."""
        if not self._open:
            return 0
        index = 16 * (self.messages - self._chain.messages) + 25 * len(self._entries) + 200
        return len(self._open) + len(self._open) // 128 + index

    @property
    def duration_s(self) -> float:
        """From the first to the last message in chunks that are closed, by their log times, s."""
        first_ns, last_ns = self._span_ns or (0, 0)
        return (last_ns - first_ns) * 1e-9

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Writes a schema and returns its number."""
        number = self._records[Opcode.SCHEMA] + 1
        body = struct.pack("<H", number) + pack_text(name) + pack_text(encoding)
        body += struct.pack("<I", len(data)) + data
        self._chain.add_entry(Opcode.SCHEMA, body)
        self._put(self._add_to_summary(Opcode.SCHEMA, body))
        return number

    def register_channel(
        self,
        topic: str,
        message_encoding: str,
        schema_id: int,
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Writes a channel and returns its number; it precedes the open chunk. Schema 0 stands
        for none.
        """
        number = len(self._counts) + 1
        body = (
            struct.pack("<HH", number, schema_id)
            + pack_text(topic)
            + pack_text(message_encoding)
        )
        body += pack_text_map(metadata or {})
        self._chain.add_entry(Opcode.CHANNEL, body)
        self._put(self._add_to_summary(Opcode.CHANNEL, body))
        self._counts[number] = 0
        self._entries[number] = []
        return number

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Adds a message to the open chunk; times are in ns."""
        opened = self._open
        self._entries[channel_id] += (log_time, len(opened))
        opened += _MESSAGE.pack(
            OP_MESSAGE, 22 + len(data), channel_id, sequence, log_time, publish_time
        )
        opened += data
        self._counts[channel_id] += 1
        self.messages += 1
        if len(opened) > self._chunk_bytes:
            self.flush()

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Writes a metadata record, before the open chunk."""
        content = pack_text(name) + pack_text_map(data)
        if name != DIGESTS:
            self._chain.add_entry(Opcode.METADATA, content)
        record = pack_record(Opcode.METADATA, content)
        index = struct.pack("<QQ", self._put(record), len(record)) + pack_text(name)
        self._add_to_summary(Opcode.METADATA_INDEX, index)

    def add_attachment(
        self, create_time: int, log_time: int, name: str, media_type: str, data: bytes
    ) -> None:
        """Writes an attachment, before the open chunk; times are in ns, 0 if unknown."""
        times = struct.pack("<QQ", log_time, create_time)
        names = pack_text(name) + pack_text(media_type)
        body = times + names + struct.pack("<Q", len(data)) + data
        body += struct.pack("<I", zlib.crc32(body))
        self._chain.add_entry(Opcode.ATTACHMENT, body)
        record = pack_record(Opcode.ATTACHMENT, body)
        place = struct.pack("<QQ", self._put(record), len(record))
        index = place + times + struct.pack("<Q", len(data)) + names
        self._add_to_summary(Opcode.ATTACHMENT_INDEX, index)

    def flush(self) -> None:
        """Closes the open chunk, if it has messages, and flushes the stream."""
        if self._open:
            self._close_chunk()
        if self._reserve is not None:
            self._reserve(self.end_bytes)
        self._stream.flush()

    def close_digest(self) -> dict[str, str]:
        """Writes the digests of all that was added, and returns them; only `finish` may follow."""
        if self._open:
            self._close_chunk()
        facts = self._chain.facts()
        self.add_metadata(DIGESTS, facts)
        return facts

    def _close_chunk(self) -> None:
        self._chain.add_records(self._open, self.messages - self._chain.messages)
        data = self._compressor.compress(self._open)
        used = {channel: entries for channel, entries in self._entries.items() if entries}
        start_ns = min(min(entries[::2]) for entries in used.values())
        end_ns = max(max(entries[::2]) for entries in used.values())
        raw = len(self._open)
        head = _CHUNK.pack(start_ns, end_ns, raw, zlib.crc32(self._open)) + pack_text(
            _COMPRESSION
        )
        record = pack_record(Opcode.CHUNK, head + struct.pack("<Q", len(data)) + data)
        offset = self._put(record)
        begin = self.position
        places = b""
        for channel, entries in used.items():
            body = struct.pack(f"<HI{len(entries)}Q", channel, 8 * len(entries), *entries)
            place = self._put(pack_record(Opcode.MESSAGE_INDEX, body))
            places += struct.pack("<HQ", channel, place)
            self._entries[channel] = []
        times = struct.pack("<QQQQ", start_ns, end_ns, offset, len(record))
        sizes = struct.pack("<QQ", len(data), raw)
        index = times + struct.pack("<I", len(places)) + places
        index += struct.pack("<Q", self.position - begin) + pack_text(_COMPRESSION) + sizes
        self._add_to_summary(Opcode.CHUNK_INDEX, index)
        first_ns, last_ns = self._span_ns or (start_ns, end_ns)
        self._span_ns = min(first_ns, start_ns), max(last_ns, end_ns)
        self._open.clear()

    def finish(self) -> None:
        """Closes the open chunk, writes the index and the end mark, and flushes the stream."""
        if self._open:
            self._close_chunk()
        self._put(pack_record(Opcode.DATA_END, struct.pack("<I", 0)))
        kinds = (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX, Opcode.CHUNK_INDEX)
        numbers = (
            len(self._counts),
            *(self._records[kind] for kind in kinds),
            *(self._span_ns or (0, 0)),
        )
        head = _STATISTICS.pack(self.messages, self._records[Opcode.SCHEMA], *numbers)
        counts = b"".join(
            struct.pack("<HQ", n, count) for n, count in self._counts.items() if count
        )
        self._add_to_summary(Opcode.STATISTICS, head + struct.pack("<I", len(counts)) + counts)
        begin = self.position
        offsets = b""
        crc = 0
        for opcode, group in self._summary.items():
            if group:
                place = self._put(bytes(group))
                crc = zlib.crc32(group, crc)
                offsets += pack_record(
                    Opcode.SUMMARY_OFFSET, struct.pack("<BQQ", opcode, place, len(group))
                )
        where = self._put(offsets)
        footer = _FOOTER.pack(Opcode.FOOTER, 20, begin, where, 0)[:-4]
        crc = zlib.crc32(footer, zlib.crc32(offsets, crc))
        self._put(footer + struct.pack("<I", crc) + MAGIC)
        self._stream.flush()
