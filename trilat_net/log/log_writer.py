"""Writer of a session's log into one MCAP file or into parts: `run-001.mcap`, `run-002.mcap`,
...

Invariant (L5): a file explains itself from its first bytes on: session, scenario and schemas
precede the first message, payloads are stored byte for byte as published, and the accounts
stand at the end. Each part repeats session, scenario and schemas and names the part before it;
a message is in exactly one part. The file changes between two messages, on the writing thread.
"""

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ..core.ticks import TickRecord
from ..errors import LogRefused, UsageError
from ..files import refuse_existing
from ..net import topics
from ..net.messages import VERSION, Event, LinkStats, State, json_schema
from ..scenario import Scenario
from . import log_layout
from .log_file import LogFile
from .mcap_writer import McapWriter, Sink
from .ros2.ros2_messages import StandardChannels
from .ros2.viz_channels import TakeMessage, VizChannels
from .running_digest import ALGORITHM, DIGESTS_KEY, PREVIOUS_DIGEST_KEY

Decoded = State | TickRecord | LinkStats | Event | None
"""A message as the channels for viewers take it; None where there are none."""


class LogWriter:
    """One log, from its header to its last account.

    Args:
        stream: receives the bytes.
        scenario: the resolved scenario.
        session: the session's name.
        driver: "live" or "virtual".
        epoch_unix_ns: Unix time of tick 0; 0 in virtual time.
        facts: further metadata of the session.
        part: metadata of a part of a log.
        choice: the channels that it takes.
        views_hz: messages a second of the channels for viewers, see `VizChannels`; 0 for none.

    Attributes:
        records_digest: the digest of its messages, once it is finished; else "".

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
        choice: log_layout.ChannelFilter = log_layout.ALL_CHANNELS,
        views_hz: float = 0.0,
    ) -> None:
        self._epoch_unix_ns = epoch_unix_ns
        self.records_digest = ""
        self._ended = ""  # why nothing more can be added
        self._views = None
        if views_hz:
            self._views = VizChannels(
                scenario=scenario,
                session=session,
                epoch_unix_ns=epoch_unix_ns,
                views_hz=views_hz,
                put=self._put_view,
            )
        self._takers: dict[str, TakeMessage] = self._views.takers if self._views else {}
        self._last_log_ns = 0
        self._file = McapWriter(
            stream, f"trilat-net {log_layout.collect_provenance()['version_trilat-net']}"
        )
        self._standard = StandardChannels(
            self._file, self._views.channels if self._views else {}
        )
        about = {
            "schema_version": str(VERSION),
            "session": session,
            "driver": driver,
            "scenario": scenario.name,
            "scenario_sha256": scenario.sha256,
            "seed": str(scenario.seed),
            "sites": " ".join(scenario.names),
            "epoch_unix_ns": str(epoch_unix_ns),
            DIGESTS_KEY: ALGORITHM,
        }
        about |= {**log_layout.collect_provenance(), **choice.facts(), **(facts or {})}
        with self._refusing():
            self._file.add_metadata(log_layout.SESSION, about)
            if part:
                self._file.add_metadata(log_layout.PART, part)
            self._file.add_attachment(
                create_time=0,
                log_time=0,
                name=log_layout.SCENARIO,
                media_type="application/toml",
                data=scenario.text.encode(),
            )
            self._channels = self._register(scenario, session, choice)
            self._file.flush()

    def _register(
        self, scenario: Scenario, session: str, choice: log_layout.ChannelFilter
    ) -> dict[str, int | None]:
        """Registers the channels of the session; returns them by key, None for those that are
        excluded.
        """
        schemas = {
            name: self._file.register_schema(
                f"trilat.{kind.__name__}.v{VERSION}",
                "jsonschema",
                json.dumps(json_schema(kind)).encode(),
            )
            for name, kind in log_layout.CHANNEL_TYPES.items()
        }
        channels: dict[str, int | None] = {}
        for member in (*scenario.names, topics.RECORDER):
            is_site = member != topics.RECORDER
            for name in log_layout.SITE_CHANNELS if is_site else log_layout.RECORDER_CHANNELS:
                key = topics.key(session, member, name)
                about = {"member": member}
                if name == topics.STATE:
                    about["rate_hz"] = str(scenario.sites[member].rate_hz)
                channels[key] = None
                if choice.accepts(key):
                    channels[key] = self._file.register_channel(
                        f"/{key}", "msgpack", schemas[name], about
                    )
        return channels

    @property
    def ended(self) -> bool:
        """True once nothing more can be added: it is finished, or the disk refused."""
        return bool(self._ended)

    @property
    def messages(self) -> int:
        """Number of messages."""
        return self._file.messages

    @property
    def written_bytes(self) -> int:
        """Number of bytes written so far."""
        return self._file.position

    @property
    def most_bytes(self) -> int:
        """Largest length of the file without its accounts, if it were finished now."""
        views = self._views.most_bytes if self._views is not None else 0
        return self._file.position + self._file.open_chunk_bytes + self._file.end_bytes + views

    def add(
        self,
        key: str,
        payload: bytes,
        t_ns: int,
        log_time_ns: int,
        number: int,
        message: Decoded = None,
    ) -> None:
        """Writes one message, if the log takes its channel.

        Args:
            key: key of its channel.
            payload: its bytes.
            t_ns: when it was sent, ns since the epoch.
            log_time_ns: when it arrived, Unix ns.
            number: its sequence number.
            message: the same, decoded, for the channels for viewers.

        Raises:
            LogRefused: the disk refused, now (then this message is the last one) or before.
        """
        if self._ended:
            raise LogRefused(self._ended)
        channel = self._channels[key]
        if channel is None:
            return
        self._last_log_ns = log_time_ns
        sent_ns = min(max(0, self._epoch_unix_ns + t_ns), log_layout.MAX_TIME_NS)
        try:
            self._file.add_message(
                channel_id=channel,
                log_time=log_time_ns,
                data=payload,
                publish_time=sent_ns,
                sequence=max(0, number) & 0xFFFFFFFF,
            )
            if message is not None and (take := self._takers.get(key)) is not None:
                take(message, log_time_ns)
        except OSError as error:
            raise self._refused(error) from None

    def _put_view(self, topic: str, data: bytes, publish_ns: int, log_ns: int) -> None:
        publish_ns = min(publish_ns, log_layout.MAX_TIME_NS)
        self._file.add_message(self._standard[topic], log_ns, data, publish_ns)

    def flush(self) -> None:
        """Closes the open chunk and hands it to the operating system: a crash loses nothing
        before it.

        Raises:
            LogRefused: the disk refused.
        """
        with self._refusing():
            self._file.flush()

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Writes the accounts, the index and the end mark, once; the stream stays open.

        Args:
            accounts: the accounts by topic, and other counts by name. Those of channels that
                the log does not take are left out.

        Raises:
            LogRefused: the disk refused.
        """
        if self._ended == _FINISHED:
            return
        whole = not self._ended
        self._ended = _FINISHED
        left_out = {f"/{key}" for key, channel in self._channels.items() if channel is None}
        taken = {name: text for name, text in accounts.items() if name not in left_out}
        with self._refusing():
            try:
                if self._views is not None and whole:
                    self._views.finish(self._last_log_ns)
            finally:
                self._file.add_metadata(log_layout.ACCOUNTS, taken)
                self.records_digest = self._file.close_digest()["records"]
                self._file.finish()

    @contextmanager
    def _refusing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise self._refused(error) from None

    def _refused(self, error: OSError) -> LogRefused:
        text = f"the log cannot be written: {error.strerror}; what was flushed before is intact"
        self._ended = self._ended or text
        return LogRefused(text)


