"""Writer of a session's log into one MCAP file or into several parts.

Parts have numbered names: `run-001.mcap`, `run-002.mcap` and so on.

Invariant (L5):
    - A file explains itself from its first bytes on: session, scenario and schemas precede the
      first message.
    - Payloads are stored byte for byte as published.
    - The accounts are at the end of the file.
    - Each part repeats session, scenario and schemas, and names the part before it.
    - Each message is in exactly one part: a new part begins between two messages, on the
      writing thread.
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
from .ros2.viz_channels import ReceiveMessage, VizChannels
from .running_digest import ALGORITHM, DIGESTS_KEY, PREVIOUS_DIGEST_KEY

Decoded = State | TickRecord | LinkStats | Event | None
"""A decoded message for the channels for viewers; None if the log has no such channels."""


class LogWriter:
    """Writer of one log file, from its header to its accounts.

    Args:
        stream: receives the bytes.
        scenario: the resolved scenario.
        session: the session's name.
        driver: "live" or "virtual".
        epoch_unix_ns: Unix time of tick 0; 0 in virtual time.
        facts: further metadata of the session.
        part: metadata of the part, for a log in parts.
        choice: the channels that the log stores.
        views_hz: rate of the channels for viewers, in messages per second, see `VizChannels`; 0
            for a log without such channels.

    Attributes:
        records_digest: digest of the messages of a finished log; "" before the end.

    Raises:
        LogRefused: the disk refused a write.
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
        # Why no message can be added any more; "" while the log is open.
        self._end_reason = ""
        self._views = None
        if views_hz:
            self._views = VizChannels(
                scenario=scenario,
                session=session,
                epoch_unix_ns=epoch_unix_ns,
                views_hz=views_hz,
                put=self._add_view_message,
            )
        self._view_receivers: dict[str, ReceiveMessage] = (
            self._views.receivers if self._views else {}
        )
        self._last_log_ns = 0
        provenance = log_layout.collect_provenance()
        self._file = McapWriter(stream, f"trilat-net {provenance['version_trilat-net']}")
        self._view_channels = StandardChannels(
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
        about |= {**provenance, **choice.facts(), **(facts or {})}
        with self._translate_disk_errors():
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
            self._channels = self._register_channels(scenario, session, choice)
            self._file.flush()

    def _register_channels(
        self, scenario: Scenario, session: str, choice: log_layout.ChannelFilter
    ) -> dict[str, int | None]:
        """Registers schemas and channels of the session.

        Returns:
            Channel numbers by key; None for the channels that `choice` excludes.
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
            names = log_layout.SITE_CHANNELS if is_site else log_layout.RECORDER_CHANNELS
            for name in names:
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
        """True if no message can be added: the log is finished, or the disk refused a write."""
        return bool(self._end_reason)

    @property
    def messages(self) -> int:
        """Number of messages in the file."""
        return self._file.messages

    @property
    def written_bytes(self) -> int:
        """Number of bytes written so far."""
        return self._file.position

    @property
    def most_bytes(self) -> int:
        """Upper bound of the file's length without accounts, if the log were finished now."""
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
        """Writes one message, unless the log excludes its channel.

        Args:
            key: key of the channel.
            payload: bytes of the message.
            t_ns: time of sending, in ns since the epoch.
            log_time_ns: time of arrival, in Unix ns.
            number: sequence number.
            message: the decoded message, for the channels for viewers.

        Raises:
            LogRefused: the disk refused this write or an earlier write, or the log is finished.
        """
        if self._end_reason:
            raise LogRefused(self._end_reason)
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
            receive_view = self._view_receivers.get(key)
            if message is not None and receive_view is not None:
                receive_view(message, log_time_ns)
        except OSError as error:
            raise self._end_with_error(error) from None

    def _add_view_message(self, topic: str, data: bytes, publish_ns: int, log_ns: int) -> None:
        """Writes a message of a channel for viewers."""
        publish_ns = min(publish_ns, log_layout.MAX_TIME_NS)
        self._file.add_message(self._view_channels[topic], log_ns, data, publish_ns)

    def flush(self) -> None:
        """Closes the open chunk and hands its bytes to the operating system.

        A later crash of the process loses none of these messages.

        Raises:
            LogRefused: the disk refused a write.
        """
        with self._translate_disk_errors():
            self._file.flush()

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Writes the accounts, the index and the end mark; the stream stays open.

        Further calls have no effect.

        Args:
            accounts: accounts by topic, and other counts by name. Accounts of excluded channels
                are left out.

        Raises:
            LogRefused: the disk refused a write.
        """
        if self._end_reason == _FINISHED:
            return
        is_intact = not self._end_reason
        self._end_reason = _FINISHED
        excluded = {f"/{key}" for key, channel in self._channels.items() if channel is None}
        included = {name: text for name, text in accounts.items() if name not in excluded}
        with self._translate_disk_errors():
            try:
                if self._views is not None and is_intact:
                    self._views.finish(self._last_log_ns)
            finally:
                self._file.add_metadata(log_layout.ACCOUNTS, included)
                self.records_digest = self._file.close_digest()["records"]
                self._file.finish()

    @contextmanager
    def _translate_disk_errors(self) -> Iterator[None]:
        """Turns an OSError of the `with` block into LogRefused and ends the log."""
        try:
            yield
        except OSError as error:
            raise self._end_with_error(error) from None

    def _end_with_error(self, error: OSError) -> LogRefused:
        """Ends the log after a failed write; returns the error to raise."""
        text = f"the log cannot be written: {error.strerror}; flushed messages are intact"
        self._end_reason = self._end_reason or text
        return LogRefused(text)


_FINISHED = "the log is finished"

ACCOUNTS_BYTES = 16 << 10
"""Space that a part keeps free, in bytes.

The space is for the accounts and for the messages for viewers that one message causes.
"""


@dataclass(frozen=True, slots=True)
class LogStorage:
    """Path and division into parts of a log.

    Attributes:
        path: path of the log; parts add their number to this name.
        force: True if the log may replace an existing file.
        durable: True if every flush also syncs the file to the disk.
        split_bytes: largest length of a part, in bytes; None for no limit.
        split_ns: longest duration of a part, in ns; None for no limit.
        carry_on: True to continue an existing log of this name, finished or not, with a new
            part.
        choice: the channels that the log stores.
        views_hz: rate of the channels for viewers, in messages per second, see `VizChannels`; 0
            for a log without such channels.
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
        """True if the log has parts from the start."""
        return self.split_bytes is not None or self.split_ns is not None

    def find_first_part(self) -> tuple[int, str]:
        """Finds the first part to write.

        Returns:
            Number of the part, 0 for a log without parts, and name of the part before it, "" if
            there is no such part.

        Raises:
            UsageError: a log of this name exists and neither `force` nor `carry_on` is set, or
                both are set.
        """
        if self.carry_on and self.force:
            raise UsageError(
                "--continue keeps what exists, --force replaces it; give one of them"
            )
        parts = log_layout.find_parts(self.path)
        if self.carry_on and parts:
            last = max(parts)
            return last + 1, parts[last].name.removesuffix(log_layout.ACTIVE_SUFFIX)
        refuse_existing(
            self.path, force=self.force, unfinished=log_layout.active_path(self.path)
        )
        if self.splits and parts and not self.force:
            raise UsageError(
                f"{parts[max(parts)]}: exists; choose another name, continue the log with "
                "--continue, or replace it with --force"
            )
        return int(self.splits), ""


def parse_split(option: str, unit: str, number: float | None, scale: int) -> int | None:
    """Returns the limit of a part that an option of a command sets, in ns or bytes.

    Args:
        option: name of the option, for the error text.
        unit: name of the option's unit, for the error text.
        number: value of the option; None, and thus no limit, if the option is absent.
        scale: ns or bytes per unit.

    Raises:
        UsageError: the number is not from 1 to 1e6.
    """
    if number is None:
        return None
    if not 1.0 <= number <= 1e6:
        raise UsageError(f"{option} is a number of {unit} from 1 to 1e6, not {number:g}")
    return int(number * scale)


class LogParts:
    """Writer of a log in as many files as its limits require; for use in a `with` statement.

    Args:
        storage: path of the log and its division into parts.
        begin: creates the `LogWriter` of a file, with the metadata of the part ({} for a log
            without parts).
        opened: opens a file by path; by default `LogFile`.

    Attributes:
        current_accounts: returns the accounts to write at the end of a full part.

    Raises:
        UsageError: the name is in use, or the file cannot be created.
        LogRefused: the disk refused a write.
    """

    def __init__(
        self,
        storage: LogStorage,
        begin: Callable[[Sink, Mapping[str, str]], LogWriter],
        opened: Callable[[Path], LogFile] | None = None,
    ) -> None:
        self._open_file = opened or (
            lambda path: LogFile(path, force=storage.force, durable=storage.durable)
        )
        self.current_accounts: Callable[[], Mapping[str, str]] = dict
        self._storage = storage
        self._begin_writer = begin
        self._number, self._previous = storage.find_first_part()
        self._previous_digest = ""
        # Remaining parts of a replaced log would seem to belong to the new log.
        if storage.force and storage.splits:
            for number in (0, *log_layout.find_parts(storage.path)):
                path = log_layout.part_path(storage.path, number)
                path.unlink(missing_ok=True)
                log_layout.active_path(path).unlink(missing_ok=True)
        self._part_start_ns: int | None = None
        self._previous_bytes = 0
        self._begin_part()

    def _begin_part(self) -> None:
        """Opens the file of the current part and writes its header."""
        path = log_layout.part_path(self._storage.path, self._number)
        part: dict[str, str] = {}
        if self._number:
            part = {"index": str(self._number), "previous": self._previous}
        if self._previous_digest:
            part[PREVIOUS_DIGEST_KEY] = self._previous_digest
        self._file = file = self._open_file(path)
        try:
            self._writer = self._begin_writer(file, part)
        except LogRefused:
            file.discard()
            if file.disk_error is None:
                raise
            raise file.refused(file.disk_error) from None
        self._part_start_ns = None
        self._previous = path.name

    def _begin_next_part(self) -> None:
        """Finishes the current part and begins the next part."""
        self._writer.finish(self.current_accounts())
        self._previous_digest = self._writer.records_digest
        self._previous_bytes += self._writer.written_bytes
        self._file.end()
        self._number += 1
        try:
            self._begin_part()
        except UsageError as error:
            # After a first part this is no longer an error of the caller.
            raise LogRefused(f"{error}; the log ends with {self._previous}") from None

    def _is_part_full(self, payload_bytes: int, duration_ns: int) -> bool:
        """Returns True if the next message exceeds a limit of the current part."""
        limits = self._storage
        writer = self._writer
        if limits.split_ns is not None and duration_ns >= limits.split_ns:
            return True
        # A part holds at least one message, however small the limit is.
        if limits.split_bytes is None or not writer.messages:
            return False
        size = writer.most_bytes + payload_bytes + ACCOUNTS_BYTES
        return size > limits.split_bytes

    @property
    def path(self) -> Path:
        """Final path of the file that is being written."""
        return self._file.path

    @property
    def written_bytes(self) -> int:
        """Number of bytes in all parts so far."""
        return self._previous_bytes + self._writer.written_bytes

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
        if self._storage.splits and not self._writer.ended:
            if self._part_start_ns is None:
                self._part_start_ns = log_time_ns
            duration_ns = log_time_ns - self._part_start_ns
            if self._is_part_full(len(payload), duration_ns):
                self._begin_next_part()
                self._part_start_ns = log_time_ns
        self._writer.add(key, payload, t_ns, log_time_ns, number, message)

    def flush(self) -> None:
        """Hands all bytes so far to the operating system; see `LogWriter.flush`."""
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
