"""A ROS 2 bag: standard messages at full rate, in an MCAP file of profile `ros2`.

Invariant:
- A bag has every record once, with its numbers and times; nothing is decimated.
- Topics and types are those of the live bridge (`trilat_net.log.ros2.published`), and so are
  their names.
- A header's stamp is the nominal time of its tick, the publish time the time of sending, the
  log time the time of arrival.
"""

import heapq
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np

from ...analysis.dominance_history import trace_dominance
from ...core.ticks import NS_PER_S
from ...log.log_layout import SCENARIO, collect_provenance
from ...log.log_reader import Log
from ...log.mcap_writer import McapWriter
from ...log.ros2 import cdr, ros2_messages
from ...log.ros2.published import SiteMessages, list_topics, pack_session_diagnostics
from ...log.ros2.topic_names import (
    DIAGNOSTICS,
    FRAMES,
    NAMINGS,
    TopicTable,
    make_session_name,
    read_topic_table,
)
from ..export import ExportFormat, Written

SOURCE_METADATA = "trilat.source"
"""Metadata of the file: its session."""
_QOS = (cdr.DEFINITIONS / "qos.yaml").read_text(encoding="utf-8")
_VOLATILE = {"DEPTH": "10", "DURABILITY": "2"}
_LATCHED = {"DEPTH": "1", "DURABILITY": "1"}
"""Quality of service of the live topics: reliable; the last ten messages, or the last one also
for who comes later (transient local).
"""
_EVERY = 1000
"""Records between two reports of progress."""

TimedMessages = tuple[int, int, list[tuple[str, bytes]]]
"""Messages of one publish time, by topic: the log time and the publish time, ns, before them.
"""


def export_ros2(
    log: Log, path: Path, written: Written = lambda _: None, *, names: str = NAMINGS[0]
) -> None:
    """Writes a log as a bag that `ros2 bag` and its like play and read.

    The topics are those of the live bridge: `/<session>/<site>/joint_states` and so on, `/tf`,
    `/diagnostics`, and of the session `/<session>/events` and `/<session>/log`. Units, names
    and representations of orientations stand in the channels' metadata.

    An earlier file is replaced; `written` is called with the number of records since its last
    call.

    Args:
        log: the log.
        path: the bag.
        written: called with the number of records.
        names: "crisp", "crtk" or a file of names, as `trilat ros2 --names` takes it.

    Raises:
        LogError: a message of the log cannot be read.
        UsageError: the names cannot be read.
        OSError: the disk refuses.
    """
    table = read_topic_table(names)
    session = make_session_name(log.session.get("session", "") or log.scenario.name)
    with path.open("wb") as stream:
        file = McapWriter(
            stream, f"trilat-net {collect_provenance()['version_trilat-net']}", profile="ros2"
        )
        file.add_metadata(SOURCE_METADATA, {"source": log.source, **log.session})
        file.add_attachment(
            create_time=0,
            log_time=0,
            name=SCENARIO,
            media_type="application/toml",
            data=log.scenario_text.encode(),
        )
        sites = [
            _SiteRecords(log=log, name=name, session=session, table=table, progress=written)
            for name in log.sites
        ]
        known = {
            f"/{topic}": channel
            for topic, channel in list_topics(log.scenario, session, table).items()
        }
        bag = ros2_messages.StandardChannels(
            file, {topic: _offer_quality(channel) for topic, channel in known.items()}
        )
        parts = [part for site in sites for part in (site.records(), site.statistics())]
        parts += [_events(log, session), _diagnostics(log, session)]
        for log_ns, publish_ns, messages in heapq.merge(*parts, key=itemgetter(0)):
            for topic, data in messages:
                file.add_message(bag[f"/{topic}"], log_ns, data, publish_ns)
        file.finish()


