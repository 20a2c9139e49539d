"""Writes the log of a session to a single MCAP file or to several parts.

The parts of run.mcap are called run-001.mcap, run-002.mcap and so on. A part ends when it
reaches the size or the duration set by the user.

Invariant (L5):
    - Every file can be understood on its own: the session, the scenario and the schemas precede
      the first message.
    - Messages are stored byte for byte as they were published.
    - The accounts (counts of received and missing messages) are at the end of the file.
    - Each part repeats the session, the scenario and the schemas, and names the previous part.
    - Each message is in exactly one part, because the writing thread starts a new part only
      between two messages.
"""

import glob
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from ..errors import LogRefused, UsageError
from ..files import refuse_existing
from ..net import VERSION, Event, LinkStats, State, json_schema, topics
from ..records import TickRecord
from . import log_layout
from .log_file import LogFile
from .mcap_writer import McapWriter, Sink
from .running_digest import ALGORITHM, DIGESTS_KEY, PREVIOUS_DIGEST_KEY
from .session_scenario import SessionScenario

Decoded = State | TickRecord | LinkStats | Event | None
"""Decoded message, from which messages for viewers are derived. None if no viewer needs it."""
ReceiveMessage = Callable[[Any, int], None]
"""Function that takes one message of the session and its arrival time in Unix time, in ns."""
PutMessage = Callable[[str, bytes, int, int], None]
"""Function that writes one message, given its topic, bytes, and sending and arrival times in
Unix time, in ns.
"""


class _ViewChannels(Protocol):
    """Maps the topic of each channel for viewers to its number in a file."""

    def __getitem__(self, topic: str) -> int:
        """Returns the number of a topic's channel in an MCAP file.

        The channel is registered in the file on first access, so that the file declares no
        channel without messages.
        """


class _LogViews(Protocol):
    """Protocol for deriving messages for general viewers from the messages of a session.

    Viewers such as Foxglove cannot read the program's own format.
    `ros2.viz_channels.VizChannels` derives standard ROS 2 messages.

    Attributes:
        receivers: Maps the key of messages of the session to the function that receives these
            messages.
    """

    receivers: dict[str, ReceiveMessage]

    @property
    def most_bytes(self) -> int:
        """Upper bound on the size of viewer messages that are still to be written, in bytes.

        A writer adds this size when it decides whether the next message still fits into the
        file.
        """

    def open_channels(self, file: McapWriter) -> _ViewChannels:
        """Returns the channels of a file that viewers such as Foxglove display.

        A channel is registered in the file only when its first message is written.

        Args:
            file: Writer of the MCAP file.
        """

    def finish(self, log_ns: int) -> None:
        """Writes the remaining messages for viewers such as Foxglove at the end of the log.

        Args:
            log_ns: Arrival time of the last message of the session in Unix time, in ns.
        """


MakeViews = Callable[[str, int, PutMessage], _LogViews]
"""Function that creates the views of one file.

Its arguments are the name of the session, the Unix time of tick 0 in ns, and the function that
writes a message.
"""


