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
"""Real numbers, or complex ones where a derivative is asked for."""


def inertia_matrix(theta: Numbers, q: Numbers) -> Numbers:
    """Returns M(q), shape (2, 2, ...), kg m^2.

    Args:
        theta: parameters, shape (5, ...).
        q: joint angles, shape (2, ...), rad.
    """
    across = theta[2] + theta[1] * np.cos(q[1])
    inner = theta[0] + 2.0 * theta[1] * np.cos(q[1])
    return np.array([[inner, across], [across, theta[2] + 0.0 * across]])


def coriolis_matrix(theta: Numbers, q: Numbers, qd: Numbers) -> Numbers:
    """Returns C(q, qd) by Christoffel symbols, shape (2, 2, ...), kg m^2/s.

    Args:
        theta: parameters, shape (5, ...).
        q: joint angles, shape (2, ...), rad.
        qd: joint velocities, shape (2, ...), rad/s.
    """
    h = -theta[1] * np.sin(q[1])
    return np.array([[h * qd[1], h * (qd[0] + qd[1])], [-h * qd[0], 0.0 * h * qd[0]]])


def gravity_torque(theta: Numbers, g: float, q: Numbers) -> Numbers:
    """Returns G(q), shape (2, ...), N m.

    Args:
        theta: parameters, shape (5, ...).
        g: gravitational acceleration, m/s^2.
        q: joint angles, shape (2, ...), rad.
    """
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
    ones = np.ones(q.shape[1:])
    units = np.multiply.outer(np.eye(5), ones)
    columns = [required_torque(unit, g, q, qd, v, a) for unit in units]
    return np.stack(columns, axis=1)


def joint_acceleration(theta: Numbers, g: float, q: Numbers, qd: Numbers, torque: Numbers) -> Numbers:
    """Returns qdd, shape (2, ...), rad/s^2: the solution of M qdd + C qd + G = torque, Eq. (8)."""
    rest = required_torque(theta, g, q, qd, qd, np.zeros_like(qd))
    M = np.moveaxis(inertia_matrix(theta, q), (0, 1), (-2, -1))
    force = np.moveaxis(torque - rest, 0, -1)[..., np.newaxis]
    return np.moveaxis(np.linalg.solve(M, force)[..., 0], -1, 0)


def end_effector_position(lengths_m: tuple[float, float], q: Numbers) -> Numbers:
    """Returns where the tip is, shape (2, ...), m, the base at the origin."""
    l1_m, l2_m = lengths_m
    turned = q[0] + q[1]
    return np.array(
        [l1_m * np.cos(q[0]) + l2_m * np.cos(turned), l1_m * np.sin(q[0]) + l2_m * np.sin(turned)]
    )


def position_jacobian(lengths_m: tuple[float, float], q: Numbers) -> Numbers:
    """Returns how the tip moves with the joints, shape (2, 2, ...), m/rad: rows x and y."""
    l1_m, l2_m = lengths_m
    turned = q[0] + q[1]
    s, c = l2_m * np.sin(turned), l2_m * np.cos(turned)
    return np.array([[-l1_m * np.sin(q[0]) - s, -s], [l1_m * np.cos(q[0]) + c, c]])
