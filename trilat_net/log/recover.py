"""Recovery: makes a finished MCAP file of one that is cut off or damaged.

Invariant: what can be read is copied byte for byte: messages with their times and numbers, metadata,
attachments. What cannot be read is left out and reported, never invented. The source file is not
modified. Any MCAP file is accepted; for a trilat-net log the accounts are rebuilt. Of two definitions of
a number, the one covered by a valid checksum wins, else the first.
"""

import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from ..errors import LogError, NothingSaved, UsageError
from .accounting import NotATrilatLog, RebuiltAccounts
from .log_file import LogFile
from .log_layout import ACCOUNTS, ACTIVE_SUFFIX, collect_provenance, describe_unfinished
from .mcap_reader import Progress
from .mcap_records import (
    COMPRESSION_NAME_OFFSET,
    FOOTER_BYTES,
    MAGIC,
    MAX_UNPACKED_BYTES,
    MAX_UNPACKED_RATIO,
    RECORD_HEAD_BYTES,
    Damage,
    RecordFrame,
    RecordScanner,
    UnreadableRecord,
    parse_record,
    unpack_chunk,
)
from .mcap_writer import McapWriter

MAX_SALVAGE_BYTES = 64 << 20
"""No more of a cut chunk is looked at."""
_PIECE_BYTES = 1 << 16
_WINDOW_BYTES = 32 << 20
_LETTERS = struct.Struct("<I")
_RECORD = struct.Struct("<BQ")
_SIZE_BYTES = 8


