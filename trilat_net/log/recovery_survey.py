"""Surveys a damaged MCAP file before its messages are recovered.

The survey collects everything in the file except the messages: the metadata of the session, the
scenario, the definitions of the channels and the index. Since a damaged disk or a damaged copy
may contain parts of other files, the survey also decides which parts belong together, and lists
the chunks (compressed blocks of messages) that are not in their original places.

Invariant:
    - If a schema or channel is defined twice with the same number, the definition with a valid
      checksum is used. Without a checksum, the first definition is used.
    - If a file contains several sessions and scenarios, the survey selects a session and a
      scenario that refer to each other. A session whose start time contradicts all messages
      with a checksum belongs to another log and is rejected. In simulated time, where all
      sessions start at 0, the numbers that identify the starts of the sites are compared
      instead.
    - A chunk with a valid checksum may still be outdated, from another file, or in the wrong
      place. In a finished file, the index shows which chunks belong to it. In an unfinished
      file, the times of the chunks show this, because they never decrease. The index has its
      own checksum.
"""

import hashlib
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode

from ..files import reading
from ..net import topics
from . import mcap_records
from .content_check import MessageOrigins
from .log_layout import ACCOUNTS, PART, SCENARIO, SESSION
from .mcap_records import ChunkHead, RecordFrame, UnreadableRecord
from .torn_chunk import PAGE_BYTES

Definition = tuple[int, bytes]
"""Record that defines a schema or a channel, as its opcode and content."""
_PROGRAM = "trilat-net"
_TOPIC_ROOT = f"/{topics.ROOT}/".encode()
_SAMPLED_CHUNKS = 16
"""Number of chunks at the start of the file whose messages are compared with the session."""


