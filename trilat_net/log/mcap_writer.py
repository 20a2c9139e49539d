"""Writes MCAP files, the format in which logs store their messages.

Messages are collected into chunks, which are compressed and written to a stream. The index,
which states where the chunks are, is written at the end of the file. The writer of the `mcap`
package is not used because it keeps a dictionary for every chunk, which takes 46 MiB per hour
at ten chunks per second with twelve channels, and because it needs three times the computing
time. The tests use that package to read the files written here.

Invariant:
    - The same calls produce the same bytes.
    - Memory grows only by the encoded index entries of the chunks.
    - The length of the end of the file is known at any time, so that disk space can be reserved
      for it.
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

_CHUNK_BYTES = 1 << 20
"""Total size of messages at which a chunk is closed, in bytes before compression."""

# Fields of fixed size, in the order of the specification at mcap.dev.
_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<BQQQI")
_STATISTICS = struct.Struct("<QHIIIIQQ")
_SUMMARY = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)
"""Kinds of records in the summary at the end of a file, in file order."""
_COMPRESSION = "zstd"
_FIXED_END_BYTES = 512
"""Upper bound on the total size of the records at the end whose number is fixed, in bytes.

These are the statistics without the counts per channel, the offsets of six groups of records,
the end of the data, the footer and the end mark.
"""


class Sink(Protocol):
    """Destination for the bytes of the file: a file, or a buffer that waits for `flush`.

    If the sink has a method `reserve(size)`, the writer calls it with the number of bytes that
    the end of the file will need, so that the sink can reserve disk space for them.
    """

    def write(self, data: bytes, /) -> int:
        """Accepts bytes for the file, and returns their number.

        Some implementations buffer the bytes until `flush`.

        Args:
            data: The bytes to write.
        """

    def flush(self) -> None:
        """Passes buffered bytes on to the file, so that other programs can read them."""


def _pack_text(text: str) -> bytes:
    """Encodes a string for an MCAP file: its length in bytes, then its bytes in UTF-8."""
    # The name of a file may contain surrogates, which UTF-8 cannot encode.
    data = text.encode(errors="backslashreplace")
    return _pack_bytes(data)


def _pack_text_map(texts: Mapping[str, str]) -> bytes:
    """Encodes a dictionary of strings for an MCAP file.

    The length of the encoded dictionary in bytes comes first, then each key and each value.

    Args:
        texts: The dictionary.
    """
    data = b"".join(_pack_text(key) + _pack_text(value) for key, value in texts.items())
    return _pack_bytes(data)


def _pack_bytes(data: bytes) -> bytes:
    """Returns bytes preceded by their length as a 32-bit integer."""
    return struct.pack("<I", len(data)) + data


def _pack_long_bytes(data: bytes) -> bytes:
    """Returns bytes preceded by their length as a 64-bit integer."""
    return struct.pack("<Q", len(data)) + data


def _pack_record(opcode: int, body: bytes) -> bytes:
    """Encodes an MCAP record: its opcode, the length of its content, and the content.

    Args:
        opcode: Identifies the kind of record.
        body: Content of the record.
    """
    return RECORD_HEAD.pack(opcode, len(body)) + body


class McapWriter:
    """Writes one MCAP file, from its first byte to its end mark.

    Schemas and channels are registered first, then messages are added. `finish` completes the
    file.

    Args:
        stream: File or buffer to write to. It is flushed whenever a chunk is complete.
        library: Name of the writing program, as stated in the file.
        profile: MCAP profile, as stated in the file.
        chunk_bytes: Total size of messages at which a chunk is closed, in bytes.

    Attributes:
        position: Number of bytes written.
        messages: Number of messages added.
    """

    def __init__(
        self, stream: Sink, library: str, profile: str = "", chunk_bytes: int = _CHUNK_BYTES
    ) -> None:
        """Begins an MCAP file with the eight magic bytes of the format, and a header."""
        self.position = 0
        self.messages = 0
        self._stream = stream
        self._reserve: Callable[[int], None] | None = getattr(stream, "reserve", None)
        self._chunk_bytes = chunk_bytes
        self._compressor = zstandard.ZstdCompressor()
        # Messages that were not written yet, encoded as records.
        self._open_chunk = bytearray()
        # Index of the open chunk: for each channel log time, offset, log time, offset, ...
        self._entries: dict[int, list[int]] = {}
        # Number of messages of each channel.
        self._counts: dict[int, int] = {}
        # First and last log time of the closed chunks. None before the first chunk.
        self._span_ns: tuple[int, int] | None = None
        # Encoded records of the summary, and their numbers, by kind.
        self._summary = {opcode: bytearray() for opcode in _SUMMARY}
        self._summary_counts: Counter[Opcode] = Counter()
        self._chain = RunningDigest()
        header = _pack_text(profile) + _pack_text(library)
        self._chain.add_entry(Opcode.HEADER, header)
        self._write(MAGIC + _pack_record(Opcode.HEADER, header))

    def _write(self, data: bytes) -> int:
        """Writes bytes, and returns their offset in the file."""
        self._stream.write(data)
        offset = self.position
        self.position += len(data)
        return offset

    def _add_to_summary(self, opcode: Opcode, body: bytes) -> bytes:
        """Adds a record to the summary of the file, and returns the encoded record."""
        record = _pack_record(opcode, body)
        self._summary[opcode] += record
        self._summary_counts[opcode] += 1
        return record

    @property
    def end_bytes(self) -> int:
        """Upper bound on the size of the end of the file (index and end mark), in bytes.

        This much disk space must be reserved so that the file can be finished. The messages of
        the chunk that is still open are not included, see `open_chunk_bytes`.
        """
        summary_bytes = sum(map(len, self._summary.values()))
        return summary_bytes + 10 * len(self._counts) + _FIXED_END_BYTES

    @property
    def open_chunk_bytes(self) -> int:
        """Upper bound on the size of messages added but not yet written, in bytes.

        These messages form the open chunk, which is written as one block. The bound includes
        the index of the messages. It is 0 if there are no such messages.
        """
        if not self._open_chunk:
            return 0
        messages = self.messages - self._chain.messages
        # An index entry has 16 bytes, the index of a channel has 25 more bytes, and the head of
        # the chunk and its entry in the summary together have less than 200 bytes.
        index_bytes = 16 * messages + 25 * len(self._entries) + 200
        # Zstandard may expand data that it cannot compress, by less than 1/128.
        data_bytes = len(self._open_chunk) + len(self._open_chunk) // 128
        return data_bytes + index_bytes

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message written to the file, in s.

        Based on the log times, at which the messages arrived at the recorder. Messages of the
        chunk that is still open do not count as written. The duration is 0 if nothing was
        written.
        """
        first_ns, last_ns = self._span_ns or (0, 0)
        return (last_ns - first_ns) * 1e-9

    def register_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Writes a schema to the file, so that other programs can decode the messages.

        Args:
            name: Name of the schema.
            encoding: Language of the schema, such as "jsonschema".
            data: Encoded text of the schema.

        Returns:
            The identifier of the schema in the file, for use with `register_channel`.
        """
        number = self._summary_counts[Opcode.SCHEMA] + 1
        body = struct.pack("<H", number) + _pack_text(name) + _pack_text(encoding)
        body += _pack_bytes(data)
        self._chain.add_entry(Opcode.SCHEMA, body)
        self._write(self._add_to_summary(Opcode.SCHEMA, body))
        return number

    def register_channel(
        self,
        topic: str,
        message_encoding: str,
        schema_id: int,
        metadata: Mapping[str, str] | None = None,
    ) -> int:
        """Writes the definition of a channel, a sequence of messages of one kind, to the file.

        The definition precedes the messages that are still in memory (the open chunk).

        Args:
            topic: Topic of the channel.
            message_encoding: Encoding of the messages.
            schema_id: Identifier of the schema, or 0 for a channel without a schema.
            metadata: Metadata of the channel.

        Returns:
            The identifier of the channel in the file, for use with `add_message`.
        """
        number = len(self._counts) + 1
        body = struct.pack("<HH", number, schema_id)
        body += _pack_text(topic) + _pack_text(message_encoding)
        body += _pack_text_map(metadata or {})
        self._chain.add_entry(Opcode.CHANNEL, body)
        self._write(self._add_to_summary(Opcode.CHANNEL, body))
        self._counts[number] = 0
        self._entries[number] = []
        return number

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """Adds a message to the open chunk, and writes the chunk if it is large enough.

        The messages of a chunk are compressed together, which makes the file much smaller.

        Args:
            channel_id: Identifier of the channel, from `register_channel`.
            log_time: Time at which the message arrived, in ns.
            data: Bytes of the message.
            publish_time: Time at which the message was sent, in ns.
            sequence: Sequence number of the message.
        """
        chunk = self._open_chunk
        self._entries[channel_id] += (log_time, len(chunk))
        chunk += _MESSAGE.pack(
            OP_MESSAGE, 22 + len(data), channel_id, sequence, log_time, publish_time
        )
        chunk += data
        self._counts[channel_id] += 1
        self.messages += 1
        if len(chunk) > self._chunk_bytes:
            self.flush()

    def add_metadata(self, name: str, data: Mapping[str, str]) -> None:
        """Writes a named dictionary of strings to the file, such as facts about a session.

        The dictionary precedes the messages that are still in memory (the open chunk).

        Args:
            name: Name of the metadata.
            data: The dictionary.
        """
        content = _pack_text(name) + _pack_text_map(data)
        if name != DIGESTS:
            self._chain.add_entry(Opcode.METADATA, content)
        record = _pack_record(Opcode.METADATA, content)
        offset = self._write(record)
        index = struct.pack("<QQ", offset, len(record)) + _pack_text(name)
        self._add_to_summary(Opcode.METADATA_INDEX, index)

    def add_attachment(
        self, create_time: int, log_time: int, name: str, media_type: str, data: bytes
    ) -> None:
        """Writes an attachment, a small file that is stored with the messages.

        The attachment precedes the messages that are still in memory (the open chunk).

        Args:
            create_time: Time at which the attachment was created, in ns; 0 if unknown.
            log_time: Time at which the attachment was recorded, in ns; 0 if unknown.
            name: Name of the attachment.
            media_type: Media type of the attachment.
            data: Content of the attachment.
        """
        times = struct.pack("<QQ", log_time, create_time)
        names = _pack_text(name) + _pack_text(media_type)
        body = times + names + _pack_long_bytes(data)
        body += struct.pack("<I", zlib.crc32(body))
        self._chain.add_entry(Opcode.ATTACHMENT, body)
        record = _pack_record(Opcode.ATTACHMENT, body)
        offset = self._write(record)
        extent = struct.pack("<QQ", offset, len(record))
        index = extent + times + struct.pack("<Q", len(data)) + names
        self._add_to_summary(Opcode.ATTACHMENT_INDEX, index)

    def flush(self) -> None:
        """Ends the open chunk, if it contains messages, and flushes the stream.

        All messages so far can then be read from the file, even if the program stops now.
        Frequent calls produce small chunks, which compress less well.
        """
        if self._open_chunk:
            self._close_chunk()
        if self._reserve is not None:
            self._reserve(self.end_bytes)
        self._stream.flush()

    def close_digest(self) -> dict[str, str]:
        """Closes the open chunk, and writes the digests of all contents as metadata.

        The digests are checksums that reveal later modifications of the file. Afterwards, only
        `finish` may be called.

        Returns:
            The metadata that contain the digests.
        """
        if self._open_chunk:
            self._close_chunk()
        facts = self._chain.facts()
        self.add_metadata(DIGESTS, facts)
        return facts

    def _close_chunk(self) -> None:
        """Writes the open chunk, which contains the newest messages, and the indexes to it.

        The format is defined by the MCAP specification. Three kinds of records are produced:

        1. Chunk: a header with the time range, the size and the checksum (CRC) of the messages,
           and the compressed messages.
        2. Message index, one per channel with messages in the chunk: the log time of each
           message, and its offset in the uncompressed chunk.
        3. Chunk index: the offsets of the chunk and its message indexes. It is only added to
           the summary, which `finish` writes at the end of the file.

        The messages are also added to the running digest, a checksum of all messages.
        """
        # The digest has counted the messages of the closed chunks.
        new_messages = self.messages - self._chain.messages
        self._chain.add_records(self._open_chunk, new_messages)
        packed = self._compressor.compress(self._open_chunk)
        # Index entries of the channels that have messages in the chunk. Log times and offsets
        # alternate: every second number, from the first one on, is a time.
        used = {channel: entries for channel, entries in self._entries.items() if entries}
        start_ns = min(min(entries[::2]) for entries in used.values())
        end_ns = max(max(entries[::2]) for entries in used.values())
        unpacked_bytes = len(self._open_chunk)
        crc = zlib.crc32(self._open_chunk)
        head = _CHUNK.pack(start_ns, end_ns, unpacked_bytes, crc) + _pack_text(_COMPRESSION)
        chunk_record = _pack_record(Opcode.CHUNK, head + _pack_long_bytes(packed))
        chunk_offset = self._write(chunk_record)

        indexes_start = self.position
        index_offsets = b""
        for channel, entries in used.items():
            # The channel (16 bits), the size of the entries in bytes (32 bits), and the
            # entries, each of which consists of 64-bit numbers with 8 bytes.
            entries_bytes = 8 * len(entries)
            body = struct.pack(f"<HI{len(entries)}Q", channel, entries_bytes, *entries)
            index_offset = self._write(_pack_record(Opcode.MESSAGE_INDEX, body))
            index_offsets += struct.pack("<HQ", channel, index_offset)
            self._entries[channel] = []
        indexes_bytes = self.position - indexes_start

        # The fields of a chunk index, in the order of the specification.
        chunk_index = struct.pack("<QQQQ", start_ns, end_ns, chunk_offset, len(chunk_record))
        chunk_index += _pack_bytes(index_offsets)
        chunk_index += struct.pack("<Q", indexes_bytes) + _pack_text(_COMPRESSION)
        chunk_index += struct.pack("<QQ", len(packed), unpacked_bytes)
        self._add_to_summary(Opcode.CHUNK_INDEX, chunk_index)

        first_ns, last_ns = self._span_ns or (start_ns, end_ns)
        self._span_ns = min(first_ns, start_ns), max(last_ns, end_ns)
        self._open_chunk.clear()

    def finish(self) -> None:
        """Completes the file, so that any program can read it.

        Writes the open chunk, the summary with the index and the statistics, a table of the
        offsets in the summary, the footer and the end mark, and flushes the stream.
        """
        if self._open_chunk:
            self._close_chunk()
        self._write(_pack_record(Opcode.DATA_END, struct.pack("<I", 0)))
        self._add_to_summary(Opcode.STATISTICS, self._pack_statistics())

        # The summary contains a group of records for each kind: schemas, channels, index, ...
        summary_start = self.position
        offsets = b""
        crc = 0
        for opcode, group in self._summary.items():
            if not group:
                continue
            group_start = self._write(bytes(group))
            crc = zlib.crc32(group, crc)
            offset_body = struct.pack("<BQQ", opcode, group_start, len(group))
            offsets += _pack_record(Opcode.SUMMARY_OFFSET, offset_body)
        offsets_start = self._write(offsets)

        # The checksum covers the summary and the footer, up to the checksum itself.
        footer = _FOOTER.pack(Opcode.FOOTER, 20, summary_start, offsets_start, 0)[:-4]
        crc = zlib.crc32(footer, zlib.crc32(offsets, crc))
        self._write(footer + struct.pack("<I", crc) + MAGIC)
        self._stream.flush()

    def _pack_statistics(self) -> bytes:
        """Encodes the MCAP record with the statistics of the file.

        It contains the number of records of each kind, and the first and last arrival times.
        """
        first_ns, last_ns = self._span_ns or (0, 0)
        head = _STATISTICS.pack(
            self.messages,
            self._summary_counts[Opcode.SCHEMA],
            len(self._counts),
            self._summary_counts[Opcode.ATTACHMENT_INDEX],
            self._summary_counts[Opcode.METADATA_INDEX],
            self._summary_counts[Opcode.CHUNK_INDEX],
            first_ns,
            last_ns,
        )
        counts = b""
        for channel, count in self._counts.items():
            if count:
                counts += struct.pack("<HQ", channel, count)
        return head + _pack_bytes(counts)
