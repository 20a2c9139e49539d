"""Clients of a site: for programs of an external arm, of its dead-man switch, and of a hand.

An external arm (`plant = "external"` in the scenario) sends its position as often as it likes.
The torque to apply is in the record that the site publishes at every tick, so the arm receives
exactly what the log holds.

    with ArmClient.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as client:
        while not client.over:
            client.send(*robot.joints())
            tau = client.torque()
            robot.brake() if tau is None else robot.apply(tau)
            robot.wait()

Invariant:
    - Without a valid torque, `torque` returns None and the arm must brake.
    - Records of another boot of the site are ignored: a client follows the boot that it saw
      first. Records older than the newest one, or too far ahead of it, are ignored, too.
    - Payloads that cannot be decoded come from strangers, and change nothing.
    - A live hand sends messages also at rest: a thread repeats its last message. If the hand's
      process hangs or ends, the messages stop, and the site releases the arm.
    - The state of the arm and the force that a hand feels are those of the site's records.
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
"""Age, in ns, from which on a record is out of date: the site is late, or gone."""
AHEAD_NS = 1_000_000_000
"""Largest time, in ns, by which nominal time may run ahead of the clock between two records."""
BRAKE_NS = 100_000_000
"""Time after a fault, or after the release of the dead-man switch, until the brakes must hold.

The unit is ns.
"""
HEARTBEAT_S = SILENCE_NS / 4e9
"""Time between two messages of a hand at rest, in s."""
_MOTIONS = {
    TorqueKind.LIVE_TIP: "move",
    TorqueKind.LIVE_JOINT: "turn",
    TorqueKind.LIVE_FORCE: "push",
}
"""The method of `Hand` that serves each kind of live hand."""
_STEP_S = 1e-6
"""Step of the numerical derivative of the arm's position, in s."""


R = TypeVar("R", bound=Request)


class SiteSender:
    """Sender of numbered messages to a site, under one of the site's keys.

    Args:
        bus: connection of the sending program.
        clock: clock of the sending program.
        session: name of the session.
        site: name of the site.
        channel: last part of the key.
        boot: random number of the sending program's start.

    Attributes:
        boot: random number of the sending program's start.
        number: number of the newest message; -1 before the first.
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
        """Sends a message with the next number, and returns the message."""
        common_fields = {
            "site": self._site,
            "boot": self.boot,
            "n": self.number + 1,
            "sent_ns": self._clock.monotonic_ns(),
        }
        message = kind(**(common_fields | fields))  # type: ignore[arg-type]
        self.number += 1
        self.repeat(message)
        return message

    def repeat(self, message: R) -> None:
        """Sends a message again."""
        self._publish(encode(message))


class SiteClient:
    """Connection of a program to one site; a context manager, which closes the connection."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        self._bus = bus
        self._clock = clock
        self._site = site
        self._record: State | None = None
        self._record_arrival_ns = 0
        self._was_present = False
        self._is_gone = False
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
        """True if the newest record is up to date.

        False before the first tick, after the run, and if the record is older than FRESH_NS.
        """
        record = self.record
        if record is None or self._is_gone or record.mode == "diverged":
            return False
        return self._clock.monotonic_ns() - self._record_arrival_ns <= FRESH_NS

    @property
    def over(self) -> bool:
        """True once the site's run has ended, or the site is gone."""
        self._read_messages()
        return self._is_gone

    def _follows_last(self, record: State, arrived_ns: int) -> bool:
        """True if a record is a plausible successor of the newest record."""
        last = self._record
        if last is None:
            return True
        if record.boot != last.boot or record.tick <= last.tick or record.t_ns <= last.t_ns:
            return False
        passed_ns = arrived_ns - self._record_arrival_ns
        return record.t_ns - last.t_ns <= passed_ns + AHEAD_NS

    def _read_messages(self) -> None:
        while (message := self._records.poll()) is not None:
            block, arrived_ns = message
            try:
                # Of a block of records only the last one is of interest.
                (payload,) = deque(split_states(block), maxlen=1)
                record = decode(payload, State)
            except WireError:
                continue  # a payload of a stranger
            if self._follows_last(record, arrived_ns):
                self._record = record
                self._record_arrival_ns = arrived_ns
        for event in read_messages(self._events, Event):
            is_followed = self._record is not None and event.boot == self._record.boot
            if event.kind == "end" and is_followed:
                self._is_gone = True
        for _, is_alive in topics.read_presence(self._presence):
            self._was_present = self._was_present or is_alive
            self._is_gone = self._is_gone or (self._was_present and not is_alive)


