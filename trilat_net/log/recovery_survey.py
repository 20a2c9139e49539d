"""Survey of a damaged file before its recovery.

The survey reads the records that describe the file, and finds chunks that are not where they
were written.

Invariant:
    - Of two definitions with one number, the one that a valid checksum covers counts; otherwise
      the first one counts.
    - Of several sessions and scenarios in a file, those count that name each other. A session
      whose epoch contradicts all messages with a checksum is of another log, and does not
      count. In virtual time, where the epoch is 0, the boots of the messages decide.
    - A chunk with a right checksum may still be old, of another file, or in the wrong place. In
      a finished file, the index decides, which has a separate checksum. In a log that was not
      finished, the times of the chunks decide, which never decrease.
"""

import hashlib
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from mcap.opcode import Opcode

from ..net import topics
from . import mcap_records
from .content_check import MessageOrigins, find_origins, has_foreign_boots
from .log_layout import ACCOUNTS, PART, SCENARIO, SESSION
from .mcap_records import ChunkHead, RecordFrame, UnreadableRecord
from .torn_chunk import PAGE_BYTES

Definition = tuple[int, bytes]
"""A schema or a channel: opcode and content."""
_PROGRAM = "trilat-net"
_TOPIC_ROOT = f"/{topics.ROOT}/".encode()
_SAMPLED_CHUNKS = 16
"""Chunks whose messages are compared with the epoch of the session."""


