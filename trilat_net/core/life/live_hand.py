"""Computes how a person or program pulls an arm, based on messages received during a run.

A person dragging an arm on a web page, or a program connected to a haptic device, sends
messages with goals. Such an operator is called a live hand. A target moves towards the newest
goal, and a simulated spring pulls the arm towards the target. The spring force is multiplied by
the grip, a factor from 0 to 1.

Rules:

- A new hold starts at the pose of the arm, with no force. The grip grows from 0 to 1 within
  `GRIP_NS`. If the grip of an earlier hold has not yet faded, the new hold continues from that
  grip.
- The target moves in a straight line to the newest goal. The move takes 25 % longer than the
  time between the last two messages, so a slightly late message does not make the target stop.
- After a silence of `SILENCE_NS`, the target comes to rest and the grip fades to 0.
- A goal out of reach is replaced by the nearest reachable point.
- The acceleration and speed of the target are limited. At distance d from the goal, the speed
  is at most

      v(d) = a h (D / (n + 1) + n / 2)                                                     (L1)
      D = d / (a h^2),    n = floor((sqrt(1 + 8 D) - 1) / 2)

  where a is the acceleration limit and h the period of the control loop. From this speed the
  target stops exactly at the goal in n more periods, and each period is slower by a h.
  Therefore a target that starts at rest does not overshoot a goal at rest. If the goal moves
  back along the line, the overshoot is at most V^2 / (2 a) + V h / 2 at the speed limit V.

Invariant:
    - `HandRules.advance` implements all of these rules. Its result depends only on the stored
      state and on the messages received before the control period.
    - The result is stored in the record of each control period, so a run can be repeated from
      its log without the original messages.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..step.jit import leaf
from ..step.vectors import Array, Vector

SILENCE_NS = 200_000_000
"""Silence of the holder after which the arm is released, ns."""
GRIP_NS = 100_000_000
"""Time in which the grip grows from 0 to 1, or fades from 1 to 0, ns."""
GLIDE_NS = 50_000_000
"""Longest time for the target to reach a new goal, ns, unless a limit on its motion prolongs
it.
"""

ANOTHER_HOLDS = "hand: another one holds the arm"
OUT_OF_ORDER = "hand: out of order"
TAKEN = "takes hold"
RELEASED = "lets go"
SILENT = "is silent: let go"
"""Outcomes of a message or of a silence: reasons for ignoring a message, and changes of the
holder.
"""


class HandReach(NamedTuple):
    """Region to which the goals for an arm are limited: a spherical shell or a box.

    Goals outside the region are moved to its border. The region may be larger than the actual
    workspace of the arm.

    Attributes:
        centre: Centre of the shell, m. Empty if there is no shell.
        inner_m: Inner radius of the shell, m.
        outer_m: Outer radius of the shell, m.
        low: Smallest coordinates of the box, rad or m. Empty if there is no box.
        high: Largest coordinates of the box, rad or m.
    """

    centre: Vector = ()
    inner_m: float = 0.0
    outer_m: float = math.inf
    low: Vector = ()
    high: Vector = ()

    def find_nearest(self, goal: Sequence[float]) -> tuple[float, ...]:
        """Returns the position in the region that is nearest to a goal.

        A goal inside the region is returned unchanged. A goal outside is projected onto the
        border of the region.

        Args:
            goal: The goal, rad or m.
        """
        nearest = tuple(goal)
        if self.low:
            ranges = zip(goal, self.low, self.high, strict=True)
            nearest = tuple(min(max(x, low), high) for x, low, high in ranges)
        if not self.centre:
            return nearest

        offset = [x - middle for x, middle in zip(nearest, self.centre, strict=True)]
        distance_m = math.sqrt(sum(x * x for x in offset))
        if self.inner_m <= distance_m <= self.outer_m:
            return nearest

        allowed_m = min(max(distance_m, self.inner_m), self.outer_m)
        if distance_m == 0.0:
            # From the centre all directions are equally near: choose the first axis.
            offset[0] = 1.0
            distance_m = 1.0
        factor = allowed_m / distance_m
        centred_offset = zip(self.centre, offset, strict=True)
        return tuple(middle + factor * x for middle, x in centred_offset)


class HandRules(NamedTuple):
    """Limits that apply to a person or program moving an arm during a run.

    The person or program sends goals. A target moves smoothly towards the newest goal, and the
    arm is pulled towards the target. In force mode, the goal and the target are forces instead
    of positions.

    Attributes:
        size: Number of coordinates of a target, one per axis or one per joint.
        rate_hz: Rate of the control loop, Hz.
        speed_limit: Largest speed of the target, m/s or rad/s.
        starts_at_arm: True if the target is a position, which starts at the pose of the arm.
            False if it is a force, which starts at 0.
        max_goal_norm: Largest norm of an accepted goal, m, rad or N.
        acceleration_limit: Largest acceleration of the target, m/s^2 or rad/s^2; inf for no
            limit.
        reach: Region to which goals are limited.
    """

    size: int
    rate_hz: int
    speed_limit: float = math.inf
    starts_at_arm: bool = True
    max_goal_norm: float = math.inf
    acceleration_limit: float = math.inf
    reach: "HandReach" = HandReach()

    def start(self) -> "HandStep":
        """Returns the initial state and action, before anyone has moved the arm."""
        return HandStep(HandMemory(), HandInForce.list_empty(self.size))

    def advance(
        self,
        memory: "HandMemory",
        t_ns: int,
        commands: Sequence["HandCommand"],
        locate: Callable[[], Sequence[float]],
    ) -> "HandStep":
        """Computes how a person or program pulls the arm in one control period.

        Moves the target by one period, processes the new messages, ends the hold of a sender
        that has been silent for too long, and chooses the next velocity of the target.

        Args:
            memory: State after the previous period.
            t_ns: Nominal time of the period, ns since the start of the session.
            commands: Messages received since the previous period, in order of arrival.
            locate: Function that returns the current pose of the arm, in the coordinates of the
                target.

        Returns:
            The action in this period, and the state for the next period.
        """
        refused: list[str] = []
        changes: list[tuple[int, str]] = []
        state = _move_target(self, memory) if memory.target else memory
        for command in commands:
            state, outcome = _accept_command(
                rules=self, memory=state, t_ns=t_ns, command=command, locate=locate
            )
            if outcome in (TAKEN, RELEASED):
                changes.append((command.source, outcome))
            elif outcome:
                refused.append(outcome)

        silence_ns = t_ns - state.received_ns
        if state.source and silence_ns > SILENCE_NS:
            changes.append((state.source, SILENT))
            # One less, so that the silent holder can take hold again by repeating its number.
            state = _release(state, state.number - 1)

        if not state.target:
            return HandStep(
                state, HandInForce.list_empty(self.size), tuple(refused), tuple(changes)
            )

        is_held = state.source != 0
        rate = _find_rate(self, state, t_ns) if is_held else _find_fading_rate(self, state)
        state = state._replace(rate=rate)
        vector = [state.grip, float(state.number), float(state.source), *state.target, *rate]
        return HandStep(state, vector, tuple(refused), tuple(changes))


class HandCommand(NamedTuple):
    """Message with which a person or program moves an arm during a run.

    A web page, for example, sends such a message whenever the mouse moves. The message states
    who sends it, where the arm is to be pulled, and whether the arm is still held.

    Attributes:
        source: Random number above 0 that identifies the sender.
        number: Sequence number of the sender's goal. Messages with the same number contain the
            same goal.
        grip: True while the sender holds the arm, False to release the arm.
        target: Goal to which the sender pulls the arm, m or rad. In force mode, the force, N.
        sent_ns: Time of sending by the sender's clock, ns.
    """

    source: int
    number: int
    grip: bool
    target: tuple[float, ...]
    sent_ns: int


class HandMemory(NamedTuple):
    """State of a person's or program's hold on an arm, kept between two control periods.

    The state covers who holds the arm, how firmly, and the motion of the target towards which
    the arm is pulled.

    Attributes:
        source: Sender that holds the arm. 0 if nobody holds it, although an earlier grip may
            still be fading.
        number: Sequence number of the newest accepted message; -1 if there is none.
        grip: Firmness of the grip, 0 to 1.
        target: Position of the target, which the arm follows, m or rad, or the force, N.
        rate: Velocity of the target.
        goal: Position towards which the target moves, or the force.
        arrives_ns: Time at which the target reaches the goal, ns since the start of the
            session.
        sent_ns: Time at which the goal's message was sent, ns.
        received_ns: Time of the tick that accepted the newest message, ns since the start of
            the session.
        before: The last sender whose hold has ended, and the sequence number up to which its
            messages are outdated.
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
    """How a person or program pulls an arm in one tick, as stored in a log.

    The field `hand` of a log record contains these attributes as numbers, in the order listed
    here. They allow the run to be repeated without the person.

    Attributes:
        grip: Firmness of the grip, 0 to 1.
        number: Sequence number of the message in effect; -1 if nobody holds the arm.
        source: Sender that holds the arm; 0 if nobody holds it.
        target: Position that the arm follows in this tick, m or rad, or the force, N.
        rate: Velocity of the target.
    """

    grip: float
    number: int
    source: int
    target: tuple[float, ...]
    rate: tuple[float, ...]

    @classmethod
    def read(cls, vector: Sequence[float]) -> "HandInForce":
        """Reads how a person or program pulled an arm in one tick, from a log record.

        Args:
            vector: Field `hand` of the record, which contains the attributes of this class in
                the order of their definition.
        """
        grip, number, source, *numbers = vector
        size = len(numbers) // 2  # of the target and of its velocity
        return cls(
            grip=grip,
            number=int(number),
            source=int(source),
            target=tuple(numbers[:size]),
            rate=tuple(numbers[size:]),
        )

    @staticmethod
    def count_numbers(size: int) -> int:
        """Returns the length of the field `hand` of a record.

        The field holds the attributes of a `HandInForce` one after another. Each vector among
        them, such as the target, has `size` entries.

        Args:
            size: Number of coordinates of the target towards which the arm is pulled.
        """
        return 3 + 2 * size

    @staticmethod
    def list_empty(size: int) -> list[float]:
        """Returns the field `hand` of a record for a tick in which nobody moves the arm.

        Args:
            size: Number of coordinates of the target towards which the arm would be pulled.
        """
        return [0.0, -1.0, 0.0, *[0.0] * (2 * size)]


