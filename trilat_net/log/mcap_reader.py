"""Reader of an MCAP file, chunk by chunk; contents of a trilat-net log by topic.

Invariant: the reader holds one chunk at a time; what it cannot read it skips and reports. Messages of a
log stay bytes until they are decoded. Channels for viewers (`/viz`) are skipped.

The loop over the messages in a chunk is written out here because it dominates the time to read a log.
"""

import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ..errors import LogError
from ..net import topics
from .log_layout import PART, SCENARIO, SESSION
from .mcap_records import (
    RECORD_HEAD_BYTES,
    Damage,
    RecordFrame,
    RecordScanner,
    UnreadableRecord,
    parse_record,
    unpack_chunk,
)

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_BEFORE_PAYLOAD = RECORD_HEAD_BYTES + _MESSAGE.size
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # a member of an enumeration compares slowly
_NAMING = (Opcode.SCHEMA, Opcode.CHANNEL)
_READ = (
    Opcode.CHUNK,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.METADATA,
    Opcode.ATTACHMENT,
    Opcode.HEADER,
)
"""Kinds of records that a walk looks into; indexes are for those who do not read all."""

KEPT_BYTES = 64 << 20
KEPT_RATIO = 300
"""What a walk gives to one who keeps it takes at most so much memory, or so many times the file's size.

Arms at rest in virtual time pack best of all that is no bomb: 120 times.
"""
_DECODED_BYTES = 3_000
_LONG_BYTES, _LONG_RATIO = 300, 24
"""A message of a log, decoded, takes some memory, and more where it is longer than a record must be."""
_NAME_BYTES, _NAME_RATIO = 600, 20
"""What a channel and its metadata take, likewise."""


class ChannelInfo(NamedTuple):
    """What a file says of a channel.

    Attributes:
        topic: its name.
        encoding: of its messages.
        schema: name of their schema, "" where they have none.
        schema_encoding: how that is written.
        metadata: what else is said of it.
    """

    topic: str
    encoding: str
    schema: str
    schema_encoding: str
    metadata: dict[str, str]


