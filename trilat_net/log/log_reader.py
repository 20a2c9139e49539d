"""Reader of logs: one file, or several that are parts of one session.

    log = open_log("run.mcap")
    log["m1"].t_s, log["m1"].q

Invariant: files of every released schema version open; one that is cut off opens up to there, with
`complete` false. Messages are decoded on access; an invalid one is an error that names the file. Measured
link delays, for scenarios with `model = "trace"`, leave out what the log does not know: a sample counts
as lost only if records cover every tick at which it could have come, up to the longest delay of the link.
"""

import hashlib
import math
import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from difflib import get_close_matches
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Generic, NamedTuple, TypeVar

import numpy as np

from ..core.delay import MAX_DELAY_US
from ..core.ticks import NS_PER_S, CoreChange
from ..errors import LogError, ScenarioError, WireError
from ..net import topics
from ..net.messages import READABLE, Event, LinkStats, RecorderStats, State
from ..net.wire import decode
from ..scenario import Scenario, parse_core_change, parse_embedded
from .accounting import SessionAccounts
from .log_layout import ACCOUNTS, describe_unfinished
from .mcap_reader import ChannelMessages, LogContents, Progress, read_contents, shift_progress
from .merge import merge_parts
from .record_columns import Ints
from .site_log import MessageTimes, SiteLog

if TYPE_CHECKING:
    import polars

    from .data_tables import Table


M = TypeVar("M", Event, LinkStats, RecorderStats)


class TimedMessages(NamedTuple, Generic[M]):
    """Messages with the times at which they came and were sent, Unix ns, shape (K,) each."""

    messages: list[M]
    log_ns: Ints
    publish_ns: Ints


