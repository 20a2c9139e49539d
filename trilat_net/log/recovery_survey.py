"""First look at a damaged file: what describes it, and which of its chunks stand where they
were written.

Invariant:
- Of two definitions of a number, the one covered by a valid checksum wins, else the first.
- Of several sessions and scenarios in a file those count that name each other; one whose epoch
  contradicts all messages with a checksum is of another log, and does not count. In virtual
  time, where the epoch is 0, the boots of the messages tell.
- A chunk whose checksum is right may still be old, of another file, or in the wrong place. In a
  finished file the index tells, which has a checksum of its own; in a log that was not finished
  the times of the chunks do, which never go back.
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
    """Contents of a file besides messages, wherever they are.

    Args:
        scanner: finds its records.

    Attributes:
        profile, library: the MCAP profile, and what made the file.
        definitions: schemas and channels outside of chunks.
        metadata: the last of each name; of sessions the one that names the scenario.
        attachments: the first of each name; of scenarios the one that the session names.
        count: how many messages the file states; None if no checksum covers that.
        is_redefined: True if a definition among the data is not what the index says, which has
            a checksum.
        is_foreign_session: True if the session that the file names is not that of its messages.
        misplaced: what is wrong with chunks that are not where they were written, by offset.
        is_chunked: True if the file has chunks.
        is_session_log: True if anything says that it is a log of a session.
        why_empty: the reason if there is nothing to save; else "".
    """

    def __init__(self, scanner: mcap_records.RecordScanner) -> None:
        self.profile = self.library = ""
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.count: int | None = None
        self._scanner = scanner
        self._sessions: list[tuple[dict[str, str], int]] = []  # and where they stand
        self._scenarios: list[tuple[bytes, bool]] = []  # and whether a checksum covers it
        self._chunks: list[tuple[RecordFrame, ChunkHead]] = []
        self._indexes: dict[int, Any] = {}  # of chunks, by offset
        footer = scanner.footer()
        is_covered = (
            footer is not None and footer.summary_crc and scanner.is_summary_intact(footer)
        )
        summary_offset = (
            footer.summary_start if footer is not None and is_covered else 0
        ) or scanner.size
        # in the summary or not
        found: dict[tuple[bool, int], list[Definition]] = defaultdict(list)
        self._places: dict[Definition, int] = {}  # of definitions that no checksum covers
        has_messages = False
        for frame in scanner.frames():
            has_messages |= frame.opcode in (Opcode.CHUNK, Opcode.MESSAGE)
            if frame.opcode in mcap_records.DEFINITIONS:
                entry = frame.opcode, scanner.content(frame)
                found[frame.offset >= summary_offset, frame.opcode].append(entry)
                if frame.offset < summary_offset:
                    self._places.setdefault(entry, frame.offset)
            elif frame.opcode == Opcode.CHUNK:
                self._chunks.append((frame, scanner.head(frame)))
            elif frame.opcode in _DESCRIBING:
                with suppress(UnreadableRecord):
                    self._take(frame, scanner.content(frame))
        if summary_offset == scanner.size:
            self.count = None
            self._indexes = {}
        self.definitions = [
            entry
            for kind in mcap_records.DEFINITIONS
            for entry in found[True, kind] or found[False, kind]
        ]
        for kind in mcap_records.DEFINITIONS:
            for entry in found[True, kind]:
                self._places.pop(entry, None)
        self.is_redefined = any(
            found[True, kind] and not set(found[False, kind]) <= set(found[True, kind])
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

    def _take(self, frame: RecordFrame, content: bytes) -> None:
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
                self._indexes[record.chunk_start_offset] = record
            case _:
                if record.name == SCENARIO and mcap_records.has_right_crc(content):
                    is_covered = content[-4:] != bytes(4)
                    self._scenarios.append((record.data, is_covered))
                self.attachments.setdefault(record.name, record.data)

    def _choose_session(self) -> None:
        """Chooses the session and the scenario that belong together.

        A scenario that no session names counts if a checksum covers it: one of 0 covers
        nothing, and a page that was zeroed leaves it behind.
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
        """Compares the first chunks that have messages with the session that the file names.

        A chunk without a checksum tells that the file is a log, but nothing against its
        session.
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
        """Leaves out a session of another log, its scenario, and its channels unless a checksum
        covers them.

        Args:
            session: metadata of that session.
            is_renamed: False if the session of the messages may have the same name; then the
                channels that are left out are those that stand in the same page.
        """
        self.is_foreign_session = True
        pages = {offset // PAGE_BYTES for entry, offset in self._sessions if entry == session}
        del self.metadata[SESSION]
        self.attachments.pop(SCENARIO, None)
        names = f"/{topics.ROOT}/{session.get('session', '')}/".encode()

        def is_own(entry: Definition) -> bool:
            offset = self._places.get(entry)
            is_near = is_renamed or (offset is not None and offset // PAGE_BYTES in pages)
            return offset is None or names not in entry[1] or not is_near

        self.definitions = list(filter(is_own, self.definitions))

    def _find_misplaced_chunks(self) -> dict[int, str]:
        if self._indexes:
            return self._find_unnamed_chunks()
        misplaced = {}
        if SESSION in self.metadata:  # files of other programs may be in any order
            ordered = _find_longest_ordered(
                [(head.start_ns, head.end_ns) for _, head in self._chunks]
            )
            for place, (frame, _) in enumerate(self._chunks):
                if place not in ordered:
                    misplaced[frame.offset] = (
                        "a chunk that is older or newer than those around it"
                    )
        return misplaced

    def _find_unnamed_chunks(self) -> dict[int, str]:
        """Returns the chunks that the index does not name; in a file that was shifted places do
        not count.
        """
        unnamed = []
        left = Counter(_chunk_measures(index) for index in self._indexes.values())
        for frame, head in self._chunks:
            index = self._indexes.get(frame.offset)
            sizes = frame.size, head.size
            if index is not None and sizes == (index.chunk_length, index.uncompressed_size):
                left[_chunk_measures(index)] -= 1
            else:
                unnamed.append((frame, head))
        misplaced = {}
        for frame, head in unnamed:
            measures = frame.size, head.size, head.start_ns, head.end_ns
            if left[measures] > 0:
                left[measures] -= 1
            else:
                misplaced[frame.offset] = "a chunk that the index of the file does not name"
        return misplaced


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
    times = index.message_start_time, index.message_end_time
    return index.chunk_length, index.uncompressed_size, *times


def _find_longest_ordered(spans_ns: Sequence[tuple[int, int]]) -> set[int]:
    """Returns the places of the longest sequence of spans of time of which each is later than
    the one before.

    That is patience sorting. Equal spans are of a chunk that stands in the file twice.
    """
    ends: list[tuple[int, int]] = []  # the earliest end of a sequence, by its length
    places: list[int] = []  # where that sequence ends
    before: list[int] = []  # of each place the place before it in its sequence, -1 for none
    for place, span_ns in enumerate(spans_ns):
        length = bisect_left(ends, span_ns)
        before.append(places[length - 1] if length else -1)
        ends[length : length + 1] = [span_ns]
        places[length : length + 1] = [place]
    ordered = set()
    place = places[-1] if places else -1
    while place >= 0:
        ordered.add(place)
        place = before[place]
    return ordered
