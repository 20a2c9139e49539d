"""Defines the messages that one process sends to one other process of a session.

These are replies to pings, requests for changes, requests for lost messages, measurements of
real arms, reports from dead-man switches, and the targets of operators (the people or programs
that move arms). Published messages, which everybody receives, are defined in `messages`.

A log contains only published messages: events, and the state of each arm in each tick (its
record). The messages of this module are visible in a log through their effects:

- A change is logged as an event.
- A lost message that was sent again is logged like any other message.
- A measurement is logged as `q` and `qd` (joint angles and velocities) of the record that used
  it. In each tick, an arm uses the newest measurement.
- A target or force of an operator is logged as `hand` in the records in which it acts.
"""

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType

from ..errors import count_nouns
from .messages import U64, VERSION, Angles, Instant, Speeds, TickNumber, Torques

BACKFILL_MESSAGES = 64
"""Maximum number of messages in one `Backfill`."""
BACKFILL_BYTES = 40_000
"""Maximum total size of the messages in one `Backfill`, unless one message alone is larger."""


class DirectMessage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base class of requests between processes, their replies, and measurements.

    Every message contains the schema version, which allows a process that runs another version
    of the program to recognise that it cannot read the message.
    """

    v: int = VERSION


class Pong(DirectMessage, frozen=True, kw_only=True):
    """Reply to a ping, with two of the four time stamps of a round trip.

    The time stamps are used to measure the offset between two clocks.

    Attributes:
        member: Name of the member.
        boot: Random number that identifies this start of the member's process.
        clock: Identity of the member's clock. Members with the same clock run on the same
            machine.
        came_ns: Time at which the ping arrived, on that clock.
        left_ns: Time at which the reply was sent, on that clock.
    """

    member: str
    boot: U64
    clock: str
    came_ns: Instant
    left_ns: Instant


OrderName = Literal["", "stop", "enable", "reset"]
"""Commands that a site accepts from users. An empty string stands for no command."""


class ChangeRequest(DirectMessage, frozen=True, kw_only=True):
    """Request to a site to change a setting from its next tick onwards.

    The possible changes are those that a scenario can contain in its timeline. A request sets
    exactly one of `link`, `dominance`, `stop_s`, `mark` and `order`.

    Attributes:
        link: Link whose settings change, such as "m1->s".
        dominance: Site whose weights for following its peers change.
        to: The new settings of the link, or the new weights.
        ramp_s: Duration of the transition to the new weights, in s.
        stop_s: Time at which the run ends, in s since the epoch (the common start of the
            session). The last tick of the site is before this time.
        mark: Text stored in the log to mark the present moment.
        order: Command to the site, such as "stop", executed in its next tick.
        source: The person or program that requests the change: a noun phrase such as "the
            experimenter", which is repeated in the site's event. Without a source, the
            encoded request is identical to that of a program that does not know this field.
    """

    link: str = ""
    dominance: str = ""
    to: dict[str, Any] = {}
    ramp_s: float = 0.0
    stop_s: Annotated[float, Meta(ge=0.0, le=1e6)] | None = None
    mark: Annotated[str, Meta(max_length=80)] = ""
    order: OrderName = ""
    source: Annotated[str, Meta(max_length=64)] | UnsetType = UNSET


class ChangeReply(DirectMessage, frozen=True, kw_only=True):
    """Reply of a site to a request for a change (`ChangeRequest`).

    Attributes:
        member: Name of the site.
        accepted: True if the site applies the change.
        text: Sentence for the user: the tick from which the change takes effect, or the reason
            why it was rejected.
        tick: First tick (at the tick rate of the site) in which the change is in effect. -1 if
            the change was rejected.
    """

    member: str
    accepted: bool
    text: str
    tick: int = -1


class BackfillRequest(DirectMessage, frozen=True, kw_only=True):
    """Request from a recorder to a site to resend messages that were lost.

    The number of a record is that of its tick. Statistics and events are numbered from 0.

    Attributes:
        channel: Channel of the messages: records, statistics or events.
        first, last: Numbers of the first and the last requested message.
    """

    channel: Literal["state", "link", "event"]
    first: TickNumber
    last: TickNumber


class Backfill(DirectMessage, frozen=True, kw_only=True):
    """Reply to a `BackfillRequest`, with consecutive messages exactly as they were published.

    Attributes:
        member: Name of the site.
        boot: Random number that identifies this start of the site.
        channel: Channel of the messages.
        first: Number of the first message in this reply: the requested number, or that of the
            oldest message that the site still stores.
        payloads: The messages, at most `BACKFILL_MESSAGES`. Empty if the site has not published
            them yet or no longer stores them.
        made: Number of messages that the site has published on this channel.
    """

    member: str
    boot: U64
    channel: Literal["state", "link", "event"]
    first: TickNumber
    payloads: list[bytes]
    made: TickNumber


class ArmMeasurement(DirectMessage, frozen=True, kw_only=True):
    """One measurement of a real arm, sent by its driver to the site.

    Attributes:
        site: Name of the site.
        boot: Random number that identifies this start of the driver. During a run, a site only
            accepts measurements from a single start.
        n: Number of the measurement since that start, from 0.
        q: Joint angles in rad.
        qd: Joint velocities in rad/s.
        sent_ns: Time of sending on the driver's monotonic clock, or time of the measurement on
            the arm's clock, in ns. It is not compared with any other clock.
        tau_x: Torque exerted by the operator and the environment on each joint, in N m. As in
            records, the torque that acts ON the arm is the negative of this value. Empty if the
            arm does not measure it.
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
                f"tau_x must have {count_nouns(len(self.q), 'finite number')}, as many as q"
            )


