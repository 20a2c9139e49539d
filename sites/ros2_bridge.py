"""A session in the graph of ROS 2: what its sites do as topics, its orders as services, its hands as targets.

Invariant: ROS never sits in a loop. What comes from it enters only as a hand's message, which the site
limits, fades and records, so that a log is verified without ROS. A topic that two publishers share moves
nothing; one that falls silent for 200 ms lets go. Nothing that comes from ROS ends the bridge: it is refused,
counted by its reason, and the first of each reason is said.
"""

import math
import threading
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

from trilat_net.core.ticks import NS_PER_S
from trilat_net.errors import TrilatError, UsageError
from trilat_net.fields import suggest_nearest
from trilat_net.files import open_regular
from trilat_net.log.ros2 import cdr
from trilat_net.log.ros2.robot_model import WORLD, RobotModel, find_quaternion
from trilat_net.log.ros2.ros2_messages import Ros2SiteChannels
from trilat_net.net import topics
from trilat_net.net.arm_client import Hand
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.net.discovery import send_change
from trilat_net.net.membership import read_records
from trilat_net.net.messages import State
from trilat_net.net.requests import ChangeReply, ChangeRequest, OrderName
from trilat_net.net.ros2_graph import (
    Attachment,
    QualityOfService,
    Refusals,
    Ros2Graph,
    TopicPublisher,
    check_ros_name,
)
from trilat_net.net.zenoh_bus import RouterSilent
from trilat_net.scenario import Scenario
from trilat_net.scenario.operators import find_live_hand

from .running_session import RunningSession, meet_sites, open_hand, order_sites, read_replies, stop_session

POLL_NS = 1_000_000
"""Least time between two looks at what has come."""
LOOK_NS = 200_000_000
"""Between two looks for what is not there yet."""
SILENCE_NS = 200_000_000
"""A target that nobody repeats for so long lets the arm go."""
RAMP_S = 1.0
"""Of a change of shares, as of `trilat set dominance`."""
RIVAL_NS = NS_PER_S
"""A publisher that was heard within this time has not gone."""
T = TypeVar("T")
POSE, WRENCH = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/WrenchStamped"
TRIGGER = "std_srvs/srv/Trigger"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
RELIABLE, LATCHED = QualityOfService(), QualityOfService(latched=True, depth=1)
_OK, _WARNING, _ERROR = 0, 1, 2
_LEVELS = {"run": _OK, "fault": _ERROR, "diverged": _ERROR}
"""Of `/diagnostics`, by mode; others warn."""


CRTK = {
    "joint_states": "measured_js",
    "reference": "setpoint_js",
    "tip_pose": "measured_cp",
    "tip_wrench": "measured_cf",
    "target_joint": "servo_jp",
    "target_pose": "servo_cp",
    "target_wrench": "servo_cf",
}
"""By our names those of the Collaborative Robotics Toolkit, as the da Vinci Research Kit has them."""


def read_topic_names(asked: str) -> Mapping[str, str]:
    """Returns the names that topics have instead of ours: none for "crisp", those of "crtk" or of a file.

    The file is TOML: `joint_states = "arm/joint_states"`.

    Raises:
        UsageError: it cannot be read, or a name in it cannot be right.
    """
    if asked in ("crisp", "crtk"):
        return CRTK if asked == "crtk" else {}
    try:
        with open_regular(Path(asked)) as stream:
            found = tomllib.loads(stream.read().decode())
    except OSError as error:
        raise UsageError(
            f"--names is crisp, crtk or a file, and {asked} cannot be read: {error.strerror}"
        ) from None
    except ValueError as error:
        raise UsageError(f"{asked}: is no TOML: {error}") from None
    for key, name in found.items():
        if key not in CRTK:
            raise UsageError(f"{asked}: no topic {key!r}{suggest_nearest(key, list(CRTK))}")
        check_ros_name(str(name), f"{asked}: {key}")
    if len(set(found.values())) < len(found):
        raise UsageError(f"{asked}: two topics have one name")
    return found


