"""Decodes the channels of a log: its scenario, its sites' records, events and statistics.

A log has one channel for each kind of message that a site or the recorder publishes.

Invariant:
    - Messages are decoded when they are accessed, and only the fields that are asked for. A
      record in which these are invalid raises an error that names the file. An invalid event or
      statistics message is skipped and reported in `DecodedLog.unreadable`.
    - Channels of other sessions and members are ignored.
"""

import hashlib
from collections.abc import Iterator, Mapping
from typing import TypeVar

import numpy as np

from ..core import CoreChange
from ..errors import LogError, ScenarioError, UnknownName, WireError, count_nouns
from ..net import READABLE, Event, LinkStats, RecorderStats, decode, topics
from ..scenario import Scenario, parse_embedded
from .log_contents import ChannelMessages, LogContents
from .site_log import SiteLog, TimedMessages

M = TypeVar("M", Event, LinkStats, RecorderStats)


class DecodedLog(Mapping[str, SiteLog]):
    """The messages of a session: a mapping from the name of each site to its records.

    See `Log`, the public class, for the arguments and attributes.
    """

    def __init__(self, contents: LogContents) -> None:
        """Reads the scenario and the events of a log. Records are decoded on first access."""
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
            raise LogError(
                f"{self.source}: the scenario in this log cannot be read: {error}"
            ) from None
        self.sites = self.scenario.names

        self._contents = contents
        self._sites: dict[str, SiteLog] = {}
        self.unreadable: list[str] = []
        self.events: list[Event] = []
        for topic in self._event_topics():
            self.events += self._read_events(topic)

    def __getitem__(self, site: str) -> SiteLog:
        if site not in self.scenario.sites:
            raise UnknownName(
                f"there is no site {site!r} in {self.source}; the sites are "
                f"{', '.join(self.sites)}"
            )
        if site not in self._sites:
            self._sites[site] = self._read_site(site)
        return self._sites[site]

    def __iter__(self) -> Iterator[str]:
        return iter(self.sites)

    def __len__(self) -> int:
        return len(self.sites)

    def _read_site(self, site: str) -> SiteLog:
        """Creates the object with all records of one arm that `log[name]` returns.

        Raises:
            LogError: A tick is beyond the duration of the scenario.
        """
        channel = self._channel(self._topic(site, topics.STATE))
        site_log = SiteLog(
            name=site,
            peers=self.scenario.peers(site),
            rate_hz=self.scenario.sites[site].rate_hz,
            payloads=channel.payloads,
            source=self.source,
            times=channel.times(),
            layout=self.scenario.layout(site),
            channel=self.scenario.channel(site),
            axes=self.scenario.arms[site].axes,
        )
        ticks = self.scenario.ticks(site)
        last_tick = site_log.last_tick
        # Counts and arrays grow with the last tick, so a damaged tick number could fill the
        # memory.
        if last_tick >= ticks:
            raise LogError(
                f"{self.source}: {site} has a record of tick {last_tick}, but the scenario has "
                f"only {count_nouns(ticks, 'tick')}"
            )
        return site_log

    def _topic(self, member: str, channel: str) -> str:
        """Returns the topic of a member's channel."""
        return "/" + topics.key(self.session["session"], member, channel)

    def _event_topics(self) -> list[str]:
        """Returns the event topics of the members that occur in the log, sorted."""
        members = (*self.sites, topics.RECORDER)
        event_topics = {self._topic(member, topics.EVENT) for member in members}
        return sorted(event_topics & self._contents.channels.keys())

    def _channel(self, topic: str) -> ChannelMessages:
        """Returns all messages of one topic of the log, for example the records of one site.

        Empty if the log does not contain the topic.
        """
        return self._contents.channels.get(topic) or ChannelMessages()

    def _decode(self, topic: str, kind: type[M]) -> list[M]:
        """Decodes the messages of a channel, skipping those that are damaged.

        Messages that cannot be decoded are removed from the channel, so that `unreadable`
        reports them only once even if the channel is decoded again. The log then counts as
        incomplete.

        Args:
            topic: Topic of the channel.
            kind: Class of the messages.

        Returns:
            The messages that can be decoded, in file order.
        """
        channel = self._channel(topic)
        readable = ChannelMessages()
        first_problem = ""
        messages: list[M] = []
        for index, payload in enumerate(channel.payloads):
            try:
                messages.append(decode(payload, kind, READABLE))
                readable.add(payload, channel.log_ns[index], channel.publish_ns[index])
            except WireError as error:
                first_problem = first_problem or str(error)
        if first_problem:
            lost_count = count_nouns(len(channel) - len(messages), "message")
            self.unreadable.append(
                f"{self.source}: {lost_count} on {topic} cannot be read: {first_problem[:200]}"
            )
            self._contents.channels[topic] = readable
            self._contents.complete = False
        return messages

    def _read_events(self, topic: str) -> list[Event]:
        """Returns the events of one process of the session, such as "lost".

        A process that is restarted numbers its events from 0 again. The starts are in the order
        in which they first appear in the file, and the events of each start in numerical order.
        """
        events = self._decode(topic, Event)
        boots = list(dict.fromkeys(event.boot for event in events))
        starts = {boot: start for start, boot in enumerate(boots)}
        return sorted(events, key=lambda event: (starts[event.boot], event.n))

    def timed_events(self) -> TimedMessages[Event]:
        """Returns the events of all processes of the session, in order of arrival.

        An event is a notable occurrence, such as a lost connection. Each event is returned with
        the time at which it was sent and the time at which it arrived at the recorder.
        """
        events: list[Event] = []
        log_times = [np.zeros(0, np.int64)]
        publish_times = [np.zeros(0, np.int64)]
        for topic in self._event_topics():
            events += self._decode(topic, Event)
            topic_log_ns, topic_publish_ns = self._channel(topic).times()
            log_times.append(topic_log_ns)
            publish_times.append(topic_publish_ns)
        log_ns = np.concatenate(log_times)
        publish_ns = np.concatenate(publish_times)
        order = np.argsort(log_ns, kind="stable")
        ordered_events = [events[n] for n in order.tolist()]
        return TimedMessages(ordered_events, log_ns[order], publish_ns[order])

    def link_stats(self, site: str) -> list[LinkStats]:
        """Returns the statistics that a site published about its network links, such as losses.

        Args:
            site: Name of the site.

        Returns:
            The messages, sorted by tick. Empty if the log contains none.
        """
        return self.timed_link_stats(site).messages

    def timed_link_stats(self, site: str) -> TimedMessages[LinkStats]:
        """Returns a site's network link statistics with their sending and arrival times.

        Args:
            site: Name of the site.

        Returns:
            The messages in tick order, each with the time at which it was sent and the time at
            which it arrived at the recorder.
        """
        topic = self._topic(site, topics.LINK)
        stats = self._decode(topic, LinkStats)
        order = sorted(range(len(stats)), key=lambda n: stats[n].tick)
        log_ns, publish_ns = self._channel(topic).times()
        return TimedMessages([stats[n] for n in order], log_ns[order], publish_ns[order])

    def recorder_stats(self) -> list[RecorderStats]:
        """Decodes the statistics that the recorder published about itself while recording.

        They show, for example, how many messages of each channel were missing.

        Returns:
            The messages, in file order. Empty if the log contains none.
        """
        return self._decode(self._topic(topics.RECORDER, topics.STATS), RecorderStats)

    def changes(self, site: str) -> dict[int, list[str]]:
        """Lists the parameter changes that a site applied during the run.

        The site stores its changes in its records. If a record is missing, its changes are
        taken from the "change" events of the site.

        Args:
            site: Name of the site.

        Returns:
            Maps each tick with changes to the changes as JSON strings.
        """
        changes = self[site].changes()
        change_events = [event for event in self.events if event.kind == "change"]
        site_events = [event for event in change_events if event.member == site]
        if site_events:
            recorded = set(self[site].tick.tolist())
            for event in site_events:
                if event.ticks not in recorded:
                    changes.setdefault(event.ticks, []).append(event.command)
        return dict(sorted(changes.items()))

    def commands(self, site: str) -> dict[int, list[CoreChange]]:
        """Lists the changes that a site applied, decoded so that the run can be repeated.

        `changes` returns the same changes as JSON strings.

        Args:
            site: Name of the site.

        Returns:
            Maps each tick with changes to the changes in the form expected by `Site.step`.

        Raises:
            LogError: A JSON string is not a valid change of the scenario.
        """
        commands = {}
        try:
            for tick, texts in self.changes(site).items():
                changes = [self.scenario.parse_core_change(site, text) for text in texts]
                commands[tick] = changes
        except ScenarioError as error:
            raise LogError(f"{self.source}: {error}") from None
        return commands
