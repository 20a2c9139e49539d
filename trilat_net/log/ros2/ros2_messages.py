"""Converts the messages of a session to standard ROS 2 messages for general viewers.

The session's own messages in a log can be decoded only by trilat-net. A log may therefore also
contain channels of standard ROS 2 messages, which viewers such as Foxglove and PlotJuggler can
display. This module defines these channels with their units and names, and converts the
messages.

Invariant:
    - Values are copied unchanged, except that times are converted to the unit stated in the
      metadata of the channel.
    - A value that was not measured is NaN.
    - Each curve has a name that viewers display. Joint states contain the names of the joints.
      In an array, the label of each dimension lists the names of its entries.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from ...core import POSITION
from ...log import McapWriter, compute_task_errors
from ...net import MODE_WORDS, Event, LinkStats, State
from ...records import Mode, TickRecord
from ...scenario import TASK_AXES, Change, Scenario
from . import cdr
from .robot_model import RobotModel, name_ros_joints

EVENTS = "events"
"""Channel with the events of the session as plain text."""
LINES = "log"
"""Channel with the events of the session as log lines, with time and level."""
SENT_PREFIX = "sent_"
"""Prefix of arrays for the vectors that a law sends: "sent_E", "sent_u_to_m2"."""

ROBOT = "robot_description"
"""Channel that contains the URDF of an arm."""
FRAMES = "tf"
"""Channel that contains the frames of an arm's links."""

NamedMessages = Iterator[tuple[str, bytes]]
"""Encoded messages, each with the name of its channel or topic."""


class Ros2Channel(NamedTuple):
    """Describes a channel of standard ROS 2 messages, which general viewers can display.

    Attributes:
        kind: ROS type of the messages.
        about: Metadata of the channel, such as the units and names of its numbers.
        latched: True if a subscriber that joins late receives the last message.
    """

    kind: str
    about: dict[str, str]
    latched: bool = False

    def is_robot_description(self) -> bool:
        """True if the channel contains the URDF (geometry) of an arm, whatever its topic is."""
        content = self.about.get("content")
        return self.kind == cdr.STRING and content == ROBOT_METADATA["content"]

    def name_numbers(self) -> list[str]:
        """Returns the names of the numbers in a message of the channel, in order.

        The metadata contain one list of names per dimension of the array, such as "m1 m2; 1 2".
        The name of a number combines one name from each list.
        """
        axes = [axis.split(" ") for axis in self.about.get("names", "").split("; ")]
        return [" ".join(filter(None, parts)) for parts in product(*axes)]


Ros2Channels = Mapping[str, Ros2Channel]
"""Maps topics to channels of standard ROS 2 messages."""


class StandardChannels:
    """Registers ROS 2 channels for viewers in an MCAP file when they are first needed.

    Indexing the object with the topic of a channel returns the number of the channel in the
    file, after registering the channel if necessary.

    Args:
        file: Writer of the MCAP file.
        known: Maps the topic of each channel that may be registered to its description.
    """

    def __init__(self, file: McapWriter, known: Mapping[str, Ros2Channel]) -> None:
        self._file = file
        self._known = known
        self._schema_numbers: dict[str, int] = {}
        self._channel_numbers: dict[str, int] = {}

    def __getitem__(self, topic: str) -> int:
        """Returns the number of a topic's channel in an MCAP file.

        The channel is registered in the file on first access, so that the file declares no
        channel without messages.
        """
        if topic not in self._channel_numbers:
            channel = self._known[topic]
            schema_number = self._get_schema_number(channel.kind)
            channel_number = self._file.register_channel(
                topic, cdr.ENCODING, schema_number, channel.about
            )
            self._channel_numbers[topic] = channel_number
        return self._channel_numbers[topic]

    def _get_schema_number(self, kind: str) -> int:
        """Returns the number of a message type, registering the type if necessary."""
        if kind not in self._schema_numbers:
            definition = cdr.ROS2_SCHEMAS[kind]
            schema_number = self._file.register_schema(kind, cdr.SCHEMA_ENCODING, definition)
            self._schema_numbers[kind] = schema_number
        return self._schema_numbers[kind]


