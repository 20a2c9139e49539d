"""Writes a session into one MCAP file: live by the recorder, in virtual time by the simulation.

Law (L5): the file explains itself, from its first bytes on: session, scenario and schemas stand before the
first message, payloads are byte for byte what was published, and the accounts stand at the end.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from mcap.writer import CompressionType, Writer

from ..core.tick import Output
from ..errors import LogRefused, UsageError
from ..net import topics
from ..net.messages import VERSION, Event, LinkStats, RecorderStats, State, json_schema
from ..scenario import Scenario
from .provenance import provenance

SESSION, ACCOUNTS, SCENARIO = "trilat.session", "trilat.accounts", "scenario.toml"
SCHEMAS: dict[str, type[msgspec.Struct]] = {
    topics.STATE: State,
    topics.LINK: LinkStats,
    topics.EVENT: Event,
    topics.STATS: RecorderStats,
}
CHANNELS = (topics.STATE, topics.LINK, topics.EVENT)
"""Channels of a site, each with a number per message that tells what is missing."""
RECORDER_CHANNELS = (topics.EVENT, topics.STATS)

_CHUNK_BYTES = 1 << 20
_LAST_NS = (1 << 64) - 1  # of the file's time stamps; a stranger's may be anything


@contextmanager
def new_file(path: Path, *, force: bool = False) -> Iterator[BinaryIO]:
    """Opens a file for writing that must not exist yet, unless it may be replaced; closes it at the end.

    Args:
        path: which file.
        force: whether it may replace one.

    Raises:
        UsageError: it exists, or cannot be made.
        LogRefused: the disk refused what was still to be written.
    """
    try:
        stream = path.open("wb" if force else "xb")
    except FileExistsError:
        raise UsageError(f"{path}: exists; choose another name, or replace it with --force") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        yield stream
    finally:
        try:
            stream.close()
        except OSError as error:  # what a full disk refused is refused once more on closing
            raise _refused(error) from None


class LogWriter:
    """One log, from its header to its last account.

    Args:
        stream: where the bytes go, opened for writing.
        scenario: the resolved scenario.
        session: the session's name.
        driver: "live" or "virtual".
        epoch_unix_ns: Unix time of tick 0; 0 in virtual time.
        facts: what else to say of the session.
    """

    def __init__(
        self,
        stream: BinaryIO,
        scenario: Scenario,
        session: str,
        driver: str,
        epoch_unix_ns: int,
        facts: Mapping[str, str] | None = None,
    ) -> None:
        self._epoch_unix_ns = epoch_unix_ns
        self._stream = stream
        self._writer: Any = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"trilat-net {provenance()['version_trilat-net']}")
        self._writer.add_metadata(
            SESSION,
            {
                "schema_version": str(VERSION),
                "session": session,
                "driver": driver,
                "scenario": scenario.name,
                "scenario_sha256": scenario.sha256,
                "seed": str(scenario.seed),
                "sites": " ".join(scenario.names),
                "epoch_unix_ns": str(epoch_unix_ns),
                **provenance(),
                **(facts or {}),
            },
        )
        self._writer.add_attachment(0, 0, SCENARIO, "application/toml", scenario.text.encode())
        self._channels = self._register(scenario, session)
        stream.flush()

    def _register(self, scenario: Scenario, session: str) -> dict[str, int]:
        schemas = {
            name: self._writer.register_schema(
                f"trilat.{kind.__name__}.v{VERSION}", "jsonschema", json.dumps(json_schema(kind)).encode()
            )
            for name, kind in SCHEMAS.items()
        }
        channels = {}
        for member in (*scenario.names, topics.RECORDER):
            for name in CHANNELS if member != topics.RECORDER else RECORDER_CHANNELS:
                key = topics.key(session, member, name)
                rate = {"rate_hz": str(scenario.sites[member].rate_hz)} if name == topics.STATE else {}
                channels[key] = self._writer.register_channel(
                    f"/{key}", "msgpack", schemas[name], {"member": member, **rate}
                )
        return channels

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the messages that have a channel in the file."""
        return tuple(self._channels)

    def add(
        self,
        key: str,
        payload: bytes,
        t_ns: int,
        log_time_ns: int,
        number: int,
        message: State | Output | LinkStats | Event | None = None,  # noqa: ARG002 - the views to come
    ) -> None:
        """Writes one message.

        Args:
            key: its key, one of `keys`.
            payload: its bytes.
            t_ns: when it was sent, ns since the epoch.
            log_time_ns: when it arrived, Unix ns.
            number: its sequence number.
            message: what it says, for those who cannot read its bytes.

        Raises:
            LogRefused: the disk refused.
        """
        try:
            self._writer.add_message(
                channel_id=self._channels[key],
                log_time=log_time_ns,
                data=payload,
                publish_time=min(max(0, self._epoch_unix_ns + t_ns), _LAST_NS),
                sequence=max(0, number) & 0xFFFFFFFF,
            )
        except OSError as error:
            raise _refused(error) from None

    def flush(self) -> None:
        """Closes the open chunk and hands it to the operating system: a crash loses nothing before it."""
        try:
            self._writer.flush()
            self._stream.flush()
        except OSError as error:
            raise _refused(error) from None

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Writes the accounts, the index and the end mark. The stream stays open.

        Args:
            accounts: per topic what arrived and what is missing; and what else was counted, by name.
        """
        try:
            self._writer.add_metadata(ACCOUNTS, dict(accounts))
            self._writer.finish()
            self._stream.flush()
        except OSError as error:
            raise _refused(error) from None


def _refused(error: OSError) -> LogRefused:
    return LogRefused(f"the log cannot be written: {error.strerror}; what was flushed before is intact")
