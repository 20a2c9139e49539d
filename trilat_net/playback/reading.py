"""Reads what is to be played out of a log, as it stands there.

Law: payloads are passed on as they are; of a payload only its number and its sender's boot are looked at.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import msgspec

from ..core.grid import NS_PER_S
from ..errors import LogError, ScenarioError
from ..log.chunks import Item, Progress, Walk
from ..log.writer import SCENARIO, SESSION
from ..net import topics
from ..net.stats import ticks_between
from ..scenario import Scenario, embedded
from .selection import Selection

HORIZON_NS = 70 * NS_PER_S
"""How much later than in its turn a message may stand in a file: sites remember a minute for recorders that
missed something."""


FAR_NS = 1 << 62
"""No message is so far from the epoch."""

_LAST = 1 << 61
"""No time and no number is larger, whatever a file says."""


class _Look(msgspec.Struct):
    """What is looked at of a payload, of any schema version."""

    boot: int = -1
    tick: int = -1
    n: int = -1


_look = msgspec.msgpack.Decoder(_Look).decode


@dataclass(slots=True)
class Facts:
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


class Message(NamedTuple):
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


class _Channel:
    """One channel of a file: whether it is played, and how its messages are numbered."""

    def __init__(self, topic: str, facts: Facts, selection: Selection) -> None:
        where = topics.address(topic.strip("/"))
        sites = facts.scenario.sites
        ours = where is not None and where.member in sites and where.session == facts.session
        self.site = where.member if where is not None and ours else ""
        self.kind = where.channel if where is not None and ours else ""
        self.every = ticks_between(sites[self.site].rate_hz) if self.site else 1
        self.played = -1
        if selection.takes(topic, sites):
            if topic not in facts.topics:
                facts.topics.append(topic)
            self.played = facts.topics.index(topic)
        self._count = 0

    def number(self, item: Item, t_ns: int) -> int:
        """Returns the number of a message; where none is known, its time."""
        if self.kind == topics.STATE:
            return item.sequence
        if self.kind not in (topics.LINK, topics.EVENT):
            return t_ns
        look = _looked(item.payload)
        number = look.tick // self.every if self.kind == topics.LINK and look.tick >= 0 else look.n
        number = min(number, _LAST)
        if self.kind == topics.EVENT and number < 0:  # before version 3 events had no number
            number = self._count
        self._count += 1
        return number


def _looked(payload: bytes) -> _Look:
    try:
        return _look(payload)
    except (ValueError, RecursionError):
        return _Look()


class Reading:
    """One pass over the files of a session.

    Args:
        paths: the files; of several, the parts of one session in their order.
        selection: what is played.
        progress: told how many bytes are read, and how many there are.

    Attributes:
        facts: what they say; None before the first message.
    """

    def __init__(self, paths: Sequence[Path], selection: Selection, progress: Progress | None = None) -> None:
        self.facts: Facts | None = None
        self._paths, self._selection, self._progress = paths, selection, progress

    def messages(self) -> Iterator[Message]:
        """Yields what is to be played, in file order.

        Raises:
            LogError: a file is missing, no log of trilat-net, or of another session than the first.
        """
        for path in self._paths:
            try:
                with path.open("rb") as stream:
                    yield from self._in_file(path, Walk(stream, str(path), self._progress, kept=False))
            except OSError as error:
                raise LogError(f"{path}: cannot be read: {error.strerror}") from None

    def _in_file(self, path: Path, walk: Walk) -> Iterator[Message]:
        epoch_ns: int | None = None
        channels: dict[str, _Channel] = {}
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
                channel = channels[item.topic] = _Channel(item.topic, facts, self._selection)
            facts.first_ns, facts.last_ns = min(facts.first_ns, t_ns), max(facts.last_ns, t_ns)
            if channel.site and channel.site not in facts.boots:
                boot = _looked(item.payload).boot
                facts.boots.update({channel.site: boot} if boot >= 0 else {})
            number = channel.number(item, t_ns)
            if channel.played >= 0 and holds(t_ns):
                yield Message(t_ns, channel.played, number, item.payload)
        if epoch_ns is None:
            _, facts = self._begin(path, walk)
        if not walk.complete:
            facts.torn[path] = "the file was not finished"
        elif walk.damaged:
            facts.torn[path] = f"damaged in {len(walk.damaged)} places"

    def _begin(self, path: Path, walk: Walk) -> tuple[int, Facts]:
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
                scenario = embedded(text, f"{path}: scenario")
                fingerprint = said.get("fingerprint", "")
                self.facts = Facts(said["session"], scenario, text, fingerprint, version)
        except (ScenarioError, ValueError) as error:
            raise LogError(f"{path}: what it says of its session cannot be read: {error}") from None
        if (self.facts.session, self.facts.scenario_text) != (said["session"], text):
            raise LogError(
                f"{path}: is of another session than {self._paths[0]}; the files of one replay are the "
                "parts of one log"
            )
        return epoch_ns, self.facts
