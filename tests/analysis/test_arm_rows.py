"""Arms over rows: chains against Pinocchio's numbers and finite differences; the planar arm as a chain."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.core.chain_references import chain_references
from trilat_net.analysis.arm_rows import HANGING_RAD, ArmRows, ChainArmRows, PlanarArmRows
from trilat_net.analysis.base_parameters import (
    find_base_parameters,
    find_consistent_links,
    find_pseudo_inertias,
    stack_regressors,
)
from trilat_net.core.arms.chain import ChainJoint, build_chain, find_acceleration, place_joints
from trilat_net.core.step.site_setup import ChainSetup
from trilat_net.scenario.arms import Arm, Task, build_arm

Array = NDArray[np.float64]
REFERENCES = chain_references()
each = pytest.mark.parametrize("name", REFERENCES)


def _hangs(arm: ArmRows, pose: Sequence[float] | np.ndarray) -> bool:
    return arm.hanging_angle(np.array(pose)) < HANGING_RAD


def chain_of(name: str, **drive: float) -> ChainArmRows:
    """Returns a reference's chain with gravity along its z axis."""
    chain = REFERENCES[name].chain
    joints = tuple(
        ChainJoint(
            joint.kind == "prismatic", joint.axis, joint.rotation, joint.origin_m, **drive
        )
        for joint in chain.joints
    )
    theta = np.concatenate([joint.inertia for joint in chain.joints])
    return ChainArmRows(theta, ChainSetup(joints, (0.0, 0.0, -9.81), chain.tip_origin_m))


def draw_rows(joints: int, rows: int = 5) -> list[Array]:
    return list(np.random.default_rng(joints).normal(size=(4, rows, joints)))


@each
def test_torque_inertia_gradient_and_tip_equal_pinocchios(name: str) -> None:
    arm = chain_of(name)
    for state in REFERENCES[name].states:
        placed_arm = arm._replace(
            chain=arm.chain._replace(gravity_m_s2=tuple(state.gravity.tolist()))
        )
        q, qd, v, a, r = (x[np.newaxis] for x in (state.q, state.qd, state.v, state.a, state.r))
        torque = placed_arm.law_torque(arm.theta[np.newaxis], q, qd, v, a)[0]
        np.testing.assert_allclose(
            torque, state.inverse_dynamics, atol=1e-12 * (1 + np.abs(torque).max())
        )
        gradient = placed_arm.gradient(q, qd, v, a, r)[0]
        np.testing.assert_allclose(gradient, state.regressor_transpose_r, atol=1e-11)
        np.testing.assert_allclose(
            arm.multiply_inertia(q, a)[0], state.inertia @ state.a, atol=1e-12
        )
        tip = arm.place_end_effector(q, qd)
        np.testing.assert_allclose(tip.position[0], state.tip_position, atol=1e-12)
        np.testing.assert_allclose(tip.J[0], state.jacobian[:3], atol=1e-12)
        np.testing.assert_allclose(tip.speed[0], state.jacobian[:3] @ state.qd, atol=1e-11)


@each
def test_the_slope_of_the_potential_energy_is_gravity(name: str) -> None:
    arm = chain_of(name)
    n = len(arm.chain.joints)
    step = 1e-5
    q = draw_rows(n, 1)[0]
    poses = q + step * np.vstack([np.eye(n), -np.eye(n)])
    up, down = np.split(arm.potential_energy(poses), 2)
    np.testing.assert_allclose((up - down) / (2 * step), arm.gravity_torque(q)[0], atol=2e-8)


def test_friction_and_stops_equal_the_cores() -> None:
    """M qdd changes by friction and stops, and by nothing else."""
    drive = {"viscous": 0.4, "coulomb": 1.2}
    stop = {"lower": -0.5, "upper": 0.5, "stop_stiffness": 800.0, "stop_damping": 9.0}
    rough = chain_of("arm6", **drive, **stop)
    smooth = chain_of("arm6")
    q, qd, torque, _ = draw_rows(6, 20)
    qd[0] *= 1e-3  # within the smooth part of Coulomb's friction
    forces = []
    for arm in (rough, smooth):
        rows = build_chain(arm.chain.joints)
        qdd = np.zeros_like(q)
        for k in range(len(q)):
            place_joints(rows, q[k])
            find_acceleration(rows, arm.theta, np.zeros(3), q[k], qd[k], torque[k], qdd[k])
        forces.append(smooth.multiply_inertia(q, qdd))
    resistance = rough.stop_torque(q, qd) - rough.friction(qd)
    assert (rough.stop_torque(q, qd) != 0.0).any(axis=0).all()
    np.testing.assert_allclose(resistance, forces[0] - forces[1], atol=1e-10)


