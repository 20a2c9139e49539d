"""What a session shows in the graph of ROS 2, and under which names: topics of its sites, and their shares.

Invariant: a message is made only while somebody listens. A name that begins with / stands for itself, and no
two topics have one name.
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import UsageError
from trilat_net.fields import suggest_nearest
from trilat_net.files import open_regular
from trilat_net.log.ros2 import cdr
from trilat_net.log.ros2.robot_model import WORLD, RobotModel, find_quaternion
from trilat_net.log.ros2.ros2_messages import Ros2SiteChannels
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock
from trilat_net.net.messages import State
from trilat_net.net.ros2_graph import QualityOfService, Ros2Graph, TopicPublisher, check_ros_name
from trilat_net.scenario import Scenario

from .running_session import ShareHistory

POSE, WRENCH = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/WrenchStamped"
RELIABLE, LATCHED = QualityOfService(), QualityOfService(latched=True, depth=1)
NAMINGS = ("crisp", "crtk")
TOPICS = {
    "joint_states": ("joint_states", "measured_js"),
    "reference": ("reference", "setpoint_js"),
    "tip_pose": ("tip_pose", "measured_cp"),
    "tip_wrench": ("tip_wrench", "measured_cf"),
    "mode": ("mode", "mode"),
    "dominance": ("dominance", "dominance"),
    "robot_description": ("robot_description", "robot_description"),
    "target_joint": ("target_joint", "servo_jp"),
    "target_pose": ("target_pose", "servo_cp"),
    "target_wrench": ("target_wrench", "servo_cf"),
    "set_dominance": ("set_dominance", "set_dominance"),
    "robot_states": ("robot/joint_states", "robot/measured_js"),
    "robot_commands": ("robot/commands", "robot/commands"),
}
"""By our name of a topic the one that it has under `/<session>/<site>` in each of `NAMINGS`: as CRISP, and as
the Collaborative Robotics Toolkit of the da Vinci Research Kit call it."""


class RobotTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a file says of the robot that is the arm of a site.

    Attributes:
        joints: its names of the arm's joints, in the scenario's order; empty: as the scenario calls them.
        controller: the same in the order of its controller; empty: in that of the scenario.
        safe: what this controller gets while the arm is to brake; empty: zeros.
    """

    joints: list[str] = []
    controller: list[str] = []
    safe: list[float] = []


class TopicTable(NamedTuple):
    """By our names of topics those that they have at every site, and where a site has others; the robots."""

    names: Mapping[str, str]
    of_site: Mapping[str, Mapping[str, str]] = {}
    robots: Mapping[str, RobotTable] = {}

    def find(self, session: str, site: str, topic: str) -> str:
        """Returns the full name of a topic of a site; one that begins with / stands for itself."""
        called = self.of_site.get(site, {}).get(topic, self.names[topic])
        return called[1:] if called.startswith("/") else f"{session}/{site}/{called}"


def read_topic_table(asked: str) -> TopicTable:
    """Returns the names of "crisp" or "crtk", or those of a file, which is TOML upon those of CRISP.

    As in `joint_states = "arm/joint_states"`; a table `[sites.s]` is for one site, and says of its robot
    what a `RobotTable` has.

    Raises:
        UsageError: it cannot be read, or a name in it cannot be right.
    """
    plain = {topic: row[NAMINGS.index(asked) if asked in NAMINGS else 0] for topic, row in TOPICS.items()}
    if asked in NAMINGS:
        return TopicTable(plain)
    try:
        with open_regular(Path(asked)) as stream:
            found = tomllib.loads(stream.read().decode())
        tables = msgspec.convert(found.pop("sites", {}), dict[str, dict[str, Any]])
        of_robot = RobotTable.__struct_fields__
        own = {site: {key: of.pop(key) for key in of_robot if key in of} for site, of in tables.items()}
        robots = msgspec.convert(own, dict[str, RobotTable])
    except OSError as error:
        raise UsageError(
            f"--names is crisp, crtk or a file, and {asked} cannot be read: {error.strerror}"
        ) from None
    except (ValueError, msgspec.ValidationError) as error:
        raise UsageError(f"{asked}: is no TOML of names: {error}") from None
    for key, name in [pair for table in (found, *tables.values()) for pair in table.items()]:
        if key not in TOPICS:
            raise UsageError(f"{asked}: no topic {key!r}{suggest_nearest(key, list(TOPICS))}")
        check_ros_name(str(name), f"{asked}: {key}")
    table = TopicTable(plain | found, tables, robots)
    shown = [topic for topic in TOPICS if topic != "robot_states"]  # several arms may stand in one message
    places = [table.find("", site, topic) for site in (*tables, "*", "**") for topic in shown]
    if len(set(places)) < len(places):
        raise UsageError(f"{asked}: two topics have one name; one that begins with / is for one site")
    return table


