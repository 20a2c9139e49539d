"""Torques that operators and environments exert on an arm.

An operator is a person or program that moves the arm, for example a model of a human hand. An
environment is an object that the arm touches, for example a wall. The code calls both of them
actors, because their torques are computed in the same way.

Sign: This module computes the torque ON the arm. Records and the equations of the control laws
use tau_x, the negative of this torque. The total joint torque is tau - tau_x, where tau is the
motor torque.

Invariant:
    - The torque depends on time and on the state of the arm. It is therefore recomputed at each
      evaluation of the integrator, several times per control period.
    - An actor marked as `sampled` is evaluated once per period, and its torque is then held
      constant. This is how a digital haptic device renders a wall.
"""

import math
from enum import IntEnum
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..plug.plugged import UserModel, call_address
from ..step.jit import leaf
from ..step.vectors import Array, Pair, Row, RowArray, Vector, count_started
from .chain import Three, add_vectors, dot_product, place_end_effector, read_three, scale_vector
from .elementary import sincos
from .two_link_arm import end_effector_jacobian, forward_kinematics


class TorqueKind(IntEnum):
    """The kinds of operators and environments.

    - PULSE is a scripted torque with a smooth start and end.
    - HAND and TASK_HAND are a spring and a damper that pull the joints or the end effector
      towards a target on a minimum-jerk path.
    - RECORDED interpolates a table of torques.
    - VISCOUS damps the motion of the joints.
    - WALL pushes the end effector out of a half-space, and never pulls.
    - CHIRP is a repeated sweep: a sine whose frequency changes linearly with time.
    - MULTISINE is a sum of sines of equal amplitude.
    - OWN_JOINTS and OWN_TIP call a user's compiled function for the joints or the end effector.
    - LIVE_TIP and LIVE_JOINT are a spring and a damper that pull towards a target moved by a
      person during the run. LIVE_FORCE is a force set by a person. See `live_hand`.
    """

    PULSE = 0
    HAND = 1
    TASK_HAND = 2
    RECORDED = 3
    VISCOUS = 4
    WALL = 5
    CHIRP = 6
    MULTISINE = 7
    OWN_JOINTS = 8
    OWN_TIP = 9
    LIVE_TIP = 10
    LIVE_FORCE = 11
    LIVE_JOINT = 12


SCRIPTED_KINDS = (TorqueKind.PULSE, TorqueKind.RECORDED, TorqueKind.CHIRP, TorqueKind.MULTISINE)
"""Kinds whose torque depends only on time."""
LIVE_KINDS = (TorqueKind.LIVE_TIP, TorqueKind.LIVE_FORCE, TorqueKind.LIVE_JOINT)
"""Kinds that act only while a hand holds the arm.

They have the largest numbers, so compiled functions can recognise them with `>=`.
"""
OWN_KINDS = (TorqueKind.OWN_JOINTS, TorqueKind.OWN_TIP)
"""Kinds that call a user's function."""


class TorqueSource(NamedTuple):
    """Settings of one operator or environment that exerts a torque on an arm.

    `kind` determines which of the other settings are used, and what the vectors `a` and `b`
    mean. For a wall they are a point and a normal; for an operator, the start and the target.

    Attributes:
        kind: The kind of operator or environment.
        start_s: Start of the action, s since the start of the session.
        end_s: End of the action, s.
        move_start_s: Start of the target's motion, s. CHIRP: start of the first sweep.
        move_end_s: End of the target's motion, s. CHIRP: end of the first sweep.
        a: PULSE, CHIRP: peak, N m. MULTISINE: amplitude of each sine, N m. HAND, TASK_HAND:
            target before the motion, rad or m. WALL: a point of the wall, m. Live hand: target
            or force.
        b: HAND, TASK_HAND: target after the motion. WALL: unit normal, pointing away from the
            wall. CHIRP: frequencies at the start and the end of a sweep, Hz. Live hand:
            position of the target one second later.
        K: Stiffness: HAND N m/rad, TASK_HAND N/m per axis, WALL N/m (first element).
        B: Damping: HAND and VISCOUS N m s/rad, TASK_HAND N s/m per axis, WALL N s/m (first
            element).
        sampled: True if the torque is evaluated once per tick and held constant until the next
            tick.
        table: RECORDED: rows of time, s, and torque ON each joint, N m, shape (rows, 1 + n).
            MULTISINE: rows of frequency, Hz, and initial phase, turns; any further columns are
            ignored.
        limit: Live hand: the largest norm of its force, N, or torque, N m.
        grip: Live hand: factor applied to its force, 0 to 1.
        model: User-defined kind: the object that holds the parameters and the function `act`.
            See `plugged`.
    """

    kind: TorqueKind
    start_s: float = -math.inf
    end_s: float = math.inf
    move_start_s: float = 0.0
    move_end_s: float = 0.0
    a: tuple[float, ...] = ()
    b: tuple[float, ...] = ()
    K: tuple[float, ...] = ()
    B: tuple[float, ...] = ()
    sampled: bool = False
    table: Array | None = None
    limit: float = math.inf
    grip: float = 0.0
    model: Any = None


