"""Reader of logs: one file, or several that are parts of one session.

    log = open_log("run.mcap")
    log["m1"].t_s, log["m1"].q

Invariant: files of every released schema version open; one that is cut off opens up to there,
with `complete` false. Messages are decoded on access; an invalid record is an error that names
the file, an invalid event or statistic is left out and reported (`unreadable`). Channels of
other sessions and members are none of the log's. Measured link delays, for scenarios with
`model = "trace"`, leave out what the log does not know: a sample counts as lost only if records
cover every tick at which it could have come, up to the longest delay of the link.
"""

import hashlib
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

import numpy as np

from ..core.delay import MAX_DELAY_US
from ..core.ticks import NS_PER_S, CoreChange
from ..errors import LogError, ScenarioError, UnknownName, WireError, count_nouns
from ..fields import suggest_nearest
from ..files import open_regular
from ..net import topics
from ..net.messages import READABLE, Event, LinkStats, RecorderStats, State
from ..net.topics import count_under_way
from ..net.wire import decode
from ..results import Result
from ..scenario import Scenario, parse_core_change, parse_embedded
from ..scenario.code_consent import LawFiles, allow_logged_code
from ..scenario.delay_traces import TracePoint
from ..scenario.sample_uses import PictureDelay
from .accounting import LAST, SessionAccounts, describe_unknown_ends
from .data_tables import (
    EVENTS_TABLE,
    SITE_TABLE_KINDS,
    Table,
    build_arrivals_table,
    build_events_table,
    build_link_table,
    build_state_table,
    to_data_frame,
    to_pandas_frame,
)
from .log_layout import (
    ACCOUNTS,
    EXECUTED_SITES_KEY,
    PART,
    RERUN_DRIVER,
    describe_unfinished,
    parse_filter_facts,
)
from .mcap_reader import ChannelMessages, LogContents, Progress, read_contents, shift_progress
from .merge import identify_session, merge_parts
from .record_columns import Ints
from .site_log import SiteLog, TimedMessages

if TYPE_CHECKING:
    import pandas
    import polars


M = TypeVar("M", Event, LinkStats, RecorderStats)


