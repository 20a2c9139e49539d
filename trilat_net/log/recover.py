"""Recovery: makes a finished MCAP file of one that is cut off or damaged.

Invariant:
- What can be read is copied byte for byte: messages with their times and numbers, metadata,
  attachments.
- What cannot be read is left out and reported. Nothing is invented: of a trilat-net log a
  message is copied only if a valid checksum covers it or if its content proves it
  (`content_check`), and only from a chunk that stands where it was written (`recovery_survey`).
- No file is made that holds nothing. A log that no command opens in the end is reported as
  such: the new file is read once more.
- The source file is not modified. Any MCAP file is accepted; for a trilat-net log the accounts
  are rebuilt.
"""

import hashlib
import json
from collections import Counter, deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode

from ..errors import LogError, NothingSaved, UsageError, count_nouns
from ..files import describe_write_error, open_regular
from ..net import topics
from ..net.messages import VERSION, json_schema
from ..results import Result
from ..scenario import parse_embedded
from . import mcap_records
from .accounting import Coverage, SessionAccounts, open_session_accounts, parse_counts
from .content_check import ContentCheck
from .log_file import LogFile
from .log_layout import (
    ACCOUNTS,
    ACTIVE_SUFFIX,
    CHANNEL_TYPES,
    PART,
    SCENARIO,
    SESSION,
    collect_provenance,
    describe_unfinished,
)
from .mcap_reader import McapReader, Progress, check_log
from .mcap_records import UnreadableRecord
from .mcap_writer import McapWriter
from .recovery_survey import RecoverySurvey
from .running_digest import DIGESTS, RECOVERED, DigestState
from .torn_chunk import TornChunk

_UNOPENED = "other MCAP programs open the new file, commands of trilat-net do not"
_UNPROVEN = "without a checksum, and without the scenario no message can be checked"
_MAX_REASONS = 3
"""Losses that the error names where they leave nothing to save."""
MAX_LISTED_LOSSES = 20
"""Losses that are listed there one by one."""
DAMAGED_SUFFIX = ".damaged"
"""What is added to the name of an attachment whose checksum does not agree."""
_MAX_SCENARIO_BYTES = 64 << 20
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
        duration_s: from the first message to the last, by the times at which they were logged,
            s.
        salvaged: messages out of a last chunk that was cut off.
        lost, lost_bytes: what was lost, a sentence each, and how many bytes could not be read.
        missing: per site which records are not in the file, be they lost here or never
            recorded.
        coverage: the records in the file and the ticks of the run; of no site if it is no
            trilat-net log.
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

    def add_loss(self, what: str, size: int = 0) -> None:
        """Adds a loss of so many bytes."""
        self.lost.append(what)
        self.lost_bytes += size

    def facts(self) -> dict[str, str]:
        """Returns the metadata of the new file that describe the recovery."""
        listed = self.lost[:MAX_LISTED_LOSSES]
        more = (
            [f"and {len(self.lost) - len(listed)} more"] if len(self.lost) > len(listed) else []
        )
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
        raise UsageError(
            f"{made}: is the file itself, which is not touched; choose another name with -o"
        )
    try:
        with open_regular(path) as stream:
            return _recover(stream, Recovery(path, made), force, progress)
    except OSError as error:
        if error.filename not in (None, str(path)):
            raise describe_write_error(Path(error.filename), error) from None
        raise LogError(
            f"{path}: cannot be read: {error.strerror}{describe_unfinished(path)}"
        ) from None


def _recover(
    stream: BinaryIO, result: Recovery, force: bool, progress: Progress | None
) -> Recovery:
    reader = McapReader(stream, str(result.path), progress, kept=False)
    survey = RecoverySurvey(reader.scanner)
    if survey.why_empty:
        raise NothingSaved(
            f"{result.path}: there is nothing in it that could be saved: {survey.why_empty}"
        )
    restored = _restore_scenario(survey, result.path)
    working = result.output.with_name(result.output.name + ".recovering")
    working.unlink(missing_ok=True)
    file = LogFile(result.output, force=force, working=working)
    try:
        copy = _FileCopy(reader, file, survey, result)
        copy.run(restored)
        if copy.is_session_log and not any(_UNOPENED in text for text in result.lost):
            _check_output(working, result)
        file.close()
    except BaseException:
        file.discard()
        if file.disk_error is not None:
            raise file.refused(file.disk_error) from None
        raise
    return result