_SCALARS = ("start_s", "end_s", "move_start_s", "move_end_s", "limit", "grip")
_NUMBERS = ("a", "b", "K", "B")


@cache
def torque_source_dtype(width: int) -> np.dtype[np.void]:
    """Returns the NumPy dtype of the parameters of an operator or environment.

    A row contains the fields of `TorqueSource` and the following:

    - `table_first` and `table_count` select the rows of the common table that belong to this
      operator or environment: recorded torques, sines, or parameters of a user's function.
    - `call` is the address of a function written by a user. The function reads its input from
      `t_s` (time since the start of the session, s), `coordinates` (number of coordinates),
      `at` (position of the arm, rad or m) and `speed` (derivative of `at`), and writes the
      force or torque into `effort`, N or N m.

    Args:
        width: Largest length of the vectors of all operators and environments.
    """
    integers = ("kind", "sampled", "table_first", "table_count", "call", "coordinates")
    scalars = (*_SCALARS, "t_s")
    vectors = (*_NUMBERS, "at", "speed", "effort")
    # Integers, scalars and vectors follow one another. All have 64 bits, so the row has no
    # gaps.
    fields: list[Any] = [(name, "i8") for name in integers]
    fields += [(name, "f8") for name in scalars]
    fields += [(name, "f8", (width,)) for name in vectors]
    return np.dtype((np.record, fields))


TorqueSourceRows = NDArray[np.void]
TorqueTable = Array
SourceTorque = tuple[float, float, float]
"""Torque ON each joint, N m, and the largest wall force that contributes to it, N."""
NO_TORQUE: SourceTorque = (0.0, 0.0, 0.0)
"""Torque on an arm with no operators or environments."""

_PULSE = int(TorqueKind.PULSE)
_HAND = int(TorqueKind.HAND)
_TASK_HAND = int(TorqueKind.TASK_HAND)
_RECORDED = int(TorqueKind.RECORDED)
_VISCOUS = int(TorqueKind.VISCOUS)
_WALL = int(TorqueKind.WALL)
_CHIRP = int(TorqueKind.CHIRP)
_OWN_JOINTS, _OWN_TIP = map(int, OWN_KINDS)
_LIVE_TIP, _LIVE_FORCE, _LIVE_JOINT = map(int, LIVE_KINDS)


def torque_source_rows(
    actors: tuple[TorqueSource, ...], joints: int = 2, axes: int = 2
) -> tuple[TorqueSourceRows, TorqueTable]:
    """Converts operators and environments to two NumPy arrays that compiled code can read.

    Compiled code cannot read Python objects. Lists of different lengths, such as recorded
    torques, are concatenated into one table.

    Args:
        actors: Operators and environments of the arm.
        joints: Number of joints of the arm.
        axes: Number of Cartesian axes: 2 for the planar arm, 3 for a chain of joints.

    Returns:
        An array with one row per operator or environment, and the common table of recorded
        torques and other lists. Each row states which rows of the table belong to it.
    """
    width = 1 + joints
    rows = np.zeros(len(actors), torque_source_dtype(max(joints, axes)))
    tables = [np.zeros((0, width))]
    first = 0
    row: Row
    for row, actor in zip(rows, actors, strict=True):
        for name in _SCALARS:
            row[name] = getattr(actor, name)
        for name in _NUMBERS:
            numbers = getattr(actor, name)
            row[name][: len(numbers)] = numbers

        row.kind = int(actor.kind)
        row.sampled = int(actor.sampled)
        row.coordinates = axes if actor.kind is TorqueKind.OWN_TIP else joints
        content = actor.table
        if actor.kind in OWN_KINDS:
            # The parameters of the user's model are stored in rows of the table.
            model = UserModel(actor.model)
            row.call = model.compile_to_address("act", rows.dtype)
            numbers = model.numbers
            row_count = math.ceil(len(numbers) / width)
            content = np.resize(numbers, (row_count, width))
        if content is None:
            continue

        # All tables have the same number of columns, padded with zeros.
        columns = np.shape(content)[1]
        table = np.zeros((len(content), width))
        table[:, :columns] = content
        tables.append(table)
        row.table_first = first
        row.table_count = len(table)
        first += len(table)
    return rows, np.ascontiguousarray(np.concatenate(tables))