class OutsideClient(SiteClient):
    """Connection of a program that sends messages to a site; a context manager."""

    channel = ""
    """Last part of the key under which the program sends."""
    member = ""
    """Member whose certificate keys the program uses; "" for those of its site."""

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
        """Returns a client that reaches a site over Zenoh.

        Args:
            session: name of the session, by default the scenario's name.
            site: name of the arm's site.
            connect: endpoints of the site, as the site prints them while it waits for its arm.
            keys: folder of certificate keys, as in --keys: an arm uses the keys of its site, a
                switch those of the operator.

        Raises:
            UsageError: an endpoint cannot be used.
        """
        connection = secure_connection(Connection((), list(connect)), keys, insecure=False)
        bus = connection.require(cls.member or site).open()
        return cls(bus, SystemClock(), session, site)


class SwitchClient(OutsideClient):
    """Dead-man switch of an arm: its program reports whether somebody holds the switch.

    >>> endpoints = ["tcp/127.0.0.1:10241"]
    >>> with tn.SwitchClient.connected("two_sites", "s", endpoints) as switch:  # doctest: +SKIP
    ...     while not switch.over:
    ...         switch.send(held=button.is_pressed())  # at least every 100 ms
    ...         time.sleep(0.02)
    """

    channel = topics.ENABLE
    member = OPERATOR

    def send(self, *, held: bool) -> None:
        """Reports whether somebody holds the switch."""
        self._sender.send(ArmEnable, held=held)


class ArmClient(OutsideClient):
    """Connection of an arm to its site; a context manager, which closes the connection.

    >>> endpoints = ["tcp/127.0.0.1:10241"]
    >>> with tn.ArmClient.connected("two_sites", "s", endpoints) as client:  # doctest: +SKIP
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
            tau_x: torque of operator and environment, N m per joint, if the arm measures it.
                The sign is that of the paper: the torque ON the arm is the negative.
            stamp_ns: time of the measurement, in ns on the arm's own clock; None for the
                present, on this program's monotonic clock.

        Raises:
            ValueError: tau_x has another length than q, or is not finite.
        """
        fields: dict[str, object] = {
            "q": [*map(float, q)],
            "qd": [*map(float, qd)],
            "tau_x": [*map(float, tau_x)],
        }
        if stamp_ns is not None:
            fields["sent_ns"] = stamp_ns
        self._sender.send(ArmMeasurement, **fields)

    def torque(self) -> tuple[float, ...] | None:
        """Returns the torque to apply now, N m per joint; None if the arm must brake.

        The arm must brake before the first tick, after the run, while the newest record is
        older than `FRESH_NS`, and from `BRAKE_NS` after a fault or the release of the dead-man
        switch on. Until then, the torque brings the arm to rest.
        """
        record = self.record
        if record is None or not self.fresh:
            return None
        shared = len(record.q_des)
        # The memory of a site at rest holds the start of the rest and its reason.
        reason = record.mem[2 * shared + 1 : 2 * shared + 2]
        is_released = record.mode == "stopped" and reason == [LifeReason.RELEASED]
        if record.mode == "fault" or is_released:
            rest_since_ns = record.mem[shared : shared + 1]
            if not rest_since_ns or record.t_ns - rest_since_ns[0] >= BRAKE_NS:
                return None
        return tuple(record.tau)


