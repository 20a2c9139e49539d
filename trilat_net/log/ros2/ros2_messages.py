"""Mapping of a session's messages to standard ROS 2 messages: channels, units, names.

Invariant: only units are converted, as the channel's metadata states; an unmeasured value is
NaN. A curve's name stands where viewers look for it: with the joints in the message, else in
the label of its dimension.
"""

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from ...core.task_space import POSITION
from ...core.ticks import TickRecord
from ...files import reading
from ...net.messages import MODE_WORDS, Event, LinkStats, State
from ...scenario import Scenario
from ...scenario.arms import TASK_AXES
from ...scenario.event_text import describe_event
from ..mcap_writer import McapWriter
from ..site_log import compute_task_errors
from . import cdr
from .robot_model import RobotModel

EVENTS = "events"
LINES = "log"
"""Channels of a whole session: events as plain text, and as lines with a time and a level."""
SENT_PREFIX = "sent_"
"""Of the names of arrays that hold what a law sends: "sent_E", "sent_u_to_m2"."""


ROBOT = "robot_description"
FRAMES = "tf"
"""Channels of an arm that a URDF describes: that file, and where its links are."""


class Ros2Channel(NamedTuple):
    """A standard channel: type of its messages, metadata, and whether late subscribers get the
    last one.
    """

    kind: str
    about: dict[str, str]
    latched: bool = False


class StandardChannels:
    """The channels of a file, of all that are known by topic; each is registered with its first
    message.
    """

    def __init__(self, file: McapWriter, known: Mapping[str, Ros2Channel]) -> None:
        self._file = file
        self._known = known
        self._numbers: dict[
            str, int
        ] = {}  # of schemas by their kind, and of channels by their topic

    def __getitem__(self, topic: str) -> int:
        if topic not in self._numbers:
            kind, about, _ = self._known[topic]
            if kind not in self._numbers:
                schema = self._file.register_schema(
                    kind, cdr.SCHEMA_ENCODING, cdr.ROS2_SCHEMAS[kind]
                )
                self._numbers[kind] = schema
            schema = self._numbers[kind]
            self._numbers[topic] = self._file.register_channel(
                topic, cdr.ENCODING, schema, about
            )
        return self._numbers[topic]


SESSION_CHANNELS = {
    EVENTS: Ros2Channel(cdr.STRING, {"content": "what happened, member first"}),
    LINES: Ros2Channel(cdr.LOG, {"content": "the same as lines of a log"}),
}
ROBOT_CHANNELS = {
    ROBOT: Ros2Channel(cdr.STRING, {"content": "URDF, with links named after their site"}),
    FRAMES: Ros2Channel(cdr.TRANSFORMS, {"content": "frames of the links", "unit": "m"}),
}
_LEVELS = {
    **dict.fromkeys(("diverged", "failed"), cdr.RosLogLevel.ERROR),
    **dict.fromkeys(
        ("lost", "left", "unheard", "waiting", "refused", "clock fault"), cdr.RosLogLevel.WARN
    ),
}
_MODES = {name: float(mode) for mode, word in MODE_WORDS.items() for name in (mode, word)}


def pack_event(event: Event, stamp_ns: int) -> Iterator[tuple[str, bytes]]:
    """Yields an event for the channels of the session; `stamp_ns` is its Unix time, not below
    0.
    """
    text = describe_event(event.kind, event.text, event.command)
    level = _LEVELS.get(event.kind, cdr.RosLogLevel.INFO)
    yield EVENTS, cdr.pack_string(f"{event.member}: {text}")
    yield LINES, cdr.pack_log(stamp_ns, level, event.member, text)


class ArrayChannel:
    """A channel of `std_msgs/msg/Float64MultiArray`: content and unit of its numbers, names on
    its axes.
    """

    def __init__(self, content: str, unit: str, *axes: Sequence[str]) -> None:
        self.channel = Ros2Channel(
            cdr.FLOAT64_ARRAY,
            {
                "content": content,
                "unit": unit,
                "names": "; ".join(" ".join(axis) for axis in axes),
            },
        )
        labels = [
            f"{content}: {' '.join(axis)}" if not n else " ".join(axis)
            for n, axis in enumerate(axes)
        ]
        labels[-1] += f" ({unit})"
        self.size = math.prod(map(len, axes))
        self.pack = cdr.make_float_array_packer(*zip(labels, map(len, axes), strict=True))


