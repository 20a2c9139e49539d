"""Positions that an arm can reach with its end effector.

A planar arm is judged by the lengths of its links. For a chain, a pose within the joint limits
is searched numerically.

Invariant:
    - A position that counts as reachable can be reached.
    - Some reachable positions of chains are not found.
"""

import math
from collections.abc import Sequence

import numpy as np

from ..core.vectors import Array
from ..scenario.arms import ArmModel

PLANAR_MARGIN = 0.01
"""Share of a planar arm's length by which a position must lie inside its reach.

No goal then needs a straight arm.
"""
FOUND_WITHIN_M = 1e-3
"""Distance at which a pose counts as found, m."""
_STEPS = 40
"""Largest number of steps of the search."""
_PROBE_RAD = 1e-6
"""Step of the numerical Jacobian, rad or m."""
_DAMPING = 1e-3
"""Damping of the least squares, m^2."""
_LARGEST_STEP_RAD = 0.5
"""Largest step of a joint, rad or m."""


def can_reach(arm: ArmModel, start_rad: Sequence[float] | Array, position_m: Array) -> bool:
    """True if the end effector of an arm can reach a position.

    Args:
        arm: the model of the arm.
        start_rad: joint angles from which a pose of a chain is searched, rad, shape (n,).
        position_m: the position in the coordinates of `ArmModel.end_effector`, m.
    """
    if arm.chain is not None:
        start = np.array(start_rad, dtype=np.float64)
        return _find_pose(arm, start, np.asarray(position_m))
    first_m, second_m = arm.lengths_m
    length_m = first_m + second_m
    farthest_m = length_m - PLANAR_MARGIN * length_m
    nearest_m = abs(first_m - second_m)
    return nearest_m <= math.hypot(*position_m) <= farthest_m


def _find_pose(arm: ArmModel, q: Array, position_m: Array) -> bool:
    """True if damped least squares find a pose within the joint limits (Wampler 1986).

    Args:
        arm: a chain.
        q: joint positions from which the search starts, shape (n,).
        position_m: the position, m.
    """
    assert arm.chain is not None
    lower = np.array([joint.lower for joint in arm.chain.joints])
    upper = np.array([joint.upper for joint in arm.chain.joints])
    for _ in range(_STEPS):
        end_effector_m = np.array(arm.end_effector(q.tolist()))
        error_m = position_m - end_effector_m
        if float(np.linalg.norm(error_m)) <= FOUND_WITHIN_M:
            return True
        J = _compute_jacobian(arm, q, end_effector_m)
        damped = J @ J.T + _DAMPING * np.eye(len(end_effector_m))
        step = J.T @ np.linalg.solve(damped, error_m)
        largest_rad = max(float(np.abs(step).max()), 1e-12)
        step *= min(1.0, _LARGEST_STEP_RAD / largest_rad)
        q = np.clip(q + step, lower, upper)
    return False


def _compute_jacobian(arm: ArmModel, q: Array, end_effector_m: Array) -> Array:
    """Returns the numerical Jacobian of a chain's end effector, shape (m, n).

    Args:
        arm: a chain.
        q: joint positions, shape (n,).
        end_effector_m: the position of the end effector at `q`, shape (m,), m.
    """
    jacobian = np.empty((len(end_effector_m), len(q)))
    for joint in range(len(q)):
        probe = q.copy()
        probe[joint] += _PROBE_RAD
        probe_m = np.array(arm.end_effector(probe.tolist()))
        jacobian[:, joint] = (probe_m - end_effector_m) / _PROBE_RAD
    return jacobian
