"""A live hand: what somebody who takes hold of an arm does in each tick, by the messages that
came in.

Invariant: `advance_hand` is the whole state machine, a pure function of what it remembers and
of the messages that came in before a tick. What is in force in a tick is an input of the tick
and stands in its record, so a log repeats people without their messages.

Whoever takes hold begins where the arm is, with no force: the grip grows from 0 to 1 within
`GRIP_NS`; while a grip still fades, from that grip, its target and the target's velocity. A
target glides to its newest goal in a straight line, over a quarter more than the time between
the last two messages, so that it does not stop where one is a little late. A hand that is
silent for `SILENCE_NS` lets go: the target comes to rest and the grip fades within `GRIP_NS`.

Goals lie within the arm's reach: one beyond is moved to the nearest point of it. From tick to
tick the velocity of a target changes by at most its acceleration limit times the period,
whatever messages come and however unevenly, and while it glides its speed does not exceed the
largest one from which it can stop at its goal, Eq. (L1):

    v(d) = a h (D / (n + 1) + n / 2),  D = d / (a h^2),  n = floor((sqrt(1 + 8 D) - 1) / 2)
    (L1)

with d the distance to the goal, a the acceleration limit and h the period. A target at that
speed needs n more ticks, each a h slower, and their ways h v, h (v - a h), ... add up to d
exactly. A target that begins at rest therefore moves in a straight line and comes to rest at a
still goal without overshoot. If the goal comes back along that line, the target passes it by no
more than the way in which it can stop, at most V^2 / (2 a) + V h / 2 at the speed limit V.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from .jit import leaf
from .vectors import Array, Vector

SILENCE_NS = 200_000_000
"""A longer silence of who holds an arm lets it go."""
GRIP_NS = 100_000_000
"""Time in which a grip becomes firm, and in which it fades."""
GLIDE_NS = 50_000_000
"""Longest time that a target takes to its goal, unless its speed is limited."""

ANOTHER_HOLDS = "hand: another one holds the arm"
OUT_OF_ORDER = "hand: out of order"
TAKEN = "takes hold"
RELEASED = "lets go"
SILENT = "is silent: let go"
"""What a tick changed in who holds an arm."""


class HandReach(NamedTuple):
    """The goals that an arm can get to, or a bound of them: a shell around a centre, and a box.

    Attributes:
        centre: of the shell, m; (): there is no shell.
        inner_m: its least radius.
        outer_m: its largest radius.
        low: least coordinates, rad or m; (): there is no box.
        high: largest coordinates.
    """

    centre: Vector = ()
    inner_m: float = 0.0
    outer_m: float = math.inf
    low: Vector = ()
    high: Vector = ()

    def find_nearest(self, goal: Sequence[float]) -> tuple[float, ...]:
        """Returns the nearest goal within reach; a goal within reach is not changed."""
        nearest = tuple(goal)
        if self.low:
            nearest = tuple(
                min(max(x, low), high)
                for x, low, high in zip(goal, self.low, self.high, strict=True)
            )
        if not self.centre:
            return nearest
        way = [x - middle for x, middle in zip(nearest, self.centre, strict=True)]
        radius = math.sqrt(sum(x * x for x in way))
        if self.inner_m <= radius <= self.outer_m:
            return nearest
        allowed_m = min(max(radius, self.inner_m), self.outer_m)
        if radius == 0.0:  # every direction is as near
            way[0] = radius = 1.0
        share = allowed_m / radius
        return tuple(middle + share * x for x, middle in zip(way, self.centre, strict=True))


class HandRules(NamedTuple):
    """What a live hand may do.

    Attributes:
        size: how many numbers its target has: one per axis, or per joint.
        rate_hz: tick rate of the site.
        speed_limit: largest speed of the target, m/s or rad/s.
        starts_at_arm: true: the target begins where the arm is; false: it is a force, which begins
            at 0.
        max_goal_norm: largest norm of a goal that is taken, m, rad or N.
        acceleration_limit: largest change of the target's velocity in a second, m/s^2 or
            rad/s^2; inf: none.
        reach: where goals may lie.
    """

    size: int
    rate_hz: int
    speed_limit: float = math.inf
    starts_at_arm: bool = True
    max_goal_norm: float = math.inf
    acceleration_limit: float = math.inf
    reach: "HandReach" = HandReach()


class HandCommand(NamedTuple):
    """One message of a hand.

    Attributes:
        source: who sends, a random number above 0.
        number: which target of that source it is; the same again says that nothing has changed.
        grip: false: it lets go.
        target: its goal, m or rad, or its force, N.
        sent_ns: when it was sent, on the sender's clock.
    """

    source: int
    number: int
    grip: bool
    target: tuple[float, ...]
    sent_ns: int


class HandMemory(NamedTuple):
    """What a live hand remembers from tick to tick.

    Attributes:
        source: who holds the arm; 0: nobody, though a grip may still fade.
        number: of the newest message taken; -1: none.
        grip: how firm it is, 0 to 1.
        target, rate: where the target is, and its velocity.
        goal: where it goes to.
        arrives_ns: when it arrives there, ns since the epoch.
        sent_ns: when the message of that goal was sent.
        received_ns: the tick that took in the newest message, ns since the epoch.
        before: who let go last, and the number of that message.
    """

    source: int = 0
    number: int = -1
    grip: float = 0.0
    target: tuple[float, ...] = ()
    rate: tuple[float, ...] = ()
    goal: tuple[float, ...] = ()
    arrives_ns: int = 0
    sent_ns: int = 0
    received_ns: int = 0
    before: tuple[int, int] = (0, -1)


class HandInForce(NamedTuple):
    """What a hand does in a tick, as the field `hand` of its record has it, in this order.

    Attributes:
        grip: how firm it is, 0 to 1.
        number: of the newest message that it follows; -1: nobody holds the arm.
        source: who holds it; 0: nobody.
        target: the target, or the force, in the tick.
        rate: its velocity.
    """

    grip: float
    number: int
    source: int
    target: tuple[float, ...]
    rate: tuple[float, ...]

    @classmethod
    def read(cls, vector: Sequence[float]) -> "HandInForce":
        """Returns the hand of a record's vector."""
        size = (len(vector) - 3) // 2
        grip, number, source, *rest = vector
        return cls(
            grip=grip,
            number=int(number),
            source=int(source),
            target=tuple(rest[:size]),
            rate=tuple(rest[size:]),
        )


