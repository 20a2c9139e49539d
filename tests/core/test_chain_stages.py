"""The torque of a tick of a chain, joint by joint, by the dynamics of Pinocchio."""

import numpy as np
import pytest

from tests.core.chain_references import (
    Arm,
    ChainState,
    chain_references,
    propagate_state,
    torque_for,
)
from trilat_net.core.arms.chain import ChainJoint
from trilat_net.core.arms.chain_stages import place_chain, update_errors, update_torque
from trilat_net.core.step.site_arrays import SiteArrays
from trilat_net.core.step.site_setup import ChainSetup, Gains, Law, LinkSetup, SiteSetup
from trilat_net.core.step.vectors import Array

REFERENCES = chain_references()
each = pytest.mark.parametrize("name", ["arm6", "arm7", "random3"])
LAMBDA = 2.0


def build_arrays(name: str, state: ChainState, **gains: object) -> SiteArrays:
    """Returns a site with the chain in a state; with its reference, v and a are those of the state."""
    chain = REFERENCES[name].chain
    joints = tuple(
        ChainJoint(joint.kind == "prismatic", joint.axis, joint.rotation, joint.origin_m)
        for joint in chain.joints
    )
    n = len(joints)
    theta = np.concatenate([joint.inertia for joint in chain.joints])
    law = Gains(Lambda=(LAMBDA,), theta_hat0=theta, known=theta, **gains)  # type: ignore[arg-type]
    arrays = SiteArrays.build(
        SiteSetup(
            name="a",
            rate_hz=1000,
            digital=False,
            theta=theta,
            g_m_s2=0.0,
            lengths_m=(0.0, 0.0),
            tau_limit_nm=1e9,
            gains=law,
            qd_limit_rad_s=1e9,
            q0=tuple(state.q),
            qd0=tuple(state.qd),
            actors=(),
            links=(LinkSetup("b", 1.0, 1000, (0.0,) * n),),
            chain=ChainSetup(joints, tuple(state.gravity)),
        ),
        pages=8,
    )
    site = arrays.site[0]
    site["q_des"][:n] = state.q + state.v / LAMBDA
    site["qd_des"][:n] = state.qd + state.a / LAMBDA
    return arrays


def find_torque(arrays: SiteArrays) -> Array:
    """Returns the torque of the site's law in its tick, N m."""
    site = arrays.site[0]
    chain = arrays.chain
    place_chain(site, chain)
    update_errors(site, chain)
    update_torque(site, chain)
    return np.array(site["tau"][: len(chain)])


@each
def test_adaptive_torque_equals_pinocchios_less_feedback(name: str) -> None:
    """Eq. (13): Y theta - Kp r - Kd ed, and Y' r of Eq. (15)."""
    for state in REFERENCES[name].states:
        arrays = build_arrays(name, state, law=Law.ADAPTIVE, Kp=(3.0,), Kd=(5.0,))
        wanted = state.inverse_dynamics - 3.0 * (state.qd - state.v) + 5.0 * state.a / LAMBDA
        np.testing.assert_allclose(find_torque(arrays), wanted, rtol=1e-9, atol=1e-9)
        transpose_rows = arrays.site[0]["Yr"][: len(state.regressor_transpose_r)]
        np.testing.assert_allclose(
            transpose_rows, state.regressor_transpose_r, rtol=1e-9, atol=1e-9
        )


@each
def test_law_that_knows_gravity_adds_springs_and_dampers(name: str) -> None:
    """G - K e - d qd - Kd ed, where G is the torque of inverse dynamics for the arm at rest."""
    for state in REFERENCES[name].states:
        arrays = build_arrays(name, state, law=Law.KNOWN, K=(7.0,), d=(2.0,), Kd=(5.0,))
        torque = find_torque(arrays)
        still = 0.0 * state.q
        arm = Arm(
            arrays.chain,
            np.concatenate([joint.inertia for joint in REFERENCES[name].chain.joints]),
        )
        propagate_state(arm, state._replace(qd=still, a=still), still)
        wanted = torque_for(arm, still, still)
        assert np.abs(wanted).max() > 1e-3
        wanted += 7.0 * state.v / LAMBDA - 2.0 * state.qd + 5.0 * state.a / LAMBDA
        np.testing.assert_allclose(torque, wanted, rtol=1e-9, atol=1e-9)
