"""Targets from ROS 2: what holds an arm, what is refused and how it is said, and when an arm is let go."""

import math
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

import trilat_net
from sites.ros2_bridge import (
    SILENCE_NS,
    DominanceTopic,
    SiteTopics,
    TargetTopic,
    read_joint_target,
    read_place_target,
    read_topic_names,
)
from tests.net.manual_clock import ManualClock
from trilat_net.errors import UsageError
from trilat_net.log.ros2 import cdr
from trilat_net.net.requests import ChangeReply
from trilat_net.net.ros2_graph import Attachment, Refusals

ROS = get_typestore(Stores.ROS2_JAZZY)
FIRST, SECOND = Attachment(1, 5, b"a" * 16), Attachment(1, 5, b"b" * 16)
NAMES = [("m1_q1", "q1"), ("m1_q2", "q2")]


class HeldArm:
    """A hand of which it is noted what is done with it."""

    def __init__(self) -> None:
        self.goals: list[tuple[float, ...]] = []
        self.holds = False

    def move(self, *goal: float) -> int:
        if any(abs(one) > 1e6 for one in goal):
            raise UsageError("is beyond the arm")
        self.goals.append(goal)
        self.holds = True
        return len(self.goals)

    def release(self) -> None:
        self.holds = False


class Desk:
    """A topic `target_pose` of an arm in the plane, its clock, and what was said."""

    def __init__(self) -> None:
        self.arm, self.clock, self.said = HeldArm(), ManualClock(), list[str]()
        self.refusals = Refusals(self.said.append)
        self.topic = TargetTopic(
            self.arm,  # type: ignore[arg-type]
            "play/m1/target_pose",
            lambda data: read_place_target(2, 7, data),
            self.arm.move,
            self.clock,
            self.refusals,
        )

    def hears(self, x: float, sender: Attachment = FIRST, after_ns: int = 0) -> None:
        self.clock.sleep_until(self.clock.monotonic_ns() + after_ns)
        self.topic.watch()
        self.topic.take(cdr.pack_frame_vectors(7, "m1/base", x, 0.5, 0, 0, 0, 0, 1), sender)


def joints(names: Sequence[str], angles: Sequence[float]) -> bytes:
    return cdr.JointStatePacker(names, velocity=False, effort=False).pack(0, angles)


def test_a_pose_moves_the_target_and_silence_lets_go() -> None:
    desk = Desk()
    desk.hears(0.1)
    desk.hears(0.2, after_ns=SILENCE_NS)
    assert desk.arm.goals == [(0.1, 0.5), (0.2, 0.5)]
    desk.clock.sleep_until(desk.clock.monotonic_ns() + SILENCE_NS)
    desk.topic.watch()
    assert desk.arm.holds
    desk.clock.sleep_until(desk.clock.monotonic_ns() + 1)
    desk.topic.watch()
    assert not desk.arm.holds


def test_two_publishers_move_nothing_until_one_is_gone() -> None:
    desk = Desk()
    desk.hears(0.1)
    desk.hears(0.9, SECOND, after_ns=10)
    assert not desk.arm.holds
    for _ in range(9):
        desk.hears(0.2, after_ns=100_000_000)
    assert desk.arm.goals == [(0.1, 0.5)]
    desk.hears(0.3, after_ns=200_000_000)
    assert desk.arm.goals == [(0.1, 0.5), (0.3, 0.5)]
    assert desk.said == [
        "refused: play/m1/target_pose has two publishers: neither moves the arm until the other is gone"
    ]
    assert desk.refusals.counts.total() == 10


@given(st.binary(max_size=120) | st.binary(max_size=120).map(lambda rest: b"\0\1\0\0" + rest))
def test_whatever_comes_is_taken_or_counted(data: bytes) -> None:
    desk = Desk()
    desk.topic.take(data, FIRST)
    assert len(desk.arm.goals) + desk.refusals.counts.total() == 1
    assert all(map(math.isfinite, (x for goal in desk.arm.goals for x in goal)))


@pytest.mark.parametrize("x", [math.nan, math.inf, 1e7])
def test_a_target_that_no_arm_can_take_is_refused_and_the_last_one_stays(x: float) -> None:
    desk = Desk()
    desk.hears(0.1)
    desk.hears(x)
    desk.hears(x)
    assert desk.arm.goals == [(0.1, 0.5)]
    assert len(desk.said) == 1
    assert desk.refusals.counts.total() == 2


def test_joints_are_found_by_their_names_in_any_order() -> None:
    assert read_joint_target(NAMES, joints(["m1_q2", "m1_q1"], [2.0, 1.0])) == [1.0, 2.0]
    assert read_joint_target(NAMES, joints(["other", "q2", "q1"], [9.0, 2.0, 1.0])) == [1.0, 2.0]


