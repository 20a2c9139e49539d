"""Check of the bytes of an MCAP file: checksums, records, and an index that agrees with them.

Invariant: each problem is reported once, with its place; its consequences are not. An index is
compared with the records in the file, never followed. Any MCAP file is accepted. Conformance
with every rule of the format is left to other programs (`pymcap-cli doctor`).
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

_INDEX_HEAD_BYTES = 6  # of a message index: channel, length of its entries


class FileCheck:
    """Check of one file, record by record.

    Args:
        file: its name.
        scanner: finds its records.
        findings: receives the problems, as "whole", "checksums", "records" and "index".

    Attributes:
        counts: its bytes, chunks and messages, and the checksums that were compared.
    """

    def __init__(
        self, file: str, scanner: mcap_records.RecordScanner, findings: Findings
    ) -> None:
        self.counts = Counter(bytes=scanner.size)
        self._file = file
        self._scanner = scanner
        self._findings = findings
        self._end = 0
        self._defined: dict[tuple[int, int], Any] = {}  # by opcode and number
        self._found: dict[
            tuple[int, int], Any
        ] = {}  # what an index should name: by its opcode and place
        self._indexed: dict[tuple[int, int], Any] = {}  # what the index names
        self._ends: dict[
            int, Any
        ] = {}  # statistics, end of the data and footer, each with its offset
        self._unknown: set[int] = set()  # channels of messages that no record names
        self._indexes: dict[int, int] | None = (
            None  # of the last chunk: where the index of a channel is
        )
        self._entries: dict[
            int, array[int]
        ] = {}  # of the last chunk: log times and places, by channel
        self._unreadable = False  # something unreadable may have named a channel

    def check_record(
        self, frame: mcap_records.RecordFrame, content: bytes, data: bytes
    ) -> None:
        """Checks one record of the file; `data` is what a chunk holds, empty if it cannot be
        unpacked.
        """
        self._end = frame.end + len(mcap_records.MAGIC)
        if frame.offset == len(mcap_records.MAGIC) and frame.opcode != Opcode.HEADER:
            self._add("records", frame.offset, "the first record is no header")
        try:
            self._take_content(frame, content, data)
        except mcap_records.UnreadableRecord as error:
            check = "checksums" if "CRC" in str(error) else "records"
            self._add(check, frame.offset, str(error))
            self._unreadable = True

    def _add(self, check: str, offset: int, text: str) -> None:
        self._findings[check].add(self._file, offset, text)

    def _take_content(
        self, frame: mcap_records.RecordFrame, content: bytes, data: bytes
    ) -> None:
        match frame.opcode:
            case Opcode.CHUNK:
                self._take_chunk(frame, content, data)
            case Opcode.MESSAGE_INDEX:
                self._take_message_index(frame, content)
            case Opcode.MESSAGE:
                self._take_message(frame, content, 0, len(content))
            case Opcode.SCHEMA | Opcode.CHANNEL:
                self._define(frame, frame.opcode, content)
            case kind if kind in mcap_records.KINDS:
                self._take_other(frame, content, mcap_records.parse_record(kind, content))
            case kind if kind < 0x80:
                self._add(
                    "records", frame.offset, f"a record of kind {kind} is none of the format"
                )

    def _take_other(self, frame: mcap_records.RecordFrame, content: bytes, record: Any) -> None:
        """Takes metadata, an attachment, or a record of the end; those of the index by what
        they name.
        """
        match frame.opcode:
            case Opcode.METADATA:
                self._found[Opcode.METADATA_INDEX, frame.offset] = frame.size, record.name
            case Opcode.ATTACHMENT:
                if not mcap_records.has_right_crc(content):
                    raise mcap_records.UnreadableRecord("an attachment's CRC differs")
                self.counts["crcs"] += content[-4:] != bytes(4)
                self._found[Opcode.ATTACHMENT_INDEX, frame.offset] = frame.size, record.name
            case Opcode.METADATA_INDEX | Opcode.ATTACHMENT_INDEX:
                self._indexed[frame.opcode, record.offset] = record.length, record.name
            case Opcode.CHUNK_INDEX:
                times = record.message_start_time, record.message_end_time
                entry = record.chunk_length, *times, record.message_index_offsets
                self._indexed[frame.opcode, record.chunk_start_offset] = entry
            case _:
                self._ends[frame.opcode] = frame.offset, record

    def _define(self, frame: mcap_records.RecordFrame, opcode: int, content: bytes) -> None:
        """Takes a schema or a channel; one that came before must be the same."""
        record = mcap_records.parse_record(opcode, content)
        name = "schema" if opcode == Opcode.SCHEMA else "channel"
        if self._defined.setdefault((opcode, record.id), record) != record:
            self._add("records", frame.offset, f"{name} {record.id} is not what it was before")
        schema = record.schema_id if opcode == Opcode.CHANNEL else 0
        if schema and (Opcode.SCHEMA, schema) not in self._defined and not self._unreadable:
            text = f"channel {record.id} names schema {schema}, which comes nowhere before"
            self._add("records", frame.offset, text)

    def _take_message(
        self, frame: mcap_records.RecordFrame, data: bytes, begin: int, end: int
    ) -> tuple[int, int]:
        """Takes a message; returns its channel and its log time."""
        if end - begin < mcap_records.MESSAGE_HEAD.size:
            raise mcap_records.UnreadableRecord("a message is shorter than its head")
        channel, _, log_ns, _ = mcap_records.MESSAGE_HEAD.unpack_from(data, begin)
        if (Opcode.CHANNEL, channel) not in self._defined and channel not in self._unknown:
            self._unknown.add(channel)
            if not self._unreadable:
                text = f"messages of channel {channel}, which comes nowhere before"
                self._add("records", frame.offset, text)
        self.counts["messages"] += 1
        return channel, log_ns

    def _take_chunk(self, frame: mcap_records.RecordFrame, content: bytes, data: bytes) -> None:
        self._indexes = None
        head = self._scanner.head(frame)
        self.counts["chunks"] += 1
        data = data or mcap_records.unpack_chunk(content)
        self.counts["crcs"] += bool(head.crc)
        self._entries.clear()
        for opcode, begin, end in mcap_records.iterate_records(data):
            if opcode == mcap_records.OP_MESSAGE:
                channel, log_ns = self._take_message(frame, data, begin, end)
                entries = self._entries.setdefault(channel, array("Q"))
                entries.append(log_ns)
                entries.append(begin - mcap_records.RECORD_HEAD_BYTES)
            elif opcode in mcap_records.DEFINITIONS:
                self._define(frame, opcode, data[begin:end])
            else:
                self._add("records", frame.offset, f"a chunk holds a record of kind {opcode}")
        self._indexes = {}
        found = frame.size, head.start_ns, head.end_ns, self._indexes
        self._found[Opcode.CHUNK_INDEX, frame.offset] = found

    def _take_message_index(self, frame: mcap_records.RecordFrame, content: bytes) -> None:
        if self._indexes is None:
            return  # the chunk could not be read
        channel = int.from_bytes(content[:2], "little")
        length = int.from_bytes(content[2:6], "little")
        body = content[_INDEX_HEAD_BYTES:]
        if length != len(content) - _INDEX_HEAD_BYTES or length % 16:
            raise mcap_records.UnreadableRecord(
                f"a message index of {count_nouns(len(body), 'byte')} says that it has {length}"
            )
        self._indexes[channel] = frame.offset
        if not np.array_equal(
            _sort_by_place(body), _sort_by_place(self._entries.get(channel, b""))
        ):
            text = f"the index of channel {channel} in a chunk is not what is there"
            self._add("index", frame.offset, text)

    def finish(self) -> None:
        """Takes the damaged parts; compares the end of a finished file with its data, and
        checksums there.
        """
        scanner = self._scanner
        if not scanner.begins:
            self._add(
                "whole",
                0,
                "does not begin as an MCAP file does" if scanner.size else "is empty",
            )
            return
        for damage in scanner.damaged:
            self._add("whole", damage.offset, str(damage))
        if scanner.torn is not None:
            self._add("whole", scanner.torn.offset, f"is cut off: {scanner.torn.problem}")
        elif scanner.finished and 0 < self._end < scanner.size:
            self._add(
                "whole",
                self._end,
                f"{count_nouns(scanner.size - self._end, 'byte follows', 'bytes follow')} the end mark",
            )
        if scanner.finished and not scanner.damaged:
            self._compare_end()

    def _compare_end(self) -> None:
        if not self._unreadable:
            self._compare_index()
            self._compare_statistics()
        footer = self._scanner.footer()
        if Opcode.DATA_END not in self._ends:
            self._add("records", self._scanner.size, "there is no end of the data")
            return
        offset, data_end = self._ends[Opcode.DATA_END]
        self.counts["crcs"] += bool(data_end.data_section_crc)
        if (
            data_end.data_section_crc
            and self._scanner.crc(0, offset) != data_end.data_section_crc
        ):
            self._add("checksums", offset, "the CRC of the data differs")
        if footer is not None and footer.summary_crc:
            self.counts["crcs"] += 1
            if not self._scanner.is_summary_intact(footer):
                offset, _ = self._ends[Opcode.FOOTER]
                self._add("checksums", offset, "the CRC of the index differs")

    def _compare_index(self) -> None:
        kinds = {opcode for opcode, _ in self._indexed}
        for (opcode, offset), entry in sorted(self._found.items()):
            if opcode in kinds and self._indexed.pop((opcode, offset), None) != entry:
                text = f"the {_INDEXED_NAMES[opcode]} that begins here is not in the index as it is"
                self._add("index", offset, text)
        for opcode, offset in sorted(self._indexed):
            text = f"the index names {_INDEXED_NAMES[opcode]} that is not there"
            self._add("index", offset, text)

    def _compare_statistics(self) -> None:
        if Opcode.STATISTICS not in self._ends:
            return
        offset, statistics = self._ends[Opcode.STATISTICS]
        kinds = Counter(opcode for opcode, _ in (*self._defined, *self._found))
        counts = {
            "messages": (statistics.message_count, self.counts["messages"]),
            "schemas": (statistics.schema_count, kinds[Opcode.SCHEMA]),
            "channels": (statistics.channel_count, kinds[Opcode.CHANNEL]),
            "chunks": (statistics.chunk_count, self.counts["chunks"]),
            "attachments": (statistics.attachment_count, kinds[Opcode.ATTACHMENT_INDEX]),
            "metadata": (statistics.metadata_count, kinds[Opcode.METADATA_INDEX]),
        }
        for name, (stated, there) in counts.items():
            if stated != there:
                text = f"the statistics say {stated} {name}, there are {there}"
                self._add("index", offset, text)


def _sort_by_place(entries: "bytes | array[int]") -> NDArray[np.uint64]:
    pairs = np.frombuffer(entries, dtype="<u8").reshape(-1, 2)
    return pairs[np.argsort(pairs[:, 1], kind="stable")]


_INDEXED_NAMES: dict[int, str] = {
    Opcode.CHUNK_INDEX: "chunk",
    Opcode.ATTACHMENT_INDEX: "attachment",
    Opcode.METADATA_INDEX: "metadata",
}
