"""Topics, types and messages of a session in ROS 2, for the live bridge and for bags.

A bag has a message for every record; the live bridge publishes a part of these messages.

Invariant:
    - The live bridge and a bag have the same topics with the same types and the same numbers,
      because this module makes the messages of both.
    - The signs of a topic's quaternions are continuous: each quaternion has the sign that is
      nearest to its predecessor.
    - A message is packed only if its topic is wanted.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

from ...core.task_space import POSE, POSITION
from ...net.messages import LinkStats, State
from ...scenario import Scenario
from ..orientations import QuaternionSigns
from . import cdr
from .robot_model import WORLD, RobotModel, compute_quaternion
from .ros2_messages import SESSION_CHANNELS, Ros2Channel, Ros2SiteChannels, stack_signals
from .topic_names import DIAGNOSTICS, FRAMES, TopicTable

Topics = dict[str, Ros2Channel]
"""Topics by name: trilat-net's own names for one site, full names for a session."""

_OK = 0
_WARNING = 1
_ERROR = 2
_LEVELS = {"run": _OK, "fault": _ERROR, "diverged": _ERROR}
"""Levels of `/diagnostics` by mode; other modes have the level `_WARNING`."""
_QUATERNION_TEXT = "unit quaternion, each nearest to the one before"
_NO_ROTATION = (0.0, 0.0, 0.0)

COMMON_TOPICS = {
    FRAMES: Ros2Channel(
        cdr.TRANSFORMS,
        {"content": "frames of the links", "unit": "m", "rotation": _QUATERNION_TEXT},
    ),
    DIAGNOSTICS: Ros2Channel(
        cdr.DIAGNOSTICS, {"content": "modes and loops of the sites, once a second"}
    ),
}
"""Topics that all sessions share, by their full names."""


def list_topics(scenario: Scenario, session: str, table: TopicTable) -> Topics:
    """Returns all topics that a session publishes, by their full names."""
    topics = {**COMMON_TOPICS}
    for name, channel in SESSION_CHANNELS.items():
        topics[f"{session}/{name}"] = channel
    for site in scenario.names:
        for name, channel in SiteMessages(scenario, site, 0).topics.items():
            topics[table.find(session, site, name)] = channel
    return topics


