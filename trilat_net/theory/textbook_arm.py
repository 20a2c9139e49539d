"""The planar two-joint arm in plain NumPy: M(q), C(q, qd), G(q), the regressor and the end effector.

Invariant: independent of the compiled core, and analytic in every argument, so that a complex step gives
derivatives exact to rounding.

Vectors have their components on the first axis and any number of columns behind it: shape (2,) or (2, B).

Source: "Adaptive Control of Dual User Teleoperation with Time Delay and Dynamic Uncertainty",
Eq. (1)-(5), (24).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[Any]
"""Real numbers, or complex ones for a derivative by complex step."""


def inertia_matrix(theta: Numbers, q: Numbers) -> Numbers:
    """Returns M(q), shape (2, 2, ...), kg m^2, for the parameters theta, shape (5, ...)."""
    coupling = theta[2] + theta[1] * np.cos(q[1])
    inner = theta[0] + 2.0 * theta[1] * np.cos(q[1])
    return np.array([[inner, coupling], [coupling, theta[2] + 0.0 * coupling]])


def coriolis_matrix(theta: Numbers, q: Numbers, qd: Numbers) -> Numbers:
    """Returns C(q, qd) by Christoffel symbols, shape (2, 2, ...), kg m^2/s."""
    h = -theta[1] * np.sin(q[1])
    return np.array([[h * qd[1], h * (qd[0] + qd[1])], [-h * qd[0], 0.0 * h * qd[0]]])


def gravity_torque(theta: Numbers, g: float, q: Numbers) -> Numbers:
    """Returns G(q), shape (2, ...), N m."""
    outer = theta[4] * g * np.cos(q[0] + q[1])
    return np.array([theta[3] * g * np.cos(q[0]) + outer, outer])


def multiply_columns(matrix: Numbers, vector: Numbers) -> Numbers:
    """Returns the product of a matrix, shape (a, b, ...), and a vector, shape (b, ...)."""
    product: Numbers = np.einsum("ab...,b...->a...", matrix, vector)
    return product


def required_torque(theta: Numbers, g: float, q: Numbers, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
    """Returns M(q) a + C(q, qd) v + G(q), shape (2, ...), N m: Y theta of Eq. (12)."""
    torque: Numbers = (
        multiply_columns(inertia_matrix(theta, q), a)
        + multiply_columns(coriolis_matrix(theta, q, qd), v)
        + gravity_torque(theta, g, q)
    )
    return torque


def regressor_matrix(g: float, q: Numbers, qd: Numbers, v: Numbers, a: Numbers) -> Numbers:
    """Returns Y(q, qd, v, a), shape (2, 5, ...), Eq. (12): column p is the torque that theta = e_p needs."""
    units = np.multiply.outer(np.eye(5), np.ones(q.shape[1:]))
    return np.stack([required_torque(unit, g, q, qd, v, a) for unit in units], axis=1)


def joint_acceleration(theta: Numbers, g: float, q: Numbers, qd: Numbers, torque: Numbers) -> Numbers:
    """Returns qdd, shape (2, ...), rad/s^2: the solution of M qdd + C qd + G = torque, Eq. (8)."""
    at_no_acceleration = required_torque(theta, g, q, qd, qd, np.zeros_like(qd))
    M = np.moveaxis(inertia_matrix(theta, q), (0, 1), (-2, -1))
    force = np.moveaxis(torque - at_no_acceleration, 0, -1)[..., np.newaxis]
    return np.moveaxis(np.linalg.solve(M, force)[..., 0], -1, 0)


def end_effector_position(lengths_m: tuple[float, float], q: Numbers) -> Numbers:
    """Returns the position of the end effector, shape (2, ...), m, from the base."""
    l1_m, l2_m = lengths_m
    q12 = q[0] + q[1]
    return np.array([l1_m * np.cos(q[0]) + l2_m * np.cos(q12), l1_m * np.sin(q[0]) + l2_m * np.sin(q12)])


def position_jacobian(lengths_m: tuple[float, float], q: Numbers) -> Numbers:
    """Returns the Jacobian of the end effector's position, shape (2, 2, ...), m/rad: rows x and y."""
    l1_m, l2_m = lengths_m
    q12 = q[0] + q[1]
    s, c = l2_m * np.sin(q12), l2_m * np.cos(q12)
    return np.array([[-l1_m * np.sin(q[0]) - s, -s], [l1_m * np.cos(q[0]) + c, c]])
