"""A session in the graph of ROS 2: a stranger that knows the wire form alone leads an arm, and is one."""

import json
import signal
import struct
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore

import trilat_net as tn
from tests.live.processes import assert_executed_again, connection_options, open_whole_log
from tests.net.free_endpoints import find_free_endpoints
from tests.net.waiting import until

from .processes import OUTSIDE, PAPER, Session, Stage, assert_let_go, pause

ROS = get_typestore(Stores.ROS2_JAZZY)
TRIGGER = "std_srvs::srv::dds_::Trigger_/RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"


SLOWER = ("--set", "rate_hz=250")
"""So that a machine with other work keeps up; what a bridge costs at 1 kHz is in `benchmarks/ros2.py`."""


class Stranger:
    """The side of ROS, written from the design of rmw_zenoh alone: CDR is that of rosbags."""

    def __init__(self, router: str, name: bytes = b"stranger") -> None:
        settings = {
            "mode": "client",
            "connect": {"endpoints": [router]},
            "scouting": {"multicast": {"enabled": False}},
        }
        self._session: Any = zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))
        self._gid = name.ljust(16)
        self._sent = 0
        self.heard: dict[str, list[tuple[bytes, bytes]]] = defaultdict(list)
        self._kept = [self._session.declare_subscriber("0/**", self._hear)]

    def _hear(self, sample: Any) -> None:
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
        self.heard["/".join(str(sample.key_expr).split("/")[1:-2])].append(
            (sample.payload.to_bytes(), attachment)
        )

    def _attachment(self) -> bytes:
        self._sent += 1
        return struct.pack("<qqB16s", self._sent, time.time_ns(), 16, self._gid)

    def tokens(self) -> list[str]:
        return [
            str(reply.ok.key_expr) for reply in self._session.liveliness().get("@ros2_lv/0/**")
        ]

    def publish(self, topic: str, kind: str, message: Any) -> None:
        dds = kind.replace("/msg/", "::msg::dds_::") + "_"
        data = bytes(ROS.serialize_cdr(message, kind))
        key = f"0/{topic}/{dds}/{ROS.hash_rihs01(kind)}"
        self._session.put(key, data, attachment=self._attachment())

    def call(self, service: str) -> tuple[bool, str]:
        replies = self._session.get(
            f"0/{service}/{TRIGGER}",
            target=zenoh.QueryTarget.ALL_COMPLETE,
            payload=b"\0\1\0\0\0",
            attachment=self._attachment(),
            timeout=10.0,
        )
        (reply,) = list(replies)
        assert reply.ok.attachment.to_bytes()[17:] == self._gid
        data = reply.ok.payload.to_bytes()
        (length,) = struct.unpack_from("<I", data, 8)
        return bool(data[4]), data[12 : 12 + length - 1].decode()

    def newest(self, topic: str, kind: str) -> Any:
        until(lambda: bool(self.heard[topic]), 20.0)
        return ROS.deserialize_cdr(self.heard[topic][-1][0], kind)

    def latched(self, topic: str, kind: str) -> Any:
        """The last message of a topic that was published before this subscription."""
        payloads: list[bytes] = []
        late = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        subscriber = zenoh.ext.declare_advanced_subscriber(
            self._session,
            f"0/{topic}/**",
            lambda sample: payloads.append(sample.payload.to_bytes()),
            history=late,
        )
        until(lambda: bool(payloads), 20.0)
        subscriber.undeclare()
        return ROS.deserialize_cdr(payloads[-1], kind)

    def close(self) -> None:
        self._session.close()


def make_pose_message(x: float, y: float) -> Any:
    types = ROS.types
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    turn = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    where = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0), turn
    )
    return types["geometry_msgs/msg/PoseStamped"](
        types["std_msgs/msg/Header"](stamp, "m1/base"), where
    )


def joint_state(names: Sequence[str], q: Sequence[float], qd: Sequence[float]) -> Any:
    """Returns the joint state of a robot whose clock began with the robot."""
    types = ROS.types
    seconds = time.monotonic_ns()
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds // 10**9, nanosec=seconds % 10**9)
    numbers = (np.array(vector) for vector in (q, qd, [0.0] * len(q)))
    return types["sensor_msgs/msg/JointState"](
        types["std_msgs/msg/Header"](stamp, ""), [*names], *numbers
    )


def make_shares_message(*numbers: float) -> Any:
    layout = ROS.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    return ROS.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(numbers))


