"""The bridge from ROS 2: messages that move an arm, refusals and their reasons, and the release
of an arm.
"""

import json
import math
import re
import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation
from trilat_ros2.ros2_bridge import (
    FIRST_NOTICE_NS,
    NEXT_NOTICE_NS,
    SAFE_PERIOD_NS,
    SENDER_TIMEOUT_NS,
    SILENCE_NS,
    DominanceTopic,
    RobotArm,
    TargetTopic,
    publish_session,
    read_joint_target,
    read_vector_target,
)
from trilat_ros2.ros2_topics import BridgeEnds, SiteTopics

import trilat_net
from tests.log.standard_files import write_standard_files
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.net.waiting import drained, until
from tests.scenario.builders import posed_task_text
from trilat_net.analysis.dominance_history import DominancePlan
from trilat_net.app.share_history import ShareHistory
from trilat_net.core.step.ticks import Mode, TickRecord
from trilat_net.errors import RunFailed, UsageError
from trilat_net.files import find_page
from trilat_net.log.ros2 import cdr
from trilat_net.log.ros2.published import Ros2Topics
from trilat_net.log.ros2.robot_model import RobotModel
from trilat_net.log.ros2.topic_names import (
    DIAGNOSTICS,
    FRAMES_TOPIC,
    TOPICS,
    RobotTable,
    TopicTable,
)
from trilat_net.net import topics
from trilat_net.net.arm_client import FRESH_NS, ArmClient
from trilat_net.net.clock import SystemClock
from trilat_net.net.membership import describe_member
from trilat_net.net.messages import Event
from trilat_net.net.requests import ArmMeasurement, Backfill
from trilat_net.net.ros2.ros2_graph import Attachment, QualityOfService, Refusals
from trilat_net.net.wire import decode, encode, encode_state
from trilat_net.scenario import load_scenario

ROS = get_typestore(Stores.ROS2_JAZZY)
FIRST = Attachment(1, 5, b"a" * 16)
SECOND = Attachment(1, 5, b"b" * 16)
NAMES = [("m1_q1", "q1"), ("m1_q2", "q2")]


class HeldArm:
    """A hand that notes every call."""

    def __init__(self) -> None:
        self.goals: list[tuple[float, ...]] = []
        self.holds = False

    def move(self, *goal: float) -> int:
        if any(abs(coordinate) > 1e6 for coordinate in goal):
            raise UsageError("is beyond the arm")
        self.goals.append(goal)
        self.holds = True
        return len(self.goals)

    def release(self) -> None:
        self.holds = False


class Desk:
    """The topic `target_pose` of a planar arm, with a clock and the texts that were printed."""

    def __init__(self) -> None:
        self.arm = HeldArm()
        self.clock = ManualClock()
        self.said: list[str] = []
        self.refusals = Refusals(self.said.append)
        self.topic = TargetTopic(
            self.arm,  # type: ignore[arg-type]
            lambda data: read_vector_target("m1/base", 2, 7, data),
            self.arm.move,
            self.clock,
        )
        self.take = self.refusals.guard("play/m1/target_pose", self.topic.receive)

    def receive(
        self, x: float, sender: Attachment = FIRST, after_ns: int = 0, frame: str = "m1/base"
    ) -> None:
        """Receives a pose after some time."""
        self.clock.sleep_until(self.clock.monotonic_ns() + after_ns)
        self.topic.watch()
        self.take(cdr.pack_frame_vectors(7, frame, x, 0.5, 0, 0, 0, 0, 1), sender)


def pack_joints(names: Sequence[str], angles: Sequence[float]) -> bytes:
    """Returns a message with the angles of joints, in rad."""
    return cdr.JointStatePacker(names, velocity=False, effort=False).pack(0, angles)


def test_a_pose_moves_the_target_until_silence() -> None:
    """A target is released when its publisher has been silent for longer than `SILENCE_NS`."""
    desk = Desk()
    desk.receive(0.1)
    desk.receive(0.2, after_ns=SILENCE_NS)
    assert desk.arm.goals == [(0.1, 0.5), (0.2, 0.5)]
    desk.clock.sleep_until(desk.clock.monotonic_ns() + SILENCE_NS)
    desk.topic.watch()
    assert desk.arm.holds
    desk.clock.sleep_until(desk.clock.monotonic_ns() + 1)
    desk.topic.watch()
    assert not desk.arm.holds


def test_two_publishers_move_nothing_until_one_is_gone() -> None:
    desk = Desk()
    desk.receive(0.1)
    desk.receive(0.9, SECOND, after_ns=10)
    assert not desk.arm.holds
    for _ in range(9):
        desk.receive(0.2, after_ns=100_000_000)
    assert desk.arm.goals == [(0.1, 0.5)]
    desk.receive(0.3, after_ns=200_000_000)
    assert desk.arm.goals == [(0.1, 0.5), (0.3, 0.5)]
    assert desk.said == [
        "refused: play/m1/target_pose has two publishers: the messages of both are refused until one of them is silent"
    ]
    assert desk.refusals.counts.total() == 10


