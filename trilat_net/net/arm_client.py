"""Clients of a site: the programs of an external arm, of its dead-man switch, and of a hand.

An external arm (`plant = "external"`) measures its joints and applies the torque that its site
computes. `ArmClient` connects the arm's program to that site, `SwitchClient` connects its
dead-man switch, and `Hand` connects a person or a program that holds an arm. The program of an
arm looks like this:

    with ArmClient.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as client:
        while not client.over:
            client.send(*robot.joints())
            tau = client.torque()
            robot.brake() if tau is None else robot.apply(tau)
            robot.wait()

Invariant:
    - The arm may send measurements at any rate. The torque that it applies is read from the
      record which the site publishes at every tick, so it equals the torque in the log.
    - `ArmClient.torque` returns None if there is no valid torque; the arm must then brake.
    - The client follows the boot of the site that it saw first: records of other boots are
      ignored, and so are records that are older than the newest one or more than `AHEAD_NS`
      too far ahead.
    - Messages that cannot be decoded come from a stranger and are ignored.
    - A thread repeats a resting hand's last message, so the site keeps receiving messages while
      the program lives. If the program dies or hangs, the site releases the arm.
    - The force on the arm, and the force that a hand feels, follow from the site's records.
"""

import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self, TypeVar

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.live_hand import GRIP_NS, SILENCE_NS, HandInForce
from ..core.ticks import LifeReason
from ..errors import UsageError, WireError
from . import topics
from .bus import Bus
from .clock import Clock, SystemClock
from .connection import Connection, secure_connection
from .membership import new_boot, read_messages
from .messages import Event, State
from .requests import ArmEnable, ArmMeasurement, HandMessage, Request
from .wire import decode, encode, split_states
from .zenoh_config import OPERATOR

FRESH_NS = 100_000_000
"""Largest age of a usable record; the site of an older record is late or gone."""
AHEAD_NS = 1_000_000_000
"""Largest excess of the time between two records over the time between their arrivals."""
BRAKE_NS = 100_000_000
"""Time after a fault, or after the release of a dead-man switch, until the brakes must hold."""
HEARTBEAT_S = SILENCE_NS / 4e9
"""Period at which the last message of a resting hand is repeated."""
_ACTIONS = {
    TorqueKind.LIVE_TIP: "move",
    TorqueKind.LIVE_JOINT: "turn",
    TorqueKind.LIVE_FORCE: "push",
}
_DERIVATIVE_STEP_S = 1e-6
"""Step of the numerical derivative of the arm's pose, in s."""


R = TypeVar("R", bound=Request)


class SiteSender:
    """Sends numbered messages to one channel of a site.

    Attributes:
        boot: the number that identifies this start of the sending program.
        number: the number of the newest message; -1 before the first.
    """

    def __init__(
        self, bus: Bus, clock: Clock, session: str, site: str, channel: str, boot: int
    ) -> None:
        self.boot = boot
        self.number = -1
        self._clock = clock
        self._site = site
        self._publish = bus.publisher(topics.key(session, site, channel))

    def send(self, kind: type[R], **fields: object) -> R:
        """Sends the next message and returns it.

        Args:
            kind: the class of the message.
            fields: its fields other than the site, the boot and the number; they may replace
                the time stamp `sent_ns`.
        """
        header = {"site": self._site, "boot": self.boot, "n": self.number + 1}
        stamp = {"sent_ns": self._clock.monotonic_ns()}
        message = kind(**(header | stamp | fields))  # type: ignore[arg-type]
        self.number += 1
        self.repeat(message)
        return message

    def repeat(self, message: R) -> None:
        """Sends a message again, with its number unchanged."""
        self._publish(encode(message))


