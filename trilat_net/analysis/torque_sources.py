"""Torques of operator and environment models (springs, dampers, walls), over all rows of a log at once.

Invariant: written from the definitions of the scenario, independently of the core; the tests compare the
two. Torques act ON the arm.
"""

import numpy as np

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.vectors import Array
from .arm_rows import EndEffectorRows


def wall_depth(actor: TorqueSource, tip: EndEffectorRows) -> Array:
    """Returns the depth of an end effector in a wall, shape (K,), m; negative outside of it."""
    depth: Array = (np.array(actor.a) - tip.at) @ np.array(actor.b)
    return depth


def wall_force(actor: TorqueSource, t_s: Array, tip: EndEffectorRows) -> Array:
    """Returns the force of a wall along its normal, shape (K,), N: it pushes, and never pulls.

    max(K depth - B outward speed, 0) inside of it, 0 outside, and before its start and after its end.
    """
    depth = wall_depth(actor, tip)
    push = np.maximum(actor.K[0] * depth - actor.B[0] * (tip.speed @ np.array(actor.b)), 0.0)
    there = (t_s >= actor.start_s) & (t_s < actor.end_s) & (depth > 0.0)
    force: Array = np.where(there, push, 0.0)
    return force


def _target_progress(actor: TorqueSource, t_s: Array) -> tuple[Array, Array]:
    """Returns the progress of a target from 0 to 1, minimum jerk, and its rate, 1/s."""
    span_s = actor.move_end_s - actor.move_start_s
    if span_s <= 0.0:
        return (t_s > actor.move_start_s).astype(np.float64), np.zeros(len(t_s))
    x = np.clip((t_s - actor.move_start_s) / span_s, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * x**2 * (1.0 - x) ** 2 / span_s


def compute_spring_effort(actor: TorqueSource, t_s: Array, at: Array, speed: Array) -> Array:
    """Returns K (target - at) + B (its velocity - speed), per joint or axis, shape (K, 2)."""
    share, rate = _target_progress(actor, t_s)
    a, way = np.array(actor.a), np.array(actor.b) - np.array(actor.a)
    pull = np.array(actor.K) * (a + share[:, None] * way - at)
    force: Array = pull + np.array(actor.B) * (rate[:, None] * way - speed)
    return force


def compute_source_torque(
    actor: TorqueSource, t_s: Array, q: Array, qd: Array, tip: EndEffectorRows
) -> Array:
    """Returns the torque of a spring, damper or wall ON the arm, shape (K, 2), N m.

    Raises:
        ValueError: it is another source: pulses and recorded torques are no function of the state.
    """
    if actor.acts is TorqueKind.WALL:
        force = wall_force(actor, t_s, tip)[:, None] * np.array(actor.b)
        pushed = np.einsum("kij,ki->kj", tip.J, force)
    elif actor.acts is TorqueKind.VISCOUS:
        pushed = -np.array(actor.B) * qd
    elif actor.acts is TorqueKind.HAND:
        pushed = compute_spring_effort(actor, t_s, q, qd)
    elif actor.acts is TorqueKind.TASK_HAND:
        pushed = np.einsum("kij,ki->kj", tip.J, compute_spring_effort(actor, t_s, tip.at, tip.speed))
    else:
        raise ValueError(f"{actor.acts.name} is no function of the state")
    there = (t_s >= actor.start_s) & (t_s < actor.end_s)
    torque: Array = np.where(there[:, None], pushed, 0.0)
    return torque
