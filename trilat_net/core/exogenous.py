"""Exogenous torque: what operators and environments do to the arm.

Law: a function of time and of the arm's state, so that each stage of the integrator can ask for it; where an
actor is `sampled`, it is asked once a tick and held, as a digital haptic wall does.

Scenarios speak of the torque ON the arm; the paper's tau_x, which Eq. (8) subtracts, is its negative.
"""

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .arm import JOINTS, Array, tip, tip_jacobian
from .delay import Row
from .jit import leaf


class Acts(IntEnum):
    """How an actor pushes.

    PULSE is a scripted torque, smooth at both ends. HAND and TASK_HAND are a spring and a damper towards a
    target that moves along a minimum-jerk path, in joint angles or in the plane. RECORDED is torque by a
    table. VISCOUS resists motion of the joints. WALL pushes the tip out of a half-plane, and never pulls.
    """

    PULSE = 0
    HAND = 1
    TASK_HAND = 2
    RECORDED = 3
    VISCOUS = 4
    WALL = 5


class Actor(NamedTuple):
    """One operator or environment; what its vectors mean depends on how it acts.

    Attributes:
        acts: how.
        start_s: from when on, s since the epoch.
        end_s: until when, s.
        move_start_s: when its target begins to move, s.
        move_end_s: when its target is there, s.
        a: PULSE: peak, N m. HAND, TASK_HAND: target before, rad or m. WALL: a point of it, m.
        b: HAND, TASK_HAND: target after. WALL: its normal, length 1, away from the wall.
        K: stiffness: HAND N m/rad, TASK_HAND N/m per axis, WALL N/m (the first one).
        B: damping: HAND and VISCOUS N m s/rad, TASK_HAND N s/m per axis, WALL N s/m (the first one).
        sampled: whether it is evaluated once a tick and held.
        table: RECORDED: rows of time, s, and torque ON each joint, N m, shape (n, 1 + JOINTS).
    """

    acts: Acts
    start_s: float = -math.inf
    end_s: float = math.inf
    move_start_s: float = 0.0
    move_end_s: float = 0.0
    a: tuple[float, ...] = (0.0,) * JOINTS
    b: tuple[float, ...] = (0.0,) * JOINTS
    K: tuple[float, ...] = (0.0,) * JOINTS
    B: tuple[float, ...] = (0.0,) * JOINTS
    sampled: bool = False
    table: Array | None = None


_PAIR = (JOINTS,)
ACTOR = np.dtype(
    (
        np.record,
        [
            ("acts", "i8"),
            ("sampled", "i8"),
            ("start_s", "f8"),
            ("end_s", "f8"),
            ("move_start_s", "f8"),
            ("move_end_s", "f8"),
            ("a", "f8", _PAIR),
            ("b", "f8", _PAIR),
            ("K", "f8", _PAIR),
            ("B", "f8", _PAIR),
            ("table_first", "i8"),
            ("table_count", "i8"),
        ],
    )
)
Actors = NDArray[np.void]
Table = Array

_PULSE, _HAND, _TASK_HAND = int(Acts.PULSE), int(Acts.HAND), int(Acts.TASK_HAND)
_RECORDED, _VISCOUS, _WALL = int(Acts.RECORDED), int(Acts.VISCOUS), int(Acts.WALL)


def rows_of(actors: tuple[Actor, ...]) -> tuple[Actors, Table]:
    """Returns the actors as the core has them: one row each, dtype ACTOR, and all their tables in one."""
    rows = np.zeros(len(actors), ACTOR)
    tables = [np.zeros((0, 1 + JOINTS))]
    first = 0
    row: Row
    for row, actor in zip(rows, actors, strict=True):
        for name in ("start_s", "end_s", "move_start_s", "move_end_s", "a", "b", "K", "B"):
            row[name] = getattr(actor, name)
        row.acts, row.sampled = int(actor.acts), int(actor.sampled)
        if actor.table is not None:
            tables.append(np.asarray(actor.table, dtype=np.float64))
            row.table_first, row.table_count = first, len(actor.table)
            first += len(actor.table)
    return rows, np.ascontiguousarray(np.concatenate(tables))


@leaf
def minimum_jerk(t_s: float, start_s: float, end_s: float, way: Array) -> None:
    """Writes how far a minimum-jerk move is: its share of the way, and the rate of that, 1/s.

    10 x^3 - 15 x^4 + 6 x^5 between start and end, after Flash and Hogan, "The coordination of arm
    movements", J. Neuroscience 5 (1985).
    """
    if t_s <= start_s:
        way[0], way[1] = 0.0, 0.0
    elif t_s >= end_s:
        way[0], way[1] = 1.0, 0.0
    else:
        x = (t_s - start_s) / (end_s - start_s)
        way[0] = x * x * x * (10.0 + x * (6.0 * x - 15.0))
        way[1] = 30.0 * x * x * (1.0 - x) * (1.0 - x) / (end_s - start_s)