class McapMessage(NamedTuple):
    """One message.

    Attributes:
        topic: of its channel; "" where the file never named it.
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


Progress = Callable[[int, int], None]
"""Told how much of something is done: (bytes so far, bytes in all)."""


class McapReader:
    """One pass over a file.

    Args:
        stream: the file, opened for reading.
        name: what errors call it.
        progress: told after every record of the file how many bytes of it are read, and how many it has.
        kept: whether the messages are kept: then what they take, decoded, is limited; see `KEPT_RATIO`.

    Attributes:
        metadata: metadata records seen so far, by name.
        attachments: attachments seen so far, by name.
        channels: channels seen so far, by topic; what one was first said to be, it is.
        library: what wrote the file, by its own word.
        chunks: chunks read so far, by compression ("" for none).
        packed_bytes: what they take in the file.
        unpacked_bytes: what they take unpacked.
        complete: True once all was read, to the end mark's last byte: the file was finished.
        damaged: parts that could not be read, in the order in which they were met.
        torn: the end that was cut off, in a file that was not finished.
    """

    def __init__(
        self, stream: BinaryIO, name: str, progress: Progress | None = None, *, kept: bool = True
    ) -> None:
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.channels: dict[str, ChannelInfo] = {}
        self.library = ""
        self.chunks: Counter[str] = Counter()
        self.packed_bytes = self.unpacked_bytes = 0
        self.complete = False
        self._framing = RecordScanner(stream)
        self._source = name
        self._progress = progress
        self._schemas: dict[int, tuple[str, str]] = {}
        self._topics: dict[int, str] = {}
        self._ours: set[int] = set()
        self._room = max(KEPT_BYTES, KEPT_RATIO * self._framing.size) if kept else None

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return self._framing.size

    @property
    def damaged(self) -> list[Damage]:
        """Parts that could not be read, so far."""
        return self._framing.damaged

    @property
    def torn(self) -> Damage | None:
        """The end that was cut off; None in a finished file, and before the walk has come to it."""
        return self._framing.torn

    def messages(self) -> Iterator[McapMessage]:
        """Yields every message in file order.

        Raises:
            LogError: the file is no MCAP file, or holds absurdly much for its size.
        """
        framing = self._framing
        if not framing.begins:
            empty = "is empty" if not framing.size else "does not begin as one does"
            raise LogError(f"{self._source}: is no MCAP file: it {empty}")
        for frame in framing.frames():
            if frame.opcode in _READ:
                try:
                    yield from self._in_frame(frame)
                except UnreadableRecord as error:
                    framing.damaged.append(Damage(frame.offset, RECORD_HEAD_BYTES + frame.length, str(error)))
            if self._progress is not None:
                self._progress(frame.end, framing.size)
        self.complete = framing.finished

    def _in_frame(self, frame: RecordFrame) -> Iterator[McapMessage]:
        """Yields the messages of one record of the file, and takes in what else it may be.

        Raises:
            Unreadable: it is damaged.
            LogError: it holds more than there is room for.
        """
        content = self._framing.content(frame)
        if frame.opcode == Opcode.CHUNK:
            head = self._framing.head(frame)
            data = unpack_chunk(content)
            self.chunks[head.compression] += 1
            self.packed_bytes += len(content)
            self.unpacked_bytes += len(data)
            yield from self._in_chunk(data, frame)
        elif frame.opcode == Opcode.METADATA:
            entry = parse_record(frame.opcode, content)
            self.metadata[entry.name] = entry.metadata
        elif frame.opcode == Opcode.ATTACHMENT:
            attachment = parse_record(frame.opcode, content)
            crc = int.from_bytes(content[-4:], "little")
            if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
                raise UnreadableRecord(f"the attachment {attachment.name[:80]!r}: its CRC differs")
            self.attachments[attachment.name] = attachment.data
        elif frame.opcode == Opcode.HEADER:
            self.library = parse_record(frame.opcode, content).library
        else:  # outside of chunks
            yield from self._in_chunk(_RECORD.pack(frame.opcode, frame.length) + content, frame)

    def _in_chunk(self, data: bytes, frame: RecordFrame) -> Iterator[McapMessage]:
        topics, ours = self._topics, self._ours
        offset, end, taken = 0, len(data), 0
        try:
            while offset < end:
                opcode, length = _RECORD.unpack_from(data, offset)
                behind = offset + RECORD_HEAD_BYTES + length
                if behind > end:
                    raise UnreadableRecord("a record reaches beyond its chunk")
                if opcode == _MESSAGE_OPCODE:
                    channel, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(
                        data, offset + RECORD_HEAD_BYTES
                    )
                    payload = data[offset + _BEFORE_PAYLOAD : behind]
                    if channel in ours:
                        taken += _DECODED_BYTES
                        if length > _LONG_BYTES:
                            taken += (length - _LONG_BYTES) * _LONG_RATIO
                    else:
                        taken += 100 + length
                    yield McapMessage(
                        topics.get(channel, ""), payload, log_time_ns, publish_time_ns, sequence
                    )
                elif opcode in _NAMING:
                    self._take(_NAME_BYTES + _NAME_RATIO * length, frame)
                    self._name(opcode, data[offset + RECORD_HEAD_BYTES : behind])
                offset = behind
        except struct.error:
            raise UnreadableRecord("a record in a chunk is cut off") from None
        self._take(taken, frame)

    def _name(self, opcode: int, content: bytes) -> None:
        record = parse_record(opcode, content)
        if opcode == Opcode.SCHEMA:
            self._schemas.setdefault(record.id, (record.name, record.encoding))
        elif record.id not in self._topics:
            self._topics[record.id] = topic = record.topic
            schema = self._schemas.get(record.schema_id, ("", ""))
            self.channels.setdefault(
                topic, ChannelInfo(topic, record.message_encoding, *schema, record.metadata)
            )
            if topic.startswith("/trilat/"):
                self._ours.add(record.id)

    def _take(self, amount: int, frame: RecordFrame) -> None:
        """Books what was kept.

        Raises:
            LogError: there is no room for it.
        """
        if self._room is None:
            return
        self._room -= amount
        if self._room < 0:
            raise LogError(
                f"{self._source}: holds absurdly much for a file of {self._framing.size} bytes: up to byte "
                f"{frame.end} alone it would take more than {KEPT_RATIO} times that in memory, and more than "
                f"{KEPT_BYTES >> 20} MiB"
            )


_OURS = (topics.STATE, topics.LINK, topics.EVENT, topics.STATS)
_LAST_NS = np.uint64((1 << 63) - 1)


class ChannelMessages:
    """The messages of one topic, in file order.

    Attributes:
        payloads: the messages as published.
        log_ns: when each came, Unix ns.
        publish_ns: when each was sent, by its own stamp, Unix ns.
    """

    __slots__ = ("log_ns", "payloads", "publish_ns")

    def __init__(self) -> None:
        self.payloads: list[bytes] = []
        self.log_ns = array("Q")
        self.publish_ns = array("Q")

    def add(self, payload: bytes, log_ns: int, publish_ns: int) -> None:
        """Adds one message."""
        self.payloads.append(payload)
        self.log_ns.append(log_ns)
        self.publish_ns.append(publish_ns)

    def times(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Returns when the messages came and when they were sent, shape (K,) each, Unix ns."""
        return _signed(self.log_ns), _signed(self.publish_ns)


