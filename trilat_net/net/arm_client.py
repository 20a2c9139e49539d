"""Clients of a site: programs of an external arm (`plant = "external"`), of its dead-man
switch, of a hand.

Invariant: the arm sends its position as often as it likes; the torque to apply stands in the
record that the site publishes at every tick, so the arm receives exactly what the log holds.
Without a valid torque, `torque` returns None and the arm must brake. A record of another start
of the site than the first one met is passed over, and so is one that is older than the newest
or too far ahead; what cannot be read is a stranger's, and changes nothing. A hand that lives is
heard, also where it rests: a thread repeats its last message. One whose process is gone, or
hangs, is silent, and the site lets go. What acts on the arm, and what a hand feels, are what
the site's records say.

    with ArmClient.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as client:
        while not client.over:
            client.send(*robot.joints())
            tau = client.torque()
            robot.brake() if tau is None else robot.apply(tau)
            robot.wait()
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
"""Age at which a record is no longer the present: the site is late, or gone."""
AHEAD_NS = 1_000_000_000
"""A record may be so much later than the one before than the time that has passed since."""
BRAKE_NS = 100_000_000
"""Time of a fault, or since a dead-man switch was let go, after which the brakes are to hold
the arm.
"""
HEARTBEAT_S = SILENCE_NS / 4e9
"""Between two messages of a hand that rests."""
_DOES = {
    TorqueKind.LIVE_TIP: "move",
    TorqueKind.LIVE_JOINT: "turn",
    TorqueKind.LIVE_FORCE: "push",
}
_STEP = 1e-6
"""Of the derivative of the arm's place, s."""


R = TypeVar("R", bound=Request)


class SiteSender:
    """Sends a site numbered messages of one kind, under one of its keys.

    Attributes:
        number: of the newest message; -1 before the first.
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
        """Sends the next message, and returns it."""
        about = {"site": self._site, "boot": self.boot, "n": self.number + 1}
        now = {"sent_ns": self._clock.monotonic_ns()}
        message = kind(**(about | now | fields))  # type: ignore[arg-type]
        self.number += 1
        self.repeat(message)
        return message

    def repeat(self, message: R) -> None:
        """Sends a message again."""
        self._publish(encode(message))


class SiteClient:
    """The connection of a program to one site; a context, which closes it."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        self._bus = bus
        self._clock = clock
        self._site = site
        self._record: State | None = None
        self._came_ns = 0
        self._present = self._gone = False
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
        """The newest record of the site; None before the first."""
        self._read_messages()
        return self._record

    @property
    def fresh(self) -> bool:
        """True if the newest record is of now: not before the first tick, after the run, or too
        old.
        """
        record = self.record
        if record is None or self._gone or record.mode == "diverged":
            return False
        return self._clock.monotonic_ns() - self._came_ns <= FRESH_NS

    @property
    def over(self) -> bool:
        """True once the site's run has ended, or the site is gone."""
        self._read_messages()
        return self._gone

    def _follows_last(self, record: State, came_ns: int) -> bool:
        last = self._record
        if last is None:
            return True
        newer = record.boot == last.boot and record.tick > last.tick and record.t_ns > last.t_ns
        return newer and record.t_ns - last.t_ns <= came_ns - self._came_ns + AHEAD_NS

    def _read_messages(self) -> None:
        while (message := self._records.poll()) is not None:
            try:
                (payload,) = deque(split_states(message[0]), maxlen=1)
                record = decode(payload, State)
            except WireError:
                continue  # a stranger's
            if self._follows_last(record, message[1]):
                self._record = record
                self._came_ns = message[1]
        for event in read_messages(self._events, Event):
            if (
                event.kind == "end"
                and self._record is not None
                and event.boot == self._record.boot
            ):
                self._gone = True
        for _, alive in topics.read_presence(self._presence):
            self._present = self._present or alive
            self._gone = self._gone or (self._present and not alive)