@leaf
def _spring(actor: Row, t_s: float, at: Array, speed: Array, work: Array, force: Array) -> None:
    """Writes K (target - at) + B (its velocity - speed), per axis."""
    minimum_jerk(t_s, actor.move_start_s, actor.move_end_s, work)
    for i in range(at.shape[0]):
        way = actor.b[i] - actor.a[i]
        target = actor.a[i] + work[0] * way
        force[i] = actor.K[i] * (target - at[i]) + actor.B[i] * (work[1] * way - speed[i])


@leaf
def _tabled(actor: Row, t_s: float, table: Table, torque: Array) -> None:
    """Adds a torque between its rows, linearly; nothing before the first and behind the last."""
    first, count = actor.table_first, actor.table_count
    if count < 1 or t_s < table[first, 0] or t_s > table[first + count - 1, 0]:
        return
    low, high = first, first + count - 1
    while high - low > 1:
        middle = (low + high) // 2
        if table[middle, 0] <= t_s:
            low = middle
        else:
            high = middle
    span = table[high, 0] - table[low, 0]
    x = (t_s - table[low, 0]) / span if span > 0.0 else 0.0
    for i in range(torque.shape[0]):
        torque[i] += table[low, 1 + i] + x * (table[high, 1 + i] - table[low, 1 + i])


@leaf
def _in_the_plane(
    actor: Row, t_s: float, q: Array, qd: Array, lengths: Array, work: Array, torque: Array
) -> None:
    """Adds J' F of a force at the tip: a hand's, or a wall's."""
    at, speed, force = work[1], work[2], work[3]
    J = work[4:6]
    tip(lengths, q, at)
    tip_jacobian(lengths, q, J)
    for i in range(2):
        speed[i] = J[i, 0] * qd[0] + J[i, 1] * qd[1]
    if actor.acts == _TASK_HAND:
        _spring(actor, t_s, at, speed, work[0], force)
    else:
        depth = (actor.a[0] - at[0]) * actor.b[0] + (actor.a[1] - at[1]) * actor.b[1]
        outward = speed[0] * actor.b[0] + speed[1] * actor.b[1]
        push = max(actor.K[0] * depth - actor.B[0] * outward, 0.0) if depth > 0.0 else 0.0
        for i in range(2):
            force[i] = push * actor.b[i]
    for i in range(torque.shape[0]):
        torque[i] += J[0, i] * force[0] + J[1, i] * force[1]


@leaf
def add_torque(
    t_s: float, q: Array, qd: Array, lengths: Array, actor: Row, table: Table, work: Array, torque: Array
) -> None:
    """Adds what one actor does to the arm at time t, N m, ON it.

    A pulse is peak * sin^2(pi (t - start) / (end - start)): smooth at both ends, as in Fig. 3 of the paper,
    whose numbers are not printed.

    Args:
        t_s: time since the epoch, s.
        q: joint angles, shape (n,), rad.
        qd: joint velocities, shape (n,), rad/s.
        lengths: of the two links, m.
        actor: its row, dtype ACTOR.
        table: the site's recorded torques.
        work: scratch, shape (6, 2).
        torque: where the result is added, shape (n,).
    """
    if not actor.start_s <= t_s < actor.end_s:
        return
    if actor.acts == _PULSE:
        height = math.sin(math.pi * (t_s - actor.start_s) / (actor.end_s - actor.start_s)) ** 2
        for i in range(torque.shape[0]):
            torque[i] += actor.a[i] * height
    elif actor.acts == _HAND:
        _spring(actor, t_s, q, qd, work[0], work[3])
        for i in range(torque.shape[0]):
            torque[i] += work[3, i]
    elif actor.acts == _VISCOUS:
        for i in range(torque.shape[0]):
            torque[i] -= actor.B[i] * qd[i]
    elif actor.acts == _RECORDED:
        _tabled(actor, t_s, table, torque)
    else:
        _in_the_plane(actor, t_s, q, qd, lengths, work, torque)


@leaf
def torque_on_arm(
    t_s: float,
    q: Array,
    qd: Array,
    lengths: Array,
    actors: Actors,
    table: Table,
    sampled: int,
    work: Array,
    torque: Array,
) -> None:
    """Writes what the actors do to the arm at time t, shape (n,), N m; -tau_x of Eq. (8).

    Args:
        t_s: time since the epoch, s.
        q: joint angles, shape (n,), rad.
        qd: joint velocities, shape (n,), rad/s.
        lengths: of the two links, m.
        actors: one row each, dtype ACTOR.
        table: the site's recorded torques.
        sampled: 1 for those that are held over a tick, 0 for the others.
        work: scratch, shape (6, 2).
        torque: where the result goes, shape (n,).
    """
    torque[:] = 0.0
    for n in range(actors.shape[0]):
        actor: Row = actors[n]
        if actor.sampled == sampled:
            add_torque(t_s, q, qd, lengths, actor, table, work, torque)
