"""Checks the bytes of an MCAP file: its checksums, its records and its index.

An MCAP file consists of records. Messages are packed into compressed chunks, each followed by
an index of its messages, and the index at the end of the file states where the chunks are. This
module recomputes all checksums, and rebuilds the index from the records to compare it with the
one in the file. To check that a file conforms to every rule of the format, use another program
(pymcap-cli doctor).

Invariant:
    - Each problem is reported once, with its offset. Problems that result from another problem
      are not reported.
    - An index is compared with the records in the file, but never used to find them.
    - Any MCAP file is accepted, not only logs of trilat-net.
"""

from array import array
from collections import Counter
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..errors import count_nouns
from . import mcap_records
from .findings import Findings

_INDEX_HEAD_BYTES = 6
"""Size of the fields before the entries of a message index (channel and length), in bytes."""


class FileCheck:
    """Checks the checksums, the records and the index of one MCAP file.

    The caller reads the file, passes each record to `check_record`, and finally calls `finish`.

    Args:
        file: Name of the file.
        scanner: Scanner that finds the records of the file.
        findings: Results of the checks. Problems are added under the names "whole" (damaged or
            missing parts), "checksums", "records" and "index".

    Attributes:
        counts: Number of bytes, chunks and messages in the file, and number of checksums that
            were compared ("crcs").
    """

    def __init__(
        self, file: str, scanner: mcap_records.RecordScanner, findings: Findings
    ) -> None:
        """Prepares the check of one MCAP file. No record has been checked yet."""
        self.counts = Counter(bytes=scanner.size)
        self._file = file
        self._scanner = scanner
        self._findings = findings
        self._end = 0
        # Schemas and channels, by opcode and number.
        self._defined: dict[tuple[int, int], Any] = {}
        # Entries that the index should contain, and entries that it contains, by the opcode of
        # the entry and the offset of the indexed record.
        self._expected_index: dict[tuple[int, int], Any] = {}
        self._stated_index: dict[tuple[int, int], Any] = {}
        # Statistics, end of the data and footer as (offset, record), by opcode.
        self._end_records: dict[int, Any] = {}
        self._undefined_channels: set[int] = set()
        # Offset of the message index of each channel, for the last chunk. The indexes follow
        # the chunk, and are added when they are read. The value is None after a chunk that
        # cannot be read.
        self._message_indexes: dict[int, int] | None = None
        # Log times and offsets of each channel's messages in the last chunk, alternately, as a
        # message index contains them. An offset is that of the record in the unpacked chunk.
        self._entries: dict[int, array[int]] = {}
        # An unreadable record may have defined a channel, so undefined channels are not
        # reported after it.
        self._has_unreadable = False

    def check_record(self, record: mcap_records.ScannedRecord) -> None:
        """Checks one record of the file, and stores the entry that the index must have for it.

        The index is at the end of the file, so the stored entries are compared with it when the
        whole file has been read. Problems are added to the findings.

        Args:
            record: The record.
        """
        frame = record.frame
        self._end = frame.end + len(mcap_records.MAGIC)
        if frame.offset == len(mcap_records.MAGIC) and frame.opcode != Opcode.HEADER:
            self._add("records", frame.offset, "the first record is not a header")
        try:
            self._check_content(record)
        except mcap_records.UnreadableRecord as error:
            check = "checksums" if "CRC" in str(error) else "records"
            self._add(check, frame.offset, str(error))
            self._has_unreadable = True

    def _add(self, check: str, offset: int, text: str) -> None:
        """Adds a problem at an offset of the file to the finding of a check."""
        self._findings[check].add(self._file, offset, text)

    def _check_content(self, record: mcap_records.ScannedRecord) -> None:
        """Checks one record of the MCAP file with the method for its kind.

        Raises:
            UnreadableRecord: The record cannot be decoded, or its checksum is wrong.
        """
        frame = record.frame
        content = record.content
        match frame.opcode:
            case Opcode.CHUNK:
                self._check_chunk(record)
            case Opcode.MESSAGE_INDEX:
                self._check_message_index(frame, content)
            case Opcode.MESSAGE:
                self._check_message(frame, content, 0, len(content))
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._define(frame, frame.opcode, content)
            case kind if kind in mcap_records.KINDS:
                self._check_other(frame, content, mcap_records.parse_record(kind, content))
            case kind if kind < 0x80:
                self._add("records", frame.offset, f"the format has no records of kind {kind}")

    def _check_other(
        self, frame: mcap_records.RecordFrame, content: bytes, record: Any
    ) -> None:
        """Stores metadata, attachments and index entries, which are compared at the end.

        Metadata and attachments must appear in the index at the end of the file. The entry that
        they must have there is stored in the expected entries. The index entries that are read
        later are stored in the stated entries. When the complete file has been read,
        `_compare_index` compares the two. An entry of a metadata record or an attachment is
        (size of the record, name). An entry of a chunk is (size of the record, first and last
        log time, offsets of the message indexes by channel), see `_check_chunk`. All other
        records are stored for `_compare_end`.

        Args:
            frame: Kind and position of the record.
            content: Content of the record.
            record: The decoded content.

        Raises:
            UnreadableRecord: The checksum of an attachment is wrong.
        """
        match frame.opcode:
            case Opcode.METADATA:
                indexed_as = Opcode.METADATA_INDEX, frame.offset
                self._expected_index[indexed_as] = frame.size, record.name
            case Opcode.ATTACHMENT:
                if not mcap_records.has_right_crc(content):
                    raise mcap_records.UnreadableRecord(
                        "the CRC of an attachment does not match its content"
                    )
                # The last 4 bytes are the checksum. A checksum of 0 means that there is none.
                has_crc = content[-4:] != bytes(4)
                self.counts["crcs"] += has_crc
                indexed_as = Opcode.ATTACHMENT_INDEX, frame.offset
                self._expected_index[indexed_as] = frame.size, record.name
            case Opcode.METADATA_INDEX | Opcode.ATTACHMENT_INDEX:
                self._stated_index[frame.opcode, record.offset] = record.length, record.name
            case Opcode.CHUNK_INDEX:
                chunk_entry = (
                    record.chunk_length,
                    record.message_start_time,
                    record.message_end_time,
                    record.message_index_offsets,
                )
                self._stated_index[frame.opcode, record.chunk_start_offset] = chunk_entry
            case _:
                self._end_records[frame.opcode] = frame.offset, record

    def _define(self, frame: mcap_records.RecordFrame, opcode: int, content: bytes) -> None:
        """Checks the definition of a schema or a channel.

        A definition may be repeated, but must not change. A channel must refer to a schema that
        was defined before, or to 0 for no schema.

        Args:
            frame: Position of the record that contains the definition, which may be a chunk.
            opcode: Kind of the definition.
            content: Content of the definition.
        """
        record = mcap_records.parse_record(opcode, content)
        name = "schema" if opcode == Opcode.SCHEMA else "channel"
        if self._defined.setdefault((opcode, record.id), record) != record:
            self._add(
                "records",
                frame.offset,
                f"{name} {record.id} is defined again with other values",
            )
        if opcode == Opcode.SCHEMA or not record.schema_id or self._has_unreadable:
            return  # an unreadable record may have defined the schema
        schema = record.schema_id
        if (Opcode.SCHEMA, schema) not in self._defined:
            text = f"channel {record.id} names schema {schema}, which no earlier record defines"
            self._add("records", frame.offset, text)

    def _check_message(
        self, frame: mcap_records.RecordFrame, data: bytes, begin: int, end: int
    ) -> tuple[int, int]:
        """Checks that a message belongs to a channel that was defined before.

        Each undefined channel is reported once.

        Args:
            frame: Position of the record that contains the message, which may be a chunk.
            data: Bytes that contain the message.
            begin: Offset of the message's first byte in `data`.
            end: Offset after the last byte of the message.

        Returns:
            The channel and the log time of the message.

        Raises:
            UnreadableRecord: The message is too short.
        """
        if end - begin < mcap_records.MESSAGE_HEAD.size:
            raise mcap_records.UnreadableRecord("a message is shorter than its header")
        channel, _, log_ns, _ = mcap_records.MESSAGE_HEAD.unpack_from(data, begin)
        is_defined = (Opcode.CHANNEL, channel) in self._defined
        if not is_defined and channel not in self._undefined_channels:
            self._undefined_channels.add(channel)
            if not self._has_unreadable:
                text = (
                    f"a message belongs to channel {channel}, which no earlier record defines"
                )
                self._add("records", frame.offset, text)
        self.counts["messages"] += 1
        return channel, log_ns

    def _check_chunk(self, record: mcap_records.ScannedRecord) -> None:
        """Checks the records of a chunk, and stores the entries that the index should contain.

        Two indexes refer to a chunk. One message index per channel follows the chunk, and is
        compared with the messages by `_check_message_index`. The entry for the chunk in the
        index of the file states its size and its times, and where these message indexes are.
        Since the message indexes are read only after this method, the expected entry contains a
        dictionary that `_check_message_index` fills.

        Args:
            record: The chunk.

        Raises:
            UnreadableRecord: The chunk cannot be decompressed, or contains an invalid record.
        """
        # If unpacking raises an exception, the message indexes of the chunk are not checked.
        self._message_indexes = None
        frame = record.frame
        head = record.head()
        self.counts["chunks"] += 1
        data = record.unpack()
        has_crc = bool(head.crc)  # 0 means that there is no checksum
        self.counts["crcs"] += has_crc
        self._entries.clear()
        for opcode, begin, end in mcap_records.iterate_records(data):
            if opcode == mcap_records.OP_MESSAGE:
                channel, log_ns = self._check_message(frame, data, begin, end)
                # `begin` is the offset of the content, behind the head of the record.
                record_offset = begin - mcap_records.RECORD_HEAD_BYTES
                entries = self._entries.setdefault(channel, array("Q"))
                entries.append(log_ns)
                entries.append(record_offset)
            elif opcode in mcap_records.DEFINITIONS:
                self._define(frame, opcode, data[begin:end])
            else:
                text = f"a chunk contains a record of kind {opcode}, which is not allowed there"
                self._add("records", frame.offset, text)

        self._message_indexes = {}
        expected_entry = frame.size, head.start_ns, head.end_ns, self._message_indexes
        self._expected_index[Opcode.CHUNK_INDEX, frame.offset] = expected_entry

    def _check_message_index(self, frame: mcap_records.RecordFrame, content: bytes) -> None:
        """Compares the index of one channel's messages with the messages of the last chunk.

        A chunk is followed by one index per channel, which states the time and the offset of
        each message in the chunk.

        Raises:
            UnreadableRecord: The length of the index is wrong.
        """
        if self._message_indexes is None:
            return  # the chunk could not be read
        channel = int.from_bytes(content[:2], "little")
        length = int.from_bytes(content[2:6], "little")
        body = content[_INDEX_HEAD_BYTES:]
        # An entry is a log time and an offset of 8 bytes each.
        if length != len(content) - _INDEX_HEAD_BYTES or length % 16:
            raise mcap_records.UnreadableRecord(
                f"a message index has {count_nouns(len(body), 'byte')} and states a length of "
                f"{length}; both must be the same multiple of 16"
            )
        self._message_indexes[channel] = frame.offset
        stated = _sort_by_offset(body)
        expected = _sort_by_offset(self._entries.get(channel, b""))
        if not np.array_equal(stated, expected):
            text = f"the index of channel {channel} in a chunk differs from its messages"
            self._add("index", frame.offset, text)

    def finish(self) -> None:
        """Reports the damaged parts of the file, and compares its end with the data.

        The end holds an index and statistics. They are compared only if the file was finished
        and has no damaged part, since otherwise they would differ from the data anyway.
        """
        scanner = self._scanner
        if not scanner.begins:
            problem = "does not begin with the mark of MCAP" if scanner.size else "is empty"
            self._add("whole", 0, problem)
            return

        for damage in scanner.damaged:
            self._add("whole", damage.offset, str(damage))
        if scanner.torn is not None:
            self._add("whole", scanner.torn.offset, f"is cut off: {scanner.torn.problem}")
        elif scanner.finished and 0 < self._end < scanner.size:
            rest = count_nouns(scanner.size - self._end, "byte follows", "bytes follow")
            self._add("whole", self._end, f"{rest} the end mark")
        if scanner.finished and not scanner.damaged:
            self._compare_end()

    def _compare_end(self) -> None:
        """Compares the end of the file, which summarises the data, with the data themselves.

        The end contains an index, the statistics (record counts), and checksums.
        """
        if not self._has_unreadable:
            self._compare_index()
            self._compare_statistics()
        if Opcode.DATA_END not in self._end_records:
            self._add("records", self._scanner.size, "the record that ends the data is missing")
            return

        offset, data_end = self._end_records[Opcode.DATA_END]
        stated_crc = data_end.data_section_crc  # 0 if there is no checksum
        self.counts["crcs"] += bool(stated_crc)
        if stated_crc and self._scanner.crc(0, offset) != stated_crc:
            self._add("checksums", offset, "the CRC of the data differs")

        footer = self._scanner.footer()
        if footer is not None and footer.summary_crc:
            self.counts["crcs"] += 1
            if not self._scanner.is_summary_intact(footer):
                offset, _ = self._end_records[Opcode.FOOTER]
                self._add("checksums", offset, "the CRC of the index differs")

    def _compare_index(self) -> None:
        """Compares the index at the end of the file with the records in the file.

        The index may leave out some kinds of records, but if it contains one record of a kind,
        it must contain all of them.
        """
        indexed_kinds = {opcode for opcode, _ in self._stated_index}
        for (opcode, offset), entry in sorted(self._expected_index.items()):
            if opcode not in indexed_kinds:
                continue
            if self._stated_index.pop((opcode, offset), None) != entry:
                name = _INDEXED_NAMES[opcode]
                text = (
                    f"the {name} record that begins here is missing in the index, or has other "
                    "values there"
                )
                self._add("index", offset, text)
        for opcode, offset in sorted(self._stated_index):
            text = f"the index lists a record ({_INDEXED_NAMES[opcode]}) that does not exist"
            self._add("index", offset, text)

    def _compare_statistics(self) -> None:
        """Compares the counts in the statistics record, if there is one, with the file."""
        if Opcode.STATISTICS not in self._end_records:
            return
        offset, statistics = self._end_records[Opcode.STATISTICS]
        kinds = Counter(opcode for opcode, _ in (*self._defined, *self._expected_index))
        counts = {
            "messages": (statistics.message_count, self.counts["messages"]),
            "schemas": (statistics.schema_count, kinds[Opcode.SCHEMA]),
            "channels": (statistics.channel_count, kinds[Opcode.CHANNEL]),
            "chunks": (statistics.chunk_count, self.counts["chunks"]),
            "attachments": (statistics.attachment_count, kinds[Opcode.ATTACHMENT_INDEX]),
            "metadata": (statistics.metadata_count, kinds[Opcode.METADATA_INDEX]),
        }
        for name, (stated, actual) in counts.items():
            if stated != actual:
                text = f"the statistics state {stated} {name}, but there are {actual}"
                self._add("index", offset, text)


def _sort_by_offset(entries: "bytes | array[int]") -> NDArray[np.uint64]:
    """Returns the pairs (log time, offset) of an MCAP message index, sorted by offset.

    Args:
        entries: Alternating log times and offsets.
    """
    pairs = np.frombuffer(entries, dtype="<u8").reshape(-1, 2)
    return pairs[np.argsort(pairs[:, 1], kind="stable")]


_INDEXED_NAMES: dict[int, str] = {
    Opcode.CHUNK_INDEX: "chunk",
    Opcode.ATTACHMENT_INDEX: "attachment",
    Opcode.METADATA_INDEX: "metadata",
}
