"""Connects a running session with ROS 2 programs, in both directions.

The bridge publishes the states of the sites as standard ROS messages, and offers the orders to
stop and enable arms as ROS services. In the other direction, a ROS topic can

- command an arm, like an operator who holds it,
- set the dominance factors of a site,
- or carry the measurements of a robot, which serves as the external arm of a site.

Invariant:
    - ROS is never part of a control loop. A ROS message enters a session only as an operator's
      target, which the site limits and records, or as a measurement of an external arm. A log
      can therefore be verified without ROS.
    - If two programs publish on a topic that commands an arm, the messages of both are
      rejected. The arm would otherwise move back and forth between two targets.
    - If no target arrives for 200 ms, the arm is released, because the program may have died.
    - A robot for which no valid torque is available receives its safe command repeatedly.
    - An unusable message does not end the bridge. It is rejected, and counted under the reason
      for the rejection. The first rejection for each reason is printed.
"""

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from trilat_net.app import RunningSession
from trilat_net.errors import SessionError, TrilatError, UsageError, count_nouns
from trilat_net.files import refuse_existing
from trilat_net.log.ros2 import (
    COMMON_TOPICS,
    DIAGNOSTICS,
    FRAMES_TOPIC,
    SESSION_CHANNELS,
    RobotTable,
    Ros2SiteChannels,
    TopicTable,
    cdr,
    pack_event,
    pack_session_diagnostics,
)
from trilat_net.net import (
    BRIDGE,
    ArmClient,
    Clock,
    Connection,
    Event,
    Hand,
    Info,
    LinkStats,
    SessionMembers,
    State,
    SystemClock,
    topics,
)
from trilat_net.net.ros2 import ROUTER_ADVICE, Attachment, Refusals, Ros2Graph, TopicPublisher
from trilat_net.process import LOOP_NICE, raise_priority
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Scenario, parse_embedded

from .ros2_topics import RELIABLE, BridgeEnds, SiteTopics

POLL_NS = 1_000_000
"""Minimum time between two polls for messages of the session, in ns."""
POLLS_PER_RECORD = 5.0
"""Number of polls in the time between two published records."""
LOOK_PERIOD_NS = 200_000_000
"""Time between two checks of the connection to the router, in ns."""
SILENCE_NS = 200_000_000
"""Time without a target after which an arm is released, in ns."""
SENDER_TIMEOUT_NS = NS_PER_S
"""Time after its last message for which a publisher counts as present, in ns."""
SAFE_PERIOD_NS = 10_000_000
"""Time between two safe commands to a robot, in ns."""
DRIVE_PERIOD_S = 0.001
"""Time between two checks for a new torque, in s."""
NOTICE_PERIOD_S = 0.5
"""Time between two checks for measurements of a robot, in s."""
FIRST_NOTICE_NS = 2 * NS_PER_S
"""Time without a measurement of a robot after which the user is first notified, in ns."""
NEXT_NOTICE_NS = 60 * NS_PER_S
"""Time without a measurement after which the user is notified again, in ns."""
REQUEST_PERIOD_S = 0.05
"""Time between two checks for new dominance factors, in s."""
TRIGGER = "std_srvs/srv/Trigger"
"""Type of the services, whose requests are empty."""
INBOX_MESSAGES = 4096
"""Capacity of each queue of messages from the session."""

JointNames = Sequence[Sequence[str]]
"""For each joint of an arm, the alternative names of the joint in ROS messages."""