@leaf
def minimum_jerk(t_s: float, start_s: float, end_s: float) -> Pair:
    """Returns the progress of a minimum-jerk motion, which resembles human reaching.

        10 x^3 - 15 x^4 + 6 x^5,    x = (t - start) / (end - start)

    After Flash and Hogan, "The coordination of arm movements", J. Neuroscience 5 (1985).

    Args:
        t_s: Time t, s.
        start_s: Start of the motion, s.
        end_s: End of the motion, s.

    Returns:
        The progress, 0 to 1, and its rate, 1/s.
    """
    if t_s <= start_s:
        return 0.0, 0.0
    if t_s >= end_s:
        return 1.0, 0.0
    duration_s = end_s - start_s
    x = (t_s - start_s) / duration_s
    remaining = 1.0 - x
    polynomial = 10.0 + x * (6.0 * x - 15.0)
    progress = x * x * x * polynomial
    rate = 30.0 * x * x * remaining * remaining / duration_s
    return progress, rate


@leaf
def _spring_along(
    actor: Row, i: int, progress: float, rate: float, at: float, speed: float
) -> float:
    """Returns the force of the spring and damper with which an operator pulls the arm.

    The result is the force or torque along one coordinate, N or N m:

        K (target - at) + B (target_speed - speed),    target = a + progress (b - a)

    Args:
        actor: Row of the operator, with the stiffness K, the damping B and the path of the
            target from a to b.
        i: Index of the coordinate.
        progress: Progress of the target from a to b, 0 to 1.
        rate: Derivative of `progress`, 1/s.
        at: Position of the arm along the coordinate, rad or m.
        speed: Derivative of `at`.
    """
    start: float = actor.a[i]
    distance: float = actor.b[i] - start
    target = start + progress * distance
    target_speed = rate * distance
    spring: float = actor.K[i] * (target - at)
    damper: float = actor.B[i] * (target_speed - speed)
    return spring + damper


@leaf
def _target_progress(actor: Row, t_s: float) -> Pair:
    """Returns the progress of an operator's target along its path from `a` to `b`.

    The operator's spring pulls the arm towards this target. A scripted operator moves the
    target along a minimum-jerk path. The target of a live hand (a person or program) is at `a`,
    and moves by b - a per second.

    Args:
        actor: Row of the operator. See `torque_source_dtype`.
        t_s: Time since the start of the session, s.

    Returns:
        The progress, 0 to 1, and its rate, 1/s. The target is at a + progress (b - a), and its
        velocity is rate (b - a).
    """
    is_live_hand = actor.kind >= _LIVE_TIP  # the live kinds have the largest numbers
    if is_live_hand:
        # `a` is the current target, and `b` the target one second later.
        return 0.0, 1.0
    return minimum_jerk(t_s, actor.move_start_s, actor.move_end_s)


@leaf
def _live_share(actor: Row, square: float) -> float:
    """Returns the factor that reduces the force of a live hand.

    The norm of the force is limited first, because a human hand has limited strength. The force
    is then multiplied by the grip, from 1 (firm) to 0 (released).

    Args:
        actor: Row of the live hand, with `grip`, 0 to 1, and `limit`, N or N m.
        square: Square of the norm of the force, N^2 or N^2 m^2.
    """
    factor: float = actor.grip
    if square > actor.limit * actor.limit:
        factor *= actor.limit / math.sqrt(square)
    return factor


