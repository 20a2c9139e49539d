"""The textbook matrices against the arm of physical bodies, and against each other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core import physical_arms as physics
from tests.core.physical_arms import angles, links, speeds
from tests.theory.loops import Array
from trilat_net.analysis.arm_rows import PlacedArm
from trilat_net.core.two_link_arm import ArmLinks, theta_from_links


def placed(q: Array) -> PlacedArm:
    return PlacedArm(9.81, (0.7, 1.2), q)


@given(a=links, q=angles, qd=speeds, v=speeds, acc=speeds)
def test_they_are_those_of_two_bodies(a: ArmLinks, q: Array, qd: Array, v: Array, acc: Array) -> None:
    theta = theta_from_links(a)
    scale = 1e-12 * (1.0 + 1e4 * theta.sum())
    assert placed(q).inertia_matrix(theta) == pytest.approx(physics.inertia(a, q), abs=scale)
    assert placed(q).coriolis_matrix(theta, qd) == pytest.approx(physics.coriolis(a, q, qd), abs=scale)
    assert placed(q).gravity_torque(theta) == pytest.approx(physics.gravity(a, 9.81, q), abs=scale)
    torque = placed(q).required_torque(theta, qd, v, acc)
    assert placed(q).regressor_matrix(qd, v, acc) @ theta == pytest.approx(torque, abs=scale)


@given(a=links, q=angles, qd=speeds, torque=speeds)
def test_the_acceleration_needs_the_torque(a: ArmLinks, q: Array, qd: Array, torque: Array) -> None:
    theta = theta_from_links(a)
    qdd = placed(q).joint_acceleration(theta, qd, torque)
    needed = placed(q).required_torque(theta, qd, qd, qdd)
    assert needed == pytest.approx(torque, abs=1e-9 * (1.0 + np.abs(qdd).max() * theta.sum()))


@given(seed=st.integers(0, 2**32 - 1))
def test_columns_are_arms_of_their_own(seed: int) -> None:
    """Many states in one call are as many calls."""
    rng = np.random.default_rng(seed)
    theta = np.array([3.0, 1.0, 1.0, 2.0, 1.0])
    q, qd, torque = rng.normal(size=(3, 2, 4))
    each = np.zeros(4) + theta[:, None]
    found = placed(q).joint_acceleration(each, qd, torque)
    for n in range(4):
        assert found[:, n] == pytest.approx(placed(q[:, n]).joint_acceleration(theta, qd[:, n], torque[:, n]))


@given(q=angles, qd=speeds)
def test_the_tip_moves_as_its_jacobian_says(q: Array, qd: Array) -> None:
    step = 1e-30
    moved = placed(q + 1j * step * qd).end_effector_position().imag / step
    assert placed(q).position_jacobian() @ qd == pytest.approx(moved, abs=1e-12 * (1 + np.abs(qd).max()))
