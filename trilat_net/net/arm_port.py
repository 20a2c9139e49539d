"""Connections of programs beside a site: of an external arm (`plant = "external"`) and its dead-man switch.

Invariant: the arm sends its position as often as it likes; the torque to apply stands in the record that the
site publishes at every tick, so the arm receives exactly what the log holds. Without a valid torque,
`torque` returns None and the arm must brake. A record of another start of the site than the first one met is
passed over, and so is one that is older than the newest or too far ahead; what cannot be read is a
stranger's, and changes nothing.

    with ArmPort.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as port:
        while not port.over:
            port.send(*robot.joints())
            tau = port.torque()
            robot.brake() if tau is None else robot.apply(tau)
            robot.wait()
"""

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Self, TypeVar

from ..core.ticks import LifeReason
from ..errors import WireError
from . import topics
from .access_rules import OPERATOR
from .bus import Bus
from .clock import Clock, SystemClock
from .connection import Connection, secure_connection
from .membership import new_boot, read_events
from .messages import State
from .requests import ArmEnable, ArmMeasurement, Request
from .wire import decode, encode, split_states

FRESH_NS = 100_000_000
"""Age at which a record is no longer the present: the site is late, or gone."""
AHEAD_NS = 1_000_000_000
"""A record may be so much later than the one before than the time that has passed since."""
BRAKE_NS = 100_000_000
"""Time of a fault, or since a dead-man switch was let go, after which the brakes are to hold the arm."""


R = TypeVar("R", bound=Request)


class SiteSender:
    """Sends a site numbered messages of one kind, under one of its keys.

    Attributes:
        boot: names this start of the sender.
        number: of the newest message; -1 before the first.
    """

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str, channel: str, boot: int) -> None:
        self.boot, self.number = boot, -1
        self._clock, self._site = clock, site
        self._publish = bus.publisher(topics.key(session, site, channel))

    def send(self, kind: type[R], **fields: object) -> R:
        """Sends the next message, and returns it."""
        about = {"site": self._site, "boot": self.boot, "n": self.number + 1}
        message = kind(**about, sent_ns=self._clock.monotonic_ns(), **fields)  # type: ignore[call-arg,arg-type]
        self.number += 1
        self.repeat(message)
        return message

    def repeat(self, message: R) -> None:
        """Sends a message again."""
        self._publish(encode(message))


class SitePort:
    """The connection of a program to one site; a context, which closes it."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        self._bus, self._clock, self._site = bus, clock, site
        self._record: State | None = None
        self._came_ns = 0
        self._present = self._gone = False
        self._records = bus.stamped(topics.key(session, site, topics.STATE), clock.monotonic_ns, bytes, 64)
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
        """True if the newest record is of now: not before the first tick, after the run, or too old."""
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
        """True if a record is later than the newest one, of the same start, and no later than it can be."""
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
                self._record, self._came_ns = record, message[1]
        for event in read_events(self._events):
            if event.kind == "end" and self._record is not None and event.boot == self._record.boot:
                self._gone = True
        for _, alive in topics.read_presence(self._presence):
            self._present = self._present or alive
            self._gone = self._gone or (self._present and not alive)


class OutsidePort(SitePort):
    """The connection of a program that sends to a site, under one of its keys; a context, which closes it."""

    channel = ""
    """The last part of that key."""
    member = ""
    """Whose keys it takes; "": those of its site."""

    def __init__(self, bus: Bus, clock: Clock, session: str, site: str) -> None:
        super().__init__(bus, clock, session, site)
        self._sender = SiteSender(bus, clock, session, site, self.channel, new_boot())

    @classmethod
    def connected(
        cls, session: str, site: str, connect: Sequence[str], keys: str | Path | None = None
    ) -> Self:
        """Returns a port that reaches a site over Zenoh.

        Args:
            session: the session's name, by default the scenario's.
            site: the site of the arm.
            connect: the site's endpoints, as it prints them when it waits for its arm.
            keys: folder of keys, as of --keys: an arm has those of its site, a switch those of the operator.

        Raises:
            UsageError: an endpoint cannot be used.
        """
        reached = secure_connection(Connection((), list(connect)), keys, insecure=False)
        return cls(reached.require(cls.member or site).open(), SystemClock(), session, site)


class EnablePort(OutsidePort):
    """The dead-man switch of an arm: what its program says for as long as somebody holds it.

    with EnablePort.connected("two_sites", "s", ["tcp/127.0.0.1:10241"]) as switch:
        while not switch.over:
            switch.send(held=button.is_pressed())  # at least every 100 ms
            time.sleep(0.02)
    """

    channel, member = topics.ENABLE, OPERATOR

    def send(self, *, held: bool) -> None:
        """Says that somebody holds it, or has let it go."""
        self._sender.send(ArmEnable, held=held)


class ArmPort(OutsidePort):
    """The connection of an arm to its site; a context, which closes it. `record` is the site's newest one."""

    channel = topics.MEASURED

    def send(self, q: Sequence[float], qd: Sequence[float], tau_x: Sequence[float] = ()) -> None:
        """Sends what was measured of the arm.

        Args:
            q: joint angles, rad.
            qd: joint velocities, rad/s.
            tau_x: torque of operator and environment, N m per joint, where the arm measures it; in the
                paper's sign: the torque ON the arm is its negative.

        Raises:
            ValueError: tau_x is not as long as q, or not finite.
        """
        measured = {"q": q, "qd": qd, "tau_x": tau_x}
        self._sender.send(ArmMeasurement, **{name: [*map(float, v)] for name, v in measured.items()})

    def torque(self) -> tuple[float, ...] | None:
        """Returns the torque to apply now, N m per joint; None if the arm must brake.

        It must before the first tick, after the run, while no record newer than `FRESH_NS` has arrived, and
        `BRAKE_NS` after a fault began, or a dead-man switch was let go: until then its torque brings it to
        rest.
        """
        record, fresh = self.record, self.fresh
        if not fresh or record is None:
            return None
        shared = len(record.q_des)
        released = record.mode == "stopped" and record.mem[2 * shared + 1] == LifeReason.RELEASED
        since_ns = record.mem[shared] if record.mode == "fault" or released else record.t_ns
        return tuple(record.tau) if record.t_ns - since_ns < BRAKE_NS else None
