"""The bridge of a session to the graph of ROS 2: orders as services, and topics that are hands
and robots.

Invariant: ROS never sits in a loop. What comes from it enters only as a hand's message, which
the site limits, fades and records, or as a measurement of an external arm, so that a log is
verified without ROS. A topic that two publishers share moves nothing; a target that falls
silent for 200 ms lets go. A robot without a valid torque gets what is safe for it, never mere
silence. Nothing that comes from ROS ends the bridge: it is refused, counted by its reason, and
the first of each reason is said.
"""

import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import TrilatError, UsageError, count_nouns
from trilat_net.log.ros2 import cdr
from trilat_net.log.ros2.published import COMMON_TOPICS, pack_session_diagnostics
from trilat_net.log.ros2.ros2_messages import SESSION_CHANNELS, Ros2SiteChannels, pack_event
from trilat_net.log.ros2.topic_names import DIAGNOSTICS, FRAMES, RobotTable, TopicTable
from trilat_net.net import topics
from trilat_net.net.arm_client import ArmClient, Hand
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.connection import Connection
from trilat_net.net.discovery import find_members, list_past_events
from trilat_net.net.membership import read_messages, read_records
from trilat_net.net.messages import Event, Info, LinkStats
from trilat_net.net.ros2_graph import Attachment, Refusals, Ros2Graph, TopicPublisher
from trilat_net.net.zenoh_bus import RouterSilent
from trilat_net.net.zenoh_config import BRIDGE
from trilat_net.scenario import Scenario, parse_embedded

from .ros2_topics import RELIABLE, Ends, SiteTopics
from .running_session import RunningSession, open_hand

POLL_NS = 1_000_000
"""Least time between two looks at what has come."""
LOOK_NS = 200_000_000
"""Between two looks for what is not there yet, or not any more."""
SILENCE_NS = 200_000_000
"""A target that nobody repeats for so long lets the arm go."""
RIVAL_NS = NS_PER_S
"""A publisher that was heard within this time has not gone."""
SAFE_NS = 10_000_000
"""Between two commands that say to a robot what is safe."""
DRIVE_S = 0.001
ASK_S = 0.05
"""Between two looks for a torque; for shares that are wanted."""
TRIGGER = "std_srvs/srv/Trigger"


class OneSender:
    """Of several publishers that send on one topic none counts, until all but one are gone."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._gid = b""
        self._heard_ns = self._mixed_ns = clock.monotonic_ns() - RIVAL_NS

    def admit(self, gid: bytes) -> int:
        """Returns how long nothing had come before a message, ns; ValueError: two publishers
        send.
        """
        now_ns = self._clock.monotonic_ns()
        silent_ns = now_ns - self._heard_ns
        if self._gid not in (b"", gid) and silent_ns < RIVAL_NS:
            self._mixed_ns = now_ns
        self._gid = gid
        self._heard_ns = now_ns
        if now_ns - self._mixed_ns < RIVAL_NS:
            raise ValueError(
                "has two publishers: neither moves the arm until the other is gone"
            )
        return silent_ns


class TargetTopic:
    """A topic of ROS that holds an arm as a hand: `target_pose`, `target_joint` or
    `target_wrench`.

    `read` returns the goal of a message, or raises ValueError, and `act` gives it to the hand.
    """

    def __init__(
        self,
        hand: Hand,
        read: Callable[[bytes], Sequence[float]],
        act: Callable[..., int],
        clock: Clock,
    ) -> None:
        self.hand = hand
        self._read = read
        self._act = act
        self._clock = clock
        self._sender = OneSender(clock)
        self._lock = threading.Lock()
        self._held_ns: int | None = None

    def take(self, data: bytes, attachment: Attachment) -> None:
        """Takes a message, in a thread of Zenoh's; raises ValueError or TrilatError if that
        cannot be.
        """
        with self._lock:
            try:
                self._sender.admit(attachment.gid)
            except ValueError:
                self._let_go()
                raise
            self._act(*self._read(data))
            self._held_ns = self._clock.monotonic_ns()

    def watch(self) -> None:
        """Lets go where nobody has repeated the target."""
        with self._lock:
            if (
                self._held_ns is not None
                and self._clock.monotonic_ns() - self._held_ns > SILENCE_NS
            ):
                self._let_go()

    def _let_go(self) -> None:
        if self._held_ns is not None:
            self._held_ns = None
            self.hand.release()


class DominanceTopic:
    """A topic of ROS that sets the shares of a site in its peers, `set_dominance`; the newest
    message wins.

    One that only repeats what was asked for, without a pause of a second, asks for nothing. Its
    numbers are in the order of `peers`; `change` asks the site, and waits until it agrees.
    """

    def __init__(
        self, peers: Sequence[str], change: Callable[[dict[str, float]], object], clock: Clock
    ) -> None:
        self._peers = peers
        self._change = change
        self._sender = OneSender(clock)
        self._wanted: dict[str, float] | None = None
        self._asked: dict[str, float] | None = None

    def take(self, data: bytes, attachment: Attachment) -> None:
        """Takes a message, in a thread of Zenoh's; raises ValueError if that cannot be."""
        shares = _check_finite(cdr.read_float_array(data))
        if len(shares) != len(self._peers):
            raise ValueError(
                f"has {count_nouns(len(shares), 'number')}; the peers are {', '.join(self._peers)}"
            )
        if self._sender.admit(attachment.gid) > RIVAL_NS:
            self._asked = None
        self._wanted = dict(zip(self._peers, shares, strict=True))

    def ask(self) -> None:
        """Asks the site for what is wanted, if that is new; raises TrilatError if it refuses."""
        wanted = self._wanted
        if wanted is not None and wanted != self._asked:
            self._asked = wanted
            self._change(wanted)