class SiteTopics:
    """What one site shows, under `/<session>/<site>`, and its part of `/tf`.

    Args:
        graph: publishes.
        scenario, session, site: whose.
        epoch_unix_ns: Unix time of tick 0, from which stamps count.
        frames: publishes on `/tf`.
        called: the names of topics, where they are not ours.
    """

    def __init__(
        self,
        graph: Ros2Graph,
        scenario: Scenario,
        session: str,
        site: str,
        epoch_unix_ns: int,
        frames: TopicPublisher,
        called: Mapping[str, str],
    ) -> None:
        self._arm, self._epoch_unix_ns, self._frames = scenario.arms[site], epoch_unix_ns, frames
        task = None if self._arm.chain is None else self._arm.chain.task
        self._scale, self._mode = (*[1.0 if task is None else task.scale] * 3, 1.0, 1.0, 1.0), ""
        self._robot, names = RobotModel(scenario, site), Ros2SiteChannels(scenario, site).joints
        self._pack_states = cdr.JointStatePacker(names).pack
        self._pack_reference = cdr.JointStatePacker(names, effort=False).pack

        def topic(name: str, kind: str, qos: QualityOfService = RELIABLE) -> TopicPublisher:
            return graph.publisher(f"{session}/{site}/{called.get(name, name)}", kind, qos)

        self._states, self._modes = topic("joint_states", cdr.JOINT_STATE), topic("mode", cdr.STRING, LATCHED)
        self._pose = topic("tip_pose", POSE)
        shares = self._arm.shares_pose
        self._reference = None if shares else topic("reference", cdr.JOINT_STATE)
        self._wrench = topic("tip_wrench", WRENCH) if shares else None
        topic("robot_description", cdr.STRING, LATCHED).put(cdr.pack_string(self._robot.description))
        spec = scenario.sites[site].arm
        self._frame, self._placed = self._robot.frames[0][1], any((*spec.base_xyz_m, *spec.base_rpy_rad))
        if self._placed:  # the end effector is in the frame that the sites share
            self._frame = f"{site}/shared"
            self._pack_shared = cdr.TransformPacker([(WORLD, self._frame)]).pack

    def publish(self, record: State) -> None:
        """Publishes a record, as far as somebody listens."""
        stamp_ns = max(0, self._epoch_unix_ns + record.t_ns)
        if self._states.heard:
            self._states.put(self._pack_states(stamp_ns, record.q, record.qd, record.tau))
        if self._reference is not None and self._reference.heard:
            self._reference.put(self._pack_reference(stamp_ns, record.q_des, record.qd_des))
        if self._pose.heard:
            place = [*self._arm.end_effector(record.q), 0.0][:3]
            turned = find_quaternion(self._arm.end_turn(record.q))
            self._pose.put(cdr.pack_frame_vectors(stamp_ns, self._frame, *place, *turned))
        if self._wrench is not None and self._wrench.heard:
            pull = [-scale * one for scale, one in zip(self._scale, record.wrench, strict=False)]
            self._wrench.put(cdr.pack_frame_vectors(stamp_ns, self._frame, *[*pull, *[0.0] * 6][:6]))
        if self._frames.heard:
            self._frames.put(self._robot.pack(stamp_ns, record.q))
            if self._placed:
                origin, upright = self._robot.shared
                self._frames.put(self._pack_shared(stamp_ns, [*origin, *upright]))
        if record.mode != self._mode:
            self._mode = record.mode
            self._modes.put(cdr.pack_string(record.mode))


class TargetTopic:
    """A topic of ROS that holds an arm as a hand: `target_pose`, `target_joint` or `target_wrench`.

    Args:
        hand: the hand; its context is that of the bridge.
        topic: its name.
        read: returns the goal of a message; a ValueError says what is wrong with it.
        act: gives a goal to the hand.
        clock, refusals: of the bridge.
    """

    def __init__(
        self,
        hand: Hand,
        topic: str,
        read: Callable[[bytes], Sequence[float]],
        act: Callable[..., int],
        clock: Clock,
        refusals: Refusals,
    ) -> None:
        self.hand, self.topic, self._read, self._act = hand, topic, read, act
        self._clock, self._refusals = clock, refusals
        self._lock = threading.Lock()
        self._heard_ns: dict[bytes, int] = {}
        self._held_ns: int | None = None

    def take(self, data: bytes, attachment: Attachment) -> None:
        """Takes a message, in a thread of Zenoh's."""
        now_ns = self._clock.monotonic_ns()
        try:
            with self._lock:
                self._heard_ns[attachment.gid] = now_ns
                rivals = sum(now_ns - heard < RIVAL_NS for heard in self._heard_ns.values())
                if rivals > 1:
                    self._let_go()
                    raise ValueError("has two publishers: neither moves the arm until the other is gone")
                self._act(*self._read(data))
                self._held_ns = now_ns
        except (ValueError, TrilatError) as error:
            self._refusals.add(f"{self.topic} {error}")

    def watch(self) -> None:
        """Lets go where nobody has repeated the target."""
        now_ns = self._clock.monotonic_ns()
        with self._lock:
            if self._held_ns is not None and now_ns - self._held_ns > SILENCE_NS:
                self._let_go()
            for gid in [gid for gid, heard in self._heard_ns.items() if now_ns - heard > RIVAL_NS]:
                del self._heard_ns[gid]

    def _let_go(self) -> None:
        if self._held_ns is not None:
            self._held_ns = None
            self.hand.release()