@given(st.binary(max_size=120) | st.binary(max_size=120).map(lambda rest: b"\0\1\0\0" + rest))
def test_every_message_is_taken_or_counted(data: bytes) -> None:
    """Any bytes either give one finite target or count as one refusal."""
    desk = Desk()
    desk.take(data, FIRST)
    assert len(desk.arm.goals) + desk.refusals.counts.total() == 1
    for goal in desk.arm.goals:
        assert all(map(math.isfinite, goal))


@pytest.mark.parametrize("x", [math.nan, math.inf, 1e7])
def test_an_impossible_target_leaves_the_last_target(x: float) -> None:
    desk = Desk()
    desk.receive(0.1)
    desk.receive(x)
    desk.receive(x)
    assert desk.arm.goals == [(0.1, 0.5)]
    assert len(desk.said) == 1
    assert desk.refusals.counts.total() == 2


def test_a_pose_in_another_frame_moves_nothing() -> None:
    desk = Desk()
    desk.receive(0.1, frame="")
    desk.receive(0.2, frame="camera")
    assert desk.arm.goals == [(0.1, 0.5)]
    assert desk.said == [
        "refused: play/m1/target_pose is in the frame 'camera', but this site uses 'm1/base'"
    ]


def test_joints_are_found_by_name_in_any_order() -> None:
    swapped = pack_joints(["m1_q2", "m1_q1"], [2.0, 1.0])
    with_another = pack_joints(["other", "q2", "q1"], [9.0, 2.0, 1.0])
    assert read_joint_target(NAMES, swapped) == [1.0, 2.0]
    assert read_joint_target(NAMES, with_another) == [1.0, 2.0]


