"""Exports a log as a ROS 2 bag: standard messages in an MCAP file with the profile `ros2`.

The bag can be played with `ros2 bag play` or read by ROS tools. It contains the messages that
the live ROS 2 bridge would have published during the run.

Invariant:
    - The bag contains every record exactly once, with its values and times.
    - The names and types of the topics are those of the live bridge
      (`trilat_net.log.ros2.published`).
    - Header stamps are the nominal times of the ticks. The publish time of a message is when it
      was sent, and its log time is when it arrived.
"""

import heapq
from collections.abc import Callable, Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np

from ...analysis import DominanceHistory
from ...log import SCENARIO, Log, McapWriter, collect_provenance
from ...log.ros2 import (
    DIAGNOSTICS,
    FRAMES_TOPIC,
    NAMINGS,
    Ros2Topics,
    SiteMessages,
    TopicTable,
    cdr,
    make_session_name,
    pack_session_diagnostics,
    ros2_messages,
)
from ...records import NS_PER_S
from ..export import ExportFormat, Written

SOURCE_METADATA = "trilat.source"
"""Name of the metadata record that describes the exported session."""
_QOS_FILE = cdr.DEFINITIONS / "qos.yaml"
_QOS = _QOS_FILE.read_text(encoding="utf-8")
"""Template of a reliable quality of service (QoS) profile in rosbag2 notation."""
_VOLATILE = {"DEPTH": "10", "DURABILITY": "2"}
"""Values for `_QOS`: keep the last ten messages, for current subscribers only."""
_LATCHED = {"DEPTH": "1", "DURABILITY": "1"}
"""Values for `_QOS`: keep the last message for late subscribers too (transient local)."""
_RECORDS_PER_REPORT = 1000
"""Number of records between two progress reports."""

TopicMessages = list[tuple[str, bytes]]
"""Pairs of topic and encoded message."""
TimedMessages = tuple[int, int, TopicMessages]
"""Log time in ns, publish time in ns, and the topic and data of each message with these times.
"""


def _write(
    log: Log,
    path: Path,
    written: Written,
    *,
    names: str = NAMINGS[0],
) -> None:
    """Writes a log as a bag that `ros2 bag` and other ROS 2 players can read.

    Each site has topics such as `/<session>/<site>/joint_states`. The topics of the session are
    `/<session>/events`, `/<session>/log`, `/tf` and `/diagnostics`. Channel metadata contain
    the units, names and orientation representations. An existing file is replaced.

    Args:
        log: Log of the run to export.
        path: File of the bag.
        written: Function that is called with the number of records written since the last call.
        names: Topic naming: "crisp", "crtk", or a file of names as for `trilat ros2 --names`.

    Raises:
        LogError: A message of the log cannot be read.
        UsageError: The names cannot be read.
        OSError: The data could not be written to disk.
    """
    table = TopicTable.read(names)
    log_session = log.session.get("session", "") or log.scenario.name
    session = make_session_name(log_session)
    with path.open("wb") as stream:
        provenance = collect_provenance()
        version = provenance["version_trilat-net"]
        file = McapWriter(stream, f"trilat-net {version}", profile="ros2")
        source = {"source": log.source, **log.session}
        file.add_metadata(SOURCE_METADATA, source)
        file.add_attachment(
            create_time=0,
            log_time=0,
            name=SCENARIO,
            media_type="application/toml",
            data=log.scenario_text.encode(),
        )
        channels = {}
        topics = Ros2Topics.of_session(log.scenario, session, table)
        for topic, channel in topics.items():
            channels[topic] = _add_quality(channel)
        channel_numbers = ros2_messages.StandardChannels(file, channels)

        streams: list[Iterator[TimedMessages]] = []
        for site in log.sites:
            site_bag = _SiteBag(
                log=log,
                site=site,
                session=session,
                table=table,
                progress=written,
            )
            streams.append(site_bag.iterate_records())
            streams.append(site_bag.iterate_statistics())
        streams.append(_iterate_events(log, session))
        streams.append(_iterate_diagnostics(log, session))

        # Each stream is in the order of log times. Merging them keeps this order.
        merged_streams = heapq.merge(*streams, key=itemgetter(0))
        for log_ns, publish_ns, messages in merged_streams:
            for topic, data in messages:
                channel_number = channel_numbers[f"/{topic}"]
                file.add_message(channel_number, log_ns, data, publish_ns)
        file.finish()


def _add_quality(channel: ros2_messages.Ros2Channel) -> ros2_messages.Ros2Channel:
    """Adds the quality of service (QoS) to the metadata of a channel, in rosbag2 notation."""
    text = _QOS
    values = _LATCHED if channel.latched else _VOLATILE
    for placeholder, value in values.items():
        text = text.replace(placeholder, value)
    metadata = {"offered_qos_profiles": text, **channel.about}
    return channel._replace(about=metadata)