class HandStep(NamedTuple):
    """Result of one control period for a person or program that moves an arm.

    Attributes:
        memory: State for the next period.
        vector: Grip, target and target velocity in this period, as the log stores them (see
            `HandInForce`).
        refused: For each message that had no effect, the reason why it was ignored.
        changes: Senders that took hold of the arm or released it, in order. Each entry contains
            the sender and TAKEN, RELEASED or SILENT (no message for too long).
    """

    memory: HandMemory
    vector: list[float]
    refused: tuple[str, ...] = ()
    changes: tuple[tuple[int, str], ...] = ()


def _move_target(rules: HandRules, memory: HandMemory) -> HandMemory:
    """Returns the state one tick later, with the target moved and the grip updated.

    The target moves at its velocity `rate`. The spring force is multiplied by the grip, a
    factor from 0 to 1. The grip grows while a sender holds the arm and fades afterwards, taking
    GRIP_NS for the full range. Once the grip has faded to 0, there is no holder and no target.

    Args:
        rules: Limits of the hand, and the rate of the control loop.
        memory: State after the previous tick, with a target.
    """
    h_s = 1.0 / rules.rate_hz
    # The period, 1e9 / rate_hz in ns, as a fraction of GRIP_NS.
    grip_step = 1e9 / (GRIP_NS * rules.rate_hz)
    # A list instead of a generator: it is faster, and this runs in each tick.
    target = tuple([x + v * h_s for x, v in zip(memory.target, memory.rate, strict=True)])
    is_held = memory.source != 0
    if is_held:
        grip = min(memory.grip + grip_step, 1.0)
        return memory._replace(target=target, grip=grip)

    grip = max(memory.grip - grip_step, 0.0)
    if grip > 0.0:
        return memory._replace(target=target, grip=grip)
    # Only the last sender is remembered, because its old messages may still arrive.
    return HandMemory(before=memory.before)