class SiteClient:
    """The connection of a program to one site; a context manager that closes the connection."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        self._bus = bus
        self._clock = clock
        self._site = site
        self._record: State | None = None
        self._received_ns = 0
        self._was_present = False
        self._is_over = False
        self._records = bus.stamped_inbox(
            topics.key(session, site, topics.STATE), clock.monotonic_ns, bytes, 64
        )
        self._events = bus.inbox(topics.key(session, site, topics.EVENT), 256)
        self._presence = bus.presence(topics.presence_key(session, site))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bus.close()

    @property
    def record(self) -> State | None:
        """The newest record of the site; None before the first record."""
        self._read_messages()
        return self._record

    @property
    def fresh(self) -> bool:
        """True if the newest record is at most `FRESH_NS` old and the run goes on.

        It is False before the first tick, after the run, and once the run has diverged.
        """
        record = self.record
        if record is None or self._is_over or record.mode == "diverged":
            return False
        return self._clock.monotonic_ns() - self._received_ns <= FRESH_NS

    @property
    def over(self) -> bool:
        """True once the site's run has ended, or the site is gone."""
        self._read_messages()
        return self._is_over

    def _is_next_record(self, record: State, received_ns: int) -> bool:
        last = self._record
        if last is None:
            return True
        is_newer = (
            record.boot == last.boot and record.tick > last.tick and record.t_ns > last.t_ns
        )
        elapsed_ns = received_ns - self._received_ns
        return is_newer and record.t_ns - last.t_ns <= elapsed_ns + AHEAD_NS

    def _read_messages(self) -> None:
        while (message := self._records.poll()) is not None:
            block, received_ns = message
            try:
                # A block holds the records of several ticks; only the last one matters here.
                (payload,) = deque(split_states(block), maxlen=1)
                record = decode(payload, State)
            except WireError:
                continue  # sent by a stranger
            if self._is_next_record(record, received_ns):
                self._record = record
                self._received_ns = received_ns
        for event in read_messages(self._events, Event):
            if (
                event.kind == "end"
                and self._record is not None
                and event.boot == self._record.boot
            ):
                self._is_over = True
        for _, alive in topics.read_presence(self._presence):
            self._was_present = self._was_present or alive
            self._is_over = self._is_over or (self._was_present and not alive)


