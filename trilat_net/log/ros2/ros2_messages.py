"""Mapping of a session's messages to standard ROS 2 messages: channels, units, names.

Invariant:
    - Only units are converted, as the metadata of the channel state.
    - A value that was not measured is NaN.
    - The name of a curve is where viewers look for it: a joint's name is in the message, other
      names are in the label of the dimension.
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
"""Channels of a whole session: events as plain text, and as log lines with time and level."""
SENT_PREFIX = "sent_"
"""Prefix of the arrays with the vectors that a law sends: "sent_E", "sent_u_to_m2"."""

ROBOT = "robot_description"
FRAMES = "tf"
"""Channels of an arm with a URDF: the URDF text, and the frames of the links."""


class Ros2Channel(NamedTuple):
    """A channel of standard ROS 2 messages.

    Attributes:
        kind: type of the messages.
        about: metadata of the channel.
        latched: True if late subscribers receive the last message.
    """

    kind: str
    about: dict[str, str]
    latched: bool = False


class StandardChannels:
    """Numbers of the standard channels of a file, by topic.

    A channel is registered in the file when its number is first looked up.

    Args:
        file: the file.
        known: the channels that can be registered, by topic.
    """

    def __init__(self, file: McapWriter, known: Mapping[str, Ros2Channel]) -> None:
        self._file = file
        self._known = known
        self._schema_numbers: dict[str, int] = {}
        self._channel_numbers: dict[str, int] = {}

    def __getitem__(self, topic: str) -> int:
        if topic not in self._channel_numbers:
            kind, about, _ = self._known[topic]
            if kind not in self._schema_numbers:
                self._schema_numbers[kind] = self._file.register_schema(
                    kind, cdr.SCHEMA_ENCODING, cdr.ROS2_SCHEMAS[kind]
                )
            self._channel_numbers[topic] = self._file.register_channel(
                topic, cdr.ENCODING, self._schema_numbers[kind], about
            )
        return self._channel_numbers[topic]


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
    """Yields channel and message of an event, for each channel of the session.

    Args:
        event: the event.
        stamp_ns: Unix time of the event, in ns, 0 or more.
    """
    text = describe_event(event.kind, event.text, event.command)
    level = _LEVELS.get(event.kind, cdr.RosLogLevel.INFO)
    yield EVENTS, cdr.pack_string(f"{event.member}: {text}")
    yield LINES, cdr.pack_log(stamp_ns, level, event.member, text)


class ArrayChannel:
    """A channel of `std_msgs/msg/Float64MultiArray`.

    Args:
        content: description of the numbers.
        unit: unit of the numbers.
        axes: names of the entries along each axis.
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
        labels = [" ".join(axis) for axis in axes]
        labels[0] = f"{content}: {labels[0]}"
        labels[-1] += f" ({unit})"
        lengths = [len(axis) for axis in axes]
        self.size = math.prod(lengths)
        self.pack = cdr.make_float_array_packer(*zip(labels, lengths, strict=True))