@leaf
def _spring_force(actor: Row, t_s: float, at: Vector, speed: Vector) -> Pair:
    """Returns the force of an operator who pulls the arm towards a target, N or N m.

    A spring and a damper act between the arm and the target along two coordinates. The force of
    a live hand is limited, and reduced while the grip is not firm. For the kind LIVE_FORCE, the
    force is set directly, without a spring.

    Args:
        actor: Row of the operator. See `torque_source_dtype`.
        t_s: Time since the start of the session, s.
        at: Position of the arm along the coordinates, rad or m.
        speed: Derivative of the position, rad/s or m/s.

    Returns:
        The force along each of the two coordinates.
    """
    progress, rate = _target_progress(actor, t_s)
    x = _spring_along(actor=actor, i=0, progress=progress, rate=rate, at=at[0], speed=speed[0])
    y = _spring_along(actor=actor, i=1, progress=progress, rate=rate, at=at[1], speed=speed[1])
    is_scripted = actor.kind < _LIVE_TIP  # the live kinds have the largest numbers
    if is_scripted:
        return x, y
    if actor.kind == _LIVE_FORCE:
        # `a` is the given force, which replaces that of the spring.
        x = actor.a[0]
        y = actor.a[1]
    square = x * x + y * y
    factor = _live_share(actor, square)
    return factor * x, factor * y


@leaf
def _find_table_rows(actor: Row, t_s: float, table: TorqueTable) -> tuple[int, int, float]:
    """Finds the two recorded torques between which to interpolate at time t.

    The recording is a table with one row per time, which is searched by bisection.

    Args:
        actor: Row of the operator, with the position of its data in the common table.
        t_s: Time since the start of the session, s.
        table: Tables of all operators and environments. Column 0 is the time of a row, s.

    Returns:
        The indices of the rows before and after t, and the relative position of t between these
        rows, from 0 to 1. The indices are -1 if t is outside the recording.
    """
    first = actor.table_first
    count = actor.table_count
    last = first + count - 1
    if count < 1 or t_s < table[first, 0] or t_s > table[last, 0]:
        return -1, -1, 0.0
    before = count_started(table, first, count, t_s) - 1
    # At the time of the last row, interpolate between the last two rows.
    offset = max(min(before, count - 2), 0)
    low = first + offset
    high = min(low + 1, last)
    low_s = table[low, 0]
    span_s = table[high, 0] - low_s
    fraction = (t_s - low_s) / span_s if span_s > 0.0 else 0.0
    return low, high, fraction


@leaf
def _recorded_torque(actor: Row, t_s: float, table: TorqueTable) -> Pair:
    """Returns the recorded torque of an operator at time t, by linear interpolation.

    The torque is zero before and after the recording.

    Args:
        actor: Row of the operator.
        t_s: Time since the start of the session, s.
        table: Tables of all operators and environments, for example of recorded torques.
    """
    low, high, x = _find_table_rows(actor, t_s, table)
    if low < 0:
        return 0.0, 0.0
    first_step = table[high, 1] - table[low, 1]
    second_step = table[high, 2] - table[low, 2]
    first = table[low, 1] + x * first_step
    second = table[low, 2] + x * second_step
    return first, second


@leaf
def _sine_of_turns(turns: float) -> float:
    """Returns sin(2 pi turns) for any number of turns.

    Complete turns are removed first, because the sine of a large angle would lose precision.
    """
    fraction = turns - math.floor(turns)
    s, _ = sincos(2.0 * math.pi * fraction)
    return s


@leaf
def _chirp_size(actor: Row, t_s: float) -> float:
    """Returns the current value of a chirp, a sine whose frequency changes with time.

    Such a torque excites the arm at all frequencies of a range, one after another, in repeated
    sweeps. With the frequencies f0 and f1 at the start and the end of a sweep, the duration
    `span` of a sweep, and the time x since the current sweep began, the value is

        sin(2 pi x (f0 + (f1 - f0) x / (2 span)))

    Args:
        actor: Row of the operator, with the frequencies in `b`, Hz.
        t_s: Time since the start of the session, s.
    """
    first_hz = actor.b[0]
    last_hz = actor.b[1]
    span_s = actor.move_end_s - actor.move_start_s
    x = t_s - actor.start_s
    sweeps = math.floor(x / span_s)
    x -= span_s * sweeps
    # The mean frequency of the sweep so far.
    rise_hz = 0.5 * (last_hz - first_hz)
    mean_hz = first_hz + rise_hz / span_s * x
    return _sine_of_turns(x * mean_hz)


