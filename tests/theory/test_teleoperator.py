from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.theory.networks import hold_by_spring
from trilat_net.analysis.theory.equilibrium import find_equilibrium
from trilat_net.analysis.theory.frequency_search import build_frequency_grid, refine_response
from trilat_net.analysis.theory.linear_loop import LinearLoop
from trilat_net.analysis.theory.operating_point import Equilibrium, OperatingConditions
from trilat_net.analysis.theory.port_analysis import (
    build_proof_output,
    compute_proof_weights,
    freeze_external_torques,
    linearise_teleoperator,
)
from trilat_net.analysis.theory.port_passivity import Passivity
from trilat_net.analysis.theory.port_response import build_admittance, evaluate_transfer
from trilat_net.scenario import Scenario, load_scenario

BARE: dict[str, Any] = {
    "sites.m1.hands": [],
    "sites.m2.hands": [],
    "sites.s.hands": [],
    "timeline": [],
}
POSE = (-0.6, 1.8)
ALONE: dict[str, dict[str, Any]] = {"free": {}, "two_sites": {"sites.m.hands": []}}


def linearise_at_pose(
    name: str, overrides: Mapping[str, Any] | None = None
) -> tuple[Scenario, OperatingConditions, Equilibrium, LinearLoop]:
    scenario = load_scenario(name, dict(overrides or {}))
    now = OperatingConditions.derive(scenario)
    rest = find_equilibrium(scenario, POSE)
    return scenario, now, rest, linearise_teleoperator(now, rest)


def build_grid(loop: LinearLoop) -> np.ndarray:
    delay_s = loop.longest_delay_s
    w, _ = refine_response(build_admittance(loop), build_frequency_grid(1e-3, 100.0, delay_s))
    return w


def in_r(now: OperatingConditions, loop: LinearLoop, *, ones: bool = False) -> Passivity:
    output = build_proof_output(now, loop)
    assert output is not None
    beta = np.repeat(np.ones(len(loop.sites)) if ones else compute_proof_weights(now), 2)
    return Passivity.check(
        lambda at: evaluate_transfer(loop, 1j * at, output),
        build_grid(loop),
        beta,
    )


