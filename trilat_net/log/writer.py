"""Writes a session into one MCAP file: live by the recorder, in virtual time by the simulation.

Law (L5): the file explains itself, from its first bytes on: session, scenario and schemas stand before the
first message, payloads are byte for byte what was published, and the accounts stand at the end.
"""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import msgspec

from ..core.tick import Output
from ..errors import LogRefused, UsageError
from ..net import topics
from ..net.messages import VERSION, Event, LinkStats, RecorderStats, State, json_schema
from ..scenario import Scenario
from . import cdr
from .choice import ALL, Choice
from .container import Container, Sink
from .provenance import provenance
from .views import MOST_BYTES, Take, Views

SESSION, PART, ACCOUNTS, SCENARIO = "trilat.session", "trilat.part", "trilat.accounts", "scenario.toml"
SCHEMAS: dict[str, type[msgspec.Struct]] = {
    topics.STATE: State,
    topics.LINK: LinkStats,
    topics.EVENT: Event,
    topics.STATS: RecorderStats,
}
CHANNELS = (topics.STATE, topics.LINK, topics.EVENT)
"""Channels of a site, each with a number per message that tells what is missing."""
RECORDER_CHANNELS = (topics.EVENT, topics.STATS)

_LAST_NS = (1 << 64) - 1  # of the file's time stamps; a stranger's may be anything