@leaf
def _multisine_size(actor: Row, t_s: float, table: TorqueTable) -> float:
    """Returns the current value of a multisine, a sum of sines of amplitude 1.

    Such a torque excites the arm at several frequencies at once.

    Args:
        actor: Row of the operator.
        t_s: Time since the start of the session, s.
        table: Tables of all actors, here with rows of frequency, Hz, and phase, turns.
    """
    total = 0.0
    first = actor.table_first
    elapsed_s = t_s - actor.start_s
    for n in range(first, first + actor.table_count):
        frequency_hz = table[n, 0]
        phase_turns = table[n, 1]
        turns = frequency_hz * elapsed_s + phase_turns
        total += _sine_of_turns(turns)
    return total


@leaf
def _scripted_size(actor: Row, t_s: float, table: TorqueTable) -> float:
    """Returns the current value of a scripted torque, as a multiple of its amplitude `a`.

    The torque is a pulse, a chirp or a multisine. A pulse is

        sin^2(pi (t - start) / (end - start))

    which is smooth at both ends, as in Fig. 3 of the paper. The paper does not state the
    parameters of its pulses.

    Args:
        actor: Row of the operator.
        t_s: Time since the start of the session, s.
        table: Tables of all operators and environments, for example of recorded torques.
    """
    if actor.kind == _PULSE:
        elapsed_s = t_s - actor.start_s
        duration_s = actor.end_s - actor.start_s
        s, _ = sincos(math.pi * elapsed_s / duration_s)
        return s * s
    if actor.kind == _CHIRP:
        return _chirp_size(actor, t_s)
    return _multisine_size(actor, t_s, table)


@leaf
def _wall_force(actor: Row, at: Pair, speed: Pair) -> Pair:
    """Returns the force of a wall on the end effector of the planar arm, N.

    The wall is a spring and a damper. The force acts along the wall's normal and never pulls.

    Args:
        actor: Row of the wall: a point of the wall in `a`, m, and the outward normal in `b`.
        at: Position of the end effector, m.
        speed: Velocity of the end effector, m/s.
    """
    normal_x = actor.b[0]
    normal_y = actor.b[1]
    x = actor.a[0] - at[0]
    y = actor.a[1] - at[1]
    depth = x * normal_x + y * normal_y
    is_touched = depth > 0.0  # False for NaN
    if not is_touched:
        return 0.0, 0.0
    outward_speed = speed[0] * normal_x + speed[1] * normal_y
    spring = actor.K[0] * depth
    damper = actor.B[0] * outward_speed
    push = max(spring - damper, 0.0)
    return push * normal_x, push * normal_y


@leaf
def _is_at_end_effector(actor: Row) -> bool:
    """Returns True if the force of an actor acts on the end effector, False if on the joints.

    A force at the end effector must be mapped to joint torques by the transposed Jacobian.
    """
    kind: int = actor.kind
    return kind in (_TASK_HAND, _WALL, _OWN_TIP, _LIVE_TIP, _LIVE_FORCE)


@leaf
def _call_user_function(actor: Row, t_s: float, table: TorqueTable) -> None:
    """Calls a user's compiled function of an operator or environment.

    Values are exchanged through the fields of the row `actor`. Before the call, the position
    (`at`) and the velocity (`speed`) have been written, and `effort` has been set to zero. The
    function writes the resulting torque or force into `effort`.

    Args:
        actor: Row of the operator or environment. `call` is the address of the function.
        t_s: Time since the start of the session, s.
        table: Tables of all actors. The rows `table_first` to `table_first + table_count` hold
            the parameters of the user's model.
    """
    actor.t_s = t_s
    for i in range(actor.coordinates):
        actor.effort[i] = 0.0
    first = actor.table_first
    end = first + actor.table_count
    numbers = table[first:end].reshape(-1)
    call_address(actor.call, (numbers, actor))


@leaf
def _user_effort(actor: Row, t_s: float, at: Vector, speed: Vector, table: TorqueTable) -> Pair:
    """Returns the torque or force of a user-defined operator or environment.

    The result acts on the two joints of the planar arm, N m, or along two axes, N.

    Args:
        actor: Row of the operator or environment.
        t_s: Time since the start of the session, s.
        at: Position along the joints or axes, rad or m.
        speed: Derivative of the position, rad/s or m/s.
        table: Tables of all operators and environments, for example of recorded torques.
    """
    for i in range(2):
        actor.at[i] = at[i]
        actor.speed[i] = speed[i]
    _call_user_function(actor, t_s, table)
    return actor.effort[0], actor.effort[1]


