"""Builders of logs: simulated, written again with changes, and edited byte by byte."""

import io
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

from trilat_net.execution import virtual
from trilat_net.log.log_reader import Log, open_log
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.net.messages import Event, LinkStats, State
from trilat_net.net.wire import encode
from trilat_net.scenario import Scenario, load_scenario, parse_scenario

Record = dict[str, Any]
SHORT = (("duration_s", 0.12), ("link.delay_ms", 20.0))
"""A tenth of a second on links of 20 ms: samples come into use, and a run takes milliseconds."""


_logs: dict[str, bytes] = {}


def simulate_bytes(scenario: Scenario, *arguments: Any, **options: Any) -> bytes:
    """Returns the log of a run in virtual time, as bytes.

    Args:
        scenario: The scenario of the run.
        arguments: Further arguments of `write_virtual_log`, such as a network.
        options: Options of `write_virtual_log`, such as `commands`.
    """
    stream = io.BytesIO()
    virtual.write_virtual_log(scenario, stream, *arguments, **options)
    return stream.getvalue()


def make_log_bytes(name: str, overrides: Mapping[str, Any] | None = None) -> bytes:
    """Returns the log of a shipped scenario in virtual time, as bytes, simulated once per process.

    Args:
        name: Name of the scenario.
        overrides: Overrides of the scenario. By default, the run is short.
    """
    settings = dict(SHORT if overrides is None else sorted(overrides.items()))
    key = json.dumps([name, settings])
    if key not in _logs:
        _logs[key] = simulate_bytes(load_scenario(name, settings))
    return _logs[key]


def make_log(name: str, overrides: Mapping[str, Any] | None = None) -> Log:
    """Returns the log of a shipped scenario in virtual time; its bytes are simulated once per process."""
    return open_bytes(make_log_bytes(name, overrides))


def open_bytes(data: bytes) -> Log:
    """Returns a log that is stored in memory."""
    return open_log(io.BytesIO(data))


def write_log(folder: Path, data: bytes, name: str = "run.mcap") -> Path:
    """Writes the bytes of a log to a file, and returns its path."""
    path = folder / name
    path.write_bytes(data)
    return path


def edit_log_bytes(
    data: bytes,
    *,
    record: Callable[[Record], Record | None] = lambda record: record,
    event: Callable[[bytes], bytes] = lambda payload: payload,
    scenario: Callable[[str], str] = lambda text: text,
    session: Mapping[str, str] | None = None,
    chunk_bytes: int = 1 << 20,
) -> bytes:
    """Returns a changed copy of a log, without a digest chain, as older programs wrote logs.

    Args:
        data: The log.
        record: Changes the record of a tick, or drops the record by returning None.
        event: Changes the payload of an event.
        scenario: Changes the text of the embedded scenario.
        session: New values of entries of the session's metadata.
        chunk_bytes: Size of the chunks of the copy, in bytes.
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


def drop_records(site: str, ticks: set[int]) -> Callable[[Record], Record | None]:
    """Returns a change for `edit_log_bytes` that drops the records of a site at given ticks."""
    return lambda record: None if record["site"] == site and record["tick"] in ticks else record


def rewrite_log(
    log: Log,
    keep: Callable[[State], bool] = lambda _: True,
    change: Callable[[State], State] = lambda state: state,
    driver: str = "virtual",
    finished: bool = True,
    others: Sequence[LinkStats | Event] = (),
) -> Log:
    """Returns a copy of a log, written by the program's own writer.

    Args:
        log: The log.
        keep: Selects the records of the copy.
        change: Changes each selected record.
        driver: Driver of the run, as the copy names it.
        finished: False if the copy shall lack its end.
        others: Messages of the copy that are no records.
    """
    stream = io.BytesIO()
    writer = LogWriter(
        stream, log.scenario, "again", driver, 1_700_000_000 * 10**9, collect_provenance()
    )
    for site in log.sites:
        for state in filter(keep, log[site].states):
            payload = encode(change(state))
            writer.add(
                topics.key("again", site, topics.STATE),
                payload,
                state.t_ns,
                0,
                state.tick,
                state,
            )
    for message in others:
        if isinstance(message, LinkStats):
            key = topics.key("again", message.site, topics.LINK)
        else:
            key = topics.key("again", message.member, topics.EVENT)
        writer.add(key, encode(message), 0, 0, 0, message)
    writer.flush()
    if finished:
        writer.finish({})
    return open_bytes(stream.getvalue())


def add_clock_readings(log: Log) -> Log:
    """Returns a copy of a log with clock readings.

    The loop is late by as many us as the number of its tick. Each tick takes 7 us of work.
    """
    return rewrite_log(
        log,
        change=lambda state: msgspec.structs.replace(state, late_us=state.tick, busy_us=7),
        driver="live",
    )


def replace_fields(state: State, **fields: object) -> State:
    """Returns a copy of a record with new fields, in which NumPy's numbers become plain ones."""
    plain = {
        key: [float(x) if isinstance(x, np.floating) else x for x in value]
        if isinstance(value, list)
        else value
        for key, value in fields.items()
    }
    return msgspec.structs.replace(state, **plain)


def replace_scenario(log: Log, overrides: Mapping[str, Any]) -> Log:
    """Returns a copy of a log whose scenario has overrides, but whose records are the same."""
    scenario = parse_scenario(log.scenario_text, "changed", dict(overrides))
    stream = io.BytesIO()
    writer = LogWriter(stream, scenario, scenario.name, "virtual", 0, collect_provenance())
    for site in log.sites:
        key = topics.key(scenario.name, site, topics.STATE)
        for state in log[site].states:
            writer.add(key, encode(state), state.t_ns, state.t_ns, state.tick, state)
    writer.finish({})
    return open_bytes(stream.getvalue())