SESSION_CHANNELS = {
    EVENTS: Ros2Channel(cdr.STRING, {"content": "what happened, member first"}),
    LINES: Ros2Channel(cdr.LOG, {"content": "the same as lines of a log"}),
}
ROBOT_METADATA = {"content": "URDF, with links named after their site"}
"""Metadata of a channel that contains the URDF of an arm."""
_FRAMES_METADATA = {
    "content": "frames of the links",
    "unit": "m",
}
ROBOT_CHANNELS = {
    ROBOT: Ros2Channel(cdr.STRING, ROBOT_METADATA),
    FRAMES: Ros2Channel(cdr.TRANSFORMS, _FRAMES_METADATA),
}


_LEVELS = {
    "diverged": cdr.RosLogLevel.ERROR,
    "failed": cdr.RosLogLevel.ERROR,
    "lost": cdr.RosLogLevel.WARN,
    "left": cdr.RosLogLevel.WARN,
    "unheard": cdr.RosLogLevel.WARN,
    "waiting": cdr.RosLogLevel.WARN,
    "refused": cdr.RosLogLevel.WARN,
    "clock fault": cdr.RosLogLevel.WARN,
}
"""Maps the kind of an event to its level in the ROS log. Other kinds have the level INFO."""
NUMBERS_BY_MODE_WORD = {word: float(mode) for mode, word in MODE_WORDS.items()}
"""Maps the name of each mode in records to its number in messages for viewers."""
_MODE_NUMBERS: dict[Mode | str, float] = {mode: float(mode) for mode in MODE_WORDS}
_MODE_NUMBERS.update(NUMBERS_BY_MODE_WORD)
"""Number of a mode, which is a `Mode` in a `TickRecord` and a word in a `State`."""


def pack_event(event: Event, stamp_ns: int) -> NamedMessages:
    """Encodes an event for viewers as two messages: a string, and a line of the ROS log.

    Args:
        event: The event, such as the loss of a connection.
        stamp_ns: Unix time of the event, in ns, 0 or more.

    Yields:
        For each message, the name of its channel (`EVENTS` or `LINES`) and the encoded message.
    """
    text = Change.describe_event(event.kind, event.text, event.command)
    text_with_member = f"{event.member}: {text}"
    yield EVENTS, cdr.pack_string(text_with_member)
    level = _LEVELS.get(event.kind, cdr.RosLogLevel.INFO)
    log_line = cdr.pack_log(stamp_ns, level, event.member, text)
    yield LINES, log_line


class _ArrayChannel:
    """A channel for viewers whose messages are arrays of a fixed shape.

    The messages are of ROS type `std_msgs/msg/Float64MultiArray`.

    Args:
        content: Description of the numbers.
        unit: Unit of the numbers.
        entry_names: For each dimension of the array, the names of the entries along it.

    Attributes:
        channel: Description of the channel, with its metadata.
        size: Number of entries of an array.
        pack: Function that encodes an array, given its entries row by row.
    """

    def __init__(self, content: str, unit: str, *entry_names: Sequence[str]) -> None:
        """Describes a channel of arrays, and prepares the encoding of its messages."""
        joined_names = [" ".join(axis_entries) for axis_entries in entry_names]
        metadata = {
            "content": content,
            "unit": unit,
            "names": "; ".join(joined_names),
        }
        self.channel = Ros2Channel(cdr.FLOAT64_ARRAY, metadata)
        # The first label also names the content, and the last label the unit.
        labels = [*joined_names]
        labels[0] = f"{content}: {labels[0]}"
        labels[-1] += f" ({unit})"
        lengths = [len(axis_entries) for axis_entries in entry_names]
        self.size = math.prod(lengths)
        dimensions = zip(labels, lengths, strict=True)
        self.pack = cdr.make_float_array_packer(*dimensions)


ArrayChannels = dict[str, _ArrayChannel]
"""Maps the last part of the topic of each array channel to the channel."""


