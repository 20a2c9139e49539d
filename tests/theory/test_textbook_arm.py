"""The textbook matrices against the arm of physical bodies, and against each other."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core import physical_arms as physics
from tests.core.physical_arms import angles, links, speeds
from tests.theory.loops import Array
from trilat_net.core.two_link_arm import ArmLinks, theta_from_links
from trilat_net.theory import textbook_arm


@given(a=links, q=angles, qd=speeds, v=speeds, acc=speeds)
def test_they_are_those_of_two_bodies(a: ArmLinks, q: Array, qd: Array, v: Array, acc: Array) -> None:
    theta = theta_from_links(a)
    scale = 1e-12 * (1.0 + 1e4 * theta.sum())
    assert textbook_arm.inertia_matrix(theta, q) == pytest.approx(physics.inertia(a, q), abs=scale)
    assert textbook_arm.coriolis_matrix(theta, q, qd) == pytest.approx(physics.coriolis(a, q, qd), abs=scale)
    assert textbook_arm.gravity_torque(theta, 9.81, q) == pytest.approx(
        physics.gravity(a, 9.81, q), abs=scale
    )
    torque = textbook_arm.required_torque(theta, 9.81, q, qd, v, acc)
    assert textbook_arm.regressor_matrix(9.81, q, qd, v, acc) @ theta == pytest.approx(torque, abs=scale)


@given(a=links, q=angles, qd=speeds, torque=speeds)
def test_the_acceleration_needs_the_torque(a: ArmLinks, q: Array, qd: Array, torque: Array) -> None:
    theta = theta_from_links(a)
    qdd = textbook_arm.joint_acceleration(theta, 9.81, q, qd, torque)
    needed = textbook_arm.required_torque(theta, 9.81, q, qd, qd, qdd)
    assert needed == pytest.approx(torque, abs=1e-9 * (1.0 + np.abs(qdd).max() * theta.sum()))


@given(seed=st.integers(0, 2**32 - 1))
def test_columns_are_arms_of_their_own(seed: int) -> None:
    """Many states in one call are as many calls."""
    rng = np.random.default_rng(seed)
    theta = np.array([3.0, 1.0, 1.0, 2.0, 1.0])
    q, qd, torque = rng.normal(size=(3, 2, 4))
    each = np.zeros(4) + theta[:, None]
    found = textbook_arm.joint_acceleration(each, 9.81, q, qd, torque)
    for n in range(4):
        assert found[:, n] == pytest.approx(
            textbook_arm.joint_acceleration(theta, 9.81, q[:, n], qd[:, n], torque[:, n])
        )


@given(q=angles, qd=speeds)
def test_the_tip_moves_as_its_jacobian_says(q: Array, qd: Array) -> None:
    lengths_m, step = (0.7, 1.2), 1e-30
    moved = textbook_arm.end_effector_position(lengths_m, q + 1j * step * qd).imag / step
    assert textbook_arm.position_jacobian(lengths_m, q) @ qd == pytest.approx(
        moved, abs=1e-12 * (1 + np.abs(qd).max())
    )