@pytest.mark.parametrize(
    ("names", "angles", "said"),
    [
        (["m1_q1"], [1.0], "lacks m1_q2; the message has m1_q1"),
        ([], [], "lacks m1_q1, m1_q2; the message has no names"),
        (["q1", "q2"], [1.0, math.nan], "has a number that is not finite"),
        (["q1", "q2", "q1"], [1.0, 2.0, 3.0], "has q1 twice"),
    ],
)
def test_missing_and_non_finite_joints_are_named(
    names: list[str], angles: list[float], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        read_joint_target(NAMES, pack_joints(names, angles))


PAGES = "".join(
    find_page(page).read_text(encoding="utf-8") for page in ("ros2-topics.md", "ros2.md")
)
FILE = "".join(re.findall(r"```\n((?:joint_states = |\[sites\.s\]).*?)```", PAGES, re.DOTALL))
"""The examples of the pages."""


def test_the_table_of_topics_is_complete() -> None:
    page = find_page("ros2-topics.md").read_text(encoding="utf-8")
    section = page.partition("## Published")[2].partition("\n## ")[0]
    first_cells = re.findall(r"^\| (`.*?`) \|", section, re.MULTILINE)
    names = [name for cell in first_cells for name in re.findall(r"`([^`]*)`", cell)]
    listed = {name.rpartition("/")[2] for name in names}
    accepted = {name for name in TOPICS if name.startswith(("target_", "set_", "robot_"))}
    published = set(TOPICS) - accepted | {"robot_description", FRAMES_TOPIC, DIAGNOSTICS}
    assert listed == published | {"events", "log", "sent_..."}


def test_topics_have_the_names_in_a_file(tmp_path: Path) -> None:
    (tmp_path / "names.toml").write_text(FILE)
    table = TopicTable.read(str(tmp_path / "names.toml"))
    assert table.find("play", "m1", "joint_states") == "play/m1/arm/joint_states"
    assert table.find("play", "m1", "target_pose") == "m1/goal"
    assert table.find("play", "s", "robot_states") == "joint_states"
    assert table.find("play", "m1", "robot_states") == "play/m1/robot/joint_states"
    assert table.robots == {
        "s": RobotTable(["shoulder", "elbow"], ["elbow", "shoulder"], [0.0, 0.0]),
        "m1": RobotTable(),
    }
    assert TopicTable.read("crtk").find("play", "s", "target_pose") == "play/s/servo_cp"
    assert TopicTable.read("crisp").find("play", "s", "target_pose") == "play/s/target_pose"


@pytest.mark.parametrize("site", ["m", "nobody"])
def test_a_site_without_external_arm_takes_no_robot(tmp_path: Path, site: str) -> None:
    (tmp_path / "names.toml").write_text(
        FILE.replace("sites.s", f"sites.{site}").replace("sites.m1", "sites.s")
    )
    scenario = load_scenario(str(Path(__file__).parents[4] / "examples" / "external_arm.toml"))
    with pytest.raises(
        UsageError,
        match=rf"sites\.{site}: no site of this name has an external arm; sites with an external arm: s",
    ):
        TopicTable.read(str(tmp_path / "names.toml")).refuse_other_robots(scenario)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_robots_have_as_many_joints_as_arms(count: int) -> None:
    """A table of names with too few or too many joints is refused before anything moves."""
    scenario = load_scenario(str(Path(__file__).parents[4] / "examples" / "external_arm.toml"))
    robot = RobotTable(joints=["shoulder", "elbow", "wrist"][:count])
    table = TopicTable.read("crisp")._replace(robots={"s": robot})
    if count == 2:
        table.refuse_other_robots(scenario)
        return
    with pytest.raises(UsageError, match=rf"sites\.s\.joints has {count} name.* has 2 joints"):
        table.refuse_other_robots(scenario)


def test_reasons_of_strangers_are_counted_but_not_kept() -> None:
    said: list[str] = []
    refusals = Refusals(said.append)
    for n in range(1000):
        refusals.add(f"reason {n}")
    assert refusals.counts.total() == 1000
    assert len(said) == len(refusals.counts) == 65


class Topic(list[bytes]):
    """A topic with a subscriber, and the messages published on it."""

    has_subscribers = True
    put = list.append


class Listener:
    """A graph in which every topic has a subscriber and nobody publishes."""

    connected = True

    def __init__(self) -> None:
        self.published: dict[str, Topic] = defaultdict(Topic)
        self.refusals = Refusals(print)
        self.served: list[str] = []
        self.offered: dict[str, tuple[str, bool]] = {}

    def subscribe(self, *_: object) -> None:
        pass

    def serve(self, service: str, _kind: str, _answer: object) -> None:
        self.served.append(service)

    def publisher(self, topic: str, kind: str, qos: QualityOfService) -> Topic:
        self.offered[topic] = kind, qos.latched
        return self.published[topic]


Pose = tuple[Any, Rotation]
"""A position in m, and a rotation."""


def read_pose(position: Any, orientation: Any) -> Pose:
    """Returns the pose that a message has in its fields."""
    rotation = Rotation.from_quat([orientation.x, orientation.y, orientation.z, orientation.w])
    return np.array([position.x, position.y, position.z]), rotation


def compose(outer: Pose, inner: Pose) -> Pose:
    """Returns a pose in the frame of another pose, as a pose in that pose's frame."""
    position, rotation = outer
    inner_position, inner_rotation = inner
    return position + rotation.apply(inner_position), rotation * inner_rotation


def place_frames(transforms: Any, site: str) -> list[Pose]:
    """Returns the poses of a site's frames and of the root in the root's frame."""
    poses = {"world": (np.zeros(3), Rotation.identity())}
    for message in transforms:
        pose = read_pose(message.transform.translation, message.transform.rotation)
        poses[message.child_frame_id] = compose(poses[message.header.frame_id], pose)
    return [
        pose for name, pose in poses.items() if name == "world" or name.startswith(f"{site}/")
    ]


@pytest.mark.parametrize(
    "name",
    [
        "paper",
        "six_joints",
        "unlike_arms",
        "wall_in_space",
        pytest.param(posed_task_text(), id="posed"),
    ],
)
def test_transforms_hold_the_pose_of_the_tip(name: str) -> None:
    """The pose of the end effector is that of one of the published frames."""
    log = trilat_net.simulate(name, {"duration_s": 0.3})
    for site in log.sites:
        graph = Listener()
        ends: Any = BridgeEnds(graph, None, None, "t", TopicTable.read("crisp"))  # type: ignore[arg-type]
        site_topics = SiteTopics(ends, log.scenario, site, 0, graph.published["tf"])  # type: ignore[arg-type]
        site_topics.publish(log[site].states[-1], 1000.0)
        messages = [
            ROS.deserialize_cdr(data, "tf2_msgs/msg/TFMessage")
            for data in graph.published["tf"]
        ]
        transforms = [transform for message in messages for transform in message.transforms]
        tip = ROS.deserialize_cdr(
            graph.published[f"t/{site}/tip_pose"][-1], "geometry_msgs/msg/PoseStamped"
        )
        base = next(
            message.transform
            for message in transforms
            if message.child_frame_id == tip.header.frame_id
        )
        tip_position, tip_rotation = compose(
            read_pose(base.translation, base.rotation),
            read_pose(tip.pose.position, tip.pose.orientation),
        )
        distances = []
        for position, rotation in place_frames(transforms, site):
            angle_rad = (rotation.inv() * tip_rotation).magnitude()
            distances.append(max(np.abs(position - tip_position).max(), angle_rad))
        assert min(distances) < 1e-7


def pack_shares(*numbers: float) -> bytes:
    """Returns a message with numbers as rosbags encodes them."""
    array = ROS.types["std_msgs/msg/Float64MultiArray"]
    layout = ROS.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return bytes(
        ROS.serialize_cdr(
            array(layout=layout, data=np.array(numbers)), "std_msgs/msg/Float64MultiArray"
        )
    )


def test_shares_are_requested_once_and_refusals_are_reported() -> None:
    requests: list[dict[str, float]] = []
    said: list[str] = []

    def change(wanted: dict[str, float]) -> None:
        requests.append(wanted)
        if sum(wanted.values()) != 1.0:
            raise RunFailed("must sum to 1")

    refusals = Refusals(said.append)
    clock = ManualClock()
    topic = DominanceTopic(["m1", "m2"], change, clock)
    receive_shares = refusals.guard("t/s/set_dominance", topic.receive)
    send_shares = refusals.guard("t/s/set_dominance", topic.send_request)
    for data in (
        pack_shares(0.9, 0.1),
        pack_shares(0.9, 0.1),
        pack_shares(0.5, 0.1),
        pack_shares(1.0),
        pack_shares(math.nan, 0.0),
        b"x",
    ):
        receive_shares(data, FIRST)
        send_shares()
        send_shares()
    assert requests == [{"m1": 0.9, "m2": 0.1}, {"m1": 0.5, "m2": 0.1}]
    assert said == [
        "refused: t/s/set_dominance must sum to 1",
        "refused: t/s/set_dominance has 1 number, but needs one weight for each peer: m1, m2",
        "refused: t/s/set_dominance has a number that is not finite",
        "refused: t/s/set_dominance is not encoded as plain little-endian CDR",
    ]
    # whoever asks for the same later may have been overruled meanwhile
    clock.sleep_until(2 * SENDER_TIMEOUT_NS)
    receive_shares(pack_shares(0.5, 0.1), FIRST)
    send_shares()
    assert requests[2:] == [{"m1": 0.5, "m2": 0.1}]


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(0, 30), st.floats(0.0, 1.0)), max_size=5)
)
def test_shares_are_those_that_the_certificate_sees(
    changes: list[tuple[int, int, float]],
) -> None:
    """The history of shares that a live session shows is the history that a certificate reads."""
    scenario = load_scenario("paper")
    history = ShareHistory(scenario, "s")
    ramps = []
    for start, lasts, share in changes:
        to = {"m1": share, "m2": 1.0 - share}
        at_s = start / 10.0
        ramp_s = lasts / 10.0
        history.add_change(
            json.dumps({"at_s": at_s, "dominance": "s", "to": to, "ramp_s": ramp_s})
        )
        history.add_change("{}")
        ramps.append(scenario.ramp("s", to, round(at_s * 1e9), ramp_s))
    if len({ramp.start_ns for ramp in ramps}) == len(ramps):
        t_s = np.arange(100) / 10.0
        plan = DominancePlan.of_scenario(scenario, "s")
        plan.ramps.extend(ramps)
        planned = plan.evaluate(t_s).alpha
        np.testing.assert_allclose(
            [history.advance_to(round(t * 1e9)) for t in t_s], planned, atol=1e-9
        )


