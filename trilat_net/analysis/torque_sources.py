"""Torques of operator and environment models (springs, dampers, walls), over all rows of a log at once.

Invariant: written from the definitions of the scenario, independently of the core; the tests compare the
two. Torques act ON the arm.
"""

import numpy as np

from ..core.exogenous import TorqueKind, TorqueSource
from ..core.vectors import Array
from .arm_rows import EndEffectorRows


def wall_depth(wall: TorqueSource, end_effector: EndEffectorRows) -> Array:
    """Returns the depth of an end effector in a wall, shape (K,), m; negative outside of it."""
    found: Array = (np.array(wall.a) - end_effector.at) @ np.array(wall.b)
    return found


def wall_force(wall: TorqueSource, t_s: Array, end_effector: EndEffectorRows) -> Array:
    """Returns the force of a wall along its normal, shape (K,), N: it pushes, and never pulls.

    max(K depth - B outward speed, 0) inside of it, 0 outside, and before its start and after its end.
    """
    depth = wall_depth(wall, end_effector)
    push = np.maximum(wall.K[0] * depth - wall.B[0] * (end_effector.speed @ np.array(wall.b)), 0.0)
    there = (t_s >= wall.start_s) & (t_s < wall.end_s) & (depth > 0.0)
    return np.where(there, push, 0.0)


def _target_progress(source: TorqueSource, t_s: Array) -> tuple[Array, Array]:
    """Returns the progress of a target from 0 to 1, minimum jerk, and its rate, 1/s."""
    span_s = source.move_end_s - source.move_start_s
    if span_s <= 0.0:
        return (t_s > source.move_start_s).astype(np.float64), np.zeros(len(t_s))
    x = np.clip((t_s - source.move_start_s) / span_s, 0.0, 1.0)
    return x**3 * (10.0 + x * (6.0 * x - 15.0)), 30.0 * x**2 * (1.0 - x) ** 2 / span_s


def compute_spring_effort(source: TorqueSource, t_s: Array, at: Array, speed: Array) -> Array:
    """Returns K (target - at) + B (its velocity - speed), per joint or axis, shape (K, 2)."""
    share, rate = _target_progress(source, t_s)
    a, way = np.array(source.a), np.array(source.b) - np.array(source.a)
    pull = np.array(source.K) * (a + share[:, None] * way - at)
    found: Array = pull + np.array(source.B) * (rate[:, None] * way - speed)
    return found


def compute_source_torque(
    source: TorqueSource, t_s: Array, q: Array, qd: Array, end_effector: EndEffectorRows
) -> Array:
    """Returns the torque of a spring, damper or wall ON the arm, shape (K, 2), N m.

    Raises:
        ValueError: it is another source: pulses and recorded torques are no function of the state.
    """
    if source.acts is TorqueKind.WALL:
        force = wall_force(source, t_s, end_effector)[:, None] * np.array(source.b)
        pushed = np.einsum("kij,ki->kj", end_effector.J, force)
    elif source.acts is TorqueKind.VISCOUS:
        pushed = -np.array(source.B) * qd
    elif source.acts is TorqueKind.HAND:
        pushed = compute_spring_effort(source, t_s, q, qd)
    elif source.acts is TorqueKind.TASK_HAND:
        effort = compute_spring_effort(source, t_s, end_effector.at, end_effector.speed)
        pushed = np.einsum("kij,ki->kj", end_effector.J, effort)
    else:
        raise ValueError(f"{source.acts.name} is no function of the state")
    there = (t_s >= source.start_s) & (t_s < source.end_s)
    return np.where(there[:, None], pushed, 0.0)
