"""Connects a program to a site: the driver of a real arm, a dead-man switch, or an operator.

A site is a process that computes the torque of one arm. If the arm is external (`plant =
"external"` in the scenario), its driver sends the measured joint positions to the site, and
applies the torque that the site publishes:

    with ArmClient.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as client:
        while not client.over:
            client.send(*robot.joints())
            tau = client.torque()
            robot.brake() if tau is None else robot.apply(tau)
            robot.wait()

`SwitchClient` reports whether somebody holds the dead-man switch of such an arm. `Hand` lets a
person or a program move an arm as its operator. Clients read torques and forces from the
records that the recorder stores as well. Therefore the log contains exactly what was applied to
the arm.

Invariant:
    - `ArmClient.torque` returns None if no valid torque is available. The arm must then brake.
    - A client accepts only records that continue those that it has received: from the same
      process of the site, newer, and not implausibly far in the future. Otherwise a second
      process of the same name, or a forged message, could move the arm.
    - While an operator sends no new target, a thread repeats the last message. If no more
      messages arrive, the site knows that the operator's program has died, and releases the
      arm.
"""

import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self, TypeVar

from ..core import GRIP_NS, RELEASE_REASONS, SILENCE_NS, HandInForce, TorqueKind, TorqueSource
from ..errors import UsageError, WireError
from . import topics
from .bus import Bus
from .clock import Clock, SystemClock
from .connection import Connection
from .membership import new_boot, read_messages
from .messages import Event, State
from .requests import ArmEnable, ArmMeasurement, DirectMessage, HandMessage
from .wire import decode, encode, split_states
from .zenoh_config import OPERATOR

FRESH_NS = 100_000_000
"""Largest age of a usable record, in ns. If the record is older, the site is late or gone."""
AHEAD_NS = 1_000_000_000
"""Largest time by which a record may be ahead of its expected time, in ns.

The expected time of a record is the time of the previous one plus the time between their
arrivals.
"""
_BRAKE_NS = 100_000_000
"""Time from a fault, or from the release of the dead-man switch, until the brakes hold, in ns.
"""
_HEARTBEAT_S = SILENCE_NS / 4e9
"""Period with which an operator's last message is repeated, in s."""
_ACTIONS = {
    TorqueKind.LIVE_TIP: "move",
    TorqueKind.LIVE_JOINT: "turn",
    TorqueKind.LIVE_FORCE: "push",
}
"""Name of the method with which an operator of each kind moves an arm."""
_DERIVATIVE_STEP_S = 1e-6
"""Step of the numerical derivative of the arm's pose, in s."""


R = TypeVar("R", bound=DirectMessage)


class _SiteSender:
    """Sends numbered messages to one channel of a site.

    A site is a process that runs one arm and its control loop. The messages of a sender are
    numbered, so that the site detects lost, repeated and reordered messages.

    Args:
        bus: Network connection that reaches the site.
        clock: Clock of this process.
        session: Name of the session.
        site: Name of the site.
        channel: Channel of the messages, the last part of their key.
        boot: Random number that identifies this start of the sending program.

    Attributes:
        boot: Random number that identifies this start of the sending program.
        number: Number of the newest message, from 0. It is -1 before the first message.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
        channel: str,
        boot: int,
    ) -> None:
        """Opens a channel for messages to a site (arm controller). No message is sent yet."""
        self.boot = boot
        self.number = -1
        self._clock = clock
        self._site = site
        self._publish = bus.publisher(topics.key(session, site, channel))

    def send(self, kind: type[R], **fields: object) -> R:
        """Sends a message to an arm controller (site), under the next number.

        Args:
            kind: Class of the message.
            **fields: Fields of the message other than the site, the boot and the number. They
                may replace the time stamp `sent_ns`, which is otherwise the present time of the
                clock.

        Returns:
            The message that was sent.
        """
        header = {"site": self._site, "boot": self.boot, "n": self.number + 1}
        stamp = {"sent_ns": self._clock.monotonic_ns()}
        message = kind(**(header | stamp | fields))  # type: ignore[arg-type]
        self.number += 1
        self.repeat(message)
        return message

    def repeat(self, message: R) -> None:
        """Sends a message again with the same number, to show that the program still runs.

        The site recognises the number, and does not execute the message a second time.

        Args:
            message: Message that `send` has returned.
        """
        self._publish(encode(message))


class HandSender(_SiteSender):
    """Sends the messages of an operator to the site of an arm.

    The operator is the person or program that moves the arm. A random number in 1 ... 2^32 - 1
    identifies the operator's program. The records of the site store this number as a float,
    which represents such numbers exactly. In a record, the number 0 means that no operator
    moves the arm.

    Args:
        bus: Network connection of the operator's program.
        clock: Clock of this process.
        session: Name of the session.
        site: Name of the site.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
    ) -> None:
        super().__init__(
            bus=bus,
            clock=clock,
            session=session,
            site=site,
            channel=topics.HAND,
            boot=new_boot() % (2**32 - 1) + 1,
        )

    def move(self, source: str, **fields: object) -> HandMessage:
        """Sends a target or a force to the site, or releases its arm.

        Args:
            source: Name of the operator for people.
            **fields: Further fields of `HandMessage`.

        Returns:
            The message that was sent.
        """
        return self.send(HandMessage, source=source, **fields)