def test_shares_that_change_at_10_hz_are_shown() -> None:
    history = ShareHistory(load_scenario("paper"), "s")
    for n in range(3_600):
        to = {"m1": 0.25, "m2": 0.75} if n % 2 else {"m1": 0.75, "m2": 0.25}
        history.add_change(
            json.dumps({"at_s": n / 10.0, "dominance": "s", "to": to, "ramp_s": 1.0})
        )
        assert sum(history.advance_to(n * 10**8)) == pytest.approx(1.0)
    assert history.advance_to(370 * 10**9) == (0.25, 0.75)


class Robot:
    """A robot whose controller orders joints otherwise than the scenario, its site, and the
    bridge between them.
    """

    def __init__(self, controller: Sequence[str] = ("elbow", "shoulder")) -> None:
        network = LocalNetwork()
        site = network.join()
        bridge = network.join()
        self.clock = ManualClock(10**9)
        self.said: list[str] = []
        self.refusals = Refusals(self.said.append)
        self._measured = site.inbox(topics.key("t", "s", topics.MEASURED))
        self._state = site.publisher(topics.key("t", "s", topics.STATE))
        self.commands = Topic()
        self.arm = RobotArm(
            lambda: ArmClient(bridge, self.clock, "t", "s"),
            [("shoulder",), ("elbow",)],
            RobotTable(controller=list(controller), safe=[0.5, -0.5]),
            self.commands,  # type: ignore[arg-type]
            self.clock,
        )
        self.arm.armed = True
        self.take = self.refusals.guard("joint_states", self.arm.receive)

    def publish_joints(
        self,
        names: Sequence[str],
        q: Sequence[float],
        qd: Sequence[float],
        sender: Attachment = FIRST,
        stamp_ns: int = 7,
    ) -> None:
        self.take(
            cdr.JointStatePacker(names, velocity=bool(qd), effort=False).pack(stamp_ns, q, qd),
            sender,
        )

    def read_measurements(self) -> list[ArmMeasurement]:
        """Returns the measurements that the site has received since the last call."""
        return [decode(payload, ArmMeasurement) for _, payload in drained(self._measured)]

    def publish_tick(
        self, k: int, *tau: float, mode: Mode = Mode.RUN, since_ns: int = 0
    ) -> None:
        """Publishes a record of the site with these torques, in N m."""
        zeros = [0.0, 0.0]
        record = TickRecord(
            k,
            k * 10**6,
            mode,
            q=zeros,
            qd=zeros,
            q_des=zeros,
            qd_des=zeros,
            tau=list(tau),
            tau_x=zeros,
            theta_hat=[],
            used=[-1],
            rx_crc=0,
            cmd=[],
            mem=[0.0, 0.0, float(since_ns)],
        )
        self._state(encode_state("s", 1, ["m"], record, (), 0, 0))

    def read_commands(self, after_ns: int = 0) -> list[list[float]]:
        """Returns the commands that the robot gets after some time."""
        self.clock.sleep_until(self.clock.monotonic_ns() + after_ns)
        self.commands.clear()
        self.arm.send_command()
        messages = [
            ROS.deserialize_cdr(data, "std_msgs/msg/Float64MultiArray")
            for data in self.commands
        ]
        return [message.data.tolist() for message in messages]


