"""Encodes and decodes standard ROS 2 messages without a ROS installation.

This allows logs to contain messages that viewers understand, and arms to be connected to ROS
programs. Messages are encoded as little-endian CDR, the Common Data Representation of the OMG.
A message begins with a header of four bytes. Each field is aligned to its size, counted from
the end of the header, with zero bytes as padding. A string or list begins with its length as a
32-bit number.

Invariant:
    - The bytes of a message are the same as those of any other serializer.
    - The layout of a message that is published at a high rate is computed once, so that a
      single call of `struct` encodes the message.
"""

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from importlib import resources
from typing import Any, NamedTuple

from ...records import NS_PER_S

ENCODING = "cdr"
"""Name of the message encoding in MCAP."""
SCHEMA_ENCODING = "ros2msg"
"""Name in MCAP of the encoding of the message definitions."""
JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64_ARRAY = "std_msgs/msg/Float64MultiArray"
STRING = "std_msgs/msg/String"
LOG = "rcl_interfaces/msg/Log"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POSE = "geometry_msgs/msg/PoseStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
WRENCH = "geometry_msgs/msg/WrenchStamped"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

# No library is used, because this module is faster. rosbags 0.11.9 and pycdr2 1.0.0 give the
# same bytes, but for nine channels at 60 Hz (joints, transforms and an array of three arms of
# six joints) they take 9 and 21 ms of processor time per second of data, and this module 0.6
# ms. `--views full` writes the same channels at 1 kHz, which is 15 % of a processor with
# rosbags. rosbags also adds 10 MB of dependencies, and 0.18 s to the start of every process
# that encodes.
_HEAD = b"\x00\x01\x00\x00"
"""Header of a message: plain CDR, little-endian, no options."""
_LAST_S = (1 << 31) - 1
"""Latest time stamp of ROS 2, in s. A stamp contains the seconds as a signed 32-bit integer."""
_POSE_BYTES = 7 * 8
"""Size of a transform in bytes: position and quaternion, seven floats of 8 bytes."""

DEFINITIONS = resources.files("trilat_net.log.ros2") / "definitions"
"""Folder of the ROS text files: message types, the quality of service of a bag, and the planar
arm.
"""
_PACKED_TYPES = (
    JOINT_STATE,
    FLOAT64_ARRAY,
    STRING,
    TRANSFORMS,
    LOG,
    POSE,
    TWIST,
    WRENCH,
    DIAGNOSTICS,
)


def _read_definition(type_name: str) -> bytes:
    """Reads the definition of a message type, such as "std_msgs/msg/String"."""
    short_name = type_name.rpartition("/")[2]
    return (DEFINITIONS / f"{short_name}.msg").read_bytes()


ROS2_SCHEMAS = {type_name: _read_definition(type_name) for type_name in _PACKED_TYPES}
"""Maps the name of each message type that this module encodes to its complete definition."""


def _pack_fields(offset: int, *values: int | str) -> bytes:
    """Encodes 32-bit integers and strings.

    A string is encoded as its length including the terminating zero, followed by its bytes.

    Args:
        offset: Position of the first field, in bytes after the header. It determines the
            padding.
        *values: The integers and strings.
    """
    data = b""
    for value in values:
        data += b"\0" * _count_padding(offset + len(data), 4)
        if isinstance(value, int):
            data += struct.pack("<I", value)
        else:
            text = value.encode() + b"\0"
            data += struct.pack("<I", len(text)) + text
    return data


def _count_padding(offset: int, size: int) -> int:
    """Returns the number of padding bytes before a field of `size` bytes at `offset`."""
    return -offset % size


def _split_stamp(stamp_ns: int) -> tuple[int, int]:
    """Splits a time into the seconds and nanoseconds of a ROS 2 stamp."""
    seconds, rest_ns = divmod(stamp_ns, NS_PER_S)
    return min(seconds, _LAST_S), rest_ns


def _pack_stamp(stamp_ns: int) -> bytes:
    """Encodes a time in Unix ns as a ROS 2 stamp."""
    seconds, rest_ns = _split_stamp(stamp_ns)
    return struct.pack("<iI", seconds, rest_ns)


def _format_floats(offset: int, count: int) -> tuple[str, int]:
    """Returns the `struct` format of a list of floats in a ROS 2 message.

    Args:
        offset: Position of the list, in bytes after the header.
        count: Number of floats.

    Returns:
        The format, and the position after the list.
    """
    length_padding = _count_padding(offset, 4)
    length_end = offset + length_padding + 4
    # An empty list contains no float, and needs no padding.
    float_padding = _count_padding(length_end, 8) if count else 0
    end = length_end + float_padding + 8 * count
    return f"{length_padding}xI{float_padding}x{count}d", end


