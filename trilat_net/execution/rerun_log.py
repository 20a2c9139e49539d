"""Writes a rerun as a log: executed sites anew, recorded sites byte for byte.

Invariant: the file names its source log by SHA-256, the executed sites and the changes; its scenario is the
one that holds in it. An executed site has no measured values (timing, round trips).
"""

import hashlib
from collections.abc import Iterator, Sequence
from heapq import merge
from pathlib import Path

from ..errors import LogError
from ..log.log_reader import Log
from ..log.log_writer import LogWriter
from ..log.mcap_writer import Sink
from ..net.messages import READABLE, State
from ..net.wire import decode
from .rerun_execution import RerunTick
from .rerun_request import RerunRequest, describe_rerun_changes
from .resumption import read_output
from .site_channels import LAST_LOG_NS, SiteChannels, SiteEntry
from .verify import EXECUTED_SITES_KEY

RERUN_DRIVER = "rerun"


def write_rerun_log(
    log: Log, request: RerunRequest, ticks: Sequence[RerunTick], stream: Sink, views_hz: float = 0.0
) -> None:
    """Writes a rerun into a stream, which stays open.

    Args:
        log: the source log.
        request: the rerun.
        ticks: every executed tick, in order.
        stream: destination of the bytes.
        views_hz: rate of the standard channels, Hz, see `log.ros2.viz_channels`.

    Raises:
        LogError: the log's epoch is no time.
        LogRefused: the disk refused.
    """
    session, epoch_unix_ns = log.session["session"], _read_epoch_unix_ns(log)
    metadata = rerun_metadata(log, request)
    writer = LogWriter(
        stream, request.scenario, session, RERUN_DRIVER, epoch_unix_ns, metadata, views_hz=views_hz
    )
    channels = {}
    for name in log.sites:
        boot = log[name].states[0].boot if len(log[name]) else 0
        rate_hz = request.scenario.sites[name].rate_hz
        channels[name] = SiteChannels(session, name, boot, log[name].peers, rate_hz)
    by_site: dict[str, list[RerunTick]] = {name: [] for name in request.replaced}
    for tick in ticks:
        by_site[tick.site].append(tick)
    entries = {name: _copy_recorded(log, name, channels[name]) for name in request.recorded}
    entries |= {name: _encode_executed(executed, channels[name]) for name, executed in by_site.items()}
    for entry in merge(*entries.values(), key=lambda entry: entry.t_ns):
        channels[entry.site].write(entry, writer, epoch_unix_ns)
    writer.finish({key: text for each in channels.values() for key, text in each.describe_accounts().items()})


def _read_epoch_unix_ns(log: Log) -> int:
    written = log.session.get("epoch_unix_ns", "0")
    if not written.isdecimal() or int(written) > LAST_LOG_NS:
        raise LogError(f"{log.source}: its epoch_unix_ns is no time: {written[:40]!r}")
    return int(written)


def rerun_metadata(log: Log, request: RerunRequest) -> dict[str, str]:
    """Returns the session metadata that name the source log and the changes."""
    digests = {}
    for path in map(Path, log.sources):
        if path.is_file():  # a log in memory has none
            with path.open("rb") as stream:
                digests[path] = hashlib.file_digest(stream, "sha256").hexdigest()
    return {
        "rerun_mode": request.mode,
        "rerun_of": " ".join(path.name for path in digests),
        "rerun_of_sha256": " ".join(digests.values()),
        "rerun_of_driver": log.driver,
        EXECUTED_SITES_KEY: " ".join(request.replaced),
        "rerun_changes": "; ".join(describe_rerun_changes(request)),
    }


def _copy_recorded(log: Log, name: str, channels: SiteChannels) -> Iterator[SiteEntry]:
    """Yields everything that a recorded site published, in order of time."""
    part = log[name]
    events = [event for event in log.events if event.member == name]
    events.sort(key=lambda event: event.t_ns)  # those before the epoch come first
    return merge(
        (channels.record(state, payload) for state, payload in zip(part.states, part.payloads, strict=True)),
        (channels.stats(stats) for stats in log.link_stats(name)),
        (channels.event(event, n) for n, event in enumerate(events)),
        key=lambda entry: entry.t_ns,
    )


def _encode_executed(ticks: Sequence[RerunTick], channels: SiteChannels) -> Iterator[SiteEntry]:
    """Yields everything that an executed site publishes, in order of time."""
    for tick in ticks:
        state = decode(tick.payload, State, READABLE)
        output = read_output(state, channels.peers)
        yield channels.record(state, tick.payload)
        yield from channels.follow(output, tick.stats)
    yield channels.end()
