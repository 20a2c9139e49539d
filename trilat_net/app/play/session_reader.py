"""Reads the messages to be played from a log, selected by channel and time.

Playing a log means publishing its messages on the network again, with the timing of the
original session. Messages are identified by the boot of the site, a random number that is drawn
each time the site starts.

Invariant:
    - Payloads are passed on unchanged. Only the number of an event and the boot are decoded.
    - By default the messages of the sites are played, but neither the recorder's statistics nor
      the messages for viewers.
    - A log that is loaded before it is played has a limited size, so that the memory is bounded
      (L6). Another process reads a larger log while it is played (`message_source`).
"""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Literal, cast, get_args

import msgspec

from trilat_net import process
from trilat_net.errors import LogError, ScenarioError, UsageError, count_nouns
from trilat_net.files import reading
from trilat_net.net import topics
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Scenario, parse_embedded

from ...log import SCENARIO, SESSION, SITE_CHANNELS, ChannelFilter, McapReader, Progress
from ...net import number_message
from .batch import BatchBuilder, MessageBatch, PlayedMessage

PlayTime = Literal["publish", "log"]
"""The time at which a message is played: its sending time or its arrival time."""


@dataclass(frozen=True, slots=True)
class PlaySelection:
    """Selects which messages of a log are played, by channel and by time in ns.

    Attributes:
        channels: Channel filter. If it includes no channel explicitly, the channels of the
            sites are played.
        start_ns: Earliest time of a message, in ns after the start of the session. `None` for
            no limit.
        stop_ns: Latest time of a message, in ns after the start of the session. `None` for no
            limit.
        time: "publish" to use the sending time of each message, "log" to use its arrival time.
    """

    channels: ChannelFilter = field(default_factory=ChannelFilter)
    start_ns: int | None = None
    stop_ns: int | None = None
    time: PlayTime = "publish"

    def accepts(self, topic: str, sites: Collection[str]) -> bool:
        """Returns True if the messages of a channel (topic) of the log are played.

        By default, the channels of the sites are played. If the user includes channels
        explicitly, only the user's filter applies.

        Args:
            topic: Topic of the channel, such as "/trilat/paper/m1/state".
            sites: Names of the sites of the scenario.
        """
        key = topic.strip("/")
        parts = topics.parse_key(key)
        is_of_site = (
            parts is not None and parts.member in sites and parts.channel in SITE_CHANNELS
        )
        is_candidate = is_of_site or bool(self.channels.include)
        return is_candidate and self.channels.accepts(key)

    def contains(self, t_ns: int) -> bool:
        """Returns True if a time in ns lies in the selected interval, such as 5 s to 10 s.

        Args:
            t_ns: Time, for example of a message, in ns after the start of the session.
        """
        is_before = self.start_ns is not None and t_ns < self.start_ns
        is_after = self.stop_ns is not None and t_ns > self.stop_ns
        return not (is_before or is_after)

    @classmethod
    def parse(
        cls,
        include: Collection[str],
        exclude: Collection[str],
        start_s: float | None,
        stop_s: float | None,
        duration_s: float | None,
        time: str,
    ) -> "PlaySelection":
        """Parses the command-line options that select which messages of a log are played.

        The user limits the time interval with `--start` and with either `--stop` or
        `--duration`.

        Args:
            include: Key expressions from `--include`.
            exclude: Key expressions from `--exclude`.
            start_s: Value of `--start`, in s after the start of the session. `None` if absent.
            stop_s: Value of `--stop`, in s after the start of the session. `None` if absent.
            duration_s: Value of `--duration`, in s, an alternative to `stop_s`. `None` if
                absent.
            time: Value of `--time`, see `PlayTime`.

        Raises:
            UsageError: The options contradict each other, or an option is invalid.
        """
        if time not in get_args(PlayTime):
            raise UsageError(
                "--time must be publish (the time at which a message was sent) or log (the "
                f"time at which it arrived), not {time!r}"
            )

        for name, seconds in (
            ("--start", start_s),
            ("--stop", stop_s),
            ("--duration", duration_s),
        ):
            if seconds is None:
                continue
            is_reasonable = math.isfinite(seconds) and abs(seconds) <= 1e9
            if not is_reasonable:
                raise UsageError(f"{name} must be a number of seconds, not {seconds:g}")

        if duration_s is not None:
            if duration_s <= 0:
                raise UsageError(f"--duration must be more than 0 s, not {duration_s:g}")
            if stop_s is not None:
                raise UsageError(
                    "--stop and --duration set the same limit; give only one of them"
                )
            stop_s = (start_s or 0.0) + duration_s

        if start_s is not None and stop_s is not None and stop_s <= start_s:
            raise UsageError(f"--stop must be after --start ({start_s:g} s), not {stop_s:g} s")

        return cls(
            channels=ChannelFilter.parse(include, exclude),
            start_ns=None if start_s is None else round(start_s * NS_PER_S),
            stop_ns=None if stop_s is None else round(stop_s * NS_PER_S),
            time=cast(PlayTime, time),
        )


