"""Logs in memory, and logs changed on purpose: through the plain `mcap` package and `msgpack`."""

import io
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import msgpack
from mcap.reader import make_reader
from mcap.writer import Writer

from trilat_net.execution import virtual
from trilat_net.log.log_reader import Log, open_log
from trilat_net.scenario import load_scenario

Record = dict[str, Any]
SHORT = (("duration_s", 0.12), ("link.delay_ms", 20.0))
"""A tenth of a second on links of 20 ms: samples come into use, and an execution takes milliseconds."""


@cache
def _recorded(name: str, overrides: tuple[tuple[str, Any], ...]) -> bytes:
    stream = io.BytesIO()
    virtual.write_virtual_log(load_scenario(name, dict(overrides)), stream)
    return stream.getvalue()


def recorded(name: str, overrides: Mapping[str, Any] | None = None) -> bytes:
    """The log of a virtual run; by default a short one."""
    return _recorded(name, SHORT if overrides is None else tuple(sorted(overrides.items())))


def opened(data: bytes) -> Log:
    return open_log(io.BytesIO(data))


def edited(
    data: bytes,
    *,
    record: Callable[[Record], Record | None] = lambda record: record,
    event: Callable[[bytes], bytes] = lambda payload: payload,
    scenario: Callable[[str], str] = lambda text: text,
    session: Mapping[str, str] | None = None,
    chunk_bytes: int = 1 << 20,
) -> bytes:
    """Writes a log again, changed, as a program did that knew no digest chain.

    Args:
        data: the log.
        record: what becomes of each record of a tick; None drops it.
        event: what becomes of each event's payload.
        scenario: what becomes of the embedded scenario.
        session: entries of the session's metadata that are changed.
        chunk_bytes: chunk size of the new file.
    """
    reader = make_reader(io.BytesIO(data))
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=chunk_bytes)
    writer.start()
    metadata = {entry.name: dict(entry.metadata) for entry in reader.iter_metadata()}
    metadata.pop("trilat.chain", None)
    metadata["trilat.session"].pop("digest_chain", None)
    metadata["trilat.session"].update(session or {})
    writer.add_metadata("trilat.session", metadata.pop("trilat.session"))
    for attachment in reader.iter_attachments():
        text = scenario(attachment.data.decode())
        writer.add_attachment(0, 0, attachment.name, attachment.media_type, text.encode())
    channels: dict[str, int] = {}
    schemas: dict[str, int] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        payload = message.data
        if channel.topic.endswith("/state"):
            changed = record(msgpack.unpackb(payload))
            if changed is None:
                continue
            payload = msgpack.packb(changed)
        if channel.topic.endswith("/event"):
            payload = event(payload)
        if schema.name not in schemas:
            schemas[schema.name] = writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        if channel.topic not in channels:
            channels[channel.topic] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.name], channel.metadata
            )
        writer.add_message(
            channels[channel.topic],
            message.log_time,
            payload,
            message.publish_time,
            message.sequence,
        )
    for name, entries in metadata.items():
        writer.add_metadata(name, entries)
    writer.finish()
    return stream.getvalue()


def without(site: str, ticks: set[int]) -> Callable[[Record], Record | None]:
    """Drops these records of a site."""
    return lambda record: None if record["site"] == site and record["tick"] in ticks else record
