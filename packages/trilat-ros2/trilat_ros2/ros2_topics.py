"""Publishes the states of a session's sites as ROS 2 topics.

The joint states, poses, torques and statistics of a site become standard ROS messages on topics
below `/<session>/<site>`, and the poses of its links become part of `/tf`.

Invariant:
    - A message is composed only while a ROS program subscribes to its topic, because composing
      it takes time.
    - The names of the topics (`topic_names`) and the content of the messages (`published`) are
      the same as in a ROS bag exported from a log.
"""

from pathlib import Path
from typing import NamedTuple

from trilat_net.app import ShareHistory
from trilat_net.files import write_whole
from trilat_net.log.ros2 import Ros2Topics, SiteMessages, TopicTable, build_rviz_config
from trilat_net.net import Bus, Clock, LinkStats, State
from trilat_net.net.ros2 import QualityOfService, Ros2Graph, TopicPublisher
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Scenario

RELIABLE = QualityOfService()
"""Quality of service of most topics."""
LATCHED = QualityOfService(latched=True, depth=1)
"""Quality of service of topics that send their last message to late subscribers."""


class BridgeEnds(NamedTuple):
    """The two networks that a bridge connects: the ROS 2 network and that of the session.

    Attributes:
        graph: Connection to the ROS programs.
        bus: Network connection to the session.
        clock: Clock of this process.
        session: Name of the session.
        table: Names of the ROS topics, as configured by the user.
    """

    graph: Ros2Graph
    bus: Bus
    clock: Clock
    session: str
    table: TopicTable

    def topic(self, site: str, name: str) -> str:
        """Returns the full ROS 2 name of an arm's topic, in the user's naming scheme.

        Args:
            site: Name of the site.
            name: Short name of the topic, such as "joint_states".
        """
        return self.table.find(self.session, site, name)

    def write_rviz_config(self, scenario: Scenario, path: Path) -> None:
        """Writes an RViz configuration that displays the arms of the session.

        Args:
            scenario: Scenario of the session.
            path: Path of the configuration. A file from an earlier session is replaced.

        Raises:
            UsageError: The file cannot be written.
        """
        topics = Ros2Topics.of_session(scenario, self.session, self.table)
        write_whole(path, build_rviz_config(topics))


class SiteTopics:
    """Publishes the state of one arm on those ROS 2 topics that have subscribers.

    Args:
        ends: Connections to ROS and to the session.
        scenario: Scenario of the session.
        site: Name of the site.
        epoch_unix_ns: Start of the session in Unix time, in ns, from which time stamps are
            counted.
        frames: Publisher of `/tf`, shared by all sites.

    Attributes:
        frame: Name of the frame of the site's end effector.
        shares: Dominance factors of the site over time.
        newest: The last published record, or None before the first one.
    """

    def __init__(
        self,
        ends: BridgeEnds,
        scenario: Scenario,
        site: str,
        epoch_unix_ns: int,
        frames: TopicPublisher,
    ) -> None:
        self._messages = SiteMessages(scenario, site, epoch_unix_ns)
        self._frames = frames
        self.frame = self._messages.frame
        self.shares = ShareHistory(scenario, site)
        self._publishers = {}
        for name, channel in self._messages.topics.items():
            quality = LATCHED if channel.latched else RELIABLE
            topic = ends.topic(site, name)
            self._publishers[name] = ends.graph.publisher(topic, channel.kind, quality)
        self._publishers["robot_description"].put(self._messages.description)
        self.newest: State | None = None

    def _has_listener(self, topic: str) -> bool:
        """Returns True if a ROS program subscribes to a topic, so that messages are needed."""
        return self._publishers[topic].has_subscribers

    def publish(self, record: State, rate_hz: float) -> None:
        """Publishes a record on all topics that have subscribers.

        A record is ignored if it is older than the last published record of the same process of
        the site, or if publishing it would exceed the rate.

        Args:
            record: Record of the site.
            rate_hz: Maximum number of records to publish per second of the session.
        """
        newest = self.newest
        # At most one record is published in each period of the rate.
        if newest is not None and record.boot == newest.boot:
            period = int(record.t_ns * rate_hz) // NS_PER_S
            newest_period = int(newest.t_ns * rate_hz) // NS_PER_S
            if period <= newest_period:
                return

        self.newest = record
        shares = self.shares.advance_to(record.t_ns)
        for topic, data in self._messages.pack_record(record, shares, self._has_listener):
            self._publishers[topic].put(data)

        if self._frames.has_subscribers:
            for data in self._messages.pack_frames(record):
                self._frames.put(data)

    def publish_statistics(self, stats: LinkStats) -> None:
        """Publishes link statistics of an arm on all ROS 2 topics that have subscribers.

        Args:
            stats: Statistics of the site's control loop and of its links.
        """
        for topic, data in self._messages.pack_statistics(stats):
            if self._has_listener(topic):
                self._publishers[topic].put(data)