class Ros2SiteChannels:
    """Describes the ROS 2 channels of one site for viewers, and encodes arrays of numbers.

    Peers are in scenario order.

    Args:
        scenario: Scenario of the session.
        site: Name of the site.

    Attributes:
        joints: Names of the joints, from the URDF or numbered for a planar arm.
        arrays: Maps the last part of the topic of each array channel to the channel.
        record_arrays: Names of the arrays that are computed from records. The others are
            computed from statistics.
        error_row: Slice of the error e = q - q_des, Eq. (9), in the values that `stack_signals`
            returns for a record.
        slow_row: Slice of the values after the error: the exogenous torque, the estimated
            parameters, the vectors that the control law sends, and the mode.
        robot: Model of the arm for viewers. None for a planar arm.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        """Describes all ROS 2 channels of a site and of its network links."""
        arm = scenario.arms[site]
        self._arm = arm
        self._peers = scenario.peers(site)
        joint_count = arm.counts.joints
        shared_count = arm.counts.shared
        # A row begins with q, q_des, qd and tau, n numbers each. The errors follow.
        error_start = 4 * joint_count
        error_end = error_start + shared_count
        self.error_row = slice(error_start, error_end)
        self.slow_row = slice(error_end, None)

        self.robot: RobotModel | None = None
        if arm.chain is not None:
            self.robot = RobotModel(scenario, site)
        self.joints = name_ros_joints(scenario, site)

        # The arrays of `_slow_names` are encoded from consecutive numbers of a record.
        sent_arrays = _make_sent_arrays(scenario, site)
        self._slow_names = ("tau_x", "theta_hat", *sent_arrays, "mode")
        self.record_arrays = ("error", *self._slow_names)
        self.arrays = {
            "error": self._make_error_array(),
            "tau_x": _ArrayChannel(
                "exogenous torque, as Eq. (8) subtracts it",
                self._join_units("N m"),
                _make_labels(self.joints),
            ),
            "theta_hat": self._make_estimate_array(),
            **sent_arrays,
            "mode": _ArrayChannel(
                "run 1, diverged 2, hold 3, brake 4, return 5", "-", ["mode"]
            ),
            **self._make_statistics_arrays(),
        }

    def _make_error_array(self) -> _ArrayChannel:
        """Returns the array channel for the synchronisation error of the pose or the joints."""
        if self._arm.shares_pose:
            shared = self._arm.counts.shared
            axes = TASK_AXES[:shared]
            return _ArrayChannel("x - x_des", "m or rad", axes)
        units = self._join_units("rad")
        labels = _make_labels(self.joints)
        return _ArrayChannel("q - q_des", units, labels)

    def _make_estimate_array(self) -> _ArrayChannel:
        """Returns the array channel for the estimated parameters of the arm."""
        labels = _make_labels(name for name, _ in self._arm.parameters)
        if self._arm.chain is not None:
            return _ArrayChannel("estimate", "kg, kg m, kg m^2", labels)
        units = "kg m^2, kg m^2, kg m^2, kg m, kg m"
        return _ArrayChannel("estimate of Eq. (24)", units, labels)

    def _make_statistics_arrays(self) -> ArrayChannels:
        """Returns the array channels that are computed from link statistics."""
        peers = self._peers
        return {
            "link_age": _ArrayChannel("age of the sample in use", "ms", peers),
            "link_delay": _ArrayChannel(
                "one-way delay, last 100 ms", "ms", peers, ("median", "max")
            ),
            "link_offset": _ArrayChannel(
                "the peer's clock minus this site's clock", "ms", peers, ("offset", "bound")
            ),
            "timing": _ArrayChannel(
                "largest in the last 100 ms", "us", ("lateness", "computing_time")
            ),
        }

    @property
    def channels(self) -> dict[str, Ros2Channel]:
        """Maps the last part of each topic to the ROS 2 channel of this site for viewers.

        There is one channel per array of numbers. If the arm has a robot model, there are also
        channels for the model and for the poses of its links.
        """
        channels: dict[str, Ros2Channel] = {}
        for name, array in self.arrays.items():
            channels[name] = array.channel
        if self.robot is not None:
            channels |= ROBOT_CHANNELS
        return channels

    def joint_states(self, names: Sequence[str], *, effort: bool = True) -> Ros2Channel:
        """Returns a channel of joint states, the usual message for the joints of a robot.

        Args:
            names: Names of the joints.
            effort: True if the messages contain torques.
        """
        revolute_units = ["rad", "rad/s"]
        if effort:
            revolute_units.append("N m")
        units = map(self._join_units, revolute_units)
        labels = _make_labels(names)
        metadata = {
            "unit": ", ".join(units),
            "names": " ".join(labels),
        }
        return Ros2Channel(cdr.JOINT_STATE, metadata)

    def _join_units(self, revolute_unit: str) -> str:
        """Returns the units of one quantity for all joints, such as "rad or m".

        A revolute joint has an angle in rad, a prismatic joint a position in m.

        Args:
            revolute_unit: Unit of the quantity for a revolute joint.
        """
        joint_units = self._arm.joint_units(revolute_unit)
        different_units = dict.fromkeys(joint_units)
        return " or ".join(different_units)

    def pack_slow_arrays(self, row: Sequence[float]) -> NamedMessages:
        """Encodes the quantities of a record that viewers receive at a reduced rate.

        These are the exogenous torque of Eq. (8), the estimated parameters, the vectors that
        the control law sends, and the mode.

        Args:
            row: Values of these quantities: the slice `slow_row` of the values that
                `stack_signals` returns for a record.

        Yields:
            The name of each array, and the encoded message.
        """
        start = 0
        for name in self._slow_names:
            array = self.arrays[name]
            end = start + array.size
            numbers = row[start:end]
            yield name, array.pack(*numbers)
            start = end

    def pack_statistics(self, stats: LinkStats) -> NamedMessages:
        """Encodes the statistics of a site's connections to its peers as arrays.

        The age of the received samples is always included. Delays, clock offsets and the timing
        of the control loop are included only in a live session, because simulated time has no
        such quantities. Nothing is yielded for a site that receives no samples from any other
        site.

        Args:
            stats: The statistics.

        Yields:
            The name of each array, and the encoded message.
        """
        peers = self._peers
        if not peers:
            return
        ages_ms: list[float] = []
        for peer in peers:
            age_us = stats.age_us.get(peer, -1)
            ages_ms.append(_convert_to_ms(age_us))
        age_array = self.arrays["link_age"]
        yield "link_age", age_array.pack(*ages_ms)

        # Virtual time has no measured delays and no clock offsets.
        if not stats.delay_us:
            return

        delays_ms: list[float] = []
        offsets_ms: list[float] = []
        for peer in peers:
            median_us = stats.delay_us.get(peer, -1)
            maximum_us = stats.delay_max_us.get(peer, -1)
            delays_ms.append(_convert_to_ms(median_us))
            delays_ms.append(_convert_to_ms(maximum_us))
            offset_us = stats.offset_us.get(peer, math.nan)
            bound_us = stats.bound_us.get(peer, math.nan)
            offsets_ms += [offset_us / 1e3, bound_us / 1e3]

        delay_array = self.arrays["link_delay"]
        yield "link_delay", delay_array.pack(*delays_ms)
        offset_array = self.arrays["link_offset"]
        yield "link_offset", offset_array.pack(*offsets_ms)
        timing_array = self.arrays["timing"]
        yield "timing", timing_array.pack(stats.late_max_us, stats.busy_max_us)


def _make_labels(names: Iterable[str]) -> list[str]:
    """Replaces spaces in names with underscores, because spaces separate labels."""
    labels: list[str] = []
    for name in names:
        parts = name.split()
        labels.append("_".join(parts))
    return labels


def _make_sent_arrays(scenario: Scenario, site: str) -> ArrayChannels:
    """Returns one array channel for each vector that a site's control law sends.

    The channels are in the order of the vectors in a record. The topic of a vector for a single
    receiver (peer) contains the name of the receiver.
    """
    arrays: ArrayChannels = {}
    peers = scenario.peers(site)
    channel = scenario.channel(site)
    for vector, peer, index in channel.entries(peers):
        # A vector has an entry per number. The first entry describes the whole vector.
        if index:
            continue
        suffix = f"_to_{peer}" if peer else ""
        receiver = peer or "all"
        content = f"{vector.name} that the law sends to {receiver}"
        numbers = range(1, vector.length + 1)
        entries = [f"{vector.name}{number}" for number in numbers]
        unit = vector.unit or "-"
        array_name = f"{SENT_PREFIX}{vector.name}{suffix}"
        arrays[array_name] = _ArrayChannel(content, unit, entries)
    return arrays


def _convert_to_ms(us: int) -> float:
    """Converts a time from us to ms. -1, which represents a missing value, becomes NaN."""
    return us / 1e3 if us != -1 else math.nan


Record = State | TickRecord
"""A record as published by a site or as returned by the kernel."""
SignalRow = Sequence[float]
"""The values of all curves at one time, or the values of one curve at all times."""


def stack_signals(records: Sequence[Record]) -> list[SignalRow]:
    """Collects from the records of a site the curves that viewers draw.

    The curves are the joint positions q, their references q_des, the velocities qd, the torques
    tau, the error e = q - q_des, the exogenous torque tau_x, the estimated parameters
    theta_hat, the vectors that the control law sends, and the mode. If the sites share the
    poses x of their end effectors instead of joint positions, the joints have no reference. In
    that case q is repeated in place of q_des, and e is x - x_des.

    Args:
        records: The records, at least one.

    Returns:
        The values of each curve, one per record. The mode has a single value if it is the same
        in all records.
    """
    first = records[0]
    is_task_space = bool(first.x)
    rows: list[tuple[float, ...]] = []
    for record in records:
        joint_reference = record.q if is_task_space else record.q_des
        kinematics = (*record.q, *joint_reference, *record.qd)
        torques = (*record.tau, *record.tau_x)
        row = (*kinematics, *torques, *record.theta_hat, *record.ch)
        rows.append(row)
    curves = _transpose(rows)

    joint_count = len(first.q)
    actual = curves[:joint_count]
    if is_task_space:
        actual = _transpose(record.x for record in records)
    desired = _transpose(record.q_des for record in records)
    errors = _compute_errors(actual, desired)
    # The error of an orientation is not a difference of numbers.
    if is_task_space and len(errors) > POSITION:
        x = np.array(actual).T
        x_des = np.array(desired).T
        all_axes = [1.0] * len(errors)
        task_errors = compute_task_errors(x, x_des, all_axes)
        errors = task_errors.T.tolist()
    error_start = 4 * joint_count
    curves_before = curves[:error_start]
    curves_after = curves[error_start:]
    modes = _list_modes(records)
    return [*curves_before, *errors, *curves_after, modes]


def _transpose(rows: Iterable[SignalRow]) -> list[SignalRow]:
    """Transposes a table, returning one sequence per curve instead of one per record."""
    return [*zip(*rows, strict=True)]


def _compute_errors(
    actual: Sequence[SignalRow], desired: Sequence[SignalRow]
) -> list[list[float]]:
    """Returns the differences between actual and desired values, curve by curve."""
    errors: list[list[float]] = []
    for actual_curve, desired_curve in zip(actual, desired, strict=True):
        pairs = zip(actual_curve, desired_curve, strict=True)
        differences = [value - reference for value, reference in pairs]
        errors.append(differences)
    return errors


def _list_modes(records: Sequence[Record]) -> list[float]:
    """Returns the mode of each record as a number, or one number if all are equal.

    If all modes are equal, their extremes are equal too, and a single number suffices.
    """
    modes = [record.mode for record in records]
    first_mode = modes[0]
    if modes.count(first_mode) == len(modes):
        del modes[1:]
    return [_MODE_NUMBERS.get(mode, 0.0) for mode in modes]