class Ros2SiteChannels:
    """The standard channels of one site with its peers in scenario order.

    Attributes:
        joints: names of its joints: those of its file, or numbered ones of a planar arm.
        arrays: the channels that are arrays, by the last part of their topic.
        record_arrays: the names of those that a record has; the others are of statistics.
        error_row: of a row of `stack_signals`, behind the joints, the error e = q - q_des, Eq.
            (9).
        slow_row: the rest: tau_x, theta_hat, what the law sends, mode.
        robot: the arm for viewers, or None where arms are planar ones alone.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        arm = scenario.arms[site]
        self._peers = scenario.peers(site)
        self._arm = arm
        n = arm.counts.joints
        peers = self._peers
        shared = arm.counts.shared
        axes = TASK_AXES[: arm.counts.shared]
        self.error_row = slice(4 * n, 4 * n + shared)
        self.slow_row = slice(4 * n + shared, None)
        self.robot = RobotModel(scenario, site) if arm.chain is not None else None
        self.joints = (
            [*arm.joint_names] if self.robot else [f"{site}_{name}" for name in arm.joint_names]
        )
        labels = ["_".join(name.split()) for name in self.joints]
        parameters = ["_".join(name.split()) for name, _ in arm.parameters]
        spread = ("median", "max")
        estimate = ("estimate of Eq. (24)", "kg m^2, kg m^2, kg m^2, kg m, kg m")
        if arm.chain is not None:
            estimate = ("estimate", "kg, kg m, kg m^2")
        sent = _make_sent_channels(scenario, site)
        self._slow = ("tau_x", "theta_hat", *sent, "mode")
        self.record_arrays = ("error", *self._slow)
        self.arrays = {
            "error": ArrayChannel("x - x_des", "m or rad", axes)
            if arm.shares_pose
            else ArrayChannel("q - q_des", self._unit("rad"), labels),
            "tau_x": ArrayChannel(
                "exogenous torque, as Eq. (8) subtracts it", self._unit("N m"), labels
            ),
            "theta_hat": ArrayChannel(*estimate, parameters),
            **sent,
            "mode": ArrayChannel("run 1, diverged 2, hold 3, brake 4, return 5", "-", ["mode"]),
            "link_age": ArrayChannel("age of the sample in use", "ms", peers),
            "link_delay": ArrayChannel("one-way delay, last 100 ms", "ms", peers, spread),
            "link_offset": ArrayChannel(
                "the peer's clock minus the own one", "ms", peers, ("offset", "bound")
            ),
            "timing": ArrayChannel(
                "largest in the last 100 ms", "us", ("lateness", "computing_time")
            ),
        }

    @property
    def channels(self) -> dict[str, Ros2Channel]:
        """Its channels by the last part of their topic: those of arrays, and of an arm for
        viewers.
        """
        arrays = {name: array.channel for name, array in self.arrays.items()}
        return arrays if self.robot is None else arrays | ROBOT_CHANNELS

    def joint_states(self, names: Sequence[str], *, effort: bool = True) -> Ros2Channel:
        """Returns a channel of joint states with these names."""
        units = ", ".join(map(self._unit, ("rad", "rad/s", "N m")[: 2 + effort]))
        return Ros2Channel(
            cdr.JOINT_STATE,
            {"unit": units, "names": " ".join("_".join(n.split()) for n in names)},
        )

    def _unit(self, unit: str) -> str:
        return " or ".join(dict.fromkeys(self._arm.joint_units(unit)))

    def slow(self, row: Sequence[float]) -> Iterator[tuple[str, bytes]]:
        """Yields the arrays of one record, from the numbers of its `slow_row`."""
        start = 0
        for name in self._slow:
            array = self.arrays[name]
            yield name, array.pack(*row[start : start + array.size])
            start += array.size

    def statistics(self, stats: LinkStats) -> Iterator[tuple[str, bytes]]:
        """Yields the arrays of one statistics; those of clocks and networks only in a live
        session.
        """
        arrays = self.arrays
        peers = self._peers
        if not peers:
            return
        yield (
            "link_age",
            arrays["link_age"].pack(*(_ms(stats.age_us.get(peer, -1)) for peer in peers)),
        )
        if not stats.delay_us:  # virtual time has neither
            return
        delays = [
            _ms(by.get(peer, -1))
            for peer in peers
            for by in (stats.delay_us, stats.delay_max_us)
        ]
        yield "link_delay", arrays["link_delay"].pack(*delays)
        offsets = [
            by.get(peer, math.nan) / 1e3
            for peer in peers
            for by in (stats.offset_us, stats.bound_us)
        ]
        yield "link_offset", arrays["link_offset"].pack(*offsets)
        yield "timing", arrays["timing"].pack(stats.late_max_us, stats.busy_max_us)


def _make_sent_channels(scenario: Scenario, site: str) -> dict[str, ArrayChannel]:
    """Returns a channel for each vector that a site's law sends, in the order of its record."""
    return {
        f"{SENT_PREFIX}{vector.name}" + f"_to_{peer}" * bool(peer): ArrayChannel(
            f"{vector.name} that the law sends to {peer or 'all'}",
            vector.unit or "-",
            [f"{vector.name}{n + 1}" for n in range(vector.length)],
        )
        for vector, peer, place in scenario.channel(site).entries(scenario.peers(site))
        if not place
    }


