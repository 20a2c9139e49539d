"""Recovers a damaged or unfinished MCAP file into a new, finished file.

An MCAP file stores messages in compressed chunks, most of them with a checksum. Any MCAP file
is accepted. For a log of trilat-net, the accounts (counts of received and missing messages) are
recomputed from its messages.

Invariant:
    - Everything readable is copied byte for byte: messages with their times and numbers,
      metadata and attachments. Everything else is left out and reported.
    - Nothing is invented. A message of a trilat-net log is copied only if it is covered by a
      valid checksum or proved genuine by its content (`content_check`), and only from a chunk
      in its original place (`recovery_survey`).
    - The new file is never empty. If nothing can be saved, no file is created.
    - The new file is read back. If no command of trilat-net can open it, this is reported.
    - The source file is not changed.
"""

import hashlib
import json
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from mcap.opcode import Opcode

from ..errors import LogError, NothingSaved, UsageError, count_nouns
from ..files import describe_write_error, open_regular
from ..net import VERSION, json_schema, topics
from ..results import Result
from ..scenario import parse_embedded
from . import mcap_records
from .accounting import Account, Coverage
from .content_check import ContentCheck
from .log_contents import LogContents
from .log_file import LogFile
from .log_layout import (
    ACCOUNTS,
    ACTIVE_SUFFIX,
    CHANNEL_TYPES,
    PART,
    SCENARIO,
    SESSION,
    describe_unfinished,
)
from .mcap_reader import McapReader, Progress
from .mcap_records import Damage, ScannedRecord, UnreadableRecord
from .mcap_writer import McapWriter
from .provenance import collect_provenance
from .recovery_survey import RecoverySurvey
from .running_digest import DIGESTS, RECOVERED, DigestState
from .session_accounts import SessionAccounts
from .torn_chunk import TornChunk

_UNOPENED = "other MCAP programs open the new file, commands of trilat-net do not"
_UNPROVEN = "has no checksum, and the log has no scenario by which to check messages"
_NO_SCENARIO = "the log has no scenario, without which no message can be checked"
_MAX_REASONS = 3
"""Maximum number of losses listed in the error message if nothing can be saved."""
_MAX_LISTED_LOSSES = 20
"""Maximum number of losses listed individually in the metadata of the new file."""
_DAMAGED_SUFFIX = ".damaged"
"""Suffix added to the name of an attachment whose checksum is wrong."""
_MAX_SCENARIO_BYTES = 64 << 20
"""Maximum size of a scenario file next to the log, in bytes."""
_MAX_NUMBERS = 65_535
"""Maximum number of channels in a file, because the format numbers them with 16 bits."""
_REGENERATED = frozenset(
    {Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.STATISTICS}
    | {Opcode.METADATA_INDEX, Opcode.SUMMARY_OFFSET, Opcode.DATA_END, Opcode.FOOTER}
)
"""Kinds of records that the writer computes from the content. Losing them loses no data."""


