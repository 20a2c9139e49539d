"""Reads the messages to play out of a log: channel and time selection, one pass over the files,
preloading.

Invariant: payloads pass through unchanged; only an event's number and a sender's boot are
decoded. The default selection is what the sites published: neither the recorder's statistics
nor the file's views. A preloaded log is bounded (L6); a larger one is read by another process
during play (`message_source`).
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
from trilat_net.log.log_layout import (
    ALL_CHANNELS,
    SCENARIO,
    SESSION,
    SITE_CHANNELS,
    ChannelFilter,
    parse_channel_filter,
)
from trilat_net.log.mcap_reader import McapMessage, McapReader, Progress
from trilat_net.net import topics
from trilat_net.net.clock import NS_PER_S
from trilat_net.net.topics import number_message
from trilat_net.scenario import Scenario, parse_embedded

from .batch import BatchBuilder, MessageBatch, PlayedMessage

PlayTime = Literal["publish", "log"]
"""The time that orders messages: of sending, or of arrival."""


@dataclass(frozen=True, slots=True)
class PlaySelection:
    """The messages of a log that are played.

    Attributes:
        channels: the channels that are played; if it includes none by name: those that sites
            published.
        start_ns: messages before this are not played, ns since the epoch; None: from the first
            one on.
        stop_ns: messages after this are not played; None: to the last one.
    """

    channels: ChannelFilter = ALL_CHANNELS
    start_ns: int | None = None
    stop_ns: int | None = None
    time: PlayTime = "publish"

    def accepts(self, topic: str, sites: Collection[str]) -> bool:
        """True if a channel is played, by its topic ("/trilat/paper/m1/state") and the
        scenario's sites.
        """
        parsed = topics.parse_key(topic.strip("/"))
        published = (
            parsed is not None and parsed.member in sites and parsed.channel in SITE_CHANNELS
        )
        return self.channels.accepts(topic.strip("/")) and (
            published or bool(self.channels.include)
        )

    def holds(self, t_ns: int) -> bool:
        """True if an instant is played, ns since the epoch."""
        return (self.start_ns is None or t_ns >= self.start_ns) and (
            self.stop_ns is None or t_ns <= self.stop_ns
        )


def parse_selection(
    include: Collection[str],
    exclude: Collection[str],
    start_s: float | None,
    stop_s: float | None,
    duration_s: float | None,
    time: str,
) -> PlaySelection:
    """Returns the selection that a user's options describe.

    Raises:
        UsageError: the options contradict each other, or one is not valid.
    """
    if time not in get_args(PlayTime):
        raise UsageError(
            f"--time is publish (as it was sent) or log (as it arrived), not {time!r}"
        )
    for name, seconds in (("--start", start_s), ("--stop", stop_s), ("--duration", duration_s)):
        if seconds is not None and not (math.isfinite(seconds) and abs(seconds) <= 1e9):
            raise UsageError(f"{name} is a number of seconds, not {seconds:g}")
    if duration_s is not None:
        if duration_s <= 0:
            raise UsageError(f"--duration is more than 0 s, not {duration_s:g}")
        if stop_s is not None:
            raise UsageError("--stop and --duration say the same in two ways; give one of them")
        stop_s = (start_s or 0.0) + duration_s
    if start_s is not None and stop_s is not None and stop_s <= start_s:
        raise UsageError(f"--stop is after --start ({start_s:g} s), not {stop_s:g} s")
    start_ns, stop_ns = (
        None if at_s is None else round(at_s * NS_PER_S) for at_s in (start_s, stop_s)
    )
    return PlaySelection(
        parse_channel_filter(include, exclude), start_ns, stop_ns, cast(PlayTime, time)
    )


HORIZON_NS = 70 * NS_PER_S
"""How much later than its turn a message may stand in a file: sites keep a minute for recorders
that missed something.
"""
_LAST = 1 << 61
"""Bound of times and numbers, whatever a file says."""
NUMBERS_OF_A_START = 1 << 40
"""Each start of a site numbers its events from 0: those of the next one come so much later."""


class _PayloadHeader(msgspec.Struct):
    """The decoded part of a payload, of any schema version."""

    boot: int = -1
    n: int = -1


_decoder = msgspec.msgpack.Decoder(_PayloadHeader)


def _decode_header(payload: bytes) -> _PayloadHeader:
    try:
        return _decoder.decode(payload)
    except (ValueError, RecursionError):
        return _PayloadHeader()


@dataclass(slots=True)
class SessionHeader:
    """The session that files hold.

    Attributes:
        version: schema version of the messages; 0 if unknown.
        topics: topics of the channels that are played, by number.
        first_ns: the earliest message of any channel so far, ns since the epoch; `last_ns`: the
            latest one.
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