class HandStep(NamedTuple):
    """What a tick made of the messages.

    Attributes:
        memory: for the next tick.
        vector: what is in force, see `HandInForce`.
        refused: reasons, one for each message that had no effect.
        changes: who took hold or let go, in order: the source, and one of TAKEN, RELEASED,
            SILENT.
    """

    memory: HandMemory
    vector: list[float]
    refused: tuple[str, ...] = ()
    changes: tuple[tuple[int, str], ...] = ()


def count_hand_numbers(size: int) -> int:
    """Returns how many numbers the field `hand` of a record has, for a target of so many."""
    return 3 + 2 * size


def empty_hand_vector(size: int) -> list[float]:
    """Returns the field `hand` of a tick in which nobody holds the arm."""
    return [0.0, -1.0, 0.0, *[0.0] * (2 * size)]


def advance_hand(
    rules: HandRules,
    memory: HandMemory,
    t_ns: int,
    commands: Sequence[HandCommand],
    place: Callable[[], Sequence[float]],
) -> HandStep:
    """Returns what a hand does in a tick.

    Args:
        rules: what it may do.
        memory: what it remembers of the tick before.
        t_ns: the nominal time of the tick, ns since the epoch.
        commands: the messages that came in since the tick before, in order.
        place: returns where the arm is now, in the coordinates of the target.
    """
    h_s = 1.0 / rules.rate_hz
    firmer = 1e9 / (GRIP_NS * rules.rate_hz)
    refused: list[str] = []
    changes: list[tuple[int, str]] = []
    now = memory
    if now.target:
        target = tuple([x + v * h_s for x, v in zip(now.target, now.rate, strict=True)])
        grip = min(now.grip + firmer, 1.0) if now.source else max(now.grip - firmer, 0.0)
        held = now.source or grip > 0.0
        now = now._replace(target=target, grip=grip) if held else HandMemory(before=now.before)
    for command in commands:
        now, outcome = _take_command(
            rules=rules, memory=now, t_ns=t_ns, command=command, place=place
        )
        if outcome in (TAKEN, RELEASED):
            changes.append((command.source, outcome))
        elif outcome:
            refused.append(outcome)
    if now.source and t_ns - now.received_ns > SILENCE_NS:
        changes.append((now.source, SILENT))
        now = _let_go(now, now.number - 1)
    if not now.target:
        return HandStep(now, empty_hand_vector(rules.size), tuple(refused), tuple(changes))
    now = now._replace(
        rate=_find_rate(rules, now, t_ns) if now.source else _find_fading_rate(rules, now)
    )
    vector = [now.grip, float(now.number), float(now.source), *now.target, *now.rate]
    return HandStep(now, vector, tuple(refused), tuple(changes))


