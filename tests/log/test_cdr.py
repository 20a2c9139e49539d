"""Our bytes against two decoders and a serializer that other people wrote."""

import math
import struct
from contextlib import suppress
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from trilat_net.log.ros2 import cdr
from trilat_net.log.ros2.cdr import (
    JointStatePacker,
    RosLogLevel,
    make_float_array_packer,
    pack_log,
    pack_string,
)

STORE = get_typestore(Stores.ROS2_JAZZY)
texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=12)
floats = st.floats(width=64) | st.sampled_from([0.0, -0.0, math.nan, math.inf, 5e-324])
stamps_ns = st.integers(0, (1 << 31) * 10**9 - 1)


def decode_cdr(name: str, data: bytes) -> Any:
    """Returns a message decoded by mcap-ros2-support from the schema text in our files."""
    schema = Schema(id=1, name=name, encoding="ros2msg", data=cdr.ROS2_SCHEMAS[name])
    decoder = DecoderFactory().decoder_for("cdr", schema)
    assert decoder is not None
    return decoder(data)


def by_rosbags(name: str, data: bytes) -> Any:
    """Returns a message decoded by rosbags from its own definition of the type."""
    return STORE.deserialize_cdr(data, name)


def serialize_cdr(name: str, message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, name))


def type_of(name: str) -> Any:
    return STORE.types[name]


def make_header(stamp_ns: int, frame_id: str) -> Any:
    time = type_of("builtin_interfaces/msg/Time")(*divmod(stamp_ns, 10**9))
    return type_of("std_msgs/msg/Header")(stamp=time, frame_id=frame_id)


def pack_numbers(numbers: Any) -> list[bytes]:
    """Returns numbers as bytes, so that NaN equals itself and -0.0 differs from 0.0."""
    return [struct.pack("<d", number) for number in numbers]