@leaf
def _end_effector_torque(
    actor: Row, t_s: float, q: Vector, qd: Vector, lengths: Vector, table: TorqueTable
) -> SourceTorque:
    """Returns the joint torque of an operator or environment that acts at the end effector.

    A force F is equivalent to the joint torque J' F, where J is the Jacobian of the end
    effector. The third value is the norm of F for a wall, N, and 0 otherwise.

    Args:
        actor: Row of the operator or environment.
        t_s: Time since the start of the session, s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        lengths: Lengths of the two links, m.
        table: Tables of all operators and environments, for example of recorded torques.
    """
    _, at = forward_kinematics(lengths, q)
    J_x, J_y = end_effector_jacobian(lengths, q)
    speed_x = J_x[0] * qd[0] + J_x[1] * qd[1]
    speed_y = J_y[0] * qd[0] + J_y[1] * qd[1]
    speed = (speed_x, speed_y)
    wall_n = 0.0
    if actor.kind == _WALL:
        force_x, force_y = _wall_force(actor, at, speed)
        wall_n = math.sqrt(force_x * force_x + force_y * force_y)
    elif actor.kind == _OWN_TIP:
        force_x, force_y = _user_effort(actor=actor, t_s=t_s, at=at, speed=speed, table=table)
    else:
        force_x, force_y = _spring_force(actor, t_s, at, speed)
    torque_0 = J_x[0] * force_x + J_y[0] * force_y
    torque_1 = J_x[1] * force_x + J_y[1] * force_y
    return torque_0, torque_1, wall_n


@leaf
def source_torque(
    t_s: float, q: Vector, qd: Vector, lengths: Vector, actor: Row, table: TorqueTable
) -> SourceTorque:
    """Computes the joint torque that one operator or environment exerts on the planar arm.

    A force at the end effector is mapped to joint torques by the transposed Jacobian.

    Args:
        t_s: Time since the start of the session, s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        lengths: Lengths of the two links, m.
        actor: Parameters of the operator or environment.
        table: Recorded torques and other data of all operators and environments.

    Returns:
        The torques on the two joints, N m, and the force exerted by the wall, N (0 if the
        environment is not a wall).
    """
    is_active = actor.start_s <= t_s < actor.end_s
    if not is_active:
        return 0.0, 0.0, 0.0
    if actor.kind == _HAND or actor.kind == _LIVE_JOINT:
        torque = _spring_force(actor, t_s, q, qd)
    elif actor.kind == _VISCOUS:
        damping_0 = -actor.B[0] * qd[0]
        damping_1 = -actor.B[1] * qd[1]
        torque = (damping_0, damping_1)
    elif actor.kind == _RECORDED:
        torque = _recorded_torque(actor, t_s, table)
    elif actor.kind == _OWN_JOINTS:
        torque = _user_effort(actor=actor, t_s=t_s, at=q, speed=qd, table=table)
    elif _is_at_end_effector(actor):
        return _end_effector_torque(
            actor=actor, t_s=t_s, q=q, qd=qd, lengths=lengths, table=table
        )
    else:
        size = _scripted_size(actor, t_s, table)
        scripted_0 = actor.a[0] * size
        scripted_1 = actor.a[1] * size
        torque = (scripted_0, scripted_1)
    return torque[0], torque[1], 0.0


@leaf
def add_source_torque(
    total: SourceTorque,
    t_s: float,
    q: Vector,
    qd: Vector,
    lengths: Vector,
    actor: Row,
    table: TorqueTable,
    sampled: int,
) -> SourceTorque:
    """Adds the joint torque of one operator or environment to a running sum.

    Args:
        total: Sum of the joint torques so far, N m, and the largest wall force so far, N.
        t_s: Time since the start of the session, s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        lengths: Lengths of the two links, m.
        actor: Parameters of the operator or environment.
        table: Recorded torques and other data of all operators and environments.
        sampled: 1 to add the torque only if the actor is sampled (held constant during a
            control period), 0 to add it only if the actor acts continuously.

    Returns:
        The new total, equal to `total` if `sampled` excludes the actor.
    """
    if actor.sampled != sampled:
        return total
    torque = source_torque(t_s=t_s, q=q, qd=qd, lengths=lengths, actor=actor, table=table)
    return total[0] + torque[0], total[1] + torque[1], max(total[2], torque[2])