@leaf
def find_stopping_speed(distance: float, acceleration: float, h_s: float) -> float:
    """Returns the largest speed from which a target can stop within a distance, Eq. (L1).

    The target moves in steps of one period h, with an acceleration of at most a. Speeds are
    measured in units of a h and distances in units of a h^2, so that the speed falls by 1 per
    period and the distance to the goal is D. From an integer speed n, the target stops in n
    more periods and travels n (n + 1) / 2. Therefore n is the largest integer with n (n + 1) /
    2 <= D. The remaining distance is divided among the n + 1 periods:

        speed = n + (D - n (n + 1) / 2) / (n + 1) = D / (n + 1) + n / 2

    Args:
        distance: Distance to the goal, m or rad.
        acceleration: Largest acceleration a, m/s^2 or rad/s^2.
        h_s: Period h of the ticks, s.

    Returns:
        The speed, m/s or rad/s.
    """
    speed_step = acceleration * h_s
    D = distance / (speed_step * h_s)
    n = math.floor(0.5 * (math.sqrt(1.0 + 8.0 * D) - 1.0))
    return speed_step * (D / (n + 1.0) + 0.5 * n)


@leaf
def find_glide_ns(between_messages_ns: int, rate_hz: int) -> int:
    """Returns how long the target of a pulled arm takes to reach a new goal, ns.

    The target (the point towards which the arm is pulled) arrives about when the next message
    is expected. It therefore moves smoothly and does not jump with each message.

    Args:
        between_messages_ns: Time from the previous message to the new message, ns.
        rate_hz: Rate of the control loop, Hz.
    """
    period_ns = 1_000_000_000 // rate_hz
    # A quarter more, so that the target does not stop when the next message is a little late.
    glide_ns = between_messages_ns * 5 // 4
    return min(max(glide_ns, period_ns), GLIDE_NS)