class RecoverySurvey:
    """The contents of a file besides its messages, wherever they are in the file.

    Args:
        scanner: finds the records of the file.

    Attributes:
        profile: the MCAP profile.
        library: program that wrote the file.
        definitions: schemas and channels outside of chunks.
        metadata: the last metadata of each name; of several sessions, the one that names the
            scenario.
        attachments: the first attachment of each name; of several scenarios, the one that the
            session names.
        count: number of messages that the file states; None if no checksum covers the number.
        is_redefined: True if a definition among the data differs from that in the summary,
            which a checksum covers.
        is_foreign_session: True if the session that the file names is not that of its messages.
        misplaced: a problem for each chunk that is not where it was written, by offset.
        is_chunked: True if the file has chunks.
        is_session_log: True if anything in the file shows that it is the log of a session.
        why_empty: the reason if there is nothing to save; else "".
    """

    def __init__(self, scanner: mcap_records.RecordScanner) -> None:
        self.profile = self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.count: int | None = None
        self._scanner = scanner
        self._sessions: list[tuple[dict[str, str], int]] = []  # (metadata, offset)
        self._scenarios: list[tuple[bytes, bool]] = []  # (text, True if a checksum covers it)
        self._chunks: list[tuple[RecordFrame, ChunkHead]] = []
        self._chunk_indexes: dict[int, Any] = {}  # by offset of the chunk
        summary_offset = _find_intact_summary(scanner)
        # Schemas and channels, by (True in the summary, opcode).
        defined: dict[tuple[bool, int], list[Definition]] = defaultdict(list)
        # Offsets of the definitions that no checksum covers.
        self._uncovered_offsets: dict[Definition, int] = {}
        has_messages = False
        for frame in scanner.frames():
            has_messages |= frame.opcode in (Opcode.CHUNK, Opcode.MESSAGE)
            if frame.opcode in mcap_records.DEFINITIONS:
                entry = frame.opcode, scanner.content(frame)
                defined[frame.offset >= summary_offset, frame.opcode].append(entry)
                if frame.offset < summary_offset:
                    self._uncovered_offsets.setdefault(entry, frame.offset)
            elif frame.opcode == Opcode.CHUNK:
                self._chunks.append((frame, scanner.head(frame)))
            elif frame.opcode in _DESCRIBING:
                with suppress(UnreadableRecord):
                    self._read_description(frame, scanner.content(frame))
        if summary_offset == scanner.size:
            self.count = None
            self._chunk_indexes = {}
        self.definitions = [
            entry
            for kind in mcap_records.DEFINITIONS
            for entry in defined[True, kind] or defined[False, kind]
        ]
        for kind in mcap_records.DEFINITIONS:
            for entry in defined[True, kind]:
                self._uncovered_offsets.pop(entry, None)
        self.is_redefined = any(
            defined[True, kind] and not set(defined[False, kind]) <= set(defined[True, kind])
            for kind in mcap_records.DEFINITIONS
        )
        self.is_session_log = (
            any(_TOPIC_ROOT in content for _, content in self.definitions)
            or _PROGRAM in self.library
            or bool({SESSION, PART, ACCOUNTS} & self.metadata.keys())
        )
        self.is_chunked = bool(self._chunks)
        self._choose_session()
        self.is_foreign_session = False
        self._judge_messages()
        self.misplaced = self._find_misplaced_chunks()
        is_torn_chunk = (
            scanner.torn is not None and scanner.read(scanner.torn.offset, 1) == _CHUNK_BYTE
        )
        self.is_chunked |= is_torn_chunk
        self.why_empty = ""
        if not (has_messages or is_torn_chunk or self.metadata or self.attachments):
            self.why_empty = "it holds no messages"
            if not scanner.begins:
                self.why_empty = (
                    "it does not begin as an MCAP file does" if scanner.size else "it is empty"
                )

    def _read_description(self, frame: RecordFrame, content: bytes) -> None:
        """Reads a header, metadata, an attachment, the statistics or a chunk index."""
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
            case _:
                if record.name == SCENARIO and mcap_records.has_right_crc(content):
                    is_covered = content[-4:] != bytes(4)
                    self._scenarios.append((record.data, is_covered))
                self.attachments.setdefault(record.name, record.data)

    def _choose_session(self) -> None:
        """Chooses the session and the scenario that belong together.

        A scenario that no session names counts if a checksum covers it. A checksum of 0 covers
        nothing: a page of zeros in the file may have replaced the right one.
        """
        self.attachments.pop(SCENARIO, None)
        covered = [text for text, is_covered in self._scenarios if is_covered]
        if covered:
            self.attachments[SCENARIO] = covered[0]
        digests = {hashlib.sha256(text).hexdigest(): text for text, _ in self._scenarios}
        for session, _ in self._sessions:
            if session.get("scenario_sha256") in digests:
                self.metadata[SESSION] = session
                self.attachments[SCENARIO] = digests[session["scenario_sha256"]]
                return
        if self._sessions:
            self.metadata[SESSION], _ = self._sessions[0]

    def _judge_messages(self) -> None:
        """Compares the messages of the first chunks with the session that the file names.

        A chunk without a checksum may show that the file is a log of a session, but is no
        evidence against the session.
        """
        origins = MessageOrigins(set(), set())
        for frame, head in self._chunks[:_SAMPLED_CHUNKS]:
            with suppress(UnreadableRecord):
                data = mcap_records.unpack_chunk(self._scanner.content(frame))
                stated = find_origins(data)
                self.is_session_log |= bool(stated.boots) or _names_session(data)
                if head.crc:
                    origins.epochs_ns.update(stated.epochs_ns)
                    origins.boots.update(stated.boots)
        session = self.metadata.get(SESSION, {})
        epochs = set(map(str, origins.epochs_ns))
        if session and epochs and session.get("epoch_unix_ns", "") not in epochs:
            self._reject_session(session, is_renamed=True)
        elif session and has_foreign_boots(session, origins.boots):
            self._reject_session(session, is_renamed=False)

    def _reject_session(self, session: dict[str, str], *, is_renamed: bool) -> None:
        """Removes a session of another log, with its scenario and its uncovered channels.

        Args:
            session: metadata of the session.
            is_renamed: False if the session of the messages may have the same name; then only
                channels in the same page as the session are removed.
        """
        self.is_foreign_session = True
        pages = {offset // PAGE_BYTES for entry, offset in self._sessions if entry == session}
        del self.metadata[SESSION]
        self.attachments.pop(SCENARIO, None)
        topic_prefix = f"/{topics.ROOT}/{session.get('session', '')}/".encode()

        def is_kept(entry: Definition) -> bool:
            offset = self._uncovered_offsets.get(entry)
            if offset is None:  # a checksum covers the definition
                return True
            is_suspect = is_renamed or offset // PAGE_BYTES in pages
            return topic_prefix not in entry[1] or not is_suspect

        self.definitions = list(filter(is_kept, self.definitions))

    def _find_misplaced_chunks(self) -> dict[int, str]:
        """Returns a problem for each chunk that is not where it was written, by offset."""
        if self._chunk_indexes:
            return self._find_unnamed_chunks()
        if SESSION not in self.metadata:
            return {}  # chunks in files of other programs may be in any order
        spans_ns = [(head.start_ns, head.end_ns) for _, head in self._chunks]
        ordered = _find_longest_ordered(spans_ns)
        return {
            frame.offset: "a chunk that is older or newer than those around it"
            for index, (frame, _) in enumerate(self._chunks)
            if index not in ordered
        }

    def _find_unnamed_chunks(self) -> dict[int, str]:
        """Returns a problem for each chunk that the index does not name, by offset.

        In a file whose contents were shifted, a chunk counts as named if the index names one
        with equal sizes and times at another offset.
        """
        unnamed = []
        unmatched = Counter(_chunk_measures(index) for index in self._chunk_indexes.values())
        for frame, head in self._chunks:
            index = self._chunk_indexes.get(frame.offset)
            sizes = frame.size, head.size
            if index is not None and sizes == (index.chunk_length, index.uncompressed_size):
                unmatched[_chunk_measures(index)] -= 1
            else:
                unnamed.append((frame, head))
        misplaced = {}
        for frame, head in unnamed:
            measures = frame.size, head.size, head.start_ns, head.end_ns
            if unmatched[measures] > 0:
                unmatched[measures] -= 1
            else:
                misplaced[frame.offset] = "a chunk that the index of the file does not name"
        return misplaced


def _find_intact_summary(scanner: mcap_records.RecordScanner) -> int:
    """Returns the offset of the summary whose checksum is right, or the size of the file."""
    footer = scanner.footer()
    if footer is None or not footer.summary_crc or not scanner.is_summary_intact(footer):
        return scanner.size
    return footer.summary_start or scanner.size


def _names_session(data: bytes) -> bool:
    """True if an unpacked chunk defines a channel of a session."""
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
    """Returns the sizes and the times of a chunk, as its index states them."""
    return (
        index.chunk_length,
        index.uncompressed_size,
        index.message_start_time,
        index.message_end_time,
    )


def _find_longest_ordered(spans_ns: Sequence[tuple[int, int]]) -> set[int]:
    """Returns the indices of the longest increasing sequence of time spans.

    The method is patience sorting. Equal spans belong to a chunk that the file contains twice,
    so the sequence increases strictly.
    """
    last_spans: list[tuple[int, int]] = []  # earliest last span of a sequence, by its length
    last_indices: list[int] = []  # index of that span
    predecessors: list[int] = []  # index before each index in its sequence; -1 for the first
    for index, span_ns in enumerate(spans_ns):
        length = bisect_left(last_spans, span_ns)
        predecessors.append(last_indices[length - 1] if length else -1)
        last_spans[length : length + 1] = [span_ns]
        last_indices[length : length + 1] = [index]
    ordered = set()
    index = last_indices[-1] if last_indices else -1
    while index >= 0:
        ordered.add(index)
        index = predecessors[index]
    return ordered