class Log(Result, Mapping[str, SiteLog]):
    """A recorded session, a mapping: `log["m1"]` is a site's part, `log.items()` has them by
    name.

    Args:
        contents: the contents of its file, or of its files together.

    Attributes:
        source: the file's name; of several files the first one's, and how many there are.
        sources: the names of its files, in order.
        session: metadata of the session: driver, seed, epoch, versions, commit, fingerprint.
        driver: that of the session: "live" or "virtual".
        scenario: the scenario that ran.
        sites: names of the sites, in scenario order.
        scenario_text, scenario_sha256: its text, as it is in the file, and the hash of that.
        events: the events, per member in order.
        damaged: parts of the file that cannot be read, a sentence each.
        chain: agreement with the digest chain of its files, the worst of several.
        unreadable: channels some of whose messages cannot be read, a sentence each.

    Raises:
        LogError: its scenario cannot be read.
    """

    def __init__(self, contents: LogContents) -> None:
        self.source = contents.source
        self.sources = contents.sources
        self.session = contents.session
        self.damaged = contents.damaged
        self.chain = contents.chain
        self.driver = self.session["driver"]
        self.scenario_sha256 = hashlib.sha256(contents.scenario).hexdigest()
        try:
            self.scenario_text = contents.scenario.decode()
            self.scenario: Scenario = parse_embedded(
                self.scenario_text, f"{self.source}: scenario"
            )
        except (ScenarioError, UnicodeDecodeError) as error:
            raise LogError(f"{self.source}: its scenario cannot be read: {error}") from None
        self.sites = self.scenario.names
        self._contents = contents
        self._sites: dict[str, SiteLog] = {}
        self.unreadable: list[str] = []
        self.events = [
            event for topic in self._event_topics() for event in self._read_events(topic)
        ]

    def headline(self) -> str:
        """Returns the session, and how many records it has, in one line."""
        try:
            seconds = max(
                (float(self[name].t_s[-1]) for name in self.sites if len(self[name])),
                default=0.0,
            )
            records = sum(len(self[name]) for name in self.sites)
            missing = sum(map(self.missing, self.sites)) or "none"
            holds = f"{seconds:.3f} s, {count_nouns(records, 'record')}, {missing} missing"
            holds += (
                f"; {describe_unknown_ends(self.unknown_ends)}" if self.unknown_ends else ""
            )
            holds += "" if self.diverged_s is None else f"; DIVERGED at {self.diverged_s:.3f} s"
        except LogError:
            holds = "with records that cannot be read"
        kind = f"{self.driver} session {self.session['session']} of {', '.join(self.sites)}"
        return f"{self.source}: {kind}; {holds}{'' if self.complete else '; not finished'}"

    def to_dict(self) -> dict[str, Any]:
        """Returns plain values, with the keys of `trilat sim --json`."""
        return {
            "files": list(self.sources),
            "session": dict(self.session),
            "scenario": self.scenario.name,
            "scenario_sha256": self.scenario_sha256,
            "seed": self.scenario.seed,
            "duration_s": self.scenario.duration_s,
            "complete": self.complete,
            "unknown_ends": list(self.unknown_ends),
            "diverged": [event.member for event in self.events if event.kind == "diverged"],
            "sites": {str(row.pop("site")): row for row in self.to_rows()},
        }

    def to_rows(self) -> list[dict[str, Any]]:
        """Returns a row per site."""
        return [
            {
                "site": name,
                "rate_hz": self[name].rate_hz,
                "records": len(self[name]),
                "missing": self.missing(name),
                "last_s": float(self[name].t_s[-1]) if len(self[name]) else None,
            }
            for name in self.sites
        ]

    def to_frame(self, name: str = "", kind: str = "") -> "pandas.DataFrame":
        """Returns a table of the log as a pandas data frame, see `table`; without a name a row
        per site.
        """
        return to_pandas_frame(self.table(name, kind)) if name else super().to_frame()

    __eq__ = object.__eq__  # logs are not compared record by record
    __hash__ = object.__hash__

    def __iter__(self) -> Iterator[str]:
        return iter(self.sites)

    def __len__(self) -> int:
        return len(self.sites)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.sites)

    def _topic(self, member: str, channel: str) -> str:
        return "/" + topics.key(self.session["session"], member, channel)

    def _event_topics(self) -> list[str]:
        named = {self._topic(member, topics.EVENT) for member in (*self.sites, topics.RECORDER)}
        return sorted(named & self._contents.channels.keys())

    def _channel(self, topic: str) -> ChannelMessages:
        return self._contents.channels.get(topic) or ChannelMessages()

    def _decode(self, topic: str, kind: type[M]) -> list[M]:
        """Returns the messages of a channel; those that cannot be read leave it, and are
        reported once.
        """
        channel = self._channel(topic)
        readable = ChannelMessages()
        problem = ""
        messages: list[M] = []
        for payload, *times in zip(
            channel.payloads, channel.log_ns, channel.publish_ns, strict=True
        ):
            try:
                messages.append(decode(payload, kind, READABLE))
                readable.add(payload, *times)
            except WireError as error:
                problem = problem or str(error)
        if problem:
            lost = len(channel.payloads) - len(messages)
            self.unreadable.append(
                f"{self.source}: {count_nouns(lost, 'message')} on {topic} cannot be read: {problem[:200]}"
            )
            self._contents.channels[topic] = readable
            self._contents.complete = False
        return messages

    def _read_events(self, topic: str) -> list[Event]:
        events = self._decode(topic, Event)
        boots = {
            boot: n for n, boot in enumerate(dict.fromkeys(event.boot for event in events))
        }
        return sorted(events, key=lambda event: (boots[event.boot], event.n))

    @cached_property
    def diverged_s(self) -> float | None:
        """When the first site left its limits, s, which ended the run; None if none did."""
        return min(
            (at_s for part in self.values() if (at_s := part.diverged_s) is not None),
            default=None,
        )

    def warn_if_diverged(self) -> None:
        """Warns the caller of the caller, in Python, of a run that diverged."""
        if self.diverged_s is not None:
            when = f"the run diverged at {self.diverged_s:.3f} s, and ends there"
            warnings.warn(
                f"{when}: a joint passed its qd_limit_rad_s", RuntimeWarning, stacklevel=3
            )

    @cached_property
    def complete(self) -> bool:
        """False if the file was not finished.

        Of several files all must be finished, or the last one, if no record is missing all the
        same.
        """
        if self._contents.complete or len(self.sources) == 1:
            return self._contents.complete
        ticks = self._stated_ticks
        lacks = any(name not in ticks or self.missing(name) for name in self.sites)
        return self._contents.ended and not lacks

    @property
    def executed_sites(self) -> tuple[str, ...]:
        """The sites whose records can be executed from the file.

        All of them, except in an open-loop rerun: the records of its other sites were made
        against sites that the file does not hold.
        """
        named = self.session.get(EXECUTED_SITES_KEY) if self.driver == RERUN_DRIVER else None
        return tuple(name for name in self.sites if named is None or name in named.split())

    @property
    def part(self) -> int:
        """Its number among the parts of a log; 0 of several parts, and of a log without parts."""
        number = self._contents.metadata.get(PART, {}).get("index", "0")
        return (
            int(number)
            if len(self.sources) == 1 and number.isdecimal() and len(number) < 10
            else 0
        )

    @cached_property
    def accounts(self) -> dict[str, str]:
        """Per topic what arrived and what is missing, as written at the end; {} in a torn file.

        Of several files, what is in all of them together.
        """
        written = self._contents.metadata.get(ACCOUNTS, {})
        if len(self.sources) == 1:
            return written
        accounts = SessionAccounts(self.session["session"], self.scenario)
        for name in self.sites:
            sequences = {
                self._topic(name, topics.STATE): self[name].tick.tolist(),
                self._topic(name, topics.LINK): [stats.tick for stats in self.link_stats(name)],
            }
            for topic in (*sequences, self._topic(name, topics.EVENT)):
                accounts.open_channel(topic)
            for topic, numbers in sequences.items():
                for number in numbers:
                    accounts.receive(topic, number)
        for event in self.events:
            if event.member in self.sites and event.n >= 0:
                accounts.receive_event(self._topic(event.member, topics.EVENT), event.n, event)
        for name, ticks in self._stated_ticks.items():
            accounts.add_expected_ticks(name, ticks)
        return {**accounts.format_accounts(), **written}

    def account(self, site: str) -> str:
        """Returns what arrived of a site's records and what is missing; "" in an unfinished
        file.
        """
        return self.accounts.get(self._topic(site, topics.STATE), "")

    @cached_property
    def unknown_ends(self) -> tuple[str, ...]:
        """The sites whose event at their end never arrived: nobody knows how many ticks they
        made.

        None of a part that others follow or of a log that takes no events: there it is not to
        be expected.
        """
        choice = parse_filter_facts(self.session)
        key = {
            site: topics.key(self.session["session"], site, topics.EVENT) for site in self.sites
        }
        is_part = bool(self.part) and len(self.sources) == 1
        ended = {event.member for event in self.events if event.kind == "end"}
        silent = [
            site for site in self.sites if site not in ended and choice.accepts(key[site])
        ]
        return () if is_part else tuple(silent)

    @cached_property
    def _stated_ticks(self) -> dict[str, int]:
        most = {name: self.scenario.ticks(name) for name in self.sites}
        ends = [event for event in self.events if event.kind == "end" and event.member in most]
        return {event.member: min(max(event.ticks, 0), most[event.member]) for event in ends}

    @cached_property
    def starts(self) -> dict[str, list[tuple[int, int]]]:
        """Per site that joined the running session the first ticks of those starts, and their
        boots.
        """
        joins = [e for e in self.events if e.kind == "join" and e.member in self.scenario.sites]
        found: dict[str, list[tuple[int, int]]] = {}
        for event in joins:
            if 0 < event.ticks < self.scenario.ticks(event.member):
                found.setdefault(event.member, []).append((event.ticks, event.boot))
        return {site: sorted(starts) for site, starts in found.items()}

    @cached_property
    def absences(self) -> dict[str, list[tuple[int, int]]]:
        """Per site the ticks before each of these starts that were not made, as (first, last).

        They begin after those of which there are records, that the start before stated at its
        end, or that others heard of.
        """
        return {site: self._find_absences(site, starts) for site, starts in self.starts.items()}

    def _find_absences(self, site: str, starts: list[tuple[int, int]]) -> list[tuple[int, int]]:
        ends = [
            event.ticks - 1
            for event in self.events
            if event.kind == "end" and event.member == site
        ]
        made = np.array([*self[site].tick.tolist(), *ends], dtype=np.int64)
        found: list[tuple[int, int]] = []
        for first, boot in starts:
            heard = [
                e.ticks for e in self.events if e.kind == LAST and e.boots.get(site) == boot
            ]
            begin = int(made[made < first].max(initial=-1)) + 1
            known = min(first, max(heard, default=0))
            if known - begin > count_under_way(topics.STATE, self[site].rate_hz):
                begin = known
            if found and begin == found[-1][0]:  # the start in between made no tick
                found.pop()
            if begin < first:
                found.append((begin, first - 1))
        return found

    def absent_ticks(self, site: str) -> int:
        """Returns how many ticks that is for a site, and how many it left out as its records
        say.
        """
        between = sum(last - first + 1 for first, last in self.absences.get(site, ()))
        return between + self[site].skipped

    def expected_ticks(self, site: str) -> int:
        """Returns how many ticks of a site belong to the run.

        Those that it stated at its end; of a site that others lost for good, those up to its
        last known one; else those of the scenario; without those that it did not make between
        two of its starts.
        """
        stated = self._stated_ticks.get(site)
        there = self[site].last_tick + 1
        if stated is None:
            kinds = ("lost", "left", "back", "admit")
            told = [
                event for event in self.events if event.about == site and event.kind in kinds
            ]
            gone = bool(told) and max(told, key=lambda event: event.t_ns).kind in (
                "lost",
                "left",
            )
            stated = there if gone and there else self.scenario.ticks(site)
        return max(stated, there) - self.absent_ticks(site)

    def missing(self, site: str) -> int:
        """Returns how many records of a site are missing: of those that it made, else up to its
        last one.
        """
        part = self[site]
        missing = part.missing + max(0, self._stated_ticks.get(site, 0) - (part.last_tick + 1))
        return max(0, missing - self.absent_ticks(site))

    @cached_property
    def last_ticks(self) -> dict[str, int]:
        """The last tick that each site is known to have made, -1 if none is known.

        The event at its end tells; without one, its records and those of its peers.
        """
        stated = self._stated_ticks
        last = {name: stated.get(name, self[name].last_tick + 1) - 1 for name in self.sites}
        for name in self.sites:
            unknown = {n: peer for n, peer in enumerate(self[name].peers) if peer not in stated}
            for state in self[name].states if unknown else ():
                for n, tick, _ in state.rx:
                    if n in unknown and tick < self.scenario.ticks(unknown[n]):
                        last[unknown[n]] = max(last[unknown[n]], tick)
        return last

    def __getitem__(self, site: str) -> SiteLog:
        if site not in self.scenario.sites:
            raise UnknownName(
                f"no site {site!r} in {self.source}; it has {', '.join(self.sites)}"
            )
        if site not in self._sites:
            channel = self._channel(self._topic(site, topics.STATE))
            rate_hz = self.scenario.sites[site].rate_hz
            times = channel.times()
            peers = self.scenario.peers(site)
            layout = self.scenario.layout(site)
            sent = self.scenario.channel(site)
            axes = self.scenario.arms[site].axes
            payloads = channel.payloads
            source = self.source
            part = SiteLog(
                name=site,
                peers=peers,
                rate_hz=rate_hz,
                payloads=payloads,
                source=source,
                times=times,
                layout=layout,
                channel=sent,
                axes=axes,
            )
            most = self.scenario.ticks(site)
            last = part.last_tick
            if last >= most:  # a tick of others is nothing to count up to
                raise LogError(
                    f"{self.source}: {site} has a record of tick {last}; the scenario has {most}"
                )
            self._sites[site] = part
        return self._sites[site]

    def changes(self, site: str) -> dict[int, list[str]]:
        """Returns the texts of the changes that a site took in, by tick, in order.

        They are in its records, and in its events, which also have those whose record is
        missing.
        """
        named = self[site].changes()
        events = [
            event for event in self.events if event.kind == "change" and event.member == site
        ]
        recorded = set(self[site].tick.tolist()) if events else set()
        for event in events:
            if event.ticks not in recorded:
                named.setdefault(event.ticks, []).append(event.command)
        return dict(sorted(named.items()))

    def commands(self, site: str) -> dict[int, list[CoreChange]]:
        """Returns the same, as the site took them in.

        Raises:
            LogError: the log names a change that is none.
        """
        named = self.changes(site).items()
        try:
            return {
                tick: [parse_core_change(self.scenario, site, one) for one in texts]
                for tick, texts in named
            }
        except ScenarioError as error:
            raise LogError(f"{self.source}: {error}") from None

    def shown(self, site: str) -> dict[str, Ints]:
        """Returns the tick of each peer that a site's user was shown at its records, -1 before
        the first.

        That is the sample in use; with `[sites.NAME.view]` the newest that had come over the
        view by then.
        """
        part = self[site]
        every = PictureDelay(self.scenario, site).list_shown_samples(part.last_tick + 1)
        shown = {
            peer: np.minimum(ticks[part.tick], self[peer].last_tick)
            for peer, ticks in every.items()
        }
        return {**part.used, **shown}

    def link_stats(self, site: str) -> list[LinkStats]:
        """Returns the statistics that a site published, in order."""
        return self.timed_link_stats(site).messages

    def timed_link_stats(self, site: str) -> TimedMessages[LinkStats]:
        """Returns the same with the times at which they came and were sent."""
        topic = self._topic(site, topics.LINK)
        stats = self._decode(topic, LinkStats)
        order = sorted(range(len(stats)), key=lambda n: stats[n].tick)
        times = (column[order] for column in self._channel(topic).times())
        return TimedMessages([stats[n] for n in order], *times)

    def timed_events(self) -> TimedMessages[Event]:
        """Returns the events in the order in which they came to the recorder, with times as
        well.
        """
        found = self._event_topics()
        events = [event for topic in found for event in self._decode(topic, Event)]
        if not events:
            return TimedMessages([], *ChannelMessages().times())
        times = [self._channel(topic).times() for topic in found]
        log_ns, publish_ns = (np.concatenate(column) for column in zip(*times, strict=True))
        order = np.argsort(log_ns, kind="stable")
        return TimedMessages(
            [events[n] for n in order.tolist()], log_ns[order], publish_ns[order]
        )

    def recorder_stats(self) -> list[RecorderStats]:
        """Returns the recorder's statistics of its own work, in order."""
        return self._decode(self._topic(topics.RECORDER, topics.STATS), RecorderStats)

    def table(self, name: str, kind: str = "") -> Table:
        """Returns a part of the log as a table: columns with names, units and meanings.

        Args:
            name: a site, or "events".
            kind: of a site, "state" (a row per record), "link" (its statistics) or "arrivals"
                (a row per sample that came in).

        Raises:
            UnknownName: there is no such part.
            LogError: its messages cannot be read.
        """
        if name == EVENTS_TABLE and name not in self.sites:
            return build_events_table(self.timed_events(), self.source)
        site = self[name]
        match kind:
            case "" | "state":
                return build_state_table(site, self.scenario)
            case "link":
                return build_link_table(site, self.timed_link_stats(name), self.source)
            case "arrivals":
                return build_arrivals_table(site, self.source, live=self.driver == "live")
        raise UnknownName(
            f"no table {kind!r} of {name}; there are {', '.join(SITE_TABLE_KINDS)}"
        )

    def tables(self) -> Iterator[Table]:
        """Yields every table, one at a time: of each site, and the events."""
        for site in self.sites:
            for kind in SITE_TABLE_KINDS:
                yield self.table(site, kind)
        yield build_events_table(self.timed_events(), self.source)

    def frame(self, name: str, kind: str = "") -> "polars.DataFrame":
        """Returns the same as a polars data frame; for pandas there is `to_frame`.

        Raises:
            UsageError: polars is not installed.
        """
        return to_data_frame(self.table(name, kind))


