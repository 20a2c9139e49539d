"""The planar two-link arm: inertia, Coriolis, gravity, regressor, forward dynamics and
kinematics.

Invariant: every dynamic term is linear in theta, Eq. (5), and takes theta, shape (5,), never
lengths and masses. Vectors are read by index and returned as tuples, matrices as tuples of rows
(`vectors`). Everywhere q is the joint angles, rad, qd their velocities, rad/s, g the
gravitational acceleration, m/s^2, and `lengths` those of the two links, m.

Source: "Adaptive Control of Dual User Teleoperation with Time Delay and Dynamic Uncertainty",
Eq. (1)-(5), (8), (12), (24). Angles are measured from the horizontal; the second one is
relative to the first link. Eq. (24) prints theta_5 = m2 l2, which holds only for lc2 = l2; here
it is m2 lc2.
"""

from typing import NamedTuple

import numpy as np

from .elementary import sincos
from .jit import leaf
from .vectors import Array, Five, Pair, Vector

JOINTS = 2
PARAMETERS = 5


class ArmLinks(NamedTuple):
    """Lengths, masses and inertias of the two links; `theta_from_links` turns them into theta.

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


def theta_from_links(links: ArmLinks) -> Array:
    """Returns theta, shape (5,), of Eq. (24): three inertial entries in kg m^2, two gravity
    ones in kg m.
    """
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


def is_positive_definite(theta: Array) -> bool:
    """True if M(q) is positive definite in every pose, with a margin (Property 1).

    Its determinant, theta_1 theta_3 - theta_3^2 - theta_2^2 cos^2 q_2, is least for the
    stretched arm.
    """
    least = theta[0] * theta[2] - theta[2] ** 2 - theta[1] ** 2
    return bool(theta[2] > 0.0 and least > 1e-9 * theta[0] * theta[2])


@leaf
def inertia(theta: Vector, q: Vector) -> tuple[Pair, Pair]:
    """Returns M(q), two rows, kg m^2 (Section IV of the paper; Property 1)."""
    _, c2 = sincos(q[1])
    across = theta[2] + theta[1] * c2
    return (theta[0] + 2.0 * theta[1] * c2, across), (across, theta[2])


@leaf
def gravity(theta: Vector, g: float, q: Vector) -> Pair:
    """Returns G(q), N m."""
    s1, c1 = sincos(q[0])
    s2, c2 = sincos(q[1])
    outer = theta[4] * g * (c1 * c2 - s1 * s2)
    return theta[3] * g * c1 + outer, outer


@leaf
def regressor(g: float, q: Vector, qd: Vector, v: Vector, a: Vector) -> tuple[Five, Five]:
    """Returns Y(q, qd, v, a), two rows, with Y theta = M(q) a + C(q, qd) v + G(q).

    The paper prints Y(q, qd, qdd) only; Eq. (12) needs the two velocities apart: qd enters
    through C, and v is the reference velocity that C multiplies, a the reference acceleration.
    With v = qd and a = qdd this is the printed one, Eq. (5).
    """
    s1, c1 = sincos(q[0])
    s2, c2 = sincos(q[1])
    outer = g * (c1 * c2 - s1 * s2)
    y12 = c2 * (2.0 * a[0] + a[1]) - s2 * (qd[1] * v[0] + (qd[0] + qd[1]) * v[1])
    y22 = c2 * a[0] + s2 * qd[0] * v[0]
    return (a[0], y12, a[1], g * c1, outer), (0.0, y22, a[0] + a[1], 0.0, outer)


@leaf
def forward_dynamics(theta: Vector, g: float, q: Vector, qd: Vector, torque: Vector) -> Pair:
    """Returns qdd, rad/s^2: the solution of M qdd = torque - C qd - G, Eq. (8).

    `torque` is the whole torque on the joints, tau - tau_x, N m. Written out by Cramer's rule:
    a step takes four of these, and their cost is that of the sines.
    """
    s1, c1 = sincos(q[0])
    s2, c2 = sincos(q[1])
    h = -theta[1] * s2
    outer = theta[4] * g * (c1 * c2 - s1 * s2)
    m11 = theta[0] + 2.0 * theta[1] * c2
    m12 = theta[2] + theta[1] * c2
    m22 = theta[2]
    f1 = torque[0] - h * qd[1] * (2.0 * qd[0] + qd[1]) - theta[3] * g * c1 - outer
    f2 = torque[1] + h * qd[0] * qd[0] - outer
    det = m11 * m22 - m12 * m12
    return (m22 * f1 - m12 * f2) / det, (m11 * f2 - m12 * f1) / det


@leaf
def forward_kinematics(lengths: Vector, q: Vector) -> tuple[Pair, Pair]:
    """Returns the positions of elbow and end effector, m, as (x, y), base at the origin."""
    s1, c1 = sincos(q[0])
    s12, c12 = sincos(q[0] + q[1])
    x = lengths[0] * c1
    y = lengths[0] * s1
    return (x, y), (x + lengths[1] * c12, y + lengths[1] * s12)


@leaf
def end_effector_jacobian(lengths: Vector, q: Vector) -> tuple[Pair, Pair]:
    """Returns the end effector's Jacobian, m/rad: rows x and y, columns the joints."""
    s1, c1 = sincos(q[0])
    s12, c12 = sincos(q[0] + q[1])
    outer_x = lengths[1] * c12
    outer_y = lengths[1] * s12
    return (-lengths[0] * s1 - outer_y, -outer_y), (lengths[0] * c1 + outer_x, outer_x)