_FINISHED = "the log is finished"

ACCOUNTS_BYTES = 16 << 10
"""Space for the accounts of a part, and for the messages for viewers that one message causes.
"""


@dataclass(frozen=True, slots=True)
class LogStorage:
    """Place and form of a log.

    Attributes:
        path: its name; parts add their number to it.
        force: True if it may replace a file.
        durable: True if every flush syncs it.
        split_bytes: largest length of a part.
        split_ns: longest time of a part.
        carry_on: True to write the part after a log of that name, finished or not.
        choice: the channels that it takes.
        views_hz: messages a second of the channels for viewers, see `VizChannels`; 0 for none.
    """

    path: Path
    force: bool = False
    durable: bool = False
    split_bytes: int | None = None
    split_ns: int | None = None
    carry_on: bool = False
    choice: log_layout.ChannelFilter = log_layout.ALL_CHANNELS
    views_hz: float = 0.0

    @property
    def splits(self) -> bool:
        """True if it has parts from the start."""
        return self.split_bytes is not None or self.split_ns is not None

    def first(self) -> tuple[int, str]:
        """Returns the number of the part to begin with, 0 for a log without parts, and the part
        before it.

        Raises:
            UsageError: the name is taken, and not just one of `force` and `carry_on` is given.
        """
        if self.carry_on and self.force:
            raise UsageError(
                "--continue keeps what exists, --force replaces it; give one of them"
            )
        there = log_layout.find_parts(self.path)
        if self.carry_on and there:
            last = max(there)
            return last + 1, there[last].name.removesuffix(log_layout.ACTIVE_SUFFIX)
        refuse_existing(
            self.path, force=self.force, unfinished=log_layout.active_path(self.path)
        )
        if self.splits and there and not self.force:
            ways = "choose another name, carry on behind it with --continue, or replace it with --force"
            raise UsageError(f"{there[max(there)]}: exists; {ways}")
        return int(self.splits), ""