@leaf
def torque_on_arm(
    t_s: float,
    q: Vector,
    qd: Vector,
    lengths: Vector,
    actors: TorqueSourceRows,
    table: TorqueTable,
    sampled: int,
) -> SourceTorque:
    """Computes the joint torque that all operators and environments exert on the planar arm.

    Some of them are sampled: their torque is evaluated once per control period and held
    constant. All others act continuously. One call covers one of the two groups.

    Args:
        t_s: Time since the start of the session, s.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        lengths: Lengths of the two links, m.
        actors: Operators and environments, one row each.
        table: Recorded torques and other data of all actors.
        sampled: 1 for the torque of the sampled actors, 0 for all others.

    Returns:
        The torques on the two joints, N m, and the largest wall force, N.
    """
    total = NO_TORQUE
    for n in range(actors.shape[0]):
        total = add_source_torque(
            total=total,
            t_s=t_s,
            q=q,
            qd=qd,
            lengths=lengths,
            actor=actors[n],
            table=table,
            sampled=sampled,
        )
    return total


@leaf
def _force_in_space(
    actor: Row, t_s: float, at: Three, speed: Three, table: TorqueTable
) -> Three:
    """Returns the force of an operator or environment on the end effector of a chain, N.

    The force is exerted by a user's function, by an operator who pulls the end effector with a
    spring, or by a wall that pushes it.

    Args:
        actor: Row of the operator or environment.
        t_s: Time since the start of the session, s.
        at: Position of the end effector, m.
        speed: Velocity of the end effector, m/s.
        table: Tables of all operators and environments, for example of recorded torques.
    """
    if actor.kind == _OWN_TIP:
        for i in range(3):
            actor.at[i] = at[i]
            actor.speed[i] = speed[i]
        _call_user_function(actor, t_s, table)
        return read_three(actor.effort)
    if actor.kind != _WALL:
        progress, rate = _target_progress(actor, t_s)
        x = _spring_along(
            actor=actor, i=0, progress=progress, rate=rate, at=at[0], speed=speed[0]
        )
        y = _spring_along(
            actor=actor, i=1, progress=progress, rate=rate, at=at[1], speed=speed[1]
        )
        z = _spring_along(
            actor=actor, i=2, progress=progress, rate=rate, at=at[2], speed=speed[2]
        )
        if actor.kind == _TASK_HAND:
            return x, y, z
        if actor.kind == _LIVE_FORCE:
            x, y, z = read_three(actor.a)
        square = x * x + y * y + z * z
        factor = _live_share(actor, square)
        force = (x, y, z)
        return scale_vector(factor, force)

    # A wall.
    normal = read_three(actor.b)
    point = read_three(actor.a)
    depth = dot_product(point, normal) - dot_product(at, normal)
    is_touched = depth > 0.0  # False for NaN
    if not is_touched:
        return 0.0, 0.0, 0.0
    outward_speed = dot_product(speed, normal)
    spring = actor.K[0] * depth
    damper = actor.B[0] * outward_speed
    push = max(spring - damper, 0.0)
    return scale_vector(push, normal)