def make_hand_sender(bus: Bus, clock: Clock, session: str, site: str) -> SiteSender:
    """Returns a sender of a hand's messages to a site.

    The sender's boot is at least 1, because 0 stands for nobody, and below 2^32, so that a
    record, which holds floating-point numbers, can hold the boot exactly.
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
    """A hand at the arm of one site; a context manager, which releases the arm on exit.

    Args:
        bus: connection of the program.
        clock: clock of the program.
        session: name of the session.
        site: name of the site.
        operator: the live hand of the scenario, as the core represents it.
        place: returns the position of the arm for joint angles (rad), in the coordinates of
            the target.
        source: name of the person or program, for people.
        repeats: True if a thread repeats the last message. Without the thread, a program that
            hangs releases the arm.
    """

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        session: str,
        site: str,
        operator: TorqueSource,
        place: Callable[[Sequence[float]], Sequence[float]],
        source: str = "",
        *,
        repeats: bool = True,
    ) -> None:
        super().__init__(bus, clock, session, site)
        self._operator = operator
        self._compute_position = place
        self._source = source
        self._sender = make_hand_sender(bus, clock, session, site)
        self._message: HandMessage | None = None
        self._lock = threading.Lock()
        self._ended = threading.Event()
        if repeats:
            threading.Thread(target=self._repeat_message, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        """Releases the arm, and waits until a record of the site says so.

        The connection stays open, because it belongs to the caller.
        """
        try:
            self.release()
            deadline_ns = self._clock.monotonic_ns() + 2 * GRIP_NS
            while self.holds and not self.over and self._clock.monotonic_ns() < deadline_ns:
                self._clock.sleep_until(self._clock.monotonic_ns() + 2_000_000)
        finally:
            self._ended.set()

    def move(self, *place_m: float) -> int:
        """Grips the arm if necessary, and moves the target of the end effector.

        Args:
            *place_m: coordinates x, y, and in space z, of the target, in m.

        Returns:
            The number of the message, which `State.hand` contains from the first record on
            that follows the message.

        Raises:
            UsageError: the hand of this site does not move a target, or a number is not finite.
        """
        return self._send("move", place_m)

    def turn(self, *angles_rad: float) -> int:
        """Like `move`, for a hand at the joints: sets a target angle for each joint, in rad."""
        return self._send("turn", angles_rad)

    def push(self, *force_n: float) -> int:
        """Like `move`, for a hand that pushes: sets the force ON the end effector, in N."""
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
        """Number of this hand's newest message that the newest record follows.

        The number is -1 if this hand does not hold the arm.
        """
        hand = self.in_force
        return -1 if hand is None or hand.source != self._sender.boot else hand.number

    @property
    def in_force(self) -> HandInForce | None:
        """State of the hand that holds the arm, by the newest record; None before the first."""
        record = self.record
        if record is None or not record.hand:
            return None
        return HandInForce.read(record.hand)

    @property
    def pose(self) -> tuple[float, ...]:
        """Position of the arm by the newest record.

        Coordinates of the end effector in m, or joint angles in rad for a hand that turns.
        """
        record = self._need_record()
        return tuple(map(float, self._compute_position(record.q)))

    @property
    def force(self) -> tuple[float, ...]:
        """Force ON the arm of the hand that holds the arm, by the newest record.

        The unit is N, or N m for a hand that turns. With the target x_t of the hand and its
        velocity v_t, and the position x and velocity v of the arm, a hand that moves or turns
        pulls by K (x_t - x) + B (v_t - v), limited in size, times the grip. The operator feels
        the negative of this force.
        """
        record = self._need_record()
        operator = self._operator
        hand = HandInForce.read(record.hand)
        pull = list(hand.target)
        if operator.kind is not TorqueKind.LIVE_FORCE:
            position = self._compute_position(record.q)
            velocity = self._compute_velocity(record)
            pull = [
                K * (x_target - x) + B * (v_target - v)
                for K, B, x_target, v_target, x, v in zip(
                    operator.K,
                    operator.B,
                    hand.target,
                    hand.rate,
                    position,
                    velocity,
                    strict=True,
                )
            ]
        size = math.hypot(*pull)
        share = hand.grip * (operator.limit / size if size > operator.limit else 1.0)
        return tuple(share * component for component in pull)

    def _compute_velocity(self, record: State) -> list[float]:
        """Returns the velocity of the arm's position, by central differences."""
        q_ahead = [q + _STEP_S * qd for q, qd in zip(record.q, record.qd, strict=True)]
        q_behind = [q - _STEP_S * qd for q, qd in zip(record.q, record.qd, strict=True)]
        ahead = self._compute_position(q_ahead)
        behind = self._compute_position(q_behind)
        return [(a - b) / (2.0 * _STEP_S) for a, b in zip(ahead, behind, strict=True)]

    def _need_record(self) -> State:
        """Returns the newest record, and waits for the first one.

        Raises:
            UsageError: the run has ended without a record.
        """
        while (record := self.record) is None:
            if self.over:
                raise UsageError(f"the run of {self._site} has ended: there is no record")
            self._clock.sleep_until(self._clock.monotonic_ns() + 1_000_000)
        return record

    def _send(self, motion: str, numbers: Sequence[float]) -> int:
        possible_motion = _MOTIONS[self._operator.kind]
        if motion != possible_motion:
            raise UsageError(
                f"the hand of {self._site} can {possible_motion}, not {motion}: "
                "see its mode in the scenario"
            )
        goal = [float(number) for number in numbers]
        if not all(map(math.isfinite, goal)):
            raise UsageError(f"a hand can {motion} to finite numbers, not to {goal}")
        field = "force" if motion == "push" else "target"
        with self._lock:
            self._message = self._sender.send(HandMessage, source=self._source, **{field: goal})
            return self._sender.number

    def _repeat_message(self) -> None:
        while not self._ended.wait(HEARTBEAT_S):
            with self._lock:
                if self._message is not None:
                    self._sender.repeat(self._message)