def parse_split(option: str, unit: str, number: float | None, scale: int) -> int | None:
    """Returns the limit of a part, as an option of a command states it in units of `scale`;
    None for none.

    Raises:
        UsageError: a part cannot be that small or that large.
    """
    if number is None:
        return None
    if not 1.0 <= number <= 1e6:
        raise UsageError(f"{option} is a number of {unit} from 1 to 1e6, not {number:g}")
    return int(number * scale)


class LogParts:
    """A `LogWriter` over as many files as it takes; for use in a `with` statement.

    Args:
        storage: place and form of the log.
        begin: begins the log in a file, with the metadata of the part ({} for a log without
            parts).
        opened: opens a file by name; by default `LogFile`.

    Attributes:
        current_accounts: returns the accounts for a part that is full.

    Raises:
        UsageError: the name is taken, or the file cannot be made.
        LogRefused: the disk refused.
    """

    def __init__(
        self,
        storage: LogStorage,
        begin: Callable[[Sink, Mapping[str, str]], LogWriter],
        opened: Callable[[Path], LogFile] | None = None,
    ) -> None:
        self._opened = opened or (
            lambda path: LogFile(path, force=storage.force, durable=storage.durable)
        )
        self.current_accounts: Callable[[], Mapping[str, str]] = dict
        self._storage = storage
        self._begin_log = begin
        self._number, self._previous = storage.first()
        self._previous_digest = ""
        # what was left of a log would seem to belong to the new one
        if storage.force and storage.splits:
            for number in (0, *log_layout.find_parts(storage.path)):
                name = log_layout.part_path(storage.path, number)
                name.unlink(missing_ok=True)
                log_layout.active_path(name).unlink(missing_ok=True)
        self._since_ns: int | None = None
        self._before_bytes = 0
        self._begin()

    def _begin(self) -> None:
        path = log_layout.part_path(self._storage.path, self._number)
        part = {"index": str(self._number), "previous": self._previous} if self._number else {}
        if self._previous_digest:
            part[PREVIOUS_DIGEST_KEY] = self._previous_digest
        self._file = file = self._opened(path)
        try:
            self._writer = self._begin_log(file, part)
        except LogRefused as error:
            file.discard()
            raise (
                error if file.disk_error is None else file.refused(file.disk_error)
            ) from None
        self._since_ns = None
        self._previous = path.name

    def _roll(self) -> None:
        self._writer.finish(self.current_accounts())
        self._previous_digest = self._writer.records_digest
        self._before_bytes += self._writer.written_bytes
        self._file.end()
        self._number += 1
        try:
            self._begin()
        except UsageError as error:  # the caller's no more: the disk took the parts before
            raise LogRefused(f"{error}; the log ends with {self._previous}") from None

    def _full(self, payload: bytes, log_time_ns: int) -> bool:
        limit = self._storage
        writer = self._writer
        if self._since_ns is None:
            self._since_ns = log_time_ns
        if limit.split_ns is not None and log_time_ns - self._since_ns >= limit.split_ns:
            return True
        size = writer.most_bytes + len(payload) + ACCOUNTS_BYTES
        return (
            limit.split_bytes is not None and writer.messages > 0 and size > limit.split_bytes
        )

    @property
    def path(self) -> Path:
        """Name of the file that is being written, once it is whole."""
        return self._file.path

    @property
    def written_bytes(self) -> int:
        """How many bytes all parts have so far."""
        return self._before_bytes + self._writer.written_bytes

    def add(
        self,
        key: str,
        payload: bytes,
        t_ns: int,
        log_time_ns: int,
        number: int,
        message: Decoded = None,
    ) -> None:
        """Writes one message; see `LogWriter.add`."""
        if self._storage.splits and not self._writer.ended and self._full(payload, log_time_ns):
            self._roll()
            self._since_ns = log_time_ns
        self._writer.add(key, payload, t_ns, log_time_ns, number, message)

    def flush(self) -> None:
        """Hands everything so far to the operating system; see `LogWriter.flush`."""
        self._writer.flush()

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Ends the last part; see `LogWriter.finish`."""
        self._writer.finish(accounts)

    def __enter__(self) -> "LogParts":
        return self

    def __exit__(
        self, _: type[BaseException] | None, error: BaseException | None, __: object
    ) -> None:
        self._file.end(error)
