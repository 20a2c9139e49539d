"""A policy as an operator: it moves the slave's end effector to a goal.

The policy sees what its own site knows: its own arm, and the slave as it was before the delay.
Its action is a linear combination of four vectors: from the slave to the goal, the velocity of
the slave, from the slave to the policy's own arm, and from that arm to the goal.
examples/train_over_delay.py finds the weights. The policy runs in virtual time and live:

    [[sites.m2.hands]]
    kind = "own"
    class = "reach_policy:ReachPolicy"
    settings = { goal_m = [1.7, 0.2], weights = [0.3, -0.02, -0.1, 0.2] }
"""

from collections.abc import Sequence

import numpy as np

import trilat_net as tn

LENGTHS_M = (1.0, 1.0)
FARTHEST_M = 0.3
"""Largest distance from the arm to the target of an action."""


def place(q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns position (m) and velocity (m/s) of a planar arm's end effector.

    Args:
        q: the two joint angles, in rad.
        qd: the two joint velocities, rad/s.
    """
    position = np.zeros(2)
    velocity = np.zeros(2)
    angle = 0.0
    rate = 0.0
    for length_m, joint_angle, joint_rate in zip(LENGTHS_M, q, qd, strict=True):
        angle += joint_angle
        rate += joint_rate
        position += length_m * np.array([np.cos(angle), np.sin(angle)])
        velocity += length_m * rate * np.array([-np.sin(angle), np.cos(angle)])
    return position, velocity


def decide(
    weights: Sequence[float],
    goal_m: np.ndarray,
    pose: np.ndarray,
    slave_q: np.ndarray,
    slave_qd: np.ndarray,
) -> np.ndarray:
    """Returns the target of the policy's own arm, m.

    Args:
        weights: weights of the four vectors, see the module's docstring.
        goal_m: goal of the slave's end effector, m.
        pose: position of the policy's own end effector, m.
        slave_q: joint angles of the slave in the newest sample, in rad.
        slave_qd: joint velocities of the slave in that sample, rad/s.
    """
    slave_m, slave_velocity = place(slave_q, slave_qd)
    step = weights[0] * (goal_m - slave_m) + weights[1] * slave_velocity
    step = step + weights[2] * (pose - slave_m) + weights[3] * (goal_m - pose)
    return pose + step * min(1.0, FARTHEST_M / max(float(np.linalg.norm(step)), 1e-9))


class ReachPolicy:
    """The policy as an operator in a scenario.

    Args:
        facts: the site of the operator, and its peers.
        goal_m: goal of the slave's end effector, m.
        weights: weights of the four vectors, see the module's docstring.
    """

    def __init__(
        self, facts: tn.HandContext, goal_m: Sequence[float], weights: Sequence[float]
    ) -> None:
        self.goal_m = np.array(goal_m)
        self.weights = weights
        self.slave = facts.peers.index("s")

    def act(self, now: tn.HandView) -> np.ndarray:
        """Returns the target of the arm, m."""
        slave = now.peers[self.slave]
        return decide(self.weights, self.goal_m, now.pose, slave.q, slave.qd)
