"""What a session publishes in ROS 2, live and in a bag: topics, types and messages.

Invariant:
- The live bridge and a bag make their messages here, so that both have the same topics with the
  same types and the same numbers. A bag has a message for every record; the bridge publishes a
  part of them.
- The sign of the quaternions of a topic is consistent: each is nearest to the one before.
- A message is made only if it is wanted.
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
"""Topics by name: of one site by our names, of a session by their full names."""

_OK = 0
_WARNING = 1
_ERROR = 2
_LEVELS = {"run": _OK, "fault": _ERROR, "diverged": _ERROR}
"""Of `/diagnostics`, by mode; others warn."""
_STEADY = "unit quaternion, each nearest to the one before"
_NO_TURN = (0.0, 0.0, 0.0)

COMMON_TOPICS = {
    FRAMES: Ros2Channel(
        cdr.TRANSFORMS, {"content": "frames of the links", "unit": "m", "rotation": _STEADY}
    ),
    DIAGNOSTICS: Ros2Channel(
        cdr.DIAGNOSTICS, {"content": "modes and loops of the sites, once a second"}
    ),
}
"""Topics of all sessions together, by their full names."""


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
        epoch_unix_ns: Unix time of tick 0, ns; 0 in virtual time.

    Attributes:
        topics: its topics by our names; those of the session and `/tf` are not among them.
        frame: the frame of its end effector.
        description: the message of `robot_description`.
    """

    def __init__(self, scenario: Scenario, site: str, epoch_unix_ns: int) -> None:
        self._arm = scenario.arms[site]
        self._epoch_unix_ns = epoch_unix_ns
        spec = scenario.sites[site]
        self._scale = spec.task.scale
        self._shapes = shapes = Ros2SiteChannels(scenario, site)
        self._robot = RobotModel(scenario, site)
        self._signs = {name: QuaternionSigns() for name in ("tip_pose", "reference_pose")}
        self._link_signs = [QuaternionSigns() for _ in self._robot.frames]
        self._mode = ""
        self._shares = tuple[float, ...]()
        self.description = cdr.pack_string(self._robot.description)
        self.frame = self._robot.frames[0][1]
        self._pack_shared: Callable[..., bytes] | None = None
        if any((*spec.arm.base_xyz_m, *spec.arm.base_rpy_rad)):
            self.frame = (
                f"{site}/shared"  # the end effector is in the frame that the sites share
            )
            self._pack_shared = cdr.TransformPacker([(WORLD, self.frame)]).pack
        self._pack_states = cdr.JointStatePacker(shapes.joints).pack
        self._pack_reference = cdr.JointStatePacker(shapes.joints, effort=False).pack
        peers = scenario.peers(site)
        self._pack_shares = cdr.make_float_array_packer((" ".join(peers), len(peers)))
        self.topics = self._list_topics(peers)

    def _list_topics(self, peers: Sequence[str]) -> Topics:
        shapes = self._shapes
        own: Topics = {"joint_states": shapes.joint_states(shapes.joints)}
        if self._arm.shares_pose:
            for topic, what in (
                ("tip", "the end effector"),
                ("reference", "its reference, Eq. (6)"),
            ):
                pose = {"content": f"pose of {what}", "unit": "m", "orientation": _STEADY}
                twist = {"content": f"velocity of {what}", "unit": "m/s, rad/s"}
                own[f"{topic}_pose"] = Ros2Channel(cdr.POSE, {**pose, "frame": self.frame})
                own[f"{topic}_twist"] = Ros2Channel(cdr.TWIST, {**twist, "frame": self.frame})
            wrench = {
                "content": "force of operator and environment ON the end effector",
                "unit": "N, N m",
            }
            own["tip_wrench"] = Ros2Channel(cdr.WRENCH, {**wrench, "frame": self.frame})
        else:
            own["reference"] = shapes.joint_states(shapes.joints, effort=False)
            pose = {"content": "pose of the end effector", "unit": "m", "orientation": _STEADY}
            own["tip_pose"] = Ros2Channel(cdr.POSE, {**pose, "frame": self.frame})
        own["mode"] = Ros2Channel(cdr.STRING, {"content": "mode of the site"}, latched=True)
        shares = {"content": "shares of its peers in its reference", "names": " ".join(peers)}
        own["dominance"] = Ros2Channel(cdr.FLOAT64_ARRAY, shares, latched=True)
        robot = {"content": "URDF, with links named after their site"}
        own["robot_description"] = Ros2Channel(cdr.STRING, robot, latched=True)
        arrays = {_name_array(name): array.channel for name, array in shapes.arrays.items()}
        if self._arm.counts.shared == POSE and self._arm.shares_pose:
            turn = {
                "orientation": "rotation vector of the law's error, at most half a turn long"
            }
            arrays["error"] = arrays["error"]._replace(about={**arrays["error"].about, **turn})
        return own | arrays

    def stamp_ns(self, record: State) -> int:
        """Returns the nominal time of a record, Unix ns."""
        return max(0, self._epoch_unix_ns + record.t_ns)

    def pack_record(
        self,
        record: State,
        shares: Sequence[float],
        wanted: Callable[[str], bool] = lambda _topic: True,
    ) -> Iterator[tuple[str, bytes]]:
        """Yields the messages of a record by our names of their topics.

        Args:
            record: the record; records come in the order of their times.
            shares: the site's shares of its peers at that time.
            wanted: False for topics whose messages need not be made.
        """
        stamp_ns = self.stamp_ns(record)
        if wanted("joint_states"):
            yield "joint_states", self._pack_states(stamp_ns, record.q, record.qd, record.tau)
        if not self._arm.shares_pose and wanted("reference"):
            yield "reference", self._pack_reference(stamp_ns, record.q_des, record.qd_des)
        yield from self._pack_tip(record, stamp_ns, wanted)
        if record.mode != self._mode:
            self._mode = record.mode
            yield "mode", cdr.pack_string(record.mode)
        if (numbers := tuple(shares)) != self._shares:
            self._shares = numbers
            yield "dominance", self._pack_shares(*numbers)
        yield from self._pack_arrays(record, wanted)

    def _pack_tip(
        self, record: State, stamp_ns: int, wanted: Callable[[str], bool]
    ) -> Iterator[tuple[str, bytes]]:
        poses = {"tip_pose": (record.x, record.xd)}
        if self._arm.shares_pose:
            poses["reference_pose"] = record.q_des, record.qd_des
        for topic, (pose, rate) in poses.items():
            if wanted(topic):
                # followed for every message that is made, so that the sign never changes between two of them
                turned = self._signs[topic].align(
                    compute_quaternion(self._find_turn(record, pose))
                )
                numbers = *self._find_place(record, pose), *turned
                yield topic, cdr.pack_frame_vectors(stamp_ns, self.frame, *numbers)
            twist = topic.replace("pose", "twist")
            if self._arm.shares_pose and wanted(twist):
                linear = [one / self._scale for one in rate[:POSITION]]
                angular = [*rate[POSITION:], *_NO_TURN][:POSITION]
                yield twist, cdr.pack_frame_vectors(stamp_ns, self.frame, *linear, *angular)
        if self._arm.shares_pose and wanted("tip_wrench"):
            force = [-self._scale * one for one in record.wrench[:POSITION]]
            torque = [-one for one in [*record.wrench[POSITION:], *_NO_TURN][:POSITION]]
            yield "tip_wrench", cdr.pack_frame_vectors(stamp_ns, self.frame, *force, *torque)

    def _find_place(self, record: State, pose: Sequence[float]) -> Sequence[float]:
        """Returns the place of a pose that is shared, or of the end effector in joint space, m."""
        if pose:
            return [one / self._scale for one in pose[:POSITION]]
        return [*self._arm.end_effector(record.q), 0.0][:POSITION]

    def _find_turn(self, record: State, pose: Sequence[float]) -> tuple[float, float, float]:
        """Returns the rotation vector of a pose, rad; of one without orientation the end
        effector's own.
        """
        if len(pose) == POSE:
            return pose[POSITION], pose[POSITION + 1], pose[POSITION + 2]
        return self._arm.end_effector_orientation(record.q)

    def _pack_arrays(
        self, record: State, wanted: Callable[[str], bool]
    ) -> Iterator[tuple[str, bytes]]:
        shapes = self._shapes
        if not any(wanted(_name_array(name)) for name in shapes.record_arrays):
            return
        row = [column[0] for column in stack_signals([record])]
        if wanted("error"):
            yield "error", shapes.arrays["error"].pack(*row[shapes.error_row])
        for name, data in shapes.slow(row[shapes.slow_row]):
            if wanted(_name_array(name)):
                yield _name_array(name), data

    def pack_frames(self, record: State) -> Iterable[bytes]:
        """Yields the messages of a record for `/tf`."""
        stamp_ns = self.stamp_ns(record)
        transforms = zip(self._link_signs, self._robot.transforms(record.q), strict=True)
        steady = [(origin, signs.align(turned)) for signs, (origin, turned) in transforms]
        yield self._robot.pack_transforms(stamp_ns, steady)
        if self._pack_shared is not None:
            origin, upright = self._robot.shared
            yield self._pack_shared(stamp_ns, [*origin, *upright])

    def pack_statistics(self, stats: LinkStats) -> Iterator[tuple[str, bytes]]:
        """Yields the messages of statistics by our names of their topics."""
        yield from self._shapes.statistics(stats)


def _name_array(name: str) -> str:
    """Returns our name of the topic of an array; `mode` is the topic of the mode's word."""
    return "mode_number" if name == "mode" else name


def pack_session_diagnostics(
    session: str, epoch_unix_ns: int, records: Sequence[State]
) -> bytes:
    """Returns a message for `/diagnostics` by the newest record of every site."""
    newest_ns = max((record.t_ns for record in records), default=0)
    parts: list[cdr.Diagnosis] = []
    for record in records:
        values = {"tick": record.tick, "late_us": record.late_us, "busy_us": record.busy_us}
        shown = {key: str(value) for key, value in values.items()}
        level = _LEVELS.get(record.mode, _WARNING)
        parts.append(cdr.Diagnosis(level, f"{session}/{record.site}", record.mode, shown))
    return cdr.pack_diagnostics(max(0, epoch_unix_ns + newest_ns), parts)