class RecoverySurvey:
    """Everything in a damaged file except its messages: metadata, definitions and chunks.

    The recovery creates this object before it copies the messages to a new file.

    Args:
        scanner: Scanner that finds the records of the file.

    Attributes:
        is_finished: True if the file has an end mark.
        trailing_bytes: Number of bytes after the end mark.
        profile: Profile in the header of the MCAP file.
        library: Program that wrote the file, as stated in the header.
        definitions: Schemas and channels that are defined outside of chunks.
        metadata: Maps the name of each metadata record to its contents. If a name occurs
            repeatedly, the last entry counts. If there are several sessions, the one that names
            the scenario counts.
        attachments: Maps the name of each attachment to its contents. If a name occurs
            repeatedly, the first entry counts. If there are several scenarios, the one named by
            the session counts.
        count: Number of messages stated in the file. None if it is not covered by a valid
            checksum.
        is_redefined: True if a definition among the data differs from the one in the summary at
            the end of the file, which is covered by a checksum.
        is_foreign_session: True if the file names a session other than that of its messages.
        misplaced: Maps the offset of each chunk that is not in its original place to a
            description of the problem.
        is_chunked: True if the file contains chunks.
        is_session_log: True if anything in the file shows that it is the log of a session.
        why_empty: Reason why there is nothing to recover. Empty if something can be recovered.
    """

    def __init__(self, scanner: mcap_records.RecordScanner) -> None:
        """Reads a damaged file once, and selects the parts that belong to one log."""
        self.profile = ""
        self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.definitions: list[Definition] = []
        self.count: int | None = None
        self._scanner = scanner
        # Sessions as (metadata, offset in the file).
        self._sessions: list[tuple[dict[str, str], int]] = []
        # Scenarios as (text, True if a checksum covers the text).
        self._scenarios: list[tuple[bytes, bool]] = []
        self._chunks: list[tuple[RecordFrame, ChunkHead]] = []
        # Entries of the index, by the offset of the chunk.
        self._chunk_indexes: dict[int, Any] = {}
        # Offsets of the definitions that no checksum covers.
        self._uncovered_offsets: dict[Definition, int] = {}

        has_messages = self._read_records()
        # The scanner knows the end of the file once it has read all records.
        self.is_finished = scanner.finished
        self.trailing_bytes = scanner.trailing
        self.is_session_log = (
            any(_TOPIC_ROOT in content for _, content in self.definitions)
            or _PROGRAM in self.library
            or bool({SESSION, PART, ACCOUNTS} & self.metadata.keys())
        )
        self._choose_session()
        self.is_foreign_session = False
        self._judge_messages()
        self.misplaced = self._find_misplaced_chunks()

        is_torn_chunk = (
            scanner.torn is not None and scanner.read(scanner.torn.offset, 1) == _CHUNK_BYTE
        )
        self.is_chunked = bool(self._chunks) or is_torn_chunk
        self.why_empty = ""
        if not (has_messages or is_torn_chunk or self.metadata or self.attachments):
            self.why_empty = self._explain_empty()

    @classmethod
    def of_unfinished_file(cls, path: Path) -> "RecoverySurvey | None":
        """Surveys what can be recovered from a file whose end is missing or damaged.

        Args:
            path: Path of the file.

        Returns:
            The survey, or None if the file ends properly.

        Raises:
            LogError: The file cannot be read.
        """
        with reading(path) as stream:
            scanner = mcap_records.RecordScanner(stream)
            if scanner.ends:
                return None
            # The scan for intact records takes longer than that for the end.
            return cls(scanner)

    def _read_records(self) -> bool:
        """Reads all records of the damaged file except messages, such as schemas and channels.

        Returns:
            True if the file contains messages or chunks.
        """
        scanner = self._scanner
        summary_offset = _find_intact_summary(scanner)
        # Schemas and channels, by (True in the summary, opcode).
        definitions_by_kind: dict[tuple[bool, int], list[Definition]] = defaultdict(list)
        has_messages = False
        for record in scanner.scan():
            if isinstance(record, mcap_records.Damage):
                continue  # the copying step reports the damage
            frame = record.frame
            has_messages |= frame.opcode in (Opcode.CHUNK, Opcode.MESSAGE)
            if frame.opcode in mcap_records.DEFINITIONS:
                entry = frame.opcode, record.content
                is_in_summary = frame.offset >= summary_offset
                definitions_by_kind[is_in_summary, frame.opcode].append(entry)
                if not is_in_summary:
                    self._uncovered_offsets.setdefault(entry, frame.offset)
            elif frame.opcode == Opcode.CHUNK:
                self._chunks.append((frame, record.head()))
            elif frame.opcode in _DESCRIBING:
                with suppress(UnreadableRecord):
                    self._read_description(frame, record.content)
        self._choose_definitions(definitions_by_kind)

        if summary_offset == scanner.size:
            # The summary is missing or damaged, so its statements are not used.
            self.count = None
            self._chunk_indexes = {}
        return has_messages

    def _choose_definitions(
        self, definitions_by_kind: dict[tuple[bool, int], list[Definition]]
    ) -> None:
        """Chooses between the definitions in the summary and those among the data.

        The definitions in the summary are preferred, because they are covered by a checksum.

        Args:
            definitions_by_kind: Maps (True if in the summary, opcode) to definitions.
        """
        self.is_redefined = False
        for kind in mcap_records.DEFINITIONS:
            in_summary = definitions_by_kind[True, kind]
            among_data = definitions_by_kind[False, kind]
            self.definitions += in_summary or among_data
            for entry in in_summary:
                self._uncovered_offsets.pop(entry, None)
            if in_summary and not set(among_data) <= set(in_summary):
                self.is_redefined = True

    def _explain_empty(self) -> str:
        """Returns the reason why the file contains nothing to recover."""
        if self._scanner.begins:
            return "it contains no messages"
        if not self._scanner.size:
            return "it is empty"
        return "it does not begin with the mark of MCAP"

    def _read_description(self, frame: RecordFrame, content: bytes) -> None:
        """Stores the content of a record that describes the file.

        Such a record is a header, metadata, an attachment, the statistics or an entry of the
        chunk index. A damaged file may contain several sessions and scenarios. All of them are
        collected, and `_choose_session` chooses later. Among other attachments with the same
        name, the first one counts.

        Args:
            frame: Position of the record.
            content: Content of the record.

        Raises:
            UnreadableRecord: The content cannot be decoded.
        """
        record = mcap_records.parse_record(frame.opcode, content)
        match frame.opcode:
            case Opcode.HEADER:
                self.profile = record.profile
                self.library = record.library
            case Opcode.METADATA:
                self.metadata[record.name] = record.metadata
                if record.name == SESSION:
                    self._sessions.append((record.metadata, frame.offset))
            case Opcode.STATISTICS:
                self.count = record.message_count
            case Opcode.CHUNK_INDEX:
                self._chunk_indexes[record.chunk_start_offset] = record
            case _:  # an attachment, the only other kind in `_DESCRIBING`
                if record.name == SCENARIO and mcap_records.has_right_crc(content):
                    # The last 4 bytes are the checksum. A checksum of 0 covers nothing.
                    is_covered = content[-4:] != bytes(4)
                    self._scenarios.append((record.data, is_covered))
                self.attachments.setdefault(record.name, record.data)

    def _choose_session(self) -> None:
        """Chooses the session and the scenario that belong together.

        The metadata of a session contain the SHA-256 hash of its scenario. The first session
        whose scenario is in the file is chosen, together with that scenario.

        If there is no such pair, the first session and the first scenario that are covered by a
        checksum are chosen. A checksum of 0 covers nothing, because a page of zeros may have
        replaced the original page of the file.
        """
        self.attachments.pop(SCENARIO, None)
        scenarios_by_digest = {
            hashlib.sha256(text).hexdigest(): text for text, _ in self._scenarios
        }
        for session, _ in self._sessions:
            digest = session.get("scenario_sha256", "")
            if digest in scenarios_by_digest:
                self.metadata[SESSION] = session
                self.attachments[SCENARIO] = scenarios_by_digest[digest]
                return

        covered_scenarios = [text for text, is_covered in self._scenarios if is_covered]
        if covered_scenarios:
            self.attachments[SCENARIO] = covered_scenarios[0]
        if self._sessions:
            first_session, _ = self._sessions[0]
            self.metadata[SESSION] = first_session

    def _judge_messages(self) -> None:
        """Removes the session that the file names, if the messages belong to another session.

        The messages of the first chunks are decoded. Their epoch (start time) and the boots of
        their senders, which identify the starts of the processes, show which session they
        belong to. Only chunks with a checksum are evidence against the named session. Any chunk
        may show that the file is the log of a session at all.

        If the epochs differ, the named session is a different one, usually with a different
        name. If only the boots differ, as in simulated time, where all epochs are 0, the two
        sessions may have the same name.
        """
        covered_origins = MessageOrigins(set(), set())
        for frame, head in self._chunks[:_SAMPLED_CHUNKS]:
            with suppress(UnreadableRecord):
                data = mcap_records.unpack_chunk(self._scanner.content(frame))
                origins = MessageOrigins.find(data)
                self.is_session_log |= bool(origins.boots) or _names_session(data)
                has_checksum = bool(head.crc)
                if has_checksum:
                    covered_origins.epochs_ns.update(origins.epochs_ns)
                    covered_origins.boots.update(origins.boots)

        named_session = self.metadata.get(SESSION, {})
        if not named_session:
            return
        epochs = set(map(str, covered_origins.epochs_ns))  # metadata contain texts
        has_other_epoch = bool(epochs) and named_session.get("epoch_unix_ns", "") not in epochs
        if has_other_epoch:
            self._reject_session(named_session, is_renamed=True)
        elif covered_origins.are_foreign(named_session):
            self._reject_session(named_session, is_renamed=False)

    def _reject_session(self, session: dict[str, str], *, is_renamed: bool) -> None:
        """Removes from the survey a session that belongs to another log than the messages.

        This happens if a damaged disk has overwritten a page of the file with a page of another
        file. A page is a block of `PAGE_BYTES` that is always overwritten as a unit. The
        foreign page contains the metadata of its session, and may contain definitions of its
        channels. These definitions and the scenario are removed too. A definition that is
        covered by a checksum is genuine and is kept.

        Args:
            session: Metadata of the foreign session.
            is_renamed: True if the session of the messages has another name. All definitions of
                channels with the name of the foreign session are then foreign. If the names may
                be equal, only definitions in the same page as the foreign metadata are removed.
        """
        self.is_foreign_session = True
        foreign_pages = {
            offset // PAGE_BYTES for metadata, offset in self._sessions if metadata == session
        }
        del self.metadata[SESSION]
        self.attachments.pop(SCENARIO, None)
        # The topic of each channel of the session begins with this prefix. The definition of a
        # channel contains the topic, encoded in UTF-8.
        topic_prefix = f"/{topics.ROOT}/{session.get('session', '')}/".encode()

        def is_genuine(definition: Definition) -> bool:
            """Returns True if a definition may belong to the session of the messages.

            This holds for every definition that is covered by a checksum, and for every
            definition that does not name the foreign session. It holds for any other definition
            only if both sessions may have the same name and the definition is not in a page
            with foreign metadata.
            """
            offset = self._uncovered_offsets.get(definition)
            if offset is None:  # a checksum covers the definition
                return True
            _opcode, content = definition
            has_foreign_name = topic_prefix in content
            is_in_foreign_page = offset // PAGE_BYTES in foreign_pages
            is_foreign = has_foreign_name and (is_renamed or is_in_foreign_page)
            return not is_foreign

        self.definitions = list(filter(is_genuine, self.definitions))

    def _find_misplaced_chunks(self) -> dict[int, str]:
        """Finds chunks of a damaged file that are in the wrong place.

        Returns:
            Maps the offset of each such chunk to a description of the problem.
        """
        if self._chunk_indexes:
            return self._find_unnamed_chunks()
        if SESSION not in self.metadata:
            # Other programs may write chunks in any order.
            return {}
        spans_ns = [(head.start_ns, head.end_ns) for _, head in self._chunks]
        ordered = _find_longest_ordered(spans_ns)
        return {
            frame.offset: "a chunk that is older or newer than those around it"
            for index, (frame, _) in enumerate(self._chunks)
            if index not in ordered
        }

    def _find_unnamed_chunks(self) -> dict[int, str]:
        """Finds the chunks that are not listed in the index of the file.

        Such a chunk may come from an older file in the same part of the disk. If bytes were
        inserted or removed, chunks have other offsets than the index states. A chunk is
        therefore also accepted if the index lists a missing chunk with the same sizes and times
        at another offset.

        Returns:
            Maps the offset of each such chunk to a description of the problem.
        """
        unmatched_entries = Counter(
            _chunk_measures(index) for index in self._chunk_indexes.values()
        )
        candidates = []
        for frame, head in self._chunks:
            index = self._chunk_indexes.get(frame.offset)
            sizes = frame.size, head.size
            if index is not None and sizes == (index.chunk_length, index.uncompressed_size):
                unmatched_entries[_chunk_measures(index)] -= 1
            else:
                candidates.append((frame, head))

        misplaced = {}
        for frame, head in candidates:
            measures = frame.size, head.size, head.start_ns, head.end_ns
            if unmatched_entries[measures] > 0:
                unmatched_entries[measures] -= 1
            else:
                misplaced[frame.offset] = "the index of the file does not name this chunk"
        return misplaced


