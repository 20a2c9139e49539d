"""A session as it was recorded: the scenario, what happened, and every site's part.

Law: a log is read as it is. What its file holds is decoded when somebody asks, and what is no message of ours
is an error that names the file, then.
"""

import hashlib
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

import numpy as np

from ..core.tick import Command
from ..errors import LogError, ScenarioError, WireError
from ..net import topics
from ..net.messages import READABLE, Event, LinkStats, RecorderStats
from ..net.stats import ticks_between
from ..net.wire import decode
from ..scenario import Scenario, command_from, embedded
from .accounting import Account
from .columns import Ints
from .contents import Channel, Contents
from .site_log import SiteLog, Times
from .writer import ACCOUNTS

if TYPE_CHECKING:
    import polars

    from .table import Table

M = TypeVar("M", Event, LinkStats, RecorderStats)


class Timed(NamedTuple, Generic[M]):
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

    def __init__(self, whole: Contents) -> None:
        self.sources = whole.sources
        self.source = whole.source
        self.session = whole.session
        self.scenario_sha256 = hashlib.sha256(whole.scenario).hexdigest()
        try:
            self.scenario_text = whole.scenario.decode()
            self.scenario: Scenario = embedded(self.scenario_text, f"{self.source}: scenario")
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

    def _channel(self, topic: str) -> Channel:
        return self._whole.channels.get(topic) or Channel()

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
        return written if len(self.sources) == 1 else {**self._accounts(), **written}

    def _accounts(self) -> dict[str, str]:
        """Returns the accounts of the sites' channels, drawn up from what is there."""
        made, texts = self._made(), {}
        for name in self.sites:
            every = ticks_between(self[name].rate_hz)
            numbers = {
                topics.STATE: self[name].tick.tolist(),
                topics.LINK: [stats.tick // every for stats in self.link_stats(name)],
                topics.EVENT: [event.n for event in self.events if event.member == name and event.n >= 0],
            }
            for channel, have in numbers.items():
                account = Account()
                for number in have:
                    account.take(number)
                account.expect(made.get(name, 0) if channel == topics.STATE else 0)
                texts[self._topic(name, channel)] = account.as_text()
        return texts

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
                Times(*channel.times()),
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

    def commands(self, site: str) -> dict[int, list[Command]]:
        """Returns the same, as the site took them in.

        Raises:
            LogError: the log names a change that is none.
        """
        try:
            return {
                tick: [command_from(self.scenario, site, text) for text in texts]
                for tick, texts in self.changes(site).items()
            }
        except ScenarioError as error:
            raise LogError(f"{self.source}: {error}") from None

    def link_stats(self, site: str) -> list[LinkStats]:
        """Returns the statistics that a site published, in order."""
        return self.timed_link_stats(site).messages

    def timed_link_stats(self, site: str) -> Timed[LinkStats]:
        """Returns the same with the times at which they came and were sent."""
        topic = self._topic(site, topics.LINK)
        stats = list(self._decoded(topic, LinkStats))
        order = sorted(range(len(stats)), key=lambda n: stats[n].tick)
        return Timed([stats[n] for n in order], *(times[order] for times in self._channel(topic).times()))

    def timed_events(self) -> Timed[Event]:
        """Returns what happened, in the order in which the recorder learnt of it, with times as well."""
        found = [topic for topic in sorted(self._whole.channels) if topic.endswith(f"/{topics.EVENT}")]
        events = [event for topic in found for event in self._decoded(topic, Event)]
        times = [self._channel(topic).times() for topic in found]
        if not events:
            return Timed([], *Channel().times())
        log_ns, publish_ns = (np.concatenate(column) for column in zip(*times, strict=True))
        order = np.argsort(log_ns, kind="stable")
        return Timed([events[n] for n in order.tolist()], log_ns[order], publish_ns[order])

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
        from .tables import table

        return table(self, name, kind)

    def frame(self, name: str, kind: str = "") -> "polars.DataFrame":
        """Returns the same as a polars data frame; pandas has it by `log.frame("m1").to_pandas()`.

        Raises:
            UsageError: polars is not installed.
        """
        from .frame import frame

        return frame(self.table(name, kind))