class OutsideClient(SiteClient):
    """The connection of a program that sends to a site, under one of its keys; a context, which
    closes it.
    """

    channel = ""
    """The last part of that key."""
    member = ""
    """Whose keys it takes; "": those of its site."""

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
            session: the session's name, by default the scenario's.
            site: the site of the arm.
            connect: the site's endpoints, as it prints them when it waits for its arm.
            keys: folder of keys, as of --keys: an arm has those of its site, a switch those of
                the operator.

        Raises:
            UsageError: an endpoint cannot be used.
        """
        reached = secure_connection(Connection((), list(connect)), keys, insecure=False)
        return cls(reached.require(cls.member or site).open(), SystemClock(), session, site)


class SwitchClient(OutsideClient):
    """The dead-man switch of an arm: what its program says for as long as somebody holds it.

    >>> with tn.SwitchClient.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as switch:  #
    doctest: +SKIP ...     while not switch.over: ...
    switch.send(held=button.is_pressed())  # at least every 100 ms ...         time.sleep(0.02)
    """

    channel = topics.ENABLE
    member = OPERATOR

    def send(self, *, held: bool) -> None:
        """Says that somebody holds it, or has let it go."""
        self._sender.send(ArmEnable, held=held)


class ArmClient(OutsideClient):
    """The connection of an arm to its site; a context, which closes it. `record` is the site's
    newest one.

    >>> with tn.ArmClient.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as client:  #
    doctest: +SKIP ...     client.send(robot.q, robot.qd) ...     tau = client.torque()
    """

    channel = topics.MEASURED

    def send(
        self,
        q: Sequence[float],
        qd: Sequence[float],
        tau_x: Sequence[float] = (),
        stamp_ns: int | None = None,
    ) -> None:
        """Sends what was measured of the arm.

        Args:
            q: joint angles, rad.
            qd: joint velocities, rad/s.
            tau_x: torque of operator and environment, N m per joint, where the arm measures it;
                in the paper's sign: the torque ON the arm is its negative.
            stamp_ns: when, ns on a clock of the arm's own; None: now, on this program's
                monotonic clock.

        Raises:
            ValueError: tau_x is not as long as q, or not finite.
        """
        measured = {"q": q, "qd": qd, "tau_x": tau_x}
        stamp = {} if stamp_ns is None else {"sent_ns": stamp_ns}
        self._sender.send(
            ArmMeasurement, **{name: [*map(float, v)] for name, v in measured.items()}, **stamp
        )

    def torque(self) -> tuple[float, ...] | None:
        """Returns the torque to apply now, N m per joint; None if the arm must brake.

        It must before the first tick, after the run, while no record newer than `FRESH_NS` has
        arrived, and `BRAKE_NS` after a fault began, or a dead-man switch was let go: until then
        its torque brings it to rest.
        """
        if (record := self.record) is None or not self.fresh:
            return None
        shared = len(record.q_des)
        reason = record.mem[2 * shared + 1 : 2 * shared + 2]
        released = record.mode == "stopped" and reason == [LifeReason.RELEASED]
        since_ns = (
            record.mem[shared : shared + 1]
            if record.mode == "fault" or released
            else [record.t_ns]
        )
        return tuple(record.tau) if since_ns and record.t_ns - since_ns[0] < BRAKE_NS else None


def make_hand_sender(bus: Bus, clock: Clock, session: str, site: str) -> SiteSender:
    """Returns what sends a site the messages of a hand; its boot is above 0 and exact in a
    record.
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
    """Somebody at one arm; a context, which lets go at its end.

    Args:
        operator: the live hand of the scenario, as the core has it.
        place: returns where the arm is by its joint angles, in the coordinates of the target.
        source: who this is, for people.
        repeats: whether a thread repeats its last message; without it, a program that hangs
            lets go.
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
        self._place = place
        self._source = source
        self._sender = make_hand_sender(bus, clock, session, site)
        self._message: HandMessage | None = None
        self._lock = threading.Lock()
        self._ended = threading.Event()
        if repeats:
            threading.Thread(target=self._beat, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        """Lets go, and waits until the site has heard it; the connection is its owner's."""
        try:
            self.release()
            give_up_ns = self._clock.monotonic_ns() + 2 * GRIP_NS
            while self.holds and not self.over and self._clock.monotonic_ns() < give_up_ns:
                self._clock.sleep_until(self._clock.monotonic_ns() + 2_000_000)
        finally:
            self._ended.set()

    def move(self, *place_m: float) -> int:
        """Takes hold, if it does not, and moves the target of the end effector: x, y, in space
        z, m.

        Returns the number of the message, as `hand` of the first record that follows it names
        it.

        Raises:
            UsageError: the hand of this site does not do that, or a number is not finite.
        """
        return self._send("move", place_m)

    def turn(self, *angles_rad: float) -> int:
        """Does as `move` for a hand at the joints: a target angle for each, rad."""
        return self._send("turn", angles_rad)

    def push(self, *force_n: float) -> int:
        """Does as `move` for a hand that pushes: the force ON the end effector, N."""
        return self._send("push", force_n)

    def release(self) -> None:
        """Lets go; the grip fades within 100 ms."""
        with self._lock:
            held = self._message
            self._message = None
            if held is not None:
                self._sender.send(HandMessage, source=self._source, grip=False)

    @property
    def holds(self) -> bool:
        """True if the newest record says that this hand holds the arm."""
        hand = self.in_force
        return hand is not None and hand.source == self._sender.boot

    @property
    def number(self) -> int:
        """Number of its newest message that the newest record follows; -1: it does not hold the
        arm.
        """
        hand = self.in_force
        return -1 if hand is None or hand.source != self._sender.boot else hand.number

    @property
    def in_force(self) -> HandInForce | None:
        """What whoever holds the arm does, by the newest record; None before the first."""
        record = self.record
        return None if record is None or not record.hand else HandInForce.read(record.hand)

    @property
    def pose(self) -> tuple[float, ...]:
        """Where the arm is, by the newest record: its end effector, m, or for `turn` its
        joints, rad.
        """
        record = self._need_record()
        return tuple(map(float, self._place(record.q)))

    @property
    def force(self) -> tuple[float, ...]:
        """The force of whoever holds the arm ON it, by the newest record, N; for `turn`
        torques, N m.

        What the operator feels is the negative.
        """
        record = self._need_record()
        operator = self._operator
        hand = HandInForce.read(record.hand)
        pull = list(hand.target)
        if operator.kind is not TorqueKind.LIVE_FORCE:
            at = self._place(record.q)
            speed = self._find_speed(record)
            pull = [
                K * (x - here) + B * (v - moves)
                for K, B, x, v, here, moves in zip(
                    operator.K, operator.B, hand.target, hand.rate, at, speed, strict=True
                )
            ]
        size = math.hypot(*pull)
        share = hand.grip * (operator.limit / size if size > operator.limit else 1.0)
        return tuple(share * one for one in pull)

    def _find_speed(self, record: State) -> list[float]:
        ahead = [q + _STEP * v for q, v in zip(record.q, record.qd, strict=True)]
        behind = [q - _STEP * v for q, v in zip(record.q, record.qd, strict=True)]
        pairs = zip(self._place(ahead), self._place(behind), strict=True)
        return [(a - b) / (2.0 * _STEP) for a, b in pairs]

    def _need_record(self) -> State:
        while (record := self.record) is None:
            if self.over:
                raise UsageError(f"the run of {self._site} is over: there is no record to feel")
            self._clock.sleep_until(self._clock.monotonic_ns() + 1_000_000)
        return record

    def _send(self, what: str, numbers: Sequence[float]) -> int:
        does = _DOES[self._operator.kind]
        if what != does:
            raise UsageError(
                f"the hand of {self._site} can {does}, not {what}: see its mode in the scenario"
            )
        goal = [float(one) for one in numbers]
        if not all(map(math.isfinite, goal)):
            raise UsageError(f"a hand can {does} to finite numbers, not to {goal}")
        with self._lock:
            goals = {"force" if does == "push" else "target": goal}
            self._message = self._sender.send(HandMessage, source=self._source, **goals)
            return self._sender.number

    def _beat(self) -> None:
        while not self._ended.wait(HEARTBEAT_S):
            with self._lock:
                if self._message is not None:
                    self._sender.repeat(self._message)
