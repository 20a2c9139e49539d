"""Connects programs to a site: the driver of a real arm, a dead-man switch, or an operator.

If an arm is external (`plant = "external"` in the scenario), its driver sends the measured
joint positions to the site and applies the torque that the site publishes:

    with ArmClient.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as client:
        while not client.over:
            client.send(*robot.joints())
            tau = client.torque()
            robot.brake() if tau is None else robot.apply(tau)
            robot.wait()

`SwitchClient` reports whether the dead-man switch of such an arm is held. `Hand` lets a person
or a program move an arm as its operator. Clients read torques and forces from the same records
that the recorder stores, so the log shows exactly what was applied to the arm.

Invariant:
    - `ArmClient.torque` returns None if no valid torque is available. The arm must then brake.
    - A client only accepts records from the site process it has been following, and only if
      they are newer than the previous record and not implausibly far in the future. This
      prevents a second process with the same name, or a forged message, from moving the arm.
    - While the operator's target does not change, a thread keeps repeating the last message.
      When the messages stop, the site concludes that the operator's program has died and
      releases the arm.
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
from .membership import new_boot
from .messages import Event, State
from .requests import ArmEnable, ArmMeasurement, DirectMessage, HandMessage
from .wire import decode, encode, read_messages, split_states
from .zenoh_config import OPERATOR

FRESH_NS = 100_000_000
"""Maximum age of a usable record, in ns. If the newest record is older, the site is late or
gone.
"""
AHEAD_NS = 1_000_000_000
"""Maximum time by which a record may be ahead of its expected time, in ns.

The expected time of a record is the time of the previous record plus the time between their
arrivals.
"""
_BRAKE_NS = 100_000_000
"""Time from a fault, or the release of the dead-man switch, until the brakes hold, in ns."""
_HEARTBEAT_S = SILENCE_NS / 4e9
"""Interval at which an operator's last message is repeated, in s."""
_ACTIONS = {
    TorqueKind.LIVE_TIP: "move",
    TorqueKind.LIVE_JOINT: "turn",
    TorqueKind.LIVE_FORCE: "push",
}
"""Mapping from each kind of operator to the name of the method that moves the arm."""
_DERIVATIVE_STEP_S = 1e-6
"""Step size of the numerical derivative of the arm's pose, in s."""


R = TypeVar("R", bound=DirectMessage)


class _SiteSender:
    """Sends numbered messages to one channel of a site.

    The numbers allow the site to detect lost, repeated and reordered messages.

    Args:
        bus: Network connection through which the site can be reached.
        clock: Clock of this process.
        session: Name of the session.
        site: Name of the site.
        channel: Channel of the messages (the last part of their key).
        boot: Random number that identifies this start of the sending program.

    Attributes:
        boot: Random number that identifies this start of the sending program.
        number: Number of the newest message, from 0. -1 before the first message.
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
        """Opens a channel for messages to a site. No message is sent yet."""
        self.boot = boot
        self.number = -1
        self._clock = clock
        self._site = site
        self._publish = bus.publisher(topics.key(session, site, channel))

    def send(self, kind: type[R], **fields: object) -> R:
        """Sends a message with the next sequence number to a site.

        Args:
            kind: Class of the message.
            **fields: Fields of the message other than `site`, `boot` and `n` (the sequence
                number). Pass `sent_ns` to override the time stamp, which is otherwise the
                current time.

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
        """Resends a message with its original number, to show that the sender is still running.

        The site recognises the number and does not execute the message a second time.

        Args:
            message: A message returned by `send`.
        """
        self._publish(encode(message))


class HandSender(_SiteSender):
    """Sends an operator's messages to the site of an arm.

    The operator's program is identified by a random number in 1 ... 2^32 - 1, which the records
    of the site store as a float without loss of precision. In a record, 0 means that no
    operator is moving the arm.

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
            source: Name of the operator, as shown to people.
            **fields: Other fields of `HandMessage`.

        Returns:
            The message that was sent.
        """
        return self.send(HandMessage, source=source, **fields)


