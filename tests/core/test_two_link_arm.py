"""Properties of the arm, Eq. (1)-(5), (12), (24), against its masses and where they are."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core import physical_arms as physics
from tests.core.physical_arms import Array, angles, links, speeds
from trilat_net.core.arms import two_link_arm
from trilat_net.core.arms.two_link_arm import ArmLinks

g_values = st.sampled_from([0.0, 1.62, 9.81])


def M_of(theta: Array, q: Array) -> Array:
    return np.array(two_link_arm.inertia(theta, q))


def C_of(theta: Array, q: Array, qd: Array) -> Array:
    """Returns C(q, qd), column by column: Y(q, qd, v, 0) theta without gravity is C v."""
    return np.column_stack([Y_of(0.0, q, qd, v, np.zeros(2)) @ theta for v in np.eye(2)])


def G_of(theta: Array, g: float, q: Array) -> Array:
    return np.array(two_link_arm.gravity(theta, g, q))


def Y_of(g: float, q: Array, qd: Array, v: Array, a: Array) -> Array:
    return np.array(two_link_arm.regressor(g, q, qd, v, a))


def is_near(a: Array, b: Array, scale: float) -> bool:
    return bool(np.abs(np.asarray(a) - b).max() <= 1e-13 * (1.0 + scale))


def measure_size(a: ArmLinks) -> float:
    """Returns an upper bound of the entries of theta."""
    return float(np.abs(a.theta()).sum())


def test_theta_of_the_two_readings() -> None:
    """Eq. (24): point masses at the link ends, and uniform rods."""
    point = ArmLinks(1, 1, 1, 0, 1, 1, 1, 0)
    third = 1 / 12
    rods = ArmLinks(1, 1, 0.5, third, 1, 1, 0.5, third)
    assert point.theta().tolist() == [3, 1, 1, 2, 1]
    assert rods.theta() == pytest.approx([5 / 3, 1 / 2, 1 / 3, 3 / 2, 1 / 2])


@given(a=links)
def test_theta_2_is_l1_times_theta_5(a: ArmLinks) -> None:
    """Eq. (24) has five parameters and four of them are independent; theta_5 is m2 lc2."""
    theta = a.theta()
    assert theta[1] == pytest.approx(a.l1_m * theta[4], rel=1e-14)
    assert theta[4] == a.m2_kg * a.lc2_m


@given(a=links, q=angles)
def test_the_inertia_is_symmetric_and_positive_definite(a: ArmLinks, q: Array) -> None:
    """Property 1."""
    M = M_of(a.theta(), q)
    assert M[0, 1] == M[1, 0]
    assert M[0, 0] > 0
    assert np.linalg.det(M) > 0


@given(a=links, q=angles, qd=speeds)
def test_the_inertia_gives_the_masses_energy(a: ArmLinks, q: Array, qd: Array) -> None:
    M = M_of(a.theta(), q)
    energy = physics.kinetic(a, q, qd)
    assert 0.5 * qd @ M @ qd == pytest.approx(energy, rel=1e-11, abs=1e-12 * measure_size(a))
    assert is_near(M, physics.inertia(a, q), measure_size(a))


@given(a=links, q=angles, qd=speeds)
def test_the_coriolis_matrix_uses_christoffel_symbols(a: ArmLinks, q: Array, qd: Array) -> None:
    assert is_near(C_of(a.theta(), q, qd), physics.coriolis(a, q, qd), 20 * measure_size(a))


@given(a=links, g=g_values, q=angles)
def test_gravity_is_the_gradient_of_the_potential_energy(
    a: ArmLinks, g: float, q: Array
) -> None:
    assert is_near(G_of(a.theta(), g, q), physics.gravity(a, g, q), g * measure_size(a))


@given(a=links, q=angles, qd=speeds, x=speeds)
def test_mdot_minus_two_c_is_skew(a: ArmLinks, q: Array, qd: Array, x: Array) -> None:
    """Eq. (4), with Mdot as the exact derivative of the masses' inertia along qd."""
    Mdot = physics.inertia_rates(a, q) @ qd
    S = Mdot - 2.0 * C_of(a.theta(), q, qd)
    assert abs(x @ S @ x) <= 1e-13 * (1 + measure_size(a)) * (1 + np.abs(qd).sum()) * (
        1 + x @ x
    )


@given(a=links, g=g_values, q=angles, qd=speeds, v=speeds, acceleration=speeds)
def test_the_regressor_separates_the_two_velocities(
    a: ArmLinks, g: float, q: Array, qd: Array, v: Array, acceleration: Array
) -> None:
    """Eq. (12): Y(q, qd, v, a) theta = M a + C(q, qd) v + G."""
    theta = a.theta()
    wanted = (
        physics.inertia(a, q) @ acceleration
        + physics.coriolis(a, q, qd) @ v
        + physics.gravity(a, g, q)
    )
    assert is_near(Y_of(g, q, qd, v, acceleration) @ theta, wanted, 1000 * measure_size(a))


@given(g=g_values, q=angles, qd=speeds, qdd=speeds)
def test_with_one_velocity_the_regressor_is_printed(
    g: float, q: Array, qd: Array, qdd: Array
) -> None:
    """Eq. (5), with Y12 and Y22 as Section IV prints them."""
    Y = Y_of(g, q, qd, qd, qdd)
    s2 = math.sin(q[1])
    c2 = math.cos(q[1])
    y12 = c2 * (2 * qdd[0] + qdd[1]) - s2 * qd[1] * qd[1] - 2 * s2 * qd[0] * qd[1]
    assert Y[0, 1] == pytest.approx(y12, abs=1e-11)
    assert Y[1, 1] == pytest.approx(c2 * qdd[0] + s2 * qd[0] * qd[0], abs=1e-11)


@given(a=links, g=g_values, q=angles, qd=speeds, torque=physics.vectors(st.floats(-200, 200)))
def test_forward_dynamics_solve_the_equation_of_motion(
    a: ArmLinks, g: float, q: Array, qd: Array, torque: Array
) -> None:
    """Eq. (8): M qdd + C qd + G = tau - tau_x."""
    qdd = np.array(two_link_arm.forward_dynamics(a.theta(), g, q, qd, torque))
    M = physics.inertia(a, q)
    rest = M @ qdd + physics.coriolis(a, q, qd) @ qd + physics.gravity(a, g, q) - torque
    terms = np.abs(M).max() * np.abs(qdd).max() + 400 * measure_size(a) + 200
    assert np.abs(rest).max() <= 1e-12 * terms * np.linalg.cond(M)


@given(a=links, q=angles)
def test_the_tip_follows_from_the_links(a: ArmLinks, q: Array) -> None:
    xy = np.array(two_link_arm.forward_kinematics((a.l1_m, a.l2_m), q))
    ends = physics.centres(a._replace(lc1_m=a.l1_m, lc2_m=a.l2_m), q)
    assert is_near(xy, np.array(ends), 10.0)
