"""Packer and reader of standard ROS 2 messages: CDR, little-endian; no ROS installation needed.

Invariant: the bytes equal those of any other serializer. Fields are aligned to their size,
counted from the end of the four-byte header; padding is zero. The constant layout is computed
once, so that a message is one `struct` call.
"""

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from importlib import resources
from typing import Any, NamedTuple

from ...core.ticks import NS_PER_S

ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"
JOINT_STATE = "sensor_msgs/msg/JointState"
FLOAT64_ARRAY = "std_msgs/msg/Float64MultiArray"
STRING = "std_msgs/msg/String"
LOG = "rcl_interfaces/msg/Log"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POSE = "geometry_msgs/msg/PoseStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
WRENCH = "geometry_msgs/msg/WrenchStamped"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

_HEAD = b"\x00\x01\x00\x00"  # plain CDR, little-endian, no options
_LAST_S = (1 << 31) - 1  # of the stamps of ROS 2

DEFINITIONS = resources.files("trilat_net.log.ros2") / "definitions"
"""Texts of ROS: types with the types of their fields, the quality of service of a bag, the
planar arm.
"""
ROS2_SCHEMAS = {
    name: (DEFINITIONS / f"{name.rpartition('/')[2]}.msg").read_bytes()
    for name in (
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
}
"""Complete definitions of the types that are packed here, by name."""


def _pack_fields(offset: int, *values: int | str) -> bytes:
    data = b""
    for value in values:
        text = value.encode() + b"\0" if isinstance(value, str) else b""
        number = value if isinstance(value, int) else len(text)
        data += b"\0" * (-(offset + len(data)) % 4) + struct.pack("<I", number) + text
    return data


def _split_stamp(stamp_ns: int) -> tuple[int, int]:
    seconds, rest_ns = divmod(stamp_ns, NS_PER_S)
    return min(seconds, _LAST_S), rest_ns


def _format_floats(offset: int, count: int) -> tuple[str, int]:
    before = -offset % 4
    start = offset + before + 4
    gap = -start % 8 if count else 0  # an empty list has nothing to align
    return f"{before}xI{gap}x{count}d", start + gap + 8 * count


class JointStatePacker:
    """Packer of `sensor_msgs/msg/JointState` with these joints, with or without velocities and
    efforts.
    """

    def __init__(
        self, names: Sequence[str], *, velocity: bool = True, effort: bool = True
    ) -> None:
        self._names = _pack_fields(8, "", len(names), *names)  # after the stamp; of no frame
        self._counts = [len(names) * present for present in (True, velocity, effort)]
        form = f"<4siI{len(self._names)}s"
        offset = 8 + len(self._names)
        for count in self._counts:
            part, offset = _format_floats(offset, count)
            form += part
        self._pack = struct.Struct(form).pack

    def pack(
        self,
        stamp_ns: int,
        position: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> bytes:
        """Returns one message of a time (Unix ns, not below 0): rad, rad/s and N m per joint."""
        p, v, e = self._counts
        return self._pack(
            _HEAD, *_split_stamp(stamp_ns), self._names, p, *position, v, *velocity, e, *effort
        )


class TransformPacker:
    """Packer of `tf2_msgs/msg/TFMessage` with these frames: pairs of parent and child."""

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        self._names = []
        form = "<4sI"
        offset = 4
        for parent, child in frames:
            names = _pack_fields(offset + 8, parent, child)
            gap = -(offset + 8 + len(names)) % 8
            form += f"iI{len(names)}s{gap}x7d"
            offset += 8 + len(names) + gap + 56
            self._names.append(names)
        self._pack = struct.Struct(form).pack

    def pack(self, stamp_ns: int, numbers: Sequence[float]) -> bytes:
        """Returns one message of a time (Unix ns, not below 0): x, y, z, m, and a quaternion."""
        fields: list[object] = []
        for n, names in enumerate(self._names):
            fields += (*_split_stamp(stamp_ns), names, *numbers[7 * n : 7 * n + 7])
        return self._pack(_HEAD, len(self._names), *fields)


def make_float_array_packer(*dimensions: tuple[str, int]) -> Callable[..., bytes]:
    """Returns a packer of `std_msgs/msg/Float64MultiArray` of one shape; it takes the numbers
    row by row.

    Each dimension is a label and a size.
    """
    sizes = [size for _, size in dimensions]
    layout: list[int | str] = []
    for n, (label, size) in enumerate(dimensions):
        layout += label, size, math.prod(sizes[n:])
    shape = _pack_fields(0, len(dimensions), *layout, 0)  # the last is data_offset
    form, _ = _format_floats(len(shape), count := math.prod(sizes))
    pack = struct.Struct(f"<4s{len(shape)}s{form}").pack
    return lambda *numbers: pack(_HEAD, shape, count, *numbers)


def pack_string(text: str) -> bytes:
    """Returns a `std_msgs/msg/String`."""
    return _HEAD + _pack_fields(0, text)


class RosLogLevel(IntEnum):
    """Severity of a line of a log, by the numbers of ROS 2."""

    INFO = 20
    WARN = 30
    ERROR = 40


def pack_log(stamp_ns: int, level: RosLogLevel, name: str, text: str) -> bytes:
    """Returns an `rcl_interfaces/msg/Log` of a member at a time (Unix ns, not below 0)."""
    # after stamp and level; of no file, function and line
    fields = _pack_fields(9, name, text, "", "", 0)
    return _HEAD + struct.pack("<iIB", *_split_stamp(stamp_ns), level) + fields


def pack_frame_vectors(stamp_ns: int, frame: str, *numbers: float) -> bytes:
    """Returns a message of vectors in a frame.

    It is a `PoseStamped` (x, y, z, m, and the quaternion x, y, z, w), a `TwistStamped` (m/s,
    rad/s) or a `WrenchStamped` (N, N m).
    """
    head = struct.pack("<iI", *_split_stamp(stamp_ns)) + _pack_fields(8, frame)
    return _HEAD + head + b"\0" * (-len(head) % 8) + struct.pack(f"<{len(numbers)}d", *numbers)


def pack_trigger_response(*, success: bool, text: str) -> bytes:
    """Returns the response of `std_srvs/srv/Trigger`."""
    return _HEAD + bytes([success]) + _pack_fields(1, text)


class Diagnosis(NamedTuple):
    """A part of `/diagnostics`: its level (0 ok, 1 warning, 2 error, 3 stale), name, text and
    values.
    """

    level: int
    name: str
    text: str
    values: Mapping[str, str]


def pack_diagnostics(stamp_ns: int, parts: Sequence[Diagnosis]) -> bytes:
    """Returns a `diagnostic_msgs/msg/DiagnosticArray`."""
    data = struct.pack("<iI", *_split_stamp(stamp_ns)) + _pack_fields(8, "", len(parts))
    for part in parts:
        data += bytes([part.level])
        fields = [one for pair in part.values.items() for one in pair]
        data += _pack_fields(len(data), part.name, part.text, "", len(part.values), *fields)
    return _HEAD + data


class CdrReader:
    """Reads the fields of a message one after another.

    Raises:
        ValueError: the message is not plain CDR, little-endian, or ends before a field does.
    """

    def __init__(self, payload: bytes) -> None:
        if payload[:2] != _HEAD[:2] or len(payload) < len(_HEAD):
            raise ValueError("is not plain CDR, little-endian")
        self._data = payload[len(_HEAD) :]
        self._at = 0

    def numbers(self, code: str, count: int = 1) -> tuple[Any, ...]:
        """Returns numbers of a format of `struct`."""
        size = struct.calcsize(f"<{code}")
        start = self._at + (-self._at % size if count else 0)
        self._at = start + count * size
        if self._at > len(self._data):
            raise ValueError("ends in the middle of a field")
        return struct.unpack_from(f"<{count}{code}", self._data, start)

    def count(self) -> int:
        """Returns how many entries a list has, each of one byte at least."""
        (count,) = self.numbers("I")
        if count > len(self._data) - self._at:
            raise ValueError("ends in the middle of a field")
        return int(count)

    def text(self) -> str:
        """Returns a string."""
        length = self.count()
        (data,) = self.numbers("s", length) if length else (b"",)
        return bytes(data).removesuffix(b"\0").decode()

    def floats(self) -> tuple[float, ...]:
        """Returns a list of numbers."""
        return self.numbers("d", self.count())

    def header(self) -> tuple[int, str]:
        """Returns the stamp of a header, ns, on whatever clock, and its frame."""
        (whole_s,) = self.numbers("i")
        (rest_ns,) = self.numbers("I")
        return whole_s * NS_PER_S + rest_ns, self.text()


class RosJoints(NamedTuple):
    """A `JointState`: stamp, ns, names, and positions, velocities, efforts, as many as they, or
    none.
    """

    stamp_ns: int
    names: list[str]
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    effort: tuple[float, ...]


def read_joint_state(payload: bytes) -> RosJoints:
    """Returns what a `sensor_msgs/msg/JointState` says.

    Raises:
        ValueError: it cannot be read.
    """
    reader = CdrReader(payload)
    stamp_ns, _ = reader.header()
    names = [reader.text() for _ in range(reader.count())]
    return RosJoints(
        stamp_ns=stamp_ns,
        names=names,
        position=reader.floats(),
        velocity=reader.floats(),
        effort=reader.floats(),
    )


def read_float_array(payload: bytes) -> tuple[float, ...]:
    """Returns the numbers of a `std_msgs/msg/Float64MultiArray`, whatever its shape.

    Raises:
        ValueError: it cannot be read.
    """
    reader = CdrReader(payload)
    for _ in range(reader.count()):
        reader.text()
        reader.numbers("I", 2)
    reader.numbers("I")
    return reader.floats()


def read_frame_vectors(payload: bytes, count: int) -> tuple[str, tuple[float, ...]]:
    """Returns the frame of a `PoseStamped` (7 numbers) or a `WrenchStamped` (6), and its
    numbers.

    Raises:
        ValueError: it cannot be read.
    """
    reader = CdrReader(payload)
    return reader.header()[1], reader.numbers("d", count)