@leaf
def find_stopping_speed(distance: float, acceleration: float, h_s: float) -> float:
    """Returns the largest speed from which a target can stop at a distance, Eq. (L1).

    Args:
        distance: to the goal, m or rad.
        acceleration: the largest change of speed in a second, m/s^2 or rad/s^2.
        h_s: period of the ticks, s.
    """
    step = acceleration * h_s
    ways = distance / (step * h_s)
    ticks = math.floor(0.5 * (math.sqrt(1.0 + 8.0 * ways) - 1.0))
    return step * (ways / (ticks + 1.0) + 0.5 * ticks)


_plain_stopping_speed = getattr(find_stopping_speed, "py_func", find_stopping_speed)
"""Without compilation: a call from Python into compiled code takes longer than its few
operations.
"""


@leaf
def glide(
    first: int,
    rate_hz: int,
    grip: float,
    arrives_ns: int,
    speed_limit: float,
    acceleration: float,
    goal: Array,
    target: Array,
    rate: Array,
    rows: Array,
) -> float:
    """Does as `advance_hand` of a held arm in ticks without a message, compiled: a row of
    `rows` each.

    A row is as `HandInForce`, but for number and source. Target and rate are changed; returns
    the grip.
    """
    h_s = 1.0 / rate_hz
    firmer = 1e9 / (GRIP_NS * rate_hz)
    size = target.shape[0]
    for n in range(rows.shape[0]):
        t_ns = (first + n) * 1_000_000_000 // rate_hz
        grip = min(grip + firmer, 1.0)
        left_s = max((arrives_ns - t_ns) * 1e-9, h_s)
        if acceleration < math.inf:
            _glide_tick(
                left_s=left_s,
                h_s=h_s,
                speed_limit=speed_limit,
                acceleration=acceleration,
                goal=goal,
                target=target,
                rate=rate,
            )
        else:
            square = 0.0
            for i in range(size):
                target[i] += rate[i] * h_s
                rate[i] = (goal[i] - target[i]) / left_s
                square += rate[i] * rate[i]
            speed = math.sqrt(square)
            share = speed_limit / speed if speed > speed_limit else 1.0
            for i in range(size):
                rate[i] *= share
        rows[n, 0] = grip
        for i in range(size):
            rows[n, 3 + i] = target[i]
            rows[n, 3 + size + i] = rate[i]
    return grip


@leaf
def _glide_tick(
    left_s: float,
    h_s: float,
    speed_limit: float,
    acceleration: float,
    goal: Array,
    target: Array,
    rate: Array,
) -> None:
    """Moves a target on by a tick and changes its rate within both limits, as
    `_find_limited_rate`.
    """
    size = target.shape[0]
    square = 0.0
    for i in range(size):
        target[i] += rate[i] * h_s
        way = goal[i] - target[i]
        square += way * way
    distance = math.sqrt(square)
    stopping = find_stopping_speed(distance, acceleration, h_s)
    speed = min(speed_limit, min(distance / left_s, stopping))
    per_way = speed / distance if distance > 0.0 else 0.0
    square = 0.0
    for i in range(size):
        change = per_way * (goal[i] - target[i]) - rate[i]
        square += change * change
    size_of_change = math.sqrt(square)
    most = acceleration * h_s
    share = most / size_of_change if size_of_change > most else 1.0
    for i in range(size):
        rate[i] += share * (per_way * (goal[i] - target[i]) - rate[i])


