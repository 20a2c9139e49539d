"""Inertia, regressor and end effector of the arm, over all rows of a log at once.

Invariant: written from Section IV and Eq. (12) of the paper, independently of the core that ran the log; the
tests compare the two.
"""

from typing import NamedTuple

import numpy as np

from ..core.two_link_arm import JOINTS
from ..core.vectors import Array


def inertia_product_rows(theta: Array, q: Array, x: Array) -> Array:
    """Returns M(q) x of rows of q, rad, and of x, shape (K, 2) each; theta of the arm has shape (5,)."""
    bend = theta[1] * np.cos(q[:, 1])
    cross = theta[2] + bend
    first = (theta[0] + 2.0 * bend) * x[:, 0] + cross * x[:, 1]
    return np.stack([first, cross * x[:, 0] + theta[2] * x[:, 1]], axis=1)


def regressor_rows(g: float, q: Array, qd: Array, v: Array, a: Array) -> Array:
    """Returns Y(q, qd, v, a) with Y theta = M(q) a + C(q, qd) v + G(q), Eq. (12), shape (K, 2, 5).

    Gravitational acceleration g in m/s^2; q, qd, reference velocity v and acceleration a of shape (K, 2), in
    rad, rad/s and rad/s^2.
    """
    Y = np.zeros((len(q), 2, 5))
    c2, s2 = np.cos(q[:, 1]), np.sin(q[:, 1])
    Y[:, 0, 0] = a[:, 0]
    Y[:, 0, 1] = c2 * (2.0 * a[:, 0] + a[:, 1])
    Y[:, 0, 1] -= s2 * (qd[:, 1] * v[:, 0] + (qd[:, 0] + qd[:, 1]) * v[:, 1])
    Y[:, 0, 2] = a[:, 1]
    Y[:, 0, 3] = g * np.cos(q[:, 0])
    Y[:, 1, 1] = c2 * a[:, 0] + s2 * qd[:, 0] * v[:, 0]
    Y[:, 1, 2] = a[:, 0] + a[:, 1]
    Y[:, 0, 4] = Y[:, 1, 4] = g * np.cos(q[:, 0] + q[:, 1])
    return Y


class EndEffectorRows(NamedTuple):
    """Position and velocity of the end effector, shape (K, 2), m and m/s.

    Attributes:
        J: its Jacobian, shape (K, 2, 2), m/rad: rows x and y, columns the joints.
    """

    at: Array
    speed: Array
    J: Array


def compute_end_effector(lengths: tuple[float, float], q: Array, qd: Array) -> EndEffectorRows:
    """Returns the end effector of an arm: lengths of its links, m; q and qd, shape (K, 2), rad and rad/s."""
    inner, outer = q[:, 0], q[:, 0] + q[:, 1]
    elbow = lengths[0] * np.stack([np.cos(inner), np.sin(inner)], axis=1)
    reach = lengths[1] * np.stack([np.cos(outer), np.sin(outer)], axis=1)
    at = elbow + reach
    J = np.empty((len(q), 2, JOINTS))
    J[:, 0, 0], J[:, 1, 0] = -at[:, 1], at[:, 0]
    J[:, 0, 1], J[:, 1, 1] = -reach[:, 1], reach[:, 0]
    return EndEffectorRows(at, np.einsum("kij,kj->ki", J, qd), J)