@contextmanager
def bridged_session(stage: Stage, duration_s: int) -> Iterator[tuple[Session, Any, Stranger]]:
    """A session whose arms people can hold, its bridge, and a stranger behind a router."""
    (router,) = find_free_endpoints(1)
    running = stage.start("router", "router", "--listen", router)
    session = Session(stage, "play", PAPER, "--duration", str(duration_s), *SLOWER)
    session.all()
    session.begun()
    bridge = stage.start(
        "ros2",
        "ros2",
        "--session",
        "t",
        "--ros",
        router,
        *connection_options(session.endpoints),
    )
    bridge.prints("is in the graph of ROS 2")
    stranger = Stranger(router)
    try:
        yield session, bridge, stranger
    finally:
        stranger.close()
        running.end()


@pytest.mark.long
def test_strangers_lead_and_stop_arms_and_verify(stage: Stage) -> None:
    with bridged_session(stage, 25) as (session, bridge, ros):
        start = ros.newest("t/m1/tip_pose", "geometry_msgs/msg/PoseStamped").pose.position
        for n in range(150):
            goal = make_pose_message(start.x - 0.15 * min(1.0, n / 60.0), start.y)
            ros.publish("t/m1/target_pose", "geometry_msgs/msg/PoseStamped", goal)
            pause(1.0 / 60.0)
        tip = ros.newest("t/m1/tip_pose", "geometry_msgs/msg/PoseStamped").pose.position
        assert tip.x - start.x == pytest.approx(-0.15, abs=0.05)
        ros.publish(
            "t/s/set_dominance", "std_msgs/msg/Float64MultiArray", make_shares_message(0.9, 0.1)
        )
        assert ros.call("t/s/stop")[0]
        assert ros.call("t/s/reset") == (
            False,
            "s is in mode stopped; reset is possible only in mode fault",
        )
        until(lambda: ros.newest("t/s/mode", "std_msgs/msg/String").data == "stopped", 20.0)
        assert ros.call("t/s/enable")[0]
        kinds = {"joint_states": "MP", "target_pose": "MS", "stop": "SS"}
        tokens = ros.tokens()
        for name, kind in kinds.items():
            assert any(f"/{kind}/%/%t/trilat/%t%m1%{name}/" in token for token in tokens)
        log = session.is_reproduced()
        assert bridge.code() == 0
        for states, attachment in ros.heard["t/m2/joint_states"][-50:]:
            assert len(attachment) == 33
            joint_state = ROS.deserialize_cdr(states, "sensor_msgs/msg/JointState")
            stamp_ns = joint_state.header.stamp.sec * 10**9 + joint_state.header.stamp.nanosec
            row = (stamp_ns - int(log.session["epoch_unix_ns"])) * log["m2"].rate_hz // 10**9
            assert joint_state.position.tolist() == log["m2"].q[row].tolist()
            assert joint_state.effort.tolist() == log["m2"].tau[row].tolist()
        assert np.abs(log["m1"].tau_x).max() > 1.0
        changes = [json.loads(text) for state in log["s"].states for text in state.cmd]
        assert [change["to"] for change in changes if "dominance" in change] == [
            {"m1": 0.9, "m2": 0.1}
        ]
        published_shares = [
            ROS.deserialize_cdr(data, "std_msgs/msg/Float64MultiArray").data.tolist()
            for data, _ in ros.heard["t/s/dominance"]
        ]
        assert published_shares[-1] == [0.9, 0.1]
        assert all(
            0.0 < first < 0.9 for first, _ in published_shares[:-1]
        )  # on its ramp, and before


@pytest.mark.long
def test_a_killed_bridge_leaves_no_force(stage: Stage) -> None:
    with bridged_session(stage, 15) as (session, bridge, ros):
        start = ros.newest("t/m1/tip_pose", "geometry_msgs/msg/PoseStamped").pose.position
        for _ in range(60):
            ros.publish(
                "t/m1/target_pose",
                "geometry_msgs/msg/PoseStamped",
                make_pose_message(start.x - 0.1, start.y),
            )
            pause(1.0 / 60.0)
        bridge.signal(signal.SIGKILL)
        log = session.is_reproduced()
    assert_let_go(log, "ros2")