def test_joint_states_are_measurements_of_the_site() -> None:
    """Joints are found by their names, and messages without these joints are ignored."""
    robot = Robot()
    of_another_clock = 1_790_000_000 * 10**9
    robot.publish_joints(
        ["gripper", "elbow", "shoulder"],
        [9.0, 2.0, 1.0],
        [8.0, 4.0, 3.0],
        stamp_ns=of_another_clock,
    )
    robot.publish_joints(["shoulder", "elbow"], [1.5, 2.5], [0.0, 0.0], stamp_ns=0)
    robot.publish_joints(["wheel"], [7.0], [7.0])  # another robot on the same topic
    first, second = robot.read_measurements()
    assert first.q == [1.0, 2.0]
    assert first.qd == [3.0, 4.0]
    assert first.sent_ns == of_another_clock
    assert second.q == [1.5, 2.5]
    assert second.n == 1
    assert second.sent_ns == 0
    assert not robot.said


def test_silent_robots_are_named_once_then_rarely() -> None:
    """A notice names the topic and what is missing, and a measurement ends the notices."""
    robot = Robot()

    def hear(after_ns: int) -> str:
        robot.clock.sleep_until(robot.clock.monotonic_ns() + after_ns)
        return robot.arm.silence.pop("/joint_states", "s")

    assert not hear(FIRST_NOTICE_NS - 1)
    assert hear(1) == "no message on /joint_states yet: s waits for its arm"
    robot.publish_joints(["wheel"], [7.0], [7.0])
    assert not hear(NEXT_NOTICE_NS - 1)
    assert hear(1) == (
        "no measurement on /joint_states yet: s waits for its arm with shoulder, elbow; a "
        "message has wheel"
    )
    for _ in range(3):
        robot.publish_joints(["shoulder", "elbow"], [1.0, 2.0], [0.0, 0.0])
        assert not hear(FIRST_NOTICE_NS - 1)
    assert hear(1) == "no further measurement on /joint_states: s has lost its arm"
    assert not hear(NEXT_NOTICE_NS - 1)


@pytest.mark.parametrize(
    ("names", "q", "qd", "said"),
    [
        (["shoulder"], [1.0], [0.0], "lacks elbow; the message has shoulder"),
        ([], [], [], "lacks shoulder, elbow; the message has no names"),
        (["shoulder", "elbow"], [1.0, math.nan], [0.0, 0.0], "has a number that is not finite"),
        (["shoulder", "elbow"], [1.0, 2.0], [0.0, math.inf], "has a number that is not finite"),
        (["shoulder", "elbow"], [1.0, 2.0], [], "has 2 positions and 0 velocities"),
        (["shoulder", "elbow", "elbow"], [1.0, 2.0, 3.0], [0.0] * 3, "has elbow twice"),
    ],
)
def test_joint_states_that_measure_no_arm_are_named(
    names: list[str], q: list[float], qd: list[float], said: str
) -> None:
    robot = Robot()
    robot.publish_joints(names, q, qd)
    assert robot.read_measurements() == []
    assert robot.said == [f"refused: joint_states {said}"]


