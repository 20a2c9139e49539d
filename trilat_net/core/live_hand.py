"""Computes the action of an operator on an arm in each tick, from the operator's messages.

A live hand is a person or program that moves an arm while the session runs. It sends messages
with goals. The arm is pulled by a spring towards a target, which follows the goals, with a
force that is multiplied by the grip, a number from 0 to 1.

A new hold starts with no force at the arm's pose, and the grip grows from 0 to 1 within
`GRIP_NS`. If an earlier grip is still fading, the hold starts from that grip, its target and
the target's velocity. A target glides to its newest goal in a straight line. The glide takes a
quarter more than the time between the last two messages, so that the target does not stop when
a message is a little late. A hand that is silent for `SILENCE_NS` releases the arm: the target
comes to rest, and the grip fades within `GRIP_NS`.

Goals beyond the arm's reach are moved to the nearest point within reach. From tick to tick the
velocity of a target changes by at most its acceleration limit times the period, for any
sequence of messages. While it glides, its speed does not exceed the largest speed from which it
can stop at its goal, Eq. (L1):

    v(d) = a h (D / (n + 1) + n / 2)                                                        (L1)
    D = d / (a h^2),    n = floor((sqrt(1 + 8 D) - 1) / 2)

where d is the distance to the goal, a the acceleration limit and h the period. A target at that
speed needs n more ticks, each a h slower than the one before, and the steps h v, h (v - a h),
... add up to d exactly. A target that starts at rest therefore moves in a straight line and
comes to rest at a still goal without overshoot. If the goal moves back along that line, the
target overshoots it by at most the stopping distance, V^2 / (2 a) + V h / 2 at the speed limit
V.

Invariant:
    - `advance_hand` is the whole state machine: a pure function of its memory and of the
      messages received before a tick.
    - The action of the hand in a tick is an input of the tick and part of its record, so a log
      repeats people without their messages.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from .jit import leaf
from .vectors import Array, Vector

SILENCE_NS = 200_000_000
"""A longer silence of the holder releases the arm."""
GRIP_NS = 100_000_000
"""Time in which a grip becomes firm, and time in which it fades."""
GLIDE_NS = 50_000_000
"""Longest time of a glide to the goal, unless a limit of the target prolongs it."""

ANOTHER_HOLDS = "hand: another one holds the arm"
OUT_OF_ORDER = "hand: out of order"
TAKEN = "takes hold"
RELEASED = "lets go"
SILENT = "is silent: let go"
"""Outcomes of a message or a silence: refusals, and changes of the holder."""


class HandReach(NamedTuple):
    """Region of the goals that an arm can reach, or a bound of it: a shell and a box.

    Attributes:
        centre: Centre of the shell, m; () without a shell.
        inner_m: Inner radius of the shell, m.
        outer_m: Outer radius of the shell, m.
        low: Least coordinates of the box, rad or m; () without a box.
        high: Largest coordinates of the box, rad or m.
    """

    centre: Vector = ()
    inner_m: float = 0.0
    outer_m: float = math.inf
    low: Vector = ()
    high: Vector = ()

    def find_nearest(self, goal: Sequence[float]) -> tuple[float, ...]:
        """Returns the nearest reachable goal; a reachable goal is returned unchanged.

        The goal is moved into the box first, then into the shell.

        Args:
            goal: The goal, rad or m.
        """
        nearest = tuple(goal)
        if self.low:
            nearest = tuple(
                min(max(x, low), high)
                for x, low, high in zip(goal, self.low, self.high, strict=True)
            )
        if not self.centre:
            return nearest
        offset = [x - middle for x, middle in zip(nearest, self.centre, strict=True)]
        radius = math.sqrt(sum(x * x for x in offset))
        if self.inner_m <= radius <= self.outer_m:
            return nearest
        allowed_m = min(max(radius, self.inner_m), self.outer_m)
        if radius == 0.0:
            # From the centre all directions are equally near: choose the first axis.
            offset[0] = 1.0
            radius = 1.0
        factor = allowed_m / radius
        pairs = zip(offset, self.centre, strict=True)
        return tuple(middle + factor * x for x, middle in pairs)


class HandRules(NamedTuple):
    """Limits of a live hand, a person or program that moves an arm during the run.

    Attributes:
        size: Count of the target's numbers: one per axis, or one per joint.
        rate_hz: Tick rate of the site, Hz.
        speed_limit: Largest speed of the target, m/s or rad/s.
        starts_at_arm: True: the target starts at the arm's pose; false: the target is a force,
            which starts at 0.
        max_goal_norm: Largest norm of an accepted goal, m, rad or N.
        acceleration_limit: Largest acceleration of the target, m/s^2 or rad/s^2; inf: no limit.
        reach: The reachable goals.
    """

    size: int
    rate_hz: int
    speed_limit: float = math.inf
    starts_at_arm: bool = True
    max_goal_norm: float = math.inf
    acceleration_limit: float = math.inf
    reach: "HandReach" = HandReach()


class HandCommand(NamedTuple):
    """One message by which a person or program moves an arm.

    Attributes:
        source: The sender, a random number above 0.
        number: Number of the sender's target; a repeated number means an unchanged target.
        grip: False releases the arm.
        target: The goal, m or rad, or the force, N.
        sent_ns: Time of sending by the sender's clock, ns.
    """

    source: int
    number: int
    grip: bool
    target: tuple[float, ...]
    sent_ns: int


class HandMemory(NamedTuple):
    """State of a live hand, a person or program that moves an arm, from tick to tick.

    Attributes:
        source: Sender that holds the arm; 0: nobody, though a grip may still fade.
        number: Number of the newest accepted message; -1 without a message.
        grip: Firmness of the grip, 0 to 1.
        target: Position of the target, which the arm follows, m or rad, or the force, N.
        rate: Velocity of the target.
        goal: Position to which the target moves, or the force.
        arrives_ns: Time at which the target arrives at the goal, ns since the epoch, the common
            start of the session.
        sent_ns: Time of sending of the goal's message, ns.
        received_ns: Time of the tick that accepted the newest message, ns since the epoch.
        before: The last sender that released the arm, and the number of its last message.
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
    """What a live hand, a person or program that moves an arm, does in one tick.

    The fields are in the order of the record's field `hand`.

    Attributes:
        grip: Firmness of the grip, 0 to 1.
        number: Number of the newest message that the hand follows; -1: nobody holds the arm.
        source: Sender that holds the arm; 0: nobody.
        target: Position that the arm follows, m or rad, or the force, N, in the tick.
        rate: Velocity of the target.
    """

    grip: float
    number: int
    source: int
    target: tuple[float, ...]
    rate: tuple[float, ...]

    @classmethod
    def read(cls, vector: Sequence[float]) -> "HandInForce":
        """Returns what a live hand did in a tick, from the record of that tick.

        Args:
            vector: Numbers of the record's field `hand`.
        """
        size = (len(vector) - 3) // 2
        grip, number, source, *numbers = vector
        return cls(
            grip=grip,
            number=int(number),
            source=int(source),
            target=tuple(numbers[:size]),
            rate=tuple(numbers[size:]),
        )


