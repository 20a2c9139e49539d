"""Measures messages per second of `LogWriter.add` and `mcap.Writer`, and the memory of an hour's index."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from trilat_net.core.step.ticks import Arrival
from trilat_net.execution import virtual
from trilat_net.log.log_writer import LogWriter
from trilat_net.log.mcap_writer import McapWriter
from trilat_net.log.provenance import collect_provenance
from trilat_net.net import topics
from trilat_net.net.wire import encode_state
from trilat_net.scenario import load_scenario

from .stopwatch import best_s

PAYLOAD_BYTES = 480
FLUSH_EVERY = 300
"""Number of records of three sites at 1 kHz in 100 ms."""
CHANNELS, CHUNKS_PER_MIN = 12, 600
Message = tuple[str, bytes, int, int]
"""Key, payload, time, number."""


def run() -> list[str]:
    messages = _messages(6.0)
    size = sum(len(message[1]) for message in messages) / len(messages)
    ours, theirs = best_s(lambda: _ours(messages)), best_s(lambda: _theirs(messages))
    files = len(_ours(messages)) / 1e6, len(_theirs(messages)) / 1e6
    return [
        f"{len(messages)} records of {size:.0f} bytes, three channels, zstd, flushed every {FLUSH_EVERY}:",
        f"  LogWriter.add: {len(messages) / ours / 1e3:.0f} k msg/s, best of 5 (bar: >= 150 k)",
        f"  mcap.Writer: {len(messages) / theirs / 1e3:.0f} k msg/s, {theirs / ours:.1f} times as slow",
        f"  files: {files[0]:.2f} and {files[1]:.2f} MB",
        f"memory, {CHUNKS_PER_MIN} chunks a minute of {CHANNELS} channels, over an hour:",
        *(f"  {name}: {_growth(make):.2f} MiB a minute" for name, make in _WRITERS.items()),
    ]


def _messages(duration_s: float) -> list[Message]:
    """Returns records of the paper's experiment, with enough arrivals to give them a realistic size."""
    scenario = load_scenario("paper", {"duration_s": duration_s})
    messages = []
    for site, arrivals, output in virtual.execute_virtual(scenario):
        key = topics.key(scenario.name, site.name, topics.STATE)
        more: list[Arrival] = list(arrivals) * 4
        payload = encode_state(site.name, 7, site.peers, output, more, 12, 34)
        payload += bytes(max(0, PAYLOAD_BYTES - len(payload)))
        messages.append((key, payload, output.t_ns, output.tick))
    return messages


def _ours(messages: list[Message]) -> bytes:
    stream = io.BytesIO()
    scenario = load_scenario("paper")
    writer = LogWriter(stream, scenario, scenario.name, "virtual", 0, collect_provenance())
    for n, (key, payload, t_ns, tick) in enumerate(messages, 1):
        writer.add(key, payload, t_ns, t_ns, tick)
        if n % FLUSH_EVERY == 0:
            writer.flush()
    writer.finish({})
    return stream.getvalue()


def _theirs(messages: list[Message]) -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD)
    writer.start()
    schema = writer.register_schema("S", "jsonschema", b"{}")
    channels = {
        key: writer.register_channel(f"/{key}", "msgpack", schema)
        for key in dict.fromkeys(m[0] for m in messages)
    }
    for n, (key, payload, t_ns, tick) in enumerate(messages, 1):
        writer.add_message(channels[key], t_ns, payload, t_ns, tick)
        if n % FLUSH_EVERY == 0:
            writer.flush()
    writer.finish()
    return stream.getvalue()


class _Nowhere:
    """A file that discards everything that is written to it."""

    def __init__(self) -> None:
        self._size = 0

    def write(self, data: bytes, /) -> int:
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        pass


def _theirs_nowhere() -> Any:
    sink: Any = _Nowhere()
    writer = Writer(sink, compression=CompressionType.ZSTD)
    writer.start()
    return writer


_WRITERS: dict[str, Callable[[], Any]] = {
    "ours": lambda: McapWriter(_Nowhere(), "benchmark"),
    "mcap.Writer": _theirs_nowhere,
}


def _growth(make: Callable[[], Any]) -> float:
    """Returns the growth of the process per minute, MiB."""
    file = make()
    schema = file.register_schema("S", "jsonschema", b"{}")
    channels = [file.register_channel(f"/{n}", "msgpack", schema, {}) for n in range(CHANNELS)]

    def chunk(k: int) -> None:
        for channel in channels:
            file.add_message(channel, k, b"x" * 10, k, k)
        file.flush()

    for k in range(CHUNKS_PER_MIN):
        chunk(k)
    before = _resident_bytes()
    for k in range(CHUNKS_PER_MIN, 60 * CHUNKS_PER_MIN):
        chunk(k)
    return (_resident_bytes() - before) / 59 / (1 << 20)


def _resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1]) * 4096