def _offer_quality(channel: ros2_messages.Ros2Channel) -> ros2_messages.Ros2Channel:
    """Returns a channel whose metadata has its quality of service as rosbag2 writes it."""
    text = _QOS
    for word, number in (_LATCHED if channel.latched else _VOLATILE).items():
        text = text.replace(word, number)
    return channel._replace(about={"offered_qos_profiles": text, **channel.about})


class _SiteRecords:
    """The messages of one site, with their times."""

    def __init__(
        self,
        log: Log,
        name: str,
        session: str,
        table: TopicTable,
        progress: Callable[[int], None],
    ) -> None:
        self._log = log
        self._name = name
        self._progress = progress
        self._messages = SiteMessages(log.scenario, name, _find_epoch_ns(log))
        self._session = session
        self._table = table

    def _find_topic(self, topic: str) -> str:
        return self._table.find(self._session, self._name, topic)

    def _named(self, messages: Iterable[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        return [(self._find_topic(topic), data) for topic, data in messages]

    def records(self) -> Iterator[TimedMessages]:
        """Yields its records in the order of arrival."""
        part = self._log[self._name]
        shares = trace_dominance(self._log, self._name, part.t_s).alpha.tolist()
        log_ns = part.log_time_ns.tolist()
        publish_ns = part.publish_time_ns.tolist()
        for count, at in enumerate(np.argsort(part.log_time_ns, kind="stable").tolist(), 1):
            record = part.states[at]
            messages = self._named(self._messages.pack_record(record, shares[at]))
            if count == 1:
                messages.insert(
                    0, (self._find_topic("robot_description"), self._messages.description)
                )
            messages += [(FRAMES, data) for data in self._messages.pack_frames(record)]
            yield log_ns[at], publish_ns[at], messages
            if not count % _EVERY or count == len(part):
                self._progress((count - 1) % _EVERY + 1)

    def statistics(self) -> Iterator[TimedMessages]:
        """Yields its statistics in the order of arrival."""
        timed = self._log.timed_link_stats(self._name)
        rows = zip(
            timed.log_ns.tolist(), timed.publish_ns.tolist(), timed.messages, strict=True
        )
        for log_ns, publish_ns, stats in sorted(rows, key=itemgetter(0)):
            yield log_ns, publish_ns, self._named(self._messages.pack_statistics(stats))


def _find_epoch_ns(log: Log) -> int:
    return int(log.session.get("epoch_unix_ns", "0"))


def _events(log: Log, session: str) -> Iterator[TimedMessages]:
    timed = log.timed_events()
    rows = zip(timed.log_ns.tolist(), timed.publish_ns.tolist(), timed.messages, strict=True)
    for log_ns, publish_ns, event in rows:
        messages = ros2_messages.pack_event(event, publish_ns)
        yield log_ns, publish_ns, [(f"{session}/{topic}", data) for topic, data in messages]


def _diagnostics(log: Log, session: str) -> Iterator[TimedMessages]:
    """Yields a message of every whole second, after the records that it is of."""
    parts = [log[site] for site in log.sites if len(log[site])]
    end_ns = max((int(part.t_ns.max()) for part in parts), default=-1)
    log_ns = publish_ns = 0
    for second in range(end_ns // NS_PER_S + 1):
        places = [
            int(np.searchsorted(part.t_ns, second * NS_PER_S, side="right")) - 1
            for part in parts
        ]
        newest = [(part, at) for part, at in zip(parts, places, strict=True) if at >= 0]
        if newest:
            log_ns = max([log_ns, *(int(part.log_time_ns[at]) for part, at in newest)])
            publish_ns = max(
                [publish_ns, *(int(part.publish_time_ns[at]) for part, at in newest)]
            )
            records = [part.record(at) for part, at in newest]
            data = pack_session_diagnostics(session, _find_epoch_ns(log), records)
            yield log_ns, publish_ns, [(DIAGNOSTICS, data)]


FORMAT = ExportFormat(export_ros2, "-ros2.mcap")