HORIZON_NS = 70 * NS_PER_S
"""Largest time by which a message may appear too late in a file, in ns. Sites keep their
messages for a minute, and send them again to recorders that missed them.
"""
_LAST = 1 << 61
"""Bound on times and numbers, so that wrong values in damaged files do not overflow."""
NUMBERS_OF_A_START = 1 << 40
"""Number that is added to the event numbers of each further start of a site. Otherwise, the
numbers would repeat, because events are numbered from 0 after each start.
"""


class PayloadHeader(msgspec.Struct):
    """The few fields of a message that the player decodes.

    They exist in all versions of the message format, so that old logs can be replayed.

    Attributes:
        boot: Random number that the sender drew when it started. It is -1 if it cannot be
            decoded.
        n: Number of the message, if it is an event that has a number. Otherwise -1.
    """

    boot: int = -1
    n: int = -1

    @staticmethod
    def decode(payload: bytes) -> "PayloadHeader":
        """Decodes the fields of a message, or returns the defaults if it cannot be decoded."""
        try:
            return _decoder.decode(payload)
        except (ValueError, RecursionError):
            return PayloadHeader()


_decoder = msgspec.msgpack.Decoder(PayloadHeader)


@dataclass(slots=True)
class SessionHeader:
    """Description of the recorded session, collected while its files are read.

    Attributes:
        session: Name of the recorded session.
        scenario: Scenario of the session.
        scenario_text: TOML text of the scenario, as stored in the log.
        fingerprint: String that identifies the platform on which the session was recorded.
        version: Version of the message format. 0 if it is unknown.
        boots: For each site, the random number that identifies its first start.
        topics: Topics of the channels that are played. The index of a topic is its channel
            index.
        torn: The damaged files, each with a description of the damage.
        first_ns: Time of the earliest message so far, in ns after the start of the session.
        last_ns: Time of the latest message so far, in ns after the start of the session.
    """

    session: str
    scenario: Scenario
    scenario_text: str
    fingerprint: str
    version: int
    boots: dict[str, int] = field(default_factory=dict)
    topics: list[str] = field(default_factory=list)
    torn: dict[Path, str] = field(default_factory=dict)
    first_ns: int = 2**62
    last_ns: int = -(2**62)

    def map_topic(self, topic: str, session: str) -> str:
        """Returns the key under which a channel of the log is published in another session.

        The name of the recorded session is replaced with that of the other session. A topic
        that does not belong to the recorded session is appended in full to the name of the
        other session, so that it cannot collide with another topic.

        Args:
            topic: Topic of the channel in the log.
            session: Name of the other session.
        """
        name_parts = topic.strip("/").split("/")
        if name_parts[:2] == [topics.ROOT, self.session]:
            name_parts = name_parts[2:]
        return "/".join([topics.ROOT, session, *name_parts])


class _PlayedChannel:
    """A channel (topic) of a log file, with a method that numbers its messages for playback.

    The messages are played in the order in which they were sent.

    Args:
        topic: Topic of the channel.
        header: Description of the session. The topic is added to it if the channel is played.
        selection: Which messages are played.

    Attributes:
        site: Name of the site. Empty if the channel belongs to another member or session.
        kind: "state", "link" or "event" for a channel of a site. Otherwise empty.
        rate_hz: Tick rate of the site, in Hz. It is 0 if the channel belongs to no site.
        channel_number: Number of the channel in `header.topics`. It is -1 if it is not played.
    """

    def __init__(self, topic: str, header: SessionHeader, selection: PlaySelection) -> None:
        parts = topics.parse_key(topic.strip("/"))
        sites = header.scenario.sites
        self.site = ""
        self.kind = ""
        self.rate_hz = 0

        is_of_session = parts is not None and parts.session == header.session
        if parts is not None and is_of_session and parts.member in sites:
            self.site = parts.member
            self.kind = parts.channel
            self.rate_hz = sites[self.site].rate_hz

        # A channel that is played gets the next number.
        self.channel_number = -1
        if selection.accepts(topic, sites):
            if topic not in header.topics:
                header.topics.append(topic)
            self.channel_number = header.topics.index(topic)
        # Number of events so far, for events that contain no number.
        self._event_count = 0
        # Index of each start of the site, by its boot.
        self._starts: dict[int, int] = {}

    def find_number(self, sequence: int, payload: bytes, t_ns: int) -> int:
        """Returns the number that determines the position of a message within its channel.

        The messages of a channel are played in order of these numbers. To reproduce the order
        in which the messages were originally published, three kinds of numbers are used:

        - Records and statistics of a site are numbered by their control period (tick). A site
          that was started again continues these numbers.
        - Events of a site are numbered from 0 after each start of the site. To distinguish the
          starts, a multiple of `NUMBERS_OF_A_START` is added.
        - Other messages have no number. Their time is used instead.

        Call this method exactly once per message, in file order, because it counts the events
        and the starts of the site.

        Args:
            sequence: Sequence number of the message in the file.
            payload: The encoded message.
            t_ns: Time of the message, in ns after the start of the session.

        Returns:
            The number, as defined by `PlayedMessage`.
        """
        if self.kind in (topics.STATE, topics.LINK):
            return number_message(self.kind, sequence, self.rate_hz)
        if self.kind != topics.EVENT:
            return t_ns

        header = PayloadHeader.decode(payload)
        event_index = self._event_count
        self._event_count += 1
        has_number = header.n >= 0
        if not has_number:
            # Before version 3 of the schema, events have no number. They are counted instead.
            return event_index

        # A new boot belongs to the next start of the site: the first one has the index 0.
        start_index = self._starts.setdefault(header.boot, len(self._starts))
        # A damaged file may contain numbers that are too large.
        number_in_start = min(header.n, NUMBERS_OF_A_START - 1)
        return min(start_index * NUMBERS_OF_A_START + number_in_start, _LAST)