class HandStep(NamedTuple):
    """Result of `advance_hand`: what the person or program that moves an arm does in a tick.

    Attributes:
        memory: State for the next tick.
        vector: Action in the tick, see `HandInForce`.
        refused: A reason for each message that had no effect.
        changes: Changes of the holder in order: the source, and TAKEN, RELEASED or SILENT.
    """

    memory: HandMemory
    vector: list[float]
    refused: tuple[str, ...] = ()
    changes: tuple[tuple[int, str], ...] = ()


def count_hand_numbers(size: int) -> int:
    """Returns the length of the field `hand` of a record, which contains a `HandInForce`.

    Args:
        size: Count of the numbers of a target.
    """
    return 3 + 2 * size


def empty_hand_vector(size: int) -> list[float]:
    """Returns the field `hand` of a record while nobody holds the arm.

    Args:
        size: Count of the numbers of a target.
    """
    return [0.0, -1.0, 0.0, *[0.0] * (2 * size)]


def advance_hand(
    rules: HandRules,
    memory: HandMemory,
    t_ns: int,
    commands: Sequence[HandCommand],
    locate: Callable[[], Sequence[float]],
) -> HandStep:
    """Computes what a live hand, a person or program that moves an arm, does in a tick.

    The hand holds the arm at a target, which moves to the goal of the newest message. The steps
    are: move the target by one period; accept the messages; release a silent hand; choose the
    velocity of the target.

    Args:
        rules: Limits of the hand.
        memory: State after the previous tick.
        t_ns: Nominal time of the tick, ns since the epoch, the common start of the session.
        commands: Messages received since the previous tick, in order.
        locate: Function that returns the arm's pose now, in the coordinates of the target.

    Returns:
        The action in the tick, and the state for the next tick.
    """
    refused: list[str] = []
    changes: list[tuple[int, str]] = []
    now = _move_target(rules, memory) if memory.target else memory
    for command in commands:
        now, outcome = _accept_command(
            rules=rules, memory=now, t_ns=t_ns, command=command, locate=locate
        )
        if outcome in (TAKEN, RELEASED):
            changes.append((command.source, outcome))
        elif outcome:
            refused.append(outcome)

    if now.source and t_ns - now.received_ns > SILENCE_NS:
        changes.append((now.source, SILENT))
        # One less: the silent holder may repeat its number and so take hold again.
        now = _release(now, now.number - 1)

    if not now.target:
        return HandStep(now, empty_hand_vector(rules.size), tuple(refused), tuple(changes))
    rate = _find_rate(rules, now, t_ns) if now.source else _find_fading_rate(rules, now)
    now = now._replace(rate=rate)
    vector = [now.grip, float(now.number), float(now.source), *now.target, *now.rate]
    return HandStep(now, vector, tuple(refused), tuple(changes))