class Ends(NamedTuple):
    """Both ends of the bridge: the graph of ROS, and a session by its bus, its name and its topics."""

    graph: Ros2Graph
    bus: Bus
    clock: Clock
    session: str
    table: TopicTable

    def topic(self, site: str, name: str) -> str:
        """Returns the full name of a topic."""
        return self.table.find(self.session, site, name)


class SiteTopics:
    """What one site shows, under `/<session>/<site>`, and by `frames` of `/tf`; stamps count from the epoch.

    Its end effector is in `frame`; `newest` is the record that was shown last.
    """

    def __init__(
        self, ends: Ends, scenario: Scenario, site: str, epoch_unix_ns: int, frames: TopicPublisher
    ) -> None:
        self._arm, self._epoch_unix_ns, self._frames = scenario.arms[site], epoch_unix_ns, frames
        self._scale, self._mode = (*[scenario.sites[site].task.scale] * 3, 1.0, 1.0, 1.0), ""
        self._robot, names = RobotModel(scenario, site), Ros2SiteChannels(scenario, site).joints
        self._pack_states = cdr.JointStatePacker(names).pack
        self._pack_reference = cdr.JointStatePacker(names, effort=False).pack
        peers = scenario.peers(site)
        self._pack_shares = cdr.make_float_array_packer((" ".join(peers), len(peers)))
        self.shares = ShareHistory(scenario, site)
        self._shown: tuple[float, ...] = ()

        def topic(name: str, kind: str, qos: QualityOfService = RELIABLE) -> TopicPublisher:
            return ends.graph.publisher(ends.topic(site, name), kind, qos)

        self._states, self._modes = topic("joint_states", cdr.JOINT_STATE), topic("mode", cdr.STRING, LATCHED)
        self._pose, self._dominance = topic("tip_pose", POSE), topic("dominance", cdr.FLOAT64_ARRAY, LATCHED)
        shares = self._arm.shares_pose
        self._reference = None if shares else topic("reference", cdr.JOINT_STATE)
        self._wrench = topic("tip_wrench", WRENCH) if shares else None
        topic("robot_description", cdr.STRING, LATCHED).put(cdr.pack_string(self._robot.description))
        spec = scenario.sites[site].arm
        self.frame, self._placed = self._robot.frames[0][1], any((*spec.base_xyz_m, *spec.base_rpy_rad))
        if self._placed:  # the end effector is in the frame that the sites share
            self.frame = f"{site}/shared"
            self._pack_shared = cdr.TransformPacker([(WORLD, self.frame)]).pack
        self.newest: State | None = None

    def show(self, record: State, rate_hz: float) -> None:
        """Publishes a record, as far as somebody listens, if it is the first of its time at a rate.

        None is shown after a later one.
        """
        last = self.newest
        times = [int(one.t_ns * rate_hz) // NS_PER_S for one in (record, last or record)]
        if last is not None and record.boot == last.boot and times[0] <= times[1]:
            return
        self.newest = record
        stamp_ns = max(0, self._epoch_unix_ns + record.t_ns)
        if self._states.heard:
            self._states.put(self._pack_states(stamp_ns, record.q, record.qd, record.tau))
        if self._reference is not None and self._reference.heard:
            self._reference.put(self._pack_reference(stamp_ns, record.q_des, record.qd_des))
        if self._pose.heard:
            place = [*self._arm.end_effector(record.q), 0.0][:3]
            turned = find_quaternion(self._arm.end_turn(record.q))
            self._pose.put(cdr.pack_frame_vectors(stamp_ns, self.frame, *place, *turned))
        if self._wrench is not None and self._wrench.heard:
            pull = [-scale * one for scale, one in zip(self._scale, record.wrench, strict=False)]
            self._wrench.put(cdr.pack_frame_vectors(stamp_ns, self.frame, *[*pull, *[0.0] * 6][:6]))
        if self._frames.heard:
            self._frames.put(self._robot.pack(stamp_ns, record.q))
            if self._placed:
                origin, upright = self._robot.shared
                self._frames.put(self._pack_shared(stamp_ns, [*origin, *upright]))
        if record.mode != self._mode:
            self._mode = record.mode
            self._modes.put(cdr.pack_string(record.mode))
        if (shares := self.shares.at(record.t_ns)) != self._shown:
            self._shown = shares
            self._dominance.put(self._pack_shares(*shares))