@pytest.mark.parametrize("name", list(cdr.ROS2_SCHEMAS))
def test_schema_texts_are_complete_and_hash_right(name: str) -> None:
    """The hash of a schema text, by which ROS 2 distinguishes types, is that of the type."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(cdr.ROS2_SCHEMAS[name].decode(), name))
    assert store.hash_rihs01(name) == STORE.hash_rihs01(name)


@st.composite
def joint_states(draw: st.DrawFn) -> SimpleNamespace:
    names = draw(st.lists(texts, max_size=5))
    velocity = draw(st.booleans())
    effort = draw(st.booleans())
    row = st.lists(floats, min_size=len(names), max_size=len(names))
    return SimpleNamespace(
        stamp_ns=draw(stamps_ns),
        names=names,
        position=draw(row),
        velocity=draw(row) if velocity else [],
        effort=draw(row) if effort else [],
        packer=JointStatePacker(names, velocity=velocity, effort=effort),
    )


@given(joint_states())
def test_joint_states_are_read_as_they_were_written(case: SimpleNamespace) -> None:
    data = case.packer.pack(case.stamp_ns, case.position, case.velocity, case.effort)
    for message in (decode_cdr(cdr.JOINT_STATE, data), by_rosbags(cdr.JOINT_STATE, data)):
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == case.stamp_ns
        assert (message.header.frame_id, list(message.name)) == ("", case.names)
        assert pack_numbers(message.position) == pack_numbers(case.position)
        assert pack_numbers(message.velocity) == pack_numbers(case.velocity)
        assert pack_numbers(message.effort) == pack_numbers(case.effort)
    written = type_of(cdr.JOINT_STATE)(
        header=make_header(case.stamp_ns, ""),
        name=case.names,
        position=np.array(case.position),
        velocity=np.array(case.velocity),
        effort=np.array(case.effort),
    )
    assert data == serialize_cdr(cdr.JOINT_STATE, written)


@st.composite
def draw_array(draw: st.DrawFn) -> tuple[list[tuple[str, int]], list[float]]:
    dimensions = draw(st.lists(st.tuples(texts, st.integers(0, 3)), max_size=3))
    count = math.prod(size for _, size in dimensions)
    return dimensions, draw(st.lists(floats, min_size=count, max_size=count))


@given(draw_array())
def test_arrays_are_read_as_they_were_written(
    case: tuple[list[tuple[str, int]], list[float]],
) -> None:
    dimensions, numbers = case
    data = make_float_array_packer(*dimensions)(*numbers)
    strides = [math.prod(size for _, size in dimensions[n:]) for n in range(len(dimensions))]
    for message in (decode_cdr(cdr.FLOAT64_ARRAY, data), by_rosbags(cdr.FLOAT64_ARRAY, data)):
        assert pack_numbers(message.data) == pack_numbers(numbers)
        shape = [(d.label, d.size, d.stride) for d in message.layout.dim]
        assert shape == [(*d, stride) for d, stride in zip(dimensions, strides, strict=True)]
    make_dimension = type_of("std_msgs/msg/MultiArrayDimension")
    dims = [make_dimension(*d, stride) for d, stride in zip(dimensions, strides, strict=True)]
    layout = type_of("std_msgs/msg/MultiArrayLayout")(dim=dims, data_offset=0)
    written = type_of(cdr.FLOAT64_ARRAY)(layout=layout, data=np.array(numbers))
    assert data == serialize_cdr(cdr.FLOAT64_ARRAY, written)


@given(texts)
def test_a_string_is_read_as_it_was_written(text: str) -> None:
    data = pack_string(text)
    assert decode_cdr(cdr.STRING, data).data == by_rosbags(cdr.STRING, data).data == text
    assert data == serialize_cdr(cdr.STRING, type_of(cdr.STRING)(data=text))


@given(stamps_ns, st.sampled_from(RosLogLevel), texts, texts)
def test_log_lines_are_read_as_written(
    stamp_ns: int, level: RosLogLevel, name: str, text: str
) -> None:
    data = pack_log(stamp_ns, level, name, text)
    for message in (decode_cdr(cdr.LOG, data), by_rosbags(cdr.LOG, data)):
        assert message.stamp.sec * 10**9 + message.stamp.nanosec == stamp_ns
        assert (message.level, message.name, message.msg, message.line) == (
            level,
            name,
            text,
            0,
        )
        assert (message.file, message.function) == ("", "")
    time = type_of("builtin_interfaces/msg/Time")(*divmod(stamp_ns, 10**9))
    written = type_of(cdr.LOG)(
        stamp=time, level=level.value, name=name, msg=text, file="", function="", line=0
    )
    assert data == serialize_cdr(cdr.LOG, written)


def test_stamps_beyond_ros_2_become_its_last() -> None:
    message = by_rosbags(
        cdr.JOINT_STATE, JointStatePacker(["a"]).pack(2**63, [1.0], [2.0], [3.0])
    )
    assert message.header.stamp.sec == 2**31 - 1


def make_pose(stamp_ns: int, frame: str, numbers: list[float]) -> Any:
    point = type_of("geometry_msgs/msg/Point")
    turn = type_of("geometry_msgs/msg/Quaternion")
    where = type_of("geometry_msgs/msg/Pose")(
        position=point(*numbers[:3]), orientation=turn(*numbers[3:])
    )
    return type_of("geometry_msgs/msg/PoseStamped")(
        header=make_header(stamp_ns, frame), pose=where
    )


def make_wrench(stamp_ns: int, frame: str, numbers: list[float]) -> Any:
    vector = type_of("geometry_msgs/msg/Vector3")
    pull = type_of("geometry_msgs/msg/Wrench")(
        force=vector(*numbers[:3]), torque=vector(*numbers[3:])
    )
    return type_of("geometry_msgs/msg/WrenchStamped")(
        header=make_header(stamp_ns, frame), wrench=pull
    )


@given(stamps_ns, texts, st.lists(floats, min_size=7, max_size=7))
def test_poses_and_wrenches_are_those_of_rosbags(
    stamp_ns: int, frame: str, numbers: list[float]
) -> None:
    for kind, make, count in (("PoseStamped", make_pose, 7), ("WrenchStamped", make_wrench, 6)):
        data = cdr.pack_frame_vectors(stamp_ns, frame, *numbers[:count])
        assert data == serialize_cdr(
            f"geometry_msgs/msg/{kind}", make(stamp_ns, frame, numbers[:count])
        )
        named, read = cdr.read_frame_vectors(data, count)
        assert (named, pack_numbers(read)) == (frame, pack_numbers(numbers[:count]))


@given(stamps_ns, texts, st.lists(texts, max_size=4), st.booleans())
def test_joint_states_of_others_are_read(
    stamp_ns: int, frame: str, names: list[str], moves: bool
) -> None:
    speeds = [0.5] * len(names) if moves else []
    message = type_of(cdr.JOINT_STATE)(
        header=make_header(stamp_ns, frame),
        name=names,
        position=np.arange(len(names), dtype=np.float64),
        velocity=np.array(speeds),
        effort=np.zeros(0),
    )
    joint_state = cdr.RosJoints.read(serialize_cdr(cdr.JOINT_STATE, message))
    assert joint_state == (stamp_ns, names, tuple(range(len(names))), tuple(speeds), ())


@given(
    stamps_ns,
    st.lists(
        st.tuples(st.integers(0, 3), texts, texts, st.dictionaries(texts, texts, max_size=3))
    ),
)
def test_diagnostics_are_those_of_rosbags(stamp_ns: int, parts: list[tuple[Any, ...]]) -> None:
    status = type_of("diagnostic_msgs/msg/DiagnosticStatus")
    pair = type_of("diagnostic_msgs/msg/KeyValue")
    theirs = [
        status(
            level=n,
            name=name,
            message=text,
            hardware_id="",
            values=[pair(*item) for item in values.items()],
        )
        for n, name, text, values in parts
    ]
    kind = "diagnostic_msgs/msg/DiagnosticArray"
    message = type_of(kind)(header=make_header(stamp_ns, ""), status=theirs)
    assert cdr.pack_diagnostics(
        stamp_ns, [cdr.Diagnosis(*part) for part in parts]
    ) == serialize_cdr(kind, message)


@given(st.booleans(), texts)
def test_responses_of_triggers_are_boolean_and_text(success: bool, text: str) -> None:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg("bool success\nstring message\n", "std_srvs/msg/Told"))
    message = store.types["std_srvs/msg/Told"](success=success, message=text)
    assert cdr.pack_trigger_response(success=success, text=text) == bytes(
        store.serialize_cdr(message, "std_srvs/msg/Told")
    )


@given(st.binary(max_size=200) | st.binary(max_size=200).map(lambda rest: b"\0\1\0\0" + rest))
def test_an_invalid_message_is_a_value_error(data: bytes) -> None:
    for read in (cdr.RosJoints.read, lambda data: cdr.read_frame_vectors(data, 7)):
        with suppress(ValueError):
            read(data)
