"""What actors do to an arm, over all of its rows at once: springs, dampers, walls.

Law: written from the definitions of `scenario.actors`, apart from the core's; the tests hold one against the
other.
"""

from typing import NamedTuple

import numpy as np

from ..core.arm import JOINTS, Array
from ..core.exogenous import Actor, Acts


class Tip(NamedTuple):
    """Where the tip is and how fast, and how it moves with the joints.

    Attributes:
        at: shape (K, 2), m.
        speed: shape (K, 2), m/s.
        J: its Jacobian, shape (K, 2, 2), m/rad: rows x and y, columns the joints.
    """

    at: Array
    speed: Array
    J: Array


def tip_of(lengths: tuple[float, float], q: Array, qd: Array) -> Tip:
    """Returns the tip of an arm.

    Args:
        lengths: of the two links, m.
        q: joint angles, shape (K, 2), rad.
        qd: joint velocities, shape (K, 2), rad/s.
    """
    inner, outer = q[:, 0], q[:, 0] + q[:, 1]
    elbow = lengths[0] * np.stack([np.cos(inner), np.sin(inner)], axis=1)
    reach = lengths[1] * np.stack([np.cos(outer), np.sin(outer)], axis=1)
    at = elbow + reach
    J = np.empty((len(q), 2, JOINTS))
    J[:, 0, 0], J[:, 1, 0] = -at[:, 1], at[:, 0]
    J[:, 0, 1], J[:, 1, 1] = -reach[:, 1], reach[:, 0]
    return Tip(at, np.einsum("kij,kj->ki", J, qd), J)


def wall_depth(actor: Actor, tip: Tip) -> Array:
    """Returns how deep a tip is in a wall, shape (K,), m; negative outside of it."""
    depth: Array = (np.array(actor.a) - tip.at) @ np.array(actor.b)
    return depth


def wall_force(actor: Actor, t_s: Array, tip: Tip) -> Array:
    """Returns the force of a wall along its normal, shape (K,), N: it pushes, and never pulls.

    max(K depth - B outward speed, 0) inside of it, 0 outside, and while it is not there.
    """
    depth = wall_depth(actor, tip)
    push = np.maximum(actor.K[0] * depth - actor.B[0] * (tip.speed @ np.array(actor.b)), 0.0)
    there = (t_s >= actor.start_s) & (t_s < actor.end_s) & (depth > 0.0)
    force: Array = np.where(there, push, 0.0)
    return force


def _way(actor: Actor, t_s: Array) -> tuple[Array, Array]:
    """Returns the share of its way that a target has made, and the rate of that, 1/s: minimum jerk."""
    span_s = actor.move_end_s - actor.move_start_s
    if span_s <= 0.0:
        return (t_s > actor.move_start_s).astype(np.float64), np.zeros(len(t_s))
    x = np.clip((t_s - actor.move_start_s) / span_s, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * x**2 * (1.0 - x) ** 2 / span_s


def spring_of(actor: Actor, t_s: Array, at: Array, speed: Array) -> Array:
    """Returns K (target - at) + B (its velocity - speed), per joint or axis, shape (K, 2)."""
    share, rate = _way(actor, t_s)
    a, way = np.array(actor.a), np.array(actor.b) - np.array(actor.a)
    pull = np.array(actor.K) * (a + share[:, None] * way - at)
    force: Array = pull + np.array(actor.B) * (rate[:, None] * way - speed)
    return force


def torque_of(actor: Actor, t_s: Array, q: Array, qd: Array, tip: Tip) -> Array:
    """Returns what one actor does to the joints, shape (K, 2), N m, ON the arm.

    Springs, dampers and walls: what is a function of the state. Pulses and recorded torques are not.

    Raises:
        ValueError: it acts in another way.
    """
    if actor.acts is Acts.WALL:
        force = wall_force(actor, t_s, tip)[:, None] * np.array(actor.b)
        pushed = np.einsum("kij,ki->kj", tip.J, force)
    elif actor.acts is Acts.VISCOUS:
        pushed = -np.array(actor.B) * qd
    elif actor.acts is Acts.HAND:
        pushed = spring_of(actor, t_s, q, qd)
    elif actor.acts is Acts.TASK_HAND:
        pushed = np.einsum("kij,ki->kj", tip.J, spring_of(actor, t_s, tip.at, tip.speed))
    else:
        raise ValueError(f"{actor.acts.name} is no function of the state")
    there = (t_s >= actor.start_s) & (t_s < actor.end_s)
    torque: Array = np.where(there[:, None], pushed, 0.0)
    return torque
