"""Dynamics, regressor and kinematics of the planar two-link arm.

Symbols: q and qd are the joint angles, rad, and velocities, rad/s; g is the gravitational
acceleration, m/s^2; `lengths` are the lengths of the two links, m; and theta holds the five
dynamic parameters, which combine masses, lengths and inertias. The regressor is the matrix
whose product with theta is the torque of the arm's dynamics. The first angle is measured from
the horizontal, the second from the first link.

Source: "Adaptive Control of Dual User Teleoperation with Time Delay and Dynamic Uncertainty",
Eq. (1)-(5), (8), (12), (24). Eq. (24) prints theta_5 = m2 l2, which holds only for lc2 = l2;
here theta_5 = m2 lc2.

Invariant:
    - The dynamic terms are linear in theta, shape (5,), Eq. (5). They do not depend on lengths
      and masses in any other way.
    - Vectors are read by index and returned as tuples. Matrices are returned as tuples of rows
      (see `vectors`).
"""

from typing import NamedTuple

import numpy as np

from ...records import JOINTS as JOINTS
from ...records import PARAMETERS as PARAMETERS
from ..step.jit import leaf
from ..step.vectors import Array, Five, Pair, Vector
from .elementary import sincos


class ArmLinks(NamedTuple):
    """Lengths, masses and inertias of the two links of a planar arm.

    These quantities can be measured on a real arm. `theta` converts them to the five parameters
    in which the equations of motion are linear.

    Attributes:
        l1_m: Length of the first link, m.
        m1_kg: Mass of the first link, kg.
        lc1_m: Distance from the first joint to the link's centre of mass, m.
        I1_kg_m2: Inertia of the first link about its centre of mass, kg m^2.
        l2_m: Length of the second link, m.
        m2_kg: Mass of the second link, kg.
        lc2_m: Distance from the second joint to the link's centre of mass, m.
        I2_kg_m2: Inertia of the second link about its centre of mass, kg m^2.
    """

    l1_m: float
    m1_kg: float
    lc1_m: float
    I1_kg_m2: float
    l2_m: float
    m2_kg: float
    lc2_m: float
    I2_kg_m2: float

    def theta(self) -> Array:
        """Returns the dynamic parameters theta of the arm, shape (5,), Eq. (24).

        The torque of the arm is linear in theta. The first three entries are inertial
        parameters, in kg m^2; the last two are gravity parameters, in kg m.
        """
        l1, m1, lc1, I1, _, m2, lc2, I2 = self
        inner_inertia = m1 * lc1**2
        outer_inertia = m2 * (l1**2 + lc2**2)
        theta_1 = inner_inertia + outer_inertia + I1 + I2
        theta_2 = m2 * l1 * lc2
        theta_3 = m2 * lc2**2 + I2
        theta_4 = m1 * lc1 + m2 * l1
        theta_5 = m2 * lc2
        return np.array([theta_1, theta_2, theta_3, theta_4, theta_5])


@leaf
def inertia(theta: Vector, q: Vector) -> tuple[Pair, Pair]:
    """Returns the inertia matrix M(q) of the planar arm as two rows, kg m^2.

    The matrix is given in Section IV of the paper:

        M = | theta_1 + 2 theta_2 cos(q2)    theta_3 + theta_2 cos(q2) |
            | theta_3 + theta_2 cos(q2)      theta_3                   |

    Args:
        theta: Parameters of the arm, shape (5,).
        q: Joint angles, rad.
    """
    _, c2 = sincos(q[1])
    m11 = theta[0] + 2.0 * theta[1] * c2
    m12 = theta[2] + theta[1] * c2
    m22 = theta[2]
    first = (m11, m12)
    second = (m12, m22)
    return first, second


@leaf
def gravity(theta: Vector, g: float, q: Vector) -> Pair:
    """Returns the torque G(q) that holds the planar arm against gravity, N m per joint.

        G = g | theta_4 cos(q1) + theta_5 cos(q1 + q2) |
              | theta_5 cos(q1 + q2)                   |

    Args:
        theta: Parameters of the arm, shape (5,).
        g: Gravitational acceleration, m/s^2.
        q: Joint angles, rad.
    """
    s1, c1 = sincos(q[0])
    s2, c2 = sincos(q[1])
    c12 = c1 * c2 - s1 * s2
    inner = theta[3] * g * c1
    outer = theta[4] * g * c12
    return inner + outer, outer


