"""Messages between two parties: pings, changes, backfill, external arms and their switches,
hands.

Invariant: none of these is logged. Their effects are: a change as an event, a backfilled
message as itself, a measurement as q and qd of the record of the tick that used it, a hand as
`hand` of the records of the ticks in which it acts. A site uses the newest measurement at each
tick, and the newest goal of a hand.
"""

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from ..errors import count_nouns
from .messages import U64, VERSION, Angles, Instant, Speeds, TickNumber, Torques

BACKFILL_MESSAGES = 64
BACKFILL_BYTES = 40_000
"""Most messages in one `Backfill`, and most bytes of them, unless a single message has more."""


class Request(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A message between two parties, of this version of the schema."""

    v: int = VERSION


class Pong(Request, frozen=True, kw_only=True):
    """A member's answer to a ping: when that came and the answer left, on a clock of this
    identity.
    """

    member: str
    boot: U64
    clock: str
    came_ns: Instant
    left_ns: Instant


OrderName = Literal["", "stop", "enable", "reset"]
"""What a site may be ordered from outside; "" is no order."""


class ChangeRequest(Request, frozen=True, kw_only=True):
    """A change requested from a site, as in a scenario's timeline, from the earliest possible
    tick on.

    It names a link, as in "m1->s", or the site whose dominance row changes during `ramp_s`; or
    `stop_s`, the time since the epoch, s, before which the site's last tick lies; or `mark`, a
    text for the log; or an `order`, which the site carries out in its next tick.

    Attributes:
        source: who asks for it, for people: a noun phrase such as "the experimenter", which the
            site's event repeats. A request without it has the bytes of a program that knows no
            such field.
    """

    link: str = ""
    dominance: str = ""
    to: dict[str, Any] = {}
    ramp_s: float = 0.0
    stop_s: Annotated[float, Meta(ge=0.0, le=1e6)] | None = None
    mark: Annotated[str, Meta(max_length=80)] = ""
    order: OrderName = ""
    source: Annotated[str, Meta(max_length=64)] | UnsetType = UNSET


class ChangeReply(Request, frozen=True, kw_only=True):
    """A site's reply to a `ChangeRequest`.

    Attributes:
        text: the tick from which the change holds, or the reason for refusing it.
        tick: first tick, at the site's rate, for which the change holds; -1 if refused.
    """

    member: str
    accepted: bool
    text: str
    tick: int = -1


class BackfillRequest(Request, frozen=True, kw_only=True):
    """A recorder's request for missing messages of a site.

    A message's number is its tick for a record, its place from 0 for statistics and events.
    """

    channel: Literal["state", "link", "event"]
    first: TickNumber
    last: TickNumber


class Backfill(Request, frozen=True, kw_only=True):
    """The requested messages that a site still has: consecutive, as they were published.

    Attributes:
        first: number of the first message here: the one requested, or the oldest one kept.
        payloads: the messages, a bounded number; empty if there are none (yet, or any more).
        made: number of messages of this channel that the site has published.
    """

    member: str
    boot: U64
    channel: Literal["state", "link", "event"]
    first: TickNumber
    payloads: list[bytes]
    made: TickNumber


class ArmMeasurement(Request, frozen=True, kw_only=True):
    """One measurement of an external arm.

    Attributes:
        boot: the start of the arm's program, random: a site listens to one of them.
        n: number of the measurement of that start, from 0.
        tau_x: torque of operator and environment, as a record has it: the torque ON the arm is
            its negative; empty where it is not measured.
        sent_ns: time of sending, ns of the program's own monotonic clock, or of measuring, on a
            clock of the arm's; it is compared with no other clock.
    """

    site: str
    boot: U64
    n: TickNumber
    q: Angles
    qd: Speeds
    sent_ns: int
    tau_x: Torques = []

    def __post_init__(self) -> None:
        if self.tau_x and not (
            len(self.tau_x) == len(self.q) and all(map(math.isfinite, self.tau_x))
        ):
            raise ValueError(
                f"tau_x must be {count_nouns(len(self.q), 'finite number')}, as q is"
            )


class ArmEnable(Request, frozen=True, kw_only=True):
    """Says that somebody holds the dead-man switch of an external arm, at least ten times a
    second.

    Attributes:
        boot: the start of the program, random: a switch is held by one of them.
        n: number of the message of that start, from 0.
        held: false: it was let go, and nobody waits for the silence.
        sent_ns: time of sending, ns of the program's own monotonic clock.
    """

    site: str
    boot: U64
    n: TickNumber
    held: bool = True
    sent_ns: Instant


class HandMessage(Request, frozen=True, kw_only=True):
    """What somebody who holds an arm wants: sent when it changes, and again before `SILENCE_NS`
    is over.

    Attributes:
        boot: the hand, random and above 0: an arm is held by one of them.
        source: who it is, for people.
        n: number of its goal, from 0; the same again says that nothing has changed.
        grip: false: it lets go.
        target: where the end effector is to go, m, or the joints, rad; empty for a hand that
            pushes.
        force: the force ON the end effector, N; empty for any other hand.
        sent_ns: time of sending, ns of the program's own monotonic clock.
    """

    site: str
    boot: Annotated[int, Meta(ge=1, lt=2**32)]
    source: Annotated[str, Meta(max_length=64)] = ""
    n: TickNumber
    grip: bool = True
    target: list[float] = []
    force: list[float] = []
    sent_ns: Instant


class PeerSeen(Request, frozen=True, kw_only=True):
    """A peer in a `HandViewMessage`, as `PeerView`."""

    alpha: float
    tick: int
    age_s: float
    new: int
    q: list[float]
    qd: list[float]
    tau_x: list[float]


class HandViewMessage(Request, frozen=True, kw_only=True):
    """What a hand of one's own in a process of its own sees at a tick, as `HandView`, and
    decides by.

    Attributes:
        site: the site whose arm it holds.
        boot: of the site.
    """

    site: str
    boot: U64
    k: TickNumber
    t_s: float
    q: list[float]
    qd: list[float]
    pose: list[float]
    q_des: list[float]
    tau_x: list[float]
    target: list[float]
    grip: float
    peers: list[PeerSeen]
