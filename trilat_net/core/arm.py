"""The planar two-link arm: inertia, Coriolis, gravity, regressor and forward dynamics.

Law: every function is linear in theta, Eq. (5), and takes theta, never lengths and masses.

Source: "Adaptive Control of Dual User Teleoperation with Time Delay and Dynamic Uncertainty",
Eq. (1)-(5), (8), (12), (24). Angles are measured from the horizontal; the second one is relative to the
first link. Eq. (24) prints theta_5 = m2 l2, which holds only where lc2 = l2; here it is m2 lc2.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .jit import leaf

Array = NDArray[np.float64]

JOINTS = 2
PARAMETERS = 5


class Links(NamedTuple):
    """What the two links are made of; `parameters` turns it into theta.

    Attributes:
        l1_m: length of the first link, m.
        m1_kg: its mass, kg.
        lc1_m: distance from its joint to its centre of mass, m.
        I1_kg_m2: its inertia about its centre of mass, kg m^2.
        l2_m: length of the second link, m.
        m2_kg: its mass, kg.
        lc2_m: distance from its joint to its centre of mass, m.
        I2_kg_m2: its inertia about its centre of mass, kg m^2.
    """

    l1_m: float
    m1_kg: float
    lc1_m: float
    I1_kg_m2: float
    l2_m: float
    m2_kg: float
    lc2_m: float
    I2_kg_m2: float


def parameters(links: Links) -> Array:
    """Returns theta, shape (5,), of Eq. (24): three inertial entries in kg m^2, two gravity ones in kg m."""
    a = links
    return np.array(
        [
            a.m1_kg * a.lc1_m**2 + a.m2_kg * (a.l1_m**2 + a.lc2_m**2) + a.I1_kg_m2 + a.I2_kg_m2,
            a.m2_kg * a.l1_m * a.lc2_m,
            a.m2_kg * a.lc2_m**2 + a.I2_kg_m2,
            a.m1_kg * a.lc1_m + a.m2_kg * a.l1_m,
            a.m2_kg * a.lc2_m,
        ]
    )


def positive_definite(theta: Array) -> bool:
    """True where M(q) is positive definite in every pose, with a margin (Property 1).

    Its determinant, theta_1 theta_3 - theta_3^2 - theta_2^2 cos^2 q_2, is least for the stretched arm.

    Args:
        theta: parameters, shape (5,).
    """
    least = theta[0] * theta[2] - theta[2] ** 2 - theta[1] ** 2
    return bool(theta[2] > 0.0 and least > 1e-9 * theta[0] * theta[2])


@leaf
def inertia(theta: Array, q: Array, M: Array) -> None:
    """Writes M(q), shape (2, 2), kg m^2 (Section IV of the paper; Property 1).

    Args:
        theta: parameters, shape (5,).
        q: joint angles, shape (2,), rad.
        M: where the result goes, shape (2, 2).
    """
    c2 = math.cos(q[1])
    M[0, 0] = theta[0] + 2.0 * theta[1] * c2
    M[0, 1] = theta[2] + theta[1] * c2
    M[1, 0] = M[0, 1]
    M[1, 1] = theta[2]


@leaf
def coriolis(theta: Array, q: Array, qd: Array, C: Array) -> None:
    """Writes C(q, qd), shape (2, 2), kg m^2/s, by Christoffel symbols, so that Eq. (4) holds.

    Args:
        theta: parameters, shape (5,).
        q: joint angles, shape (2,), rad.
        qd: joint velocities, shape (2,), rad/s.
        C: where the result goes, shape (2, 2).
    """
    h = -theta[1] * math.sin(q[1])
    C[0, 0] = h * qd[1]
    C[0, 1] = h * (qd[0] + qd[1])
    C[1, 0] = -h * qd[0]
    C[1, 1] = 0.0


@leaf
def gravity(theta: Array, g: float, q: Array, G: Array) -> None:
    """Writes G(q), shape (2,), N m.

    Args:
        theta: parameters, shape (5,).
        g: gravitational acceleration, m/s^2.
        q: joint angles, shape (2,), rad.
        G: where the result goes, shape (2,).
    """
    outer = theta[4] * g * math.cos(q[0] + q[1])
    G[0] = theta[3] * g * math.cos(q[0]) + outer
    G[1] = outer


@leaf
def regressor(g: float, q: Array, qd: Array, v: Array, a: Array, Y: Array) -> None:
    """Writes Y(q, qd, v, a), shape (2, 5), with Y theta = M(q) a + C(q, qd) v + G(q).

    The paper prints Y(q, qd, qdd) only; Eq. (12) needs the two velocities apart: qd enters through
    C, and v is what C multiplies. With v = qd and a = qdd this is the printed one, Eq. (5).

    Args:
        g: gravitational acceleration, m/s^2.
        q: joint angles, shape (2,), rad.
        qd: joint velocities, shape (2,), rad/s.
        v: reference velocity, shape (2,), rad/s.
        a: reference acceleration, shape (2,), rad/s^2.
        Y: where the result goes, shape (2, 5).
    """
    c2 = math.cos(q[1])
    s2 = math.sin(q[1])
    c12 = g * math.cos(q[0] + q[1])
    Y[0, 0] = a[0]
    Y[0, 1] = c2 * (2.0 * a[0] + a[1]) - s2 * (qd[1] * v[0] + (qd[0] + qd[1]) * v[1])
    Y[0, 2] = a[1]
    Y[0, 3] = g * math.cos(q[0])
    Y[0, 4] = c12
    Y[1, 0] = 0.0
    Y[1, 1] = c2 * a[0] + s2 * qd[0] * v[0]
    Y[1, 2] = a[0] + a[1]
    Y[1, 3] = 0.0
    Y[1, 4] = c12


@leaf
def forward_dynamics(theta: Array, g: float, q: Array, qd: Array, torque: Array, qdd: Array) -> None:
    """Writes qdd, shape (2,), rad/s^2: the solution of M qdd = torque - C qd - G, Eq. (8).

    Written out by Cramer's rule: four of these make a step, and the shared sines are what they cost.

    Args:
        theta: parameters, shape (5,).
        g: gravitational acceleration, m/s^2.
        q: joint angles, shape (2,), rad.
        qd: joint velocities, shape (2,), rad/s.
        torque: all that acts on the joints, tau - tau_x, shape (2,), N m.
        qdd: where the result goes, shape (2,).
    """
    c2 = math.cos(q[1])
    h = -theta[1] * math.sin(q[1])
    outer = theta[4] * g * math.cos(q[0] + q[1])
    m11 = theta[0] + 2.0 * theta[1] * c2
    m12 = theta[2] + theta[1] * c2
    m22 = theta[2]
    f1 = torque[0] - h * qd[1] * (2.0 * qd[0] + qd[1]) - theta[3] * g * math.cos(q[0]) - outer
    f2 = torque[1] + h * qd[0] * qd[0] - outer
    det = m11 * m22 - m12 * m12
    qdd[0] = (m22 * f1 - m12 * f2) / det
    qdd[1] = (m11 * f2 - m12 * f1) / det


@leaf
def forward_kinematics(l1_m: float, l2_m: float, q: Array, xy: Array) -> None:
    """Writes the positions of elbow and tip, shape (2, 2), m, rows (x, y), base at the origin.

    Args:
        l1_m: length of the first link, m.
        l2_m: length of the second link, m.
        q: joint angles, shape (2,), rad.
        xy: where the result goes, shape (2, 2).
    """
    xy[0, 0] = l1_m * math.cos(q[0])
    xy[0, 1] = l1_m * math.sin(q[0])
    xy[1, 0] = xy[0, 0] + l2_m * math.cos(q[0] + q[1])
    xy[1, 1] = xy[0, 1] + l2_m * math.sin(q[0] + q[1])


@leaf
def tip(lengths: Array, q: Array, xy: Array) -> None:
    """Writes where the tip is, shape (2,), m, base at the origin.

    Args:
        lengths: of the two links, shape (2,), m.
        q: joint angles, shape (2,), rad.
        xy: where the result goes, shape (2,).
    """
    xy[0] = lengths[0] * math.cos(q[0]) + lengths[1] * math.cos(q[0] + q[1])
    xy[1] = lengths[0] * math.sin(q[0]) + lengths[1] * math.sin(q[0] + q[1])


@leaf
def tip_jacobian(lengths: Array, q: Array, J: Array) -> None:
    """Writes how the tip moves with the joints, shape (2, 2), m/rad: rows x and y, columns the joints.

    Args:
        lengths: of the two links, shape (2,), m.
        q: joint angles, shape (2,), rad.
        J: where the result goes, shape (2, 2).
    """
    outer_x = lengths[1] * math.cos(q[0] + q[1])
    outer_y = lengths[1] * math.sin(q[0] + q[1])
    J[0, 0] = -lengths[0] * math.sin(q[0]) - outer_y
    J[0, 1] = -outer_y
    J[1, 0] = lengths[0] * math.cos(q[0]) + outer_x
    J[1, 1] = outer_x