class Log:
    """A session as it was recorded; `log["m1"]` is a site's part.

    Args:
        whole: what its file holds, or its files together.

    Attributes:
        source: the file's name; those of several files, joined.
        sources: the names of its files, in order.
        session: what the file says of the session: driver, seed, epoch, versions, commit, fingerprint.
        scenario: the scenario that ran.
        scenario_text: its text, as it stands in the file.
        scenario_sha256: the hash of that.
        events: what happened, per member in order.
        damaged: parts of the file that cannot be read, a sentence each.

    Raises:
        LogError: its scenario or an event cannot be read.
    """

    def __init__(self, whole: LogContents) -> None:
        self.sources = whole.sources
        self.source = whole.source
        self.session = whole.session
        self.scenario_sha256 = hashlib.sha256(whole.scenario).hexdigest()
        try:
            self.scenario_text = whole.scenario.decode()
            self.scenario: Scenario = parse_embedded(self.scenario_text, f"{self.source}: scenario")
        except (ScenarioError, UnicodeDecodeError) as error:
            raise LogError(f"{self.source}: its scenario cannot be read: {error}") from None
        self.damaged = whole.damaged
        self._whole = whole
        self._sites: dict[str, SiteLog] = {}
        ends = f"/{topics.EVENT}"
        self.events = [
            e for topic in sorted(whole.channels) if topic.endswith(ends) for e in self._events(topic)
        ]

    def __repr__(self) -> str:
        try:
            seconds = max((float(self[name].t_s[-1]) for name in self.sites if len(self[name])), default=0.0)
            records = sum(len(self[name]) for name in self.sites)
            missing = sum(map(self.missing, self.sites)) or "none"
            holds = f"{seconds:.3f} s, {records} records, {missing} missing"
        except LogError:
            holds = "with records that cannot be read"
        kind = f"{self.driver} session {self.session['session']} of {', '.join(self.sites)}"
        return f"<Log {self.source}: {kind}; {holds}{'' if self.complete else '; not finished'}>"

    def _topic(self, member: str, channel: str) -> str:
        return "/" + topics.key(self.session["session"], member, channel)

    def _channel(self, topic: str) -> ChannelMessages:
        return self._whole.channels.get(topic) or ChannelMessages()

    def _decoded(self, topic: str, kind: type[M]) -> Iterator[M]:
        try:
            for payload in self._channel(topic).payloads:
                yield decode(payload, kind, READABLE)
        except WireError as error:
            raise LogError(f"{self.source}: a message on {topic} cannot be read: {error}") from None

    def _events(self, topic: str) -> list[Event]:
        """Returns a member's events in order: one that came late stands where it belongs."""
        events = list(self._decoded(topic, Event))
        boots = {boot: n for n, boot in enumerate(dict.fromkeys(event.boot for event in events))}
        return sorted(events, key=lambda event: (boots[event.boot], event.n))

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the sites, in scenario order."""
        return self.scenario.names

    @property
    def driver(self) -> str:
        """What drove the session: "live" or "virtual"."""
        return self.session["driver"]

    @cached_property
    def complete(self) -> bool:
        """False where the file was not finished.

        Of several files all must be finished, or the last one, if no record is missing all the same.
        """
        if self._whole.complete or len(self.sources) == 1:
            return self._whole.complete
        made = self._made()
        lacks = any(name not in made or self.missing(name) for name in self.sites)
        return self._whole.ended and not lacks

    @cached_property
    def accounts(self) -> dict[str, str]:
        """Per topic what arrived and what is missing, as written at the end; {} in a torn file.

        Of several files, what is in all of them together.
        """
        written = self._whole.metadata.get(ACCOUNTS, {})
        return written if len(self.sources) == 1 else {**self._make_accounts(), **written}

    def _make_accounts(self) -> dict[str, str]:
        """Returns the accounts of the sites' channels, made from what is there."""
        rates_hz = {name: self.scenario.sites[name].rate_hz for name in self.sites}
        accounts = SessionAccounts(self.session["session"], rates_hz)
        for name in self.sites:
            numbers = {
                topics.STATE: self[name].tick.tolist(),
                topics.LINK: [stats.tick for stats in self.link_stats(name)],
                topics.EVENT: [event.n for event in self.events if event.member == name and event.n >= 0],
            }
            for channel in numbers:
                accounts.open(self._topic(name, channel))
            for channel, sequences in numbers.items():
                for sequence in sequences:
                    accounts.take(self._topic(name, channel), sequence)
        for name, ticks in self._made().items():
            accounts.expect(name, ticks)
        return accounts.texts()

    def account(self, site: str) -> str:
        """Returns what arrived of a site's records and what is missing; "" in an unfinished file."""
        return self.accounts.get(self._topic(site, topics.STATE), "")

    def _made(self) -> dict[str, int]:
        """Returns how many ticks each site made, of those that said so."""
        most = {name: self.scenario.ticks(name) for name in self.sites}
        ends = [event for event in self.events if event.kind == "end" and event.member in most]
        return {event.member: min(max(event.ticks, 0), most[event.member]) for event in ends}

    def missing(self, site: str) -> int:
        """Returns how many records of a site are missing: of those that it made, else up to its last one."""
        part = self[site]
        behind = self._made().get(site, 0) - (int(part.tick[-1]) + 1 if len(part) else 0)
        return part.missing + max(0, behind)

    def __getitem__(self, site: str) -> SiteLog:
        if site not in self.scenario.sites:
            raise KeyError(f"no site {site!r} in {self.source}; it has {', '.join(self.sites)}")
        if site not in self._sites:
            channel = self._channel(self._topic(site, topics.STATE))
            part = SiteLog(
                site,
                self.scenario.peers(site),
                self.scenario.sites[site].rate_hz,
                channel.payloads,
                self.source,
                MessageTimes(*channel.times()),
            )
            most = self.scenario.ticks(site)
            if len(part) and part.tick[-1] >= most:  # nobody counts up to what a stranger says
                last = int(part.tick[-1])
                raise LogError(f"{self.source}: {site} has a record of tick {last}; the scenario has {most}")
            self._sites[site] = part
        return self._sites[site]

    def changes(self, site: str) -> dict[int, list[str]]:
        """Returns the texts of the changes that a site took in, by tick, in order.

        They stand in its records, and in its events, which tell of those whose record is missing.
        """
        named = self[site].changes()
        told = [event for event in self.events if event.kind == "change" and event.member == site]
        have = set(self[site].tick.tolist()) if told else set()
        for event in told:
            if event.ticks not in have:
                named.setdefault(event.ticks, []).append(event.command)
        return dict(sorted(named.items()))

    def commands(self, site: str) -> dict[int, list[CoreChange]]:
        """Returns the same, as the site took them in.

        Raises:
            LogError: the log names a change that is none.
        """
        try:
            return {
                tick: [parse_core_change(self.scenario, site, text) for text in texts]
                for tick, texts in self.changes(site).items()
            }
        except ScenarioError as error:
            raise LogError(f"{self.source}: {error}") from None

    def link_stats(self, site: str) -> list[LinkStats]:
        """Returns the statistics that a site published, in order."""
        return self.timed_link_stats(site).messages

    def timed_link_stats(self, site: str) -> TimedMessages[LinkStats]:
        """Returns the same with the times at which they came and were sent."""
        topic = self._topic(site, topics.LINK)
        stats = list(self._decoded(topic, LinkStats))
        order = sorted(range(len(stats)), key=lambda n: stats[n].tick)
        return TimedMessages(
            [stats[n] for n in order], *(times[order] for times in self._channel(topic).times())
        )

    def timed_events(self) -> TimedMessages[Event]:
        """Returns what happened, in the order in which the recorder learnt of it, with times as well."""
        found = [topic for topic in sorted(self._whole.channels) if topic.endswith(f"/{topics.EVENT}")]
        events = [event for topic in found for event in self._decoded(topic, Event)]
        times = [self._channel(topic).times() for topic in found]
        if not events:
            return TimedMessages([], *ChannelMessages().times())
        log_ns, publish_ns = (np.concatenate(column) for column in zip(*times, strict=True))
        order = np.argsort(log_ns, kind="stable")
        return TimedMessages([events[n] for n in order.tolist()], log_ns[order], publish_ns[order])

    def recorder_stats(self) -> list[RecorderStats]:
        """Returns what the recorder said of its own work, in order."""
        return list(self._decoded(self._topic(topics.RECORDER, topics.STATS), RecorderStats))

    def table(self, name: str, kind: str = "") -> "Table":
        """Returns a part of the log as a table: columns with names, units and meanings.

        Args:
            name: a site, or "events".
            kind: of a site, "state" (a row per record), "link" (its statistics) or "arrivals" (a row per
                sample that came in).

        Raises:
            KeyError: there is no such part.
            LogError: what is in it cannot be read.
        """
        from .data_tables import build_table

        return build_table(self, name, kind)

    def frame(self, name: str, kind: str = "") -> "polars.DataFrame":
        """Returns the same as a polars data frame; pandas has it by `log.frame("m1").to_pandas()`.

        Raises:
            UsageError: polars is not installed.
        """
        from .data_tables import to_data_frame

        return to_data_frame(self.table(name, kind))


