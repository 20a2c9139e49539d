"""Defines the topics under which ROS 2 programs see a session, and encodes their messages.

The command `trilat ros2` publishes a running session as ROS 2 topics (the live bridge), and the
export `ros2` converts a log to a bag, a recording of ROS 2. Both use this module. A bag
contains one message per record. The live bridge publishes some of these messages.

Invariant:
    - The live bridge and a bag have the same topics with the same types and the same numbers,
      because this module encodes the messages of both.
    - The quaternions of a topic do not jump. Two quaternions of opposite sign represent the
      same orientation, and the one closer to the previous quaternion is chosen.
    - A message is encoded only if its topic is wanted.
"""

import struct
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.exceptions import McapError
from mcap.reader import SeekingReader

from ...core import POSE, POSITION
from ...files import reading
from ...log import VIZ_ROOT, QuaternionSigns
from ...net import LinkStats, State
from ...scenario import Scenario
from . import cdr
from .robot_model import WORLD, FramePose, RobotModel, Vector, compute_quaternion
from .ros2_messages import (
    ROBOT_METADATA,
    SESSION_CHANNELS,
    NamedMessages,
    Ros2Channel,
    Ros2SiteChannels,
    stack_signals,
)
from .topic_names import DIAGNOSTICS, FRAMES_TOPIC, NAMINGS, TopicTable, make_session_name

if TYPE_CHECKING:
    from ...log import Log

Topics = dict[str, Ros2Channel]
"""Maps the trilat-net name of each topic of one site to its description."""

IsWanted = Callable[[str], bool]
"""Function that takes the trilat-net name of a topic and returns True if its message is needed.
"""

_OK = 0
_WARNING = 1
_ERROR = 2
_LEVELS = {"run": _OK, "fault": _ERROR, "diverged": _ERROR}
"""Maps modes to levels in `/diagnostics`. Other modes have the level `_WARNING`."""
_QUATERNION_TEXT = "unit quaternion, each nearest to the one before"
_NO_ROTATION = (0.0, 0.0, 0.0)
"""Angular part of a velocity or wrench, if the sites share only positions."""

_FRAMES_METADATA = {
    "content": "frames of the links",
    "unit": "m",
    "rotation": _QUATERNION_TEXT,
}
_DIAGNOSTICS_METADATA = {"content": "modes and loops of the sites, once a second"}
COMMON_TOPICS = {
    FRAMES_TOPIC: Ros2Channel(cdr.TRANSFORMS, _FRAMES_METADATA),
    DIAGNOSTICS: Ros2Channel(cdr.DIAGNOSTICS, _DIAGNOSTICS_METADATA),
}
"""Maps the names, without the leading "/", of topics common to all sessions to their
descriptions.
"""


_INDEX_ERRORS = (
    McapError,
    EOFError,
    OSError,
    struct.error,
    ValueError,
    OverflowError,
)
"""Errors raised by the library `mcap` for a file whose index cannot be read."""


class Ros2Topics(dict[str, Ros2Channel]):
    """Maps the full names of ROS 2 topics, which begin with "/", to their descriptions."""

    @classmethod
    def of_session(cls, scenario: Scenario, session: str, table: TopicTable) -> "Ros2Topics":
        """Lists all topics under which a session is published, by the bridge or in a bag.

        Args:
            scenario: Scenario of the session.
            session: Name of the session.
            table: Names of the topics in ROS 2.
        """
        topics = cls()
        for name, channel in COMMON_TOPICS.items():
            topics[f"/{name}"] = channel
        for name, channel in SESSION_CHANNELS.items():
            topics[f"/{session}/{name}"] = channel
        for site in scenario.names:
            site_messages = SiteMessages(scenario, site, epoch_unix_ns=0)
            for name, channel in site_messages.topics.items():
                topic = table.find(session, site, name)
                topics[f"/{topic}"] = channel
        return topics

    @classmethod
    def of_log(cls, log: "Log") -> "Ros2Topics":
        """Lists the topics that the ROS 2 bridge would use to publish the session of a log.

        Viewer settings that are created from a log contain these topics, so that they also work
        for the live session. The names follow the first built-in convention (`NAMINGS`).

        Args:
            log: Log of the session.
        """
        session = make_session_name(log.session["session"])
        table = TopicTable.read(NAMINGS[0])
        return cls.of_session(log.scenario, session, table)

    @classmethod
    def of_file(cls, path: Path) -> "Ros2Topics":
        """Lists the standard ROS 2 channels that a finished log or bag contains.

        Args:
            path: Path of the file.

        Returns:
            Maps each topic to the description of its channel. Empty if the file has no readable
            index.

        Raises:
            LogError: The file cannot be opened.
        """
        with reading(path) as stream:
            try:
                summary = SeekingReader(stream).get_summary()
            except _INDEX_ERRORS:
                summary = None
        topics = cls()
        if summary is None:
            return topics
        for _, channel in sorted(summary.channels.items()):
            schema = summary.schemas.get(channel.schema_id)
            is_ros2 = channel.message_encoding == cdr.ENCODING
            if is_ros2 and schema is not None:
                topics[channel.topic] = Ros2Channel(schema.name, dict(channel.metadata))
        return topics

    @property
    def are_of_log(self) -> bool:
        """True if the topics come from a log with messages for viewers, not from a bag.

        False for a file without topics.
        """
        return any(topic.startswith(VIZ_ROOT) for topic in self)