class _PlayedChannel:
    """One channel of a file: its number if it is played, else -1, and the numbers of its
    messages.
    """

    def __init__(self, topic: str, header: SessionHeader, selection: PlaySelection) -> None:
        parsed = topics.parse_key(topic.strip("/"))
        sites = header.scenario.sites
        own = parsed is not None and parsed.member in sites and parsed.session == header.session
        self.site, self.kind = (
            (parsed.member, parsed.channel) if parsed is not None and own else ("", "")
        )
        self.rate_hz = sites[self.site].rate_hz if self.site else 0
        self.place = -1
        if selection.accepts(topic, sites):
            if topic not in header.topics:
                header.topics.append(topic)
            self.place = header.topics.index(topic)
        self._count = 0
        self._starts: dict[int, int] = {}

    def number(self, item: McapMessage, t_ns: int) -> int:
        """Returns the number of a message, or its time if it has none."""
        if self.kind in (topics.STATE, topics.LINK):
            return number_message(self.kind, item.sequence, self.rate_hz)
        if self.kind != topics.EVENT:
            return t_ns
        header = _decode_header(item.payload)
        self._count += 1
        if header.n < 0:  # before version 3 events had no number
            return self._count - 1
        start = self._starts.setdefault(header.boot, len(self._starts))
        return min(min(header.n, NUMBERS_OF_A_START - 1) + start * NUMBERS_OF_A_START, _LAST)


