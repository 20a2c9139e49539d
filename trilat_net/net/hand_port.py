"""A hand of a live session: takes hold of an arm, moves or pushes it, and feels it.

Invariant: a hand that lives is heard, also where it rests: a thread repeats its last message. A hand whose
process is gone, or hangs, is silent, and the site lets go. What acts on the arm, and what this hand feels,
are what the site's records say.
"""

import math
import threading
from collections.abc import Callable, Sequence

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.live_hand import GRIP_NS, SILENCE_NS, HandInForce
from ..errors import UsageError
from . import topics
from .arm_port import SitePort, SiteSender
from .bus import Bus
from .clock import Clock
from .membership import new_boot
from .messages import State
from .requests import HandMessage

HEARTBEAT_S = SILENCE_NS / 4e9
"""Between two messages of a hand that rests."""
_DOES = {TorqueKind.LIVE_TIP: "move", TorqueKind.LIVE_JOINT: "turn", TorqueKind.LIVE_FORCE: "push"}
_STEP = 1e-6
"""Of the derivative of the arm's place, s."""


def make_hand_sender(bus: Bus, clock: Clock, session: str, site: str) -> SiteSender:
    """Returns what sends a site the messages of a hand; its boot is above 0 and exact in a record."""
    return SiteSender(bus, clock, session, site, topics.HAND, new_boot() % (2**32 - 1) + 1)


class Hand(SitePort):
    """Somebody at one arm; a context, which lets go at its end.

    Args:
        bus: connection to the site.
        clock: of this process.
        session: the session's name.
        site: the site of the arm.
        operator: the live hand of the scenario, as the core has it.
        place: returns where the arm is by its joint angles, in the coordinates of the target.
        source: who this is, for people.
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
    ) -> None:
        super().__init__(bus, clock, session, site)
        self._operator, self._place, self._source = operator, place, source
        self._sender = make_hand_sender(bus, clock, session, site)
        self._message: HandMessage | None = None
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._heart = threading.Thread(target=self._beat, daemon=True)
        self._heart.start()

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
        """Takes hold, if it does not, and moves the target of the end effector: x, y, in space z, m.

        Returns the number of the message, as `hand` of the first record that follows it names it.

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
            held, self._message = self._message, None
            if held is not None:
                self._sender.send(HandMessage, source=self._source, grip=False)

    @property
    def holds(self) -> bool:
        """True if the newest record says that this hand holds the arm."""
        hand = self.in_force
        return hand is not None and hand.source == self._sender.boot

    @property
    def number(self) -> int:
        """Number of its newest message that the newest record follows; -1: it does not hold the arm."""
        hand = self.in_force
        return -1 if hand is None or hand.source != self._sender.boot else hand.number

    @property
    def in_force(self) -> HandInForce | None:
        """What whoever holds the arm does, by the newest record; None before the first."""
        record = self.record
        return None if record is None or not record.hand else HandInForce.read(record.hand)

    @property
    def pose(self) -> tuple[float, ...]:
        """Where the arm is, by the newest record: its end effector, m, or for `turn` its joints, rad."""
        record = self._need_record()
        return tuple(map(float, self._place(record.q)))

    @property
    def force(self) -> tuple[float, ...]:
        """The force of whoever holds the arm ON it, by the newest record, N; for `turn` torques, N m.

        What the operator feels is the negative.
        """
        record, operator = self._need_record(), self._operator
        hand = HandInForce.read(record.hand)
        pull = list(hand.target)
        if operator.acts is not TorqueKind.LIVE_FORCE:
            at, speed = self._place(record.q), self._find_speed(record)
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
        does = _DOES[self._operator.acts]
        if what != does:
            raise UsageError(f"the hand of {self._site} can {does}, not {what}: see its mode in the scenario")
        goal = [float(one) for one in numbers]
        if not all(map(math.isfinite, goal)):
            raise UsageError(f"a hand can {does} to finite numbers, not to {goal}")
        with self._lock:
            goals = {"force" if does == "push" else "target": goal}
            self._message = self._sender.send(HandMessage, source=self._source, **goals)
            return self._sender.number

    def _beat(self) -> None:
        """Repeats the newest message, so that a hand at rest is heard."""
        while not self._ended.wait(HEARTBEAT_S):
            with self._lock:
                if self._message is not None:
                    self._sender.repeat(self._message)
