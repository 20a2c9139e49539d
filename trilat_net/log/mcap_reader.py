"""Reader of an MCAP file, chunk by chunk; contents of a trilat-net log by topic.

Invariant: the reader holds one chunk at a time; what it cannot read it skips and reports.
Messages of a log stay bytes until they are decoded. Channels for viewers (`/viz`) are skipped.
A channel that would take the memory of all ends where its share does, and the others are read.
"""

import math
from array import array
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..errors import LogError, ScenarioError, count_nouns
from ..net import topics
from ..scenario import parse_embedded
from . import mcap_records
from .log_layout import CHANNEL_TYPES, PART, SCENARIO, SESSION
from .running_digest import DIGESTS, Integrity, RunningDigest

_READ = {
    *mcap_records.DEFINITIONS,
    Opcode.CHUNK,
    Opcode.MESSAGE,
    Opcode.METADATA,
    Opcode.ATTACHMENT,
    Opcode.HEADER,
}
"""Records that are read; indexes are of no use to a reader of the whole file."""

KEPT_BYTES = 64 << 20
KEPT_RATIO = 300
CHANNEL_SHARE = 1 / 3
"""Messages that are kept take at most so much memory, or so many times the file's size; a
channel its share.

Arms at rest in virtual time pack best of all that is no bomb: 120 times.
"""
_DECODED_BYTES = 3_000
_LONG_BYTES = 300
_LONG_RATIO = 24
"""A message of a log, decoded, takes some memory, and more if it is longer than a record must
be.
"""
_NAME_BYTES = 600
_NAME_RATIO = 20
"""What a channel and its metadata take, likewise."""

Progress = Callable[[int, int], None]
"""Takes how much of something is done: (bytes so far, bytes in all)."""
Watch = Callable[[mcap_records.RecordFrame, bytes, bytes], None]
"""Takes a record of a file: its place, its content, and what a chunk holds (empty if it is
unreadable).
"""