def test_the_planar_arm_equals_its_chain() -> None:
    arm = Arm(l1_m=0.8, m1_kg=1.5, lc1_m=0.3, I1_kg_m2=0.05, l2_m=0.6, m2_kg=0.7, lc2_m=0.25)
    model = build_arm(arm, Task(), {}, chains=True)
    assert model.chain is not None
    theta = build_arm(arm, Task(), {}, chains=False).theta
    plane = PlanarArmRows(theta, 9.81, (0.8, 0.6))
    chain = ChainArmRows(model.theta, model.chain)
    q, qd, v, a = draw_rows(2)
    np.testing.assert_allclose(plane.gravity_torque(q), chain.gravity_torque(q), atol=1e-12)
    np.testing.assert_allclose(
        plane.multiply_inertia(q, a), chain.multiply_inertia(q, a), atol=1e-12
    )
    theirs = chain.law_torque(model.theta[np.newaxis], q, qd, v, a)
    np.testing.assert_allclose(
        plane.law_torque(np.tile(theta, (len(q), 1)), q, qd, v, a), theirs, atol=1e-12
    )
    ours = plane.place_end_effector(q, qd)
    theirs = chain.place_end_effector(q, qd)
    np.testing.assert_allclose(ours.position, theirs.position[:, :2], atol=1e-12)
    np.testing.assert_allclose(ours.J, theirs.J[:, :2], atol=1e-12)
    energies = plane.potential_energy(q), chain.potential_energy(q)
    np.testing.assert_allclose(np.diff(energies[0]), np.diff(energies[1]), atol=1e-12)
    judged = [
        ((-np.pi / 2, 0.1), True),
        ((-1.4, -0.1), True),
        ((0.0, 0.0), False),
        ((1.6, 0.1), False),
    ]
    for pose, hangs in judged:
        assert _hangs(plane, pose) is _hangs(chain, pose) is hangs


def test_arms_hang_near_their_least_potential_energy() -> None:
    """The links of a UR5 point along -x of their frames: shoulder_lift at +90 degrees is straight down."""
    arm = chain_of("arm6")
    down = np.array([0.4, 0.5 * np.pi, 0.0, 0.0, 0.0, 1.0])
    poses = np.random.default_rng(2).uniform(-np.pi, np.pi, (5000, 6))
    assert arm.potential_energy(down[np.newaxis])[0] < arm.potential_energy(poses).min() + 2.0
    assert _hangs(arm, down)
    assert not _hangs(arm, -down)
    assert not _hangs(arm, [0.0, -1.1, 1.0, -0.4, 0.3, 0.1])
    lying = arm._replace(chain=arm.chain._replace(gravity_m_s2=(0.0, 0.0, 0.0)))
    assert not _hangs(lying, down)


@pytest.mark.parametrize(("name", "count"), [("random2", 10), ("arm6", 36), ("arm7", 43)])
def test_base_parameters_count_the_regressors_rank(name: str, count: int) -> None:
    """36 of a UR5 is the number by Pinocchio's regressors; the rank by SVD of other states agrees."""
    arm = chain_of(name)
    base = find_base_parameters(arm, np.ones(len(arm.theta), dtype=np.bool_))
    assert len(base.kept) == count == np.linalg.matrix_rank(stack_regressors(arm, 77), tol=1e-7)
    np.testing.assert_array_equal(base.combination[:, base.kept], np.eye(count))


@each
def test_base_parameters_omit_only_torque_free_combinations(name: str) -> None:
    """Pinocchio's Y'r has no part that is orthogonal to the rows of the combination."""
    arm = chain_of(name)
    B = find_base_parameters(arm, np.ones(len(arm.theta), dtype=np.bool_)).combination
    for state in REFERENCES[name].states:
        # another direction of gravity excites other parameters of the first link
        if np.any(state.gravity[:2]):
            continue
        Yr = state.regressor_transpose_r
        left = Yr - B.T @ np.linalg.lstsq(B.T, Yr, rcond=None)[0]
        assert np.abs(left).max() <= 1e-9 * (1.0 + np.abs(Yr).max())
    null = np.random.default_rng(3).normal(size=len(arm.theta))
    null -= B.T @ np.linalg.lstsq(B.T, null, rcond=None)[0]
    q, qd, v, a = draw_rows(len(arm.chain.joints))
    assert np.abs(arm.law_torque(null[np.newaxis], q, qd, v, a)).max() <= 1e-8


def test_fixed_parameters_join_no_combination() -> None:
    arm = chain_of("arm6")
    learnt = np.arange(60) % 10 < 4
    base = find_base_parameters(arm, learnt)
    assert learnt[base.kept].all()
    assert not base.combination[:, ~learnt].any()


def combine_masses(places: Array, masses: Array) -> Array:
    """Returns ten parameters of point masses."""
    m = masses.sum()
    mc = masses @ places
    inertia = np.sum(
        [
            w * ((p @ p) * np.eye(3) - np.outer(p, p))
            for w, p in zip(masses, places, strict=True)
        ],
        axis=0,
    )
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = inertia
    return np.array([m, *mc, xx, xy, yy, xz, yz, zz])


def test_a_negative_mass_is_inconsistent() -> None:
    random = np.random.default_rng(4)
    places = random.normal(size=(6, 3))
    masses = random.uniform(0.5, 2.0, 6)
    sound = combine_masses(places, masses)
    homogeneous = np.column_stack([places, np.ones(6)])
    wanted = (masses * homogeneous.T) @ homogeneous
    np.testing.assert_allclose(find_pseudo_inertias(sound)[0], wanted, atol=1e-12)
    assert find_consistent_links(np.concatenate([sound, -sound, np.zeros(10)])) == [
        True,
        False,
        False,
    ]
    long = combine_masses(np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.ones(2))
    long[4] = 5.0  # more about its own axis than the triangle inequality allows
    assert find_consistent_links(long) == [False]