def open_log(
    source: str | Path | BinaryIO,
    *more: str | Path | BinaryIO,
    progress: Progress | None = None,
    law: LawFiles = (),
    other_version: bool = False,
    remember: bool = False,
) -> Log:
    """Returns the log in a file, or in files that are parts of one session, in any order.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("run.mcap")
    >>> tn.open_log(path)["m"].t_s[-1]
    np.float64(0.099)

    Args:
        source: a path, or a file opened for reading.
        more: further parts.
        progress: called while they are read.
        law: files of control laws that the log names, which may run when it is executed, see
            docs/code-that-runs.md. Laws of runs that this process has made may.
        other_version: whether these may have another hash than the log names.
        remember: whether they may run for other logs that name their hashes, with the same
            settings.

    Raises:
        UsageError: `law` is none that the log names.
        LogError: a file is missing, is no MCAP file, or no log of trilat-net; files are of
            different sessions, or disagree on a message.
    """
    log = Log(merge_parts(_read_parts((source, *more), progress)))
    allow_logged_code(log.scenario, law, other_version=other_version, remember=remember)
    return log


def open_logs(*sources: str | Path, progress: Progress | None = None) -> list[Log]:
    """Returns the logs in files and folders, see `open_log`; files of one session are its
    parts.
    """
    files: list[Path] = []
    for path in map(Path, sources):
        if not (found := sorted(path.glob("*.mcap")) if path.is_dir() else [path]):
            raise LogError(f"{path}: no log is in this directory")
        files += found
    sessions: dict[str, list[LogContents]] = {}
    for part in _read_parts(files, progress):
        sessions.setdefault(str(identify_session(part)), []).append(part)
    return [Log(merge_parts(parts)) for parts in sessions.values()]


