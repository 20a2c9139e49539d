"""Messages from one MCAP file into another, with the channels and schemas that they need.

Law: a message is copied byte for byte, with its times and its number, or counted as one that cannot be; the
numbers of channels and schemas may change, what they say does not.
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from mcap.opcode import Opcode

from .container import Container
from .framing import HEAD, parsed
from .packed import Unreadable

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_OP_MESSAGE = int(Opcode.MESSAGE)
_MOST = 65_535
"""Channels, and schemas, that a file can have."""


def records_in(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yields the records in an unpacked chunk: opcode and content.

    Raises:
        Unreadable: one reaches beyond the chunk.
    """
    offset, end = 0, len(data)
    while offset < end:
        if end - offset < HEAD:
            raise Unreadable("a record in a chunk is cut off")
        opcode, length = _RECORD.unpack_from(data, offset)
        begin = offset + HEAD
        offset = begin + length
        if offset > end:
            raise Unreadable("a record reaches beyond its chunk")
        yield opcode, data[begin:offset]


class Copying:
    """The way of messages into a file.

    Args:
        file: where they go.
        opened: told the topic of every channel that the file gets.
        took: told topic, sequence and payload of every message.

    Attributes:
        lost: messages whose channel nobody named, or that make no sense, by the number of their channel.
        bare: topics of channels whose schema nobody named.
        contradicted: numbers of channels and schemas that the file tells in two ways; the first one holds.
    """

    def __init__(
        self, file: Container, opened: Callable[[str], None], took: Callable[[str, int, bytes], None]
    ) -> None:
        self.lost: Counter[int] = Counter()
        self.bare: list[str] = []
        self.contradicted: set[int] = set()
        self._file, self._opened, self._took = file, opened, took
        self._schemas: dict[int, Any] = {}
        self._channels: dict[int, Any] = {}
        self._new_schemas: dict[int, int] = {}
        self._new_channels: dict[int, tuple[int, str]] = {}

    def define(self, opcode: int, content: bytes) -> None:
        """Takes a schema or a channel; what a number meant first, it means.

        Raises:
            Unreadable: it is none.
        """
        entry = parsed(opcode, content)
        known = self._schemas if opcode == Opcode.SCHEMA else self._channels
        if known.setdefault(entry.id, entry) != entry:
            self.contradicted.add(entry.id)

    def open_all(self) -> None:
        """Gives the file every channel that is known by now, whether it has messages or not."""
        for number in sorted(self._channels):
            self._channel(number)

    def take(self, opcode: int, content: bytes) -> None:
        """Takes a record of a chunk, or a message that is in none.

        Raises:
            Unreadable: it makes no sense.
        """
        if opcode == _OP_MESSAGE:
            self._message(content)
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            self.define(opcode, content)

    def _message(self, content: bytes) -> None:
        if len(content) < _MESSAGE.size:
            raise Unreadable("a message is too short")
        number, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(content)
        new = self._new_channels.get(number) or self._channel(number)
        if new is None:
            self.lost[number] += 1
            return
        payload = content[_MESSAGE.size :]
        self._file.add_message(new[0], log_ns, payload, publish_ns, sequence)
        self._took(new[1], sequence, payload)

    def _channel(self, number: int) -> tuple[int, str] | None:
        """Returns what a channel is called in the new file, and its topic; None where nobody named it."""
        known = self._channels.get(number)
        if known is None or len(self._new_channels) >= _MOST:
            return None
        schema = self._schema(known.schema_id)
        if known.schema_id and not schema:
            self.bare.append(known.topic)
        new = self._file.register_channel(known.topic, known.message_encoding, schema, known.metadata)
        self._new_channels[number] = new, known.topic
        self._opened(known.topic)
        return new, known.topic

    def _schema(self, number: int) -> int:
        known = self._schemas.get(number)
        if known is not None and number not in self._new_schemas:
            self._new_schemas[number] = self._file.register_schema(known.name, known.encoding, known.data)
        return self._new_schemas.get(number, 0)
