"""The leaves of a chain against Pinocchio's numbers, and its own laws."""

import numpy as np
import pytest

from tests.core.chain_references import (
    Arm,
    chain_references,
    find_largest_difference,
    full_matrix,
    propagate_state,
    torque_for,
)
from trilat_net.core.arms.chain import (
    LINK_PARAMETERS,
    MAX_JOINTS,
    ChainJoint,
    build_chain,
    find_acceleration,
    parameter_gradient,
    place_end_effector,
    place_joints,
)
from trilat_net.core.step.vectors import Array

REFERENCES = chain_references()
EPS = np.finfo(float).eps
each = pytest.mark.parametrize("name", REFERENCES)


def build_arm(name: str, **drive: float) -> Arm:
    joints = REFERENCES[name].chain.joints
    fields = [
        ChainJoint(
            joint.kind == "prismatic", joint.axis, joint.rotation, joint.origin_m, **drive
        )
        for joint in joints
    ]
    return Arm(
        build_chain(fields, MAX_JOINTS), np.concatenate([joint.inertia for joint in joints])
    )


@each
def test_inverse_dynamics_and_gradient_are_those_of_pinocchio(name: str) -> None:
    """M a + C v + G with C by Christoffel symbols, Eq. (12), and Y' r, Eq. (15)."""
    arm = build_arm(name)
    gradient = np.zeros(LINK_PARAMETERS * len(arm.rows))
    for state in REFERENCES[name].states:
        propagate_state(arm, state, state.v)
        assert (
            find_largest_difference(torque_for(arm, state.v, state.a), state.inverse_dynamics)
            <= 1e-12
        )
        parameter_gradient(arm.rows, gradient)
        assert find_largest_difference(gradient, state.regressor_transpose_r) <= 1e-12


@each
def test_forward_dynamics_are_those_of_pinocchio(name: str) -> None:
    """M to 1e-12, and accelerations to 100 eps of its condition."""
    arm = build_arm(name)
    qdd = np.zeros(len(arm.rows))
    for state in REFERENCES[name].states:
        place_joints(arm.rows, state.q)
        M = full_matrix(arm)
        assert find_largest_difference(M, state.inertia) <= 1e-12
        find_acceleration(arm.rows, arm.theta, state.gravity, state.q, state.qd, state.tau, qdd)
        wanted = state.forward_dynamics
        assert (
            np.abs(qdd - wanted).max() <= 100 * EPS * np.linalg.cond(M) * np.abs(wanted).max()
        )


@each
def test_place_and_jacobian_are_those_of_pinocchio(name: str) -> None:
    arm = build_arm(name)
    chain = REFERENCES[name].chain
    for state in REFERENCES[name].states:
        place_joints(arm.rows, state.q)
        assert (
            find_largest_difference(
                np.array(place_end_effector(arm.rows, chain.tip_origin_m)), state.tip_position
            )
            <= 1e-12
        )
        assert (
            find_largest_difference(
                np.vstack([arm.rows["J_lin"].T, arm.rows["J_ang"].T]), state.jacobian
            )
            <= 1e-12
        )
        rotation = arm.rows["R_base"][-1] @ np.array(chain.tip_rotation)
        assert find_largest_difference(rotation, state.tip_rotation) <= 1e-12


def test_friction_and_drives_enter_both_dynamics_alike() -> None:
    """The torque of inverse dynamics for a motion makes that motion, with armature and friction too."""
    arm = build_arm("arm7", armature_kg_m2=0.1, viscous=0.5, coulomb=1.5)
    state = REFERENCES["arm7"].states[0]
    qdd = np.zeros(7)
    propagate_state(arm, state, state.qd)
    torque = torque_for(arm, state.qd, state.a)
    find_acceleration(arm.rows, arm.theta, state.gravity, state.q, state.qd, torque, qdd)
    assert find_largest_difference(qdd, state.a) <= 1e-11


def stop_torque(q: list[float], qd: list[float]) -> Array:
    """Returns the generalised force of the stops of two joints, N m: their change of M qdd."""
    arms = (
        build_arm("random2", lower=-0.5, upper=0.5, stop_stiffness=1e3, stop_damping=10.0),
        build_arm("random2"),
    )
    qdds = np.zeros((2, 2))
    for arm, qdd in zip(arms, qdds, strict=True):
        place_joints(arm.rows, np.array(q))
        none = np.zeros(2)
        find_acceleration(
            arm.rows, arm.theta, np.zeros(3), np.array(q), np.array(qd), none, qdd
        )
    place_joints(arms[1].rows, np.array(q))
    return full_matrix(arms[1]) @ (qdds[0] - qdds[1])


def test_stops_push_back_and_never_pull() -> None:
    assert np.abs(stop_torque([0.4, -0.4], [1.0, 1.0])).max() <= 1e-12
    assert stop_torque([0.6, -0.7], [0.0, 0.0]) == pytest.approx([-100.0, 200.0])
    assert stop_torque([0.6, 0.0], [-20.0, 0.0]) == pytest.approx([0.0, 0.0], abs=1e-9)