@leaf
def _add_joint_torque(
    actor: Row,
    t_s: float,
    q: Vector,
    qd: Vector,
    joints: int,
    table: TorqueTable,
    torque: Array,
) -> None:
    """Adds the torque of an operator or environment that acts directly on joints of a chain.

    Examples are a recorded torque per joint and a damper at each joint. Forces at the end
    effector are mapped to joint torques by `put_torque_on_chain`.

    Args:
        actor: Row of the operator or environment.
        t_s: Time since the start of the session, s.
        q: Joint positions, shape (n,), rad or m.
        qd: Joint velocities, shape (n,), rad/s or m/s.
        joints: Number n of joints.
        table: Tables of all operators and environments, for example of recorded torques.
        torque: The torque is added to this array, shape (n,), N m.
    """
    if actor.kind == _HAND or actor.kind == _LIVE_JOINT:
        # An operator who pulls each joint towards a target with a spring.
        progress, rate = _target_progress(actor, t_s)
        factor = 1.0
        square = 0.0
        if actor.kind == _LIVE_JOINT:
            # The limit applies to the norm over all joints, which must be known first.
            for i in range(joints):
                pull = _spring_along(
                    actor=actor, i=i, progress=progress, rate=rate, at=q[i], speed=qd[i]
                )
                square += pull * pull
            factor = _live_share(actor, square)
        for i in range(joints):
            pull = _spring_along(
                actor=actor, i=i, progress=progress, rate=rate, at=q[i], speed=qd[i]
            )
            torque[i] += factor * pull
    elif actor.kind == _VISCOUS:
        for i in range(joints):
            torque[i] -= actor.B[i] * qd[i]
    elif actor.kind == _RECORDED:
        low, high, fraction = _find_table_rows(actor, t_s, table)
        is_recorded = low >= 0
        if is_recorded:
            for i in range(joints):
                before = table[low, 1 + i]
                step = table[high, 1 + i] - before
                torque[i] += before + fraction * step
    elif actor.kind == _OWN_JOINTS:
        for i in range(joints):
            actor.at[i] = q[i]
            actor.speed[i] = qd[i]
        _call_user_function(actor, t_s, table)
        for i in range(joints):
            torque[i] += actor.effort[i]
    else:
        size = _scripted_size(actor, t_s, table)
        for i in range(joints):
            torque[i] += actor.a[i] * size


@leaf
def _tip_motion(qd: Vector, tip: Vector, chain: RowArray) -> tuple[Three, Three]:
    """Returns the position and the velocity of the end effector of a chain, m and m/s.

    Args:
        qd: Joint velocities, shape (n,), rad/s or m/s.
        tip: Position of the end effector in the last link's frame, m.
        chain: Joint data, one row per joint. `place_joints` must have been called before. The
            Jacobian of the end effector is written into it.
    """
    position = place_end_effector(chain, tip)
    velocity = (0.0, 0.0, 0.0)
    for i in range(chain.shape[0]):
        column = read_three(chain[i].J_lin)
        velocity = add_vectors(velocity, scale_vector(qd[i], column))
    return position, velocity


@leaf
def put_torque_on_chain(
    t_s: float,
    q: Vector,
    qd: Vector,
    tip: Vector,
    chain: RowArray,
    actors: TorqueSourceRows,
    table: TorqueTable,
    sampled: int,
    torque: Array,
) -> float:
    """Computes the joint torque that operators and environments exert on a chain of joints.

    Some of them are sampled: their torque is evaluated once per control period and held
    constant. All others act continuously. One call covers one of the two groups.

    Args:
        t_s: Time since the start of the session, s.
        q: Joint positions, shape (n,), rad or m.
        qd: Joint velocities, shape (n,), rad/s or m/s.
        tip: Position of the end effector in the last link's frame, m.
        chain: Joint data, one row per joint. `place_joints` must have been called for the same
            positions.
        actors: Operators and environments, one row each.
        table: Recorded torques and other data of all actors.
        sampled: 1 for the torque of the sampled actors, 0 for all others.
        torque: Receives the torque on the arm, shape (n,), N m.

    Returns:
        The largest wall force, N (0 if no wall is touched).
    """
    n = chain.shape[0]
    for i in range(n):
        torque[i] = 0.0
    # The motion of the end effector is computed only if an operator or environment needs it.
    at = (0.0, 0.0, 0.0)
    speed = (0.0, 0.0, 0.0)
    has_motion = False
    largest_n = 0.0
    for m in range(actors.shape[0]):
        actor: Row = actors[m]
        is_active = actor.start_s <= t_s < actor.end_s
        if actor.sampled != sampled or not is_active:
            continue

        if not _is_at_end_effector(actor):
            _add_joint_torque(
                actor=actor, t_s=t_s, q=q, qd=qd, joints=n, table=table, torque=torque
            )
            continue
        if not has_motion:
            at, speed = _tip_motion(qd, tip, chain)
            has_motion = True
        force = _force_in_space(actor=actor, t_s=t_s, at=at, speed=speed, table=table)
        # The torque J' F, where J is the Jacobian.
        for i in range(n):
            column = read_three(chain[i].J_lin)
            torque[i] += dot_product(column, force)
        if actor.kind == _WALL:
            force_n = math.sqrt(dot_product(force, force))
            largest_n = max(largest_n, force_n)
    return largest_n
