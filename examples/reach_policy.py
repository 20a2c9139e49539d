"""A policy that reaches: it brings the slave's end effector to a place, by what its own site knows.

It is linear in four vectors, each as seen where the user is: how far the delayed slave is from the goal, how
fast it moved, how far its own arm is ahead of it, and how far its own arm is from the goal. The weights are
found by examples/train_over_delay.py; here they act, in virtual time or live, by the same function:

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
"""Longest way from the arm to where the hand is to go."""


def place(q: np.ndarray, qd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns place and velocity of a planar arm's end effector, m and m/s."""
    a, b = q[0], q[0] + q[1]
    links = [(LENGTHS_M[0], a, qd[0]), (LENGTHS_M[1], b, qd[0] + qd[1])]
    at = sum(length * np.array([np.cos(angle), np.sin(angle)]) for length, angle, _ in links)
    speed = sum(
        length * rate * np.array([-np.sin(angle), np.cos(angle)])
        for length, angle, rate in links
    )
    return np.asarray(at), np.asarray(speed)


def decide(
    weights: Sequence[float],
    goal_m: np.ndarray,
    pose: np.ndarray,
    slave_q: np.ndarray,
    slave_qd: np.ndarray,
) -> np.ndarray:
    """Returns where the hand is to go, m."""
    at, speed = place(slave_q, slave_qd)
    way = weights[0] * (goal_m - at) + weights[1] * speed
    way = way + weights[2] * (pose - at) + weights[3] * (goal_m - pose)
    return pose + way * min(1.0, FARTHEST_M / max(float(np.linalg.norm(way)), 1e-9))


class ReachPolicy:
    """The policy as a hand of a scenario."""

    def __init__(
        self, facts: tn.HandContext, goal_m: Sequence[float], weights: Sequence[float]
    ) -> None:
        self.goal_m, self.weights = np.array(goal_m), weights
        self.slave = facts.peers.index("s")

    def act(self, now: tn.HandView) -> np.ndarray:
        """Returns where the hand is to go, m."""
        slave = now.peers[self.slave]
        return decide(self.weights, self.goal_m, now.pose, slave.q, slave.qd)
