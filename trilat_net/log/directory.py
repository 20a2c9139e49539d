"""What the end of an MCAP file says of the file, against what is there.

Law: an index is compared, never followed: where it names a place, a record was met there, or it is wrong.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from mcap.opcode import Opcode

from .framing import HEAD, Frame, Framing
from .packed import ChunkHead

Tell = Callable[[str, int, str], None]


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

    frame: Frame
    head: ChunkHead
    indexes: dict[int, int] = field(default_factory=dict)
    indexes_end: int = 0
    readable: bool = True


class Directory:
    """Collects what is in a file, and what its end says of it.

    Args:
        tell: takes what is wrong: which check, at which byte, what.
    """

    def __init__(self, tell: Tell) -> None:
        self._tell = tell
        self._chunks: dict[int, ChunkFacts] = {}
        self._named: dict[int, tuple[int, str, int]] = {}  # attachments and metadata: kind, name, length
        self._statistics: tuple[int, Any] | None = None
        self._chunk_indexes: list[tuple[int, Any]] = []
        self._others: list[tuple[Frame, Any]] = []
        self._groups: dict[int, tuple[int, int]] = {}  # per kind where its records at the end begin and end
        self._offsets: list[tuple[int, Any]] = []
        self._data_end: tuple[Frame, Any] | None = None
        self._footer: tuple[Frame, Any] | None = None
        self._first_offset = 0

    def chunk(self, frame: Frame, head: ChunkHead) -> ChunkFacts:
        """Takes in a chunk of the data."""
        self.data(frame)
        facts = self._chunks[frame.offset] = ChunkFacts(frame, head, {}, frame.end)
        return facts

    def skip(self, frame: Frame) -> None:
        """Takes in an index of the last chunk, which could not be read."""
        if self._chunks:
            facts = self._chunks[next(reversed(self._chunks))]
            facts.indexes_end, facts.readable = frame.end, False

    def data(self, frame: Frame) -> None:
        """Takes in that there is data."""
        if self._data_end is not None:
            self._tell("records", frame.offset, "there is data behind the end of the data")

    def take(self, frame: Frame, record: Any) -> None:
        """Takes in any other record."""
        opcode = frame.opcode
        if opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
            self.data(frame)
            self._named[frame.offset] = (opcode, record.name, HEAD + frame.length)
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
        framing: Framing,
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
                ("length", told.chunk_length, HEAD + frame.length),
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

    def _compare_crcs(self, framing: Framing) -> int:
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
