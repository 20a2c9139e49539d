"""What a session shows in the graph of ROS 2: the topics of its sites.

Invariant: a message is made only while somebody listens. Names are those of `topic_names`,
messages those of `published`, which a bag has as well.
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


class Ends(NamedTuple):
    """Both ends of the bridge: the graph of ROS, and a session by its bus, its name and its
    topics.
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
    """What one site shows, under `/<session>/<site>`, and by `frames` of `/tf`; stamps count
    from the epoch.

    Its end effector is in `frame`; `newest` is the record that was shown last.
    """

    def __init__(
        self,
        ends: Ends,
        scenario: Scenario,
        site: str,
        epoch_unix_ns: int,
        frames: TopicPublisher,
    ) -> None:
        self._messages = SiteMessages(scenario, site, epoch_unix_ns)
        self._frames = frames
        self.frame = self._messages.frame
        self.shares = ShareHistory(scenario, site)
        self._publishers = {
            name: ends.graph.publisher(
                ends.topic(site, name), channel.kind, LATCHED if channel.latched else RELIABLE
            )
            for name, channel in self._messages.topics.items()
        }
        self._publishers["robot_description"].put(self._messages.description)
        self.newest: State | None = None

    def _is_heard(self, topic: str) -> bool:
        return self._publishers[topic].has_subscribers

    def show(self, record: State, rate_hz: float) -> None:
        """Publishes a record, as far as somebody listens, if it is the first of its time at a
        rate.

        None is shown after a later one.
        """
        last = self.newest
        times = [int(one.t_ns * rate_hz) // NS_PER_S for one in (record, last or record)]
        if last is not None and record.boot == last.boot and times[0] <= times[1]:
            return
        self.newest = record
        for topic, data in self._messages.pack_record(
            record, self.shares.at(record.t_ns), self._is_heard
        ):
            self._publishers[topic].put(data)
        if self._frames.has_subscribers:
            for data in self._messages.pack_frames(record):
                self._frames.put(data)

    def show_statistics(self, stats: LinkStats) -> None:
        """Publishes statistics of the site, as far as somebody listens."""
        for topic, data in self._messages.pack_statistics(stats):
            if self._is_heard(topic):
                self._publishers[topic].put(data)