class LogWriter:
    """Writes the messages of a session, and everything that describes them, to one log file.

    Besides the messages as published, it can write messages for viewers that are derived from
    them.

    Args:
        stream: File or buffer to write to.
        scenario: Scenario of the session.
        session: Name of the session.
        driver: Kind of time in the session: "live" or "virtual".
        epoch_unix_ns: Unix time of tick 0, in ns; 0 in virtual time.
        provenance: Facts about the program that writes the log, see `provenance`.
        facts: Further metadata of the session.
        part: Metadata of the part, if the log consists of several files.
        choice: Filter that selects the channels to store in the log.
        make_views: Creates the messages for viewers. If None, the log contains no such
            messages.

    Attributes:
        records_digest: Digest of the messages of a finished log. Empty until then.

    Raises:
        LogRefused: Writing to the disk failed.
    """

    def __init__(
        self,
        stream: Sink,
        scenario: SessionScenario,
        session: str,
        driver: str,
        epoch_unix_ns: int,
        provenance: Mapping[str, str],
        facts: Mapping[str, str] | None = None,
        *,
        part: Mapping[str, str] | None = None,
        choice: log_layout.ChannelFilter = log_layout.ALL_CHANNELS,
        make_views: MakeViews | None = None,
    ) -> None:
        self._epoch_unix_ns = epoch_unix_ns
        self.records_digest = ""
        # Reason why no message can be added any more. Empty while the log is open.
        self._end_reason = ""
        self._views: _LogViews | None = None
        self._view_receivers: dict[str, ReceiveMessage] = {}
        if make_views is not None:
            self._views = make_views(session, epoch_unix_ns, self._add_view_message)
            self._view_receivers = self._views.receivers
        self._last_log_ns = 0
        self._file = McapWriter(stream, f"trilat-net {provenance['version_trilat-net']}")
        self._view_channels: _ViewChannels = {}
        if self._views is not None:
            self._view_channels = self._views.open_channels(self._file)
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
        self, scenario: SessionScenario, session: str, choice: log_layout.ChannelFilter
    ) -> dict[str, int | None]:
        """Registers all topics of a session and their message formats in the log file.

        Args:
            scenario: Scenario of the session.
            session: Name of the session.
            choice: Filter that selects the channels to store in the log.

        Returns:
            Maps the key of each channel to its number in the file, or None if it is excluded.
        """
        # A schema describes the fields of one kind of messages.
        schemas: dict[str, int] = {}
        for name, kind in log_layout.CHANNEL_TYPES.items():
            schema_name = f"trilat.{kind.__name__}.v{VERSION}"
            schema_text = json.dumps(json_schema(kind)).encode()
            schemas[name] = self._file.register_schema(schema_name, "jsonschema", schema_text)

        channels: dict[str, int | None] = {}
        for member in (*scenario.names, topics.RECORDER):
            is_site = member != topics.RECORDER
            names = log_layout.SITE_CHANNELS if is_site else log_layout.RECORDER_CHANNELS
            for name in names:
                key = topics.key(session, member, name)
                metadata = {"member": member}
                if name == topics.STATE:
                    metadata["rate_hz"] = str(scenario.sites[member].rate_hz)
                channels[key] = None
                if choice.accepts(key):
                    channels[key] = self._file.register_channel(
                        f"/{key}", "msgpack", schemas[name], metadata
                    )
        return channels

    @property
    def ended(self) -> bool:
        """True if no more messages can be added: the log is finished, or a write has failed.

        Messages that arrive later will be missing from this file.
        """
        return bool(self._end_reason)

    @property
    def messages(self) -> int:
        """Number of messages in the log, including those that are not yet on the disk."""
        return self._file.messages

    @property
    def written_bytes(self) -> int:
        """Number of bytes of the log file written so far."""
        return self._file.position

    @property
    def most_bytes(self) -> int:
        """Upper bound on the size of the finished file without its message counts, in bytes.

        The bound applies if the file is finished now. It is used to decide whether another
        message still fits into a part of limited size.
        """
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
        """Adds a network message to the log, unless the user's filter excludes its channel.

        Args:
            key: Key of the channel.
            payload: Bytes of the message.
            t_ns: Sending time since the start of the session, in ns.
            log_time_ns: Arrival time in Unix time, in ns.
            number: Sequence number.
            message: The decoded message, if the log contains messages for viewers.

        Raises:
            LogRefused: Writing to the disk failed, in this call or an earlier one, or the log
                is already finished.
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
        """Adds a message for viewers such as Foxglove to the log.

        Args:
            topic: Topic of the message.
            data: Bytes of the message.
            publish_ns: Sending time in Unix time, in ns.
            log_ns: Arrival time in Unix time, in ns.
        """
        publish_ns = min(publish_ns, log_layout.MAX_TIME_NS)
        self._file.add_message(self._view_channels[topic], log_ns, data, publish_ns)

    def flush(self) -> None:
        """Passes all messages so far to the operating system, so that a crash cannot lose them.

        Raises:
            LogRefused: Writing to the disk failed.
        """
        with self._translate_disk_errors():
            self._file.flush()

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Completes the file so that other programs can read it.

        Writes the message counts, the index and the end mark. The stream stays open. Further
        calls have no effect.

        Args:
            accounts: Maps each topic to a string with its numbers of received and missing
                messages, and the names of other counts to their values. Topics that the log
                does not record are left out.

        Raises:
            LogRefused: Writing to the disk failed.
        """
        if self._end_reason == _FINISHED:
            return
        is_intact = not self._end_reason
        self._end_reason = _FINISHED
        excluded_topics = {
            f"/{key}" for key, channel in self._channels.items() if channel is None
        }
        included_accounts = {
            name: text for name, text in accounts.items() if name not in excluded_topics
        }
        with self._translate_disk_errors():
            try:
                if self._views is not None and is_intact:
                    self._views.finish(self._last_log_ns)
            finally:
                self._file.add_metadata(log_layout.ACCOUNTS, included_accounts)
                self.records_digest = self._file.close_digest()["records"]
                self._file.finish()

    @contextmanager
    def _translate_disk_errors(self) -> Iterator[None]:
        """Converts an OSError in the `with` block to a LogRefused, and ends the log."""
        try:
            yield
        except OSError as error:
            raise self._end_with_error(error) from None

    def _end_with_error(self, error: OSError) -> LogRefused:
        """Ends the log after a disk error, and returns the error to raise."""
        text = f"the log cannot be written: {error.strerror}; flushed messages are intact"
        self._end_reason = self._end_reason or text
        return LogRefused(text)