def shift_progress(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Returns the progress of one file as a part of `total` bytes, of which `before` were done."""
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)


class ChannelInfo(NamedTuple):
    """A channel as its file describes it; `schema` is the name of its messages' schema, "" for
    none.
    """

    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    metadata: dict[str, str]
    schema_data: bytes = b""


class McapMessage(NamedTuple):
    """One message.

    Attributes:
        topic: of its channel; "" if the file never named it.
        payload: its bytes, as published.
        log_time_ns: when it came, Unix ns.
        publish_time_ns: when it was sent, by its own stamp, Unix ns.
        sequence: its number, modulo 2^32.
    """

    topic: str
    payload: bytes
    log_time_ns: int
    publish_time_ns: int
    sequence: int


class McapReader:
    """One pass over a file.

    Args:
        stream: the file, opened for reading.
        name: its name in errors.
        progress: called after every record of the file.
        kept: True if the caller keeps the messages: then what they take, decoded, is limited
            (`KEPT_RATIO`).

    Attributes:
        metadata, attachments: what was seen of them so far, by name.
        channels: channels seen so far, by topic; the first definition of one holds.
        library: what wrote the file, as its header states.
        chunks: chunks read so far, by compression ("" for none).
        packed_bytes, unpacked_bytes: what they take in the file, and unpacked.
        size: bytes of the file.
        offset: first byte of the record of the file that is being read.
        complete: True once all was read, to the end mark's last byte: the file was finished.
        scanner: finds its records.
        watch: takes every record of the file before its messages, if it is set. It goes on
            where the reader gives up, after `MAX_DAMAGED_PARTS`, and takes a file that begins
            otherwise as well.
    """

    def __init__(
        self,
        stream: BinaryIO,
        name: str,
        progress: Progress | None = None,
        *,
        kept: bool = True,
    ) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.channels: dict[str, ChannelInfo] = {}
        self.library = ""
        self.chunks: Counter[str] = Counter()
        self.packed_bytes = self.unpacked_bytes = 0
        self.offset = 0
        self.complete = False
        self._chain = RunningDigest()
        self.scanner = mcap_records.RecordScanner(stream)
        self.size = self.scanner.size
        self._source = name
        self._progress = progress
        self.watch: Watch | None = None
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._topics: dict[int, str] = {}
        self._ours: set[int] = set()
        self._room = max(KEPT_BYTES, KEPT_RATIO * self.size) if kept else None
        share = math.inf if self._room is None else CHANNEL_SHARE * self._room
        # what is left, by channel
        self._shares: defaultdict[int, float] = defaultdict(lambda: share)
        self._more_damage: list[mcap_records.Damage] = []

    @property
    def damaged(self) -> list[mcap_records.Damage]:
        """Parts that could not be read, so far, and channels that were read in part."""
        return self.scanner.damaged + self._more_damage

    @property
    def torn(self) -> mcap_records.Damage | None:
        """The end that was cut off; None in a finished file, and before it was reached."""
        return self.scanner.torn

    def messages(self) -> Iterator[McapMessage]:
        """Yields every message in file order.

        Raises:
            LogError: the file is no MCAP file, or holds absurdly much for its size.
        """
        scanner = self.scanner
        if not scanner.begins and self.watch is None:
            empty = "is empty" if not self.size else "does not begin as one does"
            raise LogError(f"{self._source}: is no MCAP file: it {empty}")
        for frame in scanner.frames():
            self.offset = frame.offset
            if frame.opcode in _READ or self.watch is not None:
                try:
                    yield from self._read_records(self._open(frame), frame)
                except mcap_records.UnreadableRecord as error:
                    found = scanner.damaged if self.watch is None else self._more_damage
                    found.append(mcap_records.Damage(frame.offset, frame.size, str(error)))
            if self._progress is not None:
                self._progress(frame.end, self.size)
        self.complete = scanner.finished and not self._gave_up

    @property
    def _gave_up(self) -> bool:
        return self.watch is not None and len(self.damaged) >= mcap_records.MAX_DAMAGED_PARTS

    def _open(self, frame: mcap_records.RecordFrame) -> bytes:
        content = self.scanner.content(frame)
        data = b""
        try:
            if frame.opcode in _READ and not self._gave_up:
                data = self._unpack(frame, content)
        finally:
            if self.watch is not None:
                self.watch(frame, content, data)
        return data

    def _unpack(self, frame: mcap_records.RecordFrame, content: bytes) -> bytes:
        """Returns the records with messages and channels in a record of the file; stores other
        contents.
        """
        match frame.opcode:
            case Opcode.CHUNK:
                data = mcap_records.unpack_chunk(content)
                self.chunks[self.scanner.head(frame).compression] += 1
                self.packed_bytes += len(content)
                self.unpacked_bytes += len(data)
                return data
            case Opcode.MESSAGE | Opcode.SCHEMA | Opcode.CHANNEL:  # outside of chunks
                return mcap_records.RECORD_HEAD.pack(frame.opcode, frame.length) + content
            case Opcode.METADATA:
                entry = mcap_records.parse_record(frame.opcode, content)
                self.metadata[entry.name] = entry.metadata
                if entry.name == DIGESTS:
                    return b""
            case Opcode.ATTACHMENT:
                attachment = mcap_records.parse_record(frame.opcode, content)
                if not mcap_records.has_right_crc(content):
                    raise mcap_records.UnreadableRecord(
                        f"the attachment {attachment.name[:80]!r}: its CRC differs"
                    )
                self.attachments[attachment.name] = attachment.data
            case Opcode.HEADER:
                self.library = mcap_records.parse_record(frame.opcode, content).library
        self._chain.add_entry(frame.opcode, content)
        return b""

    def _read_records(
        self, data: bytes, frame: mcap_records.RecordFrame
    ) -> Iterator[McapMessage]:
        find_topic = self._topics.get
        ours = self._ours
        shares = self._shares
        parse_head = mcap_records.MESSAGE_HEAD.unpack_from
        head_bytes = mcap_records.MESSAGE_HEAD.size
        new = tuple.__new__  # what the class does with its arguments, in half the time
        memory = chained = messages = 0
        view = memoryview(data)
        for opcode, begin, end in mcap_records.iterate_records(data):
            if opcode == mcap_records.OP_MESSAGE:
                length = end - begin
                messages += 1
                if length < head_bytes:
                    raise mcap_records.UnreadableRecord("a message is shorter than its head")
                channel, sequence, log_time_ns, publish_time_ns = parse_head(data, begin)
                if channel in ours:
                    cost = _DECODED_BYTES
                    if length > _LONG_BYTES:
                        cost += (length - _LONG_BYTES) * _LONG_RATIO
                else:
                    cost = 100 + length
                if (left := shares[channel]) < cost:
                    self._cut_channel(channel, frame)
                    continue
                shares[channel] = left - cost
                memory += cost
                payload = data[begin + head_bytes : end]
                topic = find_topic(channel, "")
                yield new(McapMessage, (topic, payload, log_time_ns, publish_time_ns, sequence))
            elif opcode in mcap_records.DEFINITIONS:
                self._chain.add_records(
                    view[chained : begin - mcap_records.RECORD_HEAD_BYTES], 0
                )
                chained = end
                self._take_memory(_NAME_BYTES + _NAME_RATIO * (end - begin), frame)
                self._define(opcode, data[begin:end])
        self._chain.add_records(view[chained:], messages)
        self._take_memory(memory, frame)

    def judge_digest(self) -> Integrity:
        """Returns whether the file, once it was read, agrees with its digest chain."""
        return self._chain.judge(
            self.metadata, finished=self.complete, damaged=bool(self.damaged)
        )

    @property
    def agrees_on_messages(self) -> bool:
        """True if the messages that were read are all that the digest chain states, in its
        order.
        """
        stated = self.metadata.get(DIGESTS, {})
        found = self._chain.facts()
        return all(stated.get(key) == found[key] for key in ("messages", "records"))

    def _define(self, opcode: int, content: bytes) -> None:
        self._chain.add_entry(opcode, content)
        record = mcap_records.parse_record(opcode, content)
        if opcode == Opcode.SCHEMA:
            self._schemas.setdefault(record.id, (record.name, record.encoding, record.data))
        elif record.id not in self._topics:
            self._topics[record.id] = topic = record.topic
            name, encoding, data = self._schemas.get(record.schema_id, ("", "", b""))
            info = ChannelInfo(
                topic=topic,
                encoding=record.message_encoding,
                schema=name,
                schema_encoding=encoding,
                metadata=record.metadata,
                schema_data=data,
            )
            self.channels.setdefault(topic, info)
            if topic.startswith("/trilat/"):
                self._ours.add(record.id)

    def _cut_channel(self, channel: int, frame: mcap_records.RecordFrame) -> None:
        if self._shares[channel] >= 0.0:
            self._shares[channel] = -math.inf
            topic = self._topics.get(channel, f"channel {channel}")
            text = (
                f"{topic[:80]} takes absurdly much for such a file; from here on it is not read"
            )
            self._more_damage.append(mcap_records.Damage(frame.offset, frame.size, text))

    def _take_memory(self, amount: int, frame: mcap_records.RecordFrame) -> None:
        """Takes memory for what is kept; raises `LogError` if there is not so much."""
        if self._room is None:
            return
        self._room -= amount
        if self._room < 0:
            raise LogError(
                f"{self._source}: holds absurdly much for a file of "
                f"{count_nouns(self.size, 'byte')}: up to byte "
                f"{frame.end} alone it would take more than {KEPT_RATIO} times that in memory, and more than "
                f"{KEPT_BYTES >> 20} MiB"
            )


_LAST_SIGNED_NS = np.uint64((1 << 63) - 1)


@dataclass(slots=True)
class ChannelMessages:
    """The messages of one topic, in file order.

    Attributes:
        payloads: the messages as published.
        log_ns, publish_ns: when each came, and was sent by its own stamp, Unix ns.
    """

    payloads: list[bytes] = field(default_factory=list)
    log_ns: "array[int]" = field(default_factory=partial(array, "Q"))
    publish_ns: "array[int]" = field(default_factory=partial(array, "Q"))

    def add(self, payload: bytes, log_ns: int, publish_ns: int) -> None:
        """Adds one message."""
        self.payloads.append(payload)
        self.log_ns.append(log_ns)
        self.publish_ns.append(publish_ns)

    def times(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns when the messages came and when they were sent, shape (K,) each, Unix ns
        below 2^63.
        """
        stored = (np.array(times, dtype=np.uint64) for times in (self.log_ns, self.publish_ns))
        log_ns, publish_ns = (
            np.minimum(times, _LAST_SIGNED_NS).astype(np.int64) for times in stored
        )
        return log_ns, publish_ns


@dataclass
class LogContents:
    """Contents of a file, or of several that are one session's; `sources` are the files' names.

    Attributes:
        session, metadata: metadata of the session; all metadata, by name.
        scenario: text of the scenario.
        channels: messages, by topic.
        complete: True if all of it is there, finished and readable throughout; a later part
            alone is not.
        ended: True if the last one was finished.
        damaged: what cannot be read, a sentence each.
        chain: agreement with the digest chain, of several files the worst.
    """

    sources: tuple[str, ...]
    session: dict[str, str]
    scenario: bytes
    metadata: dict[str, dict[str, str]]
    channels: dict[str, ChannelMessages] = field(repr=False)
    complete: bool
    ended: bool
    damaged: list[str]
    chain: Integrity

    @property
    def source(self) -> str:
        """Its name in errors."""
        more = len(self.sources) - 1
        return self.sources[0] + (
            f" and {more} more {'parts' if more > 1 else 'part'}" if more else ""
        )


def read_contents(
    stream: BinaryIO, name: str, progress: Progress | None = None, *, own: bool = False
) -> LogContents:
    """Returns the contents of a file, called `name` in errors.

    One that this program wrote just now is its `own`: however well a run that hardly moves is
    packed, it holds no more than the run did.

    Raises:
        LogError: it is no MCAP file, or no log of trilat-net.
    """
    reader = McapReader(stream, name, progress, kept=not own)
    channels: dict[str, ChannelMessages] = {}
    taken: dict[str, ChannelMessages | None] = {}
    for topic, payload, log_ns, publish_ns, _ in reader.messages():
        try:
            channel = taken[topic]
        except KeyError:
            key = topics.parse_key(topic.removeprefix("/"))
            is_ours = key is not None and key.channel in CHANNEL_TYPES
            channel = taken[topic] = (
                channels.setdefault(topic, ChannelMessages()) if is_ours else None
            )
        if channel is not None:
            channel.add(payload, log_ns, publish_ns)
    _check_head(reader, name)
    session = reader.metadata[SESSION]
    damaged = [f"{name}: {damage}" for damage in reader.damaged]
    complete = (
        reader.complete
        and not damaged
        and reader.metadata.get(PART, {}).get("index", "1") == "1"
    )
    text = reader.attachments[SCENARIO]
    chain = reader.judge_digest()
    ended = reader.complete
    return LogContents(
        sources=(name,),
        session=session,
        scenario=text,
        metadata=reader.metadata,
        channels=channels,
        complete=complete,
        ended=ended,
        damaged=damaged,
        chain=chain,
    )


def check_log(stream: BinaryIO, name: str) -> None:
    """Reads a file once, message by message, as a reader of a log does, and keeps nothing.

    Raises:
        LogError: no command opens the file; the text says why.
    """
    reader = McapReader(stream, name)
    deque(reader.messages(), maxlen=0)
    _check_head(reader, name)
    try:
        parse_embedded(reader.attachments[SCENARIO].decode(), f"{name}: scenario")
    except (ScenarioError, UnicodeDecodeError) as error:
        raise LogError(f"{name}: its scenario cannot be read: {error}") from None


def _check_head(reader: McapReader, name: str) -> None:
    """Raises `LogError` unless a file that was read describes a session."""
    session = reader.metadata.get(SESSION, {})
    lacking = [key for key in ("session", "driver") if key not in session]
    lacking += [] if SCENARIO in reader.attachments else [SCENARIO]
    if lacking:
        why = f"damaged: {reader.damaged[0]}" if reader.damaged else reader.torn
        problem = f"{name}: is an MCAP file, but no log of trilat-net: no {lacking[0]}"
        raise LogError(f"{problem}; {why}" if why else problem)
