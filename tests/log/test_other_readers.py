"""Our files in the hands of other people's readers, whose numbers must be ours."""

import io
import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from tests.execution.builders import execute_ticks
from tests.log.split_logs import read_messages
from tests.log.standard_files import write_standard_files
from tests.programs import PYMCAP, RERUN, list_rerun_faults, run_program
from trilat_net.core.step.ticks import Mode
from trilat_net.log.log_reader import Log, open_log

from .standard_files import EPOCH_NS, KINDS, SCENARIO

BUCKET = 20


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_standard_files(tmp_path_factory.mktemp("files"))


@pytest.fixture(params=KINDS)
def log_file(files: dict[str, Path], request: pytest.FixtureRequest) -> Path:
    return files[request.param]


def iterate_decoded(path: Path, prefix: str = "/viz") -> Iterator[Any]:
    """Topic, message and the plain record of every standard message, by mcap-ros2-support."""
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()], validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            if channel.message_encoding == "cdr":
                assert schema is not None
                assert channel.topic.startswith(prefix)
                decode = DecoderFactory().decoder_for("cdr", schema)
                assert decode is not None
                yield channel.topic, decode(message.data), message


def test_mcap_reads_equal_data_without_index(log_file: Path) -> None:
    data = log_file.read_bytes()
    by_index = make_reader(io.BytesIO(data), validate_crcs=True).iter_messages()
    plain = NonSeekingReader(io.BytesIO(data), validate_crcs=True).iter_messages(
        log_time_order=False
    )
    in_order = [(channel.topic, *vars(message).values()) for _, channel, message in plain]
    assert Counter(
        (channel.topic, *vars(message).values()) for _, channel, message in by_index
    ) == Counter(in_order)
    times = [message.log_ns for message in read_messages(data)]
    assert times == sorted(times)


def test_every_channel_has_a_full_schema(log_file: Path) -> None:
    """Viewers pass over channels without a schema, and take a list on top for many messages."""
    with log_file.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == ""
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert schema.id == channel.schema_id != 0
            pair = (channel.message_encoding, schema.encoding)
            assert pair in (("msgpack", "jsonschema"), ("cdr", "ros2msg"))
            if channel.message_encoding == "msgpack":
                assert isinstance(msgpack.unpackb(message.data), dict)
                assert json.loads(schema.data)["type"] == "object"


