"""The topics of a session's sites in the graph of ROS 2.

Invariant:
    - A message is packed only while somebody listens to its topic.
    - The topics are named by `topic_names`, and their messages packed by `published`, as in a
      bag.
"""

from typing import NamedTuple

from trilat_net.core.ticks import NS_PER_S
from trilat_net.log.ros2.published import SiteMessages
from trilat_net.log.ros2.topic_names import TopicTable
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.messages import LinkStats, State
from trilat_net.net.ros2_graph import QualityOfService, Ros2Graph, TopicPublisher
from trilat_net.scenario import Scenario

from .running_session import ShareHistory

RELIABLE = QualityOfService()
LATCHED = QualityOfService(latched=True, depth=1)


class BridgeEnds(NamedTuple):
    """Both ends of the bridge: the graph of ROS, and the session.

    Attributes:
        graph: the graph of ROS 2.
        bus: the bus to the session.
        clock: the clock of this process.
        session: the session's name.
        table: the names of the topics.
    """

    graph: Ros2Graph
    bus: Bus
    clock: Clock
    session: str
    table: TopicTable

    def topic(self, site: str, name: str) -> str:
        """Returns the full name of a topic."""
        return self.table.find(self.session, site, name)


class SiteTopics:
    """The topics of one site under `/<session>/<site>`, and its part of `/tf`.

    Args:
        ends: the graph and the session.
        scenario: the scenario of the session.
        site: the name of the site.
        epoch_unix_ns: the session's epoch in Unix time; the stamps count from there.
        frames: the publisher of `/tf`.

    Attributes:
        frame: the frame of the site's end effector.
        shares: the shares of the site in its peers.
        newest: the record that was published last.
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
        """Returns True if somebody listens to a topic of the site."""
        return self._publishers[topic].has_subscribers

    def publish(self, record: State, rate_hz: float) -> None:
        """Publishes a record on the topics with listeners, at most `rate_hz` records a second.

        Records older than the newest published one of the same boot are ignored.
        """
        newest = self.newest
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
        """Publishes statistics of the site on the topics with listeners."""
        for topic, data in self._messages.pack_statistics(stats):
            if self._has_listener(topic):
                self._publishers[topic].put(data)