class RobotArm:
    """A robot of ROS that is the arm of a site: the site gets its joint states, it gets the
    site's torque.

    It is the program of an external arm, see `ArmClient`. Where that has to brake, the robot's
    controller gets again and again what is safe for it. Of each joint, in the scenario's order,
    `joints` has the names by which the robot may call it; `make` returns a client of whatever
    start of the site. Until it is `armed` the robot gets nothing but what is safe.

    Raises:
        UsageError: the controller has not one number for each joint.
    """

    def __init__(
        self,
        make: Callable[[], ArmClient],
        joints: Sequence[Sequence[str]],
        robot: RobotTable,
        commands: TopicPublisher,
        clock: Clock,
    ) -> None:
        self.armed = False
        self._make = make
        self._client = make()
        self._joints = joints
        order = robot.controller or [called[0] for called in joints]
        self._order = [n for name in order for n, called in enumerate(joints) if name in called]
        self._safe = robot.safe or [0.0] * len(joints)
        whole = sorted(self._order) == list(range(len(joints))) and len(order) == len(joints)
        if (
            not whole
            or len(self._safe) != len(joints)
            or not all(map(math.isfinite, self._safe))
        ):
            named = ", ".join(called[0] for called in joints)
            raise UsageError(
                f"--names: `controller` and `safe` have one of each joint: {named}"
            )
        self._pack = cdr.make_float_array_packer((" ".join(order), len(order)))
        self._commands = commands
        self._clock = clock
        self._sender = OneSender(clock)
        self._lock = threading.Lock()
        self._sent: tuple[int, int] | None = (
            None  # boot and tick of the record whose torque went out last
        )
        self._safe_ns = clock.monotonic_ns() - SAFE_NS

    def take(self, data: bytes, attachment: Attachment) -> None:
        """Takes a message, in a thread of Zenoh's, unless it is of another robot; ValueError:
        it is none.
        """
        found = cdr.read_joint_state(data)
        if found.names and not any(
            name in found.names for called in self._joints for name in called
        ):
            return
        at = find_joint_places(self._joints, found)
        if len(found.velocity) != len(found.position):
            raise ValueError(
                f"has {count_nouns(len(found.position), 'position')} and "
                f"{count_nouns(len(found.velocity), 'velocity')}"
            )
        q, qd = (
            _check_finite([row[n] for n in at]) for row in (found.position, found.velocity)
        )
        with self._lock:
            self._sender.admit(attachment.gid)
            self._client.send(q, qd, stamp_ns=found.stamp_ns)

    def drive(self) -> None:
        """Publishes the torque of the newest record, once, or what is safe."""
        if self._client.over:  # the site may come again
            with self._lock:
                self._client = self._make()
        record = self._client.record
        torque = self._client.torque()  # of that record, or a newer one
        if (
            not self.armed
            or torque is None
            or record is None
            or len(torque) != len(self._order)
        ):
            if self._clock.monotonic_ns() - self._safe_ns >= SAFE_NS:
                self.brake()
        elif self._sent != (record.boot, record.tick):
            self._sent = record.boot, record.tick
            self._commands.put(self._pack(*(torque[n] for n in self._order)))

    def brake(self) -> None:
        """Publishes what is safe."""
        self._safe_ns = self._clock.monotonic_ns()
        self._commands.put(self._pack(*self._safe))