class SiteClient:
    """Connection of a program to one site, from which it receives records and events.

    The object is a context manager that closes the network connection.

    A site is a process that runs one arm and its control loop. A record is the result of one
    period of this loop.

    Args:
        bus: Network connection that reaches the site.
        clock: Clock of this process.
        session: Name of the session.
        site: Name of the site.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
    ) -> None:
        """Subscribes to the records, the events and the presence of a site (arm controller)."""
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
        """Newest record of the arm controller (site) that has arrived, with angles and torque.

        A record is the result of one period of the control loop. The value is None before the
        first record has arrived.
        """
        self._read_messages()
        return self._record

    @property
    def fresh(self) -> bool:
        """True if the newest record can still be used to control the arm.

        This is the case if the record is at most `FRESH_NS` old and the run continues. It is
        False before the first tick (period of the control loop), after the run, and once the
        run has diverged.
        """
        record = self.record
        if record is None or self._is_over or record.mode == "diverged":
            return False
        return self._clock.monotonic_ns() - self._received_ns <= FRESH_NS

    @property
    def over(self) -> bool:
        """True once no more records of the site (arm controller) will arrive.

        This is the case if the run of the site has ended, or if its process is gone.
        """
        self._read_messages()
        return self._is_over

    def _is_next_record(self, record: State, received_ns: int) -> bool:
        """Returns True if a record may follow the newest known one.

        It must come from the same process of the site and be newer. Its time must not be more
        than `AHEAD_NS` later than the time of the newest record (result of a control period)
        plus the time since that record arrived. A forged record with a time far in the future
        would otherwise make the client ignore all correct records.

        Args:
            record: The record.
            received_ns: Time of its arrival on the local clock, in ns.
        """
        newest = self._record
        if newest is None:
            return True
        is_newer = (
            record.boot == newest.boot
            and record.tick > newest.tick
            and record.t_ns > newest.t_ns
        )
        elapsed_ns = received_ns - self._received_ns
        is_plausible = record.t_ns - newest.t_ns <= elapsed_ns + AHEAD_NS
        return is_newer and is_plausible

    def _read_messages(self) -> None:
        """Receives all waiting messages, and updates the newest record and the end of the run.

        The run of the site (arm controller) has ended if the site has published its end, or if
        its liveliness token, which exists as long as its process is connected, has disappeared.
        """
        while (message := self._records.poll()) is not None:
            block, received_ns = message
            try:
                # A block holds the records of several ticks. Only the last one matters here.
                (payload,) = deque(split_states(block), maxlen=1)
                record = decode(payload, State)
            except WireError:
                continue  # sent by another program
            if self._is_next_record(record, received_ns):
                self._record = record
                self._received_ns = received_ns

        for event in read_messages(self._events, Event):
            # Only the process that sent the records can end the run, not another process of the
            # same name.
            newest = self._record
            if event.kind == "end" and newest is not None and event.boot == newest.boot:
                self._is_over = True

        for _, is_alive in topics.read_presence(self._presence):
            self._was_present = self._was_present or is_alive
            is_gone = self._was_present and not is_alive
            self._is_over = self._is_over or is_gone


class _OutsideClient(SiteClient):
    """Connection of a program that also sends messages to one channel of a site.

    `ArmClient` and `SwitchClient` define the channel. The object is a context manager that
    closes the network connection.

    A site is a process that runs one arm and its control loop. The channel is one stream of
    messages to the site, for example that of the measurements of its arm.

    Args:
        bus: Network connection that reaches the site.
        clock: Clock of this process.
        session: Name of the session.
        site: Name of the site.
    """

    channel = ""
    """The last part of the key under which the program publishes."""
    member = ""
    """The member whose keys the program uses; "" stands for the site."""

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
    ) -> None:
        """Subscribes to the messages of a site (arm controller), and opens a channel to it."""
        super().__init__(bus, clock, session, site)
        self._sender = _SiteSender(
            bus=bus,
            clock=clock,
            session=session,
            site=site,
            channel=self.channel,
            boot=new_boot(),
        )

    @classmethod
    def connected(
        cls,
        session: str,
        site: str,
        connect: Sequence[str],
        keys: str | Path | None = None,
    ) -> Self:
        """Connects a program to an arm controller (site) over the network.

        Args:
            session: Name of the session, by default the name of the scenario.
            site: Name of the site, the process that runs the arm.
            connect: Endpoints of the site, which the site prints while it waits for its arm.
            keys: Folder with the keys of one member, as `trilat keys new` creates it. The
                program of an arm uses the keys of its site. The program of a dead-man switch
                uses the keys of the operator. If None, the connection uses no keys.

        Returns:
            The client.

        Raises:
            UsageError: An endpoint or the keys cannot be used.
        """
        connection = Connection((), list(connect)).secure(keys, insecure=False)
        bus = connection.require(cls.member or site).open()
        return cls(bus, SystemClock(), session, site)


class SwitchClient(_OutsideClient):
    """Connection of the program of a dead-man switch to the site of the arm.

    The program reports regularly whether somebody holds the switch. The arm stops if the switch
    is released, or if no message has arrived for 100 ms.

    >>> endpoints = ["tcp/127.0.0.1:10241"]
    >>> with tn.SwitchClient.connected("two_sites", "s", endpoints) as switch:  # doctest: +SKIP
    ...     while not switch.over:
    ...         switch.send(held=button.is_pressed())  # at least every 100 ms
    ...         time.sleep(0.02)
    """

    channel = topics.ENABLE
    member = OPERATOR
    """Member whose keys the program uses. Empty stands for the site."""

    def send(self, *, held: bool) -> None:
        """Reports to the site whether somebody holds the dead-man switch.

        The program of the switch must report at least every 100 ms, because the arm stops
        otherwise.

        Args:
            held: True while somebody holds the switch. False stops the arm at once.
        """
        self._sender.send(ArmEnable, held=held)


class ArmClient(_OutsideClient):
    """Connection of the driver of an external arm to the site that controls the arm.

    The driver sends measurements with `send`, and reads the torque to apply with `torque`. The
    attribute `record` is the newest record of the site, the result of one period of its control
    loop. The object is a context manager that closes the network connection.

    >>> endpoints = ["tcp/127.0.0.1:10241"]
    >>> with tn.ArmClient.connected("two_sites", "s", endpoints) as client:  # doctest: +SKIP
    ...     client.send(robot.q, robot.qd)
    ...     tau = client.torque()
    """

    channel = topics.MEASURED
    """Channel of the messages, the last part of their key."""

    def send(
        self,
        q: Sequence[float],
        qd: Sequence[float],
        tau_x: Sequence[float] = (),
        stamp_ns: int | None = None,
    ) -> None:
        """Sends a measurement of a real arm, such as its joint angles, to its controller.

        Args:
            q: Joint angles in rad.
            qd: Joint velocities in rad/s.
            tau_x: Torque of the operator and the environment in N m per joint, if the arm
                measures it. The sign is that of the paper: the torque that acts ON the arm is
                the negative of `tau_x`.
            stamp_ns: Time of the measurement in ns, on any monotonic clock of the arm. If None,
                the present time of this program's monotonic clock is used.

        Raises:
            ValueError: `tau_x` and `q` have different lengths, or a number is not finite.
        """
        vectors = {"q": q, "qd": qd, "tau_x": tau_x}
        vectors_by_name = {
            name: [float(number) for number in vector] for name, vector in vectors.items()
        }
        optional_stamp = {} if stamp_ns is None else {"sent_ns": stamp_ns}
        self._sender.send(ArmMeasurement, **vectors_by_name, **optional_stamp)

    def torque(self) -> tuple[float, ...] | None:
        """Returns the torque to apply now, or None if the arm must brake.

        The torque is that of the newest record, the result of one tick (period of the control
        loop) of the site (arm controller). The arm must brake in these cases:

        - before the first tick and after the run,
        - if the newest record is older than `FRESH_NS`,
        - `_BRAKE_NS` after a fault or after the release of the dead-man switch. Until then the
          torque brings the arm to rest. If the switch is released while the arm is stopped by
          order, this time counts from the stop.

        Returns:
            The torque in N m per joint. None if the arm must brake.
        """
        record = self.record
        if record is None or not self.fresh:
            return None

        # With n coordinates, `mem`, the memory of the site in a record, contains: n coordinates
        # of the position that the arm holds, the time at which the fault or stop began, n
        # further numbers, and the reason of a stop. Each slice below is a list with one number,
        # or empty in records without these numbers.
        n = len(record.q_des)
        begun_index = n
        reason_index = 2 * n + 1
        begun_ns = record.mem[begun_index : begun_index + 1]
        stop_reason = record.mem[reason_index : reason_index + 1]
        was_released = bool(stop_reason) and stop_reason[0] in RELEASE_REASONS
        is_switch_released = record.mode == "stopped" and was_released
        must_brake_soon = record.mode == "fault" or is_switch_released
        if must_brake_soon:
            is_coming_to_rest = bool(begun_ns) and record.t_ns - begun_ns[0] < _BRAKE_NS
            if not is_coming_to_rest:
                return None
        return tuple(record.tau)


class Hand(SiteClient):
    """Connection of a person or a program that moves an arm as its operator.

    `tn.hand` and the commands of the live page create it. The first call of `move`, `turn` or
    `push` starts to move the arm. Which of them is permitted depends on whether the operator in
    the scenario has a target position, target angles, or a force. `release` ends the operator's
    influence. The object is a context manager that releases the arm at its end.

    Args:
        bus: Network connection.
        clock: Clock of this process.
        session: Name of the session.
        site: Site of the arm.
        operator: Settings of the live operator in the scenario, as the simulation kernel stores
            them.
        compute_pose: Function that returns the arm's pose for given joint angles, in the
            coordinates of the operator's target: the position of the end effector in m, or the
            joint angles in rad.
        source: Name of the person or program, which events of the session mention.
        repeats: True if a thread repeats the last message. Without the thread, the site
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
        """Connects to a site (arm controller). The arm moves only after a further call."""
        super().__init__(bus, clock, session, site)
        self._operator = operator
        self._compute_pose = compute_pose
        self._source = source

        self._sender = HandSender(bus, clock, session, site)
        # The newest message, which a thread repeats, so that the site knows that this program
        # still runs. The lock keeps the two threads from sending at the same time.
        self._message: HandMessage | None = None
        self._lock = threading.Lock()
        self._ended = threading.Event()
        if repeats:
            threading.Thread(target=self._repeat_messages, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        """Releases the arm, and waits until its record shows that nobody holds it any more.

        The wait takes at most twice the time in which the grip fades, even if no record (result
        of a control period) arrives. The bus stays open, because the caller opened it.
        """
        try:
            self.release()
            deadline_ns = self._clock.monotonic_ns() + 2 * GRIP_NS
            while self.holds and not self.over and self._clock.monotonic_ns() < deadline_ns:
                self._clock.sleep_until(self._clock.monotonic_ns() + 2_000_000)
        finally:
            self._ended.set()

    def move(self, *place_m: float) -> int:
        """Pulls the end effector of the arm towards a target position, like a spring.

        Args:
            *place_m: Coordinates x and y of the target, for an arm in space also z, in m.

        Returns:
            The number of the message. The property `number` has this value once the site (arm
            controller) follows the message.

        Raises:
            UsageError: The scenario's operator is not moved in this way, or a number is not
                finite.
        """
        return self._send("move", place_m)

    def turn(self, *angles_rad: float) -> int:
        """Pulls the joints of the arm towards target angles, like springs.

        Args:
            *angles_rad: Target angle of each joint, in rad.

        Returns:
            The number of the message, see `move`.

        Raises:
            UsageError: The scenario's operator is not moved in this way, or a number is not
                finite.
        """
        return self._send("turn", angles_rad)

    def push(self, *force_n: float) -> int:
        """Pushes the end effector of the arm with a force, as a person would with a hand.

        Args:
            *force_n: Coordinates of the force that acts ON the end effector, in N.

        Returns:
            The number of the message, see `move`.

        Raises:
            UsageError: The scenario's operator does not apply forces, or a number is not
                finite.
        """
        return self._send("push", force_n)

    def release(self) -> None:
        """Stops moving the arm. The force on it fades within 100 ms, so that it does not jump.

        Afterwards, `move`, `turn` or `push` may take hold of the arm again.
        """
        with self._lock:
            is_gripping = self._message is not None
            self._message = None
            if is_gripping:
                self._sender.move(self._source, grip=False)

    @property
    def holds(self) -> bool:
        """True if this program moves the arm, as its operator, in the newest record.

        A record contains the state of the site in one period of its control loop. The value is
        False if another operator or nobody moves the arm, or if there is no record yet.
        """
        hand = self.in_force
        return hand is not None and hand.source == self._sender.boot

    @property
    def number(self) -> int:
        """Number of the message from this program that the arm followed in its newest record.

        It is the number that `move`, `turn` or `push` returned, or -1 if this program does not
        move the arm at present.
        """
        hand = self.in_force
        if hand is None or hand.source != self._sender.boot:
            return -1
        return hand.number

    @property
    def in_force(self) -> HandInForce | None:
        """Operator who moves the arm in the newest record, with the present target or force.

        A record contains the state of the site in one period of its control loop. The operator
        may be this program or another program. The value is None if nobody moves the arm, or if
        there is no record yet.
        """
        record = self.record
        if record is None or not record.hand:
            return None
        return HandInForce.read(record.hand)

    @property
    def pose(self) -> tuple[float, ...]:
        """Pose of the arm in the newest received record.

        It is the position of the end effector in m, or for `turn` the joint angles in rad.
        """
        record = self._wait_for_record()
        return tuple(map(float, self._compute_pose(record.q)))

    @property
    def force(self) -> tuple[float, ...]:
        """Force of the operator ON the arm in the newest record, in N.

        For `turn`, these are the torques on the joints in N m.

        An operator with a target pulls the arm like a spring and a damper,

            F = K (target - pose) + B (target rate - pose rate).

        The force is limited in size, and scaled by the grip between 0 and 1. The operator feels
        the negative of this force.
        """
        record = self._wait_for_record()
        operator = self._operator
        hand = HandInForce.read(record.hand)

        pull = list(hand.target)  # for an operator with a force, the target is the force
        if operator.kind is not TorqueKind.LIVE_FORCE:
            pose = self._compute_pose(record.q)
            pose_rate = self._compute_pose_rate(record)
            coordinates = zip(
                operator.K, operator.B, hand.target, hand.rate, pose, pose_rate, strict=True
            )
            pull = [
                K * (target - position) + B * (target_rate - rate)
                for K, B, target, target_rate, position, rate in coordinates
            ]

        magnitude = math.hypot(*pull)
        limitation = operator.limit / magnitude if magnitude > operator.limit else 1.0
        scale = hand.grip * limitation
        return tuple(scale * component for component in pull)

    def _compute_pose_rate(self, record: State) -> list[float]:
        """Returns the velocity of the end effector, or of the angles that the operator turns.

        It is computed as a central difference, because only a function for the pose is known:
        the pose is evaluated a little later and a little earlier along the measured joint
        velocities, and the difference is divided by the time between the two.

        Args:
            record: Record (result of a control period) of the site (arm controller), with
                angles and velocities of the joints.

        Returns:
            The rate of each coordinate of the pose, m/s or rad/s.
        """
        step_s = _DERIVATIVE_STEP_S
        joints = list(zip(record.q, record.qd, strict=True))
        pose_after = self._compute_pose([q + step_s * qd for q, qd in joints])
        pose_before = self._compute_pose([q - step_s * qd for q, qd in joints])
        pairs = zip(pose_after, pose_before, strict=True)
        return [(later - earlier) / (2.0 * step_s) for later, earlier in pairs]

    def _wait_for_record(self) -> State:
        """Returns the newest record of the site (arm controller), and waits for the first one.

        Raises:
            UsageError: The run has ended before the first record.
        """
        while (record := self.record) is None:
            if self.over:
                raise UsageError(f"the run of {self._site} ended before a record arrived")
            self._clock.sleep_until(self._clock.monotonic_ns() + 1_000_000)
        return record

    def _send(self, action: str, numbers: Sequence[float]) -> int:
        """Sends a target or force to the arm controller, and returns the message's number.

        Args:
            action: Name of the method that the program called: "move", "turn" or "push".
            numbers: Coordinates of the target or the force.

        Raises:
            UsageError: The scenario's operator has another kind, or a number is not finite.
        """
        permitted_action = _ACTIONS[self._operator.kind]
        if action != permitted_action:
            raise UsageError(
                f"the hand of {self._site} can {permitted_action}, not {action}: "
                "see the mode of the hand in the scenario"
            )
        coordinates = [float(number) for number in numbers]
        if not all(map(math.isfinite, coordinates)):
            raise UsageError(f"the numbers of {action} must be finite, not {coordinates}")
        field = "force" if permitted_action == "push" else "target"
        with self._lock:
            self._message = self._sender.move(self._source, **{field: coordinates})
            return self._sender.number

    def _repeat_messages(self) -> None:
        """Repeats the last message while the program holds the arm, in a thread of its own.

        Without the repeated messages, the site would assume that a program without a new target
        has died, and would release the arm. The thread ends when the object is closed.
        """
        while not self._ended.wait(_HEARTBEAT_S):
            with self._lock:
                if self._message is not None:
                    self._sender.repeat(self._message)