def test_two_robots_on_one_topic_measure_nothing() -> None:
    robot = Robot()
    pose = (["shoulder", "elbow"], [1.0, 2.0], [0.0, 0.0])
    robot.publish_joints(*pose)
    robot.publish_joints(*pose, sender=SECOND)
    robot.publish_joints(*pose)
    assert len(robot.read_measurements()) == 1
    robot.clock.sleep_until(robot.clock.monotonic_ns() + SENDER_TIMEOUT_NS)
    robot.publish_joints(*pose)
    assert len(robot.read_measurements()) == 1
    assert robot.said == [
        "refused: joint_states has two publishers: the messages of both are refused until one of them is silent"
    ]


@given(st.binary(max_size=120) | st.binary(max_size=120).map(lambda rest: b"\0\1\0\0" + rest))
def test_any_request_for_shares_is_taken_or_counted(data: bytes) -> None:
    """Any bytes either give a request with finite shares or count as one refusal."""
    refusals = Refusals(lambda _: None)
    requests: list[dict[str, float]] = []
    topic = DominanceTopic(["m1"], requests.append, ManualClock())
    refusals.guard("set_dominance", topic.receive)(data, FIRST)
    topic.send_request()
    assert len(requests) + refusals.counts.total() == 1
    for shares in requests:
        assert all(map(math.isfinite, shares.values()))


@given(st.binary(max_size=120) | st.binary(max_size=120).map(lambda rest: b"\0\1\0\0" + rest))
def test_any_target_of_joints_is_taken_or_counted(data: bytes) -> None:
    """Any bytes either give finite angles or count as one refusal."""
    refusals = Refusals(lambda _: None)
    targets_rad: list[list[float]] = []
    refusals.guard("target", lambda: targets_rad.append(read_joint_target(NAMES, data)))()
    assert len(targets_rad) + refusals.counts.total() == 1
    for target_rad in targets_rad:
        assert all(map(math.isfinite, target_rad))


@given(st.binary(max_size=120).map(lambda rest: b"\0\1\0\0" + rest))
def test_any_message_of_a_robot_is_counted_somewhere(data: bytes) -> None:
    robot = Robot()
    robot.take(data, FIRST)
    assert len(robot.read_measurements()) + robot.refusals.counts.total() <= 1


def test_a_robot_gets_each_torque_once_in_order() -> None:
    robot = Robot()
    robot.publish_tick(0, 3.0, 4.0)
    assert robot.read_commands() == [[4.0, 3.0]]
    assert robot.read_commands() == []
    robot.publish_tick(1, 5.0, 6.0)
    robot.publish_tick(2, 7.0, 8.0)
    assert robot.read_commands(2_000_000) == [[8.0, 7.0]]


def test_a_robot_without_torque_gets_the_safe_command() -> None:
    robot = Robot()
    safe = [[0.5, -0.5]]
    assert robot.read_commands() == safe  # the site has made no tick
    assert robot.read_commands(SAFE_PERIOD_NS - 1) == []
    robot.publish_tick(0, 3.0, 4.0)
    assert robot.read_commands(SAFE_PERIOD_NS) == [[4.0, 3.0]]
    assert robot.read_commands(FRESH_NS + 1) == safe  # it is silent
    robot.publish_tick(200, 3.0, 4.0, mode=Mode.FAULT, since_ns=50 * 10**6)
    assert robot.read_commands(SAFE_PERIOD_NS) == safe  # its arm has come to rest
    robot.publish_tick(201, 3.0, 4.0)
    robot.arm.armed = False
    assert robot.read_commands(SAFE_PERIOD_NS) == safe


@pytest.mark.parametrize(
    "controller", [["elbow"], ["elbow", "wrist"], ["elbow", "shoulder", "wrist"]]
)
def test_a_controller_of_other_joints_is_refused(controller: list[str]) -> None:
    with pytest.raises(UsageError, match=r"one entry for every joint \(shoulder, elbow\)"):
        Robot(controller)


