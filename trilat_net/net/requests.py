"""Messages between two parties: pings, changes, backfill, external arms, switches and hands.

Invariant:
    - No log contains these messages, but logs contain their effects: a change as an event, a
      backfilled message as the message itself, a measurement as q and qd of the record of the
      tick that used it, and a hand as `hand` of the records of the ticks in which it acts.
    - At each tick, a site uses the newest measurement of the arm and the newest goal of the
      hand.
"""

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from ..errors import count_nouns
from .messages import U64, VERSION, Angles, Instant, Speeds, TickNumber, Torques

BACKFILL_MESSAGES = 64
"""Largest number of messages in one `Backfill`."""
BACKFILL_BYTES = 40_000
"""Largest total size of the messages in one `Backfill`, unless a single message is larger."""


class Request(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the messages between two parties, in the present version of the schema."""

    v: int = VERSION


class Pong(Request, frozen=True, kw_only=True):
    """A member's reply to a ping.

    Attributes:
        member: name of the member.
        boot: boot of the member.
        clock: identity of the member's clock.
        came_ns: arrival of the ping on that clock.
        left_ns: sending of the reply on that clock.
    """

    member: str
    boot: U64
    clock: str
    came_ns: Instant
    left_ns: Instant


OrderName = Literal["", "stop", "enable", "reset"]
"""Orders that a site accepts from outside; "" stands for no order."""


class ChangeRequest(Request, frozen=True, kw_only=True):
    """A request to a site for a change, as in a scenario's timeline, from the next tick on.

    A request sets exactly one of `link`, `dominance`, `stop_s`, `mark` and `order`.

    Attributes:
        link: link whose settings change, as in "m1->s".
        dominance: site whose row of dominance shares changes.
        to: the new settings of the link, or the new shares.
        ramp_s: duration of the transition to new shares, in s.
        stop_s: time since the epoch, in s, before which the site's last tick lies.
        mark: a text for the log.
        order: an order, which the site executes in its next tick.
        source: who requests the change, for people: a noun phrase such as "the experimenter",
            which the site's event repeats. A request without a source has the same bytes as
            one of a program that does not know the field.
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

    The number of a record is its tick. Statistics and events are numbered from 0.

    Attributes:
        channel: channel of the messages.
        first, last: range of the numbers of the messages.
    """

    channel: Literal["state", "link", "event"]
    first: TickNumber
    last: TickNumber


class Backfill(Request, frozen=True, kw_only=True):
    """Reply to a `BackfillRequest`: consecutive messages, as the site published them.

    Attributes:
        member: name of the site.
        boot: boot of the site.
        channel: channel of the messages.
        first: number of the first message in this reply: the requested number, or that of the
            oldest message that the site still has.
        payloads: the messages, at most BACKFILL_MESSAGES; empty if the site has not published
            them yet, or has them no longer.
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
        site: name of the arm's site.
        boot: random number of the start of the arm's program; a site follows one start.
        n: number of the measurement since that start, from 0.
        q: joint angles, rad.
        qd: joint velocities, rad/s.
        sent_ns: sending time on the program's monotonic clock, or time of the measurement on
            the arm's clock, in ns. The time is compared with no other clock.
        tau_x: torque of operator and environment in N m, with the sign of a record: the torque
            ON the arm is the negative. Empty if the arm does not measure the torque.
    """

    site: str
    boot: U64
    n: TickNumber
    q: Angles
    qd: Speeds
    sent_ns: int
    tau_x: Torques = []

    def __post_init__(self) -> None:
        if not self.tau_x:
            return
        if len(self.tau_x) != len(self.q) or not all(map(math.isfinite, self.tau_x)):
            raise ValueError(
                f"tau_x must be {count_nouns(len(self.q), 'finite number')}, as q is"
            )


class ArmEnable(Request, frozen=True, kw_only=True):
    """Report of a dead-man switch of an external arm, sent at least ten times a second.

    Attributes:
        site: name of the arm's site.
        boot: random number of the start of the switch's program.
        n: number of the message since that start, from 0.
        held: True while somebody holds the switch. False releases the switch at once, without
            waiting for its silence.
        sent_ns: sending time on the program's monotonic clock, in ns.
    """

    site: str
    boot: U64
    n: TickNumber
    held: bool = True
    sent_ns: Instant


class HandMessage(Request, frozen=True, kw_only=True):
    """Goal of a hand at an arm, sent when it changes and repeated within `SILENCE_NS`.

    Attributes:
        site: name of the arm's site.
        boot: random number of the hand, above 0; one hand at a time holds an arm.
        source: name of the person or program, for people.
        n: number of the goal, from 0; a repeated number states that nothing has changed.
        grip: False to release the arm.
        target: target position of the end effector in m, or of the joints in rad; empty for a
            hand that pushes.
        force: force ON the end effector in N; empty for all other hands.
        sent_ns: sending time on the program's monotonic clock, in ns.
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
    """A peer as a hand sees it, in a `HandViewMessage`; the fields are those of `PeerView`."""

    alpha: float
    tick: int
    age_s: float
    new: int
    q: list[float]
    qd: list[float]
    tau_x: list[float]


class HandViewMessage(Request, frozen=True, kw_only=True):
    """State of a site at a tick, for a user's hand that runs in a separate process.

    The fields other than `site` and `boot` are those of `HandView`.

    Attributes:
        site: name of the site whose arm the hand holds.
        boot: boot of the site.
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