def find_joint_places(names: Sequence[Sequence[str]], found: cdr.RosJoints) -> list[int]:
    """Returns where joints, of some names each, stand in a message; ValueError: one is not
    there once.
    """
    if len(found.names) != len(found.position):
        raise ValueError(
            f"has {count_nouns(len(found.names), 'name')} and {count_nouns(len(found.position), 'position')}"
        )
    at = {name: n for n, name in enumerate(found.names)}
    lacking = [called[0] for called in names if not at.keys() & set(called)]
    if lacking:
        raise ValueError(
            f"lacks {', '.join(lacking)}; it has {', '.join(found.names[:9]) or 'no names'}"
        )
    if twice := [name for called in names for name in called if found.names.count(name) > 1]:
        raise ValueError(f"has {twice[0]} twice")
    return [next(at[name] for name in called if name in at) for called in names]


def read_joint_target(names: Sequence[Sequence[str]], data: bytes) -> list[float]:
    """Returns the angles of a `JointState` in an arm's order; ValueError: it lacks one, or is
    none.
    """
    found = cdr.read_joint_state(data)
    return _check_finite([found.position[n] for n in find_joint_places(names, found)])


def _check_finite(numbers: Sequence[float]) -> list[float]:
    if not all(map(math.isfinite, numbers)):
        raise ValueError("has a number that is not finite")
    return list(numbers)


def read_place_target(frame: str, axes: int, count: int, data: bytes) -> list[float]:
    """Returns the place of a `PoseStamped` (7 numbers) or the force of a `WrenchStamped` (6),
    by the axes.

    Raises:
        ValueError: it cannot be read, is in another frame than this or none, or a number is not
            finite.
    """
    found, numbers = cdr.read_frame_vectors(data, count)
    if found not in ("", frame):
        raise ValueError(f"is in the frame {found[:80]!r}, and here it is {frame!r}")
    return _check_finite(numbers[:axes])


class Bridge:
    """The bridge of a session that runs; its topics and services are there from now on.

    By their topics, `targets` are what holds an arm, and `dominance` what changes who leads.
    """

    def __init__(self, ends: Ends, scenario: Scenario, epoch_unix_ns: int) -> None:
        graph, bus, clock, session, _ = self._ends = ends
        self._records, self._events, self._links = (
            bus.inbox(topics.key(session, "*", channel), 4096)
            for channel in (topics.STATE, topics.EVENT, topics.LINK)
        )
        self._presence = bus.presence(topics.presence_key(session, "*"))
        self._present = set[topics.KeyParts]()
        self._met = False
        self._epoch_unix_ns = epoch_unix_ns
        frames, self._diagnostics = (
            graph.publisher(topic, COMMON_TOPICS[topic].kind, RELIABLE)
            for topic in (FRAMES, DIAGNOSTICS)
        )
        self._lines = {
            name: graph.publisher(f"{session}/{name}", channel.kind, RELIABLE)
            for name, channel in SESSION_CHANNELS.items()
        }
        self._sites = {
            name: SiteTopics(
                ends=ends,
                scenario=scenario,
                site=name,
                epoch_unix_ns=epoch_unix_ns,
                frames=frames,
            )
            for name in scenario.names
        }
        running = RunningSession(session, Connection(), bus)
        self.targets = dict[str, TargetTopic]()
        self.dominance = dict[str, DominanceTopic]()
        for name, shown in self._sites.items():
            for event in list_past_events(bus, clock, session, name):
                shown.shares.take(event.command)
            topic = ends.topic(name, "set_dominance")
            change = partial(running.set_dominance, name)
            self.dominance[topic] = DominanceTopic(scenario.peers(name), change, clock)
            graph.subscribe(topic, cdr.FLOAT64_ARRAY, self.dominance[topic].take)
        for name in scenario.open_hands:
            hand = open_hand(
                bus=bus,
                clock=clock,
                session=session,
                site=name,
                scenario=scenario,
                source="ros2",
            )
            last, kind, read, act = describe_target(
                scenario, name, hand, self._sites[name].frame
            )
            topic = ends.topic(name, last)
            self.targets[topic] = TargetTopic(hand, read, act, clock)
            graph.subscribe(topic, kind, self.targets[topic].take)
        serve_orders(graph, running, scenario.names)

    def run(
        self, rate_hz: float, stopped: Callable[[], bool], say: Callable[[str], None]
    ) -> bool:
        """Shows the session at a rate, the newest record each time, until it ends or `stopped`.

        Returns True if another session has begun under its name.
        """
        clock = self._ends.clock
        connected = True
        wake_ns = looked_ns = diagnosed_ns = clock.monotonic_ns()
        poll_ns = max(POLL_NS, int(NS_PER_S / (5.0 * rate_hz)))
        while not (stopped() or (self._met and not self._present)):
            if self._show(rate_hz):
                return True
            for target in self.targets.values():
                target.watch()
            now_ns = clock.monotonic_ns()
            if now_ns - looked_ns > LOOK_NS:
                looked_ns = now_ns
                before = connected
                connected = self._ends.graph.connected
                if connected != before:
                    say(
                        f"the router of ROS {'is back' if connected else 'is gone: waiting for it'}"
                    )
            if now_ns - diagnosed_ns > NS_PER_S:
                diagnosed_ns = now_ns
                self._diagnose()
            wake_ns = max(wake_ns + poll_ns, now_ns)
            clock.sleep_until(wake_ns)
        return False

    def _show(self, rate_hz: float) -> bool:
        """Shows what has come; returns whether another session has begun under the name of this
        one.
        """
        for record in read_records(self._records):
            if record.site in self._sites:
                self._sites[record.site].show(record, rate_hz)
        anew = False
        for event in read_messages(self._events, Event):
            anew = anew or (
                event.kind == "epoch" and event.epoch_unix_ns != self._epoch_unix_ns
            )
            if event.member in self._sites:
                self._sites[event.member].shares.take(event.command)
            for name, data in pack_event(event, self._ends.clock.unix_ns()):
                self._lines[name].put(data)
        for stats in read_messages(self._links, LinkStats):
            if stats.site in self._sites:
                self._sites[stats.site].show_statistics(stats)
        for parts, alive in topics.read_presence(self._presence):
            if parts.member in self._sites:
                (self._present.add if alive else self._present.discard)(parts)
                self._met = True
        return anew

    def _diagnose(self) -> None:
        records = [shown.newest for shown in self._sites.values() if shown.newest is not None]
        if self._diagnostics.has_subscribers:
            self._diagnostics.put(
                pack_session_diagnostics(self._ends.session, self._epoch_unix_ns, records)
            )