class SiteClient:
    """Receives the records and events of one site.

    Use the client as a context manager to close the network connection.

    Args:
        bus: Network connection through which the site can be reached.
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
        """Subscribes to the records, the events and the presence of a site."""
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
        """Newest record received from the site, which contains the joint angles and the torque.

        None until the first record arrives.
        """
        self._read_messages()
        return self._record

    @property
    def fresh(self) -> bool:
        """True if the newest record is recent enough to control the arm.

        The record must be at most `FRESH_NS` old. False before the first tick, after the end of
        the run, and once the run has diverged.
        """
        record = self.record
        if record is None or self._is_over or record.mode == "diverged":
            return False
        return self._clock.monotonic_ns() - self._received_ns <= FRESH_NS

    @property
    def over(self) -> bool:
        """True once the site will send no more records.

        Either its run has ended or its process has disappeared.
        """
        self._read_messages()
        return self._is_over

    def _is_next_record(self, record: State, received_ns: int) -> bool:
        """Returns True if a record is a valid successor of the newest known one.

        It must come from the same process of the site and be newer. Its time must not exceed
        the time of the newest record, plus the time since that record arrived, by more than
        `AHEAD_NS`. Otherwise, a forged record with a time far in the future would make the
        client ignore all correct records.

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
        """Processes all pending messages, and updates the newest record and the end of the run.

        The run of the site has ended if the site has published its end, or if its liveliness
        token has disappeared, which happens when its process loses its connection.
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
    """Connects a program that also sends messages to one channel of a site.

    The channel, for example that of the measurements of an arm, is defined by `ArmClient` and
    `SwitchClient`. Use the client as a context manager to close the network connection.

    Args:
        bus: Network connection through which the site can be reached.
        clock: Clock of this process.
        session: Name of the session.
        site: Name of the site.
    """

    channel = ""
    """Last part of the key under which the program publishes."""
    member = ""
    """Member whose keys the program uses, or an empty string for the site."""

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
    ) -> None:
        """Subscribes to the messages of a site, and opens a channel to it."""
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
        """Connects a program to a site over the network.

        Args:
            session: Name of the session. Unless the session was given a name, this is the name
                of its scenario.
            site: Name of the site.
            connect: Endpoints of the site, which the site prints while it waits for its arm.
            keys: Folder with the keys of one member, as created by `trilat keys new`. An arm's
                driver uses the keys of the arm's site; the program of a dead-man switch uses
                the keys of the operator. If None, the connection uses no keys.

        Returns:
            The client.

        Raises:
            UsageError: An endpoint or the keys cannot be used.
        """
        connection = Connection((), list(connect)).secure(keys, insecure=False)
        bus = connection.require(cls.member or site).open()
        return cls(bus, SystemClock(), session, site)


class SwitchClient(_OutsideClient):
    """Connects the program of a dead-man switch to the site of the arm.

    The program regularly reports whether the switch is held. The arm stops when the switch is
    released, or when no report has arrived for 100 ms.

    >>> endpoints = ["tcp/127.0.0.1:10241"]
    >>> with tn.SwitchClient.connected("two_sites", "s", endpoints) as switch:  # doctest: +SKIP
    ...     while not switch.over:
    ...         switch.send(held=button.is_pressed())  # at least every 100 ms
    ...         time.sleep(0.02)
    """

    channel = topics.ENABLE
    member = OPERATOR
    """Member whose keys the program uses, or an empty string for the site."""

    def send(self, *, held: bool) -> None:
        """Reports to the site whether the dead-man switch is held.

        Call this at least every 100 ms; otherwise the arm stops.

        Args:
            held: True while the switch is held. False stops the arm at once.
        """
        self._sender.send(ArmEnable, held=held)


class ArmClient(_OutsideClient):
    """Connects the driver of an external arm to the site that controls the arm.

    The driver sends measurements with `send` and reads the torque to apply with `torque`. The
    attribute `record` holds the newest record of the site. Use the client as a context manager
    to close the network connection.

    >>> endpoints = ["tcp/127.0.0.1:10241"]
    >>> with tn.ArmClient.connected("two_sites", "s", endpoints) as client:  # doctest: +SKIP
    ...     client.send(robot.q, robot.qd)
    ...     tau = client.torque()
    """

    channel = topics.MEASURED
    """Channel of the messages (the last part of their key)."""

    def send(
        self,
        q: Sequence[float],
        qd: Sequence[float],
        tau_x: Sequence[float] = (),
        stamp_ns: int | None = None,
    ) -> None:
        """Sends measured joint angles (rad) and velocities (rad/s) of a real arm to its site.

        Args:
            q: Joint angles in rad.
            qd: Joint velocities in rad/s.
            tau_x: Torque exerted by the operator and the environment, in N m per joint, if the
                arm measures it. The sign convention is that of the paper: `tau_x` is the
                negative of the torque that acts ON the arm.
            stamp_ns: Time of the measurement in ns, on any monotonic clock of the arm. If None,
                the current time of this program's monotonic clock is used.

        Raises:
            ValueError: `tau_x` and `q` have different lengths, or a value is not finite.
        """
        vectors = {"q": q, "qd": qd, "tau_x": tau_x}
        vectors_by_name = {
            name: [float(number) for number in vector] for name, vector in vectors.items()
        }
        optional_stamp = {} if stamp_ns is None else {"sent_ns": stamp_ns}
        self._sender.send(ArmMeasurement, **vectors_by_name, **optional_stamp)

    def torque(self) -> tuple[float, ...] | None:
        """Returns the torque to apply now, in N m per joint, or None if the arm must brake.

        The torque is taken from the newest record of the site. The arm must brake in these
        cases:

        - before the first tick and after the end of the run,
        - if the newest record is older than `FRESH_NS`,
        - once `_BRAKE_NS` have passed since a fault or the release of the dead-man switch.
          Before that, the torque brings the arm to rest. If the arm had already been stopped by
          a command when the switch was released, this time is measured from the stop.
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
    """Lets a person or a program move an arm as its operator.

    Instances are created by `tn.hand` and by the commands of the live page. The first call to
    `move`, `turn` or `push` takes hold of the arm. Which of the three is allowed depends on
    whether the scenario gives the operator a target position, target angles or a force.
    `release` lets go of the arm. When used as a context manager, the arm is released on exit.

    Args:
        bus: Network connection.
        clock: Clock of this process.
        session: Name of the session.
        site: Site of the arm.
        operator: Settings of the scenario's live operator, as stored by the simulation kernel.
        compute_pose: Function that computes the arm's pose from its joint angles, in the
            coordinates of the operator's target: the position of the end effector in m, or the
            joint angles in rad.
        source: Name of the person or program, which is mentioned in the events of the session.
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
        """Connects to a site. The arm does not move until a method such as `move` is called."""
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

        The wait takes at most twice the time in which the grip fades, even if no record
        arrives. The bus stays open, because it was opened by the caller.
        """
        try:
            self.release()
            deadline_ns = self._clock.monotonic_ns() + 2 * GRIP_NS
            while self.holds and not self.over and self._clock.monotonic_ns() < deadline_ns:
                self._clock.sleep_until(self._clock.monotonic_ns() + 2_000_000)
        finally:
            self._ended.set()

    def move(self, *place_m: float) -> int:
        """Pulls the end effector towards a target position in m, like a spring.

        Args:
            *place_m: Coordinates of the target in m: x and y, plus z for an arm in space.

        Returns:
            The number of the message. The property `number` changes to this value once the site
            follows the message.

        Raises:
            UsageError: The scenario does not give the operator a target position, or a
                coordinate is not finite.
        """
        return self._send("move", place_m)

    def turn(self, *angles_rad: float) -> int:
        """Pulls the joints of the arm towards target angles in rad, like springs.

        Args:
            *angles_rad: Target angle of each joint, in rad.

        Returns:
            The number of the message, see `move`.

        Raises:
            UsageError: The scenario does not give the operator target angles, or an angle is
                not finite.
        """
        return self._send("turn", angles_rad)

    def push(self, *force_n: float) -> int:
        """Pushes the end effector of the arm with a force in N, as a person's hand would.

        Args:
            *force_n: Components of the force that acts ON the end effector, in N.

        Returns:
            The number of the message, see `move`.

        Raises:
            UsageError: The scenario does not give the operator a force, or a component is not
                finite.
        """
        return self._send("push", force_n)

    def release(self) -> None:
        """Lets go of the arm. The force fades within 100 ms, to avoid a sudden movement.

        `move`, `turn` or `push` can take hold of the arm again.
        """
        with self._lock:
            is_gripping = self._message is not None
            self._message = None
            if is_gripping:
                self._sender.move(self._source, grip=False)

    @property
    def holds(self) -> bool:
        """True if, according to the newest record, this program is the operator moving the arm.

        False if another operator or nobody is moving the arm, or if no record has arrived yet.
        """
        hand = self.in_force
        return hand is not None and hand.source == self._sender.boot

    @property
    def number(self) -> int:
        """Number of the message from this program that the arm follows in the newest record.

        Matches the number returned by `move`, `turn` or `push`. -1 if this program is not
        moving the arm.
        """
        hand = self.in_force
        if hand is None or hand.source != self._sender.boot:
            return -1
        return hand.number

    @property
    def in_force(self) -> HandInForce | None:
        """The operator moving the arm in the newest record, with the current target or force.

        The operator may be this program or another one. None if nobody is moving the arm, or if
        no record has arrived yet.
        """
        record = self.record
        if record is None or not record.hand:
            return None
        return HandInForce.read(record.hand)

    @property
    def pose(self) -> tuple[float, ...]:
        """Pose of the arm in the newest record received.

        This is the position of the end effector in m or, for `turn`, the joint angles in rad.
        """
        record = self._wait_for_record()
        return tuple(map(float, self._compute_pose(record.q)))

    @property
    def force(self) -> tuple[float, ...]:
        """Force that the operator exerts ON the arm in the newest record, in N.

        For `turn`, these are joint torques in N m.

        An operator with a target pulls the arm like a spring and a damper,

            F = K (target - pose) + B (target rate - pose rate).

        The magnitude of the force is limited, and the force is scaled by the grip (0 to 1). The
        operator feels the negative of this force.
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
        """Returns the velocity of the end effector (m/s) or of the turned joint angles (rad/s).

        Because only a function for the pose is known, the velocity is computed as a central
        difference: the pose is evaluated slightly later and slightly earlier along the measured
        joint velocities, and the difference is divided by the time between the two.

        Args:
            record: Record of the site, with angles and velocities of the joints.

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
        """Returns the newest record of the site, waiting for the first one if necessary.

        Raises:
            UsageError: The run has ended before the first record.
        """
        while (record := self.record) is None:
            if self.over:
                raise UsageError(f"the run of {self._site} ended before a record arrived")
            self._clock.sleep_until(self._clock.monotonic_ns() + 1_000_000)
        return record

    def _send(self, action: str, numbers: Sequence[float]) -> int:
        """Sends a target or force to the site, and returns the number of the message.

        Args:
            action: Name of the method that the program called: "move", "turn" or "push".
            numbers: Coordinates of the target or the force.

        Raises:
            UsageError: The scenario's operator is of another kind, or a coordinate is not
                finite.
        """
        permitted_action = _ACTIONS[self._operator.kind]
        if action != permitted_action:
            raise UsageError(
                f"the hand of {self._site} can {permitted_action}, not {action}: "
                "see the mode of the hand in the scenario"
            )
        coordinates = [float(number) for number in numbers]
        if not all(map(math.isfinite, coordinates)):
            raise UsageError(f"the coordinates of {action} must be finite, not {coordinates}")
        field = "force" if permitted_action == "push" else "target"
        with self._lock:
            self._message = self._sender.move(self._source, **{field: coordinates})
            return self._sender.number

    def _repeat_messages(self) -> None:
        """Repeats the last message while the program holds the arm, in a separate thread.

        Otherwise, the site would assume that a program that sends no new target has died, and
        would release the arm. The thread ends when the object is closed.
        """
        while not self._ended.wait(_HEARTBEAT_S):
            with self._lock:
                if self._message is not None:
                    self._sender.repeat(self._message)
