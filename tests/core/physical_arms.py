"""Physical arms drawn at random, and their dynamics derived again from the positions of the
masses.

The only import from `trilat_net.core.arm` is the type that names lengths and masses.
"""

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from trilat_net.core.arms.two_link_arm import ArmLinks

Array = NDArray[np.float64]

positive = st.floats(0.05, 5.0)
links = st.builds(
    ArmLinks,
    l1_m=positive,
    m1_kg=positive,
    lc1_m=positive,  # a massless first link would make M singular where the arm is straight
    I1_kg_m2=st.floats(0.0, 5.0),
    l2_m=positive,
    m2_kg=positive,
    lc2_m=positive,
    I2_kg_m2=st.floats(0.0, 5.0),
)
angle = st.floats(-7.0, 7.0)
speed = st.floats(-10.0, 10.0)


def vectors(entry: st.SearchStrategy[float]) -> st.SearchStrategy[Array]:
    return st.tuples(entry, entry).map(np.array)


angles = vectors(angle)
speeds = vectors(speed)
STEP = 1e-30


def centres(a: ArmLinks, q: NDArray) -> list[NDArray]:
    """Returns the centres of mass, in the vertical plane; q may be complex."""
    first = q[0]
    both = q[0] + q[1]
    elbow = a.l1_m * np.array([np.cos(first), np.sin(first)])
    first_centre = a.lc1_m * np.array([np.cos(first), np.sin(first)])
    return [first_centre, elbow + a.lc2_m * np.array([np.cos(both), np.sin(both)])]


def kinetic(a: ArmLinks, q: Array, qd: Array) -> float:
    """Returns the energy of the moving masses; their velocities by complex step along qd."""
    first, two = (centre.imag / STEP for centre in centres(a, q + 1j * STEP * qd))
    spin = a.I1_kg_m2 * qd[0] ** 2 + a.I2_kg_m2 * (qd[0] + qd[1]) ** 2
    return float(0.5 * (a.m1_kg * first @ first + a.m2_kg * two @ two + spin))


def potential(a: ArmLinks, g: float, q: NDArray) -> NDArray:
    first, two = centres(a, q)
    return g * (a.m1_kg * first[1] + a.m2_kg * two[1])


def gravity(a: ArmLinks, g: float, q: Array) -> Array:
    """Returns the gradient of the potential energy, by complex step."""
    return np.array([potential(a, g, q + 1j * STEP * axis).imag / STEP for axis in np.eye(2)])


def inertia(a: ArmLinks, q: NDArray) -> NDArray:
    """Returns the sum of m J'J and I, with the Jacobians of the centres of mass; q may be complex."""
    s1 = np.sin(q[0])
    c1 = np.cos(q[0])
    s12 = np.sin(q[0] + q[1])
    c12 = np.cos(q[0] + q[1])
    J1 = a.lc1_m * np.array([[-s1, 0 * s1], [c1, 0 * s1]])
    J2 = np.array(
        [
            [-a.l1_m * s1 - a.lc2_m * s12, -a.lc2_m * s12],
            [a.l1_m * c1 + a.lc2_m * c12, a.lc2_m * c12],
        ]
    )
    spins = np.array([[a.I1_kg_m2 + a.I2_kg_m2, a.I2_kg_m2], [a.I2_kg_m2, a.I2_kg_m2]])
    return a.m1_kg * J1.T @ J1 + a.m2_kg * J2.T @ J2 + spins


def inertia_rates(a: ArmLinks, q: Array) -> Array:
    """Returns dM/dq_k, shape (2, 2, 2) with k last, by complex step."""
    return np.stack(
        [inertia(a, q + 1j * STEP * axis).imag / STEP for axis in np.eye(2)], axis=-1
    )


def coriolis(a: ArmLinks, q: Array, qd: Array) -> Array:
    """Returns C(q, qd) by Christoffel symbols of the first kind."""
    D = inertia_rates(a, q)
    symbols = 0.5 * (D + D.transpose(0, 2, 1) - D.transpose(2, 0, 1))
    return np.einsum("ijk,k->ij", symbols, qd)