def _signed(times: "array[int]") -> NDArray[np.int64]:
    """Returns times as whole numbers that may be subtracted; a stranger's may be anything."""
    return np.minimum(np.array(times, dtype=np.uint64), _LAST_NS).astype(np.int64)


@dataclass
class LogContents:
    """A file, or several that are one session's.

    Attributes:
        sources: the files' names.
        session: what the file says of the session.
        scenario: text of the scenario.
        metadata: everything of that kind, by name.
        channels: messages, by topic.
        complete: whether all of it is there, finished and readable throughout; a later part alone is not.
        ended: whether the last one was finished.
        damaged: what cannot be read, a sentence each.
    """

    sources: tuple[str, ...]
    session: dict[str, str]
    scenario: bytes
    metadata: dict[str, dict[str, str]]
    channels: dict[str, ChannelMessages] = field(repr=False)
    complete: bool
    ended: bool
    damaged: list[str]

    @property
    def source(self) -> str:
        """What errors call it."""
        more = len(self.sources) - 1
        return self.sources[0] + (f" and {more} more {'parts' if more > 1 else 'part'}" if more else "")


def read_contents(stream: BinaryIO, name: str, progress: Progress | None = None) -> LogContents:
    """Returns what a file holds.

    Args:
        stream: the file, opened for reading.
        name: what errors call it.
        progress: told while it is read how many bytes of it are, and how many it has.

    Raises:
        LogError: it is no MCAP file, or no log of trilat-net.
    """
    walk = McapReader(stream, name, progress)
    channels: dict[str, ChannelMessages] = {}
    adders: dict[str, Callable[[bytes, int, int], None]] = {}
    for topic, payload, log_ns, publish_ns, _ in walk.messages():
        try:
            add = adders[topic]
        except KeyError:
            add = adders[topic] = _adder(topic, channels)
        add(payload, log_ns, publish_ns)
    session = walk.metadata.get(SESSION, {})
    lacking = {"session", "driver"} - session.keys() or {SCENARIO} - walk.attachments.keys()
    if lacking:
        why = f"; damaged: {walk.damaged[0]}" if walk.damaged else f"; {walk.torn}" if walk.torn else ""
        raise LogError(f"{name}: is an MCAP file, but no log of trilat-net: no {lacking.pop()}{why}")
    damaged = [f"{name}: {damage}" for damage in walk.damaged]
    complete = walk.complete and not damaged and walk.metadata.get(PART, {}).get("index", "1") == "1"
    text = walk.attachments[SCENARIO]
    return LogContents((name,), session, text, walk.metadata, channels, complete, walk.complete, damaged)


def _adder(topic: str, channels: dict[str, ChannelMessages]) -> Callable[[bytes, int, int], None]:
    """Returns what keeps a topic's messages; or lets them go, where nobody will ask for them."""
    where = topics.parse_key(topic.removeprefix("/"))
    if where is None or where.channel not in _OURS:
        return lambda payload, log_ns, publish_ns: None  # noqa: ARG005
    return channels.setdefault(topic, ChannelMessages()).add