def _check_output(working: Path, result: Recovery) -> None:
    """Adds a loss if no command opens the file that was made."""
    with working.open("rb") as stream:
        try:
            check_log(stream, str(result.output))
        except LogError as error:
            result.lost.insert(0, f"{error}; {_UNOPENED}")


def _restore_scenario(survey: RecoverySurvey, path: Path) -> bytes:
    """Returns the scenario of a log that lost it, if the file that was run is beside it; else
    b"".
    """
    digest = survey.metadata.get(SESSION, {}).get("scenario_sha256", "")
    kept = survey.attachments.get(SCENARIO)
    if not digest or kept is not None:
        return b""
    with suppress(OSError, LogError), open_regular(path.with_name(SCENARIO)) as stream:
        text: bytes = stream.read(_MAX_SCENARIO_BYTES)
        if hashlib.sha256(text).hexdigest() == digest:
            survey.attachments[SCENARIO] = text
            return text
    return b""


class _FileCopy:
    """Copy of one file into another; of a number's definitions the first one holds.

    Attributes:
        is_session_log: True if anything says that it is a log of a session.
    """

    def __init__(
        self, reader: McapReader, file: LogFile, survey: RecoverySurvey, result: Recovery
    ) -> None:
        reader.watch = self._copy
        self._reader = reader
        self._scanner = reader.scanner
        self._survey = survey
        self._result = result
        by = f"recovered by trilat-net {collect_provenance()['version_trilat-net']}"
        self._out = McapWriter(file, f"{survey.library or 'unknown'}, {by}", survey.profile)
        self._accounts = open_session_accounts(survey.metadata, survey.attachments)
        self._content = _make_content_check(survey, self._accounts)
        self._data_end = reader.size + 1
        self.is_session_log = survey.is_session_log
        self._is_empty = True  # neither a message nor metadata nor an attachment was copied
        self._reported = 0  # damaged parts that are among the losses
        self._defined: dict[
            tuple[int, int], Any
        ] = {}  # schemas and channels, by opcode and number
        self._contradicted: set[int] = set()  # numbers that have two definitions
        self._new_schemas: dict[int, int] = {}
        self._released_schemas: dict[
            str, int
        ] = {}  # written anew, by the kind of their messages
        self._new_channels: dict[int, tuple[int, str]] = {}  # number in the new file, and topic
        self._new_topics: dict[
            str, tuple[int, str]
        ] = {}  # the same by topic, of the session's own channels
        self._bare: list[str] = []  # topics of channels whose schema no record names
        self._misnamed: list[
            str
        ] = []  # topics of channels whose messages prove another or no definition
        self._unnamed: Counter[int] = Counter()  # messages of channels that no record names
        self._identified: set[int] = set()  # channels whose first message was looked at
        for opcode, content in survey.definitions:
            try:
                self._define(opcode, content)
            except UnreadableRecord as error:
                result.add_loss(f"a definition: {error}", len(content))
        for kind, number in sorted(self._defined):
            if kind == Opcode.CHANNEL and self._is_plausible(self._defined[kind, number].topic):
                self._open_channel(number)  # with or without messages

    def run(self, restored: bytes) -> None:
        """Copies everything; a scenario that was `restored` from elsewhere comes first.

        Raises:
            NothingSaved: all that the file holds is lost.
        """
        if restored:
            self._out.add_attachment(
                create_time=0,
                log_time=0,
                name=SCENARIO,
                media_type="application/toml",
                data=restored,
            )
            self._is_empty = False
        deque(self._reader.messages(), maxlen=0)  # every record passes through `_copy`
        self._report_damaged()
        if self._scanner.torn is not None:
            self._take_torn(self._scanner.torn)
        self._out.flush()
        self._report_unnamed()
        # before the end mark, which would make it a file
        if self._is_empty and self._result.lost:
            reasons = [text for text in self._result.lost if _UNOPENED not in text][
                :_MAX_REASONS
            ]
            why = f"there is nothing in it that could be saved: {'; '.join(reasons)}"
            raise NothingSaved(f"{self._result.path}: {why}")
        self._finish()

    def _copy(self, frame: mcap_records.RecordFrame, content: bytes, data: bytes) -> None:
        self._report_damaged()
        try:
            self._take(frame, content, data)
        except UnreadableRecord as error:
            self._result.add_loss(
                f"{count_nouns(frame.size, 'byte')} at byte {frame.offset}: {error}", frame.size
            )

    def _report_damaged(self) -> None:
        for damage in self._scanner.damaged[self._reported :]:
            if damage.offset <= self._data_end:
                self._result.add_loss(str(damage), damage.length)
        self._reported = len(self._scanner.damaged)

    def _take(self, frame: mcap_records.RecordFrame, content: bytes, data: bytes) -> None:
        """Copies one record of the file; `data` is what a chunk holds, empty if it cannot be
        unpacked.
        """
        opcode = frame.opcode
        if opcode == Opcode.HEADER or opcode in mcap_records.DEFINITIONS:
            return
        if opcode in _MADE_AGAIN:
            self._pass_over(frame, content)
        elif opcode == Opcode.CHUNK:
            self._take_chunk(frame, data or mcap_records.unpack_chunk(content))
        elif opcode == mcap_records.OP_MESSAGE:
            self._take_single(content)
        elif opcode == Opcode.METADATA:
            self._take_metadata(content)
        elif opcode == Opcode.ATTACHMENT:
            self._take_attachment(content)
        else:
            raise UnreadableRecord(f"a record of kind {opcode} is unknown here")

    def _take_metadata(self, content: bytes) -> None:
        entry = mcap_records.parse_record(Opcode.METADATA, content)
        is_made_again = self._accounts is not None and entry.name in (ACCOUNTS, DIGESTS)
        if entry.name == RECOVERED or is_made_again:
            return
        if entry.name == SESSION and entry.metadata != self._survey.metadata.get(SESSION):
            raise UnreadableRecord("metadata of another session")
        self._out.add_metadata(entry.name, entry.metadata)
        self._is_empty = False

    def _take_attachment(self, content: bytes) -> None:
        """Copies an attachment; one that is damaged must not get a valid checksum under its own
        name.
        """
        entry = mcap_records.parse_record(Opcode.ATTACHMENT, content)
        name = entry.name
        problem = "" if mcap_records.has_right_crc(content) else "its CRC differs"
        if name == SCENARIO and entry.data != self._survey.attachments.get(SCENARIO):
            problem = problem or "it is not that of this session"
        if problem:
            name = f"{name}{DAMAGED_SUFFIX}"
            self._result.add_loss(f"attachment {entry.name}: {problem}; it is kept as {name}")
        self._out.add_attachment(
            create_time=entry.create_time,
            log_time=entry.log_time,
            name=name,
            media_type=entry.media_type,
            data=entry.data,
        )
        self._is_empty = False

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

    def _take_chunk(self, frame: mcap_records.RecordFrame, data: bytes) -> None:
        """Copies a chunk that was unpacked, and agrees with its checksum if it has one."""
        if problem := self._survey.misplaced.get(frame.offset):
            raise UnreadableRecord(problem)
        head = self._scanner.head(frame)
        inner = [
            (opcode, data[begin:end])
            for opcode, begin, end in mcap_records.iterate_records(data)
        ]
        if not head.crc and self._content is None and self.is_session_log:
            raise UnreadableRecord(f"a chunk {_UNPROVEN}")
        if not head.crc and self._content is not None:
            self._take_unproven(inner, (head.start_ns, head.end_ns))
            return
        if self._content is not None:
            self._content.check_origin(data)
        for opcode, content in inner:
            self._take_inner(opcode, content)

    def _take_single(self, content: bytes) -> None:
        """Copies a message outside of chunks, which has no checksum."""
        if self._content is not None:
            self._take_unproven([(mcap_records.OP_MESSAGE, content)], (0, _LAST_NS))
        elif self.is_session_log:
            raise UnreadableRecord(f"a message {_UNPROVEN}")
        elif self._survey.is_chunked:
            raise UnreadableRecord("a message stands outside of the chunks")
        else:
            self._take_inner(mcap_records.OP_MESSAGE, content)

    def _take_inner(self, opcode: int, content: bytes) -> None:
        if opcode in mcap_records.DEFINITIONS:
            self._define(opcode, content)
        elif opcode == mcap_records.OP_MESSAGE:
            number, sequence, log_ns, publish_ns = _split_head(content)
            payload = content[mcap_records.MESSAGE_HEAD.size :]
            new = self._find_channel(number, payload)
            if new is None:
                self._unnamed[number] += 1
                return
            self._out.add_message(
                channel_id=new[0],
                log_time=log_ns,
                data=payload,
                publish_time=publish_ns,
                sequence=sequence,
            )
            self._is_empty = False
            if self._content is not None:
                self._content.accept(new[1], sequence, log_ns, payload)
            if self._accounts is not None:
                self._accounts.receive(new[1], sequence, payload)

    def _take_unproven(
        self, inner: Iterable[tuple[int, bytes]], span_ns: tuple[int, int]
    ) -> None:
        """Copies the messages of which no checksum proves anything, if all of them prove
        themselves.

        Args:
            inner: records of a chunk.
            span_ns: first and last log time of the chunk, Unix ns.

        Raises:
            UnreadableRecord: a record fails; nothing was copied.
        """
        inner = list(inner)
        for opcode, content in inner:
            self._check_unproven(opcode, content, span_ns)
        for opcode, content in inner:
            self._take_inner(opcode, content)

    def _check_unproven(self, opcode: int, content: bytes, span_ns: tuple[int, int]) -> None:
        if opcode in mcap_records.DEFINITIONS:
            entry = mcap_records.parse_record(opcode, content)
            is_own = opcode == Opcode.CHANNEL and entry.topic.startswith(f"/{topics.ROOT}/")
            if is_own and self._content is None:
                self.is_session_log = True
                raise UnreadableRecord("its scenario, without which no message can be checked")
            if opcode == Opcode.CHANNEL and not self._is_plausible(entry.topic):
                raise UnreadableRecord("a channel is none of this session")
            self._define(opcode, content)
            return
        if opcode != mcap_records.OP_MESSAGE:
            raise UnreadableRecord(f"a chunk holds a record of kind {opcode}")
        number, sequence, log_ns, publish_ns = _split_head(content)
        payload = content[mcap_records.MESSAGE_HEAD.size :]
        channel = self._find_channel(number, payload)
        if channel is None:
            raise UnreadableRecord(f"a message is of channel {number}, which no record names")
        if self._content is not None:
            self._content.check(channel[1], sequence, log_ns, publish_ns, payload, span_ns)
        elif not span_ns[0] <= log_ns <= span_ns[1]:
            raise UnreadableRecord("a message was logged outside of its chunk")

    def _define(self, opcode: int, content: bytes) -> None:
        entry = mcap_records.parse_record(opcode, content)
        if self._defined.setdefault((opcode, entry.id), entry) != entry:
            self._contradicted.add(entry.id)

    def _is_plausible(self, topic: str) -> bool:
        """True for a topic that the file can have: of a session's log none of another session's
        members.
        """
        is_own = topic.startswith(f"/{topics.ROOT}/")
        return self._content is None or not is_own or self._content.owns_channel(topic)

    def _find_channel(self, number: int, payload: bytes) -> tuple[int, str] | None:
        """Returns the number of a channel in the new file, and its topic; None if nothing tells
        what it is.

        The first message of a channel of the session decides: it names its member and its kind,
        where the definition of a channel has no checksum in a file that was not finished.
        """
        known = self._new_channels.get(number)
        if known is not None and (self._content is None or number in self._identified):
            return known
        self._identified.add(number)
        topic = self._content.identify(payload) if self._content is not None else ""
        if not topic or (known is not None and known[1] == topic):
            return known or self._open_channel(number)
        self._misnamed.append(topic)
        self._new_channels[number] = self._new_topics.get(topic) or self._open_again(topic)
        return self._new_channels[number]

    def _open_channel(self, number: int) -> tuple[int, str] | None:
        """Returns the number of a channel in the new file, and its topic; None if no record
        names it.
        """
        known = self._defined.get((Opcode.CHANNEL, number))
        if (
            known is None
            or len(self._new_channels) >= _MAX_NUMBERS
            or not self._is_plausible(known.topic)
        ):
            return None
        schema = self._defined.get((Opcode.SCHEMA, known.schema_id))
        if schema is not None and schema.id not in self._new_schemas:
            new = self._out.register_schema(schema.name, schema.encoding, schema.data)
            self._new_schemas[schema.id] = new
        if schema is None and known.schema_id:
            self._bare.append(known.topic)
        new_schema = self._new_schemas.get(known.schema_id, 0)
        channel = self._out.register_channel(
            known.topic, known.message_encoding, new_schema, known.metadata
        )
        return self._keep_channel(number, channel, known.topic)

    def _open_again(self, topic: str) -> tuple[int, str]:
        """Returns a channel of the session that is defined anew, as the log's writer defines
        it.
        """
        assert self._content is not None
        kind = CHANNEL_TYPES[topic.rpartition("/")[2]]
        name = f"trilat.{kind.__name__}.v{VERSION}"
        if name not in self._released_schemas:
            data = json.dumps(json_schema(kind)).encode()
            self._released_schemas[name] = self._out.register_schema(name, "jsonschema", data)
        about = self._content.describe_channel(topic)
        channel = self._out.register_channel(
            topic, "msgpack", self._released_schemas[name], about
        )
        return self._keep_channel(None, channel, topic)

    def _keep_channel(self, number: int | None, channel: int, topic: str) -> tuple[int, str]:
        if number is not None:
            self._new_channels[number] = channel, topic
        if self._content is not None and self._content.owns_channel(topic):
            self._new_topics.setdefault(topic, (channel, topic))
        if self._accounts is not None:
            self._accounts.open_channel(topic)
        return channel, topic

    def _take_torn(self, torn: mcap_records.Damage) -> None:
        opcode = int.from_bytes(self._scanner.read(torn.offset, 1), "little")
        if not torn.length or opcode in _MADE_AGAIN or torn.offset > self._data_end:
            return
        if opcode != Opcode.CHUNK:
            self._result.add_loss(str(torn), torn.length)
            return
        before = self._out.messages
        problem = self._salvage(torn.offset)
        self._result.salvaged = self._out.messages - before
        why = f" before {problem}" if problem else ""
        self._result.add_loss(
            f"the end of a chunk that was cut off at byte {torn.offset}; of its "
            f"{count_nouns(torn.length, 'byte')} "
            f"{count_nouns(self._result.salvaged, 'message')} could be saved{why}",
            torn.length,
        )

    def _salvage(self, offset: int) -> str:
        """Copies the records of a chunk that was cut off, block by block; returns what ended
        that, or "".
        """
        if self._content is None and self.is_session_log:
            return "its scenario, without which no message can be checked"
        try:
            torn = TornChunk.read(self._scanner, offset)
            for records in torn.iterate_blocks():
                self._take_unproven(records, (torn.head.start_ns, torn.head.end_ns))
        except UnreadableRecord as error:
            return str(error)
        return ""

    def _report_unnamed(self) -> None:
        result = self._result
        stated = self._survey.count
        for number, count in self._unnamed.items():
            result.add_loss(
                f"{count_nouns(count, 'message')} of channel {number}, which no record names"
            )
        for topic in self._bare:
            result.add_loss(f"the schema of {topic}")
        for topic in self._misnamed:
            result.add_loss(
                f"the definition of {topic}; its messages name it, and it was made again"
            )
        for number in self._contradicted:
            result.add_loss(f"what channel or schema {number} is: the file says it in two ways")
        survey = self._survey
        has_head = SESSION in survey.metadata and SCENARIO in survey.attachments
        if self.is_session_log and not has_head:
            lacks = "the scenario" if SESSION in survey.metadata else "the session's metadata"
            if survey.is_foreign_session:
                lacks += ", in whose place are those of another session"
            advice = ""
            if SESSION in survey.metadata:  # which names the hash that the scenario must have
                advice = f". If the file that was run stands beside the log as {SCENARIO}, recover puts it in"
            # lists show the first losses
            result.lost.insert(0, f"{lacks}; {_UNOPENED}{advice}")
        if stated is not None and self._out.messages < stated and result.lossless:
            result.add_loss(
                f"{stated - self._out.messages} of the {count_nouns(stated, 'message')} that it says it has"
            )

    def _finish(self) -> None:
        result = self._result
        accounts = self._accounts
        result.finished = self._scanner.finished
        result.messages = self._out.messages
        result.duration_s = self._out.duration_s
        if SESSION in self._survey.metadata:
            result.chain = self._judge_source()
        if accounts is not None:
            result.missing = list(accounts.describe_missing())
            # else the end is in a later part
            if not (result.finished and PART in self._survey.metadata):
                result.missing += accounts.describe_unfinished_sites()
            result.coverage = accounts.coverage()
            before = self._survey.metadata.get(ACCOUNTS, {})
            alone = (
                self._scanner.finished and result.lossless and PART not in self._survey.metadata
            )
            if alone and any(
                parse_counts(before.get(topic, "")) not in ({}, parse_counts(text))
                for topic, text in accounts.format_accounts().items()
                if topic.endswith(f"/{topics.STATE}")
            ):
                result.chain = DigestState.CHANGED
            counts = {name: text for name, text in before.items() if not name.startswith("/")}
            self._out.add_metadata(ACCOUNTS, {**accounts.format_accounts(), **counts})
        self._out.add_metadata(RECOVERED, result.facts())
        if accounts is not None:
            self._out.close_digest()
        self._out.finish()

    def _judge_source(self) -> DigestState:
        """Returns the agreement of the source with its digest chain.

        A definition that is damaged among the data, and stands in the index with a checksum,
        changes no message.
        """
        state = self._reader.judge_digest().state if self._scanner.begins else DigestState.OPEN
        is_repaired = self._survey.is_redefined and self._reader.agrees_on_messages
        return DigestState.OPEN if state is DigestState.CHANGED and is_repaired else state


_LAST_NS = (1 << 64) - 1


def _split_head(content: bytes) -> tuple[int, int, int, int]:
    """Returns channel, sequence, log time and publish time of a message."""
    if len(content) < mcap_records.MESSAGE_HEAD.size:
        raise UnreadableRecord("a message is too short")
    number, sequence, log_ns, publish_ns = mcap_records.MESSAGE_HEAD.unpack_from(content)
    return number, sequence, log_ns, publish_ns


def _make_content_check(
    survey: RecoverySurvey, accounts: SessionAccounts | None
) -> ContentCheck | None:
    """Returns the check of a log's messages; None of a file of another program, and without a
    scenario.
    """
    if accounts is None:
        return None
    scenario = parse_embedded(survey.attachments[SCENARIO].decode(), SCENARIO)
    is_continued = survey.metadata.get(PART, {}).get("index", "1") != "1"
    return ContentCheck(scenario, survey.metadata[SESSION], is_continued=is_continued)