@dataclass(repr=False)
class Recovery(Result):
    """Result of recovering a damaged log: what was copied and what was lost.

    Attributes:
        path: The source file.
        output: The new file.
        finished: True if the source file had been finished.
        messages: Number of messages in the new file.
        duration_s: Time between the arrivals of the first and the last message, in s.
        salvaged: Number of messages saved from a truncated last chunk.
        lost: One sentence per loss.
        lost_bytes: Number of bytes that could not be read.
        missing: One line per site whose records are incomplete in the new file, either because
            they were lost in the source file or because they were never recorded.
        coverage: Number of records in the new file and of ticks in the run, per site. Empty if
            the source is not a log of trilat-net.
        chain: Result of comparing the source with its digests. Empty if the source is not a log
            of trilat-net.
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
        """True if the recovered file contains everything that the damaged file contains.

        False if anything was lost, in which case `lost` describes the losses.
        """
        return not self.lost

    def to_dict(self) -> dict[str, Any]:
        """Returns the result of recovering a damaged log as plain values, for JSON.

        This is the output of `trilat log recover --json`. The entries state what was saved
        ("messages", "coverage") and what was lost ("lost_bytes", "missing").
        """
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
                site: {"records": records, "ticks": ticks}
                for site, (records, ticks) in self.coverage.to_json().items()
            },
            "digest_chain": str(self.chain) or None,
        }

    def add_loss(self, text: str, size: int = 0) -> None:
        """Adds the loss of a part of the damaged file to the report for the user.

        Args:
            text: Sentence that describes the loss to the user.
            size: Number of bytes that cannot be read. 0 if the loss is not a range of bytes.
        """
        self.lost.append(text)
        self.lost_bytes += size

    def facts(self) -> dict[str, str]:
        """Summarises what was recovered and what was lost, as a dictionary of strings.

        The summary is stored in the metadata of the recovered file, so that readers can
        recognise the file as a recovered log. It states the source file, the losses and the
        missing records.
        """
        losses = self.lost[:_MAX_LISTED_LOSSES]
        unlisted = len(self.lost) - len(losses)
        if unlisted:
            losses.append(f"and {unlisted} more")
        return {
            "from": self.path.name,
            "finished": str(self.finished).lower(),
            "lost": "; ".join(losses) or "nothing",
            "lost_bytes": str(self.lost_bytes),
            "salvaged_messages": str(self.salvaged),
            "missing": "; ".join(self.missing) or "nothing",
            "coverage": str(self.coverage) if self.coverage.expected else "unknown",
            "chain": str(self.chain),
        }


def recovered_path(path: Path) -> Path:
    """Returns the default name of the recovered file.

    This is run.mcap for an unfinished log run.mcap.active, and run.recovered.mcap for run.mcap.

    Args:
        path: Path of the damaged file.
    """
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
    """Recovers a damaged or unfinished file into a new file, like `trilat log recover`.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("torn.mcap")
    >>> tn.recover(path, "whole.mcap").lossless
    True

    Args:
        file: Path of the source file.
        out: Path of the new file. By default, it is derived from the source, see
            `recovered_path`.
        force: True to allow replacing an existing file.
        progress: Function that is called after every record of the source file.

    Raises:
        LogError: The source file cannot be read.
        NothingSaved: Nothing could be recovered.
        UsageError: The new file already exists or cannot be created.
        LogRefused: Writing to the disk failed. No file was created.
    """
    path = Path(file)
    if not path.name:
        raise LogError(f"{path} cannot be read: Is a directory")
    output = recovered_path(path) if out is None else Path(out)
    if not output.name:
        raise UsageError(f"{output} is a directory; name a file with -o")
    if output.exists() and path.exists() and output.samefile(path):
        raise UsageError(
            f"{output} is the source file, which is never changed; choose another name with -o"
        )
    try:
        with open_regular(path) as stream:
            return _recover(stream, Recovery(path, output), force, progress)
    except OSError as error:
        if error.filename not in (None, str(path)):
            raise describe_write_error(Path(error.filename), error) from None
        raise LogError(
            f"{path} cannot be read: {error.strerror}{describe_unfinished(path)}"
        ) from None


def _recover(
    stream: BinaryIO, result: Recovery, force: bool, progress: Progress | None
) -> Recovery:
    """Recovers an opened source file.

    The new file has a working name until it is complete. If the recovery fails, it is deleted.

    Args:
        stream: The source file, opened for reading.
        result: Result with the names of the files, to be completed.
        force: True to allow replacing an existing file.
        progress: Function that is called after every record of the source file.

    Returns:
        The completed result.

    Raises:
        NothingSaved: Nothing could be recovered.
        UsageError: The new file already exists or cannot be created.
        LogRefused: Writing to the disk failed.
    """
    reader = McapReader(stream, str(result.path), progress, kept=False)
    survey = RecoverySurvey(reader.scanner)
    if survey.why_empty:
        raise NothingSaved(
            f"{result.path}: nothing in this file could be saved: {survey.why_empty}"
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
    """Tries to open the recovered file, and adds a loss to the result if this fails.

    Args:
        working: The new file, under its temporary name.
        result: Result of the recovery.
    """
    with working.open("rb") as stream:
        try:
            LogContents.check(stream, str(result.output))
        except LogError as error:
            result.lost.insert(0, f"{error}; {_UNOPENED}")


def _restore_scenario(survey: RecoverySurvey, path: Path) -> bytes:
    """Looks for a lost scenario in a file next to the log.

    The file is recognised by the hash of the scenario in the metadata of the session. Its text
    is added to the survey.

    Args:
        survey: Survey of the source file.
        path: Path of the source file.

    Returns:
        The text of the file. Empty if the log contains its scenario, or if there is no such
        file.
    """
    expected_sha256 = survey.metadata.get(SESSION, {}).get("scenario_sha256", "")
    is_lost = SCENARIO not in survey.attachments
    if not is_lost or not expected_sha256:
        return b""
    with suppress(OSError, LogError), open_regular(path.with_name(SCENARIO)) as stream:
        text: bytes = stream.read(_MAX_SCENARIO_BYTES)
        if hashlib.sha256(text).hexdigest() == expected_sha256:
            survey.attachments[SCENARIO] = text
            return text
    return b""


class _FileCopy:
    """Copies the contents of a damaged MCAP file, the source, to a new file.

    A schema describes the fields of a kind of message, and a channel is a sequence of such
    messages. If the source defines the same number of a schema or channel twice, the first
    definition counts.

    Args:
        reader: Reader of the source file.
        file: Writer of the new file.
        survey: Survey of the source file.
        result: Result of the recovery, to which losses are added.

    Attributes:
        is_session_log: True if anything shows that the source is the log of a session.
    """

    def __init__(
        self, reader: McapReader, file: LogFile, survey: RecoverySurvey, result: Recovery
    ) -> None:
        self._reader = reader
        self._scanner = reader.scanner
        self._survey = survey
        self._result = result
        version = collect_provenance()["version_trilat-net"]
        library = f"{survey.library or 'unknown'}, recovered by trilat-net {version}"
        self._out = McapWriter(file, library, survey.profile)
        self._accounts = SessionAccounts.open(survey.metadata, survey.attachments)
        # Check of messages by their content. None for files of other programs, and if there is
        # no readable scenario, which the check needs.
        self._content = _create_content_check(survey, self._accounts)
        # Offset of the record that ends the data. Until this record is read, all records are
        # data.
        self._data_end = reader.size + 1
        self.is_session_log = survey.is_session_log
        # True until a message, metadata or an attachment is copied.
        self._is_empty = True
        # Schemas and channels of the source, by opcode and number.
        self._definitions: dict[tuple[int, int], Any] = {}
        # Numbers that the source defines in two different ways.
        self._contradicted: set[int] = set()
        # Schema number in the new file, by the number in the source.
        self._new_schemas: dict[int, int] = {}
        # Number of each schema that the recovery defines itself, by the schema's name.
        self._session_schemas: dict[str, int] = {}
        # Channel number in the new file, and topic, by the number in the source.
        self._new_channels: dict[int, tuple[int, str]] = {}
        # Channel number in the new file, and topic, by topic, for the channels of the session's
        # members.
        self._new_topics: dict[str, tuple[int, str]] = {}
        # Topics of channels whose schema is missing.
        self._topics_without_schema: list[str] = []
        # Topics whose messages contradict the definition of their channel, or lack one.
        self._misnamed: list[str] = []
        # Number of messages of undefined channels, by channel number in the source.
        self._unnamed: Counter[int] = Counter()
        # Channels whose first message has been identified by its content.
        self._identified: set[int] = set()
        for opcode, content in survey.definitions:
            try:
                self._define(opcode, content)
            except UnreadableRecord as error:
                result.add_loss(f"a definition: {error}", len(content))
        for opcode, number in sorted(self._definitions):
            if opcode != Opcode.CHANNEL:
                continue
            # A channel is copied even if it has no messages.
            if self._is_plausible(self._definitions[opcode, number].topic):
                self._open_channel(number)

    def run(self, restored: bytes) -> None:
        """Copies everything readable from a damaged log to a new file.

        Args:
            restored: Text of the scenario, from a file next to the damaged log. Written first.
                Empty if the log itself contains its scenario.

        Raises:
            NothingSaved: Nothing could be copied.
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

        for item in self._reader.scan():
            if isinstance(item, Damage):
                self._report_damage(item)
            else:
                self._copy_or_report(item)
                # The messages are not needed here, but reading them updates the digests of the
                # source, which are judged at the end.
                deque(self._reader.read_record(item), maxlen=0)

        if self._scanner.torn is not None:
            self._copy_torn_chunk(self._scanner.torn)
        self._out.flush()
        self._report_final_losses()

        # This check precedes the end mark, which would make an empty file a valid one.
        if self._is_empty and self._result.lost:
            losses = [text for text in self._result.lost if _UNOPENED not in text]
            reasons = "; ".join(losses[:_MAX_REASONS])
            raise NothingSaved(
                f"{self._result.path}: nothing in this file could be saved: {reasons}"
            )
        self._finish()

    def _copy_or_report(self, record: ScannedRecord) -> None:
        """Copies one record of the source, or reports it as a loss if it cannot be read."""
        try:
            self._copy_record(record)
        except UnreadableRecord as error:
            frame = record.frame
            self._result.add_loss(
                f"{count_nouns(frame.size, 'byte')} at byte {frame.offset}: {error}", frame.size
            )

    def _report_damage(self, damage: Damage) -> None:
        """Adds a damaged part of the file to the losses in the report on the recovery.

        A damaged part after the end of the data is not a loss, because it contains only the
        index, which is rebuilt.
        """
        if damage.offset <= self._data_end:
            self._result.add_loss(str(damage), damage.length)

    def _copy_record(self, record: ScannedRecord) -> None:
        """Copies one record of the damaged file to the new one, using the method for its kind.

        Records are the units that make up an MCAP file: a chunk of messages, metadata, an
        attachment, or a part of an index.

        Raises:
            UnreadableRecord: The record cannot be trusted and was not copied.
        """
        frame = record.frame
        content = record.content
        opcode = frame.opcode
        if opcode == Opcode.HEADER or opcode in mcap_records.DEFINITIONS:
            return  # already read by the survey
        if opcode in _REGENERATED:
            self._check_regenerated(frame, content)
        elif opcode == Opcode.CHUNK:
            self._copy_chunk(record)
        elif opcode == mcap_records.OP_MESSAGE:
            self._copy_single_message(content)
        elif opcode == Opcode.METADATA:
            self._copy_metadata(content)
        elif opcode == Opcode.ATTACHMENT:
            self._copy_attachment(content)
        else:
            raise UnreadableRecord(f"this record has the unknown kind {opcode}")

    def _copy_metadata(self, content: bytes) -> None:
        """Copies a named dictionary from the damaged file, unless it is written again later.

        Raises:
            UnreadableRecord: The metadata are those of another session.
        """
        entry = mcap_records.parse_record(Opcode.METADATA, content)
        is_regenerated = self._accounts is not None and entry.name in (ACCOUNTS, DIGESTS)
        if entry.name == RECOVERED or is_regenerated:
            return
        if entry.name == SESSION and entry.metadata != self._survey.metadata.get(SESSION):
            raise UnreadableRecord("the metadata belong to another session")
        self._out.add_metadata(entry.name, entry.metadata)
        self._is_empty = False

    def _copy_attachment(self, content: bytes) -> None:
        """Copies a file attached to the log, such as the scenario.

        A damaged attachment is renamed with the suffix `_DAMAGED_SUFFIX`. If it kept its name,
        nobody would notice the damage, because the writer adds a valid checksum.
        """
        entry = mcap_records.parse_record(Opcode.ATTACHMENT, content)
        name = entry.name
        problem = ""
        if not mcap_records.has_right_crc(content):
            problem = "its CRC does not match its content"
        elif name == SCENARIO and entry.data != self._survey.attachments.get(SCENARIO):
            problem = "it belongs to another session"
        if problem:
            name = f"{name}{_DAMAGED_SUFFIX}"
            self._result.add_loss(f"attachment {entry.name}: {problem}; it is kept as {name}")
        self._out.add_attachment(
            create_time=entry.create_time,
            log_time=entry.log_time,
            name=name,
            media_type=entry.media_type,
            data=entry.data,
        )
        self._is_empty = False

    def _check_regenerated(self, frame: mcap_records.RecordFrame, content: bytes) -> None:
        """Checks that a record that is not copied really belongs to an index of the file.

        The index of the new file is computed from scratch. If the opcode of a record with data
        is damaged, the record may look like a part of an index, and its loss would go
        unreported.

        Args:
            frame: Kind and position of the record. The kind is one of `_REGENERATED`.
            content: Content of the record.

        Raises:
            UnreadableRecord: The record is not plausible.
        """
        if frame.opcode == Opcode.DATA_END and len(content) == 4:
            self._data_end = frame.offset
        elif frame.opcode == Opcode.MESSAGE_INDEX:
            size = int.from_bytes(content[2:6], "little")
            if size != len(content) - 6 or size % 16:
                raise UnreadableRecord("a message index has the wrong length")
        elif frame.offset < self._data_end:
            raise UnreadableRecord(
                f"an index record of kind {frame.opcode} appears in the data section"
            )

    def _copy_chunk(self, chunk: ScannedRecord) -> None:
        """Copies the records of a chunk if there is evidence that they are correct.

        A chunk is a block of records, usually with a checksum. There are four cases:

        - The chunk has a valid checksum: its records are copied. If the log contains its
          scenario, the first messages must also belong to the run of the log.
        - There is no checksum, but the scenario can be read: each message is checked by its
          content (`content_check`).
        - There is no checksum, and the log of a session has lost its scenario: nothing shows
          that the messages are correct, so no message is copied.
        - There is no checksum, and the file is from another program, which need not write
          checksums: its records are copied.

        Args:
            chunk: The chunk.

        Raises:
            UnreadableRecord: The chunk cannot be decompressed, is not in its original place, is
                from another run, or cannot be checked.
        """
        data = chunk.unpack()
        problem = self._survey.misplaced.get(chunk.frame.offset)
        if problem:
            raise UnreadableRecord(problem)

        head = chunk.head()
        records = [
            (opcode, data[begin:end])
            for opcode, begin, end in mcap_records.iterate_records(data)
        ]
        has_checksum = bool(head.crc)
        has_scenario = self._content is not None
        if not has_checksum and not has_scenario and self.is_session_log:
            raise UnreadableRecord(f"a chunk {_UNPROVEN}")
        if not has_checksum and has_scenario:
            self._copy_unproven(records, (head.start_ns, head.end_ns))
            return

        if self._content is not None:
            self._content.check_origin(data)
        for opcode, content in records:
            self._copy_chunk_record(opcode, content)

    def _copy_single_message(self, content: bytes) -> None:
        """Copies a message that is not in a chunk and not covered by a checksum.

        In the log of a session, the content of the message must show that it is the next one of
        its channel (`content_check`), which requires the scenario. Other programs may write
        files without chunks, whose messages are copied unchecked.

        Args:
            content: Content of the message record.

        Raises:
            UnreadableRecord: The content contradicts the session or cannot be checked. Also
                raised if the file of another program has chunks and a message outside of them,
                which only damage can cause.
        """
        if self._content is not None:
            any_time_ns = (0, _LAST_NS)  # no chunk limits the time of the message
            self._copy_unproven([(mcap_records.OP_MESSAGE, content)], any_time_ns)
            return
        if self.is_session_log:
            raise UnreadableRecord(f"a message {_UNPROVEN}")
        if self._survey.is_chunked:
            raise UnreadableRecord("a message lies outside of the chunks")
        self._copy_chunk_record(mcap_records.OP_MESSAGE, content)

    def _copy_chunk_record(self, opcode: int, content: bytes) -> None:
        """Copies a message of a chunk to the new file, or stores a definition for later.

        Definitions describe schemas and channels, and are written when a message needs them.
        Other kinds of records are ignored.

        Args:
            opcode: Opcode of the record.
            content: Content of the record.

        Raises:
            UnreadableRecord: The record cannot be decoded.
        """
        if opcode in mcap_records.DEFINITIONS:
            self._define(opcode, content)
            return
        if opcode != mcap_records.OP_MESSAGE:
            return

        number, sequence, log_ns, publish_ns = _parse_message_head(content)
        payload = content[mcap_records.MESSAGE_HEAD.size :]
        channel = self._find_channel(number, payload)
        if channel is None:
            self._unnamed[number] += 1
            return

        new_number, topic = channel
        self._out.add_message(
            channel_id=new_number,
            log_time=log_ns,
            data=payload,
            publish_time=publish_ns,
            sequence=sequence,
        )
        self._is_empty = False
        if self._content is not None:
            self._content.accept(topic, sequence, log_ns, payload)
        if self._accounts is not None:
            self._accounts.receive(topic, sequence, payload)

    def _copy_unproven(
        self, records: Iterable[tuple[int, bytes]], span_ns: tuple[int, int]
    ) -> None:
        """Copies records without a checksum, if the content of each shows that it is intact.

        All records are checked before the first one is copied.

        Args:
            records: Opcodes and contents of the records of a chunk.
            span_ns: First and last arrival time of the chunk in Unix time, in ns.

        Raises:
            UnreadableRecord: A record may be damaged. No record was copied.
        """
        records = list(records)
        for opcode, content in records:
            self._check_unproven(opcode, content, span_ns)
        for opcode, content in records:
            self._copy_chunk_record(opcode, content)

    def _check_unproven(self, opcode: int, content: bytes, span_ns: tuple[int, int]) -> None:
        """Checks a record that is not covered by a checksum, based on its content.

        In the log of a session, a message states its sender, its number and its time, which
        must match its channel, the previous messages and the scenario (`content_check`).
        Messages of other programs contain no such statements, so only the arrival time is
        compared with the time range of the chunk.

        Args:
            opcode: Kind of the record.
            content: Content of the record.
            span_ns: First and last arrival time of the chunk in Unix time, in ns.

        Raises:
            UnreadableRecord: The content contradicts its position in the file.
        """
        if opcode in mcap_records.DEFINITIONS:
            self._check_unproven_definition(opcode, content)
            return
        if opcode != mcap_records.OP_MESSAGE:
            raise UnreadableRecord(
                f"a chunk contains a record of kind {opcode}, which is not allowed there"
            )

        number, sequence, log_ns, publish_ns = _parse_message_head(content)
        payload = content[mcap_records.MESSAGE_HEAD.size :]
        channel = self._find_channel(number, payload)
        if channel is None:
            raise UnreadableRecord(
                f"a message belongs to channel {number}, which no record defines"
            )
        _, topic = channel
        first_ns, last_ns = span_ns
        if self._content is not None:
            self._content.check(
                topic=topic,
                sequence=sequence,
                log_ns=log_ns,
                publish_ns=publish_ns,
                payload=payload,
                span_ns=span_ns,
            )
        elif not first_ns <= log_ns <= last_ns:
            raise UnreadableRecord(
                "the log time of a message lies outside the time range of its chunk"
            )

    def _check_unproven_definition(self, opcode: int, content: bytes) -> None:
        """Checks a schema or channel without a checksum, and adds it to the definitions.

        The topic of a channel may be the first evidence that the file is the log of a session.
        If its scenario is missing, the messages of the session cannot be checked, and no
        further messages without a checksum are copied.

        Args:
            opcode: Kind of the definition: schema or channel.
            content: Content of the definition.

        Raises:
            UnreadableRecord: A channel belongs to no member of this session, or to a session
                whose scenario is missing.
        """
        entry = mcap_records.parse_record(opcode, content)
        if opcode == Opcode.CHANNEL:
            is_session_topic = entry.topic.startswith(f"/{topics.ROOT}/")
            has_scenario = self._content is not None
            if is_session_topic and not has_scenario:
                self.is_session_log = True
                raise UnreadableRecord(_NO_SCENARIO)
            if not self._is_plausible(entry.topic):
                raise UnreadableRecord("a channel belongs to no member of this session")
        self._define(opcode, content)

    def _define(self, opcode: int, content: bytes) -> None:
        """Stores the definition of a message format (schema) or topic (channel) for later use.

        If the file defines the same number twice, the first definition counts.

        Raises:
            UnreadableRecord: The definition cannot be decoded.
        """
        entry = mcap_records.parse_record(opcode, content)
        known = self._definitions.setdefault((opcode, entry.id), entry)
        if known != entry:
            self._contradicted.add(entry.id)

    def _is_plausible(self, topic: str) -> bool:
        """Returns True if a topic can occur in the log being recovered.

        Damaged bytes can look like a valid topic. The log of a session, for example, contains
        no topics of other sessions.
        """
        if self._content is None or not topic.startswith(f"/{topics.ROOT}/"):
            return True
        return self._content.owns_channel(topic)

    def _find_channel(self, number: int, payload: bytes) -> tuple[int, str] | None:
        """Finds or registers the channel of the new file for a message of the source.

        In the log of a session, the first message of a channel determines the channel, because
        a message names its sender and its kind. The definition of the channel is less reliable,
        because no checksum covers it in an unfinished file. If the two contradict each other, a
        new channel is defined from the message, and its topic is reported as a loss. Further
        messages of the channel are then assigned to the same new channel.

        Args:
            number: Channel number in the source.
            payload: The message.

        Returns:
            The channel number in the new file, and the topic. None if neither the message nor a
            definition names the channel.
        """
        known_channel = self._new_channels.get(number)
        is_identified = self._content is None or number in self._identified
        if known_channel is not None and is_identified:
            return known_channel

        # The content of the message names the topic, if the scenario is known.
        self._identified.add(number)
        topic = self._content.identify(payload) if self._content is not None else ""
        is_unidentified = not topic
        definition = self._definitions.get((Opcode.CHANNEL, number))
        defined_topic = definition.topic if definition is not None else ""
        if known_channel is not None:
            defined_topic = known_channel[1]
        if is_unidentified or defined_topic == topic:
            return known_channel or self._open_channel(number)

        # The definition contradicts the message.
        self._misnamed.append(topic)
        channel = self._new_topics.get(topic) or self._open_session_channel(topic)
        self._new_channels[number] = channel
        return channel

    def _open_channel(self, number: int) -> tuple[int, str] | None:
        """Registers a channel in the new file, using the definition in the damaged file.

        The schema of the channel, which describes the fields of its messages, is registered
        first.

        Args:
            number: Channel number in the damaged file.

        Returns:
            The channel number in the new file, and the topic. None if the damaged file has no
            plausible definition of the channel.
        """
        definition = self._definitions.get((Opcode.CHANNEL, number))
        if definition is None or len(self._new_channels) >= _MAX_NUMBERS:
            return None
        if not self._is_plausible(definition.topic):
            return None

        schema = self._definitions.get((Opcode.SCHEMA, definition.schema_id))
        if schema is not None and schema.id not in self._new_schemas:
            self._new_schemas[schema.id] = self._out.register_schema(
                schema.name, schema.encoding, schema.data
            )
        needs_schema = definition.schema_id != 0  # 0: the channel has no schema
        if schema is None and needs_schema:
            self._topics_without_schema.append(definition.topic)
        new_number = self._out.register_channel(
            definition.topic,
            definition.message_encoding,
            self._new_schemas.get(definition.schema_id, 0),
            definition.metadata,
        )
        return self._register_copy(number, new_number, definition.topic)

    def _open_session_channel(self, topic: str) -> tuple[int, str]:
        """Defines a channel of the session in the recovered file, as `LogWriter` does.

        Args:
            topic: Topic of the channel.

        Returns:
            The channel number in the new file, and the topic.
        """
        assert self._content is not None
        kind = CHANNEL_TYPES[topic.rpartition("/")[2]]
        name = f"trilat.{kind.__name__}.v{VERSION}"
        if name not in self._session_schemas:
            data = json.dumps(json_schema(kind)).encode()
            self._session_schemas[name] = self._out.register_schema(name, "jsonschema", data)
        about = self._content.describe_channel(topic)
        new_number = self._out.register_channel(
            topic, "msgpack", self._session_schemas[name], about
        )
        return self._register_copy(None, new_number, topic)

    def _register_copy(
        self, number: int | None, new_number: int, topic: str
    ) -> tuple[int, str]:
        """Records which channel of the new file receives the messages of a damaged channel.

        A message is assigned to its channel by the channel number stored with it in the damaged
        file. If that number is wrong, it is assigned by its topic, which follows from the
        sender and the kind stated in the message itself.

        Args:
            number: Channel number in the source. None if the source does not define the
                channel.
            new_number: Channel number in the new file.
            topic: Topic of the channel.

        Returns:
            The channel number in the new file, and the topic, in the form that callers return.
        """
        channel = new_number, topic
        if number is not None:
            self._new_channels[number] = channel
        if self._content is not None and self._content.owns_channel(topic):
            self._new_topics.setdefault(topic, channel)
        if self._accounts is not None:
            # Missing messages are then noticed even if all messages of the channel are lost.
            self._accounts.open_channel(topic)
        return channel

    def _copy_torn_chunk(self, torn: Damage) -> None:
        """Copies the messages that can be read from the last chunk, if it is incomplete.

        The rest of the chunk, or the complete record if it is not a chunk, is reported as a
        loss. An incomplete index is not a loss, because the index of the new file is computed
        from scratch.

        Args:
            torn: The incomplete last record of the file. Its length is 0 if the file ends
                between two records.
        """
        # The first byte of a record states its kind.
        opcode = int.from_bytes(self._scanner.read(torn.offset, 1), "little")
        is_between_records = not torn.length
        is_part_of_index = opcode in _REGENERATED or torn.offset > self._data_end
        if is_between_records or is_part_of_index:
            return
        if opcode != Opcode.CHUNK:
            self._result.add_loss(str(torn), torn.length)
            return

        messages_before = self._out.messages
        problem = self._salvage(torn.offset)
        self._result.salvaged = self._out.messages - messages_before
        size = count_nouns(torn.length, "byte")
        salvaged = count_nouns(self._result.salvaged, "message")
        reason = f" until this problem: {problem}" if problem else ""
        self._result.add_loss(
            f"the end of a chunk that was cut off at byte {torn.offset}; of its {size} "
            f"{salvaged} could be saved{reason}",
            torn.length,
        )

    def _salvage(self, offset: int) -> str:
        """Copies the records of an incomplete chunk that can still be decompressed.

        The chunk was compressed in blocks, which can be decompressed one after another up to
        the place where the file ends. The checksum of the chunk also covers the missing part,
        so it cannot be used. Each message must therefore be checked by its content, which
        requires the scenario in the log of a session.

        Args:
            offset: Offset of the chunk in the source file.

        Returns:
            The problem that ended the copy, for display to the user. Empty if all blocks were
            copied.
        """
        can_check_messages = self._content is not None or not self.is_session_log
        if not can_check_messages:
            return _NO_SCENARIO
        try:
            torn_chunk = TornChunk.read(self._scanner, offset)
            for records in torn_chunk.iterate_blocks():
                span_ns = (torn_chunk.head.start_ns, torn_chunk.head.end_ns)
                self._copy_unproven(records, span_ns)
        except UnreadableRecord as error:
            return str(error)
        return ""

    def _report_final_losses(self) -> None:
        """Adds the losses that are known only after the complete damaged file has been read.

        One example is messages of a channel without a definition, since a definition may follow
        its messages.
        """
        result = self._result
        for number, count in self._unnamed.items():
            result.add_loss(
                f"{count_nouns(count, 'message')} of channel {number}, which no record defines"
            )
        for topic in self._topics_without_schema:
            result.add_loss(f"the schema of {topic}")
        for topic in self._misnamed:
            result.add_loss(f"the definition of {topic}, which was restored from its messages")
        for number in self._contradicted:
            result.add_loss(
                f"the meaning of channel or schema {number}: the file defines it in two ways"
            )
        self._report_missing_head()

        # The file states how many messages it contains. A difference is reported as a separate
        # loss only if no other loss explains it.
        stated = self._survey.count
        if stated is not None and self._out.messages < stated and result.lossless:
            missing = stated - self._out.messages
            result.add_loss(
                f"{missing} of the {count_nouns(stated, 'message')} that the file lists"
            )

    def _report_missing_head(self) -> None:
        """Adds a loss if the log of a session lacks its metadata or its scenario."""
        survey = self._survey
        has_metadata = SESSION in survey.metadata
        if not self.is_session_log or (has_metadata and SCENARIO in survey.attachments):
            return
        loss = "the scenario" if has_metadata else "the session's metadata"
        if survey.is_foreign_session:
            loss += ", in whose place are those of another session"
        advice = ""
        # Only the metadata state the hash by which a scenario file can be recognised.
        if has_metadata:
            advice = (
                f". If the scenario file of the run lies beside the log as {SCENARIO}, recover "
                "restores it"
            )
        # The most important loss comes first, because lists show only the first losses.
        self._result.lost.insert(0, f"{loss}; {_UNOPENED}{advice}")

    def _finish(self) -> None:
        """Finishes the new file and the result of the recovery, after all messages are copied.

        The following are written at the end of the new file:

        - the accounts: how many messages of each channel are in the new file, and how many are
          missing (only if the source is the log of a session with a readable scenario),
        - the facts about the recovery: the name of the source, the losses, and whether the
          source matched its digests, the checksums of its contents,
        - digests of the new file, which reveal later modifications (only with accounts),
        - the index and the end mark of the MCAP format.
        """
        result = self._result
        accounts = self._accounts
        source_metadata = self._survey.metadata
        result.finished = self._scanner.finished
        result.messages = self._out.messages
        result.duration_s = self._out.duration_s
        if SESSION in source_metadata:
            result.chain = self._judge_source_chain()

        if accounts is not None:
            result.missing = list(accounts.describe_missing())
            # If a log is divided into parts, the sites may end in a later part.
            is_finished_part = result.finished and PART in source_metadata
            if not is_finished_part:
                result.missing += accounts.describe_unfinished_sites()
            result.coverage = accounts.coverage()
            source_accounts = source_metadata.get(ACCOUNTS, {})
            if self._contradicts_accounts(accounts, source_accounts):
                # Records were removed or added, even if the digests of the source agree.
                result.chain = DigestState.CHANGED
            # The names of other counts, such as those of dropped messages, are not topics. They
            # cannot be computed from the messages, and are copied from the source.
            other_counts = {
                name: text for name, text in source_accounts.items() if not name.startswith("/")
            }
            self._out.add_metadata(ACCOUNTS, {**accounts.format_accounts(), **other_counts})

        self._out.add_metadata(RECOVERED, result.facts())
        if accounts is not None:
            # Without accounts, the digests of the source were copied, if there are any.
            self._out.close_digest()
        self._out.finish()

    def _contradicts_accounts(
        self, accounts: SessionAccounts, source_accounts: Mapping[str, str]
    ) -> bool:
        """Returns True if the message counts in the source differ from those of its records.

        They can be compared only if the source is a finished log in one file with no losses.
        Otherwise the counts may include records that the new file lacks.

        Args:
            accounts: Counts computed from the copied messages.
            source_accounts: Maps each topic to the counts stated in the source.
        """
        is_complete = self._scanner.finished and self._result.lossless
        if not is_complete or PART in self._survey.metadata:
            return False
        for topic, text in accounts.format_accounts().items():
            if not topic.endswith(f"/{topics.STATE}"):
                continue
            source_counts = Account.parse_counts(source_accounts.get(topic, ""))
            if source_counts not in ({}, Account.parse_counts(text)):
                return True
        return False

    def _judge_source_chain(self) -> DigestState:
        """Compares the source with the digests that it states, to reveal later modifications.

        A log states two digests (checksums): one of its messages, and one of its metadata and
        the definitions of its schemas and channels. Both are compared.

        A definition is stored twice: among the data, and in the summary at the end of the file.
        If it was damaged among the data, but is intact in the summary, the second digest
        differs, although no message was changed. The recovery then uses the intact definition,
        so the source counts as damaged (OPEN) rather than modified by somebody.

        Returns:
            The result, see `DigestState`. Also OPEN if the file lacks its magic bytes.
        """
        has_first_mark = self._scanner.begins
        if not has_first_mark:
            return DigestState.OPEN
        state = self._reader.judge_digest().state
        is_only_definition_damaged = (
            self._survey.is_redefined and self._reader.agrees_on_messages
        )
        if state is DigestState.CHANGED and is_only_definition_damaged:
            return DigestState.OPEN
        return state


