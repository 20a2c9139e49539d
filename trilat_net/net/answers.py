"""What members are asked and answer, besides who they are: pings, and changes while a session runs.

Law: these pass between two and are not logged; what they change or teach is, as events.
"""

from typing import Any

import msgspec

from .messages import U64, VERSION, Instant


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


class Order(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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


class Reply(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
