"""A ROS 2 bag: standard messages at full rate, in an MCAP file of profile `ros2`.

Invariant: a bag has every record once, with its numbers and times; nothing is decimated. A header's stamp is
the nominal time of its tick, the publish time the time of sending, the log time the time of arrival.
"""

import heapq
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np

from ...core.ticks import NS_PER_S
from ...log.log_layout import SCENARIO, collect_provenance
from ...log.log_reader import Log
from ...log.mcap_writer import McapWriter
from ...log.ros2 import cdr, ros2_messages
from ...log.ros2.cdr import pack_string
from ..export import ExportFormat, Written

SOURCE_METADATA = "trilat.source"
"""Metadata of the file: its session."""
_QOS = (cdr.DEFINITIONS / "qos.yaml").read_text(encoding="utf-8")
"""Reliable, volatile, the last ten: the default of publishers in ROS 2."""
_TF = "/tf"
"""The frames of all sites, where tools look for them."""
_EVERY = 1000
"""Records between two reports of progress."""

TimedMessages = tuple[int, int, list[tuple[str, bytes]]]
"""Messages of one publish time, by topic: the log time and the publish time, ns, before them."""


def export_ros2(log: Log, path: Path, written: Written = lambda _: None) -> None:
    """Writes a log as a bag that `ros2 bag` and its like play and read.

    Per site, under its name: `joint_states`, `reference`, `error`, `tau_x`, `theta_hat`, `mode`, in task
    space `end_effector` and `wrench`; its statistics `link_age`, `link_delay`, `link_offset`, `timing`; of
    the session `/events` and `/log`. Units and names stand in the channels' metadata and in the labels of
    dimensions. A chain has its `robot_description` and its links' frames in `/tf`.

    An earlier file is replaced; `written` is called with the number of records since its last call.

    Raises:
        LogError: a message of the log cannot be read.
        OSError: the disk refuses.
    """
    with path.open("wb") as stream:
        file = McapWriter(stream, f"trilat-net {collect_provenance()['version_trilat-net']}", profile="ros2")
        file.add_metadata(SOURCE_METADATA, {"source": log.source, **log.session})
        file.add_attachment(0, 0, SCENARIO, "application/toml", log.scenario_text.encode())
        sites = [_SiteMessages(log, name, written) for name in log.sites]
        known = {f"/{name}": channel for name, channel in ros2_messages.SESSION_CHANNELS.items()}
        for site in sites:
            known |= site.channels
        bag = ros2_messages.StandardChannels(file, known, offered_qos_profiles=_QOS)
        parts = [part for site in sites for part in (site.records(), site.statistics())]
        for log_ns, publish_ns, messages in heapq.merge(*parts, _events(log), key=itemgetter(0)):
            for topic, data in messages:
                file.add_message(bag[topic], log_ns, data, publish_ns)
        file.finish()


class _SiteMessages:
    """The messages of one site, on topics under its name."""

    def __init__(self, log: Log, name: str, progress: Callable[[int], None]) -> None:
        self._log, self._name, self._progress = log, name, progress
        self._epoch_unix_ns = int(log.session.get("epoch_unix_ns", "0"))
        self._shapes = shapes = ros2_messages.Ros2SiteChannels(log.scenario, name)
        self._states = cdr.JointStatePacker(shapes.joints)
        self._reference = cdr.JointStatePacker(shapes.joints, effort=False)
        states = {"joint_states": shapes.joint_states(shapes.joints)}
        states["reference"] = shapes.joint_states(shapes.joints, effort=False)
        self.channels = {self._topic(part): channel for part, channel in (states | shapes.channels).items()}

    def _topic(self, part: str) -> str:
        return _TF if part == ros2_messages.FRAMES else f"/{self._name}/{part}"

    def _named(self, messages: Iterable[tuple[str, bytes]]) -> list[tuple[str, bytes]]:
        return [(self._topic(part), data) for part, data in messages]

    def records(self) -> Iterator[TimedMessages]:
        """Yields its records in the order of arrival."""
        part = self._log[self._name]
        log_ns, publish_ns = part.log_time_ns.tolist(), part.publish_time_ns.tolist()
        for count, at in enumerate(np.argsort(part.log_time_ns, kind="stable").tolist(), 1):
            state = part.states[at]
            stamp_ns = max(0, self._epoch_unix_ns + state.tick * NS_PER_S // part.rate_hz)
            row = [column[0] for column in ros2_messages.stack_signals([state])]
            messages = [
                ("joint_states", self._states.pack(stamp_ns, state.q, state.qd, state.tau)),
                *self._shapes.end_effector(state),
                ("error", self._shapes.arrays["error"].pack(*row[self._shapes.error_row])),
                *self._shapes.slow(row[self._shapes.slow_row]),
            ]
            if not self._shapes.task:
                messages.insert(1, ("reference", self._reference.pack(stamp_ns, state.q_des, state.qd_des)))
            if (robot := self._shapes.robot) is not None:
                if count == 1:
                    messages.append((ros2_messages.ROBOT, pack_string(robot.description)))
                messages.append((ros2_messages.FRAMES, robot.pack(stamp_ns, state.q)))
            yield log_ns[at], publish_ns[at], self._named(messages)
            if not count % _EVERY or count == len(part):
                self._progress((count - 1) % _EVERY + 1)

    def statistics(self) -> Iterator[TimedMessages]:
        """Yields its statistics in the order of arrival."""
        timed = self._log.timed_link_stats(self._name)
        rows = zip(timed.log_ns.tolist(), timed.publish_ns.tolist(), timed.messages, strict=True)
        for log_ns, publish_ns, stats in sorted(rows, key=itemgetter(0)):
            yield log_ns, publish_ns, self._named(self._shapes.statistics(stats))


def _events(log: Log) -> Iterator[TimedMessages]:
    timed = log.timed_events()
    rows = zip(timed.log_ns.tolist(), timed.publish_ns.tolist(), timed.messages, strict=True)
    for log_ns, publish_ns, event in rows:
        messages = [(f"/{topic}", data) for topic, data in ros2_messages.pack_event(event, publish_ns)]
        yield log_ns, publish_ns, messages


FORMAT = ExportFormat(export_ros2, "-ros2.mcap")