_plain_glide_ns = getattr(find_glide_ns, "py_func", find_glide_ns)
_plain_stopping_speed = getattr(find_stopping_speed, "py_func", find_stopping_speed)
"""The uncompiled functions. A call from Python into compiled code would take longer than these
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
    """Computes how a person or program pulls an arm in several ticks without a new message.

    A simulated spring pulls the arm towards a target, which moves to the goal of the last
    message. The spring force is multiplied by the grip, a factor that grows until it reaches 1.
    The results are bit-identical to those of `HandRules.advance`, but a single compiled call
    computes all ticks.

    Args:
        first: The first tick.
        rate_hz: Tick rate of the site, Hz.
        grip: Initial firmness of the grip, 0 to 1.
        arrives_ns: Time at which the target reaches the goal, ns since the start of the
            session.
        speed_limit: Largest speed of the target, m/s or rad/s.
        acceleration: Largest acceleration of the target, m/s^2 or rad/s^2; inf for no limit.
        goal: The goal, shape (size,).
        target: The initial target; modified, shape (size,).
        rate: The initial velocity of the target; modified, shape (size,).
        rows: Receives one row per tick, in the form of `HandInForce`. The caller fills in the
            number and the source of the message (columns 1 and 2).

    Returns:
        The firmness of the grip after the last tick.
    """
    h_s = 1.0 / rate_hz
    # The period, 1e9 / rate_hz in ns, as a fraction of GRIP_NS.
    grip_step = 1e9 / (GRIP_NS * rate_hz)
    size = target.shape[0]
    for n in range(rows.shape[0]):
        t_ns = (first + n) * 1_000_000_000 // rate_hz
        grip = min(grip + grip_step, 1.0)
        # An overdue target arrives within one period.
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
    """Moves a target towards its goal in one control period, with limited acceleration.

    Compiled equivalent of `_find_limited_rate`.

    Args:
        left_s: Time remaining until the target should reach the goal, s.
        h_s: The control period, s.
        speed_limit: Largest speed of the target, m/s or rad/s.
        acceleration: Largest acceleration of the target, m/s^2 or rad/s^2.
        goal: The goal, shape (size,).
        target: The target; modified, shape (size,).
        rate: Velocity of the target; modified, shape (size,).
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
    """Processes a message from a person or program that holds an arm, or tries to.

    Only one sender can hold an arm at a time. A message may take hold of a free arm, move the
    goal, or release the arm.

    Args:
        rules: Limits of the goals.
        memory: State before the message.
        t_ns: Nominal time of the tick, ns since the start of the session.
        command: The message.
        locate: Function that returns the current pose of the arm.

    Returns:
        The state after the message, and the outcome: the reason why the message has no effect,
            a change of the holder, or "" for an ordinary message.
    """
    is_held = memory.source != 0
    if is_held and memory.source != command.source:
        return memory, ANOTHER_HOLDS

    # Messages may arrive out of order or twice.
    if is_held:
        known_source = memory.source
        newest_number = memory.number
    else:
        known_source, newest_number = memory.before
    if command.source == known_source:
        is_repeated = command.number == newest_number and not is_held
        if command.number < newest_number or is_repeated:
            return memory, OUT_OF_ORDER

    if not command.grip:
        if not is_held:
            return memory, ""
        return _release(memory, command.number), RELEASED
    if not is_held:
        return _take_hold(rules, memory, t_ns, command, locate), TAKEN

    memory = memory._replace(received_ns=t_ns)
    has_new_goal = command.number != memory.number
    if not has_new_goal:
        return memory, ""

    between_messages_ns = command.sent_ns - memory.sent_ns
    glide_ns = _plain_glide_ns(between_messages_ns, rules.rate_hz)
    return _aim(rules, memory, command, t_ns + glide_ns), ""