class DominanceTopic:
    """A topic of ROS that sets the shares of a site in its peers, `set_dominance`; the newest message wins.

    Args:
        topic: its name.
        peers: of the site, in the order of the numbers of a message.
        change: asks the site, and waits for its reply.
        refusals: of the bridge.
    """

    def __init__(
        self,
        topic: str,
        peers: Sequence[str],
        change: Callable[[dict[str, float]], ChangeReply],
        refusals: Refusals,
    ) -> None:
        self.topic, self._peers, self._change, self._refusals = topic, peers, change, refusals
        self._wanted: dict[str, float] | None = None
        self._asked: dict[str, float] | None = None

    def take(self, data: bytes, _: Attachment) -> None:
        """Takes a message, in a thread of Zenoh's."""
        try:
            shares = _check_finite(cdr.read_float_array(data))
            if len(shares) != len(self._peers):
                raise ValueError(f"has {len(shares)} numbers; the peers are {', '.join(self._peers)}")
            self._wanted = dict(zip(self._peers, shares, strict=True))
        except ValueError as error:
            self._refusals.add(f"{self.topic} {error}")

    def ask(self) -> None:
        """Asks the site for what is wanted, if that is new; waits for its reply."""
        if (wanted := self._wanted) is None or wanted == self._asked:
            return
        self._asked = wanted
        try:
            reply = self._change(wanted)
        except TrilatError as error:
            self._refusals.add(f"{self.topic} {error}")
        else:
            if not reply.accepted:
                self._refusals.add(f"{self.topic} {reply.text}")


def read_joint_target(names: Sequence[Sequence[str]], data: bytes) -> list[float]:
    """Returns the angles of a `JointState` in the order of an arm's joints, whose names it has in any order.

    Args:
        names: of each joint the names by which it may be called.
        data: the message; further joints in it are passed over, and without names it is in the arm's order.

    Raises:
        ValueError: it cannot be read, lacks a joint, or an angle is not finite.
    """
    found = cdr.read_joint_state(data)
    if not found.names and len(found.position) == len(names):
        return _check_finite(found.position)
    if len(found.names) != len(found.position):
        raise ValueError(f"has {len(found.names)} names and {len(found.position)} positions")
    at = dict(zip(found.names, found.position, strict=True))
    lacking = [called[0] for called in names if not at.keys() & set(called)]
    if lacking:
        raise ValueError(f"lacks {', '.join(lacking)}; it has {', '.join(found.names[:9]) or 'no names'}")
    return _check_finite([next(at[name] for name in called if name in at) for called in names])


def _check_finite(numbers: Sequence[float]) -> list[float]:
    if not all(map(math.isfinite, numbers)):
        raise ValueError("has a number that is not finite")
    return list(numbers)


def read_place_target(axes: int, count: int, data: bytes) -> list[float]:
    """Returns the place of a `PoseStamped` (7 numbers) or the force of a `WrenchStamped` (6), by the axes.

    Raises:
        ValueError: it cannot be read, or a number is not finite.
    """
    return _check_finite(cdr.read_frame_vectors(data, count)[1][:axes])


class Bridge(NamedTuple):
    """A bridge that is open.

    Attributes:
        sites: by name what a site shows.
        targets: the topics that hold arms.
        dominance: the topics that change who leads.
        diagnose: publishes `/diagnostics` of the newest records.
    """

    sites: dict[str, SiteTopics]
    targets: list[TargetTopic]
    dominance: list[DominanceTopic]
    diagnose: Callable[[dict[str, State]], None]