class JointStatePacker:
    """Encodes messages of type `sensor_msgs/msg/JointState` for one robot.

    The layout of the messages is computed once, which makes encoding fast.

    Args:
        names: Names of the joints.
        velocity: True if the messages contain joint velocities.
        effort: True if the messages contain joint torques.
    """

    def __init__(
        self, names: Sequence[str], *, velocity: bool = True, effort: bool = True
    ) -> None:
        """Computes the positions of all fields in a `JointState` message from the joint names.

        This is done once, so that encoding a message only fills in numbers.
        """
        # The names follow the stamp of 8 bytes and an empty frame.
        frame = ""
        self._names = _pack_fields(8, frame, len(names), *names)
        joint_count = len(names)
        velocity_count = joint_count if velocity else 0
        effort_count = joint_count if effort else 0
        self._counts = (joint_count, velocity_count, effort_count)
        struct_format = f"<4siI{len(self._names)}s"
        offset = 8 + len(self._names)
        for count in self._counts:
            list_format, offset = _format_floats(offset, count)
            struct_format += list_format
        self._pack = struct.Struct(struct_format).pack

    def pack(
        self,
        stamp_ns: int,
        position: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> bytes:
        """Encodes a `sensor_msgs/msg/JointState`, the ROS 2 message for the joints of a robot.

        Args:
            stamp_ns: Unix time of the message, in ns, 0 or more.
            position: Joint angles, in rad.
            velocity: Joint velocities, in rad/s.
            effort: Joint torques, in N m.
        """
        position_count, velocity_count, effort_count = self._counts
        return self._pack(
            _HEAD,
            *_split_stamp(stamp_ns),
            self._names,
            position_count,
            *position,
            velocity_count,
            *velocity,
            effort_count,
            *effort,
        )


class TransformPacker:
    """Encodes messages of type `tf2_msgs/msg/TFMessage`, which contain poses of frames.

    The layout of the messages is computed once, which makes encoding fast.

    Args:
        frames: For each pose, the names of the parent frame and of the child frame.
    """

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        """Computes the positions of all fields in a transform message from the frame names.

        This is done once, so that encoding a message only fills in numbers.
        """
        self._names: list[bytes] = []
        struct_format = "<4sI"
        # The number of transforms takes the first 4 bytes.
        offset = 4
        for parent, child in frames:
            names_offset = offset + 8
            names = _pack_fields(names_offset, parent, child)
            names_end = names_offset + len(names)
            padding = _count_padding(names_end, 8)
            struct_format += f"iI{len(names)}s{padding}x7d"
            offset = names_end + padding + _POSE_BYTES
            self._names.append(names)
        self._pack = struct.Struct(struct_format).pack

    def pack(self, stamp_ns: int, numbers: Sequence[float]) -> bytes:
        """Encodes a `tf2_msgs/msg/TFMessage`, the ROS 2 message for poses of frames.

        Args:
            stamp_ns: Unix time of the message, in ns, 0 or more.
            numbers: The poses of all frames, one after another, each as x, y, z in m and the
                quaternion x, y, z, w.

        Returns:
            The message in CDR, the binary format of ROS 2.
        """
        seconds, rest_ns = _split_stamp(stamp_ns)
        fields: list[object] = []
        for frame_index, names in enumerate(self._names):
            start = 7 * frame_index
            pose = numbers[start : start + 7]
            fields += [seconds, rest_ns, names, *pose]
        return self._pack(_HEAD, len(self._names), *fields)


def make_float_array_packer(*dimensions: tuple[str, int]) -> Callable[..., bytes]:
    """Creates a function that encodes arrays of a fixed shape for ROS 2.

    The messages are of type `std_msgs/msg/Float64MultiArray`. Everything in a message except
    its numbers is encoded once, here.

    Args:
        dimensions: Label and size of each dimension of the array.

    Returns:
        A function that takes the entries of an array, row by row, and returns the encoded
        message.
    """
    sizes = [size for _, size in dimensions]
    count = math.prod(sizes)
    layout: list[int | str] = []
    for index, (label, size) in enumerate(dimensions):
        # The stride of a dimension is the number of floats from it on.
        stride = math.prod(sizes[index:])
        layout += [label, size, stride]
    data_offset = 0
    shape = _pack_fields(0, len(dimensions), *layout, data_offset)
    list_format, _ = _format_floats(len(shape), count)
    pack = struct.Struct(f"<4s{len(shape)}s{list_format}").pack
    return lambda *numbers: pack(_HEAD, shape, count, *numbers)


def pack_string(text: str) -> bytes:
    """Encodes a string as a ROS 2 message of type `std_msgs/msg/String`."""
    return _HEAD + _pack_fields(0, text)


class RosLogLevel(IntEnum):
    """Severity of a line in the ROS log, as numbered by ROS 2.

    Events of a session are reported as such lines. For example, an arm that diverged is
    reported as an ERROR.
    """

    INFO = 20
    WARN = 30
    ERROR = 40


def pack_log(stamp_ns: int, level: RosLogLevel, name: str, text: str) -> bytes:
    """Encodes a line of the ROS log as a message of type `rcl_interfaces/msg/Log`.

    Args:
        stamp_ns: Unix time of the line, in ns, 0 or more.
        level: Severity of the line.
        name: Name of the member of the session that reports the line.
        text: Text of the line.
    """
    seconds, rest_ns = _split_stamp(stamp_ns)
    head = struct.pack("<iIB", seconds, rest_ns, level)
    # The file, the function and the line number of the source are empty.
    fields = _pack_fields(len(head), name, text, "", "", 0)
    return _HEAD + head + fields


def pack_frame_vectors(stamp_ns: int, frame: str, *numbers: float) -> bytes:
    """Encodes a pose, velocity or force in a given frame as a stamped ROS 2 message.

    The messages `PoseStamped`, `TwistStamped` and `WrenchStamped` of the ROS package
    geometry_msgs have the same structure and differ only in their numbers.

    Args:
        stamp_ns: Unix time of the message, in ns, 0 or more.
        frame: Name of the frame in which the vectors are expressed.
        numbers: For a pose, x, y, z in m and the quaternion x, y, z, w. For a twist, the
            velocity in m/s and the angular velocity in rad/s. For a wrench, the force in N and
            the torque in N m.
    """
    data = _pack_stamp(stamp_ns) + _pack_fields(8, frame)
    data += b"\0" * _count_padding(len(data), 8)
    data += struct.pack(f"<{len(numbers)}d", *numbers)
    return _HEAD + data


def pack_trigger_response(*, success: bool, text: str) -> bytes:
    """Encodes the response of a ROS service of type `std_srvs/srv/Trigger`.

    Such a service performs an action, such as stopping an arm, and reports whether it
    succeeded.

    Args:
        success: True if the action was carried out.
        text: Explanation for the caller of the service.
    """
    return _HEAD + bytes([success]) + _pack_fields(1, text)


class Diagnosis(NamedTuple):
    """Status of one component, as reported on the ROS topic `/diagnostics`.

    Robot monitors display these statuses, with one colour per level.

    Attributes:
        level: 0 if the component is ok, 1 for a warning, 2 for an error, 3 if the status is
            outdated.
        name: Name of the component.
        text: Description of the status.
        values: Maps the names of further values to the values as strings.
    """

    level: int
    name: str
    text: str
    values: Mapping[str, str]


def pack_diagnostics(stamp_ns: int, diagnoses: Sequence[Diagnosis]) -> bytes:
    """Encodes the status of several components for the ROS topic `/diagnostics`.

    The message is of type `diagnostic_msgs/msg/DiagnosticArray`.

    Args:
        stamp_ns: Unix time of the message, in ns, 0 or more.
        diagnoses: The status of each component.
    """
    frame = ""
    hardware_id = ""
    data = _pack_stamp(stamp_ns) + _pack_fields(8, frame, len(diagnoses))
    for diagnosis in diagnoses:
        data += bytes([diagnosis.level])
        fields: list[str | int] = [diagnosis.name, diagnosis.text, hardware_id]
        fields.append(len(diagnosis.values))
        for key, value in diagnosis.values.items():
            fields += [key, value]
        data += _pack_fields(len(data), *fields)
    return _HEAD + data


class _CdrReader:
    """Decodes a ROS 2 message field by field, in the order of its definition.

    Every method call returns the next field. All methods raise ValueError if the message ends
    before the field does.

    Args:
        payload: The message with its header of four bytes.

    Raises:
        ValueError: The message is not plain, little-endian CDR, the usual encoding of ROS 2.
    """

    def __init__(self, payload: bytes) -> None:
        if payload[:2] != _HEAD[:2] or len(payload) < len(_HEAD):
            raise ValueError("is not encoded as plain little-endian CDR")
        self._data = payload[len(_HEAD) :]
        self._position = 0

    def numbers(self, code: str, count: int = 1) -> tuple[Any, ...]:
        """Decodes the next numbers of a ROS 2 message.

        Args:
            code: Type of the numbers, in the notation of the module `struct`.
            count: How many numbers to decode.
        """
        size = struct.calcsize(f"<{code}")
        padding = _count_padding(self._position, size) if count else 0
        start = self._position + padding
        self._position = start + count * size
        if self._position > len(self._data):
            raise ValueError("ends in the middle of a field")
        return struct.unpack_from(f"<{count}{code}", self._data, start)

    def count(self) -> int:
        """Decodes the length of a list, which precedes its entries in the message.

        Each entry takes at least one byte. A length greater than the number of remaining bytes
        is therefore invalid, and is rejected before memory is allocated.

        Raises:
            ValueError: The length exceeds the number of remaining bytes.
        """
        (count,) = self.numbers("I")
        # With a wrong length, the caller would reserve memory for entries that do not exist.
        if count > len(self._data) - self._position:
            raise ValueError("ends in the middle of a field")
        return int(count)

    def text(self) -> str:
        """Decodes the next string of a ROS 2 message, and advances the reader."""
        length = self.count()
        if not length:
            return ""
        (data,) = self.numbers("s", length)
        return bytes(data).removesuffix(b"\0").decode()

    def floats(self) -> tuple[float, ...]:
        """Decodes the next list of floats of a ROS 2 message, and advances the reader."""
        return self.numbers("d", self.count())

    def header(self) -> tuple[int, str]:
        """Decodes the header of type `std_msgs/msg/Header` at the start of many ROS 2 messages.

        Returns:
            The time stamp in ns on the sender's clock, and the name of the coordinate frame.
        """
        (whole_s,) = self.numbers("i")
        (rest_ns,) = self.numbers("I")
        return whole_s * NS_PER_S + rest_ns, self.text()


class RosJoints(NamedTuple):
    """State of a robot's joints, decoded from a `sensor_msgs/msg/JointState` message.

    Attributes:
        stamp_ns: Time of the message on the sender's clock, in ns.
        names: Names of the joints. The other attributes use the same order.
        position: Joint angles, in rad. Empty if unknown.
        velocity: Joint velocities, in rad/s. Empty if unknown.
        effort: Joint torques, in N m. Empty if unknown.
    """

    stamp_ns: int
    names: list[str]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]

    @classmethod
    def read(cls, payload: bytes) -> "RosJoints":
        """Decodes a `sensor_msgs/msg/JointState`, the usual message for the joints of a robot.

        Args:
            payload: The encoded message.

        Raises:
            ValueError: The message cannot be decoded.
        """
        reader = _CdrReader(payload)
        stamp_ns, _ = reader.header()
        names = [reader.text() for _ in range(reader.count())]
        return cls(
            stamp_ns=stamp_ns,
            names=names,
            position=reader.floats(),
            velocity=reader.floats(),
            effort=reader.floats(),
        )


def read_float_array(payload: bytes) -> tuple[float, ...]:
    """Decodes the numbers of a `std_msgs/msg/Float64MultiArray`, in message order.

    The layout, which states the sizes of the dimensions, is skipped.

    Raises:
        ValueError: The message cannot be decoded.
    """
    reader = _CdrReader(payload)
    # Each dimension has a label, a size and a stride; the offset of the data follows.
    for _ in range(reader.count()):
        reader.text()
        reader.numbers("I", 2)
    reader.numbers("I")
    return reader.floats()


def read_frame_vectors(payload: bytes, count: int) -> tuple[str, tuple[float, ...]]:
    """Decodes a pose or a force from a stamped ROS 2 message.

    The message is of type `PoseStamped` or `WrenchStamped`.

    Args:
        payload: The encoded message.
        count: How many numbers the message contains: 7 for a pose, 6 for a wrench.

    Returns:
        The name of the frame in which the vectors are expressed, and the numbers: for a pose,
            x, y, z in m and the quaternion x, y, z, w; for a wrench, the force in N and the
            torque in N m.

    Raises:
        ValueError: The message cannot be decoded.
    """
    reader = _CdrReader(payload)
    _, frame = reader.header()
    return frame, reader.numbers("d", count)