@contextmanager
def new_file(path: Path, *, force: bool = False) -> Iterator[BinaryIO]:
    """Opens a small file for writing that must not exist yet, unless it may be replaced; closes it.

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
        part: which part of a log this is, where it has several.
        choice: which channels it takes.
        views_hz: messages a second of the standard channels beside its own, see `views`; 0 for none.

    Raises:
        LogRefused: the disk refused.
    """

    def __init__(
        self,
        stream: Sink,
        scenario: Scenario,
        session: str,
        driver: str,
        epoch_unix_ns: int,
        facts: Mapping[str, str] | None = None,
        *,
        part: Mapping[str, str] | None = None,
        choice: Choice = ALL,
        views_hz: float = 0.0,
    ) -> None:
        self._epoch_unix_ns = epoch_unix_ns
        self._over = ""  # why nothing more can be added
        self._views = Views(scenario, session, epoch_unix_ns, views_hz, self._put_view) if views_hz else None
        self._takers: dict[str, Take] = self._views.takers if self._views else {}
        self._last_log_ns = 0
        self._standard: dict[str, int] = {}  # what there is of standard schemas and channels
        self._file = Container(stream, f"trilat-net {provenance()['version_trilat-net']}")
        about = {
            "schema_version": str(VERSION),
            "session": session,
            "driver": driver,
            "scenario": scenario.name,
            "scenario_sha256": scenario.sha256,
            "seed": str(scenario.seed),
            "sites": " ".join(scenario.names),
            "epoch_unix_ns": str(epoch_unix_ns),
        }
        with self._refusing():
            self._file.add_metadata(SESSION, {**about, **provenance(), **choice.facts(), **(facts or {})})
            if part:
                self._file.add_metadata(PART, part)
            self._file.add_attachment(0, 0, SCENARIO, "application/toml", scenario.text.encode())
            self._channels = self._register(scenario, session, choice)
            self._file.flush()

    def _register(self, scenario: Scenario, session: str, choice: Choice) -> dict[str, int | None]:
        """Returns the channel of every key of the session; None where it is not to be taken."""
        schemas = {
            name: self._file.register_schema(
                f"trilat.{kind.__name__}.v{VERSION}", "jsonschema", json.dumps(json_schema(kind)).encode()
            )
            for name, kind in SCHEMAS.items()
        }
        channels: dict[str, int | None] = {}
        for member in (*scenario.names, topics.RECORDER):
            for name in CHANNELS if member != topics.RECORDER else RECORDER_CHANNELS:
                key = topics.key(session, member, name)
                rate = {"rate_hz": str(scenario.sites[member].rate_hz)} if name == topics.STATE else {}
                channels[key] = None
                if choice.takes(key):
                    channels[key] = self._file.register_channel(
                        f"/{key}", "msgpack", schemas[name], {"member": member, **rate}
                    )
        return channels

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the messages that have a channel in the file."""
        return tuple(key for key, channel in self._channels.items() if channel is not None)

    @property
    def ended(self) -> bool:
        """True once nothing more can be added: it is finished, or the disk has refused."""
        return bool(self._over)

    @property
    def messages(self) -> int:
        """How many messages it has."""
        return self._file.messages

    @property
    def written_bytes(self) -> int:
        """How many bytes were written so far."""
        return self._file.position

    @property
    def most_bytes(self) -> int:
        """How long the file would be at most, its accounts aside, if it were finished now."""
        views = MOST_BYTES * len(self._views.lanes) if self._views is not None else 0
        return self._file.position + self._file.pending + self._file.owed + views

    def add(
        self,
        key: str,
        payload: bytes,
        t_ns: int,
        log_time_ns: int,
        number: int,
        message: State | Output | LinkStats | Event | None = None,
    ) -> None:
        """Writes one message, if the log takes its channel.

        Args:
            key: its key: a channel of the session.
            payload: its bytes.
            t_ns: when it was sent, ns since the epoch.
            log_time_ns: when it arrived, Unix ns.
            number: its sequence number.
            message: what it says, for those who cannot read its bytes.

        Raises:
            LogRefused: the disk refused, now (then this message is the last one) or before.
        """
        if self._over:
            raise LogRefused(self._over)
        channel = self._channels[key]
        if channel is None:
            return
        self._last_log_ns = log_time_ns
        sent_ns = self._epoch_unix_ns + t_ns
        with_number = number & 0xFFFFFFFF if number >= 0 else 0
        try:
            self._file.add_message(channel, log_time_ns, payload, min(max(0, sent_ns), _LAST_NS), with_number)
            if message is not None and (take := self._takers.get(key)) is not None:
                take(message, log_time_ns)
        except OSError as error:
            raise self._refused(error) from None

    def _put_view(self, topic: str, data: bytes, publish_ns: int, log_ns: int) -> None:
        """Writes a message of a standard channel, which is made when its first one comes."""
        channel = self._standard.get(topic)
        if channel is None and self._views is not None:
            kind, about = self._views.channels[topic]
            if kind not in self._standard:
                schema = self._file.register_schema(kind, cdr.SCHEMA_ENCODING, cdr.SCHEMAS[kind])
                self._standard[kind] = schema
            channel = self._file.register_channel(topic, cdr.ENCODING, self._standard[kind], about)
            self._standard[topic] = channel
        if channel is not None:
            self._file.add_message(channel, log_ns, data, min(publish_ns, _LAST_NS))

    def flush(self) -> None:
        """Closes the open chunk and hands it to the operating system: a crash loses nothing before it.

        Raises:
            LogRefused: the disk refused.
        """
        with self._refusing():
            self._file.flush()

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Writes the accounts, the index and the end mark, once; the stream stays open.

        Args:
            accounts: per topic what arrived and what is missing; and what else was counted, by name. Those
                of channels that the log does not take are left out.

        Raises:
            LogRefused: the disk refused.
        """
        if self._over == _FINISHED:
            return
        whole, self._over = not self._over, _FINISHED
        left_out = {f"/{key}" for key, channel in self._channels.items() if channel is None}
        with self._refusing():
            try:
                if self._views is not None and whole:
                    self._views.finish(self._last_log_ns)
            finally:
                self._file.add_metadata(
                    ACCOUNTS, {name: text for name, text in accounts.items() if name not in left_out}
                )
                self._file.finish()

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._refused(error) from None

    def _refused(self, error: OSError) -> LogRefused:
        refused = _refused(error)
        self._over = self._over or str(refused)
        return refused


_FINISHED = "the log is finished"


def _refused(error: OSError) -> LogRefused:
    return LogRefused(f"the log cannot be written: {error.strerror}; what was flushed before is intact")