class _SingleSender:
    """Checks that only one program publishes on a topic, for each of its messages.

    Two programs that command the same arm would move it back and forth. The messages of both
    are rejected until one of them has not published for `SENDER_TIMEOUT_NS`.

    Args:
        clock: Clock of this process.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._publisher = b""
        self._received_ns = clock.monotonic_ns() - SENDER_TIMEOUT_NS
        # Time of the last message whose publisher differed from the one before.
        self._conflict_ns = self._received_ns

    def admit(self, publisher: bytes) -> int:
        """Accepts a publisher's message, or raises ValueError if there is another publisher.

        While two publishers send messages, the messages of both are rejected.

        Args:
            publisher: Identity of the publisher as stated in the message, see `Attachment.gid`.

        Returns:
            The time since the previous message, in ns.

        Raises:
            ValueError: Another publisher has sent a message within `SENDER_TIMEOUT_NS`.
        """
        now_ns = self._clock.monotonic_ns()
        silent_ns = now_ns - self._received_ns
        is_other_publisher = self._publisher not in (b"", publisher)
        if is_other_publisher and silent_ns < SENDER_TIMEOUT_NS:
            self._conflict_ns = now_ns

        self._publisher = publisher
        self._received_ns = now_ns

        has_recent_conflict = now_ns - self._conflict_ns < SENDER_TIMEOUT_NS
        if has_recent_conflict:
            raise ValueError(
                "has two publishers: the messages of both are refused until one of them is "
                "silent"
            )
        return silent_ns


class TargetTopic:
    """Subscription to a ROS topic on which another program commands an arm.

    The topic is `target_pose`, `target_joint` or `target_wrench`. Each message is converted to
    a target and sent to the site of the arm, which treats the ROS program as the operator who
    holds the arm.

    Args:
        hand: Connection to the site, through which the ROS program acts as the arm's operator.
        read: Function that converts a message to a target. Raises ValueError for an invalid
            message.
        apply: Function that sends a target to the site.
        clock: Clock of this process.

    Attributes:
        hand: Connection to the site.
    """

    def __init__(
        self,
        hand: Hand,
        read: Callable[[bytes], Sequence[float]],
        apply: Callable[..., int],
        clock: Clock,
    ) -> None:
        self.hand = hand
        self._read = read
        self._apply = apply
        self._clock = clock
        self._sender = _SingleSender(clock)
        self._lock = threading.Lock()
        # Time of the newest target; `None` while the topic does not hold the arm.
        self._received_ns: int | None = None

    def receive(self, data: bytes, attachment: Attachment) -> None:
        """Receives a message on the topic, and sends its target to the arm's site.

        Called in a thread of the network library Zenoh.

        Args:
            data: The message, encoded in CDR, the binary format of ROS 2.
            attachment: Additional data of the message that identify the publishing program.

        Raises:
            ValueError: The message cannot be read, or two programs publish on the topic. In the
                second case, the arm is released.
            TrilatError: The target is rejected.
        """
        with self._lock:
            # Two programs that command the arm would move it back and forth.
            try:
                self._sender.admit(attachment.gid)
            except ValueError:
                self._release_hand()
                raise
            target = self._read(data)
            self._apply(*target)
            self._received_ns = self._clock.monotonic_ns()

    def watch(self) -> None:
        """Releases the arm if the ROS program has sent no target for `SILENCE_NS`.

        The bridge calls this method regularly, so that a program that has failed does not keep
        holding the arm.
        """
        with self._lock:
            if self._received_ns is None:
                return
            silent_ns = self._clock.monotonic_ns() - self._received_ns
            if silent_ns > SILENCE_NS:
                self._release_hand()

    def _release_hand(self) -> None:
        """Releases the arm if it is currently moved by targets from a ROS 2 topic.

        The next target takes control of the arm again.
        """
        if self._received_ns is not None:
            self._received_ns = None
            self.hand.release()


class DominanceTopic:
    """Subscription to a ROS topic that sets the dominance factors of a site.

    The topic is `set_dominance`. Requests to the site wait for its reply, and are therefore
    sent by a separate thread. If several messages arrive during this wait, only the newest is
    used. Messages that repeat the last request are ignored, unless no message has arrived for a
    second.

    Args:
        peers: Names of the peers, in the order of the dominance factors in a message.
        change: Function that requests dominance factors from the site, and waits for its reply.
        clock: Clock of this process.
    """

    def __init__(
        self,
        peers: Sequence[str],
        change: Callable[[dict[str, float]], object],
        clock: Clock,
    ) -> None:
        self._peers = peers
        self._change = change
        self._sender = _SingleSender(clock)
        self._requested: dict[str, float] | None = None
        self._sent_request: dict[str, float] | None = None

    def receive(self, data: bytes, attachment: Attachment) -> None:
        """Receives a message with the dominance factors of a site.

        The factors are stored until `send_request` sends them to the site. Called in a thread
        of the network library Zenoh.

        Args:
            data: The message, encoded in CDR, the binary format of ROS 2. It contains one
                dominance factor per peer.
            attachment: Additional data of the message that identify the publishing program.

        Raises:
            ValueError: The message cannot be read, or two programs publish on the topic.
        """
        shares = _check_finite(cdr.read_float_array(data))
        if len(shares) != len(self._peers):
            count_text = count_nouns(len(shares), "number")
            peers_text = ", ".join(self._peers)
            raise ValueError(
                f"has {count_text}, but needs one weight for each peer: {peers_text}"
            )

        silence_ns = self._sender.admit(attachment.gid)
        # After a pause, the weights are requested again even if they have not changed.
        if silence_ns > SENDER_TIMEOUT_NS:
            self._sent_request = None
        peer_shares = zip(self._peers, shares, strict=True)
        self._requested = dict(peer_shares)

    def send_request(self) -> None:
        """Asks the site to use the newest dominance factors, and waits for its reply.

        Does nothing if no new dominance factors have arrived since the last call.

        Raises:
            TrilatError: The site rejects the dominance factors.
        """
        requested = self._requested
        if requested is not None and requested != self._sent_request:
            self._sent_request = requested
            self._change(requested)


class _SilenceNotice:
    """Composes notices for the user while a robot sends no measurements.

    The first notice is due after `FIRST_NOTICE_NS` without a measurement, and further notices
    every `NEXT_NOTICE_NS`. A measurement restarts this sequence.

    Args:
        joints: Alternative names of each joint of the arm in ROS messages.
        clock: Clock of this process.
    """

    def __init__(self, joints: JointNames, clock: Clock) -> None:
        self._joints = joints
        self._clock = clock
        self._due_ns = clock.monotonic_ns() + FIRST_NOTICE_NS
        self._has_message = False
        self._has_measurement = False
        self._other_joints: Sequence[str] = ()

    def note_message(self, other_joints: Sequence[str] = ()) -> None:
        """Records that a message from the robot has arrived, even if it is not a measurement.

        Args:
            other_joints: Names of the joints in the message, if none of them belongs to the
                arm.
        """
        self._has_message = True
        if other_joints:
            self._other_joints = other_joints

    def note_measurement(self) -> None:
        """Records that a measurement from the robot was sent to the site.

        The next notice is then due after `FIRST_NOTICE_NS` without a measurement.
        """
        self._has_measurement = True
        self._due_ns = self._clock.monotonic_ns() + FIRST_NOTICE_NS

    def pop(self, topic: str, site: str) -> str:
        """Returns a notice that the robot sends no measurements, or "" if no notice is due.

        The notice states whether measurements have stopped, no message has arrived yet, or the
        messages contain only joints with other names.

        Args:
            topic: Name of the topic, with its leading slash.
            site: Name of the site that waits for the robot.
        """
        now_ns = self._clock.monotonic_ns()
        if now_ns < self._due_ns:
            return ""

        self._due_ns = now_ns + NEXT_NOTICE_NS

        if self._has_measurement:
            return f"no further measurement on {topic}: {site} has lost its arm"
        if not self._has_message:
            return f"no message on {topic} yet: {site} waits for its arm"

        text = f"no measurement on {topic} yet: {site} waits for its arm"
        if self._other_joints:
            joint_names = ", ".join(names[0] for names in self._joints)
            text += f" with {joint_names}; a message has {', '.join(self._other_joints[:9])}"
        return text


class RobotArm:
    """A ROS robot that serves as the external arm of a site.

    The joint states of the robot are sent to the site, and the torque commanded by the site is
    sent to the controller of the robot, as in a driver that uses `ArmClient`. While the arm
    must brake, the safe command is sent to the controller repeatedly.

    Args:
        make_client: Function that connects to the process in which the site currently runs.
        joints: Alternative names that the robot may use for each joint, in scenario order.
        robot: Settings of the robot.
        commands: Publisher of the commands to the controller.
        clock: Clock of this process.

    Attributes:
        armed: False while the robot must receive only safe commands. The bridge sets it to True
            once the scenario is known.
        silence: Notices for the user while the robot sends no measurements.

    Raises:
        UsageError: The settings do not have one entry per joint.
    """

    def __init__(
        self,
        make_client: Callable[[], ArmClient],
        joints: JointNames,
        robot: RobotTable,
        commands: TopicPublisher,
        clock: Clock,
    ) -> None:
        self.armed = False
        self._make_client = make_client
        self._client = make_client()
        self._joints = joints

        controller = robot.controller or [names[0] for names in joints]
        self._safe_command = robot.safe or [0.0] * len(joints)
        self._joint_order = _order_joints(joints, controller, self._safe_command)
        controller_dimension = (" ".join(controller), len(controller))
        self._pack = cdr.make_float_array_packer(controller_dimension)

        self._commands = commands
        self._clock = clock
        self.silence = _SilenceNotice(joints, clock)
        self._sender = _SingleSender(clock)
        self._lock = threading.Lock()
        # Process start (boot) and tick of the record whose torque was published last.
        self._published_tick: tuple[int, int] | None = None
        self._safe_ns = clock.monotonic_ns() - SAFE_PERIOD_NS

    def receive(self, data: bytes, attachment: Attachment) -> None:
        """Forwards the joint states in a message to the site. Called in a thread of Zenoh.

        A message without any of the joints belongs to another robot and is ignored.

        Args:
            data: The message, encoded in CDR, the binary format of ROS 2.
            attachment: Attachment of the message, which identifies the publisher.

        Raises:
            ValueError: The message cannot be read, or two programs publish on the topic.
        """
        self.silence.note_message()
        state = cdr.RosJoints.read(data)
        known_names = {name for names in self._joints for name in names}
        is_other_robot = bool(state.names) and known_names.isdisjoint(state.names)
        if is_other_robot:
            self.silence.note_message(state.names)
            return

        indices = _find_joint_indices(self._joints, state)
        if len(state.velocity) != len(state.position):
            positions = count_nouns(len(state.position), "position")
            velocities = count_nouns(len(state.velocity), "velocity")
            raise ValueError(f"has {positions} and {velocities}")

        q = _check_finite([state.position[index] for index in indices])
        qd = _check_finite([state.velocity[index] for index in indices])
        with self._lock:
            self._sender.admit(attachment.gid)
            self._client.send(q, qd, stamp_ns=state.stamp_ns)
        self.silence.note_measurement()

    def send_command(self) -> None:
        """Sends the robot the site's newest torque, or the safe command if the arm must brake.

        Each torque is sent only once.
        """
        # A site that was restarted needs another client, as a client follows one process.
        if self._client.over:
            with self._lock:
                self._client = self._make_client()

        record = self._client.record
        torque = self._client.torque()  # from `record`, or from a newer record
        if record is None or torque is None or not self._may_apply(torque):
            waited_ns = self._clock.monotonic_ns() - self._safe_ns
            if waited_ns >= SAFE_PERIOD_NS:
                self.send_safe_command()
            return

        record_identity = (record.boot, record.tick)
        if record_identity != self._published_tick:
            self._published_tick = record_identity
            ordered_torque = [torque[index] for index in self._joint_order]
            self._commands.put(self._pack(*ordered_torque))

    def _may_apply(self, torque: Sequence[float]) -> bool:
        """Returns True if a torque may be passed on to the robot.

        The robot must be armed, and the torque must have one entry per joint.
        """
        return self.armed and len(torque) == len(self._joint_order)

    def send_safe_command(self) -> None:
        """Sends the robot the command from its settings that makes it brake or hold still."""
        self._safe_ns = self._clock.monotonic_ns()
        self._commands.put(self._pack(*self._safe_command))


def _order_joints(
    joints: JointNames,
    controller: Sequence[str],
    safe_command: Sequence[float],
) -> list[int]:
    """Finds the joint of the scenario that corresponds to each joint of the controller.

    A robot's controller may list its joints in an order that differs from the scenario, and may
    have additional joints.

    Args:
        joints: Alternative names of each joint, in scenario order.
        controller: Names of the joints, in the order of the controller.
        safe_command: Command sent to the controller while the arm brakes.

    Returns:
        For each joint of the controller, its index in the scenario.

    Raises:
        UsageError: The controller or the safe command does not have one entry per joint.
    """
    joint_count = len(joints)
    joint_order: list[int] = []
    for controller_name in controller:
        for index, names in enumerate(joints):
            if controller_name in names:
                joint_order.append(index)
    # Each joint occurs exactly once if the sorted indices are 0, 1, ... count - 1.
    all_indices = list(range(joint_count))
    has_each_joint = sorted(joint_order) == all_indices
    is_controller_valid = has_each_joint and len(controller) == joint_count
    has_safe_numbers = len(safe_command) == joint_count
    is_safe_valid = has_safe_numbers and all(map(math.isfinite, safe_command))

    if not is_controller_valid or not is_safe_valid:
        known_joints = ", ".join(names[0] for names in joints)
        raise UsageError(
            "--names: `controller` and `safe` must each have one entry for every joint "
            f"({known_joints}), and the numbers of `safe` must be finite"
        )
    return joint_order


def _find_joint_indices(joints: JointNames, state: cdr.RosJoints) -> list[int]:
    """Finds the index of each joint of an arm in a joint state message.

    The message may contain additional joints, in any order.

    Args:
        joints: Alternative names of each joint, in the order of the arm.
        state: The message.

    Returns:
        For each joint of the arm, its index among the joints of the message.

    Raises:
        ValueError: A joint is missing or appears twice.
    """
    if len(state.names) != len(state.position):
        name_count = count_nouns(len(state.names), "name")
        position_count = count_nouns(len(state.position), "position")
        raise ValueError(f"has {name_count} and {position_count}")

    message_names = set(state.names)
    missing_joints = [names[0] for names in joints if message_names.isdisjoint(names)]
    if missing_joints:
        present_names = ", ".join(state.names[:9]) or "no names"
        missing_text = ", ".join(missing_joints)
        raise ValueError(f"lacks {missing_text}; the message has {present_names}")

    for names in joints:
        for name in names:
            if state.names.count(name) > 1:
                raise ValueError(f"has {name} twice")

    indices: list[int] = []
    for names in joints:
        present_name = next(name for name in names if name in state.names)
        indices.append(state.names.index(present_name))
    return indices


def read_joint_target(joints: JointNames, data: bytes) -> list[float]:
    """Extracts the commanded joint angles in rad from a ROS program's message.

    The message names the joints, so their order may differ from that in the scenario.

    Args:
        joints: Alternative names of each joint, in the order of the arm.
        data: The `JointState` message, encoded in CDR, the binary format of ROS 2.

    Returns:
        The angles in rad, in the order of the arm's joints.

    Raises:
        ValueError: The message cannot be read, or lacks a joint.
    """
    state = cdr.RosJoints.read(data)
    indices = _find_joint_indices(joints, state)
    return _check_finite([state.position[index] for index in indices])


def _check_finite(numbers: Sequence[float]) -> list[float]:
    """Returns the numbers of a ROS 2 message as a list, after checking that all are finite.

    A NaN or infinity could make a robot move uncontrollably.

    Raises:
        ValueError: A number is not finite.
    """
    if not all(map(math.isfinite, numbers)):
        raise ValueError("has a number that is not finite")
    return list(numbers)


def read_vector_target(
    frame: str,
    axes: int,
    count: int,
    data: bytes,
) -> list[float]:
    """Extracts the commanded position in m or force in N from a ROS program's message.

    The message is a `PoseStamped` for a position, and a `WrenchStamped` for a force.

    Args:
        frame: Name of the coordinate frame in which the arm expects the vector.
        axes: Number of coordinates to return.
        count: How many numbers the message contains: 7 in a pose, 6 in a wrench.
        data: The message, encoded in CDR, the binary format of ROS 2.

    Returns:
        The position in m, or the force in N.

    Raises:
        ValueError: The message cannot be read, is in another frame, or contains a number that
            is not finite.
    """
    message_frame, numbers = cdr.read_frame_vectors(data, count)
    # An empty name means the default frame.
    if message_frame not in ("", frame):
        raise ValueError(
            f"is in the frame {message_frame[:80]!r}, but this site uses {frame!r}"
        )
    return _check_finite(numbers[:axes])


class _Bridge:
    """Connects one running session with ROS 2.

    Once the object has been created, ROS programs see its topics and services. `run` then
    publishes the records, events and statistics of the session.

    Args:
        ends: Connections to ROS and to the session.
        scenario: Scenario of the session.
        epoch_unix_ns: Start of the session in Unix time, in ns.

    Attributes:
        targets: Maps the names of topics that command an arm to the subscriptions.
        dominance: Maps the names of topics that set dominance factors to the subscriptions.
    """

    def __init__(self, ends: BridgeEnds, scenario: Scenario, epoch_unix_ns: int) -> None:
        graph = ends.graph
        bus = ends.bus
        session = ends.session
        self._ends = ends
        self._scenario = scenario
        self._epoch_unix_ns = epoch_unix_ns

        # Messages from the session.
        members = SessionMembers(bus, ends.clock, session)
        self._members = members
        self._read_records = members.subscribe(State, capacity=INBOX_MESSAGES)
        self._read_events = members.subscribe(Event, capacity=INBOX_MESSAGES)
        self._read_statistics = members.subscribe(LinkStats, capacity=INBOX_MESSAGES)
        presence_key = topics.presence_key(session, "*")
        self._presence = bus.presence(presence_key)
        self._present = set[topics.KeyParts]()
        self._has_seen_site = False

        # Publishers of the ROS topics: of the session, and of each site.
        frames = graph.publisher(FRAMES_TOPIC, COMMON_TOPICS[FRAMES_TOPIC].kind, RELIABLE)
        self._diagnostics = graph.publisher(
            DIAGNOSTICS, COMMON_TOPICS[DIAGNOSTICS].kind, RELIABLE
        )
        self._lines: dict[str, TopicPublisher] = {}
        for name, channel in SESSION_CHANNELS.items():
            topic = f"{session}/{name}"
            self._lines[name] = graph.publisher(topic, channel.kind, RELIABLE)
        self._sites: dict[str, SiteTopics] = {}
        for site in scenario.names:
            self._sites[site] = SiteTopics(
                ends=ends,
                scenario=scenario,
                site=site,
                epoch_unix_ns=epoch_unix_ns,
                frames=frames,
            )

        # Subscriptions and services through which ROS programs influence the session.
        running = RunningSession(session, Connection(), bus, ends.clock)
        self.targets: dict[str, TargetTopic] = {}
        self.dominance: dict[str, DominanceTopic] = {}
        for site in scenario.names:
            self._subscribe_dominance(site, running)
        for site in scenario.open_hands:
            self._subscribe_target(site, running)
        _serve_orders(graph, running, scenario.names)

    def _subscribe_dominance(self, site: str, running: RunningSession) -> None:
        """Subscribes to the topic that sets the dominance factors of a site.

        Changes from before the start of the bridge are read first, because they determine the
        current dominance factors, which the bridge publishes.

        Args:
            site: Name of the site.
            running: Connection that requests the changes.
        """
        ends = self._ends
        # The changes before the bridge was started determine the site's present shares.
        shares = self._sites[site].shares
        for event in self._members.list_past_events(site):
            shares.add_change(event.command)

        topic = ends.topic(site, "set_dominance")
        change = partial(running.set_dominance, site)
        peers = self._scenario.peers(site)
        dominance = DominanceTopic(peers, change, ends.clock)
        self.dominance[topic] = dominance
        ends.graph.subscribe(topic, cdr.FLOAT64_ARRAY, dominance.receive)

    def _subscribe_target(self, site: str, running: RunningSession) -> None:
        """Subscribes to the topic on which a ROS program moves an arm, as its operator.

        This lets a person or a program in ROS move an arm of the session.

        Args:
            site: Name of the arm's site, whose scenario must allow a live hand.
            running: Connection through which the targets are sent.
        """
        ends = self._ends
        hand = running.open_hand(ends.bus, site, self._scenario, "ros2")

        frame = self._sites[site].frame
        topic_name, kind, read, apply = _describe_target(self._scenario, site, hand, frame)
        topic = ends.topic(site, topic_name)

        target = TargetTopic(hand, read, apply, ends.clock)
        self.targets[topic] = target
        ends.graph.subscribe(topic, kind, target.receive)

    def run(
        self, rate_hz: float, stopped: Callable[[], bool], say: Callable[[str], None]
    ) -> bool:
        """Forwards messages of the session to ROS 2 topics until the session ends.

        Args:
            rate_hz: Rate at which the newest records are published, in 1/s.
            stopped: Function that returns True to end the call.
            say: Function that prints a line for the user.

        Returns:
            True if another session with the same name has begun.
        """
        clock = self._ends.clock
        is_connected = True
        now_ns = clock.monotonic_ns()
        wake_up_ns = now_ns
        checked_ns = now_ns
        diagnosed_ns = now_ns
        polls_hz = POLLS_PER_RECORD * rate_hz
        poll_ns = max(POLL_NS, int(NS_PER_S / polls_hz))
        while not stopped() and not self._have_sites_left():
            if self._publish_messages(rate_hz):
                return True
            for target in self.targets.values():
                target.watch()

            now_ns = clock.monotonic_ns()
            if now_ns - checked_ns > LOOK_PERIOD_NS:
                checked_ns = now_ns
                was_connected = is_connected
                is_connected = self._ends.graph.connected
                if is_connected != was_connected:
                    state = "is back" if is_connected else "is gone: waiting for it"
                    say(f"the router of ROS {state}")
            if now_ns - diagnosed_ns > NS_PER_S:
                diagnosed_ns = now_ns
                self._publish_diagnostics()

            wake_up_ns = max(wake_up_ns + poll_ns, now_ns)
            clock.sleep_until(wake_up_ns)
        return False

    def _have_sites_left(self) -> bool:
        """Returns True if sites were present and all have left, so that the bridge may end."""
        return self._has_seen_site and not self._present

    def _publish_messages(self, rate_hz: float) -> bool:
        """Publishes the records, events and statistics that have arrived from the session.

        Called repeatedly, so that ROS programs see the newest states of the arms.

        Returns:
            True if another session with the same name has begun.
        """
        for record in self._read_records():
            if record.site in self._sites:
                self._sites[record.site].publish(record, rate_hz)

        has_new_epoch = False
        for event in self._read_events():
            if event.kind == "epoch" and event.epoch_unix_ns != self._epoch_unix_ns:
                has_new_epoch = True
            if event.member in self._sites:
                member_topics = self._sites[event.member]
                member_topics.shares.add_change(event.command)
            stamp_ns = self._ends.clock.unix_ns()
            for name, data in pack_event(event, stamp_ns):
                self._lines[name].put(data)

        for stats in self._read_statistics():
            if stats.site in self._sites:
                self._sites[stats.site].publish_statistics(stats)

        for parts, is_present in topics.read_presence(self._presence):
            if parts.member in self._sites:
                self._has_seen_site = True
                if is_present:
                    self._present.add(parts)
                else:
                    self._present.discard(parts)
        return has_new_epoch

    def _publish_diagnostics(self) -> None:
        """Publishes the state of all sites on /diagnostics, which ROS tools display.

        No message is composed while no ROS program subscribes.
        """
        if not self._diagnostics.has_subscribers:
            return
        newest = [site_topics.newest for site_topics in self._sites.values()]
        records = [record for record in newest if record is not None]
        data = pack_session_diagnostics(self._ends.session, self._epoch_unix_ns, records)
        self._diagnostics.put(data)


def _describe_target(
    scenario: Scenario,
    site: str,
    hand: Hand,
    frame: str,
) -> tuple[str, str, Callable[[bytes], Sequence[float]], Callable[..., int]]:
    """Determines the topic that commands the arm of a site, and how its messages are used.

    Another program commands the arm on a ROS 2 topic, in the role of the site's operator. The
    type of the topic depends on whether the scenario's operator moves the end effector, moves
    the joints, or applies forces.

    Args:
        scenario: Scenario of the session.
        site: Name of the site, which must have a live operator.
        hand: Connection to the site, through which the ROS program acts as the arm's operator.
            Its method `turn` sends joint angles, `push` a force, and `move` a position of the
            end effector.
        frame: Name of the coordinate frame of the positions and forces in the messages.

    Returns:
        topic: Name of the topic.
        type: Name of the ROS type of its messages.
        read: Function that converts an encoded message to a target: joint angles, a force or a
            position. Raises ValueError for an invalid message.
        send: Function that sends the target to the site.
    """
    operator = scenario.sites[site].find_live_hand(is_open=True)
    assert operator is not None
    initial_q = scenario.sites[site].q0_rad
    end_effector = scenario.arms[site].end_effector(initial_q)
    axes = len(end_effector)  # 2 for an arm in a plane, 3 in space

    if operator.mode == "joint":
        read_joints = partial(read_joint_target, _list_joint_names(scenario, site))
        return "target_joint", cdr.JOINT_STATE, read_joints, hand.turn

    if operator.mode == "force":
        wrench_length = 6  # force and moment
        read_force = partial(read_vector_target, frame, axes, wrench_length)
        return "target_wrench", cdr.WRENCH, read_force, hand.push

    pose_length = 7  # position and quaternion
    read_position = partial(read_vector_target, frame, axes, pose_length)
    return "target_pose", cdr.POSE, read_position, hand.move


def _list_joint_names(scenario: Scenario, site: str) -> list[tuple[str, ...]]:
    """Lists the alternative names of each joint of an arm in ROS 2 messages.

    Args:
        scenario: Scenario of the session.
        site: Name of the site of the arm.

    Returns:
        For each joint, its name in the ROS topics of this program, and its name in the
        scenario.
    """
    topic_names = Ros2SiteChannels(scenario, site).joints
    scenario_names = scenario.arms[site].joint_names
    pairs = zip(topic_names, scenario_names, strict=True)
    # Often both names are equal. A dictionary removes the duplicate.
    return [tuple(dict.fromkeys(pair)) for pair in pairs]


def _serve_orders(graph: Ros2Graph, running: RunningSession, sites: Sequence[str]) -> None:
    """Offers the orders to stop, enable and reset arms, and to end a session, as ROS services.

    The names of the services are `/<session>/stop` for all sites, `/<session>/<site>/stop` for
    one site, and analogous names for the other orders.

    Args:
        graph: Connection to the ROS programs.
        running: The session.
        sites: Names of the sites of the session.
    """

    def serve(order: Callable[..., list[str]], *site: str) -> None:
        """Offers a ROS 2 service that sends an order, such as "stop", to one arm or to all.

        Args:
            order: Method of `RunningSession` that sends the order. The service has the same
                name.
            *site: Name of the site. If omitted, the order is sent to all sites.
        """
        name_parts = [running.name, *site, order.__name__]
        name = "/".join(name_parts)
        graph.serve(name, TRIGGER, lambda _request: _send_order(order, *site))

    for order in (running.stop, running.enable, running.reset):
        serve(order)
        for site in sites:
            serve(order, site)
    serve(running.end)


def _send_order(order: Callable[..., list[str]], *sites: str) -> bytes:
    """Sends an order, such as "stop", to sites, and returns the response of the ROS service.

    Args:
        order: Method of `RunningSession` that sends the order.
        *sites: Names of the sites. If omitted, the order is sent to all sites.

    Returns:
        The encoded response, with the replies of the sites or the error.
    """
    try:
        replies = order(*sites)
    except TrilatError as error:
        return cdr.pack_trigger_response(success=False, text=str(error))
    replies_text = "; ".join(replies)
    return cdr.pack_trigger_response(success=True, text=replies_text)


@contextmanager
def _repeat_in_thread(
    period_s: float, act: Callable[[], None], finish: Callable[[], None] = lambda: None
) -> Iterator[None]:
    """Calls a function at regular intervals in a thread, while a `with` block runs.

    Args:
        period_s: Time between two calls, in s.
        act: Function to call repeatedly.
        finish: Function that is called once after the thread has ended.
    """
    is_over = threading.Event()

    def repeat() -> None:
        while not is_over.wait(period_s):
            act()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()
        finish()


def serve_ros2(
    running: RunningSession,
    open_graph: Callable[[Refusals], Ros2Graph],
    rate_hz: float,
    table: TopicTable,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    timeout_s: float,
    rviz: Path | None = None,
) -> None:
    """Runs the bridge of a session, for the command `trilat ros2`.

    Waits for a ROS router and for the session. If another session with the same name begins,
    the function reconnects to ROS and continues with that session.

    Args:
        running: The session.
        open_graph: Function that connects to the ROS programs.
        rate_hz: Rate at which records are published, in 1/s.
        table: Names of the topics, and settings of the robots.
        stopped: Function that returns True to end the call.
        say: Function that prints a line for the user.
        timeout_s: Maximum time to wait for the first site of the session, or for the router
            through which the site is reached, in s.
        rviz: Path of the RViz configuration to write, with which RViz shows the session. If
            None, no file is written.

    Raises:
        SessionError: The session cannot be reached in time.
        UsageError: The endpoint of the ROS router belongs to another program, the file exists,
            or the settings of a robot do not fit the session.
    """
    clock = SystemClock()
    if rviz is not None:
        refuse_existing(rviz, force=False)

    with running.reach(BRIDGE, timeout_s) as bus:
        has_new_epoch = True
        is_announced = False
        while has_new_epoch and not stopped():
            try:
                graph = open_graph(Refusals(say))
            except SessionError as silent:
                if not is_announced:
                    say(f"{silent}: waiting for it; {ROUTER_ADVICE}")
                is_announced = True
                clock.sleep_until(clock.monotonic_ns() + LOOK_PERIOD_NS)
                continue

            with graph:
                ends = BridgeEnds(
                    graph=graph,
                    bus=bus,
                    clock=clock,
                    session=running.name,
                    table=table,
                )
                has_new_epoch = publish_session(ends, rate_hz, stopped, say, rviz)


def publish_session(
    ends: BridgeEnds,
    rate_hz: float,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    rviz: Path | None = None,
) -> bool:
    """Waits until a session begins, and connects it to ROS 2 until the session ends.

    Robots are connected before the session begins, because the session begins only when they
    send measurements.

    Args:
        ends: Connections to ROS and to the session.
        rate_hz: Rate at which records are published, in 1/s.
        stopped: Function that is called repeatedly. The connection ends early when it returns
            True.
        say: Function that prints a line for the user.
        rviz: Path of the RViz configuration to write, with which RViz shows the session. If
            None, no file is written.

    Returns:
        True if the session was replaced with another session of the same name, to which the
        caller must reconnect. False if the session has ended or `stopped` returned True.
    """
    with ExitStack() as stack:
        robots: dict[str, RobotArm] = {}
        for site, robot in ends.table.robots.items():
            # A robot whose joints are named needs no scenario, and can start before any site
            # replies.
            if robot.joints:
                robot_context = _open_robot(ends, site, robot, say)
                robots[site] = stack.enter_context(robot_context)

        say(f"waiting for session {ends.session!r} to begin")
        info = _await_site(ends, stopped, running=False)
        if info is None:
            return False
        scenario = parse_embedded(info.scenario, ends.session)
        ends.table.refuse_other_robots(scenario)
        for site in scenario.outside:
            if site not in robots:
                robot = ends.table.robots.get(site, RobotTable())
                names = _list_joint_names(scenario, site)
                robot_context = _open_robot(ends, site, robot, say, names)
                robots[site] = stack.enter_context(robot_context)
            robots[site].armed = True
        if robots:
            # a site is in fault when its arm's measurements are delayed by 0.2 s
            raise_priority(LOOP_NICE)

        running_info = _await_site(ends, stopped, running=True)
        if running_info is None:
            return False

        bridge = _Bridge(ends, scenario, running_info.epoch_unix_ns)
        for target in bridge.targets.values():
            stack.enter_context(target.hand)
        for topic, dominance in bridge.dominance.items():
            # A request waits for the site's reply, and must not delay the records.
            send_request = ends.graph.refusals.guard(topic, dominance.send_request)
            stack.enter_context(_repeat_in_thread(REQUEST_PERIOD_S, send_request))
        session_text = f"session {ends.session} is in the graph of ROS 2: /{ends.session}/..."
        input_clauses = _describe_inputs(ends, bridge, robots)
        say("; ".join([session_text, *input_clauses]))
        if rviz is not None:
            ends.write_rviz_config(scenario, rviz)
            say(f"{rviz} shows the arms; open it with: rviz2 -d {rviz}")
        return bridge.run(rate_hz, stopped, say)


def _describe_inputs(ends: BridgeEnds, bridge: _Bridge, robots: Iterable[str]) -> list[str]:
    """Describes for the user which ROS topics influence the session, and how.

    A ROS program can publish target positions for an arm, as the operator of that arm. A robot
    that is the arm of a site publishes its measured joint states.

    Args:
        ends: Connections to ROS and to the session.
        bridge: The bridge of the session, which contains the target topics.
        robots: Names of the sites whose arm is a ROS robot.

    Returns:
        One clause per topic, such as "/session/s/robot_states measures the arm of s".
    """
    clauses = [f"/{topic} commands an arm" for topic in bridge.targets]
    for site in robots:
        topic = ends.topic(site, "robot_states")
        clauses.append(f"/{topic} measures the arm of {site}")
    return clauses


@contextmanager
def _open_robot(
    ends: BridgeEnds,
    site: str,
    robot: RobotTable,
    say: Callable[[str], None],
    joints: JointNames = (),
) -> Iterator[RobotArm]:
    """Context manager that connects the ROS robot of a site.

    Inside the `with` block, joint states and torques are exchanged. At its end, the robot
    receives its safe command.

    Args:
        ends: Connections to ROS and to the session.
        site: Name of the site whose arm is the robot.
        robot: Settings of the robot.
        say: Function that prints a line for the user.
        joints: Alternative names of each joint, in scenario order. If empty, the names in the
            settings are used.

    Yields:
        The robot.
    """
    commands_topic = ends.topic(site, "robot_commands")
    states_topic = ends.topic(site, "robot_states")
    commands = ends.graph.publisher(commands_topic, cdr.FLOAT64_ARRAY, RELIABLE)
    arm = RobotArm(
        make_client=partial(ArmClient, ends.bus, ends.clock, ends.session, site),
        joints=joints or [(name,) for name in robot.joints],
        robot=robot,
        commands=commands,
        clock=ends.clock,
    )
    ends.graph.subscribe(states_topic, cdr.JOINT_STATE, arm.receive)

    def report_silence() -> None:
        """Prints a notice that the robot sends no measurements, if such a notice is due."""
        notice = arm.silence.pop(f"/{states_topic}", site)
        if notice:
            say(notice)

    with (
        _repeat_in_thread(NOTICE_PERIOD_S, report_silence),
        _repeat_in_thread(DRIVE_PERIOD_S, arm.send_command, arm.send_safe_command),
    ):
        yield arm


def _await_site(ends: BridgeEnds, stopped: Callable[[], bool], *, running: bool) -> Info | None:
    """Waits until any site of the session replies to a query for its identity.

    A session that has not started yet, or is on another machine, may take a while to appear.

    Args:
        ends: Connections to ROS and to the session.
        stopped: Function that returns True to end the wait.
        running: True to wait until a site is running. If False, a site that is still waiting
            for others is accepted.

    Returns:
        The identity of the site, or None if `stopped` returned True.
    """
    members = SessionMembers(ends.bus, ends.clock, ends.session)
    for info in members.find(stopped=stopped, timeout_s=None):
        # Members without a scenario, such as the recorder, are not sites.
        is_site = bool(info.scenario)
        if is_site and (info.running or not running):
            return info
    return None