class _SiteBag:
    """Converts the records of one arm to standard ROS 2 messages for a bag.

    Args:
        log: Log of the run to export.
        site: Name of the site.
        session: Name of the session in topics.
        table: Topic names.
        progress: Function that is called with the number of records since the last call.
    """

    def __init__(
        self,
        log: Log,
        site: str,
        session: str,
        table: TopicTable,
        progress: Callable[[int], None],
    ) -> None:
        self._log = log
        self._site = site
        self._session = session
        self._table = table
        self._progress = progress
        epoch_unix_ns = _find_epoch_ns(log)
        self._messages = SiteMessages(log.scenario, site, epoch_unix_ns)

    def _find_topic(self, topic: str) -> str:
        """Returns the full name of a topic of the site."""
        return self._table.find(self._session, self._site, topic)

    def _name_messages(self, messages: ros2_messages.NamedMessages) -> TopicMessages:
        """Returns the messages with fully qualified topic names."""
        topic_messages: TopicMessages = []
        for name, data in messages:
            topic = self._find_topic(name)
            topic_messages.append((topic, data))
        return topic_messages

    def iterate_records(self) -> Iterator[TimedMessages]:
        """Yields ROS messages about the motion of a site's arm, such as its joint states.

        The messages are sorted by the time at which the records arrived in the log, as required
        for a bag. The first messages include the robot description.
        """
        records = self._log[self._site]
        dominance = DominanceHistory.of_log(self._log, self._site, records.t_s)
        dominance_factors = dominance.alpha.tolist()
        log_ns = records.log_time_ns.tolist()
        publish_ns = records.publish_time_ns.tolist()
        # The stable sort keeps the order of records that arrived at the same time.
        rows_by_arrival = np.argsort(records.log_time_ns, kind="stable")

        for count, row in enumerate(rows_by_arrival.tolist(), 1):
            record = records.states[row]
            packed = self._messages.pack_record(record, dominance_factors[row])
            messages = self._name_messages(packed)
            if count == 1:
                topic = self._find_topic("robot_description")
                description = (topic, self._messages.description)
                messages.insert(0, description)
            for data in self._messages.pack_frames(record):
                messages.append((FRAMES_TOPIC, data))

            yield log_ns[row], publish_ns[row], messages
            is_last = count == len(records)
            if is_last or count % _RECORDS_PER_REPORT == 0:
                # The last report may cover fewer records than the others.
                new_records = (count - 1) % _RECORDS_PER_REPORT + 1
                self._progress(new_records)

    def iterate_statistics(self) -> Iterator[TimedMessages]:
        """Yields ROS messages about the delays and losses of the links to the site.

        Each item contains the time of arrival in the log, the time of publication (both in ns),
        and the messages. Items are sorted by time of arrival, as required for a bag.
        """
        timed = self._log.timed_link_stats(self._site)
        log_times_ns = timed.log_ns.tolist()
        publish_times_ns = timed.publish_ns.tolist()
        rows = zip(log_times_ns, publish_times_ns, timed.messages, strict=True)
        ordered_rows = sorted(rows, key=itemgetter(0))
        for log_ns, publish_ns, stats in ordered_rows:
            packed = self._messages.pack_statistics(stats)
            messages = self._name_messages(packed)
            yield log_ns, publish_ns, messages


def _find_epoch_ns(log: Log) -> int:
    """Returns the Unix time at which a session started, in ns, or 0 in virtual time."""
    epoch_text = log.session.get("epoch_unix_ns", "0")
    return int(epoch_text)


def _iterate_events(log: Log, session: str) -> Iterator[TimedMessages]:
    """Yields the messages for the events of a session."""
    timed = log.timed_events()
    log_times_ns = timed.log_ns.tolist()
    publish_times_ns = timed.publish_ns.tolist()
    rows = zip(log_times_ns, publish_times_ns, timed.messages, strict=True)
    for log_ns, publish_ns, event in rows:
        packed = ros2_messages.pack_event(event, publish_ns)
        messages = [(f"{session}/{topic}", data) for topic, data in packed]
        yield log_ns, publish_ns, messages


def _iterate_diagnostics(log: Log, session: str) -> Iterator[TimedMessages]:
    """Yields one ROS message per second about the state of all sites, for monitoring tools.

    Each message is composed from the most recent record of every site. Its times are the latest
    times of these records, but never earlier than those of the previous message, because a bag
    must be sorted by time.
    """
    site_logs = [log[site] for site in log.sites if len(log[site])]
    end_times_ns = [int(site_log.t_ns.max()) for site_log in site_logs]
    end_ns = max(end_times_ns, default=-1)
    log_ns = 0
    publish_ns = 0

    for second_number in range(end_ns // NS_PER_S + 1):
        t_ns = second_number * NS_PER_S
        records = []
        for site_log in site_logs:
            # Row of the newest record at or before this second.
            next_row = int(np.searchsorted(site_log.t_ns, t_ns, side="right"))
            row = next_row - 1
            if row < 0:
                continue
            records.append(site_log.record(row))
            record_log_ns = int(site_log.log_time_ns[row])
            log_ns = max(log_ns, record_log_ns)
            record_publish_ns = int(site_log.publish_time_ns[row])
            publish_ns = max(publish_ns, record_publish_ns)

        if records:
            epoch_unix_ns = _find_epoch_ns(log)
            data = pack_session_diagnostics(session, epoch_unix_ns, records)
            yield log_ns, publish_ns, [(DIAGNOSTICS, data)]


FORMAT = ExportFormat(_write, "-ros2.mcap")
