"""The arm's inertia and regressor over all rows at once, for the books.

Law: written from Section IV and Eq. (12) of the paper, independently of the code that ran.
"""

import numpy as np

from ..core.arm import Array


def inertia_times(theta: Array, q: Array, x: Array) -> Array:
    """Returns M(q) x.

    Args:
        theta: the arm's parameters, shape (5,).
        q: joint angles, shape (K, 2), rad.
        x: what M multiplies, shape (K, 2).
    """
    bend = theta[1] * np.cos(q[:, 1])
    cross = theta[2] + bend
    first = (theta[0] + 2.0 * bend) * x[:, 0] + cross * x[:, 1]
    return np.stack([first, cross * x[:, 0] + theta[2] * x[:, 1]], axis=1)


def regressor(g: float, q: Array, qd: Array, v: Array, a: Array) -> Array:
    """Returns Y(q, qd, v, a) with Y theta = M(q) a + C(q, qd) v + G(q), Eq. (12), shape (K, 2, 5).

    Args:
        g: gravitational acceleration, m/s^2.
        q: joint angles, shape (K, 2), rad.
        qd: joint velocities, shape (K, 2), rad/s.
        v: reference velocity, shape (K, 2), rad/s.
        a: reference acceleration, shape (K, 2), rad/s^2.
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