class Sites:
    """The sites of a session: their identities, notes and records, and a bridge that shows them."""

    def __init__(
        self, noted: Sequence[Event], scenario: str = "paper", session: str = "t"
    ) -> None:
        network = LocalNetwork()
        bus = network.join()
        self._scenario = load_scenario(scenario)
        self.session = session
        self._info = b""
        past = {
            "channel": "event",
            "first": 0,
            "payloads": [*map(encode, noted)],
            "made": len(noted),
        }
        for site in self._scenario.names:
            bus.announce(topics.presence_token(session, site, 1))
            bus.respond(topics.key(session, site, topics.INFO), lambda _: self._info)
            kept = encode(Backfill(member=site, boot=1, **past))
            bus.respond(topics.key(session, site, topics.PAST), lambda _, kept=kept: kept)
        self._state = bus.publisher(topics.key(session, "s", topics.STATE))
        self._event = bus.publisher(topics.key(session, "s", topics.EVENT))
        self.graph = Listener()
        self.is_replaced: list[bool] = []
        self.said: list[str] = []
        self._ends: Any = BridgeEnds(
            self.graph, network.join(), SystemClock(), session, TopicTable.read("crisp")
        )  # type: ignore[arg-type]

    def begin(self, epoch_unix_ns: int) -> None:
        """Begins a session at an epoch."""
        description = describe_member(
            "s",
            1,
            SystemClock(),
            "0",
            self._scenario.text,
            running=True,
            epoch_unix_ns=epoch_unix_ns,
        )
        self._info = encode(description)
        self._event(encode(make_event("epoch", epoch_unix_ns=epoch_unix_ns)))

    def publish_tick(self, k: int) -> None:
        """Publishes a record of the slave at rest."""
        zeros = [0.0, 0.0]
        peers = self._scenario.peers("s")
        record = TickRecord(
            k,
            k * 10**6,
            Mode.RUN,
            q=zeros,
            qd=zeros,
            q_des=zeros,
            qd_des=zeros,
            tau=zeros,
            tau_x=zeros,
            theta_hat=[0.0] * 5,
            used=[-1] * len(peers),
            rx_crc=0,
            cmd=[],
            mem=[],
        )
        self._state(encode_state("s", 1, peers, record, (), 0, 0))

    @contextmanager
    def run_bridge(self, rviz: Path | None = None) -> Iterator[threading.Thread]:
        """Runs a bridge that shows the session, from its first message on."""
        over = threading.Event()

        def show() -> None:
            is_replaced = publish_session(
                self._ends, 100.0, over.is_set, self.said.append, rviz
            )
            self.is_replaced.append(is_replaced)

        bridge = threading.Thread(target=show)
        self.graph.published.clear()  # before the bridge takes its topics from it
        bridge.start()
        until(self._has_shown_a_tick)
        yield bridge
        over.set()
        bridge.join()

    def _has_shown_a_tick(self) -> bool:
        """Publishes a record, and returns True if the bridge has published one."""
        self.publish_tick(7)
        return bool(self.graph.published[f"{self.session}/s/joint_states"])

    def list_stamps_s(self) -> set[int]:
        """Returns the stamps that were shown, in seconds."""
        states = [
            ROS.deserialize_cdr(data, "sensor_msgs/msg/JointState")
            for data in self.graph.published["t/s/joint_states"]
        ]
        return {message.header.stamp.sec for message in states}


def make_event(kind: str, **fields: Any) -> Event:
    """Returns an event of the slave."""
    return Event(member="s", boot=1, kind=kind, text="", **fields)


def test_a_new_session_is_shown_with_its_epoch() -> None:
    sites = Sites([])
    sites.begin(10**18)
    with sites.run_bridge() as bridge:
        sites.begin(10**18)  # another attempt of its own
        assert sites.list_stamps_s() == {10**9}
        sites.begin(2 * 10**18)
        bridge.join(20.0)
        assert sites.is_replaced == [True]
    with sites.run_bridge():
        assert sites.list_stamps_s() == {2 * 10**9}
    assert sites.is_replaced == [True, False]
    texts = ["waiting for session 't' to begin", "session t is in the graph of ROS 2: /t/..."]
    assert sites.said == texts * 2


def test_earlier_changes_of_shares_are_shown() -> None:
    change = '{"at_s": 0.001, "dominance": "s", "to": {"m1": 0.75, "m2": 0.25}}'
    sites = Sites(
        [
            make_event("setup"),
            make_event("change", command="none"),
            make_event("change", command=change),
        ]
    )
    sites.begin(10**18)
    with sites.run_bridge():
        (data,) = until(lambda: sites.graph.published["t/s/dominance"])
        message = ROS.deserialize_cdr(data, "std_msgs/msg/Float64MultiArray")
        assert message.data.tolist() == [0.75, 0.25]
        assert {"t/stop", "t/s/stop", "t/m1/reset", "t/end"} <= set(sites.graph.served)


def list_bag(path: Path) -> dict[str, tuple[str, bool]]:
    """Returns, for every topic of a bag as rosbags reads it, the type and whether the topic is latched."""
    with Reader(path) as bag:
        return {
            connection.topic.removeprefix("/"): (
                connection.msgtype,
                connection.ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL",  # type: ignore[union-attr]
            )
            for connection in bag.connections
        }


def test_bags_have_the_topics_of_live_bridges(tmp_path: Path) -> None:
    bag = list_bag(write_standard_files(tmp_path)["bag"])
    sites = Sites([], "two_sites", "lab")
    sites.begin(10**18)
    with sites.run_bridge():
        live = dict(sites.graph.offered)
    assert bag == live
    assert {
        "tf",
        "diagnostics",
        "lab/s/robot_description",
        "lab/m/tip_pose",
        "lab/log",
    } <= bag.keys()