class SiteMessages:
    """Encodes everything that one site publishes as ROS 2 messages.

    Args:
        scenario: Scenario of the session.
        site: Name of the site.
        epoch_unix_ns: Start time of the session (tick 0) in Unix time, in ns; 0 in virtual
            time.

    Attributes:
        topics: Maps the trilat-net name of each topic of the site to its description. The
            topics of the session as a whole and `/tf` are not included.
        frame: Name of the frame in which the poses of the end effector are expressed.
        description: Message of the topic `robot_description`, the model of the arm.
    """

    def __init__(self, scenario: Scenario, site: str, epoch_unix_ns: int) -> None:
        """Prepares the encoding of all ROS 2 messages about one arm, such as joint names."""
        self._arm = scenario.arms[site]
        self._epoch_unix_ns = epoch_unix_ns
        settings = scenario.sites[site]
        # Sites share positions in units of 1 / scale metres.
        self._scale = settings.task.scale
        channels = Ros2SiteChannels(scenario, site)
        self._channels = channels
        self._robot = RobotModel(scenario, site)
        self._signs = {
            "tip_pose": QuaternionSigns(),
            "reference_pose": QuaternionSigns(),
        }
        self._link_signs = [QuaternionSigns() for _ in self._robot.frames]

        # The mode and the dominance factors are published when they change.
        self._mode = ""
        self._shares = tuple[float, ...]()

        self.description = cdr.pack_string(self._robot.description)
        _, self.frame = self._robot.frames[0]
        self._pack_shared_frame: Callable[..., bytes] | None = None
        # With a displaced base, the poses are in the frame that the sites share.
        if any(settings.arm.base_xyz_m) or any(settings.arm.base_rpy_rad):
            self.frame = f"{site}/shared"
            frame_packer = cdr.TransformPacker([(WORLD, self.frame)])
            self._pack_shared_frame = frame_packer.pack

        # Functions that encode the messages. The constant bytes are computed once, here.
        state_packer = cdr.JointStatePacker(channels.joints)
        self._pack_joint_states = state_packer.pack
        reference_packer = cdr.JointStatePacker(channels.joints, effort=False)
        self._pack_reference = reference_packer.pack
        peers = scenario.peers(site)
        peer_dimension = (" ".join(peers), len(peers))
        self._pack_shares = cdr.make_float_array_packer(peer_dimension)
        self.topics = self._list_topics(peers)

    def _list_topics(self, peers: Sequence[str]) -> Topics:
        """Maps the trilat-net name of each topic of the site to its description.

        The topics of the reference depend on whether the sites exchange joint angles or the
        pose of the end effector.

        Args:
            peers: Names of the peers.
        """
        channels = self._channels
        topics: Topics = {}
        topics["joint_states"] = channels.joint_states(channels.joints)
        if self._arm.shares_pose:
            topics["tip_pose"] = self._describe_pose("the end effector")
            topics["tip_twist"] = self._describe_twist("the end effector")
            topics["reference_pose"] = self._describe_pose("its reference, Eq. (6)")
            topics["reference_twist"] = self._describe_twist("its reference, Eq. (6)")
            wrench = {
                "content": "force of operator and environment ON the end effector",
                "unit": "N, N m",
                "frame": self.frame,
            }
            topics["tip_wrench"] = Ros2Channel(cdr.WRENCH, wrench)
        else:
            topics["reference"] = channels.joint_states(channels.joints, effort=False)
            topics["tip_pose"] = self._describe_pose("the end effector")

        # Late subscribers receive the last message of these topics, which change rarely.
        mode = {"content": "mode of the site"}
        topics["mode"] = Ros2Channel(cdr.STRING, mode, latched=True)
        shares = {
            "content": "shares of its peers in its reference",
            "names": " ".join(peers),
        }
        topics["dominance"] = Ros2Channel(cdr.FLOAT64_ARRAY, shares, latched=True)
        topics["robot_description"] = Ros2Channel(cdr.STRING, ROBOT_METADATA, latched=True)
        return topics | self._list_array_topics()

    def _describe_pose(self, subject: str) -> Ros2Channel:
        """Describes a topic with poses of the end effector or of its reference."""
        about = {
            "content": f"pose of {subject}",
            "unit": "m",
            "orientation": _QUATERNION_TEXT,
            "frame": self.frame,
        }
        return Ros2Channel(cdr.POSE, about)

    def _describe_twist(self, subject: str) -> Ros2Channel:
        """Describes a topic with velocities of the end effector or of its reference."""
        about = {
            "content": f"velocity of {subject}",
            "unit": "m/s, rad/s",
            "frame": self.frame,
        }
        return Ros2Channel(cdr.TWIST, about)

    def _list_array_topics(self) -> Topics:
        """Lists the topics that contain arrays of numbers, such as the error."""
        topics: Topics = {}
        for name, array in self._channels.arrays.items():
            topic = _name_array_topic(name)
            topics[topic] = array.channel
        is_full_pose = self._arm.counts.shared == POSE
        if is_full_pose and self._arm.shares_pose:
            # The error then contains a rotation, whose format is not obvious.
            error = topics["error"]
            rotation_text = "rotation vector of the law's error, at most half a turn long"
            about = {**error.about, "orientation": rotation_text}
            topics["error"] = error._replace(about=about)
        return topics

    def stamp_ns(self, record: State) -> int:
        """Returns the time stamp of the ROS 2 messages derived from one record, in ns.

        This is the nominal time of the record's tick, in Unix time.

        Args:
            record: The record.
        """
        return max(0, self._epoch_unix_ns + record.t_ns)

    def pack_record(
        self,
        record: State,
        shares: Sequence[float],
        is_wanted: IsWanted = lambda _topic: True,
    ) -> NamedMessages:
        """Converts the record of a site to ROS 2 messages.

        The record contains the motion, reference, torques and mode of the arm at one tick.

        Args:
            record: The record. Records must be passed in chronological order, because the signs
                of quaternions depend on the previous record.
            shares: Dominance factors at the time of the record.
            is_wanted: Function that returns False for topics whose messages are not needed.

        Yields:
            For each wanted topic, its trilat-net name and the encoded message.
        """
        stamp_ns = self.stamp_ns(record)
        if is_wanted("joint_states"):
            data = self._pack_joint_states(stamp_ns, record.q, record.qd, record.tau)
            yield "joint_states", data
        if self._arm.shares_pose:
            yield from self._pack_shared_motion(record, stamp_ns, is_wanted)
        else:
            yield from self._pack_joint_reference(record, stamp_ns, is_wanted)

        # The mode and the dominance factors are published only when they change.
        if record.mode != self._mode:
            self._mode = record.mode
            yield "mode", cdr.pack_string(record.mode)
        new_shares = tuple(shares)
        if new_shares != self._shares:
            self._shares = new_shares
            yield "dominance", self._pack_shares(*new_shares)

        yield from self._pack_arrays(record, is_wanted)

    def _pack_joint_reference(
        self, record: State, stamp_ns: int, is_wanted: IsWanted
    ) -> NamedMessages:
        """Encodes the reference of the joints, and the pose of the end effector.

        Used if the sites share joint angles. The pose is computed from them.
        """
        if is_wanted("reference"):
            data = self._pack_reference(stamp_ns, record.q_des, record.qd_des)
            yield "reference", data
        if is_wanted("tip_pose"):
            yield "tip_pose", self._pack_pose("tip_pose", record, record.x, stamp_ns)

    def _pack_shared_motion(
        self, record: State, stamp_ns: int, is_wanted: IsWanted
    ) -> NamedMessages:
        """Encodes the motion of the end effector, its reference, and the wrench on it.

        Used if the sites share the position or pose of the end effector instead of the joint
        positions. The task scale enlarges or reduces the motion that the sites share:

            shared motion = scale * motion of this arm.

        A record contains shared quantities. Speeds and positions of this arm are therefore
        divided by the scale. Forces of this arm are multiplied by it, so that the power, force
        times speed, remains the same. Angles are not scaled.

        Args:
            record: The record of one tick of the site.
            stamp_ns: Time of the record in Unix time, in ns.
            is_wanted: Function that returns True if a program has subscribed to the topic with
                a given name.

        Yields:
            The trilat-net name of each wanted topic, and the message.
        """
        motions = [
            ("tip", record.x, record.xd),
            ("reference", record.q_des, record.qd_des),
        ]
        for subject, pose, rate in motions:
            pose_topic = f"{subject}_pose"
            if is_wanted(pose_topic):
                pose_data = self._pack_pose(pose_topic, record, pose, stamp_ns)
                yield pose_topic, pose_data
            twist_topic = f"{subject}_twist"
            if is_wanted(twist_topic):
                # The first three numbers are linear. The others, if there are any, are angular.
                linear_rate = rate[:POSITION]
                linear = [speed / self._scale for speed in linear_rate]
                angular = _fill_rotation(rate)
                yield twist_topic, self._pack_vectors(stamp_ns, linear, angular)
        if is_wanted("tip_wrench"):
            # The message contains the wrench that acts on the arm. In the model of the arm, Eq.
            # (8) of the paper, the exogenous wrench is subtracted. Therefore a record contains
            # the negative of this wrench.
            subtracted_force = record.wrench[:POSITION]
            subtracted_torque = _fill_rotation(record.wrench)
            force = [-self._scale * component for component in subtracted_force]
            torque = [-component for component in subtracted_torque]
            yield "tip_wrench", self._pack_vectors(stamp_ns, force, torque)

    def _pack_vectors(
        self,
        stamp_ns: int,
        linear: Sequence[float],
        angular: Sequence[float],
    ) -> bytes:
        """Encodes the linear and angular parts of a quantity in the frame of the site."""
        return cdr.pack_frame_vectors(stamp_ns, self.frame, *linear, *angular)

    def _pack_pose(
        self,
        topic: str,
        record: State,
        pose: Sequence[float],
        stamp_ns: int,
    ) -> bytes:
        """Encodes a pose of the end effector as a ROS 2 message: position and unit quaternion.

        Args:
            topic: Name of the topic. Successive quaternions of a topic do not jump.
            record: The record.
            pose: The pose that the sites exchange. Empty if they exchange joint angles.
            stamp_ns: Time of the message in Unix time, in ns.
        """
        rotation_vector = self._compute_rotation_vector(record, pose)
        quaternion = compute_quaternion(rotation_vector)
        # Only packed quaternions are aligned, so that the sign is continuous from message to
        # message.
        aligned_quaternion = self._signs[topic].align(quaternion)
        position = self._compute_position(record, pose)
        return self._pack_vectors(stamp_ns, position, aligned_quaternion)

    def _compute_position(self, record: State, pose: Sequence[float]) -> Sequence[float]:
        """Returns the position of the end effector in a record, in m.

        Args:
            record: The record. Its joint angles are used if there is no pose.
            pose: The pose that the sites exchange. Empty if they exchange joint angles.
        """
        if pose:
            coordinates = pose[:POSITION]
            return [coordinate / self._scale for coordinate in coordinates]
        end_effector = self._arm.end_effector(record.q)
        # The end effector of a planar arm has two coordinates. The third coordinate is 0.
        coordinates = [*end_effector, 0.0]
        return coordinates[:POSITION]

    def _compute_rotation_vector(self, record: State, pose: Sequence[float]) -> Vector:
        """Returns the rotation vector of a pose, in rad.

        If the pose contains no orientation, it is computed from the joint angles.
        """
        if len(pose) == POSE:
            x, y, z = pose[POSITION:]
            return x, y, z
        return self._arm.end_effector_orientation(record.q)

    def _pack_arrays(self, record: State, is_wanted: IsWanted) -> NamedMessages:
        """Encodes the quantities of a record with no standard ROS type, as labelled arrays.

        These are the error e = q - q_des, and the arrays that viewers receive at a reduced rate
        ("slow"): the exogenous torque, the estimated parameters, the vectors that the control
        law sends, and the mode. `pack_slow_arrays` encodes the slow arrays together, and only
        the wanted ones are yielded.

        Args:
            record: The record of one tick of the site.
            is_wanted: Function that returns True if a program has subscribed to the topic with
                a given name.

        Yields:
            The trilat-net name of each wanted topic, and the message.
        """
        channels = self._channels
        array_topics = [_name_array_topic(name) for name in channels.record_arrays]
        if not any(is_wanted(topic) for topic in array_topics):
            return
        # Each curve has one value per record. For a single record, the first values of all
        # curves are the numbers of that record. `error_row` and `slow_row` are slices of them.
        curves = stack_signals([record])
        numbers = [curve[0] for curve in curves]
        if is_wanted("error"):
            errors = numbers[channels.error_row]
            error_array = channels.arrays["error"]
            yield "error", error_array.pack(*errors)
        slow_numbers = numbers[channels.slow_row]
        for name, data in channels.pack_slow_arrays(slow_numbers):
            topic = _name_array_topic(name)
            if is_wanted(topic):
                yield topic, data

    def pack_frames(self, record: State) -> Iterable[bytes]:
        """Encodes the poses of all links of an arm at one tick, for viewers.

        Args:
            record: The record, which contains the joint positions.

        Yields:
            The messages for the topic `/tf`.
        """
        stamp_ns = self.stamp_ns(record)
        transforms = self._robot.compute_transforms(record.q)
        aligned_transforms: list[FramePose] = []
        pairs = zip(self._link_signs, transforms, strict=True)
        for signs, (origin, rotation) in pairs:
            aligned_rotation = signs.align(rotation)
            aligned_transforms.append((origin, aligned_rotation))
        yield self._robot.pack_transforms(stamp_ns, aligned_transforms)
        if self._pack_shared_frame is not None:
            origin, rotation = self._robot.shared
            numbers = [*origin, *rotation]
            yield self._pack_shared_frame(stamp_ns, numbers)

    def pack_statistics(self, stats: LinkStats) -> NamedMessages:
        """Encodes statistics of network links, such as delays and losses, as ROS 2 messages.

        Args:
            stats: The statistics.

        Yields:
            The trilat-net name of the topic, and the message.
        """
        yield from self._channels.pack_statistics(stats)