class SiteMessages:
    """The messages of one site.

    Args:
        scenario: the scenario that runs.
        site: the site.
        epoch_unix_ns: Unix time of tick 0, in ns; 0 in virtual time.

    Attributes:
        topics: the site's topics by trilat-net's own names, without the topics of the session
            and `/tf`.
        frame: frame of the poses of the end effector.
        description: message of the topic `robot_description`.
    """

    def __init__(self, scenario: Scenario, site: str, epoch_unix_ns: int) -> None:
        self._arm = scenario.arms[site]
        self._epoch_unix_ns = epoch_unix_ns
        spec = scenario.sites[site]
        self._scale = spec.task.scale
        self._channels = channels = Ros2SiteChannels(scenario, site)
        self._robot = RobotModel(scenario, site)
        self._signs = {name: QuaternionSigns() for name in ("tip_pose", "reference_pose")}
        self._link_signs = [QuaternionSigns() for _ in self._robot.frames]
        self._mode = ""
        self._shares = tuple[float, ...]()
        self.description = cdr.pack_string(self._robot.description)
        self.frame = self._robot.frames[0][1]
        self._pack_shared: Callable[..., bytes] | None = None
        # With a displaced base, the poses are in the frame that the sites share.
        if any((*spec.arm.base_xyz_m, *spec.arm.base_rpy_rad)):
            self.frame = f"{site}/shared"
            self._pack_shared = cdr.TransformPacker([(WORLD, self.frame)]).pack
        self._pack_states = cdr.JointStatePacker(channels.joints).pack
        self._pack_reference = cdr.JointStatePacker(channels.joints, effort=False).pack
        peers = scenario.peers(site)
        self._pack_shares = cdr.make_float_array_packer((" ".join(peers), len(peers)))
        self.topics = self._list_topics(peers)

    def _list_topics(self, peers: Sequence[str]) -> Topics:
        """Returns the topics of the site by trilat-net's own names."""
        channels = self._channels
        topics: Topics = {"joint_states": channels.joint_states(channels.joints)}
        if self._arm.shares_pose:
            for topic, subject in (
                ("tip", "the end effector"),
                ("reference", "its reference, Eq. (6)"),
            ):
                pose = {
                    "content": f"pose of {subject}",
                    "unit": "m",
                    "orientation": _QUATERNION_TEXT,
                }
                twist = {"content": f"velocity of {subject}", "unit": "m/s, rad/s"}
                topics[f"{topic}_pose"] = Ros2Channel(cdr.POSE, {**pose, "frame": self.frame})
                topics[f"{topic}_twist"] = Ros2Channel(
                    cdr.TWIST, {**twist, "frame": self.frame}
                )
            wrench = {
                "content": "force of operator and environment ON the end effector",
                "unit": "N, N m",
            }
            topics["tip_wrench"] = Ros2Channel(cdr.WRENCH, {**wrench, "frame": self.frame})
        else:
            topics["reference"] = channels.joint_states(channels.joints, effort=False)
            pose = {
                "content": "pose of the end effector",
                "unit": "m",
                "orientation": _QUATERNION_TEXT,
            }
            topics["tip_pose"] = Ros2Channel(cdr.POSE, {**pose, "frame": self.frame})
        topics["mode"] = Ros2Channel(cdr.STRING, {"content": "mode of the site"}, latched=True)
        shares = {"content": "shares of its peers in its reference", "names": " ".join(peers)}
        topics["dominance"] = Ros2Channel(cdr.FLOAT64_ARRAY, shares, latched=True)
        robot = {"content": "URDF, with links named after their site"}
        topics["robot_description"] = Ros2Channel(cdr.STRING, robot, latched=True)
        arrays = {
            _name_array_topic(name): array.channel for name, array in channels.arrays.items()
        }
        if self._arm.counts.shared == POSE and self._arm.shares_pose:
            about = {
                **arrays["error"].about,
                "orientation": "rotation vector of the law's error, at most half a turn long",
            }
            arrays["error"] = arrays["error"]._replace(about=about)
        return topics | arrays

    def stamp_ns(self, record: State) -> int:
        """Returns the nominal time of a record, in Unix ns."""
        return max(0, self._epoch_unix_ns + record.t_ns)

    def pack_record(
        self,
        record: State,
        shares: Sequence[float],
        is_wanted: Callable[[str], bool] = lambda _topic: True,
    ) -> Iterator[tuple[str, bytes]]:
        """Yields topic and message for the messages of a record.

        The topics have trilat-net's own names.

        Args:
            record: the record; calls must be in the order of the records' times.
            shares: the site's shares of its peers at the time of the record.
            is_wanted: returns False for topics whose messages are not needed.
        """
        stamp_ns = self.stamp_ns(record)
        if is_wanted("joint_states"):
            yield "joint_states", self._pack_states(stamp_ns, record.q, record.qd, record.tau)
        if not self._arm.shares_pose and is_wanted("reference"):
            yield "reference", self._pack_reference(stamp_ns, record.q_des, record.qd_des)
        yield from self._pack_tip(record, stamp_ns, is_wanted)
        if record.mode != self._mode:
            self._mode = record.mode
            yield "mode", cdr.pack_string(record.mode)
        new_shares = tuple(shares)
        if new_shares != self._shares:
            self._shares = new_shares
            yield "dominance", self._pack_shares(*new_shares)
        yield from self._pack_arrays(record, is_wanted)

    def _pack_tip(
        self, record: State, stamp_ns: int, is_wanted: Callable[[str], bool]
    ) -> Iterator[tuple[str, bytes]]:
        """Yields the poses, twists and wrench of the end effector and its reference."""
        poses = {"tip_pose": (record.x, record.xd)}
        if self._arm.shares_pose:
            poses["reference_pose"] = record.q_des, record.qd_des
        for topic, (pose, rate) in poses.items():
            if is_wanted(topic):
                rotation_vector = self._compute_rotation_vector(record, pose)
                # Only packed quaternions are aligned: the sign is continuous from message to
                # message.
                quaternion = self._signs[topic].align(compute_quaternion(rotation_vector))
                position = self._compute_position(record, pose)
                yield (
                    topic,
                    cdr.pack_frame_vectors(stamp_ns, self.frame, *position, *quaternion),
                )
            twist = topic.replace("pose", "twist")
            if self._arm.shares_pose and is_wanted(twist):
                linear = [speed / self._scale for speed in rate[:POSITION]]
                angular = [*rate[POSITION:], *_NO_ROTATION][:POSITION]
                yield twist, cdr.pack_frame_vectors(stamp_ns, self.frame, *linear, *angular)
        if self._arm.shares_pose and is_wanted("tip_wrench"):
            force = [-self._scale * component for component in record.wrench[:POSITION]]
            shared_torque = [*record.wrench[POSITION:], *_NO_ROTATION][:POSITION]
            torque = [-component for component in shared_torque]
            yield "tip_wrench", cdr.pack_frame_vectors(stamp_ns, self.frame, *force, *torque)

    def _compute_position(self, record: State, pose: Sequence[float]) -> Sequence[float]:
        """Returns the position of a shared pose, in m.

        In joint space no pose is shared, and the position is that of the end effector.
        """
        if pose:
            return [coordinate / self._scale for coordinate in pose[:POSITION]]
        return [*self._arm.end_effector(record.q), 0.0][:POSITION]

    def _compute_rotation_vector(
        self, record: State, pose: Sequence[float]
    ) -> tuple[float, float, float]:
        """Returns the rotation vector of a pose, in rad.

        For a pose without orientation, the rotation vector is that of the end effector.
        """
        if len(pose) == POSE:
            return pose[POSITION], pose[POSITION + 1], pose[POSITION + 2]
        return self._arm.end_effector_orientation(record.q)

    def _pack_arrays(
        self, record: State, is_wanted: Callable[[str], bool]
    ) -> Iterator[tuple[str, bytes]]:
        """Yields the wanted arrays of a record."""
        channels = self._channels
        if not any(is_wanted(_name_array_topic(name)) for name in channels.record_arrays):
            return
        row = [column[0] for column in stack_signals([record])]
        if is_wanted("error"):
            yield "error", channels.arrays["error"].pack(*row[channels.error_row])
        for name, data in channels.slow(row[channels.slow_row]):
            topic = _name_array_topic(name)
            if is_wanted(topic):
                yield topic, data

    def pack_frames(self, record: State) -> Iterable[bytes]:
        """Yields the messages of a record on `/tf`."""
        stamp_ns = self.stamp_ns(record)
        transforms = zip(self._link_signs, self._robot.transforms(record.q), strict=True)
        aligned = [(origin, signs.align(rotation)) for signs, (origin, rotation) in transforms]
        yield self._robot.pack_transforms(stamp_ns, aligned)
        if self._pack_shared is not None:
            origin, rotation = self._robot.shared
            yield self._pack_shared(stamp_ns, [*origin, *rotation])

    def pack_statistics(self, stats: LinkStats) -> Iterator[tuple[str, bytes]]:
        """Yields topic, by trilat-net's own name, and message of link statistics."""
        yield from self._channels.statistics(stats)


def _name_array_topic(name: str) -> str:
    """Returns the topic of an array; the topic `mode` holds the mode as text, not as number."""
    return "mode_number" if name == "mode" else name


def pack_session_diagnostics(
    session: str, epoch_unix_ns: int, records: Sequence[State]
) -> bytes:
    """Returns a message for `/diagnostics`, made from the newest record of each site."""
    newest_ns = max((record.t_ns for record in records), default=0)
    parts: list[cdr.Diagnosis] = []
    for record in records:
        values = {"tick": record.tick, "late_us": record.late_us, "busy_us": record.busy_us}
        texts = {key: str(value) for key, value in values.items()}
        level = _LEVELS.get(record.mode, _WARNING)
        parts.append(cdr.Diagnosis(level, f"{session}/{record.site}", record.mode, texts))
    return cdr.pack_diagnostics(max(0, epoch_unix_ns + newest_ns), parts)