@leaf
def regressor(g: float, q: Vector, qd: Vector, v: Vector, a: Vector) -> tuple[Five, Five]:
    """Returns the regressor Y(q, qd, v, a), as two rows of five elements.

        Y theta = M(q) a + C(q, qd) v + G(q)

    The vector theta has three inertial and two gravity parameters (see `ArmLinks.theta`). With
    qi the angle of joint i, the terms of the equation of motion in these parameters are

        M = | theta_1 + 2 theta_2 cos(q2)    theta_3 + theta_2 cos(q2) |
            | theta_3 + theta_2 cos(q2)      theta_3                   |

        C = theta_2 sin(q2) | -qd2    -(qd1 + qd2) |
                            |  qd1     0           |

        G = g | theta_4 cos(q1) + theta_5 cos(q1 + q2) |
              | theta_5 cos(q1 + q2)                   |

    Column j of Y contains the factors of theta_j. The paper prints only Y(q, qd, qdd), Eq. (5),
    which is the case v = qd and a = qdd, but Eq. (12) needs the two velocities separately.

    Args:
        g: Gravitational acceleration, m/s^2.
        q: Joint angles, rad.
        qd: Joint velocities, on which C depends, rad/s.
        v: Reference velocity, which C multiplies, rad/s.
        a: Reference acceleration, which M multiplies, rad/s^2.

    Returns:
        The rows of Y for the first and the second joint.
    """
    s1, c1 = sincos(q[0])
    s2, c2 = sincos(q[1])
    c12 = c1 * c2 - s1 * s2  # cos(q1 + q2)
    a1 = a[0]
    a2 = a[1]
    outer_rate = qd[0] + qd[1]
    # The first row of C v is -theta_2 sin(q2) times this sum, the second row theta_2 times
    # `centrifugal_2`.
    coriolis_1 = qd[1] * v[0] + outer_rate * v[1]
    centrifugal_2 = s2 * qd[0] * v[0]
    # The factor of theta_2 in the first row of M a.
    inertial_1 = c2 * (2.0 * a1 + a2)
    y12 = inertial_1 - s2 * coriolis_1
    y22 = c2 * a1 + centrifugal_2
    gravity_1 = g * c1
    gravity_12 = g * c12
    first = (a1, y12, a2, gravity_1, gravity_12)
    second = (0.0, y22, a1 + a2, 0.0, gravity_12)
    return first, second


@leaf
def forward_dynamics(theta: Vector, g: float, q: Vector, qd: Vector, torque: Vector) -> Pair:
    """Computes the joint accelerations of the planar arm caused by a torque.

        qdd = M(q)^-1 (torque - C(q, qd) qd - G(q))

    M is the inertia matrix, C the Coriolis matrix and G the gravity torque.

    Args:
        theta: Dynamic parameters of the arm, shape (5,).
        g: Gravitational acceleration, m/s^2.
        q: Joint angles, rad.
        qd: Joint velocities, rad/s.
        torque: Total joint torque of motors, operators and environments, N m.

    Returns:
        The accelerations qdd of the two joints, rad/s^2.
    """
    s1, c1 = sincos(q[0])
    s2, c2 = sincos(q[1])
    c12 = c1 * c2 - s1 * s2
    qd1 = qd[0]
    qd2 = qd[1]
    m11 = theta[0] + 2.0 * theta[1] * c2
    m12 = theta[2] + theta[1] * c2
    m22 = theta[2]
    h = -theta[1] * s2  # the factor of all terms of C
    coriolis_1 = h * qd2 * (2.0 * qd1 + qd2)
    # The gravity torques: both act on the first joint, only `outer` on the second.
    inner = theta[3] * g * c1
    outer = theta[4] * g * c12
    # The torques that accelerate the arm.
    f1 = torque[0] - coriolis_1 - inner - outer
    centrifugal_2 = h * qd1 * qd1
    f2 = torque[1] + centrifugal_2 - outer
    # Cramer's rule for M qdd = f.
    determinant = m11 * m22 - m12 * m12
    qdd1 = (m22 * f1 - m12 * f2) / determinant
    qdd2 = (m11 * f2 - m12 * f1) / determinant
    return qdd1, qdd2


@leaf
def forward_kinematics(lengths: Vector, q: Vector) -> tuple[Pair, Pair]:
    """Returns the positions of the elbow and the end effector of the planar arm, m.

    The origin is the shoulder, with x to the right and y up. If both angles are 0, the arm is
    stretched out along x.

    Args:
        lengths: Lengths of the two links, m.
        q: Joint angles, rad.

    Returns:
        The position (x, y) of the elbow, and the position of the end effector, m.
    """
    s1, c1 = sincos(q[0])
    s12, c12 = sincos(q[0] + q[1])
    elbow_x = lengths[0] * c1
    elbow_y = lengths[0] * s1
    x = elbow_x + lengths[1] * c12
    y = elbow_y + lengths[1] * s12
    elbow = (elbow_x, elbow_y)
    end_effector = (x, y)
    return elbow, end_effector


@leaf
def end_effector_jacobian(lengths: Vector, q: Vector) -> tuple[Pair, Pair]:
    """Returns the Jacobian J of the planar arm's end effector, as two rows.

    J qd is the velocity of the end effector (m/s) for joint velocities qd (rad/s), and J' F is
    the joint torque equivalent to a force F at the end effector.

    Args:
        lengths: Lengths of the two links, m.
        q: Joint angles, rad.

    Returns:
        The rows for x and y, with one column per joint, m/rad.
    """
    s1, c1 = sincos(q[0])
    s12, c12 = sincos(q[0] + q[1])
    inner_x = lengths[0] * c1
    outer_x = lengths[1] * c12
    outer_y = lengths[1] * s12
    x_by_first = -lengths[0] * s1 - outer_y
    y_by_first = inner_x + outer_x
    row_x = (x_by_first, -outer_y)
    row_y = (y_by_first, outer_x)
    return row_x, row_y