def _take_hold(
    rules: HandRules,
    memory: HandMemory,
    t_ns: int,
    command: HandCommand,
    locate: Callable[[], Sequence[float]],
) -> HandMemory:
    """Returns the state after a sender has taken hold of a free arm.

    While the grip of an earlier hold fades, its target still exists and moves. A new hold then
    continues with this grip, target and velocity, so that the force does not jump. Otherwise
    the hold starts at the pose of the arm, with no force.

    Args:
        rules: Limits of the hand.
        memory: State before the message, in which nobody holds the arm.
        t_ns: Nominal time of the tick, ns since the start of the session.
        command: The message.
        locate: Function that returns the current pose of the arm.

    Returns:
        The new state. The target reaches its goal after GLIDE_NS.
    """
    zeros = (0.0,) * rules.size
    is_earlier_grip_fading = bool(memory.target)
    if is_earlier_grip_fading:
        target = memory.target
    elif rules.starts_at_arm:
        target = tuple(map(float, locate()))
    else:
        target = zeros  # the target is a force
    held = HandMemory(
        source=command.source,
        number=command.number,
        grip=memory.grip,
        target=target,
        rate=memory.rate or zeros,
        received_ns=t_ns,
        before=memory.before,
    )
    arrives_ns = t_ns + GLIDE_NS
    return _aim(rules, held, command, arrives_ns)


def _aim(
    rules: HandRules, memory: HandMemory, command: HandCommand, arrives_ns: int
) -> HandMemory:
    """Returns the state after the goal has been set from a new message.

    A goal out of reach is replaced by the nearest reachable point.

    Args:
        rules: Limits of the hand.
        memory: State before the message.
        command: The message.
        arrives_ns: Time at which the target should reach the goal, ns since the start of the
            session.
    """
    goal = rules.reach.find_nearest(command.target)
    return memory._replace(
        number=command.number, goal=goal, arrives_ns=arrives_ns, sent_ns=command.sent_ns
    )


def _release(memory: HandMemory, number: int) -> HandMemory:
    """Returns the state after a person or program has let go of the arm.

    The grip, the target and its velocity are kept, so that the force fades smoothly.

    Args:
        memory: State before the release.
        number: Messages of the former holder up to this sequence number are outdated, and
            cannot take hold of the arm again.
    """
    before = (memory.source, number)
    return HandMemory(grip=memory.grip, target=memory.target, rate=memory.rate, before=before)