def test_hands_at_ports_restore_their_loop() -> None:
    """A hand holds a pose by a torque, which remained when its spring and damper were taken off."""
    hand = {
        "kind": "spring",
        "from_rad": [-0.3, 1.6],
        "stiffness_nm_rad": 20.0,
        "damping_nm_s_rad": 3.0,
    }
    dashpot = {"kind": "viscous", "damping_nm_s_rad": 0.7}
    scenario = load_scenario(
        "training", {**BARE, "sites.m1.hands": [hand], "sites.s.environment": [dashpot]}
    )
    rest = find_equilibrium(scenario)
    bare = linearise_teleoperator(OperatingConditions.derive(scenario), rest)
    again = hold_by_spring(hold_by_spring(bare, "m1", 20.0, 3.0), "s", 0.0, 0.7)
    whole = LinearLoop.of_conditions(OperatingConditions.derive(scenario), rest)
    np.testing.assert_allclose(again.A, whole.A, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(again.B, whole.B)
    for a, b in zip(again.delayed, whole.delayed, strict=True):
        np.testing.assert_allclose(a.A, b.A, rtol=1e-9, atol=1e-9)


def test_reflected_force_includes_that_of_loads() -> None:
    hand = {"kind": "spring", "stiffness_nm_rad": 50.0, "damping_nm_s_rad": 4.0}
    scenario = load_scenario(
        "contact", {"sites.m.hands": [], "sites.s.environment": [], "sites.s.hands": [hand]}
    )
    rest = find_equilibrium(scenario, POSE)
    bare = linearise_teleoperator(OperatingConditions.derive(scenario), rest)
    again = hold_by_spring(bare, "s", 50.0, 4.0)
    whole = LinearLoop.of_conditions(OperatingConditions.derive(scenario), rest)
    for a, b in zip(again.delayed, whole.delayed, strict=True):
        np.testing.assert_allclose(a.A, b.A, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(a.B, b.B)


def test_torques_at_rest_continue_to_act() -> None:
    scenario = load_scenario("training")
    off = freeze_external_torques(
        OperatingConditions.derive(scenario), find_equilibrium(scenario)
    )
    pushes = [site.actors[0].a for site in off.sites if site.actors]
    assert len(pushes) == 2
    assert np.abs(np.array(pushes)).max() > 1.0
    _, now, rest, _ = linearise_at_pose("training", BARE)
    assert not any(site.actors for site in freeze_external_torques(now, rest).sites)


@pytest.mark.parametrize("delay_ms", [0.0, 50.0, 200.0, 800.0])
@pytest.mark.parametrize("name", ["free", "two_sites"])
def test_the_papers_law_is_passive_in_r(name: str, delay_ms: float) -> None:
    """The theorem of the nonlinear loop with hands, docs/theory/errata-proof.md."""
    _, now, _, loop = linearise_at_pose(name, {"link.delay_ms": delay_ms, **ALONE[name]})
    assert in_r(now, loop).passive
    assert not Passivity.check(build_admittance(loop), build_grid(loop)).passive


def test_circle_free_dominance_needs_the_proofs_weights() -> None:
    """beta = (0.444, 0.130, 0.426) / mean: passive; the paper's ones: not, where little damping
    hides it.
    """
    _, now, _, loop = linearise_at_pose("force_sharing", {**BARE, "control.Kp": 0.1})
    assert in_r(now, loop).passive
    assert not in_r(now, loop, ones=True).passive


def test_scalar_differences_of_kd_are_weighted_out() -> None:
    _, now, _, loop = linearise_at_pose("lyapunov")
    np.testing.assert_allclose(compute_proof_weights(now).sum(), 3.0)
    assert in_r(now, loop).passive
    assert not in_r(now, loop, ones=True).passive


def test_laws_without_r_lack_the_proofs_output() -> None:
    _, now, _, loop = linearise_at_pose("p_d_margin")
    assert build_proof_output(now, loop) is None


def test_r_is_read_as_qd_plus_lambda_e() -> None:
    """At a frequency where the delay turns by a half, r = qd + Lambda (q + mean of the peers' q)."""
    _, now, _, loop = linearise_at_pose("free")
    s = 1j * np.array([np.pi / 0.2])
    output = build_proof_output(now, loop)
    assert output is not None
    qd = evaluate_transfer(loop, s)[0]
    mean = np.kron(now.alpha, np.eye(2)) @ qd
    np.testing.assert_allclose(
        evaluate_transfer(loop, s, output)[0], qd + (qd + mean) / s[0], rtol=1e-9
    )


def test_statics_share_the_force_by_dominance() -> None:
    """Gravity known, equal Kp Lambda: a hand that holds site i feels beta_s / beta_i of a torque at s."""
    scenario, _, _, loop = linearise_at_pose("force_sharing", BARE)
    beta = scenario.beta
    assert beta is not None
    Y = build_admittance(loop)(np.array([1e-5]))[0]
    slave = loop.find_site_ports("s")
    for index, site in enumerate(("m1", "m2")):
        site_ports = loop.find_site_ports(site)
        felt = np.linalg.solve(Y[np.ix_(site_ports, site_ports)], Y[np.ix_(site_ports, slave)])
        np.testing.assert_allclose(felt.real, np.eye(2) * beta[2] / beta[index], atol=1e-3)
        np.testing.assert_allclose(felt.imag, 0.0, atol=1e-3)


@pytest.mark.parametrize("delay_ms", [1.0, 200.0])
@pytest.mark.parametrize("name", ["free", "two_sites"])
def test_learning_gravity_is_a_spring_at_low_frequency(name: str, delay_ms: float) -> None:
    """A push moves N sites together, each a spring Gamma g^2 cos^2 q (1 + Lambda T) of its channel."""
    _, now, _, loop = linearise_at_pose(name, {"link.delay_ms": delay_ms, **ALONE[name]})
    w = 1e-4
    # stiffness of all ports
    Z = 1j * w * np.linalg.inv(build_admittance(loop)(np.array([w]))[0])
    first, outer = (
        9.81**2 * np.cos(angle) ** 2 * (1.0 + 1e-3 * delay_ms) for angle in (POSE[0], sum(POSE))
    )
    alone = np.linalg.inv(np.linalg.inv(Z)[:2, :2])  # what one hand feels, the others off
    expected = len(now.sites) * np.array([[first + outer, outer], [outer, outer]])
    np.testing.assert_allclose(alone.real, expected, rtol=2e-3)
    assert np.abs(alone.imag).max() < 1e-2 * expected.max()


def test_clamped_sites_make_learnt_gravity_wind_up() -> None:
    """Impedance as 1 / w^2 towards zero, its phase that of a negative damper."""
    _, _, _, loop = linearise_at_pose("two_sites", ALONE["two_sites"])
    held = loop.clamp_site("s")
    assert held.sites == ("m",)
    Z = 1.0 / build_admittance(held)(np.array([1e-3, 2e-3]))[:, 0, 0]
    assert abs(Z[0] / Z[1]) == pytest.approx(4.0, rel=1e-2)
    assert abs(np.angle(Z[0])) == pytest.approx(np.pi, abs=0.02)