def test_every_view_has_exact_numbers(files: dict[str, Path]) -> None:
    """Of every bucket the extremes, and at the header's stamp as at the publish time a tick of it."""
    shown: dict[tuple[str, int], list[list[float]]] = defaultdict(list)
    for topic, ros, message in iterate_decoded(files["live"]):
        if topic.endswith("/joint_states"):
            stamp_ns = ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec
            assert stamp_ns == message.publish_time <= message.log_time
            site = topic.split("/")[2]
            assert ros.name == [f"{site}_q1", f"{site}_q2", f"{site}_q1_ref", f"{site}_q2_ref"]
            assert all(map(math.isnan, [*ros.velocity[2:], *ros.effort[2:]]))
            number = (message.publish_time - EPOCH_NS) // (BUCKET * 10**6)
            shown[site, number].append([*ros.position, *ros.velocity[:2], *ros.effort[:2]])
    for site, made_by in execute_ticks(SCENARIO).items():
        for first in range(0, len(made_by), BUCKET):
            rows = np.array(
                [[*o.q, *o.q_des, *o.qd, *o.tau] for o in made_by[first : first + BUCKET]]
            )
            got = np.array(shown.pop((site, first // BUCKET)))
            assert len(got) == 2
            assert np.array_equal(got.min(axis=0), rows.min(axis=0))
            assert np.array_equal(got.max(axis=0), rows.max(axis=0))
    assert not shown


def test_statistics_and_events_equal_the_sites(files: dict[str, Path]) -> None:
    log = open_log(files["live"])
    stats = {(site, s.t_ns + EPOCH_NS): s for site in log.sites for s in log.link_stats(site)}
    seen = Counter[str]()
    for topic, ros, message in iterate_decoded(files["live"]):
        name = topic.rpartition("/")[2]
        seen[name] += 1
        if name in ("link_delay", "link_age", "link_offset"):
            (site,) = topic.split("/")[2:-1]
            statistics = stats[site, message.publish_time]
            (peer,) = log.scenario.peers(site)
            assert (
                ros.data
                == {
                    "link_delay": [
                        statistics.delay_us[peer] / 1e3,
                        statistics.delay_max_us[peer] / 1e3,
                    ],
                    "link_age": [statistics.age_us[peer] / 1e3],
                    "link_offset": [
                        statistics.offset_us[peer] / 1e3,
                        statistics.bound_us[peer] / 1e3,
                    ],
                }[name]
            )
            assert peer in ros.layout.dim[0].label
            assert "(ms)" in ros.layout.dim[-1].label
        if name == "events":
            assert ros.data in {f"{event.member}: {event.text}" for event in log.events}
        if name == "log":
            assert ros.msg in {event.text for event in log.events}
    assert seen["link_delay"] == seen["link_age"] == len(stats)
    assert seen["events"] == seen["log"] == len(log.events)


@pytest.fixture(scope="module")
def log(files: dict[str, Path]) -> Log:
    return open_log(files["live"])


def test_rosbags_reads_every_record_of_the_bag(files: dict[str, Path], log: Log) -> None:
    joints: dict[str, list[Any]] = defaultdict(list)
    others: dict[str, list[list[float]]] = defaultdict(list)
    with AnyReader([files["bag"]]) as reader:
        for connection, log_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype == "sensor_msgs/msg/JointState":
                joints[connection.topic].append((log_ns, message))
            elif connection.msgtype == "std_msgs/msg/Float64MultiArray":
                others[connection.topic].append(message.data.tolist())
    for site in log.sites:
        part = log[site]
        states = joints[f"/lab/{site}/joint_states"]
        references = joints[f"/lab/{site}/reference"]
        assert [log_ns for log_ns, _ in states] == part.log_time_ns.tolist()
        stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in states]
        assert stamps == [EPOCH_NS + k * 10**6 for k in part.tick.tolist()]
        for field, list_of in (("q", "position"), ("qd", "velocity"), ("tau", "effort")):
            assert np.array_equal(
                [getattr(m, list_of) for _, m in states], getattr(part, field)
            )
        assert np.array_equal([m.position for _, m in references], part.q_des)
        assert np.array_equal([m.velocity for _, m in references], part.qd_des)
        assert all(len(m.effort) == 0 for _, m in references)
        assert np.array_equal(others[f"/lab/{site}/error"], part.e)
        assert np.array_equal(others[f"/lab/{site}/tau_x"], part.tau_x)
        assert np.array_equal(others[f"/lab/{site}/theta_hat"], part.theta_hat)
        assert others[f"/lab/{site}/mode_number"] == [[float(Mode.RUN)]] * len(part)
        assert len(others[f"/lab/{site}/link_delay"]) == len(log.link_stats(site))


def test_the_bag_keeps_publish_times(files: dict[str, Path], log: Log) -> None:
    times: dict[str, list[int]] = defaultdict(list)
    for topic, _, message in iterate_decoded(files["bag"], "/"):
        times[topic].append(message.publish_time)
    for site in log.sites:
        for name in (
            "joint_states",
            "reference",
            "error",
            "tau_x",
            "theta_hat",
            "tip_pose",
            "mode_number",
        ):
            assert times[f"/lab/{site}/{name}"] == log[site].publish_time_ns.tolist()


def test_the_bag_conforms_to_ros_2(files: dict[str, Path]) -> None:
    """Its profile, its types and the qualities of service are those that its tools ask for."""
    with files["bag"].open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        for channel in summary.channels.values():
            assert channel.message_encoding == "cdr"
            assert "offered_qos_profiles" in channel.metadata
            assert {"unit", "content"} & channel.metadata.keys()
        metadata = {entry.name: entry.metadata for entry in reader.iter_metadata()}
        (scenario,) = reader.iter_attachments()
    assert metadata["trilat.source"]["session"] == "lab"
    assert scenario.data.decode() == SCENARIO.text
    with Reader(files["bag"]) as bag:
        for connection in bag.connections:
            (profile,) = connection.ext.offered_qos_profiles
            latched = connection.topic.rpartition("/")[2] in (
                "mode",
                "dominance",
                "robot_description",
            )
            durability = "TRANSIENT_LOCAL" if latched else "VOLATILE"
            qualities = profile.depth, profile.reliability.name, profile.durability.name
            assert qualities == (1 if latched else 10, "RELIABLE", durability)


LONG = [
    pytest.param(kind, marks=pytest.mark.long)
    for kind in ("virtual", "first part", "last part")
]


@pytest.mark.parametrize("kind", ["live", "recovered", "bag", *LONG])
def test_rerun_finds_nothing_wrong(files: dict[str, Path], kind: str) -> None:
    assert list_rerun_faults(files[kind], "--full") == []


@pytest.mark.long
def test_rerun_has_curves_with_the_names_of_joints(
    files: dict[str, Path], tmp_path: Path
) -> None:
    """Of a recording as it converts it, the names of the series and their numbers."""
    recording = tmp_path / "run.rrd"
    run_program(*RERUN, "mcap", "convert", str(files["live"]), "-o", str(recording))
    text = run_program(*RERUN, "rrd", "print", "-vvv", str(recording))
    for site in SCENARIO.names:
        for entity in (
            f"/viz/{site}/joint_states/position",
            f"/viz/{site}/error",
            f"/viz/{site}/link_delay",
        ):
            assert entity in text
        assert f"{site}_q1_ref" in text
    assert "Scalars:scalars" in text
    assert "SeriesLines:names" in text


@pytest.mark.parametrize(
    "kind",
    ["live", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("recovered", "bag"))],
)
@pytest.mark.push
def test_pymcap_cli_finds_nothing_wrong(files: dict[str, Path], kind: str) -> None:
    """A program of others under another license: run, never imported."""
    assert "passed" in run_program(
        *PYMCAP, "doctor", "--strict-message-order", str(files[kind])
    )
    if kind == "live":
        assert "/viz/m/joint_states" in run_program(*PYMCAP, "info", str(files[kind]))