@pytest.mark.parametrize(
    ("names", "angles", "said"),
    [
        (["m1_q1"], [1.0], "lacks m1_q2; it has m1_q1"),
        ([], [], "lacks m1_q1, m1_q2; it has no names"),
        (["q1", "q2"], [1.0, math.nan], "has a number that is not finite"),
    ],
)
def test_joints_that_are_missing_or_not_finite_are_named(
    names: list[str], angles: list[float], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        read_joint_target(NAMES, joints(names, angles))


def test_topics_are_called_as_a_file_says(tmp_path: Path) -> None:
    (tmp_path / "names.toml").write_text('joint_states = "arm/joint_states"\n')
    assert read_topic_names(str(tmp_path / "names.toml")) == {"joint_states": "arm/joint_states"}
    assert read_topic_names("crtk")["target_pose"] == "servo_cp"
    assert not read_topic_names("crisp")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("joint_state = 'a'", "no topic 'joint_state'.*joint_states"),
        ("joint_states = 'a b'", "joint_states 'a b' is no name of ROS 2"),
        ("joint_states", "is no TOML"),
        ("joint_states = 'a'\nreference = 'a'", "two topics have one name"),
        (None, "--names is crisp, crtk or a file, and .* cannot be read: No such file"),
    ],
)
def test_names_that_cannot_be_right_are_refused(tmp_path: Path, text: str | None, said: str) -> None:
    file = tmp_path / "names.toml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(UsageError, match=said.replace("--names", "names")):
        read_topic_names(str(file))


def test_reasons_that_strangers_invent_are_counted_and_not_kept() -> None:
    said: list[str] = []
    refusals = Refusals(said.append)
    for n in range(1000):
        refusals.add(f"reason {n}")
    assert refusals.counts.total() == 1000
    assert len(said) == len(refusals.counts) == 65


class Topic(list[bytes]):
    """A topic to which somebody listens, and what came on it."""

    heard = True
    put = list.append


class Listener:
    """A graph in which every topic is heard."""

    def __init__(self) -> None:
        self.came: dict[str, Topic] = defaultdict(Topic)

    def publisher(self, topic: str, _kind: str, _qos: object) -> Topic:
        return self.came[topic]


def compose(frames: Any, site: str) -> list[tuple[Any, Any]]:
    """Where all links of a site are in `world`, by the transforms alone; rotations by SciPy."""
    found = {"world": (np.zeros(3), Rotation.identity())}
    for one in frames:
        (at, turned), move, turn = (
            found[one.header.frame_id],
            one.transform.translation,
            one.transform.rotation,
        )
        place = at + turned.apply([move.x, move.y, move.z])
        found[one.child_frame_id] = place, turned * Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
    return [where for name, where in found.items() if name.startswith(f"{site}/")] + [found["world"]]


@pytest.mark.parametrize("name", ["paper", "six_joints", "unlike_arms", "wall_in_space"])
def test_the_pose_of_the_tip_is_that_of_a_link_in_the_transforms(name: str) -> None:
    log = trilat_net.simulate(name, {"duration_s": 0.3})
    for site in log.sites:
        graph = Listener()
        shown = SiteTopics(graph, log.scenario, "t", site, 0, graph.came["tf"], {})  # type: ignore[arg-type]
        shown.publish(log[site].states[-1])
        messages = [ROS.deserialize_cdr(data, "tf2_msgs/msg/TFMessage") for data in graph.came["tf"]]
        frames = [one for message in messages for one in message.transforms]
        tip = ROS.deserialize_cdr(graph.came[f"t/{site}/tip_pose"][-1], "geometry_msgs/msg/PoseStamped")
        where, turn = tip.pose.position, tip.pose.orientation
        held = next(one for one in frames if one.child_frame_id == tip.header.frame_id).transform
        base = Rotation.from_quat([held.rotation.x, held.rotation.y, held.rotation.z, held.rotation.w])
        place = base.apply([where.x, where.y, where.z])
        place += [held.translation.x, held.translation.y, held.translation.z]
        turned = base * Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])
        apart = [
            max(np.abs(at - place).max(), (way.inv() * turned).magnitude())
            for at, way in compose(frames, site)
        ]
        assert min(apart) < 1e-7


def shares(*numbers: float) -> bytes:
    array = ROS.types["std_msgs/msg/Float64MultiArray"]
    layout = ROS.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return bytes(
        ROS.serialize_cdr(array(layout=layout, data=np.array(numbers)), "std_msgs/msg/Float64MultiArray")
    )


def test_shares_are_asked_for_once_and_what_is_refused_is_said() -> None:
    asked: list[dict[str, float]] = []
    said: list[str] = []

    def change(wanted: dict[str, float]) -> ChangeReply:
        asked.append(wanted)
        return ChangeReply(member="s", accepted=sum(wanted.values()) == 1.0, text="must sum to 1")

    topic = DominanceTopic("t/s/set_dominance", ["m1", "m2"], change, Refusals(said.append))
    for data in (
        shares(0.9, 0.1),
        shares(0.9, 0.1),
        shares(0.5, 0.1),
        shares(1.0),
        shares(math.nan, 0.0),
        b"x",
    ):
        topic.take(data, FIRST)
        topic.ask()
        topic.ask()
    assert asked == [{"m1": 0.9, "m2": 0.1}, {"m1": 0.5, "m2": 0.1}]
    assert said == [
        "refused: t/s/set_dominance must sum to 1",
        "refused: t/s/set_dominance has 1 numbers; the peers are m1, m2",
        "refused: t/s/set_dominance has a number that is not finite",
        "refused: t/s/set_dominance is not plain CDR, little-endian",
    ]