_FINISHED = "the log is finished"
"""Reason why no message can be added to a finished log."""

_ACCOUNTS_BYTES = 16 << 10
"""Space left free in a part of limited size, in bytes.

Reserved for the accounts, and for the viewer messages that result from one message.
"""


@dataclass(frozen=True, slots=True)
class LogStorage:
    """Path of a log, and the size or duration at which the log continues in a new file.

    Attributes:
        path: Name of the log. The names of its parts also contain a number.
        force: True to allow replacing an existing log.
        durable: True to sync the file to the disk at every flush, so that a power failure does
            not damage the log.
        split_bytes: Maximum size of a part, in bytes. If None, unlimited.
        split_ns: Maximum duration of a part, in ns. If None, unlimited.
        carry_on: True to continue an existing log of this name, finished or not, with a new
            part.
        choice: Filter that selects the channels to store in the log.
    """

    path: Path
    force: bool = False
    durable: bool = False
    split_bytes: int | None = None
    split_ns: int | None = None
    carry_on: bool = False
    choice: log_layout.ChannelFilter = log_layout.ALL_CHANNELS

    @property
    def splits(self) -> bool:
        """True if the log is split into several files by a limit on size or duration.

        Without a limit, a log has several files only if an existing log was continued.
        """
        return self.split_bytes is not None or self.split_ns is not None

    def find_parts(self) -> dict[int, Path]:
        """Finds the existing files of the log, which may be split into parts.

        Both finished files and files that are still being recorded are included.

        Returns:
            Maps the number of each part to its file. A file with the name of the log counts as
            part 1. Empty if there are no files.
        """
        parts: dict[int, Path] = {}
        for file in (self.path, log_layout.active_path(self.path)):
            if file.exists():
                parts.setdefault(1, file)
        for file in sorted(self.path.parent.glob(f"{glob.escape(self.path.stem)}-*")):
            finished = file.with_name(file.name.removesuffix(log_layout.ACTIVE_SUFFIX))
            match = log_layout.PART_STEM.fullmatch(finished.stem)
            if match and match[1] == self.path.stem and finished.suffix == self.path.suffix:
                parts.setdefault(int(match[2]), file)
        return parts

    def find_first_part(self) -> tuple[int, str]:
        """Determines which file to write first, and checks that its name is free.

        A log may consist of several numbered files, its parts. If an existing log is continued,
        the new part is numbered after the last one.

        Returns:
            The number of the part (0 if the log is a single file), and the name of the previous
            part (empty if there is none).

        Raises:
            UsageError: A log of this name exists, and neither `force` nor `carry_on` is set.
                Also raised if both are set.
        """
        if self.carry_on and self.force:
            raise UsageError(
                "--continue keeps the existing files and --force replaces them; give only one "
                "of these options"
            )
        parts = self.find_parts()
        if self.carry_on and parts:
            last = max(parts)
            return last + 1, parts[last].name.removesuffix(log_layout.ACTIVE_SUFFIX)

        refuse_existing(
            self.path, force=self.force, unfinished=log_layout.active_path(self.path)
        )
        if self.splits and parts and not self.force:
            raise UsageError(
                f"{parts[max(parts)]} already exists; choose another name, continue the log "
                "with --continue, or replace it with --force"
            )
        return int(self.splits), ""


