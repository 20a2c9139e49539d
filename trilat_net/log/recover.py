"""Recovery: makes a finished MCAP file of one that is cut off or damaged.

Invariant: what can be read is copied byte for byte: messages with their times and numbers, metadata,
attachments. What cannot be read is left out and reported, never invented. The source file is not
modified. Any MCAP file is accepted; for a trilat-net log the accounts are rebuilt. Of two definitions of
a number, the one covered by a valid checksum wins, else the first.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from ..errors import LogError, NothingSaved, UsageError
from ..files import describe_write_error, open_regular
from ..net import topics
from ..results import Result
from . import mcap_records
from .accounting import Coverage, open_session_accounts, parse_counts
from .log_file import LogFile
from .log_layout import ACCOUNTS, ACTIVE_SUFFIX, PART, SESSION, collect_provenance, describe_unfinished
from .mcap_reader import McapReader, Progress
from .mcap_records import UnreadableRecord
from .mcap_writer import McapWriter
from .running_digest import DIGESTS, RECOVERED, DigestState

MAX_LISTED_LOSSES = 20
"""Losses that are listed there one by one."""
MAX_SALVAGE_BYTES = 64 << 20
"""No more of a cut chunk is read."""
_PIECE_BYTES = 1 << 16
_MAX_NUMBERS = 65_535
"""Channels, and schemas, that a file can have."""
_MADE_AGAIN = frozenset(
    {Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.STATISTICS}
    | {Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.DATA_END, Opcode.FOOTER}
)
"""What a finished file has besides its content: nothing is lost with it."""


@dataclass(repr=False)
class Recovery(Result):
    """Result of a recovery.

    Attributes:
        path, output: the source file, and the file that was made.
        finished: True if the source had been finished.
        messages: number of messages.
        duration_s: from the first message to the last, by the times at which they were logged, s.
        salvaged: messages out of a last chunk that was cut off.
        lost, lost_bytes: what was lost, a sentence each, and how many bytes could not be read.
        missing: per site which records are not in the file, be they lost here or never recorded.
        coverage: the records in the file and the ticks of the run; of no site if it is no trilat-net log.
        chain: agreement of the source with its digest chain; "" if it is no trilat-net log.
    """

    path: Path
    output: Path
    finished: bool = False
    messages: int = 0
    duration_s: float = 0.0
    salvaged: int = 0
    lost: list[str] = field(default_factory=list)
    lost_bytes: int = 0
    missing: list[str] = field(default_factory=list)
    coverage: Coverage = field(default_factory=lambda: Coverage({}, {}))
    chain: DigestState | str = ""

    @property
    def lossless(self) -> bool:
        """True if all that was in the file is in the new one."""
        return not self.lost

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat log recover --json`."""
        return {
            "file": self.path.as_posix(),
            "output": self.output.as_posix(),
            "finished": self.finished,
            "lossless": self.lossless,
            "messages": self.messages,
            "records": self.coverage.judged,
            "duration_s": self.duration_s,
            "salvaged_messages": self.salvaged,
            "lost_bytes": self.lost_bytes,
            "lost": self.lost,
            "missing": self.missing,
            "coverage": {
                site: {"records": there, "ticks": ticks}
                for site, (there, ticks) in self.coverage.to_json().items()
            },
            "digest_chain": str(self.chain) or None,
        }

    def lose(self, what: str, size: int = 0) -> None:
        """Adds a loss of so many bytes."""
        self.lost.append(what)
        self.lost_bytes += size

    def facts(self) -> dict[str, str]:
        """Returns the metadata of the new file that describe the recovery."""
        listed = self.lost[:MAX_LISTED_LOSSES]
        more = [f"and {len(self.lost) - len(listed)} more"] if len(self.lost) > len(listed) else []
        return {
            "from": self.path.name,
            "finished": str(self.finished).lower(),
            "lost": "; ".join(listed + more) or "nothing",
            "lost_bytes": str(self.lost_bytes),
            "salvaged_messages": str(self.salvaged),
            "missing": "; ".join(self.missing) or "nothing",
            "coverage": str(self.coverage) if self.coverage.expected else "unknown",
            "chain": str(self.chain),
        }


def recovered_path(path: Path) -> Path:
    """Returns the default name of the file that is made of another one."""
    if path.name.endswith(ACTIVE_SUFFIX) and path.name != ACTIVE_SUFFIX:
        return path.with_name(path.name.removesuffix(ACTIVE_SUFFIX))
    return path.with_name(f"{path.stem}.recovered{path.suffix or '.mcap'}")


