"""Reader of MCAP files, chunk by chunk, and contents of a trilat-net log by topic.

Invariant:
    - The reader holds one chunk at a time. Unreadable parts are skipped and reported.
    - Messages of a log stay bytes until they are decoded.
    - Channels for viewers (/viz) are skipped.
    - A channel whose messages would need too much memory is read up to its share of the memory;
      the other channels are read completely.
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
"""Kinds of records that are read; a reader of the whole file needs no indexes."""

KEPT_BYTES = 64 << 20
"""Memory that the kept messages of any file may take, in bytes."""
KEPT_RATIO = 300
"""The kept messages of larger files may take this many times the size of the file.

Logs of arms at rest in virtual time have the largest honest ratio, of about 120.
"""
CHANNEL_SHARE = 1 / 3
"""Largest share of that memory for one channel."""
_DECODED_BYTES = 3_000
_LONG_BYTES = 300
_LONG_RATIO = 24
"""Memory of a decoded message: _DECODED_BYTES, and for every byte of its payload beyond
_LONG_BYTES another _LONG_RATIO bytes.
"""
_NAME_BYTES = 600
_NAME_RATIO = 20
"""Memory of a channel: _NAME_BYTES, and _NAME_RATIO bytes for every byte of its record."""

Progress = Callable[[int, int], None]
"""Receives the progress of a task: (bytes done, all bytes)."""
Watch = Callable[[mcap_records.RecordFrame, bytes, bytes], None]
"""Receives a record of a file: its place, its content, and the unpacked records of a chunk.