def open_log(
    source: str | Path | BinaryIO, *more: str | Path | BinaryIO, progress: Progress | None = None
) -> Log:
    """Returns the log in a file, or in files that are parts of one session, in any order.

    Args:
        source: a path, or a file opened for reading.
        more: further parts.
        progress: told while they are read how many bytes are, and how many there are in all.

    Raises:
        LogError: a file is missing, is no MCAP file, or no log of trilat-net; files are of different
            sessions, or tell the same differently.
    """
    parts: list[LogContents] = []
    with ExitStack() as stack:
        files = [_opened(one, stack) for one in (source, *more)]
        sizes = [_size(stream) for stream, _ in files]
        for n, (stream, name) in enumerate(files):
            told = shift_progress(progress, sum(sizes[:n]), sum(sizes))
            with _readable(name):
                parts.append(read_contents(stream, name, told))
    return Log(merge_parts(parts))


def _opened(source: str | Path | BinaryIO, stack: ExitStack) -> tuple[BinaryIO, str]:
    """Returns a file and its name; one that is opened here is closed with the stack."""
    if not isinstance(source, str | Path):
        return source, "log"
    with _readable(str(source)):
        return stack.enter_context(Path(source).open("rb")), str(source)


@contextmanager
def _readable(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise LogError(f"{name}: cannot be read: {error.strerror}{describe_unfinished(Path(name))}") from None


def _size(stream: BinaryIO) -> int:
    """Returns how many bytes a file has from where it stands."""
    here = stream.tell()
    size = stream.seek(0, os.SEEK_END)
    stream.seek(here)
    return size - here


DelayRow = tuple[float, float]
"""A sample's stamp, s since the epoch, and its delay, ms; a delay of infinity is a sample lost."""


def read_link_delays(path: Path, link: str) -> list[DelayRow]:
    """Returns how long the samples of a link were under way, by their own stamps.

    These are the delays of the network that carried them, as the receiver's records have them in `rx`; what
    the session's scenario injected besides is not in them. A negative one is a matter of clocks and counts
    as none; of a sample that came twice the shorter one counts.

    Args:
        path: the log.
        link: which link, as in "m1->s".

    Raises:
        OSError: the file cannot be opened.
        ValueError: it is no log, or has no such link, or nothing came over it.
    """
    status = path.stat()  # raises what open would, in the same words
    links = _links(path, status.st_mtime_ns, status.st_size)
    if link not in links:
        near = get_close_matches(link, list(links), n=1, cutoff=0.5)
        hint = f"; did you mean {near[0]!r}?" if near else "."
        raise ValueError(f"has no link {link!r}{hint} Its links are {', '.join(links)}")
    if not links[link]:
        raise ValueError(f"nothing came over {link} in it")
    return links[link]


@lru_cache(maxsize=1)
def _links(path: Path, modified_ns: int, size: int) -> dict[str, list[DelayRow]]:  # noqa: ARG001 - of this very file
    """Returns the rows of every link of a log; a scenario asks for one after the other."""
    try:
        log = open_log(path)
        return {
            f"{peer}->{site}": list(_rows(log, site, index, peer))
            for site in log.sites
            for index, peer in enumerate(log.scenario.peers(site))
        }
    except LogError as error:
        raise ValueError(str(error).removeprefix(f"{path}: ")) from None


def _rows(log: Log, site: str, index: int, peer: str) -> Iterator[DelayRow]:
    states = log[site].states
    came = _delays_us(states, index)
    longest_ns = 1000 * max(came.values(), default=0)
    gaps = _gaps_ns(states)
    rate_hz = log.scenario.sites[peer].rate_hz
    for tick in range(max(came, default=-1) + 1):
        stamp_ns = tick * NS_PER_S // rate_hz
        if tick not in came and any(
            stamp_ns <= end and stamp_ns + longest_ns >= start for start, end in gaps
        ):
            continue
        # the microsecond in which the stamp lies, as the core counts it
        yield stamp_ns // 1000 / 1e6, came[tick] / 1e3 if tick in came else math.inf


def _delays_us(states: Sequence[State], index: int) -> dict[int, int]:
    """Returns the delay of every sample that came from a peer, us, from 0 to `LIMIT_US`."""
    came: dict[int, int] = {}
    for state in states:
        for peer, tick, delay_us in state.rx:
            if peer == index and tick >= 0:
                came[tick] = min(came.get(tick, MAX_DELAY_US), max(delay_us, 0))
    return came


def _gaps_ns(states: Sequence[State]) -> list[tuple[int, float]]:
    """Returns when samples may have come unseen, ns: where records are missing, and behind the last one."""
    pairs = pairwise(states)
    gaps: list[tuple[int, float]] = [(a.t_ns, b.t_ns) for a, b in pairs if b.tick != a.tick + 1]
    if states and states[0].tick > 0:
        gaps.append((0, states[0].t_ns))
    return [*gaps, (states[-1].t_ns if states else 0, math.inf)]