class SessionReader:
    """Reads the messages of a recorded session from its log files, for playback.

    Args:
        paths: The files of the log. Several files must be parts of the same session, in order.
        selection: Which messages are played, by channel and time.
        progress: Function that is called periodically with the number of bytes read and the
            total number of bytes.

    Attributes:
        header: Description of the session. `None` before the first message.
    """

    def __init__(
        self, paths: Sequence[Path], selection: PlaySelection, progress: Progress | None = None
    ) -> None:
        self.header: SessionHeader | None = None
        self._paths = paths
        self._selection = selection
        self._progress = progress

    def messages(self) -> Iterator[PlayedMessage]:
        """Yields the messages to play, file by file, in the order in which they are stored.

        Raises:
            LogError: A file is missing, is not a log of trilat-net, or belongs to a different
                session from the first file.
        """
        for path in self._paths:
            with reading(path) as stream:
                reader = McapReader(stream, str(path), self._progress, kept=False)
                yield from self._read_file(path, reader)

    def preload(self, limit_bytes: int) -> tuple[SessionHeader, MessageBatch | None]:
        """Reads the header of the session, and its selected messages if they fit in memory.

        A short log is played from memory. If the messages need more memory than allowed, they
        are left to a reader process that is started later, and the file is searched only for
        the first messages of all sites.

        Args:
            limit_bytes: Memory limit for the messages, in bytes.

        Returns:
            The description of the session, and the messages in playback order, or `None` in
            place of the messages if they need more memory.

        Raises:
            LogError: A file is missing, or is not a log of trilat-net.
            UsageError: No message is selected.
        """
        waiting = BatchBuilder()
        first_path = self._paths[0]
        with process.pause_gc():
            messages = self.messages()
            for message in messages:
                waiting.add(*message)
                if waiting.memory > limit_bytes:
                    break
            else:  # the end of the files was reached
                if self.header is None:
                    raise LogError(f"{first_path} is empty")
                if not waiting.memory:
                    reason = _describe_empty_selection(first_path, self._selection, self.header)
                    raise UsageError(reason)
                return self.header, waiting.ordered()

            # The messages do not fit. Read on until the first message of each site.
            assert self.header is not None  # there was a message
            for _ in islice(messages, SEARCH_LIMIT):
                if self.header.boots.keys() >= self.header.scenario.sites.keys():
                    break
        return self.header, None

    def _read_file(self, path: Path, reader: McapReader) -> Iterator[PlayedMessage]:
        """Yields the messages of a log file that are replayed, and completes the header.

        The header describes the session. Each message is yielded with its time, the number of
        its channel, and the number that orders it within the channel.

        Args:
            path: The file.
            reader: Reader of the file.

        Raises:
            LogError: The file is not a log of trilat-net, or belongs to another session.
        """
        epoch_ns: int | None = None
        channels: dict[str, _PlayedChannel] = {}
        stop_ns = self._selection.stop_ns
        for item in reader.messages():
            if epoch_ns is None:
                # The reader has read the metadata when it yields the first message.
                epoch_ns, header = self._read_session(path, reader)

            t_ns = self._find_time_ns(item.publish_time_ns, item.log_time_ns, epoch_ns)
            arrival_ns = item.log_time_ns - epoch_ns
            # A message arrives later than it was sent, but by less than the horizon.
            if stop_ns is not None and arrival_ns > stop_ns + HORIZON_NS:
                return  # all further messages arrived even later

            channel = channels.get(item.topic)
            if channel is None:
                channel = _PlayedChannel(item.topic, header, self._selection)
                channels[item.topic] = channel
            header.first_ns = min(header.first_ns, t_ns)
            header.last_ns = max(header.last_ns, t_ns)

            # The first message of a site contains the boot, the random number of the site's
            # start.
            if channel.site and channel.site not in header.boots:
                boot = PayloadHeader.decode(item.payload).boot
                if boot >= 0:
                    header.boots[channel.site] = boot

            number = channel.find_number(item.sequence, item.payload, t_ns)
            if channel.channel_number >= 0 and self._selection.contains(t_ns):
                yield t_ns, channel.channel_number, number, item.payload

        if epoch_ns is None:
            _, header = self._read_session(path, reader)
        if not reader.complete:
            header.torn[path] = "the file was not finished"
        elif reader.damaged:
            header.torn[path] = f"damaged in {count_nouns(len(reader.damaged), 'place')}"

    def _find_time_ns(self, sent_ns: int, arrived_ns: int, epoch_ns: int) -> int:
        """Returns the time at which a message is played, in ns after the start of the session.

        A message was sent at one time and arrived at a later time. The user chooses which of
        the two times is used.

        Args:
            sent_ns: Time at which the message was sent, in Unix time, in ns.
            arrived_ns: Time at which the message arrived, in Unix time, in ns.
            epoch_ns: Start of the session, in Unix time, in ns.
        """
        t_ns = arrived_ns
        # An impossible sending time is replaced by the arrival time.
        is_possible = abs(sent_ns - arrived_ns) <= HORIZON_NS
        if self._selection.time == "publish" and is_possible:
            t_ns = sent_ns
        return min(max(t_ns - epoch_ns, -_LAST), _LAST)

    def _read_session(self, path: Path, reader: McapReader) -> tuple[int, SessionHeader]:
        """Reads the metadata of a file's session, and creates the header for the first file.

        All files must belong to the same session, because they are played as one session.

        Returns:
            The start of the session in Unix time, in ns, and the header.

        Raises:
            LogError: The file is not a log of trilat-net, or belongs to a different session
                from the previous files.
        """
        metadata = reader.metadata.get(SESSION, {})
        if "session" not in metadata or SCENARIO not in reader.attachments:
            raise LogError(f"{path} is an MCAP file, but not a trilat-net log")

        try:
            text = reader.attachments[SCENARIO].decode()
            epoch_ns = int(metadata.get("epoch_unix_ns", "0"))
            version = int(metadata.get("schema_version", "0"))
            if self.header is None:
                self.header = SessionHeader(
                    session=metadata["session"],
                    scenario=parse_embedded(text, f"{path}: scenario"),
                    scenario_text=text,
                    fingerprint=metadata.get("fingerprint", ""),
                    version=version,
                )
        except (ScenarioError, ValueError) as error:
            raise LogError(f"{path}: the session of the log cannot be read: {error}") from None

        is_same_session = (
            self.header.session == metadata["session"] and self.header.scenario_text == text
        )
        if not is_same_session:
            raise LogError(
                f"{path} belongs to a different session from {self._paths[0]}; the files of "
                "one replay must be parts of the same log"
            )
        return epoch_ns, self.header


SEARCH_LIMIT = 100_000
"""Number of further messages, beyond those that fit into memory, that are searched for starts
of sites.
"""


def _describe_empty_selection(
    path: Path, selection: PlaySelection, header: SessionHeader
) -> str:
    """Explains to the user why no message is selected, and what the log contains.

    A wrong start or end is named. Otherwise the filter of the channels is the reason.
    """
    if header.last_ns < header.first_ns:
        return f"{path} contains no messages"

    span = f"from {header.first_ns / NS_PER_S:.3f} s to {header.last_ns / NS_PER_S:.3f} s"

    if selection.start_ns is not None and selection.start_ns > header.last_ns:
        option = f"--start {selection.start_ns / NS_PER_S:g} s"
        return f"{option} is after the end; the log lasts {span}"
    if selection.stop_ns is not None and selection.stop_ns < header.first_ns:
        option = f"--stop {selection.stop_ns / NS_PER_S:g} s"
        return f"{option} is before the beginning; the log lasts {span}"

    return (
        f"{path} has no message for this selection; the topics of the log have the form "
        f"trilat/{header.session}/{header.scenario.names[0]}/state, and the log lasts {span}"
    )