The unpacked records are empty if the chunk is unreadable.
"""


def shift_progress(progress: Progress | None, before: int, total: int) -> Progress | None:
    """Returns a progress of one file within `total` bytes, of which `before` are done."""
    if progress is None:
        return None
    return lambda done, _: progress(before + done, total)


class ChannelInfo(NamedTuple):
    """A channel as its file describes it.

    Attributes:
        topic: topic of the channel.
        encoding: encoding of the messages.
        schema: name of the messages' schema; "" without a schema.
        schema_encoding: encoding of the schema.
        metadata: metadata of the channel.
        schema_data: content of the schema.
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
        topic: topic of its channel; "" if the file does not define the channel.
        payload: bytes of the message, as published.
        log_time_ns: arrival, Unix ns.
        publish_time_ns: sending time that the message states, Unix ns.
        sequence: number of the message, modulo 2^32.
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
        name: name of the file in errors.
        progress: called after every record of the file.
        kept: True if the caller keeps the messages: then their memory is limited, see
            `KEPT_RATIO`.

    Attributes:
        metadata, attachments: metadata and attachments read so far, by name.
        channels: channels read so far, by topic; the first definition of a channel counts.
        library: program that wrote the file, as its header states.
        chunks: number of chunks read so far, by compression ("" without compression).
        packed_bytes, unpacked_bytes: sizes of these chunks in the file, and unpacked.
        size: size of the file, in bytes.
        offset: offset of the record of the file that is being read.
        complete: True once a finished file has been read to the last byte of its end mark.
        scanner: finds the records of the file.
        watch: receives every record of the file before the messages of the record, if it is
            set. It also receives the records after `MAX_DAMAGED_PARTS` damaged parts, where
            the reader gives up, and those of a file without the mark at its beginning.
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
        self._session_channels: set[int] = set()
        # Memory that is left for all messages, and by channel, in bytes.
        self._memory_left = max(KEPT_BYTES, KEPT_RATIO * self.size) if kept else None
        share = math.inf if self._memory_left is None else CHANNEL_SHARE * self._memory_left
        self._channel_memory_left: defaultdict[int, float] = defaultdict(lambda: share)
        self._more_damage: list[mcap_records.Damage] = []

    @property
    def damaged(self) -> list[mcap_records.Damage]:
        """Parts that could not be read so far, and channels that were read only in part."""
        return self.scanner.damaged + self._more_damage

    @property
    def torn(self) -> mcap_records.Damage | None:
        """The end that was cut off; None in a finished file, and before the end is reached."""
        return self.scanner.torn

    def messages(self) -> Iterator[McapMessage]:
        """Yields every message in file order.

        Raises:
            LogError: the file is not an MCAP file, or unpacks to far too much for its size.
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
                    damaged = scanner.damaged if self.watch is None else self._more_damage
                    damaged.append(mcap_records.Damage(frame.offset, frame.size, str(error)))
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
        """Returns the messages, schemas and channels in a record of the file, unpacked.

        Metadata, attachments and the header are stored, and have no unpacked records.
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
        session_channels = self._session_channels
        memory_left = self._channel_memory_left
        parse_head = mcap_records.MESSAGE_HEAD.unpack_from
        head_bytes = mcap_records.MESSAGE_HEAD.size
        new = tuple.__new__  # twice as fast as calling the class `McapMessage`
        memory = 0
        chained = 0  # end of the part of `data` that the digest chain includes
        messages = 0
        view = memoryview(data)
        for opcode, begin, end in mcap_records.iterate_records(data):
            if opcode == mcap_records.OP_MESSAGE:
                length = end - begin
                messages += 1
                if length < head_bytes:
                    raise mcap_records.UnreadableRecord("a message is shorter than its head")
                channel, sequence, log_time_ns, publish_time_ns = parse_head(data, begin)
                if channel in session_channels:
                    cost = _DECODED_BYTES
                    if length > _LONG_BYTES:
                        cost += (length - _LONG_BYTES) * _LONG_RATIO
                else:
                    cost = 100 + length
                remaining = memory_left[channel]
                if remaining < cost:
                    self._cut_channel(channel, frame)
                    continue
                memory_left[channel] = remaining - cost
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
        """Returns the agreement of the file, once it has been read, with its digest chain."""
        return self._chain.judge(
            self.metadata, finished=self.complete, damaged=bool(self.damaged)
        )

    @property
    def agrees_on_messages(self) -> bool:
        """True if number and order of the messages read agree with the digest chain."""
        stated = self.metadata.get(DIGESTS, {})
        computed = self._chain.facts()
        return all(stated.get(key) == computed[key] for key in ("messages", "records"))

    def _define(self, opcode: int, content: bytes) -> None:
        """Stores a schema or a channel."""
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
                self._session_channels.add(record.id)

    def _cut_channel(self, channel: int, frame: mcap_records.RecordFrame) -> None:
        """Ends the reading of a channel whose share of the memory is used up."""
        if self._channel_memory_left[channel] >= 0.0:
            self._channel_memory_left[channel] = -math.inf
            topic = self._topics.get(channel, f"channel {channel}")
            text = (
                f"{topic[:80]} takes absurdly much for such a file; from here on it is not read"
            )
            self._more_damage.append(mcap_records.Damage(frame.offset, frame.size, text))

    def _take_memory(self, amount: int, frame: mcap_records.RecordFrame) -> None:
        """Subtracts memory from the memory that is left.

        Raises:
            LogError: the memory does not suffice.
        """
        if self._memory_left is None:
            return
        self._memory_left -= amount
        if self._memory_left < 0:
            raise LogError(
                f"{self._source}: holds absurdly much for a file of "
                f"{count_nouns(self.size, 'byte')}: up to byte {frame.end} alone it would take "
                f"more than {KEPT_RATIO} times that in memory, and more than "
                f"{KEPT_BYTES >> 20} MiB"
            )


_LAST_SIGNED_NS = np.uint64((1 << 63) - 1)