def _move_target(rules: HandRules, memory: HandMemory) -> HandMemory:
    """Returns the state one period later: target moved, grip firmer or weaker.

    Args:
        rules: Limits of the hand.
        memory: State after the previous tick.
    """
    h_s = 1.0 / rules.rate_hz
    grip_step = 1e9 / (GRIP_NS * rules.rate_hz)
    # A list instead of a generator: it is faster, and this runs in each tick.
    target = tuple([x + v * h_s for x, v in zip(memory.target, memory.rate, strict=True)])
    if memory.source:
        return memory._replace(target=target, grip=min(memory.grip + grip_step, 1.0))
    grip = max(memory.grip - grip_step, 0.0)
    if grip > 0.0:
        return memory._replace(target=target, grip=grip)
    return HandMemory(before=memory.before)


@leaf
def find_stopping_speed(distance: float, acceleration: float, h_s: float) -> float:
    """Returns the largest speed from which a target can stop within a distance, Eq. (L1).

    Args:
        distance: Distance to the goal, m or rad.
        acceleration: Largest acceleration, m/s^2 or rad/s^2.
        h_s: Period of the ticks, s.
    """
    speed_step = acceleration * h_s
    D = distance / (speed_step * h_s)
    n = math.floor(0.5 * (math.sqrt(1.0 + 8.0 * D) - 1.0))
    return speed_step * (D / (n + 1.0) + 0.5 * n)


