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
_PROBE_RAD = 1e-6
"""Step of the numerical Jacobian, rad or m."""
_DAMPING = 1e-3
"""Damping of the least squares, m^2."""
_LARGEST_STEP_RAD = 0.5


def can_reach(arm: ArmModel, start_rad: Sequence[float] | Array, place_m: Array) -> bool:
    """True if the end effector of an arm can reach a position.

    Args:
        arm: the model of the arm.
        start_rad: joint angles from which a pose of a chain is searched, rad, shape (n,).
        place_m: the position in the coordinates of `ArmModel.end_effector`, m.
    """
    if arm.chain is not None:
        return _find_pose(arm, np.array(start_rad, dtype=np.float64), np.asarray(place_m))
    first_m, second_m = arm.lengths_m
    margin_m = PLANAR_MARGIN * (first_m + second_m)
    distance_m = math.hypot(*place_m)
    return abs(first_m - second_m) <= distance_m <= first_m + second_m - margin_m


def _find_pose(arm: ArmModel, q: Array, place_m: Array) -> bool:
    """True if damped least squares find a pose within the joint limits (Wampler 1986).

    Args:
        arm: a chain.
        q: joint positions from which the search starts, shape (n,).
        place_m: the position, m.
    """
    assert arm.chain is not None
    lower = np.array([joint.lower for joint in arm.chain.joints])
    upper = np.array([joint.upper for joint in arm.chain.joints])
    for _ in range(_STEPS):
        position_m = np.array(arm.end_effector(q.tolist()))
        error_m = place_m - position_m
        if float(np.linalg.norm(error_m)) <= FOUND_WITHIN_M:
            return True
        jacobian = np.empty((len(position_m), len(q)))
        for joint in range(len(q)):
            probe = q.copy()
            probe[joint] += _PROBE_RAD
            probe_position_m = np.array(arm.end_effector(probe.tolist()))
            jacobian[:, joint] = (probe_position_m - position_m) / _PROBE_RAD
        damped = jacobian @ jacobian.T + _DAMPING * np.eye(len(position_m))
        step = jacobian.T @ np.linalg.solve(damped, error_m)
        step *= min(1.0, _LARGEST_STEP_RAD / max(float(np.abs(step).max()), 1e-12))
        q = np.clip(q + step, lower, upper)
    return False
