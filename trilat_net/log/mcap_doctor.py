"""Conformance check of every byte of an MCAP file with the format's specification, its index included.

Invariant: each problem is reported once, with its place; its consequences are not. An index is compared
with the records in the file, never followed. Any MCAP file is accepted.
"""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from .mcap_reader import Progress
from .mcap_records import (
    MAGIC,
    RECORD_HEAD_BYTES,
    ChunkHead,
    RecordFrame,
    RecordScanner,
    UnreadableRecord,
    parse_record,
    unpack_chunk,
)

ReportProblem = Callable[[str, int, str], None]


@dataclass(slots=True)
class ChunkFacts:
    """A chunk that was read.

    Attributes:
        frame: where it lies.
        head: what it says of itself.
        indexes: where the index of each channel in it lies.
        indexes_end: the first byte behind those.
        readable: whether its messages could be read; else nothing is known of the indexes.
    """

    frame: RecordFrame
    head: ChunkHead
    indexes: dict[int, int] = field(default_factory=dict)
    indexes_end: int = 0
    readable: bool = True


class SummaryCheck:
    """Collects what is in a file, and what its end says of it.

    Args:
        tell: takes what is wrong: which check, at which byte, what.
    """

    def __init__(self, tell: ReportProblem) -> None:
        self._tell = tell
        self._chunks: dict[int, ChunkFacts] = {}
        self._named: dict[int, tuple[int, str, int]] = {}  # attachments and metadata: kind, name, length
        self._statistics: tuple[int, Any] | None = None
        self._chunk_indexes: list[tuple[int, Any]] = []
        self._others: list[tuple[RecordFrame, Any]] = []
        self._groups: dict[int, tuple[int, int]] = {}  # per kind where its records at the end begin and end
        self._offsets: list[tuple[int, Any]] = []
        self._data_end: tuple[RecordFrame, Any] | None = None
        self._footer: tuple[RecordFrame, Any] | None = None
        self._first_offset = 0

    def chunk(self, frame: RecordFrame, head: ChunkHead) -> ChunkFacts:
        """Takes in a chunk of the data."""
        self.data(frame)
        facts = self._chunks[frame.offset] = ChunkFacts(frame, head, {}, frame.end)
        return facts

    def skip(self, frame: RecordFrame) -> None:
        """Takes in an index of the last chunk, which could not be read."""
        if self._chunks:
            facts = self._chunks[next(reversed(self._chunks))]
            facts.indexes_end, facts.readable = frame.end, False

    def data(self, frame: RecordFrame) -> None:
        """Takes in that there is data."""
        if self._data_end is not None:
            self._tell("records", frame.offset, "there is data behind the end of the data")

    def take(self, frame: RecordFrame, record: Any) -> None:
        """Takes in any other record."""
        opcode = frame.opcode
        if opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.data(frame)
            self._named[frame.offset] = (opcode, record.name, RECORD_HEAD_BYTES + frame.length)
        elif opcode == Opcode.DATA_END:
            self._data_end = (frame, record)
        elif opcode == Opcode.STATISTICS:
            self._statistics = (frame.offset, record)
        elif opcode == Opcode.CHUNK_INDEX:
            self._chunk_indexes.append((frame.offset, record))
        elif opcode in (Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
            self._others.append((frame, record))
        elif opcode == Opcode.SUMMARY_OFFSET:
            self._first_offset = self._first_offset or frame.offset
            self._offsets.append((frame.offset, record))
        elif opcode == Opcode.FOOTER:
            self._footer = (frame, record)
        if self._data_end is not None and opcode not in (
            Opcode.DATA_END,
            Opcode.SUMMARY_OFFSET,
            Opcode.FOOTER,
        ):
            begin, _ = self._groups.get(opcode, (frame.offset, 0))
            self._groups[opcode] = (begin, frame.end)

    def compare(
        self,
        framing: RecordScanner,
        messages: Mapping[int, int] | None,
        schemas: Mapping[int, Any],
        channels: Mapping[int, Any],
    ) -> int:
        """Compares, once all was read; returns how many checksums were compared.

        Args:
            framing: the file.
            messages: how many there are of each channel; None where some could not be read.
            schemas: those that there are.
            channels: those that there are.
        """
        if messages is not None:
            self._compare_statistics(messages, len(schemas), len(channels))
        self._compare_chunks()
        self._compare_others()
        self._compare_offsets()
        return self._compare_crcs(framing)

    def _compare_statistics(self, messages: Mapping[int, int], schemas: int, channels: int) -> None:
        if self._statistics is None:
            return
        offset, told = self._statistics
        kinds = Counter(kind for kind, _, _ in self._named.values())
        pairs = [
            ("messages", told.message_count, sum(messages.values())),
            ("schemas", told.schema_count, schemas),
            ("channels", told.channel_count, channels),
            ("chunks", told.chunk_count, len(self._chunks)),
            ("attachments", told.attachment_count, kinds[Opcode.ATTACHMENT]),
            ("metadata", told.metadata_count, kinds[Opcode.METADATA]),
        ]
        for what, said, there in pairs:
            if said != there:
                self._tell("index", offset, f"the statistics say {said} {what}, there are {there}")
        counts = {n: count for n, count in told.channel_message_counts.items() if count}
        if counts != {n: count for n, count in messages.items() if count} and pairs[0][1] == pairs[0][2]:
            self._tell("index", offset, "the statistics count the messages of some channel wrong")
        heads = [facts.head for facts in self._chunks.values() if facts.head.end_ns]
        span = (min((h.start_ns for h in heads), default=0), max((h.end_ns for h in heads), default=0))
        if heads and (told.message_start_time, told.message_end_time) != span:
            self._tell("index", offset, "the statistics say another span of time than the chunks")

    def _compare_chunks(self) -> None:
        for offset, told in self._chunk_indexes:
            facts = self._chunks.get(told.chunk_start_offset)
            if facts is None:
                self._tell(
                    "index", offset, f"a chunk is said to begin at byte {told.chunk_start_offset}; none does"
                )
                continue
            frame, head = facts.frame, facts.head
            packed = frame.length - head.data_offset
            pairs = [
                ("length", told.chunk_length, RECORD_HEAD_BYTES + frame.length),
                ("first log time", told.message_start_time, head.start_ns),
                ("last log time", told.message_end_time, head.end_ns),
                ("compression", told.compression, head.compression),
                ("packed size", told.compressed_size, packed),
                ("unpacked size", told.uncompressed_size, head.size),
                ("places of its index", told.message_index_offsets, facts.indexes),
                ("length of its index", told.message_index_length, facts.indexes_end - frame.end),
            ]
            for what, said, there in pairs if facts.readable else pairs[:6]:
                if said != there:
                    self._tell(
                        "index", offset, f"the {what} of the chunk at byte {frame.offset} is told wrong"
                    )
        told_of = Counter(told.chunk_start_offset for _, told in self._chunk_indexes)
        for place in self._chunks:
            if told_of and told_of[place] != 1:
                times = "not" if not told_of[place] else f"{told_of[place]} times"
                self._tell("index", place, f"a chunk is {times} in the index")

    def _compare_others(self) -> None:
        for frame, told in self._others:
            kind = Opcode.ATTACHMENT if frame.opcode == Opcode.ATTACHMENT_INDEX else Opcode.METADATA
            if self._named.get(told.offset) != (kind, told.name, told.length):
                name = kind.name.lower()
                self._tell("index", frame.offset, f"the index names {name} that is not at byte {told.offset}")

    def _compare_offsets(self) -> None:
        for offset, told in self._offsets:
            begin, end = self._groups.get(told.group_opcode, (told.group_start, told.group_start))
            if (told.group_start, told.group_length) != (begin, end - begin):
                self._tell("index", offset, "the index of the index names a group where it is not")
        if self._footer is None:
            return
        frame, footer = self._footer
        begin = min((begin for begin, _ in self._groups.values()), default=0)
        if footer.summary_start != begin:
            self._tell(
                "index",
                frame.offset,
                f"the index is said to begin at byte {footer.summary_start}, not {begin}",
            )
        if footer.summary_offset_start not in (0, self._first_offset):
            self._tell("index", frame.offset, "the index of the index is said to be where it is not")

    def _compare_crcs(self, framing: RecordScanner) -> int:
        compared = 0
        if self._data_end is not None and (crc := self._data_end[1].data_section_crc):
            compared += 1
            if framing.crc(0, self._data_end[0].offset) != crc:
                self._tell("crc", self._data_end[0].offset, "the CRC of the data differs")
        if self._data_end is None:
            self._tell("records", framing.size, "there is no end of the data")
        elif self._footer is not None and (crc := self._footer[1].summary_crc):
            compared += 1
            frame, footer = self._footer
            begin = footer.summary_start or frame.offset
            if framing.crc(begin, frame.end - 4) != crc:
                self._tell("crc", frame.offset, "the CRC of the index differs")
        return compared


_MESSAGE = struct.Struct("<HIQQ")
_INDEX = struct.Struct("<HI")
MAX_PROBLEMS = 1000
"""Problems that are kept; more are counted."""


class FormatProblem(NamedTuple):
    """Something wrong in a file.

    Attributes:
        check: what it is a matter of: "whole", "crc", "records", "index".
        offset: at which byte.
        text: what is wrong.
    """

    check: str
    offset: int
    text: str


class RawMessage(NamedTuple):
    """A message as the file has it.

    Attributes:
        channel: number of its channel.
        sequence: its number, modulo 2^32.
        log_ns: when it came, Unix ns.
        publish_ns: when it was sent, Unix ns.
        payload: its bytes.
        offset: where its chunk begins, or itself where it is in none.
    """

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    payload: bytes
    offset: int


class FormatCheck:
    """One pass over a file.

    Args:
        stream: the file, opened for reading.
        progress: told after every record how many bytes are read, and how many there are.

    Attributes:
        schemas: by number, as the `mcap` package has them.
        channels: by number, likewise.
        metadata: entries by name.
        attachments: data by name.
        chunks: how many.
        messages: how many, per channel.
        crcs: how many checksums were compared.
        problems: what is wrong; the first of it.
        wrong: how many things are wrong, by check.
    """

    def __init__(self, stream: BinaryIO, progress: Progress | None = None) -> None:
        self.schemas: dict[int, Any] = {}
        self.channels: dict[int, Any] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.chunks = self.crcs = 0
        self.messages: Counter[int] = Counter()
        self.problems: list[FormatProblem] = []
        self.wrong: Counter[str] = Counter()
        self._framing = RecordScanner(stream)
        self._directory = SummaryCheck(self._tell)
        self._progress = progress
        self._chunk: ChunkFacts | None = None
        self._entries: dict[int, NDArray[np.uint64]] = {}
        self._hidden = False  # whether something that cannot be read may have named a channel

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._framing.size

    @property
    def finished(self) -> bool:
        """True once all was read, to the end of a file that was finished."""
        return self._framing.finished

    def _tell(self, check: str, offset: int, text: str) -> None:
        self.wrong[check] += 1
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(FormatProblem(check, offset, text))

    def read(self) -> Iterator[RawMessage]:
        """Looks at everything, and yields every message that can be read, in the order of the file."""
        framing = self._framing
        if not framing.begins:
            self._tell("whole", 0, "does not begin as an MCAP file does" if framing.size else "is empty")
            return
        before = 0
        frame = None
        for frame in framing.frames():
            if frame.offset == len(MAGIC) and frame.opcode != Opcode.HEADER:
                self._tell("records", frame.offset, "the first record is no header")
            try:
                yield from self._look(frame)
            except UnreadableRecord as error:
                text = str(error)
                self._tell("crc" if "CRC" in text else "records", frame.offset, text)
                self._chunk = None
                self._hidden = True
            for damage in framing.damaged[before:]:
                self._tell("whole", damage.offset, str(damage))
                self._hidden = True
            before = len(framing.damaged)
            if self._progress is not None:
                self._progress(frame.end, framing.size)
        self._end(frame, before)

    def _end(self, last: RecordFrame | None, before: int) -> None:
        framing = self._framing
        for damage in framing.damaged[before:]:
            self._tell("whole", damage.offset, str(damage))
        if framing.torn is not None:
            self._tell("whole", framing.torn.offset, f"is cut off: {framing.torn.problem}")
        elif last is not None and last.opcode == Opcode.FOOTER and last.end + len(MAGIC) != framing.size:
            more = framing.size - last.end - len(MAGIC)
            self._tell("whole", last.end + len(MAGIC), f"{more} bytes follow the end mark")
        if framing.finished and not framing.damaged:
            counted = None if self.wrong["crc"] or self.wrong["records"] else self.messages
            self.crcs += self._directory.compare(framing, counted, self.schemas, self.channels)

    def _look(self, frame: RecordFrame) -> Iterator[RawMessage]:
        content = self._framing.content(frame)
        opcode = frame.opcode
        if opcode == Opcode.CHUNK:
            yield from self._in_chunk(frame, content)
            return
        if opcode == Opcode.MESSAGE_INDEX:
            self._message_index(frame, content)
            return
        self._chunk = None
        if opcode == Opcode.MESSAGE:
            self._directory.data(frame)
            yield self._message(content, 0, len(content), frame.offset)
        elif opcode in _KNOWN:
            if opcode == Opcode.ATTACHMENT:
                self._check_attachment(content)
            record = parse_record(opcode, content)
            self._directory.take(frame, record)
            self._keep(opcode, record, frame.offset)
        elif opcode < 0x80:
            self._tell("records", frame.offset, f"a record of kind {opcode} is none of the format")

    def _keep(self, opcode: int, record: Any, offset: int) -> None:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self._define(opcode, record, offset)
        elif opcode == Opcode.METADATA:
            self.metadata.setdefault(record.name, record.metadata)
        elif opcode == Opcode.ATTACHMENT:
            self.attachments.setdefault(record.name, record.data)

    def _define(self, opcode: int, record: Any, offset: int) -> None:
        """Takes in a schema or a channel; one that came before must be the same."""
        known, what = (self.schemas, "schema") if opcode == Opcode.SCHEMA else (self.channels, "channel")
        if known.setdefault(record.id, record) != record:
            self._tell("records", offset, f"{what} {record.id} is not what it was before")
        if opcode == Opcode.SCHEMA and not record.id:
            self._tell("records", offset, "a schema has the number 0, which means none")
        unknown = opcode == Opcode.CHANNEL and record.schema_id and record.schema_id not in self.schemas
        if unknown and not self._hidden:
            self._tell(
                "records",
                offset,
                f"channel {record.id} names schema {record.schema_id}, which comes nowhere before",
            )

    def _check_attachment(self, content: bytes) -> None:
        crc = int.from_bytes(content[-4:], "little")
        self.crcs += bool(crc)
        if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
            raise UnreadableRecord("an attachment's CRC differs")

    def _message(self, data: bytes, start: int, end: int, offset: int) -> RawMessage:
        if end - start < _MESSAGE.size:
            raise UnreadableRecord("a message is shorter than its head")
        channel, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, start)
        if channel not in self.channels and not self.messages[channel] and not self._hidden:
            self._tell("records", offset, f"messages of channel {channel}, which comes nowhere before")
        self.messages[channel] += 1
        return RawMessage(channel, sequence, log_ns, publish_ns, data[start + _MESSAGE.size : end], offset)

    def _in_chunk(self, frame: RecordFrame, content: bytes) -> Iterator[RawMessage]:
        head = self._framing.head(frame)
        self.chunks += 1
        chunk = self._directory.chunk(frame, head)
        data = unpack_chunk(content)
        self.crcs += bool(head.crc)
        places: dict[int, array[int]] = {}
        for opcode, start, end in _inner(data):
            if opcode == Opcode.MESSAGE:
                message = self._message(data, start, end, frame.offset)
                entries = places.get(message.channel)
                if entries is None:
                    entries = places[message.channel] = array("Q")
                entries.append(message.log_ns)
                entries.append(start - RECORD_HEAD_BYTES)
                yield message
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._define(opcode, parse_record(opcode, data[start:end]), frame.offset)
            else:
                self._tell("records", frame.offset, f"a chunk holds a record of kind {opcode}")
        self._entries = {
            channel: np.frombuffer(entries, dtype=np.uint64).reshape(-1, 2)
            for channel, entries in places.items()
        }
        span = [int(ends) for a in self._entries.values() for ends in (a[:, 0].min(), a[:, 0].max())]
        first_ns, last_ns = min(span, default=0), max(span, default=0)
        if span and (head.start_ns, head.end_ns) != (first_ns, last_ns):
            told = f"{head.start_ns} to {head.end_ns}"
            self._tell("index", frame.offset, f"a chunk of log times {first_ns} to {last_ns} says {told} ns")
        self._chunk = chunk

    def _message_index(self, frame: RecordFrame, content: bytes) -> None:
        if self._chunk is None:
            self._directory.skip(frame)
            return  # of a chunk that could not be read
        try:
            channel, length = _INDEX.unpack_from(content)
        except struct.error:
            raise UnreadableRecord("a message index is cut off") from None
        self._chunk.indexes[channel] = frame.offset
        self._chunk.indexes_end = frame.end
        body = memoryview(content)[_INDEX.size :]
        if length != len(body) or length % 16:
            raise UnreadableRecord(f"a message index of {len(body)} bytes says that it has {length}")
        told = np.frombuffer(body, dtype="<u8").reshape(-1, 2)
        there = self._entries.get(channel, np.empty((0, 2), dtype=np.uint64))
        if len(told) != len(there) or (_sorted(told) != _sorted(there)).any():
            self._tell(
                "index", frame.offset, f"the index of channel {channel} in a chunk is not what is there"
            )


def _sorted(entries: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Returns entries of an index in the order of their places."""
    return entries[np.argsort(entries[:, 1], kind="stable")]


def _inner(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yields the records inside a chunk: opcode, where the content begins, where it ends."""
    offset, end = 0, len(data)
    head = struct.Struct("<BQ")
    while offset < end:
        if end - offset < RECORD_HEAD_BYTES:
            raise UnreadableRecord("a chunk ends within a record")
        opcode, length = head.unpack_from(data, offset)
        offset += RECORD_HEAD_BYTES
        if length > end - offset:
            raise UnreadableRecord("a record reaches beyond its chunk")
        yield opcode, offset, offset + length
        offset += length


_KNOWN = frozenset(Opcode) - {Opcode.CHUNK, Opcode.MESSAGE, Opcode.MESSAGE_INDEX}