def _find_intact_summary(scanner: mcap_records.RecordScanner) -> int:
    """Returns the offset of the summary at the end of an MCAP file, if its checksum is valid.

    Returns the size of the file if the summary is missing or damaged.
    """
    footer = scanner.footer()
    if footer is None or not footer.summary_crc or not scanner.is_summary_intact(footer):
        return scanner.size
    return footer.summary_start or scanner.size


def _names_session(data: bytes) -> bool:
    """Returns True if an uncompressed chunk defines a channel of a session."""
    records = mcap_records.iterate_records(data)
    return any(
        opcode == Opcode.CHANNEL and _TOPIC_ROOT in data[begin:end]
        for opcode, begin, end in records
    )


_CHUNK_BYTE = bytes([Opcode.CHUNK])
_DESCRIBING = frozenset(
    {Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT, Opcode.STATISTICS, Opcode.CHUNK_INDEX}
)


def _chunk_measures(index: Any) -> tuple[int, int, int, int]:
    """Returns the sizes and times of a chunk, as stated in an entry of the index."""
    return (
        index.chunk_length,
        index.uncompressed_size,
        index.message_start_time,
        index.message_end_time,
    )


def _find_longest_ordered(spans_ns: Sequence[tuple[int, int]]) -> set[int]:
    """Finds the longest increasing sequence in a list of time spans.

    The chunks of a log are in chronological order, so a chunk outside of the sequence is
    probably in the wrong place. The method is patience sorting, with O(K log K) comparisons for
    K spans. The sequence is strictly increasing, because equal spans belong to a chunk that the
    file contains twice.

    Args:
        spans_ns: First and last time of each chunk, in ns.

    Returns:
        The indices of the spans that belong to the sequence.
    """
    # Entry n of both lists: the last span, and its index, of the increasing sequence of length
    # n + 1 that ends earliest.
    last_spans: list[tuple[int, int]] = []
    last_indices: list[int] = []
    # For each index, the index before it in its sequence. It is -1 for the first one.
    predecessors: list[int] = []
    for index, span_ns in enumerate(spans_ns):
        length = bisect_left(last_spans, span_ns)
        predecessors.append(last_indices[length - 1] if length else -1)
        last_spans[length : length + 1] = [span_ns]
        last_indices[length : length + 1] = [index]

    indices_in_sequence = set()
    index = last_indices[-1] if last_indices else -1
    while index >= 0:
        indices_in_sequence.add(index)
        index = predecessors[index]
    return indices_in_sequence
