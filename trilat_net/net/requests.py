"""Messages between two parties: pings, change requests, backfill, and measurements of an external arm.

Invariant: none of these is logged. Their effects are: a change as an event, a backfilled message as
itself, a measurement as q and qd of the record of the tick that used it. A site uses the newest
measurement at each tick.
"""

from typing import Any, Literal

import msgspec

from ..core.two_link_arm import JOINTS
from .messages import U64, VERSION, Angles, Instant, Speeds, TickNumber

BACKFILL_MESSAGES = 64
BACKFILL_BYTES = 40_000
"""Most messages in one `Past`, and most bytes of them, unless a single message has more."""


class Pong(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a member answers to a ping, at once.

    Attributes:
        v: version of this schema.
        member: a site, or "recorder".
        boot: its process start.
        clock: identity of its monotonic clock.
        came_ns: that clock when the ping had come.
        left_ns: that clock when the answer was given.
    """

    v: int = VERSION
    member: str
    boot: U64
    clock: str
    came_ns: Instant
    left_ns: Instant


class ChangeRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A change that somebody asks a site for, as in a scenario's timeline, from as soon as it can be.

    Attributes:
        v: version of this schema.
        link: the link to change, as in "m1->s", or "".
        dominance: the site whose shares to change, or "".
        to: what the link or the row is to be.
        ramp_s: how long shares take, s.
    """

    v: int = VERSION
    link: str = ""
    dominance: str = ""
    to: dict[str, Any]
    ramp_s: float = 0.0


class ChangeReply(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a site answers to an `Order`.

    Attributes:
        v: version of this schema.
        member: who answers.
        accepted: whether it does it.
        text: from when on, or why not.
        tick: its first tick, at its own rate, for which the change holds; -1 where it was refused.
    """

    v: int = VERSION
    member: str
    accepted: bool
    text: str
    tick: int = -1


class BackfillRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Messages that a recorder lacks and asks their site for.

    A message's number is its tick for a record, its place from 0 for statistics and events.

    Attributes:
        v: version of this schema.
        channel: of which channel.
        first: number of the first one wanted.
        last: number of the last one, the same or more.
    """

    v: int = VERSION
    channel: Literal["state", "link", "event"]
    first: TickNumber
    last: TickNumber


class Backfill(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a site still has of what it was asked for: consecutive messages, as they were published.

    Attributes:
        v: version of this schema.
        member: the site.
        boot: its process start.
        channel: of which channel.
        first: number of the first message here: the one asked for, or the oldest that is left.
        payloads: the messages, at most a bounded chunk; none where there is nothing (yet, or any more).
        made: how many messages of this channel the site has published so far.
    """

    v: int = VERSION
    member: str
    boot: U64
    channel: Literal["state", "link", "event"]
    first: TickNumber
    payloads: list[bytes]
    made: TickNumber


MEASUREMENT_VECTORS = {"q": JOINTS, "qd": JOINTS}


class ArmMeasurement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One measurement of an arm.

    Attributes:
        v: version of this schema.
        site: whose arm it is.
        boot: the start of the arm's program, random: a site listens to one of them.
        n: which measurement of that start it is, from 0.
        q: joint angles.
        qd: joint velocities.
        sent_ns: when it was sent, ns of the program's own monotonic clock.
    """

    v: int = VERSION
    site: str
    boot: U64
    n: TickNumber
    q: Angles
    qd: Speeds
    sent_ns: Instant
