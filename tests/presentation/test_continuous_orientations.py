"""Orientations leave the program without a jump: every export, topic and page, against SciPy's
rotations.

A motion may pass half a turn about any axis, and turn several times. The records then have
rotation vectors that jump. In every output the values move at most `ALLOWED` times as far as
the arm from one row to the next.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import scipy.io
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from trilat_people.live_page.body_turns import BodyTurns
from trilat_ros2.ros2_topics import BridgeEnds, SiteTopics

import trilat_net as tn
from tests.turning import (
    ALLOWED,
    CASE,
    MOTIONS,
    RECORDS,
    Motion,
    count_wraps,
    find_largest_turn,
    make_rotation,
    make_turning_log,
    place_links,
)
from trilat_net.core.step.vectors import Array
from trilat_net.log.log_reader import Log
from trilat_net.log.orientations import RotationVectors, align_signs, expand_poses
from trilat_net.log.ros2.topic_names import TopicTable

ROS = get_typestore(Stores.ROS2_JAZZY)
EVERY = [0, *(pytest.param(number, marks=pytest.mark.long) for number in MOTIONS if number)]
"""One motion on every push, all of them in the long tests."""
Series = tuple[str, Array, Rotation]
"""A series of numbers by what it is, shape (K, 4) of w, x, y, z or (K, 6), and the true orientations."""


def read_rotation(series: Array) -> Rotation:
    """Returns the orientations of quaternions or of the first two columns of matrices."""
    if series.shape[1] == 4:
        return Rotation.from_quat(series, scalar_first=True)
    columns = series[:, :3], series[:, 3:], np.cross(series[:, :3], series[:, 3:])
    return Rotation.from_matrix(np.stack(columns, axis=2))


def assert_follows(what: str, series: Array, truth: Rotation, accuracy: float = 1e-6) -> None:
    """Asserts that the series has the orientations, and no step larger than `ALLOWED` times
    that of the motion.
    """
    assert (read_rotation(series) * truth.inv()).magnitude().max() < accuracy, what
    largest = np.linalg.norm(np.diff(series, axis=0), axis=1).max()
    assert largest <= ALLOWED * find_largest_turn(truth), what


def test_motions_pass_half_a_turn() -> None:
    """Otherwise the other tests would prove nothing."""
    wraps = [count_wraps(make_rotation(number)) for number in MOTIONS]
    assert sum(count > 0 for count in wraps) >= 25
    assert max(wraps) >= 3


@pytest.mark.parametrize("number", MOTIONS)
def test_numbers_of_a_turning_body_never_jump(number: int) -> None:
    truth = make_rotation(number, 1000)
    vectors = truth.as_rotvec()
    turns = RotationVectors(vectors)
    assert_follows("quaternions", turns.as_quaternions(), truth, 1e-12)
    assert_follows("six numbers", turns.as_matrix_columns(), truth, 1e-12)
    pose = np.hstack([np.ones((1000, 3)), vectors])
    assert np.array_equal(expand_poses(pose)[:, 3:], turns.as_matrix_columns())
    assert expand_poses(pose[7]).shape == (9,)
    flipped = truth.as_quat(canonical=True, scalar_first=True)
    assert_follows("signs", align_signs(flipped), truth, 1e-12)
    nearer = RotationVectors(vectors[1:]).nearest_to(vectors[:-1])
    assert (Rotation.from_rotvec(nearer) * truth[1:].inv()).magnitude().max() < 1e-9
    assert np.linalg.norm(nearer - vectors[:-1], axis=1).max() < 3.0
    steady = Rotation.from_rotvec(turns.without_jumps())
    assert (steady * truth.inv()).magnitude().max() < 1e-9


def list_table_series(
    read: Callable[[str, str], Any], motions: dict[str, Motion], records: int = RECORDS
) -> Iterator[Series]:
    """Yields the orientations in a table of states; `read` returns a column of a site."""
    for site, motion in motions.items():
        for field, truth in (("x", motion.turned), ("q_des", motion.reference)):
            columns = [
                np.asarray(read(site, f"{field}_{axis}")) for axis in ("qw", "qx", "qy", "qz")
            ]
            yield f"{site} {field}", np.stack(columns, axis=1)[:records], truth


def list_csv(log: Log, motions: dict[str, Motion], folder: Path) -> Iterator[Series]:
    tn.export(log, "csv", folder / "out")
    frames = {site: pl.read_csv(folder / "out" / f"{site}_state.csv") for site in motions}
    about = json.loads((folder / "out" / "about.json").read_text())["tables"]["m_state.csv"][
        "columns"
    ]
    assert "unit quaternion" in about["x_qw"]["meaning"]
    assert about["x_qw"]["source"] == "x[3:6]"
    assert not [name for name in about if "_rx_rad" in name and "rad_s" not in name]
    return list_table_series(lambda site, name: frames[site][name], motions)


def list_parquet(log: Log, motions: dict[str, Motion], folder: Path) -> Iterator[Series]:
    tn.export(log, "parquet", folder / "out")
    frames = {
        site: pl.read_parquet(folder / "out" / f"{site}_state.parquet") for site in motions
    }
    return list_table_series(lambda site, name: frames[site][name], motions)


def list_npz(log: Log, motions: dict[str, Motion], folder: Path) -> Iterator[Series]:
    tn.export(log, "npz", folder / "out.npz")
    arrays = np.load(folder / "out.npz")
    return list_table_series(lambda site, name: arrays[f"{site}/{name}"], motions)


def list_mat(log: Log, motions: dict[str, Motion], folder: Path) -> Iterator[Series]:
    tn.export(log, "mat", folder / "out.mat")
    structs = scipy.io.loadmat(folder / "out.mat", simplify_cells=True)
    return list_table_series(lambda site, name: structs[site][name], motions)


def list_python(log: Log, motions: dict[str, Motion], _folder: Path) -> Iterator[Series]:
    frames = {site: log.table(site).to_pandas() for site in motions}
    yield from list_table_series(lambda site, name: frames[site][name], motions)
    for site, motion in motions.items():
        yield f"{site} orientation", log[site].orientation, motion.turned
        yield f"{site} orientation_des", log[site].orientation_des, motion.reference


def list_lerobot(log: Log, motions: dict[str, Motion], folder: Path) -> Iterator[Series]:
    tn.export(log, "lerobot", folder / "out", fps=1000)
    frames = pl.read_parquet(folder / "out" / "data" / "chunk-000" / "file-000.parquet")
    features = json.loads((folder / "out" / "meta" / "info.json").read_text())["features"]
    assert features["action"]["names"] == [
        *(f"{axis}.pos" for axis in "xyz"),
        *(f"{entry}.rot" for entry in ("r11", "r21", "r31", "r12", "r22", "r32")),
    ]
    assert (
        "rotation matrix"
        in json.loads((folder / "out" / "about.json").read_text())["meanings"]["r11.rot"]
    )
    for column in ("action", "action.m"):
        yield column, frames[column].to_numpy()[:, 3:].astype(np.float64), motions["m"].turned


def read_turn(quantity: Any) -> list[float]:
    return [quantity.w, quantity.x, quantity.y, quantity.z]


def list_ros_series(
    poses: dict[str, list[Any]],
    frames: list[Any],
    log: Log,
    motions: dict[str, Motion],
    prefix: str,
) -> Iterator[Series]:
    """Yields the orientations in messages of poses, by topic, and of frames."""
    for site, motion in motions.items():
        for topic, truth in (("tip_pose", motion.turned), ("reference_pose", motion.reference)):
            messages = poses[f"{prefix}/{site}/{topic}"]
            turns = np.array([read_turn(transform.pose.orientation) for transform in messages])
            yield f"{site} {topic}", turns, truth
    links = defaultdict(list)
    for message in frames:
        for transform in message.transforms:
            links[transform.header.frame_id, transform.child_frame_id].append(
                read_turn(transform.transform.rotation)
            )
    for site, motion in motions.items():
        turned = [Rotation.identity(RECORDS), *place_links(log.scenario, site, motion.q)]
        moving = [
            np.array(turns)
            for (_, child), turns in links.items()
            if child.startswith(f"{site}/") and np.ptp(turns, axis=0).max() > 1e-12
        ]
        assert len(moving) == len(turned) - 1
        for n, turns in enumerate(moving):
            yield f"{site} link {n + 1}", turns, turned[n].inv() * turned[n + 1]


def list_bag(log: Log, motions: dict[str, Motion], folder: Path) -> Iterator[Series]:
    tn.export(log, "ros2", folder / "out.mcap")
    poses = defaultdict(list)
    frames = []
    with AnyReader([folder / "out.mcap"]) as bag:
        for connection, _, data in bag.messages():
            if connection.msgtype == "geometry_msgs/msg/PoseStamped":
                poses[connection.topic].append(bag.deserialize(data, connection.msgtype))
            elif connection.topic == "/tf":
                frames.append(bag.deserialize(data, connection.msgtype))
    return list_ros_series(poses, frames, log, motions, "/tool_down")


class Topic(list[bytes]):
    """A topic with a subscriber."""

    has_subscribers = True
    put = list.append


class Graph:
    """A graph of ROS that keeps the published messages."""

    def __init__(self) -> None:
        self.published: dict[str, Topic] = defaultdict(Topic)

    def publisher(self, topic: str, *_: object) -> Topic:
        return self.published[topic]


def list_live_topics(log: Log, motions: dict[str, Motion], _folder: Path) -> Iterator[Series]:
    graph = Graph()
    ends: Any = BridgeEnds(graph, None, None, "t", TopicTable.read("crisp"))  # type: ignore[arg-type]
    for site in motions:
        site_topics = SiteTopics(ends, log.scenario, site, 0, graph.published["tf"])  # type: ignore[arg-type]
        for record in log[site].states:
            site_topics.publish(record, 1000.0)
    kind = "geometry_msgs/msg/PoseStamped"
    poses = {
        topic: [ROS.deserialize_cdr(data, kind) for data in messages]
        for topic, messages in graph.published.items()
        if topic.endswith("_pose")
    }
    frames = [
        ROS.deserialize_cdr(data, "tf2_msgs/msg/TFMessage") for data in graph.published["tf"]
    ]
    return list_ros_series(poses, frames, log, motions, "t")


@pytest.mark.parametrize(
    "list_series",
    [
        list_csv,
        list_parquet,
        list_npz,
        list_mat,
        list_python,
        list_lerobot,
        list_bag,
        list_live_topics,
    ],
)
@pytest.mark.parametrize("number", EVERY)
def test_exports_and_topics_turn_with_the_arm(
    tmp_path: Path, number: int, list_series: Callable[..., Iterator[Series]]
) -> None:
    log, motions = make_turning_log(number)
    count = 0
    for what, series, truth in list_series(log, motions, tmp_path):
        assert len(series) == RECORDS, what
        assert_follows(what, series, truth)
        count += 1
    assert count >= 2


@pytest.mark.parametrize("number", MOTIONS)
def test_bodies_on_pages_turn_with_the_plant(number: int) -> None:
    """A plant may give its quaternions any sign."""
    truth = make_rotation(number)
    bodies = BodyTurns()
    canonical = truth.as_quat(canonical=True, scalar_first=True)
    frames = [bodies.align([1.0, 2.0, 3.0, *axis, 0.0, 0.0, 0.0, *-axis]) for axis in canonical]
    poses = np.array(frames).reshape(RECORDS, 2, 7)
    assert_follows("first body", poses[:, 0, 3:], truth, 1e-4)
    assert_follows("second body", poses[:, 1, 3:], truth, 1e-4)
    assert poses[0, 0, :3].tolist() == [1.0, 2.0, 3.0]
    assert BodyTurns().align([]).tolist() == []


def test_environments_observe_continuous_orientations() -> None:
    """Arms whose tools point down, as the user and as its peer."""
    env = tn.make_env(
        CASE.read_text(encoding="utf-8"), user="s", leads="m", rate_hz=100, duration_s=2.0
    )
    observed = [env.reset(seed=1)[0]]
    shared = []
    for _ in range(190):
        way = np.array([0.0, 0.02, 0.0])
        observed.append(env.step(observed[-1]["pose"] + way)[0])
        view = env.unwrapped._build_scene().view
        shared.append(np.concatenate([view.q_des, view.peers[0].q]))
    assert env.observation_space.contains(observed[-1])
    for what, column in (("q_des", 3), ("peer_q", 9)):
        vectors = np.array(shared)[:, column : column + 3]
        series = np.array([observation[what].ravel()[3:] for observation in observed[1:]])
        assert series.shape[1] == 6
        turned = Rotation.from_rotvec(vectors)
        assert count_wraps(turned) > 0
        assert_follows(what, series, turned)


def test_datasets_of_downward_tools_have_no_jump(tmp_path: Path) -> None:
    log = tn.simulate(str(CASE))
    tn.export(log, "lerobot", tmp_path / "out")
    frames = pl.read_parquet(tmp_path / "out" / "data" / "chunk-000" / "file-000.parquet")
    rows = (np.arange(len(frames)) * 1000) // 30
    turned = Rotation.from_rotvec(log["m"].x[rows, 3:])
    assert count_wraps(turned) > 0
    assert find_largest_turn(turned) < 0.2
    assert_follows("action", frames["action"].to_numpy()[:, 3:].astype(np.float64), turned)
