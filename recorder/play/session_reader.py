"""Reads the messages to play out of a log: channel and time selection, one pass over the files, preloading.

Invariant: payloads pass through unchanged; only a message's number and its sender's boot are decoded. The
default selection is what the sites published: neither the recorder's statistics nor the file's views. A
preloaded log is bounded (L6); a larger one is read by another process during play (`reader_process`).
"""

import hashlib
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from trilat_net import process
from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import LogError, ScenarioError, UsageError
from trilat_net.log.log_layout import SCENARIO, SESSION
from trilat_net.log.mcap_reader import McapMessage, McapReader, Progress
from trilat_net.net import topics
from trilat_net.net.bus import matches_key
from trilat_net.net.loop_stats import ticks_per_stats
from trilat_net.scenario import Scenario, parse_embedded

from .batch import BatchBuilder, MessageBatch
from .pace import to_seconds

PLAYED_CHANNELS = (topics.STATE, topics.LINK, topics.EVENT)
"""Channels of a site that are played unless others are asked for."""

PlayTime = Literal["publish", "log"]
"""By which time: when a message was sent, or when it arrived."""


@dataclass(frozen=True, slots=True)
class PlaySelection:
    """What is played of a log.

    Attributes:
        include: key expressions of the only channels that are played; none: every site's own.
        exclude: key expressions of channels that are not.
        start_ns: messages before this are not, ns since the epoch; None: from the first one on.
        stop_ns: messages after this are not; None: to the last one.
        time: by which time.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    start_ns: int | None = None
    stop_ns: int | None = None
    time: PlayTime = "publish"

    def takes(self, topic: str, sites: Collection[str]) -> bool:
        """Says whether a channel is played.

        Args:
            topic: its topic in the file, as in "/trilat/paper/m1/state".
            sites: the sites of the scenario.
        """
        key = topic.strip("/")
        if any(matches_key(expression, key) for expression in self.exclude):
            return False
        if self.include:
            return any(matches_key(expression, key) for expression in self.include)
        where = topics.parse_key(key)
        return where is not None and where.member in sites and where.channel in PLAYED_CHANNELS

    def holds(self, t_ns: int) -> bool:
        """Says whether an instant is played, ns since the epoch."""
        return (self.start_ns is None or t_ns >= self.start_ns) and (
            self.stop_ns is None or t_ns <= self.stop_ns
        )


def parse_selection(
    include: Collection[str],
    exclude: Collection[str],
    start_s: float | None,
    stop_s: float | None,
    duration_s: float | None,
    time: PlayTime,
) -> PlaySelection:
    """Returns what a person asks for.

    Args:
        include: see `Selection`; a leading slash, as topics have it, is fine.
        exclude: the same.
        start_s: from when on, s since the epoch.
        stop_s: until when.
        duration_s: how long, instead of `stop_s`; counted from `start_s`, or from the epoch.
        time: by which time.

    Raises:
        UsageError: it cannot be meant.
    """
    for name, seconds in (("--start", start_s), ("--stop", stop_s), ("--duration", duration_s)):
        if seconds is not None and not (math.isfinite(seconds) and abs(seconds) <= 1e9):
            raise UsageError(f"{name} is a number of seconds, not {seconds:g}")
    if duration_s is not None and duration_s <= 0:
        raise UsageError(f"--duration is more than 0 s, not {duration_s:g}")
    if duration_s is not None and stop_s is not None:
        raise UsageError("--stop and --duration say the same in two ways; give one of them")
    if duration_s is not None:
        stop_s = (start_s or 0.0) + duration_s
    if start_s is not None and stop_s is not None and stop_s <= start_s:
        raise UsageError(f"--stop is after --start ({start_s:g} s), not {stop_s:g} s")
    return PlaySelection(
        _expressions("--include", include),
        _expressions("--exclude", exclude),
        None if start_s is None else round(start_s * NS_PER_S),
        None if stop_s is None else round(stop_s * NS_PER_S),
        time,
    )


def _expressions(option: str, given: Collection[str]) -> tuple[str, ...]:
    """Refuses what is no key expression: it would match nothing, and say nothing."""
    for text in given:
        chunks = text.strip("/").split("/")
        if not all(chunk in ("*", "**") or (chunk and "*" not in chunk) for chunk in chunks):
            raise UsageError(
                f"{option} is a key expression like '**/state' or 'trilat/*/m1/**': chunks are names, "
                f"* or **; not {text!r}"
            )
    return tuple(text.strip("/") for text in given)


HORIZON_NS = 70 * NS_PER_S
"""How much later than in its turn a message may stand in a file: sites remember a minute for recorders that
missed something."""


FAR_NS = 1 << 62
"""No message is so far from the epoch."""

_LAST = 1 << 61
"""No time and no number is larger, whatever a file says."""


class _PayloadHeader(msgspec.Struct):
    """What is looked at of a payload, of any schema version."""

    boot: int = -1
    tick: int = -1
    n: int = -1


_decode_header = msgspec.msgpack.Decoder(_PayloadHeader).decode


@dataclass(slots=True)
class SessionHeader:
    """What the files say of the session.

    Attributes:
        session: its name there.
        scenario: what ran.
        scenario_text: as the files have it.
        fingerprint: of the arithmetic that made the log; "" if they do not say.
        version: schema version of the messages; 0 if they do not say.
        boots: the sites' boots, as far as read.
        topics: topics of the channels that are played, by number.
        torn: files that were not finished, or are damaged somewhere.
        first_ns: the earliest message of any channel so far, ns since the epoch.
        last_ns: the latest one.
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

    @property
    def scenario_sha256(self) -> str:
        """Hash of the scenario's text."""
        return hashlib.sha256(self.scenario_text.encode()).hexdigest()