def _take_command(
    rules: HandRules,
    memory: HandMemory,
    t_ns: int,
    command: HandCommand,
    place: Callable[[], Sequence[float]],
) -> tuple[HandMemory, str]:
    """Returns the memory after a message, and why it has no effect, or what it changes, or ""."""
    if memory.source not in (0, command.source):
        return memory, ANOTHER_HOLDS
    last = memory.number if memory.source else memory.before[1]
    known = memory.source or memory.before[0] == command.source
    if known and (command.number < last or (command.number == last and not memory.source)):
        return memory, OUT_OF_ORDER
    if not command.grip:
        return (_let_go(memory, command.number), RELEASED) if memory.source else (memory, "")
    if not memory.source:
        still = (0.0,) * rules.size
        start = memory.target or (tuple(map(float, place())) if rules.starts_at_arm else still)
        held = HandMemory(
            source=command.source,
            number=command.number,
            grip=memory.grip,
            target=start,
            rate=memory.rate or still,
        )
        held = held._replace(received_ns=t_ns, before=memory.before)
        return _aim(rules, held, command, t_ns + GLIDE_NS), TAKEN
    memory = memory._replace(received_ns=t_ns)
    if command.number == memory.number:
        return memory, ""
    period_ns = 1_000_000_000 // rules.rate_hz
    between_ns = min(max((command.sent_ns - memory.sent_ns) * 5 // 4, period_ns), GLIDE_NS)
    return _aim(rules, memory, command, t_ns + between_ns), ""


def _aim(
    rules: HandRules, memory: HandMemory, command: HandCommand, arrives_ns: int
) -> HandMemory:
    goal = rules.reach.find_nearest(command.target)
    return memory._replace(
        number=command.number, goal=goal, arrives_ns=arrives_ns, sent_ns=command.sent_ns
    )


def _let_go(memory: HandMemory, number: int) -> HandMemory:
    """Returns the memory of a grip that fades; messages of its source up to `number` are over."""
    before = (memory.source, number)
    return HandMemory(grip=memory.grip, target=memory.target, rate=memory.rate, before=before)


def _find_fading_rate(rules: HandRules, memory: HandMemory) -> tuple[float, ...]:
    """Returns the velocity of a target that comes to rest while its grip fades."""
    speed = math.sqrt(sum(v * v for v in memory.rate))
    slower = speed - rules.acceleration_limit / rules.rate_hz
    if slower <= 0.0:
        return (0.0,) * len(memory.rate)
    return tuple(slower / speed * v for v in memory.rate)


def _find_limited_rate(
    rules: HandRules, memory: HandMemory, left_s: float
) -> tuple[float, ...]:
    """Returns the velocity of a target whose acceleration is limited, see Eq. (L1).

    Both limits are balls around a velocity within them, so that a velocity between the last one
    and the wanted one keeps them too.
    """
    h_s = 1.0 / rules.rate_hz
    way = [goal - x for goal, x in zip(memory.goal, memory.target, strict=True)]
    square = 0.0
    for x in way:
        square += x * x
    distance = math.sqrt(square)
    stopping = _plain_stopping_speed(distance, rules.acceleration_limit, h_s)
    speed = min(rules.speed_limit, distance / left_s, stopping)
    per_way = speed / distance if distance > 0.0 else 0.0
    changes = [per_way * x - v for x, v in zip(way, memory.rate, strict=True)]
    square = 0.0
    for change in changes:
        square += change * change
    size = math.sqrt(square)
    most = rules.acceleration_limit * h_s
    share = most / size if size > most else 1.0
    return tuple(v + share * change for v, change in zip(memory.rate, changes, strict=True))


def _find_rate(rules: HandRules, memory: HandMemory, t_ns: int) -> tuple[float, ...]:
    """Returns the velocity at which a target goes to its goal, within its limits."""
    left_s = max((memory.arrives_ns - t_ns) * 1e-9, 1.0 / rules.rate_hz)
    if rules.acceleration_limit < math.inf:
        return _find_limited_rate(rules, memory, left_s)
    rate = [(goal - x) / left_s for goal, x in zip(memory.goal, memory.target, strict=True)]
    speed = math.sqrt(sum(v * v for v in rate))
    share = rules.speed_limit / speed if speed > rules.speed_limit else 1.0
    return tuple(share * v for v in rate)