def recover(
    file: str | Path,
    out: str | Path | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> Recovery:
    """Makes a whole file of a torn or damaged one; the command is `trilat log recover`.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("torn.mcap")
    >>> tn.recover(path, "whole.mcap").lossless
    True

    Args:
        file: the torn one.
        out: the file to be made; by default `recovered_path`.
        force: True if it may replace one.
        progress: called after every record of the file.

    Raises:
        LogError: the file cannot be read.
        NothingSaved: nothing could be recovered.
        UsageError: the output exists, or cannot be made.
        LogRefused: the disk refused; nothing was made.
    """
    path = Path(file)
    if not path.name:
        raise LogError(f"{path}: cannot be read: Is a directory")
    made = recovered_path(path) if out is None else Path(out)
    if not made.name:
        raise UsageError(f"{made}: is a directory; name a file with -o")
    if made.exists() and path.exists() and made.samefile(path):
        raise UsageError(f"{made}: is the file itself, which is not touched; choose another name with -o")
    try:
        with open_regular(path) as stream:
            return _recover(stream, Recovery(path, made), force, progress)
    except OSError as error:
        if error.filename not in (None, str(path)):
            raise describe_write_error(Path(error.filename), error) from None
        raise LogError(f"{path}: cannot be read: {error.strerror}{describe_unfinished(path)}") from None


def _recover(stream: BinaryIO, result: Recovery, force: bool, progress: Progress | None) -> Recovery:
    reader = McapReader(stream, str(result.path), progress, kept=False)
    survey = _Survey(reader.scanner)
    if survey.why_empty:
        raise NothingSaved(f"{result.path}: there is nothing in it that could be saved: {survey.why_empty}")
    working = result.output.with_name(result.output.name + ".recovering")
    working.unlink(missing_ok=True)
    file = LogFile(result.output, force=force, working=working)
    try:
        _FileCopy(reader, file, survey, result).run()
        file.close()
    except BaseException:
        file.discard()
        if file.trouble is not None:
            raise file.refused(file.trouble) from None
        raise
    return result


class _Survey:
    """Contents of a file besides messages, wherever they are.

    Attributes:
        profile, library: the MCAP profile, and what made the file.
        definitions: schemas and channels outside of chunks, opcode and content.
        metadata: the last of each name.
        attachments: the first of each name.
        count: how many messages the file states; None if no checksum covers that.
        why_empty: the reason if there is nothing to save; else "".
    """

    def __init__(self, scanner: mcap_records.RecordScanner) -> None:
        self.profile = self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.count: int | None = None
        footer = scanner.footer()
        is_covered = footer is not None and footer.summary_crc and scanner.is_summary_intact(footer)
        summary_offset = (footer.summary_start if footer is not None and is_covered else 0) or scanner.size
        found: dict[tuple[bool, int], list[tuple[int, bytes]]] = defaultdict(list)  # in the summary or not
        content = False
        for frame in scanner.frames():
            content |= frame.opcode in (Opcode.CHUNK, Opcode.MESSAGE)
            if frame.opcode in mcap_records.DEFINITIONS:
                entry = frame.opcode, scanner.content(frame)
                found[frame.offset >= summary_offset, frame.opcode].append(entry)
            elif frame.opcode in (Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.STATISTICS):
                with suppress(UnreadableRecord):
                    self._take(frame.opcode, mcap_records.parse_record(frame.opcode, scanner.content(frame)))
        if summary_offset == scanner.size:
            self.count = None
        self.definitions = [
            entry for kind in mcap_records.DEFINITIONS for entry in found[True, kind] or found[False, kind]
        ]
        content |= scanner.torn is not None and scanner.read(scanner.torn.offset, 1) == bytes([Opcode.CHUNK])
        self.why_empty = ""
        if not (content or self.metadata or self.attachments):
            self.why_empty = "it holds no messages"
            if not scanner.begins:
                self.why_empty = "it does not begin as an MCAP file does" if scanner.size else "it is empty"

    def _take(self, opcode: int, record: Any) -> None:
        match opcode:
            case Opcode.HEADER:
                self.profile, self.library = record.profile, record.library
            case Opcode.METADATA:
                self.metadata[record.name] = record.metadata
            case Opcode.STATISTICS:
                self.count = record.message_count
            case _:
                self.attachments.setdefault(record.name, record.data)


class _FileCopy:
    """Copy of one file into another; of a number's definitions the first one holds."""

    def __init__(self, reader: McapReader, file: LogFile, survey: _Survey, result: Recovery) -> None:
        reader.watch = self._copy
        self._reader, self._scanner, self._survey, self._result = reader, reader.scanner, survey, result
        by = f"recovered by trilat-net {collect_provenance()['version_trilat-net']}"
        self._out = McapWriter(file, f"{survey.library or 'unknown'}, {by}", survey.profile)
        self._accounts = open_session_accounts(survey.metadata, survey.attachments)
        self._data_end = reader.size + 1
        self._reported = 0  # damaged parts that are among the losses
        self._defined: dict[tuple[int, int], Any] = {}  # schemas and channels, by opcode and number
        self._contradicted: set[int] = set()  # numbers that have two definitions
        self._new_schemas: dict[int, int] = {}
        self._new_channels: dict[int, tuple[int, str]] = {}  # number in the new file, and topic
        self._bare: list[str] = []  # topics of channels whose schema no record names
        self._unnamed: Counter[int] = Counter()  # messages of channels that no record names
        for opcode, content in survey.definitions:
            try:
                self._define(opcode, content)
            except UnreadableRecord as error:
                result.lose(f"a definition: {error}", len(content))
        for kind, number in sorted(self._defined):
            if kind == Opcode.CHANNEL:  # with or without messages
                self._open_channel(number)

    def run(self) -> None:
        deque(self._reader.messages(), maxlen=0)  # every record passes through `_copy`
        self._report_damaged()
        if self._scanner.torn is not None:
            self._take_torn(self._scanner.torn)
        self._out.flush()
        self._report_unnamed()
        self._finish()

    def _copy(self, frame: mcap_records.RecordFrame, content: bytes, data: bytes) -> None:
        self._report_damaged()
        try:
            self._take(frame, content, data)
        except UnreadableRecord as error:
            self._result.lose(f"{frame.size} bytes at byte {frame.offset}: {error}", frame.size)

    def _report_damaged(self) -> None:
        for damage in self._scanner.damaged[self._reported :]:
            if damage.offset <= self._data_end:
                self._result.lose(str(damage), damage.length)
        self._reported = len(self._scanner.damaged)

    def _take(self, frame: mcap_records.RecordFrame, content: bytes, data: bytes) -> None:
        """Copies one record of the file; `data` is what a chunk holds, empty if it cannot be unpacked."""
        opcode = frame.opcode
        if opcode == Opcode.HEADER or opcode in mcap_records.DEFINITIONS:
            return
        if opcode in _MADE_AGAIN:
            self._pass_over(frame, content)
        elif opcode == Opcode.CHUNK:
            data = data or mcap_records.unpack_chunk(content)
            for inner, begin, end in mcap_records.iterate_records(data):
                self._take_inner(inner, data[begin:end])
        elif opcode == mcap_records.OP_MESSAGE:
            self._take_inner(opcode, content)
        elif opcode == Opcode.METADATA:
            entry = mcap_records.parse_record(opcode, content)
            ours = self._accounts is not None
            if entry.name != RECOVERED and not (ours and entry.name in (ACCOUNTS, DIGESTS)):
                self._out.add_metadata(entry.name, entry.metadata)
        elif opcode == Opcode.ATTACHMENT:
            one = mcap_records.parse_record(opcode, content)
            if not mcap_records.has_right_crc(content):
                self._result.lose(f"attachment {one.name}: its CRC differs; it is kept as it is")
            self._out.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)
        else:
            raise UnreadableRecord(f"a record of kind {opcode} is unknown here")

    def _pass_over(self, frame: mcap_records.RecordFrame, content: bytes) -> None:
        """Leaves out what is made again; raises if it is something else whose kind was damaged."""
        if frame.opcode == Opcode.DATA_END and len(content) == 4:
            self._data_end = frame.offset
        elif frame.opcode == Opcode.MESSAGE_INDEX:
            size = int.from_bytes(content[2:6], "little")
            if size != len(content) - 6 or size % 16:
                raise UnreadableRecord("a record (message index) is none")
        elif frame.offset < self._data_end:
            raise UnreadableRecord(f"a record of kind {frame.opcode} stands among the data")

    def _take_inner(self, opcode: int, content: bytes) -> None:
        if opcode in mcap_records.DEFINITIONS:
            self._define(opcode, content)
        elif opcode == mcap_records.OP_MESSAGE:
            if len(content) < mcap_records.MESSAGE_HEAD.size:
                raise UnreadableRecord("a message is too short")
            number, sequence, log_ns, publish_ns = mcap_records.MESSAGE_HEAD.unpack_from(content)
            new = self._new_channels.get(number) or self._open_channel(number)
            if new is None:
                self._unnamed[number] += 1
                return
            payload = content[mcap_records.MESSAGE_HEAD.size :]
            self._out.add_message(new[0], log_ns, payload, publish_ns, sequence)
            if self._accounts is not None:
                self._accounts.take(new[1], sequence, payload)

    def _define(self, opcode: int, content: bytes) -> None:
        entry = mcap_records.parse_record(opcode, content)
        if self._defined.setdefault((opcode, entry.id), entry) != entry:
            self._contradicted.add(entry.id)

    def _open_channel(self, number: int) -> tuple[int, str] | None:
        """Returns the number of a channel in the new file, and its topic; None if no record names it."""
        known = self._defined.get((Opcode.CHANNEL, number))
        if known is None or len(self._new_channels) >= _MAX_NUMBERS:
            return None
        schema = self._defined.get((Opcode.SCHEMA, known.schema_id))
        if schema is not None and schema.id not in self._new_schemas:
            new = self._out.register_schema(schema.name, schema.encoding, schema.data)
            self._new_schemas[schema.id] = new
        if schema is None and known.schema_id:
            self._bare.append(known.topic)
        new_schema = self._new_schemas.get(known.schema_id, 0)
        channel = self._out.register_channel(known.topic, known.message_encoding, new_schema, known.metadata)
        self._new_channels[number] = channel, known.topic
        if self._accounts is not None:
            self._accounts.open(known.topic)
        return channel, known.topic

    def _take_torn(self, torn: mcap_records.Damage) -> None:
        opcode = int.from_bytes(self._scanner.read(torn.offset, 1), "little")
        if not torn.length or opcode in _MADE_AGAIN or torn.offset > self._data_end:
            return
        if opcode != Opcode.CHUNK:
            self._result.lose(str(torn), torn.length)
            return
        before = self._out.messages
        content = self._scanner.read(torn.offset + mcap_records.RECORD_HEAD_BYTES, MAX_SALVAGE_BYTES)
        with suppress(UnreadableRecord):  # what follows makes no sense, and is lost with the rest
            for entry in _salvage_records(content):
                self._take_inner(*entry)
        self._result.salvaged = self._out.messages - before
        self._result.lose(
            f"the end of a chunk that was cut off at byte {torn.offset}; of its {torn.length} bytes "
            f"{self._result.salvaged} messages could be saved",
            torn.length,
        )

    def _report_unnamed(self) -> None:
        result, stated = self._result, self._survey.count
        for number, count in self._unnamed.items():
            result.lose(f"{count} messages of channel {number}, which no record names")
        for topic in self._bare:
            result.lose(f"the schema of {topic}")
        for number in self._contradicted:
            result.lose(f"what channel or schema {number} is: the file says it in two ways")
        if stated is not None and self._out.messages < stated and result.lossless:
            result.lose(f"{stated - self._out.messages} of the {stated} messages that it says it has")

    def _finish(self) -> None:
        result, accounts = self._result, self._accounts
        result.finished = self._scanner.finished
        result.messages, result.duration_s = self._out.messages, self._out.duration_s
        if SESSION in self._survey.metadata:
            result.chain = self._reader.judge_digest().state if self._scanner.begins else DigestState.OPEN
        if accounts is not None:
            result.missing = list(accounts.missing())
            result.coverage = accounts.coverage()
            before = self._survey.metadata.get(ACCOUNTS, {})
            alone = self._scanner.finished and result.lossless and PART not in self._survey.metadata
            if alone and any(
                parse_counts(before.get(topic, "")) not in ({}, parse_counts(text))
                for topic, text in accounts.texts().items()
                if topic.endswith(f"/{topics.STATE}")
            ):
                result.chain = DigestState.CHANGED
            counts = {name: text for name, text in before.items() if not name.startswith("/")}
            self._out.add_metadata(ACCOUNTS, {**accounts.texts(), **counts})
        self._out.add_metadata(RECOVERED, result.facts())
        if accounts is not None:
            self._out.close_digest()
        self._out.finish()


