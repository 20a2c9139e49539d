"""Walks through an MCAP file, chunk by chunk, as far as it is whole.

Law: bounded memory, one chunk at a time; what cannot be read is passed over and reported, never hidden. Only
the messages inside a chunk are taken apart here, because that loop is what reading a log costs.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode

from ..errors import LogError
from .framing import HEAD, Damage, Frame, Framing, parsed
from .packed import Unreadable, unpacked

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_BEFORE_PAYLOAD = HEAD + _MESSAGE.size
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


class Channel(NamedTuple):
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


class Item(NamedTuple):
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


class Walk:
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
        self.channels: dict[str, Channel] = {}
        self.library = ""
        self.chunks: Counter[str] = Counter()
        self.packed_bytes = self.unpacked_bytes = 0
        self.complete = False
        self._framing = Framing(stream)
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

    def messages(self) -> Iterator[Item]:
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
                except Unreadable as error:
                    framing.damaged.append(Damage(frame.offset, HEAD + frame.length, str(error)))
            if self._progress is not None:
                self._progress(frame.end, framing.size)
        self.complete = framing.finished

    def _in_frame(self, frame: Frame) -> Iterator[Item]:
        """Yields the messages of one record of the file, and takes in what else it may be.

        Raises:
            Unreadable: it is damaged.
            LogError: it holds more than there is room for.
        """
        content = self._framing.content(frame)
        if frame.opcode == Opcode.CHUNK:
            head = self._framing.head(frame)
            data = unpacked(content)
            self.chunks[head.compression] += 1
            self.packed_bytes += len(content)
            self.unpacked_bytes += len(data)
            yield from self._in_chunk(data, frame)
        elif frame.opcode == Opcode.METADATA:
            entry = parsed(frame.opcode, content)
            self.metadata[entry.name] = entry.metadata
        elif frame.opcode == Opcode.ATTACHMENT:
            attachment = parsed(frame.opcode, content)
            crc = int.from_bytes(content[-4:], "little")
            if crc and zlib.crc32(memoryview(content)[:-4]) != crc:
                raise Unreadable(f"the attachment {attachment.name[:80]!r}: its CRC differs")
            self.attachments[attachment.name] = attachment.data
        elif frame.opcode == Opcode.HEADER:
            self.library = parsed(frame.opcode, content).library
        else:  # outside of chunks
            yield from self._in_chunk(_RECORD.pack(frame.opcode, frame.length) + content, frame)

    def _in_chunk(self, data: bytes, frame: Frame) -> Iterator[Item]:
        topics, ours = self._topics, self._ours
        offset, end, taken = 0, len(data), 0
        try:
            while offset < end:
                opcode, length = _RECORD.unpack_from(data, offset)
                behind = offset + HEAD + length
                if behind > end:
                    raise Unreadable("a record reaches beyond its chunk")
                if opcode == _MESSAGE_OPCODE:
                    channel, sequence, log_time_ns, publish_time_ns = _MESSAGE.unpack_from(
                        data, offset + HEAD
                    )
                    payload = data[offset + _BEFORE_PAYLOAD : behind]
                    if channel in ours:
                        taken += _DECODED_BYTES
                        if length > _LONG_BYTES:
                            taken += (length - _LONG_BYTES) * _LONG_RATIO
                    else:
                        taken += 100 + length
                    yield Item(topics.get(channel, ""), payload, log_time_ns, publish_time_ns, sequence)
                elif opcode in _NAMING:
                    self._take(_NAME_BYTES + _NAME_RATIO * length, frame)
                    self._name(opcode, data[offset + HEAD : behind])
                offset = behind
        except struct.error:
            raise Unreadable("a record in a chunk is cut off") from None
        self._take(taken, frame)

    def _name(self, opcode: int, content: bytes) -> None:
        record = parsed(opcode, content)
        if opcode == Opcode.SCHEMA:
            self._schemas.setdefault(record.id, (record.name, record.encoding))
        elif record.id not in self._topics:
            self._topics[record.id] = topic = record.topic
            schema = self._schemas.get(record.schema_id, ("", ""))
            self.channels.setdefault(topic, Channel(topic, record.message_encoding, *schema, record.metadata))
            if topic.startswith("/trilat/"):
                self._ours.add(record.id)

    def _take(self, amount: int, frame: Frame) -> None:
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