@dataclass(slots=True)
class ChannelMessages:
    """The messages of one topic, in file order.

    Attributes:
        payloads: the messages as published.
        log_ns: arrival of each message, Unix ns.
        publish_ns: sending time that each message states, Unix ns.
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
        """Returns the arrival and sending times, shape (K,) each, in Unix ns below 2^63."""
        return _clip_times(self.log_ns), _clip_times(self.publish_ns)


def _clip_times(times: "array[int]") -> NDArray[np.int64]:
    unsigned = np.array(times, dtype=np.uint64)
    return np.minimum(unsigned, _LAST_SIGNED_NS).astype(np.int64)


@dataclass
class LogContents:
    """Contents of a log: of one file, or of several parts.

    Attributes:
        sources: names of the files.
        session: metadata of the session.
        scenario: text of the scenario.
        metadata: all metadata, by name.
        channels: messages, by topic.
        complete: True if all parts are present, finished, and readable throughout.
        ended: True if the last part was finished.
        damaged: a sentence for every part that cannot be read.
        chain: agreement with the digest chain; of several files, the worst.
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
        """Name of the log in errors."""
        more = len(self.sources) - 1
        if not more:
            return self.sources[0]
        return f"{self.sources[0]} and {more} more {'parts' if more > 1 else 'part'}"


def read_contents(
    stream: BinaryIO, name: str, progress: Progress | None = None, *, trusted: bool = False
) -> LogContents:
    """Returns the contents of a log.

    Args:
        stream: the file, opened for reading.
        name: name of the file in errors.
        progress: called after every record of the file.
        trusted: True if this program has just written the file. Then the memory of the messages
            is not limited: however well a run at rest is packed, the file holds no more than
            the run did.

    Raises:
        LogError: the file is not an MCAP file, or not a log of trilat-net.
    """
    reader = McapReader(stream, name, progress, kept=not trusted)
    channels: dict[str, ChannelMessages] = {}
    channel_of_topic: dict[str, ChannelMessages | None] = {}  # None for skipped topics
    for topic, payload, log_ns, publish_ns, _ in reader.messages():
        try:
            channel = channel_of_topic[topic]
        except KeyError:
            key = topics.parse_key(topic.removeprefix("/"))
            channel = None
            if key is not None and key.channel in CHANNEL_TYPES:
                channel = channels.setdefault(topic, ChannelMessages())
            channel_of_topic[topic] = channel
        if channel is not None:
            channel.add(payload, log_ns, publish_ns)
    _check_head(reader, name)
    damaged = [f"{name}: {damage}" for damage in reader.damaged]
    is_first_part = reader.metadata.get(PART, {}).get("index", "1") == "1"
    return LogContents(
        sources=(name,),
        session=reader.metadata[SESSION],
        scenario=reader.attachments[SCENARIO],
        metadata=reader.metadata,
        channels=channels,
        complete=reader.complete and not damaged and is_first_part,
        ended=reader.complete,
        damaged=damaged,
        chain=reader.judge_digest(),
    )


def check_log(stream: BinaryIO, name: str) -> None:
    """Reads a log once, message by message, without keeping the messages.

    Raises:
        LogError: no command opens the file; the text states the reason.
    """
    reader = McapReader(stream, name)
    deque(reader.messages(), maxlen=0)
    _check_head(reader, name)
    try:
        parse_embedded(reader.attachments[SCENARIO].decode(), f"{name}: scenario")
    except (ScenarioError, UnicodeDecodeError) as error:
        raise LogError(f"{name}: its scenario cannot be read: {error}") from None


def _check_head(reader: McapReader, name: str) -> None:
    """Checks that a file that was read describes a session.

    Raises:
        LogError: the file lacks the session's metadata or the scenario.
    """
    session = reader.metadata.get(SESSION, {})
    missing = [key for key in ("session", "driver") if key not in session]
    if SCENARIO not in reader.attachments:
        missing.append(SCENARIO)
    if missing:
        reason = f"damaged: {reader.damaged[0]}" if reader.damaged else reader.torn
        problem = f"{name}: is an MCAP file, but no log of trilat-net: no {missing[0]}"
        raise LogError(f"{problem}; {reason}" if reason else problem)