def _find_fading_rate(rules: HandRules, memory: HandMemory) -> tuple[float, ...]:
    """Returns the velocity of the target while the grip fades after a release.

    The target decelerates as fast as `rules` allow until it stands still.

    Args:
        rules: Limits of the target's motion, and the rate of the control loop.
        memory: State of the hand, with the current velocity of the target.

    Returns:
        The velocity, one entry per coordinate, in the unit of the target per second.
    """
    speed = math.sqrt(sum(v * v for v in memory.rate))
    largest_change = rules.acceleration_limit / rules.rate_hz
    next_speed = speed - largest_change
    if next_speed <= 0.0:
        return (0.0,) * len(memory.rate)
    return tuple(next_speed / speed * v for v in memory.rate)


def _find_limited_rate(
    rules: HandRules, memory: HandMemory, left_s: float
) -> tuple[float, ...]:
    """Returns the velocity with which a target moves towards its goal and stops there.

    Speed and acceleration are limited. The desired velocity points to the goal. Its magnitude
    is the smallest of three speeds: the speed limit, the speed that reaches the goal in the
    remaining time, and the largest speed from which the target can stop at the goal, Eq. (L1)
    of the module docstring. The velocity changes linearly towards the desired velocity, by at
    most the acceleration limit times the control period.

    The limits apply to the norms. The previous and the desired velocity are both within the
    speed limit, and so is any velocity between them.

    Args:
        rules: Limits of the hand.
        memory: State of the hand, with the target already moved, the goal, and the previous
            velocity `rate`, m/s or rad/s.
        left_s: Time remaining until the target should reach the goal, s.

    Returns:
        The velocity of the target, m/s or rad/s per coordinate.
    """
    h_s = 1.0 / rules.rate_hz
    offset = [goal - x for goal, x in zip(memory.goal, memory.target, strict=True)]
    # `_glide_tick` computes the same in compiled code. Loops add in the same order as it does.
    squared_distance = 0.0
    for x in offset:
        squared_distance += x * x
    distance = math.sqrt(squared_distance)

    arriving_speed = distance / left_s
    stopping_speed = _plain_stopping_speed(distance, rules.acceleration_limit, h_s)
    speed = min(rules.speed_limit, arriving_speed, stopping_speed)
    speed_per_distance = speed / distance if distance > 0.0 else 0.0
    changes = [speed_per_distance * x - v for x, v in zip(offset, memory.rate, strict=True)]

    squared_change = 0.0
    for change in changes:
        squared_change += change * change
    change_norm = math.sqrt(squared_change)
    largest_change = rules.acceleration_limit * h_s
    factor = largest_change / change_norm if change_norm > largest_change else 1.0
    return tuple(v + factor * change for v, change in zip(memory.rate, changes, strict=True))


def _find_rate(rules: HandRules, memory: HandMemory, t_ns: int) -> tuple[float, ...]:
    """Returns the velocity with which a target moves towards its goal.

    The target moves in a straight line, and arrives when the next message with a new goal is
    expected, unless this would exceed the speed limit. If the acceleration is limited, the
    target also decelerates in time.

    Args:
        rules: Limits of the target's motion, and the rate of the control loop.
        memory: State of the hand, with the target already moved to this tick.
        t_ns: Nominal time of the tick, ns since the start of the session.

    Returns:
        The velocity, one entry per coordinate, in the unit of the target per second.
    """
    # An overdue target arrives within one period.
    period_s = 1.0 / rules.rate_hz
    left_s = max((memory.arrives_ns - t_ns) * 1e-9, period_s)
    if rules.acceleration_limit < math.inf:
        return _find_limited_rate(rules, memory, left_s)
    rate = [(goal - x) / left_s for goal, x in zip(memory.goal, memory.target, strict=True)]
    speed = math.sqrt(sum(v * v for v in rate))
    factor = rules.speed_limit / speed if speed > rules.speed_limit else 1.0
    return tuple(factor * v for v in rate)