def _ms(us: int) -> float:
    return us / 1e3 if us != -1 else math.nan


def read_ros2_channels(path: Path) -> dict[str, Ros2Channel]:
    """Returns the standard channels of a finished file by topic, {} if it has no readable
    index.

    Raises:
        LogError: the file cannot be opened.
    """
    with reading(path) as stream:
        try:
            summary = make_reader(stream).get_summary()
        except (McapError, EOFError, OSError, struct.error, ValueError, OverflowError):
            summary = None
    if summary is None:
        return {}
    return {
        channel.topic: Ros2Channel(
            summary.schemas[channel.schema_id].name, dict(channel.metadata)
        )
        for channel in sorted(summary.channels.values(), key=lambda channel: channel.id)
        if channel.message_encoding == cdr.ENCODING and channel.schema_id in summary.schemas
    }


Record = State | TickRecord
SignalRow = Sequence[float]


def stack_signals(records: Sequence[Record]) -> list[SignalRow]:
    """Returns the numbers of records, a column per curve: q, q_des, qd, tau, e, tau_x,
    theta_hat, ch, mode.

    A column may be shorter where all of its numbers are the same. In task space no joint has a
    reference: its own angle stands there, and e is x - x_des.
    """
    task = bool(records[0].x)
    rows = [
        (*m.q, *(m.q if task else m.q_des), *m.qd, *m.tau, *m.tau_x, *m.theta_hat, *m.ch)
        for m in records
    ]
    columns: list[SignalRow] = [*zip(*rows, strict=True)]
    n = len(records[0].q)
    here = [*zip(*(m.x for m in records), strict=True)] if task else columns[:n]
    there = [*zip(*(m.q_des for m in records), strict=True)]
    error = [
        [a - b for a, b in zip(*pair, strict=True)] for pair in zip(here, there, strict=True)
    ]
    if len(error) > POSITION and task:
        x, x_des = (np.array(columns).T for columns in (here, there))
        error = compute_task_errors(x, x_des, [1.0] * len(error)).T.tolist()
    modes = [m.mode for m in records]
    if modes.count(modes[0]) == len(modes):
        del modes[1:]
    return [
        *columns[: 4 * n],
        *error,
        *columns[4 * n :],
        [_MODES.get(mode, 0.0) for mode in modes],
    ]