class ArmEnable(DirectMessage, frozen=True, kw_only=True):
    """Reports whether the dead-man switch of an external arm is held.

    The program of the switch sends this message at least ten times per second.

    Attributes:
        site: Name of the site.
        boot: Random number that identifies this start of the switch's program.
        n: Number of the message since that start, from 0.
        held: True while the switch is held. False stops the arm at once. If messages stop
            arriving, the site only stops the arm after a certain time.
        sent_ns: Time of sending on the program's monotonic clock, in ns.
    """

    site: str
    boot: U64
    n: TickNumber
    held: bool = True
    sent_ns: Instant


class HandMessage(DirectMessage, frozen=True, kw_only=True):
    """Target or force with which an operator (a person or a program) moves an arm.

    The message is sent when the target or force changes. It is also repeated within
    `SILENCE_NS`, which shows the site that the operator's program is still running.

    Attributes:
        site: Name of the site of the arm.
        boot: Random number above 0 that identifies the operator. Only one operator can move an
            arm at a time.
        source: Name of the person or program, as shown to the users of the session.
        n: Number of the target or force, from 0. A repeated number means that nothing has
            changed.
        grip: True while the operator moves the arm, and False to release it.
        target: Target position of the end effector in m, or target angles of the joints in rad.
            Empty for an operator who pushes.
        force: Force ON the end effector in N. Empty for all other operators.
        sent_ns: Time of sending on the program's monotonic clock, in ns.
    """

    site: str
    boot: Annotated[int, Meta(ge=1, lt=2**32)]
    source: Annotated[str, Meta(max_length=64)] = ""
    n: TickNumber
    grip: bool = True
    target: list[float] = []
    force: list[float] = []
    sent_ns: Instant


class PeerSeen(DirectMessage, frozen=True, kw_only=True):
    """State of a peer's arm, as received by a site whose arm is moved by an operator's program.

    The state is delayed by the network. The fields are those of `PeerView`.
    """

    alpha: float
    tick: int
    age_s: float
    new: int
    q: list[float]
    qd: list[float]
    tau_x: list[float]


class HandViewMessage(DirectMessage, frozen=True, kw_only=True):
    """State of a site in one tick, for the program that acts as its operator.

    The operator's program runs in a separate process and decides how the arm moves. It receives
    all fields except `site` and `boot` as a `HandView`, where they are explained.

    Attributes:
        site: Name of the site whose arm the operator moves.
        boot: Random number that identifies this start of the site.
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