class Ros2SiteChannels:
    """The standard channels of one site with its peers in scenario order.

    Attributes:
        joints: names of the joints, from the URDF; numbered names for a planar arm.
        arrays: the array channels, by the last part of their topic.
        record_arrays: names of the arrays that are made from records; the others are made from
            statistics.
        error_row: slice of the error e = q - q_des, Eq. (9), in a row of `stack_signals`.
        slow_row: slice of the remaining numbers of the row: tau_x, theta_hat, the vectors that
            the law sends, and the mode.
        robot: the arm for viewers; None for a planar arm.
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
        """Array channels and channels of the robot, by the last part of their topic."""
        arrays = {name: array.channel for name, array in self.arrays.items()}
        return arrays if self.robot is None else arrays | ROBOT_CHANNELS

    def joint_states(self, names: Sequence[str], *, effort: bool = True) -> Ros2Channel:
        """Returns a channel of joint states for joints with these names."""
        revolute_units = ["rad", "rad/s", "N m"] if effort else ["rad", "rad/s"]
        units = ", ".join(self._unit(unit) for unit in revolute_units)
        # The names are separated by spaces and cannot contain any.
        joined_names = " ".join("_".join(name.split()) for name in names)
        return Ros2Channel(cdr.JOINT_STATE, {"unit": units, "names": joined_names})

    def _unit(self, unit: str) -> str:
        """Returns the units of all joints, where `unit` is that of a revolute joint."""
        return " or ".join(dict.fromkeys(self._arm.joint_units(unit)))

    def slow(self, row: Sequence[float]) -> Iterator[tuple[str, bytes]]:
        """Yields name and message of a record's arrays, from the numbers of its `slow_row`."""
        start = 0
        for name in self._slow:
            array = self.arrays[name]
            yield name, array.pack(*row[start : start + array.size])
            start += array.size

    def statistics(self, stats: LinkStats) -> Iterator[tuple[str, bytes]]:
        """Yields name and message of the arrays of link statistics.

        The arrays of delays, clock offsets and timing exist in a live session only.
        """
        arrays = self.arrays
        peers = self._peers
        if not peers:
            return
        ages_ms = [_convert_to_ms(stats.age_us.get(peer, -1)) for peer in peers]
        yield "link_age", arrays["link_age"].pack(*ages_ms)
        # Virtual time has no measured delays and no clock offsets.
        if not stats.delay_us:
            return
        delays_ms: list[float] = []
        offsets_ms: list[float] = []
        for peer in peers:
            delays_ms.append(_convert_to_ms(stats.delay_us.get(peer, -1)))
            delays_ms.append(_convert_to_ms(stats.delay_max_us.get(peer, -1)))
            offsets_ms.append(stats.offset_us.get(peer, math.nan) / 1e3)
            offsets_ms.append(stats.bound_us.get(peer, math.nan) / 1e3)
        yield "link_delay", arrays["link_delay"].pack(*delays_ms)
        yield "link_offset", arrays["link_offset"].pack(*offsets_ms)
        yield "timing", arrays["timing"].pack(stats.late_max_us, stats.busy_max_us)


def _make_sent_channels(scenario: Scenario, site: str) -> dict[str, ArrayChannel]:
    """Returns a channel for each vector that a site's law sends, in the order of its record."""
    channels: dict[str, ArrayChannel] = {}
    for vector, peer, index in scenario.channel(site).entries(scenario.peers(site)):
        # A vector has several entries; the first entry stands for the whole vector.
        if index:
            continue
        suffix = f"_to_{peer}" if peer else ""
        channels[f"{SENT_PREFIX}{vector.name}{suffix}"] = ArrayChannel(
            f"{vector.name} that the law sends to {peer or 'all'}",
            vector.unit or "-",
            [f"{vector.name}{number}" for number in range(1, vector.length + 1)],
        )
    return channels


def _convert_to_ms(us: int) -> float:
    """Returns a time in ms; NaN for -1, which stands for a time that was not measured."""
    return us / 1e3 if us != -1 else math.nan


def read_ros2_channels(path: Path) -> dict[str, Ros2Channel]:
    """Returns the standard channels of a finished file by topic.

    Returns {} for a file without a readable index.

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
    """Returns the numbers of records, a column per curve.

    The columns are q, q_des, qd, tau, e, tau_x, theta_hat, ch and mode. The column of the mode
    has a single number if all records have the same mode. In task space the joints have no
    reference: the columns of q_des hold q, and e is x - x_des.
    """
    is_task_space = bool(records[0].x)
    rows: list[tuple[float, ...]] = []
    for record in records:
        joint_reference = record.q if is_task_space else record.q_des
        kinematics = (*record.q, *joint_reference, *record.qd)
        torques = (*record.tau, *record.tau_x)
        rows.append((*kinematics, *torques, *record.theta_hat, *record.ch))
    columns: list[SignalRow] = [*zip(*rows, strict=True)]
    n = len(records[0].q)
    actual = columns[:n]
    if is_task_space:
        actual = [*zip(*(record.x for record in records), strict=True)]
    desired = [*zip(*(record.q_des for record in records), strict=True)]
    error = [
        [value - reference for value, reference in zip(*curves, strict=True)]
        for curves in zip(actual, desired, strict=True)
    ]
    # A pose has an orientation, whose error is not a difference of numbers.
    if len(error) > POSITION and is_task_space:
        x = np.array(actual).T
        x_des = np.array(desired).T
        error = compute_task_errors(x, x_des, [1.0] * len(error)).T.tolist()
    modes = [record.mode for record in records]
    if modes.count(modes[0]) == len(modes):
        del modes[1:]
    return [
        *columns[: 4 * n],
        *error,
        *columns[4 * n :],
        [_MODES.get(mode, 0.0) for mode in modes],
    ]