class OutsideClient(SiteClient):
    """The connection of a program that sends messages to one channel of a site.

    It is a context manager that closes the connection.
    """

    channel = ""
    """The last part of the key under which the program publishes."""
    member = ""
    """The member whose keys the program uses; "" stands for the site."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        super().__init__(bus, clock, session, site)
        self._sender = SiteSender(
            bus=bus,
            clock=clock,
            session=session,
            site=site,
            channel=self.channel,
            boot=new_boot(),
        )

    @classmethod
    def connected(
        cls, session: str, site: str, connect: Sequence[str], keys: str | Path | None = None
    ) -> Self:
        """Returns a client that is connected to a site over Zenoh.

        Args:
            session: the session's name, by default the scenario's.
            site: the site of the arm.
            connect: the site's endpoints, as the site prints them when it waits for its arm.
            keys: the folder of keys, as for --keys. An arm uses the keys of its site, a switch
                uses those of the operator.

        Raises:
            UsageError: an endpoint cannot be used.
        """
        connection = secure_connection(Connection((), list(connect)), keys, insecure=False)
        bus = connection.require(cls.member or site).open()
        return cls(bus, SystemClock(), session, site)


class SwitchClient(OutsideClient):
    """The dead-man switch of an arm; its program reports whether somebody holds the switch.

    >>> place = ["tcp/127.0.0.1:10241"]
    >>> with tn.SwitchClient.connected("two_sites", "s", place) as switch:  # doctest: +SKIP
    ...     while not switch.over:
    ...         switch.send(held=button.is_pressed())  # at least every 100 ms
    ...         time.sleep(0.02)
    """

    channel = topics.ENABLE
    member = OPERATOR

    def send(self, *, held: bool) -> None:
        """Sends whether somebody holds the switch."""
        self._sender.send(ArmEnable, held=held)


class ArmClient(OutsideClient):
    """The connection of an arm to its site; a context manager that closes the connection.

    `record` is the newest record of the site.

    >>> place = ["tcp/127.0.0.1:10241"]
    >>> with tn.ArmClient.connected("two_sites", "s", place) as client:  # doctest: +SKIP
    ...     client.send(robot.q, robot.qd)
    ...     tau = client.torque()
    """

    channel = topics.MEASURED

    def send(
        self,
        q: Sequence[float],
        qd: Sequence[float],
        tau_x: Sequence[float] = (),
        stamp_ns: int | None = None,
    ) -> None:
        """Sends a measurement of the arm.

        Args:
            q: joint angles, rad.
            qd: joint velocities, rad/s.
            tau_x: torque of operator and environment, N m per joint, if the arm measures it. In
                the paper's sign: the torque ON the arm is the negative of `tau_x`.
            stamp_ns: time of the measurement, ns on any monotonic clock of the arm; by default
                the present time of this program's monotonic clock.

        Raises:
            ValueError: `tau_x` is not as long as `q`, or a number is not finite.
        """
        vectors = {"q": q, "qd": qd, "tau_x": tau_x}
        numbers = {name: [*map(float, vector)] for name, vector in vectors.items()}
        stamp = {} if stamp_ns is None else {"sent_ns": stamp_ns}
        self._sender.send(ArmMeasurement, **numbers, **stamp)

    def torque(self) -> tuple[float, ...] | None:
        """Returns the torque to apply now, N m per joint; None if the arm must brake.

        The arm must brake:
            - before the first tick and after the run,
            - if the newest record is older than `FRESH_NS`,
            - `BRAKE_NS` after a fault, or after the release of the dead-man switch. Until then
              the torque brings the arm to rest.
        """
        record = self.record
        if record is None or not self.fresh:
            return None
        # `mem` begins with the held pose and the time at which a fault or a stop began.
        shared = len(record.q_des)
        begun_ns = record.mem[shared : shared + 1]
        reason = record.mem[2 * shared + 1 : 2 * shared + 2]
        is_released = record.mode == "stopped" and reason == [LifeReason.RELEASED]
        if record.mode != "fault" and not is_released:
            return tuple(record.tau)
        if begun_ns and record.t_ns - begun_ns[0] < BRAKE_NS:
            return tuple(record.tau)
        return None


def make_hand_sender(bus: Bus, clock: Clock, session: str, site: str) -> SiteSender:
    """Returns a sender of a hand's messages to a site.

    Its boot lies in 1 ... 2^32 - 1: records store it as a float, and 0 means that nobody holds
    the arm.
    """
    return SiteSender(
        bus=bus,
        clock=clock,
        session=session,
        site=site,
        channel=topics.HAND,
        boot=new_boot() % (2**32 - 1) + 1,
    )


class Hand(SiteClient):
    """The hand of a person or a program at one arm; a context manager that releases the arm.

    Args:
        operator: the live hand of the scenario, as the kernel has it.
        compute_pose: returns the arm's pose for given joint angles, in the coordinates of the
            hand's target: of the end effector in m, or the joints in rad.
        source: a name of the holder, for events.
        repeats: whether a thread repeats the last message. Without the thread, the site
            releases the arm if the program hangs.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
        operator: TorqueSource,
        compute_pose: Callable[[Sequence[float]], Sequence[float]],
        source: str = "",
        *,
        repeats: bool = True,
    ) -> None:
        super().__init__(bus, clock, session, site)
        self._operator = operator
        self._compute_pose = compute_pose
        self._source = source
        self._sender = make_hand_sender(bus, clock, session, site)
        self._message: HandMessage | None = None
        self._lock = threading.Lock()
        self._ended = threading.Event()
        if repeats:
            threading.Thread(target=self._repeat_messages, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        """Releases the arm and waits until the site confirms it; leaves the bus open."""
        try:
            self.release()
            deadline_ns = self._clock.monotonic_ns() + 2 * GRIP_NS
            while self.holds and not self.over and self._clock.monotonic_ns() < deadline_ns:
                self._clock.sleep_until(self._clock.monotonic_ns() + 2_000_000)
        finally:
            self._ended.set()

    def move(self, *place_m: float) -> int:
        """Moves the target of the end effector to x, y (in space also z), m.

        The first call takes hold of the arm.

        Returns:
            The number of the message. The `hand` of each record names the number of the message
            that the record follows.

        Raises:
            UsageError: the hand of this site is not moved in this way, or a number is not
                finite.
        """
        return self._send("move", place_m)

    def turn(self, *angles_rad: float) -> int:
        """Moves the target angles of the joints, rad; otherwise like `move`."""
        return self._send("turn", angles_rad)

    def push(self, *force_n: float) -> int:
        """Sets the force ON the end effector, N; otherwise like `move`."""
        return self._send("push", force_n)

    def release(self) -> None:
        """Releases the arm; the grip fades within 100 ms."""
        with self._lock:
            is_gripping = self._message is not None
            self._message = None
            if is_gripping:
                self._sender.send(HandMessage, source=self._source, grip=False)

    @property
    def holds(self) -> bool:
        """True if this hand holds the arm, by the newest record."""
        hand = self.in_force
        return hand is not None and hand.source == self._sender.boot

    @property
    def number(self) -> int:
        """The number of this hand's newest message that the newest record follows.

        It is -1 if this hand does not hold the arm.
        """
        hand = self.in_force
        if hand is None or hand.source != self._sender.boot:
            return -1
        return hand.number

    @property
    def in_force(self) -> HandInForce | None:
        """The state of the holder's hand in the newest record; None before the first record."""
        record = self.record
        if record is None or not record.hand:
            return None
        return HandInForce.read(record.hand)

    @property
    def pose(self) -> tuple[float, ...]:
        """The pose of the arm in the newest record.

        It is the position of the end effector in m; for `turn` the joint angles in rad.
        """
        record = self._wait_for_record()
        return tuple(map(float, self._compute_pose(record.q)))

    @property
    def force(self) -> tuple[float, ...]:
        """The force of the holder ON the arm in the newest record, N; for `turn` torques, N m.

        A hand with a target pulls with F = K (target - pose) + B (target rate - pose rate),
        limited in size and scaled by the grip. The operator feels the negative of this force.
        """
        record = self._wait_for_record()
        operator = self._operator
        hand = HandInForce.read(record.hand)
        pull = list(hand.target)
        if operator.kind is not TorqueKind.LIVE_FORCE:
            pose = self._compute_pose(record.q)
            pose_rate = self._compute_pose_rate(record)
            terms = zip(
                operator.K, operator.B, hand.target, hand.rate, pose, pose_rate, strict=True
            )
            pull = [
                K * (target - position) + B * (target_rate - rate)
                for K, B, target, target_rate, position, rate in terms
            ]
        size = math.hypot(*pull)
        share = hand.grip * (operator.limit / size if size > operator.limit else 1.0)
        return tuple(share * component for component in pull)

    def _compute_pose_rate(self, record: State) -> list[float]:
        """Returns the rate of the pose by a central difference along the joint velocities."""
        step_s = _DERIVATIVE_STEP_S
        joints = list(zip(record.q, record.qd, strict=True))
        pose_after = self._compute_pose([q + step_s * qd for q, qd in joints])
        pose_before = self._compute_pose([q - step_s * qd for q, qd in joints])
        pairs = zip(pose_after, pose_before, strict=True)
        return [(after - before) / (2.0 * step_s) for after, before in pairs]

    def _wait_for_record(self) -> State:
        while (record := self.record) is None:
            if self.over:
                raise UsageError(f"the run of {self._site} has ended: there is no record")
            self._clock.sleep_until(self._clock.monotonic_ns() + 1_000_000)
        return record

    def _send(self, action: str, numbers: Sequence[float]) -> int:
        allowed = _ACTIONS[self._operator.kind]
        if action != allowed:
            raise UsageError(
                f"the hand of {self._site} can {allowed}, not {action}: "
                "see its mode in the scenario"
            )
        goal = [float(number) for number in numbers]
        if not all(map(math.isfinite, goal)):
            raise UsageError(f"a hand can {allowed} to finite numbers, not to {goal}")
        key = "force" if allowed == "push" else "target"
        with self._lock:
            self._message = self._sender.send(HandMessage, source=self._source, **{key: goal})
            return self._sender.number

    def _repeat_messages(self) -> None:
        while not self._ended.wait(HEARTBEAT_S):
            with self._lock:
                if self._message is not None:
                    self._sender.repeat(self._message)