def describe_target(
    scenario: Scenario, site: str, hand: Hand, frame: str
) -> tuple[str, str, Callable[[bytes], Sequence[float]], Callable[..., int]]:
    """Returns how the live hand of a site is moved, in a frame: topic, type, what reads it,
    what it does.
    """
    live = scenario.sites[site].find_live_hand(is_open=True)
    assert live is not None
    axes = len(scenario.arms[site].end_effector(scenario.sites[site].q0_rad))
    if live.mode == "joint":
        read = partial(read_joint_target, list_joint_names(scenario, site))
        return "target_joint", cdr.JOINT_STATE, read, hand.turn
    if live.mode == "force":
        return (
            "target_wrench",
            cdr.WRENCH,
            partial(read_place_target, frame, axes, 6),
            hand.push,
        )
    return "target_pose", cdr.POSE, partial(read_place_target, frame, axes, 7), hand.move


def list_joint_names(scenario: Scenario, site: str) -> list[tuple[str, ...]]:
    """Returns the names of each joint of a site: the one that its topics show, and that of the
    scenario.
    """
    pairs = zip(
        Ros2SiteChannels(scenario, site).joints, scenario.arms[site].joint_names, strict=True
    )
    return [tuple(dict.fromkeys(pair)) for pair in pairs]


def serve_orders(graph: Ros2Graph, running: RunningSession, sites: Sequence[str]) -> None:
    """Offers the services of a session: `/<session>/stop`, `/<session>/<site>/stop`, ..."""

    def serve(order: Callable[..., list[str]], *site: str) -> None:
        name = "/".join([running.name, *site, order.__name__])
        graph.serve(name, TRIGGER, lambda _: _answer(order, *site))

    for order in (running.stop, running.enable, running.reset):
        serve(order)
        for site in sites:
            serve(order, site)
    serve(running.end)


def _answer(order: Callable[..., list[str]], *sites: str) -> bytes:
    try:
        return cdr.pack_trigger_response(success=True, text="; ".join(order(*sites)))
    except TrilatError as error:
        return cdr.pack_trigger_response(success=False, text=str(error))


@contextmanager
def _repeated(
    period_s: float, act: Callable[[], None], last: Callable[[], None] = lambda: None
) -> Iterator[None]:
    over = threading.Event()

    def repeat() -> None:
        while not over.wait(period_s):
            act()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        last()