def open_bridge(
    graph: Ros2Graph,
    bus: Bus,
    clock: Clock,
    session: str,
    scenario: Scenario,
    epoch_unix_ns: int,
    called: Mapping[str, str],
) -> Bridge:
    """Returns the bridge of a session that runs, whose topics and services are there from now on.

    `called` has the names of topics where they are not ours.
    """
    frames = graph.publisher("tf", cdr.TRANSFORMS, RELIABLE)
    sites = {
        name: SiteTopics(graph, scenario, session, name, epoch_unix_ns, frames, called)
        for name in scenario.names
    }
    able = [name for name in scenario.names if find_live_hand(scenario.sites[name].hands) is not None]
    targets = []
    for name in able:
        hand = open_hand(bus, clock, session, name, scenario, "ros2")
        last, kind, read, act = describe_target(scenario, name, hand)
        topic = f"{session}/{name}/{called.get(last, last)}"
        targets.append(TargetTopic(hand, topic, read, act, clock, graph.refusals))
        graph.subscribe(topic, kind, targets[-1].take)
    dominance = []
    for name in scenario.names:
        change = partial(_set_dominance, bus, clock, session, name)
        peers = scenario.peers(name)
        dominance.append(DominanceTopic(f"{session}/{name}/set_dominance", peers, change, graph.refusals))
        graph.subscribe(dominance[-1].topic, cdr.FLOAT64_ARRAY, dominance[-1].take)
    for service, order in list_services(bus, clock, session, scenario):
        graph.serve(service, TRIGGER, partial(_answer, order))
    diagnostics = graph.publisher("diagnostics", DIAGNOSTICS, RELIABLE)

    def diagnose(records: dict[str, State]) -> None:
        """Publishes the state of every site."""
        parts = [_diagnose(session, record) for record in records.values()]
        newest_ns = max((record.t_ns for record in records.values()), default=0)
        diagnostics.put(cdr.pack_diagnostics(max(0, epoch_unix_ns + newest_ns), parts))

    return Bridge(sites, targets, dominance, diagnose)


class TargetKind(NamedTuple):
    """How a hand is moved from ROS: the last part of the topic, its type, what reads it, what it does."""

    name: str
    kind: str
    read: Callable[[bytes], Sequence[float]]
    act: Callable[..., int]


def describe_target(scenario: Scenario, site: str, hand: Hand) -> TargetKind:
    """Returns how the live hand of a site is moved: by the mode that the scenario gives it."""
    live = find_live_hand(scenario.sites[site].hands)
    assert live is not None
    axes = len(scenario.arms[site].end_effector(scenario.sites[site].q0_rad))
    if live.mode == "joint":
        plain = scenario.arms[site].joint_names
        shown = Ros2SiteChannels(scenario, site).joints
        called = [tuple(dict.fromkeys(pair)) for pair in zip(shown, plain, strict=True)]
        return TargetKind("target_joint", cdr.JOINT_STATE, partial(read_joint_target, called), hand.turn)
    if live.mode == "force":
        return TargetKind("target_wrench", WRENCH, partial(read_place_target, axes, 6), hand.push)
    return TargetKind("target_pose", POSE, partial(read_place_target, axes, 7), hand.move)


def _diagnose(session: str, record: State) -> cdr.Diagnosis:
    values = {"tick": record.tick, "late_us": record.late_us, "busy_us": record.busy_us}
    level = _LEVELS.get(record.mode, _WARNING)
    return cdr.Diagnosis(
        level, f"{session}/{record.site}", record.mode, {key: str(x) for key, x in values.items()}
    )


def list_services(
    bus: Bus, clock: Clock, session: str, scenario: Scenario
) -> Iterator[tuple[str, Callable[[], str]]]:
    """Yields the services of a session, and what they do: `/<session>/stop`, `/<session>/<site>/stop`, ..."""
    orders: tuple[OrderName, ...] = ("stop", "enable", "reset")

    def give(order: OrderName, *sites: str) -> str:
        return "; ".join(read_replies(order_sites(bus, clock, session, sites, order)))

    for order in orders:
        yield f"{session}/{order}", partial(give, order)
        for site in scenario.names:
            yield f"{session}/{site}/{order}", partial(give, order, site)
    yield f"{session}/end", lambda: "; ".join(stop_session(bus, clock, session))


def _set_dominance(bus: Bus, clock: Clock, session: str, site: str, shares: dict[str, float]) -> ChangeReply:
    request = ChangeRequest(dominance=site, to=shares, ramp_s=RAMP_S)
    return send_change(bus, clock, session, site, request)


def _answer(order: Callable[[], str], _request: bytes) -> bytes:
    """Does what a service is asked for; what is refused is an answer as well."""
    try:
        return cdr.pack_trigger_response(success=True, text=order())
    except TrilatError as error:
        return cdr.pack_trigger_response(success=False, text=str(error))