_LAST_NS = (1 << 64) - 1
"""Latest possible time of a message, in ns, because times have 64 bits."""


def _parse_message_head(content: bytes) -> tuple[int, int, int, int]:
    """Decodes the header of an MCAP message, with times in ns.

    Returns the channel number, sequence number, arrival time and sending time.

    Raises:
        UnreadableRecord: The message is too short.
    """
    if len(content) < mcap_records.MESSAGE_HEAD.size:
        raise UnreadableRecord("a message is shorter than its header")
    number, sequence, log_ns, publish_ns = mcap_records.MESSAGE_HEAD.unpack_from(content)
    return number, sequence, log_ns, publish_ns


def _create_content_check(
    survey: RecoverySurvey, accounts: SessionAccounts | None
) -> ContentCheck | None:
    """Creates a check that recognises intact messages by their content.

    Used where a damaged file has no checksum.

    Args:
        survey: Survey of the source file.
        accounts: Accounts of the source. None if the source has no session or no scenario.

    Returns:
        The check, or None if there are no accounts.
    """
    if accounts is None:
        return None
    scenario = parse_embedded(survey.attachments[SCENARIO].decode(), SCENARIO)
    is_continued = survey.metadata.get(PART, {}).get("index", "1") != "1"
    return ContentCheck(scenario, survey.metadata[SESSION], is_continued=is_continued)