def serve_ros2(
    running: RunningSession,
    open_graph: Callable[[Refusals], Ros2Graph],
    rate_hz: float,
    table: TopicTable,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    timeout_s: float,
) -> None:
    """Joins a session to the graph of ROS 2 until it ends, or `stopped`; waits for a router and
    for it.

    `timeout_s` is the longest wait for the first site or its router.

    Raises:
        UsageError: no router, or what the table says of a robot does not fit the session.
    """
    clock = SystemClock()
    with running.reach(BRIDGE, timeout_s) as bus:
        began_anew = True
        told = False
        while began_anew and not stopped():
            try:
                graph = open_graph(Refusals(say))
            except RouterSilent as silent:
                if not told:
                    say(f"{silent}: waiting for it")
                told = True
                clock.sleep_until(clock.monotonic_ns() + LOOK_NS)
                continue
            with graph:
                ends = Ends(
                    graph=graph, bus=bus, clock=clock, session=running.name, table=table
                )
                began_anew = show_session(ends, rate_hz, stopped, say)


def show_session(
    ends: Ends, rate_hz: float, stopped: Callable[[], bool], say: Callable[[str], None]
) -> bool:
    """Shows a session until it ends or `stopped`; waits for it to begin, which the arms of
    robots let it.

    Returns True if another one has begun under its name.
    """
    with ExitStack() as stack:
        robots: dict[str, RobotArm] = {}
        for site, robot in ends.table.robots.items():
            if robot.joints:  # as it can begin before any site answers
                robots[site] = stack.enter_context(open_robot(ends, site, robot))
        say(f"waiting for session {ends.session!r} to begin")
        if (met := await_site(ends, stopped, running=False)) is None:
            return False
        scenario = parse_embedded(met.scenario, ends.session)
        refuse_other_robots(ends.table, scenario)
        for site in scenario.outside:
            if site not in robots:
                robot = ends.table.robots.get(site, RobotTable())
                names = list_joint_names(scenario, site)
                robots[site] = stack.enter_context(open_robot(ends, site, robot, names))
            robots[site].armed = True
        if (begun := await_site(ends, stopped, running=True)) is None:
            return False
        bridge = Bridge(ends, scenario, begun.epoch_unix_ns)
        for target in bridge.targets.values():
            stack.enter_context(target.hand)
        for topic, shares in bridge.dominance.items():
            stack.enter_context(_repeated(ASK_S, ends.graph.refusals.guard(topic, shares.ask)))
        held = [f"; /{topic} holds an arm" for topic in bridge.targets]
        held += [
            f"; /{ends.topic(site, 'robot_states')} measures the arm of {site}"
            for site in robots
        ]
        say(
            f"session {ends.session} is in the graph of ROS 2: /{ends.session}/...{''.join(held)}"
        )
        return bridge.run(rate_hz, stopped, say)


@contextmanager
def open_robot(
    ends: Ends, site: str, robot: RobotTable, joints: Sequence[Sequence[str]] = ()
) -> Iterator[RobotArm]:
    """Yields the robot of a site, which is heard and driven meanwhile, and brakes at the end."""
    commands = ends.graph.publisher(
        ends.topic(site, "robot_commands"), cdr.FLOAT64_ARRAY, RELIABLE
    )
    make = partial(ArmClient, ends.bus, ends.clock, ends.session, site)
    names = joints or [(name,) for name in robot.joints]
    arm = RobotArm(make=make, joints=names, robot=robot, commands=commands, clock=ends.clock)
    ends.graph.subscribe(ends.topic(site, "robot_states"), cdr.JOINT_STATE, arm.take)
    with _repeated(DRIVE_S, arm.drive, arm.brake):
        yield arm


def refuse_other_robots(table: TopicTable, scenario: Scenario) -> None:
    """Raises UsageError if the table has the robot of a site without an external arm."""
    for site, robot in table.robots.items():
        if site not in scenario.outside and (
            robot != RobotTable() or site not in scenario.names
        ):
            able = ", ".join(scenario.outside) or "none"
            raise UsageError(
                f"--names: sites.{site}: there is no external arm; sites with one: {able}"
            )


def await_site(ends: Ends, stopped: Callable[[], bool], *, running: bool) -> Info | None:
    """Returns what a site answers, of a session that is to be running or not; None if
    `stopped`.
    """
    answers = find_members(ends.bus, ends.clock, ends.session, stopped=stopped, timeout_s=None)
    return next(
        (info for info in answers if info.scenario and (info.running or not running)), None
    )