def run_bridge(
    bridge: Bridge,
    bus: Bus,
    clock: Clock,
    session: str,
    rate_hz: float,
    stopped: Callable[[], bool],
) -> None:
    """Shows the session at a rate, the newest record each time, until it ends or `stopped`."""
    records = bus.inbox(topics.key(session, "*", topics.STATE), 4096)
    presence = bus.presence(topics.presence_key(session, "*"))
    newest: dict[str, State] = {}
    shown: dict[str, tuple[int, int]] = {}
    present: set[str] = set()
    diagnosed_ns = clock.monotonic_ns()
    poll_ns = max(POLL_NS, int(NS_PER_S / (5.0 * rate_hz)))
    wake_ns = clock.monotonic_ns()
    while not stopped():
        for record in read_records(records):
            if record.site in bridge.sites:
                bucket = int(record.t_ns * rate_hz) // NS_PER_S
                boot, last = shown.get(record.site, (record.boot, -1))
                if bucket > last or record.boot != boot:  # none is shown after a later one
                    shown[record.site] = record.boot, bucket
                    newest[record.site] = record
                    bridge.sites[record.site].publish(record)
        for parts, alive in topics.read_presence(presence):
            if parts.member in bridge.sites:
                (present.add if alive else present.discard)(parts.member)
        if newest and not present:
            return
        for target in bridge.targets:
            target.watch()
        if clock.monotonic_ns() - diagnosed_ns > NS_PER_S:
            diagnosed_ns = clock.monotonic_ns()
            bridge.diagnose(newest)
        wake_ns = max(wake_ns + poll_ns, clock.monotonic_ns())
        clock.sleep_until(wake_ns)


@contextmanager
def _asking(dominance: Sequence[DominanceTopic]) -> Iterator[None]:
    """Asks sites for the shares that are wanted, in a thread of its own, since they take time to reply."""
    over = threading.Event()

    def ask() -> None:
        while not over.wait(0.05):
            for topic in dominance:
                topic.ask()

    asker = threading.Thread(target=ask, name="shares", daemon=True)
    asker.start()
    try:
        yield
    finally:
        over.set()
        asker.join()


def serve_ros2(
    running: RunningSession,
    open_graph: Callable[[Refusals], Ros2Graph],
    rate_hz: float,
    called: Mapping[str, str],
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    timeout_s: float,
) -> None:
    """Joins a session to the graph of ROS 2 until it ends, or `stopped`; waits for it to begin and a router.

    Args:
        running: the session.
        open_graph: opens the graph, if its router answers, with what takes refusals.
        rate_hz: messages a second of each topic.
        called: the names of topics, where they are not ours.
        stopped: whether to end.
        say: takes a line for people.
        timeout_s: longest wait for the first answer of a site.
    """
    clock = SystemClock()
    wait = partial(_wait_for, clock, stopped, say)
    with running.reach(timeout_s=timeout_s) as bus:
        begun = wait(partial(_find_begun, bus, clock, running.name), f"{running.name} has not begun: waiting")
        if begun is None:
            return
        graph = wait(
            partial(_try_graph, partial(open_graph, Refusals(say))),
            "no router of ROS answers: waiting for it",
        )
        if graph is None:
            return
        scenario, epoch_unix_ns = begun
        with graph, ExitStack() as hands:
            bridge = open_bridge(graph, bus, clock, running.name, scenario, epoch_unix_ns, called)
            for target in bridge.targets:
                hands.enter_context(target.hand)
            held = "".join(f"; {target.topic} holds an arm" for target in bridge.targets)
            say(f"session {running.name} is in the graph of ROS 2: /{running.name}/...{held}")
            with _asking(bridge.dominance):
                run_bridge(bridge, bus, clock, running.name, rate_hz, stopped)


def _wait_for(
    clock: Clock,
    stopped: Callable[[], bool],
    say: Callable[[str], None],
    find: Callable[[], T | None],
    text: str,
) -> T | None:
    """Returns what is found in the end, having said once that it is waited for; None if `stopped`."""
    told = False
    while not stopped():
        if (found := find()) is not None:
            return found
        if not told:
            say(text)
            told = True
        clock.sleep_until(clock.monotonic_ns() + LOOK_NS)
    return None


def _find_begun(bus: Bus, clock: Clock, session: str) -> tuple[Scenario, int] | None:
    """Returns the scenario of a session that has begun, and its epoch in Unix time."""
    scenario, found = meet_sites(bus, clock, session)
    begun = [info for info in found.values() if info.running]
    return (scenario, begun[0].epoch_unix_ns) if begun else None


def _try_graph(open_graph: Callable[[], Ros2Graph]) -> Ros2Graph | None:
    try:
        return open_graph()
    except RouterSilent:
        return None