@pytest.mark.long
def test_late_routers_are_joined_and_latecomers_see(stage: Stage) -> None:
    (router,) = find_free_endpoints(1)
    session = Session(stage, "play", PAPER, "--duration", "120", *SLOWER)
    session.all()
    session.begun()
    bridge = stage.start(
        "ros2",
        "ros2",
        "--session",
        "t",
        "--ros",
        router,
        *connection_options(session.endpoints),
    )
    bridge.prints(f"no router of ROS answers at {router}: waiting for it")
    first = stage.start("router", "router", "--listen", router)
    bridge.prints("is in the graph of ROS 2")
    first.end()
    bridge.prints("the router of ROS is gone: waiting for it")
    stage.start("again", "router", "--listen", router)
    bridge.prints("the router of ROS is back")
    ros = Stranger(router)
    try:
        ros.newest("t/s/joint_states", "sensor_msgs/msg/JointState")
        text = ros.latched("t/s/robot_description", "std_msgs/msg/String").data
        assert [joint.get("name") for joint in ElementTree.fromstring(text).findall("joint")]
        discovery = pytest.importorskip(
            "zenoh_ros2_sdk.discovery", reason="make .venv/long.stamp installs it"
        )
        host, port = router.removeprefix("tcp/").split(":")
        seen = dict(discovery.get_topic_names_and_types(0, host, int(port), timeout=3.0))
        assert seen["/t/m1/joint_states"] == ["sensor_msgs/msg/JointState"]
        assert seen["/t/m2/target_pose"] == ["geometry_msgs/msg/PoseStamped"]
        services = dict(discovery.get_service_names_and_types(0, host, int(port), timeout=3.0))
        assert services["/t/end"] == ["std_srvs/srv/Trigger"]
        assert ros.call("t/end")[0]
        session.ends_well()
        assert_executed_again(open_whole_log(session.log, in_full=False))
        assert bridge.code() == 0
    finally:
        ros.close()


ROBOT = """
[sites.s]
robot_states = "/joint_states"
robot_commands = "/effort_controller/commands"
joints = ["shoulder", "elbow"]
controller = ["elbow", "shoulder"]
safe = [-0.25, 0.25]
"""
SAFE = [-0.25, 0.25]


@pytest.mark.long
def test_ros_robots_brake_when_their_site_is_silent(stage: Stage) -> None:
    (router,) = find_free_endpoints(1)
    running = stage.start("router", "router", "--listen", router)
    (stage.folder / "robot.toml").write_text(ROBOT)
    session = Session(stage, "two_sites", ("m", "s"), *OUTSIDE, "--duration", "8", *SLOWER)
    session.all()
    arguments = (
        "--session",
        "t",
        "--ros",
        router,
        "--names",
        "robot.toml",
        *connection_options(session.endpoints),
    )
    bridge = stage.start("ros2", "ros2", *arguments)
    running.prints("listening at")
    ros = Stranger(router)
    robot = tn.SimulatedArm(tn.load_scenario("two_sites"), "s")
    site = session.processes["s"]
    said = list[list[float]]()
    frozen = False
    robot.accelerate(np.zeros(2))  # compiles: a robot that has begun is never silent
    try:
        while not site.ended():
            said.append(robot.q.tolist())
            rows = [[row[1], 0.0, row[0]] for row in (robot.q, robot.qd)]
            state = joint_state(["elbow", "gripper", "shoulder"], *rows)
            ros.publish("joint_states", "sensor_msgs/msg/JointState", state)
            got = ros.heard["effort_controller/commands"]
            command = torques_of(got[-1][0]) if got else SAFE
            if command == SAFE:
                robot.qd[:] = 0.0  # its brakes
            else:
                robot.move(np.array(command[::-1]), 0.002)
            if not frozen and len(got) > 1000 and "session begins" in site.text():
                frozen = True
                site.signal(signal.SIGSTOP)
                until(lambda: list_torque_commands(ros)[-1] == SAFE)
                site.signal(signal.SIGCONT)
            pause(0.002)
        session.ends_well()
        assert bridge.code() == 0
        assert frozen
        assert list_torque_commands(ros)[-1] == SAFE
    finally:
        ros.close()
    log = open_whole_log(session.log)
    assert_executed_again(log)
    assert {tuple(q) for q in log["s"].q.tolist()} <= {tuple(q) for q in said}
    torques = {tuple(tau) for tau in log["s"].tau.tolist()}
    assert {(shoulder, elbow) for elbow, shoulder in list_torque_commands(ros)} - torques <= {
        (SAFE[1], SAFE[0])
    }
    assert abs(log["s"].q - log["s"].q[0]).max() > 0.01


def list_torque_commands(ros: Stranger) -> list[list[float]]:
    """All that the robot's controller got."""
    got = ros.heard["effort_controller/commands"]
    return [torques_of(data) for data, _ in list(got)]


def torques_of(data: bytes) -> list[float]:
    message: Any = ROS.deserialize_cdr(data, "std_msgs/msg/Float64MultiArray")
    torques: list[float] = message.data.tolist()
    return torques