_plain_stopping_speed = getattr(find_stopping_speed, "py_func", find_stopping_speed)
"""The same function, uncompiled: a call from Python into compiled code takes longer than these
few operations.
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
    """Computes how the target of a held arm moves in a series of ticks without a message.

    The result equals that of `advance_hand`, bit for bit, but one compiled call computes all of
    the ticks.

    Args:
        first: The first tick.
        rate_hz: Tick rate of the site, Hz.
        grip: Firmness of the grip before, 0 to 1.
        arrives_ns: Time at which the target arrives at the goal, ns since the epoch.
        speed_limit: Largest speed of the target, m/s or rad/s.
        acceleration: Largest acceleration of the target, m/s^2 or rad/s^2; inf: no limit.
        goal: The goal, shape (size,).
        target: The target before; changed, shape (size,).
        rate: Its velocity before; changed, shape (size,).
        rows: Written: one row per tick as `HandInForce`, except number and source.

    Returns:
        The firmness of the grip afterwards.
    """
    h_s = 1.0 / rate_hz
    grip_step = 1e9 / (GRIP_NS * rate_hz)
    size = target.shape[0]
    for n in range(rows.shape[0]):
        t_ns = (first + n) * 1_000_000_000 // rate_hz
        grip = min(grip + grip_step, 1.0)
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
            factor = speed_limit / speed if speed > speed_limit else 1.0
            for i in range(size):
                rate[i] *= factor
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
    """Moves a target by a tick, and changes its velocity as `_find_limited_rate` does.

    Args:
        left_s: Time that remains until the target arrives at the goal, s.
        h_s: The period, s.
        speed_limit: Largest speed of the target, m/s or rad/s.
        acceleration: Largest acceleration of the target, m/s^2 or rad/s^2.
        goal: The goal, shape (size,).
        target: The target; changed, shape (size,).
        rate: Its velocity; changed, shape (size,).
    """
    size = target.shape[0]
    square = 0.0
    for i in range(size):
        target[i] += rate[i] * h_s
        offset = goal[i] - target[i]
        square += offset * offset
    distance = math.sqrt(square)
    stopping_speed = find_stopping_speed(distance, acceleration, h_s)
    speed = min(speed_limit, min(distance / left_s, stopping_speed))
    speed_per_distance = speed / distance if distance > 0.0 else 0.0
    square = 0.0
    for i in range(size):
        desired_rate = speed_per_distance * (goal[i] - target[i])
        change = desired_rate - rate[i]
        square += change * change
    change_norm = math.sqrt(square)
    largest_change = acceleration * h_s
    factor = largest_change / change_norm if change_norm > largest_change else 1.0
    for i in range(size):
        desired_rate = speed_per_distance * (goal[i] - target[i])
        rate[i] += factor * (desired_rate - rate[i])


def _accept_command(
    rules: HandRules,
    memory: HandMemory,
    t_ns: int,
    command: HandCommand,
    locate: Callable[[], Sequence[float]],
) -> tuple[HandMemory, str]:
    """Returns the state after a message, and the outcome of the message.

    Args:
        rules: Limits of the hand.
        memory: State before the message.
        t_ns: Nominal time of the tick, ns since the epoch.
        command: The message.
        locate: Function that returns the arm's pose now.

    Returns:
        The state, and the outcome: a reason why the message has no effect, a change of the
        holder, or "" for an ordinary message.
    """
    if memory.source not in (0, command.source):
        return memory, ANOTHER_HOLDS

    # Messages may arrive out of order or twice.
    last = memory.number if memory.source else memory.before[1]
    is_known = memory.source or memory.before[0] == command.source
    if is_known:
        is_repeated = command.number == last and not memory.source
        if command.number < last or is_repeated:
            return memory, OUT_OF_ORDER

    if not command.grip:
        if not memory.source:
            return memory, ""
        return _release(memory, command.number), RELEASED
    if not memory.source:
        return _take_hold(rules, memory, t_ns, command, locate), TAKEN
    memory = memory._replace(received_ns=t_ns)
    if command.number == memory.number:
        return memory, ""

    period_ns = 1_000_000_000 // rules.rate_hz
    between_messages_ns = command.sent_ns - memory.sent_ns
    # A quarter more, so that the target does not stop when the next message is a little late.
    glide_ns = between_messages_ns * 5 // 4
    glide_ns = min(max(glide_ns, period_ns), GLIDE_NS)
    return _aim(rules, memory, command, t_ns + glide_ns), ""


def _take_hold(
    rules: HandRules,
    memory: HandMemory,
    t_ns: int,
    command: HandCommand,
    locate: Callable[[], Sequence[float]],
) -> HandMemory:
    """Returns the state after a message by which a sender takes hold of a free arm.

    Args:
        rules: Limits of the hand.
        memory: State before the message. An earlier grip may still fade.
        t_ns: Nominal time of the tick, ns since the epoch.
        command: The message.
        locate: Function that returns the arm's pose now.
    """
    zeros = (0.0,) * rules.size
    target = memory.target
    if not target:
        target = tuple(map(float, locate())) if rules.starts_at_arm else zeros
    held = HandMemory(
        source=command.source,
        number=command.number,
        grip=memory.grip,
        target=target,
        rate=memory.rate or zeros,
        received_ns=t_ns,
        before=memory.before,
    )
    return _aim(rules, held, command, t_ns + GLIDE_NS)


def _aim(
    rules: HandRules, memory: HandMemory, command: HandCommand, arrives_ns: int
) -> HandMemory:
    """Returns the state with the goal of a message, moved within reach.

    Args:
        rules: Limits of the hand.
        memory: State before the message.
        command: The message.
        arrives_ns: Time at which the target arrives at the goal, ns since the epoch.
    """
    goal = rules.reach.find_nearest(command.target)
    return memory._replace(
        number=command.number, goal=goal, arrives_ns=arrives_ns, sent_ns=command.sent_ns
    )


def _release(memory: HandMemory, number: int) -> HandMemory:
    """Returns the state of a fading grip.

    Args:
        memory: State before the release.
        number: Messages of the sender up to this number are outdated.
    """
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

    Both limits are balls in the space of velocities. The last and the desired velocity lie
    within the limits, and so does any velocity between them.

    Args:
        rules: The limits of the hand.
        memory: Its state, with the target already moved.
        left_s: Time that remains until the target arrives at the goal, s.
    """
    h_s = 1.0 / rules.rate_hz
    offset = [goal - x for goal, x in zip(memory.goal, memory.target, strict=True)]
    # Sums in a loop: the order of additions is that of `_glide_tick`.
    square = 0.0
    for x in offset:
        square += x * x
    distance = math.sqrt(square)
    stopping_speed = _plain_stopping_speed(distance, rules.acceleration_limit, h_s)
    speed = min(rules.speed_limit, distance / left_s, stopping_speed)
    speed_per_distance = speed / distance if distance > 0.0 else 0.0
    changes = [speed_per_distance * x - v for x, v in zip(offset, memory.rate, strict=True)]
    square = 0.0
    for change in changes:
        square += change * change
    change_norm = math.sqrt(square)
    largest_change = rules.acceleration_limit * h_s
    factor = largest_change / change_norm if change_norm > largest_change else 1.0
    return tuple(v + factor * change for v, change in zip(memory.rate, changes, strict=True))


def _find_rate(rules: HandRules, memory: HandMemory, t_ns: int) -> tuple[float, ...]:
    """Returns the velocity of a target towards its goal, within the limits of the hand.

    Args:
        rules: Limits of the hand.
        memory: State, with the target already moved.
        t_ns: Nominal time of the tick, ns since the epoch.
    """
    left_s = max((memory.arrives_ns - t_ns) * 1e-9, 1.0 / rules.rate_hz)
    if rules.acceleration_limit < math.inf:
        return _find_limited_rate(rules, memory, left_s)
    rate = [(goal - x) / left_s for goal, x in zip(memory.goal, memory.target, strict=True)]
    speed = math.sqrt(sum(v * v for v in rate))
    factor = rules.speed_limit / speed if speed > rules.speed_limit else 1.0
    return tuple(factor * v for v in rate)