class LogParts:
    """Context manager that writes a log, split into files according to its limits.

    Args:
        storage: Path of the log and limits on the size and duration of its parts.
        begin: Function that creates the `LogWriter` of a file, given the metadata of the part.
            The metadata are empty for a log in a single file.
        opened: Function that opens a file, given its path. If None, `LogFile` is used.

    Attributes:
        current_accounts: Function that returns the accounts (counts of received and missing
            messages of each topic) to write at the end of a full part.

    Raises:
        UsageError: The name is in use, or the file cannot be created.
        LogRefused: Writing to the disk failed.
    """

    def __init__(
        self,
        storage: LogStorage,
        begin: Callable[[Sink, Mapping[str, str]], LogWriter],
        opened: Callable[[Path], LogFile] | None = None,
    ) -> None:
        """Creates the first file of the log, which may be split into several files.

        If a file of the same name exists, an error is raised before anything is created.
        """
        self._open_file = opened or (
            lambda path: LogFile(path, force=storage.force, durable=storage.durable)
        )
        self.current_accounts: Callable[[], Mapping[str, str]] = dict
        self._storage = storage
        self._begin_writer = begin
        self._number, self._previous = storage.find_first_part()
        self._previous_digest = ""
        # All parts of a replaced log are removed, because remaining parts would seem to belong
        # to the new log.
        if storage.force and storage.splits:
            for number in (0, *storage.find_parts()):
                path = log_layout.part_path(storage.path, number)
                path.unlink(missing_ok=True)
                log_layout.active_path(path).unlink(missing_ok=True)
        self._part_start_ns: int | None = None
        self._previous_bytes = 0
        self._begin_part()

    def _begin_part(self) -> None:
        """Opens the next file of the log, and writes its beginning.

        A log that is split consists of several numbered files, its parts. If the beginning
        cannot be written, the file is deleted.

        Raises:
            UsageError: The file cannot be created.
            LogRefused: Writing to the disk failed.
        """
        path = log_layout.part_path(self._storage.path, self._number)
        part_metadata: dict[str, str] = {}
        if self._number:
            part_metadata = {"index": str(self._number), "previous": self._previous}
        if self._previous_digest:
            part_metadata[PREVIOUS_DIGEST_KEY] = self._previous_digest
        self._file = file = self._open_file(path)
        try:
            self._writer = self._begin_writer(file, part_metadata)
        except LogRefused:
            file.discard()
            if file.disk_error is None:
                raise
            raise file.refused(file.disk_error) from None
        self._part_start_ns = None
        self._previous = path.name

    def _begin_next_part(self) -> None:
        """Finishes the current file, and begins the next file of the same log.

        Raises:
            LogRefused: The file cannot be created, or writing to the disk failed.
        """
        self._writer.finish(self.current_accounts())
        self._previous_digest = self._writer.records_digest
        self._previous_bytes += self._writer.written_bytes
        self._file.end()
        self._number += 1
        try:
            self._begin_part()
        except UsageError as error:
            # The name was checked at the start, so this is not a mistake of the user.
            raise LogRefused(f"{error}; the log ends with {self._previous}") from None

    def _is_part_full(self, payload_bytes: int, duration_ns: int) -> bool:
        """Returns True if the next message would exceed a limit of the current file.

        These are the limits on size and duration at which a log is split.

        Args:
            payload_bytes: Size of the next message, in bytes.
            duration_ns: Time from the first message of the part to the next message, in ns.
        """
        limits = self._storage
        writer = self._writer
        if limits.split_ns is not None and duration_ns >= limits.split_ns:
            return True
        # A part contains at least one message, however small the limit is.
        if limits.split_bytes is None or not writer.messages:
            return False
        size = writer.most_bytes + payload_bytes + _ACCOUNTS_BYTES
        return size > limits.split_bytes

    @property
    def path(self) -> Path:
        """Final name of the file that is being written, such as run-002.mcap for part 2.

        Until it is complete, the file has another name that ends in ".active".
        """
        return self._file.path

    @property
    def written_bytes(self) -> int:
        """Number of bytes written to all files of the log so far."""
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
        """Adds a message to the log.

        If the current part has reached its maximum size or duration, a new part is started
        first.

        Args:
            key: Key of the channel.
            payload: Bytes of the message.
            t_ns: Sending time since the start of the session, in ns.
            log_time_ns: Arrival time in Unix time, in ns.
            number: Sequence number of the message.
            message: The decoded message, if the log contains messages for viewers.

        Raises:
            LogRefused: Writing to the disk failed, in this call or an earlier one.
        """
        if self._storage.splits and not self._writer.ended:
            if self._part_start_ns is None:
                self._part_start_ns = log_time_ns
            duration_ns = log_time_ns - self._part_start_ns
            if self._is_part_full(len(payload), duration_ns):
                self._begin_next_part()
                self._part_start_ns = log_time_ns
        self._writer.add(key, payload, t_ns, log_time_ns, number, message)

    def flush(self) -> None:
        """Passes all messages so far to the operating system, so that a crash cannot lose them.

        A power failure can still lose messages, because the operating system writes to the disk
        later.

        Raises:
            LogRefused: Writing to the disk failed.
        """
        self._writer.flush()

    def finish(self, accounts: Mapping[str, str]) -> None:
        """Completes the last file of the log and gives it its final name.

        Args:
            accounts: Maps each topic to a string with its numbers of received and missing
                messages, and the names of other counts to their values.

        Raises:
            LogRefused: Writing to the disk failed.
        """
        self._writer.finish(accounts)

    def __enter__(self) -> "LogParts":
        return self

    def __exit__(
        self, _: type[BaseException] | None, error: BaseException | None, __: object
    ) -> None:
        self._file.end(error)
