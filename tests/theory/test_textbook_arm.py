"""The textbook matrices against the arm of physical bodies, and against each other.

The chain in plain NumPy against Pinocchio's numbers, the planar arm, and the compiled leaves.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.core import physical_arms as physics
from tests.core.chain_references import chain_references, find_largest_difference
from tests.core.physical_arms import angles, links, speeds
from tests.theory.loops import Array
from trilat_net.analysis.arm_rows import PlacedArm
from trilat_net.analysis.theory.textbook_arm import PlacedChain
from trilat_net.core.arms.chain import ChainJoint, build_chain, find_acceleration, place_joints
from trilat_net.core.arms.two_link_arm import ArmLinks
from trilat_net.core.step.site_setup import ChainSetup


def place_arm(q: Array) -> PlacedArm:
    return PlacedArm(9.81, (0.7, 1.2), q)


@given(a=links, q=angles, qd=speeds, v=speeds, acc=speeds)
def test_matrices_are_those_of_two_bodies(
    a: ArmLinks, q: Array, qd: Array, v: Array, acc: Array
) -> None:
    theta = a.theta()
    scale = 1e-12 * (1.0 + 1e4 * theta.sum())
    assert place_arm(q).inertia_matrix(theta) == pytest.approx(physics.inertia(a, q), abs=scale)
    assert place_arm(q).coriolis_matrix(theta, qd) == pytest.approx(
        physics.coriolis(a, q, qd), abs=scale
    )
    assert place_arm(q).gravity_torque(theta) == pytest.approx(
        physics.gravity(a, 9.81, q), abs=scale
    )
    torque = place_arm(q).required_torque(theta, qd, v, acc)
    assert place_arm(q).regressor_matrix(qd, v, acc) @ theta == pytest.approx(torque, abs=scale)


@given(a=links, q=angles, qd=speeds, torque=speeds)
def test_the_acceleration_needs_the_torque(
    a: ArmLinks, q: Array, qd: Array, torque: Array
) -> None:
    theta = a.theta()
    qdd = place_arm(q).joint_acceleration(theta, qd, torque)
    needed = place_arm(q).required_torque(theta, qd, qd, qdd)
    assert needed == pytest.approx(torque, abs=1e-9 * (1.0 + np.abs(qdd).max() * theta.sum()))


@given(seed=st.integers(0, 2**32 - 1))
def test_columns_are_separate_arms(seed: int) -> None:
    """Many states in one call equal as many calls."""
    rng = np.random.default_rng(seed)
    theta = np.array([3.0, 1.0, 1.0, 2.0, 1.0])
    q, qd, torque = rng.normal(size=(3, 2, 4))
    each = np.zeros(4) + theta[:, None]
    accelerations = place_arm(q).joint_acceleration(each, qd, torque)
    for n in range(4):
        assert accelerations[:, n] == pytest.approx(
            place_arm(q[:, n]).joint_acceleration(theta, qd[:, n], torque[:, n])
        )


@given(q=angles, qd=speeds)
def test_the_tip_moves_as_its_jacobian_says(q: Array, qd: Array) -> None:
    step = 1e-30
    moved = place_arm(q + 1j * step * qd).end_effector_position().imag / step
    assert place_arm(q).position_jacobian() @ qd == pytest.approx(
        moved, abs=1e-12 * (1 + np.abs(qd).max())
    )


REFERENCES = chain_references()
each = pytest.mark.parametrize("name", REFERENCES)
DRIVE = {"armature_kg_m2": 0.1, "viscous": 0.5, "coulomb": 1.5, "lower": -0.5, "upper": 0.5}
STOPS = {"stop_stiffness": 200.0, "stop_damping": 2.0}


def make_chain_setup(name: str, gravity: Array, **drive: float) -> ChainSetup:
    read = REFERENCES[name].chain
    joints = [
        ChainJoint(
            joint.kind == "prismatic", joint.axis, joint.rotation, joint.origin_m, **drive
        )
        for joint in read.joints
    ]
    return ChainSetup(tuple(joints), tuple(gravity), read.tip_origin_m)


def read_parameters(name: str) -> Array:
    return np.concatenate([joint.inertia for joint in REFERENCES[name].chain.joints])


@each
def test_dynamics_and_kinematics_are_those_of_pinocchio(name: str) -> None:
    theta = read_parameters(name)
    for state in REFERENCES[name].states:
        placed = PlacedChain(make_chain_setup(name, state.gravity), state.q)
        torque = placed.required_torque(theta, state.qd, state.v, state.a)
        Y = placed.regressor_matrix(state.qd, state.v, state.a)
        qdd = placed.joint_acceleration(theta, state.qd, state.tau)
        M = placed.inertia_matrix(theta)
        assert find_largest_difference(torque, state.inverse_dynamics) <= 1e-12
        assert find_largest_difference(Y.T @ state.r, state.regressor_transpose_r) <= 1e-12
        assert find_largest_difference(M, state.inertia) <= 1e-12
        assert find_largest_difference(qdd, state.forward_dynamics) <= 100 * np.finfo(
            float
        ).eps * np.linalg.cond(M)
        assert (
            find_largest_difference(placed.end_effector_position(), state.tip_position) <= 1e-12
        )
        assert find_largest_difference(placed.position_jacobian(), state.jacobian[:3]) <= 1e-12


def test_columns_are_separate_chains() -> None:
    """Many states in one call equal as many calls, and a complex step is the limit of differences."""
    first, second, _ = REFERENCES["arm7"].states
    setup = make_chain_setup("arm7", first.gravity, **DRIVE, **STOPS)
    theta = read_parameters("arm7")

    def acceleration(q: Array, qd: Array, tau: Array, theta: Array) -> Array:
        return PlacedChain(setup, q).joint_acceleration(theta, qd, tau)

    both = [np.stack(pair, axis=1) for pair in ((first.q, second.q), (first.qd, second.qd))]
    accelerations = acceleration(
        *both, np.stack([first.tau, second.tau], axis=1), np.stack([theta, theta], axis=1)
    )
    for n, state in enumerate((first, second)):
        assert (
            find_largest_difference(
                accelerations[:, n], acceleration(state.q, state.qd, state.tau, theta)
            )
            <= 1e-12
        )
    for k in range(7):
        off = 1e-6 * np.eye(7)[k]
        ahead, behind = (
            acceleration(first.q + way * off, first.qd, first.tau, theta) for way in (1, -1)
        )
        exact = acceleration(first.q + 1e-24j * off, first.qd, first.tau, theta).imag / 1e-30
        assert find_largest_difference(exact, (ahead - behind) / 2e-6) <= 1e-6


@pytest.mark.parametrize("name", ["random3", "arm7"])
def test_drives_and_stops_equal_compiled_leaves(name: str) -> None:
    for state in REFERENCES[name].states:
        setup = make_chain_setup(name, state.gravity, **DRIVE, **STOPS)
        theta = read_parameters(name)
        rows = build_chain(setup.joints, 12)
        qdd = np.zeros(len(state.q))
        place_joints(rows, state.q)
        find_acceleration(rows, theta, state.gravity, state.q, state.qd, state.tau, qdd)
        acceleration = PlacedChain(setup, state.q).joint_acceleration(
            theta, state.qd, state.tau
        )
        assert find_largest_difference(acceleration, qdd) <= 1e-11


def test_planar_arms_are_two_joint_chains() -> None:
    """Rods of different lengths, hung on z axes in the x-y plane."""
    l1 = 0.7
    m1 = 1.3
    l2 = 1.1
    m2 = 0.8
    g = 9.81
    outer = m2 * l2 * l2 / 3.0
    axis = (0.0, 0.0, 1.0)
    upright = tuple(map(tuple, np.eye(3).tolist()))
    inner = m1 * l1 * l1 / 3.0 + m2 * l1 * l1 + outer
    theta = np.array([inner, m2 * l1 * l2 / 2.0, outer, m1 * l1 / 2.0 + m2 * l1, m2 * l2 / 2.0])
    bodies = [
        (m, m * half, 0.0, 0.0, 0.0, 0.0, thirds, 0.0, 0.0, thirds)
        for m, half, thirds in ((m1, l1 / 2.0, m1 * l1 * l1 / 3.0), (m2, l2 / 2.0, outer))
    ]
    joints = tuple(ChainJoint(False, axis, upright, (x, 0.0, 0.0)) for x in (0.0, l1))
    q, qd, v, a = np.random.default_rng(5).normal(size=(4, 2, 6))
    planar = PlacedArm(g, (l1, l2), q)
    placed = PlacedChain(ChainSetup(joints, (0.0, -g, 0.0), (l2, 0.0, 0.0)), q)
    of_chain, of_arm = (
        np.outer(values, np.ones(6)) for values in (np.concatenate(bodies), theta)
    )
    assert (
        find_largest_difference(
            placed.required_torque(of_chain, qd, v, a), planar.required_torque(of_arm, qd, v, a)
        )
        <= 1e-12
    )
    assert (
        find_largest_difference(placed.gravity_torque(of_chain), planar.gravity_torque(of_arm))
        <= 1e-12
    )
    assert (
        find_largest_difference(placed.position_jacobian()[:2], planar.position_jacobian())
        <= 1e-12
    )