def _salvage_records(content: bytes) -> Iterator[tuple[int, bytes]]:
    limit = max(mcap_records.MAX_UNPACKED_BYTES, mcap_records.MAX_UNPACKED_RATIO * len(content))
    waiting = bytearray()
    for piece in _unpack_pieces(content):
        waiting += piece
        limit -= len(piece)
        done = 0
        with suppress(UnreadableRecord):  # the rest of the last record comes with the next pieces
            for opcode, begin, end in mcap_records.iterate_records(waiting):
                if not opcode:
                    return
                yield opcode, bytes(waiting[begin:end])
                done = end
        del waiting[:done]
        if limit <= 0:
            return


def _unpack_pieces(content: bytes) -> Iterator[bytes]:
    name_offset = mcap_records.COMPRESSION_NAME_OFFSET + 4
    letters = int.from_bytes(content[mcap_records.COMPRESSION_NAME_OFFSET : name_offset], "little")
    data = BytesIO(content[name_offset + letters + 8 :])
    openers: dict[bytes, Callable[[BytesIO], Any]] = {
        b"": lambda data: data,
        b"zstd": zstandard.ZstdDecompressor(max_window_size=mcap_records.MAX_WINDOW_BYTES).stream_reader,
        b"lz4": lz4.frame.open,
    }
    opener = openers.get(content[name_offset : name_offset + letters])
    with suppress(zstandard.ZstdError, RuntimeError, ValueError, MemoryError, EOFError):
        stream = opener(data) if opener is not None else BytesIO()
        while piece := stream.read1(_PIECE_BYTES):
            yield piece
