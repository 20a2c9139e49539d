"""Checks whether the end effector of an arm can reach a position.

The tasks of a training environment use this to draw goals within reach. For a planar two-link
arm, the answer follows from the lengths of the links. For a chain with more joints, a numerical
search looks for a pose within the joint limits.

Invariant:
    - A position reported as reachable can be reached.
    - The converse does not hold: the search may miss a position that a chain can reach.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from trilat_net.core import Array, ChainJoint
from trilat_net.scenario import Scenario

PLANAR_MARGIN = 0.01
"""Minimum distance of a position from the limit of a planar arm's reach, as a fraction of the
arm's length, so that no goal requires a straight arm.
"""
FOUND_WITHIN_M = 1e-3
"""Distance from the position at which the search is successful, in m."""
_STEPS = 40
"""Maximum number of search steps."""
_PROBE_RAD = 1e-6
"""Step size of the numerical derivative, in rad or m."""
_DAMPING = 1e-3
"""Damping of the least-squares step, in m^2."""
_LARGEST_STEP_RAD = 0.5
"""Largest change of a joint in one step, in rad or m."""


EndEffector = Callable[[list[float]], Sequence[float]]
"""Returns the position of an end effector at given joint angles, in m."""


def can_reach(scenario: Scenario, site: str, start_rad: Array, position_m: Array) -> bool:
    """Returns True if a pose was found that places the end effector at a given position.

    For a two-link arm, the link lengths determine whether there is such a pose. For a chain
    with more joints, a numerical search looks for a pose within the joint limits, and may miss
    a pose that exists.

    Args:
        scenario: The scenario.
        site: Name of the site of the arm.
        start_rad: Joint angles from which the search starts for a chain, shape (n,), in rad.
        position_m: The position, in the coordinates of the end effector, in m.
    """
    arm = scenario.arms[site]
    if arm.chain is not None:
        start = np.array(start_rad, dtype=np.float64)
        target_m = np.asarray(position_m)
        return _find_pose(arm.end_effector, arm.chain.joints, start, target_m)
    first_m, second_m = arm.lengths_m
    length_m = first_m + second_m
    farthest_m = length_m - PLANAR_MARGIN * length_m
    nearest_m = abs(first_m - second_m)
    distance_m = math.hypot(*position_m)
    return nearest_m <= distance_m <= farthest_m


def _find_pose(
    locate: EndEffector, joints: Sequence[ChainJoint], q: Array, position_m: Array
) -> bool:
    """Searches for a pose within the joint limits that places the end effector at a position.

    Each step moves the joints by damped least squares (Wampler 1986): with the Jacobian J and
    the remaining displacement e, the step is J' (J J' + d I)^-1 e. The damping d keeps the step
    finite near singular poses. The joints are then clipped to their limits.

    Args:
        locate: Forward kinematics of the chain.
        joints: Joints of the chain, with their limits.
        q: Joint positions from which the search starts, shape (n,).
        position_m: The position, in m.

    Returns:
        True if a pose was found.
    """
    lower = np.array([joint.lower for joint in joints])
    upper = np.array([joint.upper for joint in joints])
    for _ in range(_STEPS):
        end_effector_m = np.array(locate(q.tolist()))
        error_m = position_m - end_effector_m
        distance_m = float(np.linalg.norm(error_m))
        if distance_m <= FOUND_WITHIN_M:
            return True

        J = _compute_jacobian(locate, q, end_effector_m)
        identity = np.eye(len(end_effector_m))
        damped_matrix = J @ J.T + _DAMPING * identity
        step = J.T @ np.linalg.solve(damped_matrix, error_m)
        largest_rad = float(np.abs(step).max())
        largest_rad = max(largest_rad, 1e-12)  # avoids a division by zero
        step *= min(1.0, _LARGEST_STEP_RAD / largest_rad)
        q = np.clip(q + step, lower, upper)
    return False


def _compute_jacobian(locate: EndEffector, q: Array, end_effector_m: Array) -> Array:
    """Computes the Jacobian of a chain's end effector by forward differences, shape (m, n).

    Args:
        locate: Forward kinematics of the chain.
        q: Joint positions, shape (n,).
        end_effector_m: Position of the end effector at `q`, shape (m,), in m.
    """
    joint_count = len(q)
    shape = (len(end_effector_m), joint_count)
    jacobian = np.empty(shape)
    for joint in range(joint_count):
        probe = q.copy()
        probe[joint] += _PROBE_RAD
        probe_m = np.array(locate(probe.tolist()))
        motion_m = probe_m - end_effector_m
        jacobian[:, joint] = motion_m / _PROBE_RAD
    return jacobian