class PlayedMessage(NamedTuple):
    """One message to be played.

    Attributes:
        t_ns: its time, ns since the epoch.
        channel: its place in `Facts.topics`.
        number: its number in its channel: the tick of a record, the place from 0 of what else a site said;
            of other channels its time.
        payload: as published.
    """

    t_ns: int
    channel: int
    number: int
    payload: bytes


class _PlayedChannel:
    """One channel of a file: whether it is played, and how its messages are numbered."""

    def __init__(self, topic: str, facts: SessionHeader, selection: PlaySelection) -> None:
        where = topics.parse_key(topic.strip("/"))
        sites = facts.scenario.sites
        ours = where is not None and where.member in sites and where.session == facts.session
        self.site = where.member if where is not None and ours else ""
        self.kind = where.channel if where is not None and ours else ""
        self.every = ticks_per_stats(sites[self.site].rate_hz) if self.site else 1
        self.played = -1
        if selection.takes(topic, sites):
            if topic not in facts.topics:
                facts.topics.append(topic)
            self.played = facts.topics.index(topic)
        self._count = 0

    def number(self, item: McapMessage, t_ns: int) -> int:
        """Returns the number of a message; where none is known, its time."""
        if self.kind == topics.STATE:
            return item.sequence
        if self.kind not in (topics.LINK, topics.EVENT):
            return t_ns
        look = _read_header(item.payload)
        number = look.tick // self.every if self.kind == topics.LINK and look.tick >= 0 else look.n
        number = min(number, _LAST)
        if self.kind == topics.EVENT and number < 0:  # before version 3 events had no number
            number = self._count
        self._count += 1
        return number


def _read_header(payload: bytes) -> _PayloadHeader:
    try:
        return _decode_header(payload)
    except (ValueError, RecursionError):
        return _PayloadHeader()


