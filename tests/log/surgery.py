"""A log as a list of its records, from which the same bytes can be written again."""

import io
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import msgpack
from mcap.opcode import Opcode

from trilat_net.log.mcap_records import (
    MESSAGE_HEAD,
    OP_MESSAGE,
    RecordScanner,
    iterate_records,
    parse_record,
    unpack_chunk,
)
from trilat_net.log.mcap_writer import McapWriter

ABOUT = (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.SCHEMA, Opcode.CHANNEL)


class Stored(NamedTuple):
    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    payload: bytes


@dataclass
class Pieces:
    """The content of a file: its header, its descriptions, and its messages in order."""

    library: str = ""
    about: list[Any] = field(default_factory=list)
    messages: list[Stored] = field(default_factory=list)

    def metadata(self, name: str) -> dict[str, str]:
        return next(
            entry.metadata
            for entry in self.about
            if getattr(entry, "metadata", None) is not None
            and getattr(entry, "name", "") == name
        )

    def topics(self) -> dict[int, str]:
        return {entry.id: entry.topic for entry in self.about if hasattr(entry, "topic")}

    def without_chain(self) -> "Pieces":
        """Removes the digest chain, which older programs did not write, and returns the pieces."""
        self.about = [
            entry for entry in self.about if getattr(entry, "name", "") != "trilat.chain"
        ]
        self.metadata("trilat.session").pop("digest_chain", None)
        return self

    def bytes(self) -> bytes:
        stream = io.BytesIO()
        writer = McapWriter(stream, self.library)
        late = [
            entry
            for entry in self.about
            if getattr(entry, "name", "") in ("trilat.accounts", "trilat.chain")
        ]
        for entry in self.about:
            if entry not in late:
                _write_entry(writer, entry)
        for channel, sequence, log_ns, publish_ns, payload in self.messages:
            writer.add_message(channel, log_ns, payload, publish_ns, sequence)
        for entry in late:
            if entry.name == "trilat.chain":
                writer.flush()
            _write_entry(writer, entry)
        writer.finish()
        return stream.getvalue()


def _write_entry(writer: McapWriter, entry: Any) -> None:
    match type(entry).__name__:
        case "Metadata":
            writer.add_metadata(entry.name, entry.metadata)
        case "Attachment":
            writer.add_attachment(
                entry.create_time, entry.log_time, entry.name, entry.media_type, entry.data
            )
        case "Schema":
            writer.register_schema(entry.name, entry.encoding, entry.data)
        case "Channel":
            writer.register_channel(
                entry.topic, entry.message_encoding, entry.schema_id, entry.metadata
            )


def take_apart(data: bytes) -> Pieces:
    pieces = Pieces()
    scanner = RecordScanner(io.BytesIO(data))
    for frame in scanner.frames():
        if frame.opcode == Opcode.DATA_END:
            break
        content = scanner.content(frame)
        if frame.opcode == Opcode.HEADER:
            pieces.library = parse_record(frame.opcode, content).library
        elif frame.opcode in ABOUT:
            pieces.about.append(parse_record(frame.opcode, content))
        elif frame.opcode == Opcode.CHUNK:
            records = unpack_chunk(content)
            for opcode, begin, end in iterate_records(records):
                assert opcode == OP_MESSAGE
                head = MESSAGE_HEAD.unpack_from(records, begin)
                pieces.messages.append(Stored(*head, records[begin + MESSAGE_HEAD.size : end]))
    return pieces


def repack_message(message: Stored, **fields: object) -> Stored:
    """Returns a message with other entries, whose number in the file follows its tick."""
    record = {**msgpack.unpackb(message.payload), **fields}
    return message._replace(payload=msgpack.packb(record), sequence=record["tick"] & 0xFFFFFFFF)