def salvage_records(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields the records of a chunk that are complete: opcode and content.

    Args:
        content: what is left of the chunk's content.
    """
    limit = max(MAX_UNPACKED_BYTES, MAX_UNPACKED_RATIO * len(content))
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
    name_at = COMPRESSION_NAME_OFFSET + _LETTERS.size
    if len(content) < name_at:
        return
    (letters,) = _LETTERS.unpack_from(content, COMPRESSION_NAME_OFFSET)
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


MAX_SUMMARY_BYTES = 256 << 20
"""A longer end of a file is not checked: of an hour's log it has 7 MB."""
_FOOTER = struct.Struct("<QQI")
_CRC_BYTES = 4
_LOOKED_AT = (Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.STATISTICS)


def read_opcode(stream: BinaryIO, offset: int) -> int:
    """Returns the kind of the record that begins at an offset; 0 where there is none."""
    stream.seek(offset)
    return int.from_bytes(stream.read(1), "little")


class McapSurvey:
    """What is in a file besides messages, wherever it stands.

    Args:
        stream: the file.

    Attributes:
        profile: the MCAP profile.
        library: what made it.
        definitions: schemas and channels outside of chunks, opcode and content.
        metadata: the last of each name.
        attachments: the first of each name.
        count: how many messages the file says that it has; None where nothing vouches for it.
        why_empty: what is wrong where there is nothing to save; else "".
    """

    def __init__(self, stream: BinaryIO) -> None:
        self.profile = self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.count: int | None = None
        stream.seek(0)
        framing = RecordScanner(stream)
        summary_at = self._summary(framing, stream)
        self._said: int | None = None
        said: list[tuple[int, bytes]] = []
        vouched: list[tuple[int, bytes]] = []
        content = False
        for frame in framing.frames():
            content |= frame.opcode in (Opcode.CHUNK, Opcode.MESSAGE)
            if frame.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                entry = frame.opcode, framing.content(frame)
                (vouched if summary_at is not None and frame.offset >= summary_at else said).append(entry)
            elif frame.opcode in _LOOKED_AT:
                self._take(framing, frame)
        self.definitions = [
            entry
            for kind in (Opcode.SCHEMA, Opcode.CHANNEL)
            for entry in ([e for e in vouched if e[0] == kind] or [e for e in said if e[0] == kind])
        ]
        if summary_at is not None:
            self.count = self._said
        content |= framing.torn is not None and read_opcode(stream, framing.torn.offset) == Opcode.CHUNK
        self.why_empty = ""
        if not (content or self.metadata or self.attachments):
            self.why_empty = "it holds no messages"
            if not framing.begins:
                self.why_empty = "it does not begin as an MCAP file does" if framing.size else "it is empty"

    def _summary(self, framing: RecordScanner, stream: BinaryIO) -> int | None:
        """Returns where the end of a file begins that repeats what is in it, if its checksum is right."""
        if not framing.ends:
            return None
        stream.seek(-FOOTER_BYTES + RECORD_HEAD_BYTES, os.SEEK_END)
        begin, _, crc = _FOOTER.unpack(stream.read(_FOOTER.size))
        end = framing.size - FOOTER_BYTES
        if not crc or not 0 < begin <= end or end - begin > MAX_SUMMARY_BYTES:
            return None
        stream.seek(begin)
        content = stream.read(framing.size - begin - len(MAGIC) - _CRC_BYTES)
        return begin if zlib.crc32(content) == crc else None

    def _take(self, framing: RecordScanner, frame: RecordFrame) -> None:
        try:
            entry = parse_record(frame.opcode, framing.content(frame))
        except UnreadableRecord:
            return
        if frame.opcode == Opcode.HEADER:
            self.profile, self.library = entry.profile, entry.library
        elif frame.opcode == Opcode.METADATA:
            self.metadata[entry.name] = entry.metadata
        elif frame.opcode == Opcode.STATISTICS:
            self._said = entry.message_count
        else:
            self.attachments.setdefault(entry.name, entry.data)


_MESSAGE = struct.Struct("<HIQQ")
_OP_MESSAGE = int(Opcode.MESSAGE)
_MOST = 65_535
"""Channels, and schemas, that a file can have."""


def iterate_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields the records in an unpacked chunk: opcode and content.

    Raises:
        Unreadable: one reaches beyond the chunk.
    """
    offset, end = 0, len(data)
    while offset < end:
        if end - offset < RECORD_HEAD_BYTES:
            raise UnreadableRecord("a record in a chunk is cut off")
        opcode, length = _RECORD.unpack_from(data, offset)
        begin = offset + RECORD_HEAD_BYTES
        offset = begin + length
        if offset > end:
            raise UnreadableRecord("a record reaches beyond its chunk")
        yield opcode, data[begin:offset]


class MessageCopier:
    """The way of messages into a file.

    Args:
        file: where they go.
        opened: told the topic of every channel that the file gets.
        took: told topic, sequence and payload of every message.

    Attributes:
        lost: messages whose channel nobody named, or that make no sense, by the number of their channel.
        bare: topics of channels whose schema nobody named.
        contradicted: numbers of channels and schemas that the file tells in two ways; the first one holds.
    """

    def __init__(
        self, file: McapWriter, opened: Callable[[str], None], took: Callable[[str, int, bytes], None]
    ) -> None:
        self.lost: Counter[int] = Counter()
        self.bare: list[str] = []
        self.contradicted: set[int] = set()
        self._file, self._opened, self._took = file, opened, took
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._new_schemas: dict[int, int] = {}
        self._new_channels: dict[int, tuple[int, str]] = {}

    def define(self, opcode: int, content: bytes) -> None:
        """Takes a schema or a channel; what a number meant first, it means.

        Raises:
            Unreadable: it is none.
        """
        entry = parse_record(opcode, content)
        known = self._schemas if opcode == Opcode.SCHEMA else self._channels
        if known.setdefault(entry.id, entry) != entry:
            self.contradicted.add(entry.id)

    def open_all(self) -> None:
        """Gives the file every channel that is known by now, whether it has messages or not."""
        for number in sorted(self._channels):
            self._channel(number)

    def take(self, opcode: int, content: bytes) -> None:
        """Takes a record of a chunk, or a message that is in none.

        Raises:
            Unreadable: it makes no sense.
        """
        if opcode == _OP_MESSAGE:
            self._message(content)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.define(opcode, content)

    def _message(self, content: bytes) -> None:
        if len(content) < _MESSAGE.size:
            raise UnreadableRecord("a message is too short")
        number, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
        new = self._new_channels.get(number) or self._channel(number)
        if new is None:
            self.lost[number] += 1
            return
        payload = content[_MESSAGE.size :]
        self._file.add_message(new[0], log_ns, payload, publish_ns, sequence)
        self._took(new[1], sequence, payload)

    def _channel(self, number: int) -> tuple[int, str] | None:
        """Returns what a channel is called in the new file, and its topic; None where nobody named it."""
        known = self._channels.get(number)
        if known is None or len(self._new_channels) >= _MOST:
            return None
        schema = self._schema(known.schema_id)
        if known.schema_id and not schema:
            self.bare.append(known.topic)
        new = self._file.register_channel(known.topic, known.message_encoding, schema, known.metadata)
        self._new_channels[number] = new, known.topic
        self._opened(known.topic)
        return new, known.topic

    def _schema(self, number: int) -> int:
        known = self._schemas.get(number)
        if known is not None and number not in self._new_schemas:
            self._new_schemas[number] = self._file.register_schema(known.name, known.encoding, known.data)
        return self._new_schemas.get(number, 0)


RECOVERED_METADATA = "trilat.recovered"
"""Metadata that says what a file was made from, and what was lost."""
MAX_LISTED_LOSSES = 20
"""Losses that are told one by one."""
_MADE_AGAIN = frozenset(
    {Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.STATISTICS}
    | {Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.DATA_END, Opcode.FOOTER}
)
"""What a whole file has besides its content: nothing is lost with it."""
_CRC = struct.Struct("<I")
_INDEX = struct.Struct("<HI")


@dataclass
class Recovery:
    """What came of it.

    Attributes:
        path: the file that it comes from.
        output: the file that was made.
        finished: whether the file had been finished.
        messages: how many it has.
        sites: per site how many records; empty where it is no log of ours.
        duration_s: from the first message to the last, by the times at which they were logged, s.
        chunks: how many chunks were whole.
        salvaged: messages out of a last chunk that was cut off.
        lost: what was lost, a sentence each.
        lost_bytes: how many bytes could not be read.
        missing: per site which records are not in the file, be they lost here or never recorded.
    """

    path: Path
    output: Path
    finished: bool = False
    messages: int = 0
    sites: dict[str, int] = field(default_factory=dict)
    duration_s: float = 0.0
    chunks: int = 0
    salvaged: int = 0
    lost: list[str] = field(default_factory=list)
    lost_bytes: int = 0
    missing: list[str] = field(default_factory=list)

    @property
    def lossless(self) -> bool:
        """Whether all that was in the file is in the new one."""
        return not self.lost

    def facts(self) -> dict[str, str]:
        """Returns what the new file says of it."""
        told = self.lost[:MAX_LISTED_LOSSES]
        more = [f"and {len(self.lost) - len(told)} more"] if len(self.lost) > len(told) else []
        return {
            "from": self.path.name,
            "finished": str(self.finished).lower(),
            "lost": "; ".join(told + more) or "nothing",
            "lost_bytes": str(self.lost_bytes),
            "salvaged_messages": str(self.salvaged),
            "missing": "; ".join(self.missing) or "nothing",
        }


def recovered_path(path: Path) -> Path:
    """Returns the name of the file that is made of another one by default."""
    if path.name.endswith(ACTIVE_SUFFIX) and path.name != ACTIVE_SUFFIX:
        return path.with_name(path.name.removesuffix(ACTIVE_SUFFIX))
    return path.with_name(f"{path.stem}.recovered{path.suffix or '.mcap'}")


def recover_log(
    path: Path, output: Path | None = None, *, force: bool = False, progress: Progress | None = None
) -> Recovery:
    """Makes a whole file of one that is torn or damaged.

    Args:
        path: the file.
        output: the file to be made; by default `recovered_path`.
        force: whether it may replace one.
        progress: told how many bytes are read, and how many there are.

    Raises:
        LogError: the file cannot be read.
        NothingSaved: there is nothing in it that could be kept.
        UsageError: the output exists, or cannot be made.
        LogRefused: the disk refused; nothing was made.
    """
    made = output or recovered_path(path)
    if made.exists() and path.exists() and made.samefile(path):
        raise UsageError(f"{made}: is the file itself, which is not touched; choose another name with -o")
    try:
        with path.open("rb") as stream:
            return _recover(stream, Recovery(path, made), force, progress)
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}{describe_unfinished(path)}") from None


def _recover(stream: BinaryIO, result: Recovery, force: bool, progress: Progress | None) -> Recovery:
    survey = McapSurvey(stream)
    if survey.why_empty:
        raise NothingSaved(f"{result.path}: there is nothing in it that could be saved: {survey.why_empty}")
    working = result.output.with_name(result.output.name + ".recovering")
    working.unlink(missing_ok=True)
    file = LogFile(result.output, force=force, working=working)
    try:
        _Passage(stream, file, survey, result).run(progress)
        file.close()
    except BaseException:
        file.discard()
        if file.trouble is not None:
            raise file.refused(file.trouble) from None
        raise
    return result


class _Passage:
    """The way of one file into another."""

    def __init__(self, stream: BinaryIO, file: LogFile, survey: McapSurvey, result: Recovery) -> None:
        self._stream, self._result, self._survey = stream, result, survey
        stream.seek(0)
        self._framing = RecordScanner(stream)
        by = f"recovered by trilat-net {collect_provenance()['version_trilat-net']}"
        self._out = McapWriter(file, f"{survey.library or 'unknown'}, {by}", survey.profile)
        try:
            self._books: RebuiltAccounts | None = RebuiltAccounts(survey.metadata, survey.attachments)
        except NotATrilatLog:
            self._books = None
        self._copying = MessageCopier(self._out, self._opened, self._took)
        self._data_end = self._framing.size + 1
        for opcode, content in survey.definitions:
            try:
                self._copying.define(opcode, content)
            except UnreadableRecord as error:
                self._lose(f"a definition: {error}", len(content))

    def _opened(self, topic: str) -> None:
        if self._books is not None:
            self._books.open(topic)

    def _took(self, topic: str, sequence: int, payload: bytes) -> None:
        if self._books is not None:
            self._books.take(topic, sequence, payload)

    def _lose(self, what: str, size: int) -> None:
        self._result.lost.append(what)
        self._result.lost_bytes += size

    def run(self, progress: Progress | None) -> None:
        """Copies all that can be read, and writes what is to be said of it."""
        framing = self._framing
        self._copying.open_all()
        told = 0
        for frame in framing.frames():
            told = self._tell_damaged(told)
            try:
                self._take(frame)
            except UnreadableRecord as error:
                self._lose(
                    f"{RECORD_HEAD_BYTES + frame.length} bytes at byte {frame.offset}: {error}",
                    RECORD_HEAD_BYTES + frame.length,
                )
            if progress is not None:
                progress(frame.end, framing.size)
        self._tell_damaged(told)
        if framing.torn is not None:
            self._end(framing.torn)
        self._conclude()

    def _tell_damaged(self, told: int) -> int:
        for damage in self._framing.damaged[told:]:
            if damage.offset <= self._data_end:
                self._lose(f"{damage}", damage.length)
        return len(self._framing.damaged)

    def _take(self, frame: RecordFrame) -> None:
        """Copies one record of the file."""
        opcode = frame.opcode
        if opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL):
            return
        content = self._framing.content(frame)
        if opcode in _MADE_AGAIN:
            self._pass_over(frame, content)
            return
        if opcode == Opcode.CHUNK:
            for entry in iterate_records(unpack_chunk(content)):
                self._copying.take(*entry)
            self._result.chunks += 1
        elif opcode == Opcode.MESSAGE:
            self._copying.take(opcode, content)
        elif opcode == Opcode.METADATA:
            self._take_metadata(parse_record(opcode, content))
        elif opcode == Opcode.ATTACHMENT:
            self._take_attachment(parse_record(opcode, content), content)
        else:
            raise UnreadableRecord(f"nobody here knows a record of kind {opcode}")

    def _pass_over(self, frame: RecordFrame, content: bytes) -> None:
        """Leaves out what is made again, if it is that and not something else whose kind was damaged."""
        if frame.opcode == Opcode.DATA_END and len(content) == _CRC.size:
            self._data_end = frame.offset
        elif frame.opcode == Opcode.MESSAGE_INDEX:
            size = _INDEX.unpack_from(content)[1] if len(content) >= _INDEX.size else -1
            if size != len(content) - _INDEX.size or size % 16:
                raise UnreadableRecord("a record (message index) is none")
        elif frame.offset < self._data_end:
            raise UnreadableRecord(f"a record of kind {frame.opcode} stands among the data")

    def _take_metadata(self, entry: Any) -> None:
        if entry.name != RECOVERED_METADATA and (entry.name != ACCOUNTS or self._books is None):
            self._out.add_metadata(entry.name, entry.metadata)

    def _take_attachment(self, entry: Any, content: bytes) -> None:
        crc = _CRC.unpack(content[-_CRC.size :])[0]
        if crc and zlib.crc32(content[: -_CRC.size]) != crc:
            self._lose(f"attachment {entry.name}: its CRC differs; it is kept as it is", 0)
        self._out.add_attachment(entry.create_time, entry.log_time, entry.name, entry.media_type, entry.data)

    def _end(self, torn: Damage) -> None:
        """Sees to the end that was cut off."""
        opcode = read_opcode(self._stream, torn.offset)
        if not torn.length or opcode in _MADE_AGAIN or torn.offset > self._data_end:
            return
        if opcode != Opcode.CHUNK:
            self._lose(f"{torn}", torn.length)
            return
        self._stream.seek(torn.offset + RECORD_HEAD_BYTES)
        before = self._out.messages
        try:
            for entry in salvage_records(self._stream.read(MAX_SALVAGE_BYTES)):
                self._copying.take(*entry)
        except UnreadableRecord:
            pass  # what follows makes no sense, and is lost with the rest
        self._result.salvaged = self._out.messages - before
        self._lose(
            f"the end of a chunk that was cut off at byte {torn.offset}; of its {torn.length} bytes "
            f"{self._result.salvaged} messages could be saved",
            torn.length,
        )

    def _conclude(self) -> None:
        """Writes the accounts, what was lost, and the index."""
        result, copying = self._result, self._copying
        self._out.flush()
        for number, count in copying.lost.items():
            self._lose(f"{count} messages of channel {number}, which nobody names", 0)
        for topic in copying.bare:
            self._lose(f"the schema of {topic}", 0)
        for number in copying.contradicted:
            self._lose(f"what channel or schema {number} is: the file says it in two ways", 0)
        expected = self._survey.count
        if expected is not None and self._out.messages < expected and result.lossless:
            self._lose(f"{expected - self._out.messages} of the {expected} messages that it says it has", 0)
        result.finished = self._framing.finished
        result.messages = self._out.messages
        result.duration_s = self._out.duration_s
        if self._books is not None:
            result.missing = list(self._books.missing())
            result.sites = self._books.records()
            before = self._survey.metadata.get(ACCOUNTS, {})
            counts = {name: text for name, text in before.items() if not name.startswith("/")}
            self._out.add_metadata(ACCOUNTS, {**self._books.texts(), **counts})
        self._out.add_metadata(RECOVERED_METADATA, result.facts())
        self._out.finish()