class SessionReader:
    """One pass over the files of a session.

    Args:
        paths: the files; of several, the parts of one session in their order.
        selection: what is played.
        progress: told how many bytes are read, and how many there are.

    Attributes:
        facts: what they say; None before the first message.
    """

    def __init__(
        self, paths: Sequence[Path], selection: PlaySelection, progress: Progress | None = None
    ) -> None:
        self.facts: SessionHeader | None = None
        self._paths, self._selection, self._progress = paths, selection, progress

    def messages(self) -> Iterator[PlayedMessage]:
        """Yields what is to be played, in file order.

        Raises:
            LogError: a file is missing, no log of trilat-net, or of another session than the first.
        """
        for path in self._paths:
            try:
                with path.open("rb") as stream:
                    yield from self._in_file(path, McapReader(stream, str(path), self._progress, kept=False))
            except OSError as error:
                raise LogError(f"{path}: cannot be read: {error.strerror}") from None

    def _in_file(self, path: Path, walk: McapReader) -> Iterator[PlayedMessage]:
        epoch_ns: int | None = None
        channels: dict[str, _PlayedChannel] = {}
        by_log, stop_ns = self._selection.time == "log", self._selection.stop_ns
        holds = self._selection.holds
        for item in walk.messages():
            if epoch_ns is None:
                epoch_ns, facts = self._begin(path, walk)
            t_ns = item.log_time_ns
            if not by_log and abs(item.publish_time_ns - t_ns) <= HORIZON_NS:
                t_ns = item.publish_time_ns  # or else its stamp is nonsense, and its arrival counts
            t_ns = min(max(t_ns - epoch_ns, -_LAST), _LAST)
            if not -FAR_NS < t_ns < FAR_NS:
                raise LogError(f"{path}: a message is of {t_ns} ns after the epoch: nobody lives to play it")
            if stop_ns is not None and item.log_time_ns - epoch_ns > stop_ns + HORIZON_NS:
                return
            channel = channels.get(item.topic)
            if channel is None:
                channel = channels[item.topic] = _PlayedChannel(item.topic, facts, self._selection)
            facts.first_ns, facts.last_ns = min(facts.first_ns, t_ns), max(facts.last_ns, t_ns)
            if channel.site and channel.site not in facts.boots:
                boot = _read_header(item.payload).boot
                facts.boots.update({channel.site: boot} if boot >= 0 else {})
            number = channel.number(item, t_ns)
            if channel.played >= 0 and holds(t_ns):
                yield PlayedMessage(t_ns, channel.played, number, item.payload)
        if epoch_ns is None:
            _, facts = self._begin(path, walk)
        if not walk.complete:
            facts.torn[path] = "the file was not finished"
        elif walk.damaged:
            facts.torn[path] = f"damaged in {len(walk.damaged)} places"

    def _begin(self, path: Path, walk: McapReader) -> tuple[int, SessionHeader]:
        """Takes what a file says of its session: the epoch in Unix time, and the facts.

        Raises:
            LogError: it is no log of trilat-net, or one of another session.
        """
        said = walk.metadata.get(SESSION, {})
        if "session" not in said or SCENARIO not in walk.attachments:
            raise LogError(f"{path}: is an MCAP file, but no log of trilat-net")
        try:
            text = walk.attachments[SCENARIO].decode()
            epoch_ns = int(said.get("epoch_unix_ns", "0"))
            version = int(said.get("schema_version", "0"))
            if self.facts is None:
                scenario = parse_embedded(text, f"{path}: scenario")
                fingerprint = said.get("fingerprint", "")
                self.facts = SessionHeader(said["session"], scenario, text, fingerprint, version)
        except (ScenarioError, ValueError) as error:
            raise LogError(f"{path}: what it says of its session cannot be read: {error}") from None
        if (self.facts.session, self.facts.scenario_text) != (said["session"], text):
            raise LogError(
                f"{path}: is of another session than {self._paths[0]}; the files of one replay are the "
                "parts of one log"
            )
        return epoch_ns, self.facts


SEARCH_LIMIT = 100_000
"""In how many messages more to look for sites that have not been heard yet."""


def preload_messages(
    paths: Sequence[Path], selection: PlaySelection, limit_bytes: int, progress: Progress | None = None
) -> tuple[SessionHeader, MessageBatch | None]:
    """Returns what files say of their session, and the messages to be played, in order.

    Args:
        paths: the files; of several, the parts of one session in their order.
        selection: what is played.
        limit_bytes: most that may be held.
        progress: told how much is read.

    Returns:
        The facts; and the messages, or None where they are more than the limit.

    Raises:
        LogError: a file is missing, or no log of trilat-net.
        UsageError: nothing is to be played.
    """
    reading = SessionReader(paths, selection, progress)
    gathering = BatchBuilder()
    with process.pause_gc():
        messages = reading.messages()
        for message in messages:
            gathering.add(*message)
            if gathering.memory > limit_bytes:
                break
        else:
            if reading.facts is None:
                raise LogError(f"{paths[0]}: holds nothing")
            if not len(gathering):
                raise UsageError(_empty_selection_text(paths[0], selection, reading.facts))
            return reading.facts, gathering.ordered()
        for _ in islice(messages, SEARCH_LIMIT):
            assert reading.facts is not None  # there was a message
            if reading.facts.boots.keys() >= reading.facts.scenario.sites.keys():
                break
    assert reading.facts is not None
    return reading.facts, None


def _empty_selection_text(path: Path, selection: PlaySelection, facts: SessionHeader) -> str:
    """Says why there is nothing to play, and what there would be."""
    if facts.last_ns < facts.first_ns:
        return f"{path}: holds no message"
    span = f"from {to_seconds(facts.first_ns):.3f} s to {to_seconds(facts.last_ns):.3f} s"
    if selection.start_ns is not None and selection.start_ns > facts.last_ns:
        return f"--start {to_seconds(selection.start_ns):g} s: is beyond the end; the log goes {span}"
    if selection.stop_ns is not None and selection.stop_ns < facts.first_ns:
        return f"--stop {to_seconds(selection.stop_ns):g} s: is before the beginning; the log goes {span}"
    return (
        f"{path}: has no message for this selection; its topics are like "
        f"trilat/{facts.session}/{facts.scenario.names[0]}/state, and it goes {span}"
    )