def _read_parts(
    sources: Sequence[str | Path | BinaryIO], progress: Progress | None
) -> list[LogContents]:
    files: list[tuple[BinaryIO, str]] = []
    parts: list[LogContents] = []
    with ExitStack() as stack:
        for one in sources:
            if isinstance(one, str | Path):
                with _reading(str(one)):
                    files.append((stack.enter_context(open_regular(Path(one))), str(one)))
            elif hasattr(one, "seek"):
                files.append((one, "log"))
            else:
                raise LogError(
                    f"a log is a path, or a file opened for reading, not {one!r:.80}"
                )
        sizes = [_measure(stream) for stream, _ in files]
        for n, (stream, name) in enumerate(files):
            with _reading(name):
                shifted = shift_progress(progress, sum(sizes[:n]), sum(sizes))
                parts.append(read_contents(stream, name, shifted))
    return parts


@contextmanager
def _reading(name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise LogError(
            f"{name}: cannot be read: {error.strerror}{describe_unfinished(Path(name))}"
        ) from None


def _measure(stream: BinaryIO) -> int:
    here = stream.tell()
    size = stream.seek(0, os.SEEK_END)
    stream.seek(here)
    return size - here


def read_link_delays(path: Path, link: str) -> list[TracePoint]:
    """Returns the delays of the samples of a link such as "m1->s", by their own stamps.

    These are the delays of the network that carried them, as the receiver's records have them
    in `rx`, without those that the session's scenario injected. A negative one comes of the
    clocks and counts as none; of a sample that came twice the shorter one counts. A tick of
    which the sender has a record was sent.

    Raises:
        OSError: the file cannot be opened.
        ValueError: it is no log, or has no such link, or no sample came over it.
    """
    status = path.stat()  # raises what open would, in the same words
    links = _read_links(path, status.st_mtime_ns, status.st_size)
    if link not in links:
        hint = suggest_nearest(link, list(links)) or "."
        raise ValueError(f"has no link {link!r}{hint} Its links are {', '.join(links)}")
    if not links[link]:
        raise ValueError(f"nothing came over {link} in it")
    return links[link]


@lru_cache(maxsize=1)
def _read_links(path: Path, modified_ns: int, size: int) -> dict[str, list[TracePoint]]:  # noqa: ARG001
    """Returns the rows of every link of a log; a scenario asks for one after the other."""
    try:
        log = open_log(path)
        links = (
            (site, *link) for site in log.sites for link in enumerate(log.scenario.peers(site))
        )
        return {
            f"{peer}->{site}": list(_iterate_delays(log, site, n, peer))
            for site, n, peer in links
        }
    except LogError as error:
        raise ValueError(str(error).removeprefix(f"{path}: ")) from None


def _iterate_delays(log: Log, site: str, index: int, peer: str) -> Iterator[TracePoint]:
    states = log[site].states
    delays_us: dict[int, int] = {}
    for state in states:
        for sender, tick, delay_us in state.rx:
            if sender == index and tick >= 0:
                delays_us[tick] = min(delays_us.get(tick, MAX_DELAY_US), max(delay_us, 0))
    if not delays_us:
        return
    longest_ns = 1000 * max(delays_us.values())
    gaps = _find_gaps_ns(states)
    rate_hz = log.scenario.sites[peer].rate_hz
    sent = log[peer].tick.tolist() if peer in log.sites else []
    # what the peer sent before the first arrival and after the last one was lost as well
    ticks = {*sent, *delays_us} if sent else range(max(delays_us) + 1)
    for tick in sorted(ticks):
        stamp_ns = tick * NS_PER_S // rate_hz
        came = tick in delays_us
        if came or not any(
            stamp_ns <= end and stamp_ns + longest_ns >= start for start, end in gaps
        ):
            # the microsecond in which the stamp lies, as the core counts it
            yield stamp_ns // 1000 / 1e6, delays_us[tick] / 1e3 if came else math.inf


def _find_gaps_ns(states: Sequence[State]) -> list[tuple[int, float]]:
    """Returns when samples may have come unseen, ns: where records are missing, and after the
    last one.
    """
    gaps: list[tuple[int, float]] = [
        (a.t_ns, b.t_ns) for a, b in pairwise(states) if b.tick != a.tick + 1
    ]
    if states and states[0].tick > 0:
        gaps.append((0, states[0].t_ns))
    return [*gaps, (states[-1].t_ns if states else 0, math.inf)]