class SessionReader:
    """One pass over the files of a session; several are its parts in their order.

    `progress` is called with the bytes read and their total. `header` is None before the first
    message.
    """

    def __init__(
        self, paths: Sequence[Path], selection: PlaySelection, progress: Progress | None = None
    ) -> None:
        self.header: SessionHeader | None = None
        self._paths = paths
        self._selection = selection
        self._progress = progress

    def messages(self) -> Iterator[PlayedMessage]:
        """Yields the messages to play, in file order.

        Raises:
            LogError: a file is missing, no log of trilat-net, or of another session than the
                first.
        """
        for path in self._paths:
            with reading(path) as stream:
                yield from self._read_file(
                    path, McapReader(stream, str(path), self._progress, kept=False)
                )

    def _read_file(self, path: Path, reader: McapReader) -> Iterator[PlayedMessage]:
        epoch_ns: int | None = None
        channels: dict[str, _PlayedChannel] = {}
        by_log = self._selection.time == "log"
        stop_ns = self._selection.stop_ns
        holds = self._selection.holds
        for item in reader.messages():
            if epoch_ns is None:
                epoch_ns, header = self._read_session(path, reader)
            t_ns = item.log_time_ns
            if not by_log and abs(item.publish_time_ns - t_ns) <= HORIZON_NS:
                t_ns = item.publish_time_ns  # an impossible stamp: the arrival counts
            t_ns = min(max(t_ns - epoch_ns, -_LAST), _LAST)
            if stop_ns is not None and item.log_time_ns - epoch_ns > stop_ns + HORIZON_NS:
                return  # all that follows came later still
            channel = channels.get(item.topic)
            if channel is None:
                channel = channels[item.topic] = _PlayedChannel(
                    item.topic, header, self._selection
                )
            header.first_ns = min(header.first_ns, t_ns)
            header.last_ns = max(header.last_ns, t_ns)
            if channel.site and channel.site not in header.boots:
                boot = _decode_header(item.payload).boot
                header.boots.update({channel.site: boot} if boot >= 0 else {})
            number = channel.number(item, t_ns)
            if channel.place >= 0 and holds(t_ns):
                yield t_ns, channel.place, number, item.payload
        if epoch_ns is None:
            _, header = self._read_session(path, reader)
        if not reader.complete:
            header.torn[path] = "the file was not finished"
        elif reader.damaged:
            header.torn[path] = f"damaged in {count_nouns(len(reader.damaged), 'place')}"

    def _read_session(self, path: Path, reader: McapReader) -> tuple[int, SessionHeader]:
        """Returns a file's epoch in Unix time, ns, and the session; refuses one of another
        session.
        """
        metadata = reader.metadata.get(SESSION, {})
        if "session" not in metadata or SCENARIO not in reader.attachments:
            raise LogError(f"{path}: is an MCAP file, but no log of trilat-net")
        try:
            text = reader.attachments[SCENARIO].decode()
            epoch_ns = int(metadata.get("epoch_unix_ns", "0"))
            version = int(metadata.get("schema_version", "0"))
            if self.header is None:
                scenario = parse_embedded(text, f"{path}: scenario")
                fingerprint = metadata.get("fingerprint", "")
                self.header = SessionHeader(
                    session=metadata["session"],
                    scenario=scenario,
                    scenario_text=text,
                    fingerprint=fingerprint,
                    version=version,
                )
        except (ScenarioError, ValueError) as error:
            raise LogError(f"{path}: its session cannot be read: {error}") from None
        if (self.header.session, self.header.scenario_text) != (metadata["session"], text):
            raise LogError(
                f"{path}: is of another session than {self._paths[0]}; the files of one replay are the "
                "parts of one log"
            )
        return epoch_ns, self.header


SEARCH_LIMIT = 100_000
"""Further messages in which to look for sites without a boot yet."""


def preload_messages(
    paths: Sequence[Path],
    selection: PlaySelection,
    limit_bytes: int,
    progress: Progress | None = None,
) -> tuple[SessionHeader, MessageBatch | None]:
    """Reads the session and the messages to play, in order; None in place of more than the
    limit of memory.

    Raises:
        LogError: a file is missing, or no log of trilat-net.
        UsageError: no message is to be played.
    """
    reader = SessionReader(paths, selection, progress)
    waiting = BatchBuilder()
    with process.pause_gc():
        messages = reader.messages()
        for message in messages:
            waiting.add(*message)
            if waiting.memory > limit_bytes:
                break
        else:
            if reader.header is None:
                raise LogError(f"{paths[0]}: holds nothing")
            if not waiting.memory:
                raise UsageError(_describe_empty_selection(paths[0], selection, reader.header))
            return reader.header, waiting.ordered()
        assert reader.header is not None  # there was a message
        for _ in islice(messages, SEARCH_LIMIT):
            if reader.header.boots.keys() >= reader.header.scenario.sites.keys():
                break
    return reader.header, None


def _describe_empty_selection(
    path: Path, selection: PlaySelection, header: SessionHeader
) -> str:
    if header.last_ns < header.first_ns:
        return f"{path}: holds no message"
    span = f"from {header.first_ns / NS_PER_S:.3f} s to {header.last_ns / NS_PER_S:.3f} s"
    if selection.start_ns is not None and selection.start_ns > header.last_ns:
        return f"--start {selection.start_ns / NS_PER_S:g} s: is beyond the end; the log goes {span}"
    if selection.stop_ns is not None and selection.stop_ns < header.first_ns:
        return f"--stop {selection.stop_ns / NS_PER_S:g} s: is before the beginning; the log goes {span}"
    return (
        f"{path}: has no message for this selection; its topics are like "
        f"trilat/{header.session}/{header.scenario.names[0]}/state, and it goes {span}"
    )