def _name_array_topic(name: str) -> str:
    """Returns the topic of an array. The topic `mode` already holds the mode as a string."""
    return "mode_number" if name == "mode" else name


def _fill_rotation(values: Sequence[float]) -> list[float]:
    """Returns the angular part of a velocity or wrench, or zeros if there is none."""
    angular = [*values[POSITION:], *_NO_ROTATION]
    return angular[:POSITION]


def pack_session_diagnostics(
    session: str, epoch_unix_ns: int, records: Sequence[State]
) -> bytes:
    """Encodes the status of all sites for the ROS 2 topic `/diagnostics`.

    Args:
        session: Name of the session.
        epoch_unix_ns: Start time of the session (tick 0) in Unix time, in ns; 0 in virtual
            time.
        records: Newest record of each site that has published any.

    Returns:
        The message, with one status per site.
    """
    times_ns = [record.t_ns for record in records]
    newest_ns = max(times_ns, default=0)
    diagnoses: list[cdr.Diagnosis] = []
    for record in records:
        values = {
            "tick": str(record.tick),
            "late_us": str(record.late_us),
            "busy_us": str(record.busy_us),
        }
        level = _LEVELS.get(record.mode, _WARNING)
        name = f"{session}/{record.site}"
        diagnosis = cdr.Diagnosis(level, name, record.mode, values)
        diagnoses.append(diagnosis)
    stamp_ns = max(0, epoch_unix_ns + newest_ns)
    return cdr.pack_diagnostics(stamp_ns, diagnoses)