@pytest.mark.parametrize("name", ["six_joints", "wall_in_space", "box", "handover"])
@pytest.mark.parametrize("naming", ["crisp", "crtk"])
def test_bags_of_other_scenarios_share_no_topics(
    tmp_path: Path, name: str, naming: str
) -> None:
    log = trilat_net.simulate(name, {"duration_s": 0.02})
    trilat_net.export(log, "ros2", tmp_path / "bag.mcap", names=naming)
    graph = Listener()
    table = TopicTable.read(naming)
    ends: Any = BridgeEnds(graph, None, None, name, table)  # type: ignore[arg-type]
    for site in log.sites:
        SiteTopics(ends, log.scenario, site, 0, graph.published["tf"])  # type: ignore[arg-type]
    topics = Ros2Topics.of_session(log.scenario, name, table)
    planned = {topic.removeprefix("/"): channel for topic, channel in topics.items()}
    assert {
        topic: offer for topic, offer in graph.offered.items() if topic in planned
    } == graph.offered
    bag = list_bag(tmp_path / "bag.mcap")
    assert bag == {topic: (planned[topic].kind, planned[topic].latched) for topic in bag}
    assert (
        graph.offered.items()
        >= {topic: bag[topic] for topic in bag if topic in graph.offered}.items()
    )
    missing = {topic.rpartition("/")[2] for topic in planned.keys() - bag.keys()}
    # of live sessions alone
    assert missing <= {
        "link_delay",
        "link_offset",
        "timing",
        "events",
        "log",
    }


RVIZ_TYPES = {
    "rviz_default_plugins/RobotModel": "std_msgs/msg/String",
    "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
}
"""By class of a display the type of the messages that it shows."""


def list_rviz_topics(config: Path) -> dict[str, tuple[str, bool]]:
    """Returns, for every topic of an RViz configuration, the type and whether the topic must be latched."""
    manager = YAML(typ="safe").load(config)["Visualization Manager"]
    types = {}
    for display in manager["Displays"]:
        topic = display.get("Topic") or display.get("Description Topic")
        if topic is None:
            assert display["Class"] in ("rviz_default_plugins/Grid", "rviz_default_plugins/TF")
            continue
        latched = topic["Durability Policy"] == "Transient Local"
        assert topic["Value"].startswith("/")
        types[topic["Value"][1:]] = RVIZ_TYPES[display["Class"]], latched
    return types


@pytest.mark.parametrize(
    "name", ["paper", "play", "six_joints", "unlike_arms", "wall_in_space"]
)
@pytest.mark.parametrize("naming", ["crisp", "crtk"])
def test_rviz_has_the_topics_of_the_live_bridge(tmp_path: Path, name: str, naming: str) -> None:
    scenario = load_scenario(name)
    graph = Listener()
    ends: Any = BridgeEnds(graph, None, None, name, TopicTable.read(naming))  # type: ignore[arg-type]
    for site in scenario.names:
        SiteTopics(ends, scenario, site, 0, graph.published["tf"])  # type: ignore[arg-type]
    config = tmp_path / "view.rviz"
    ends.write_rviz_config(scenario, config)
    types = list_rviz_topics(config)
    assert types.items() <= graph.offered.items()
    poses = {topic for topic, (kind, _) in graph.offered.items() if kind == cdr.POSE}
    arms = {f"{name}/{site}/robot_description" for site in scenario.names}
    assert types.keys() == poses | arms


def test_the_fixed_frame_of_rviz_is_the_root(tmp_path: Path) -> None:
    log = trilat_net.simulate("two_sites", {"duration_s": 0.02})
    trilat_net.view(log.save(tmp_path / "run.mcap"), rviz=True)
    config = YAML(typ="safe").load(tmp_path / "run.rviz")
    fixed = config["Visualization Manager"]["Global Options"]["Fixed Frame"]
    for site in log.sites:
        assert RobotModel(log.scenario, site).frames[0][0] == fixed


def test_a_bag_and_a_log_share_one_view(tmp_path: Path) -> None:
    log = trilat_net.simulate("two_sites", {"duration_s": 0.02})
    file = log.save(tmp_path / "run.mcap")
    bag = trilat_net.export(log, "ros2", tmp_path / "bag.mcap")
    for path in (file, bag):
        trilat_net.view(path, rviz=True)
    types = list_rviz_topics(tmp_path / "run.rviz")
    assert types == list_rviz_topics(tmp_path / "bag.rviz")
    assert types.items() <= list_bag(bag).items()
    with pytest.raises(UsageError, match="already exists"):
        trilat_net.view(bag, rviz=True)


def test_the_bridge_writes_the_frames_rviz_shows(tmp_path: Path) -> None:
    config = tmp_path / "view.rviz"
    sites = Sites([], "two_sites", "lab")
    sites.begin(10**18)
    with sites.run_bridge(config):
        until(config.is_file)
        offered = dict(sites.graph.offered)
    assert list_rviz_topics(config).items() <= offered.items()
