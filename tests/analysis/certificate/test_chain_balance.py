"""The energy balance of arms of n joints closes, with friction, stops, walls in space and limits too."""

import dataclasses

import numpy as np
import pytest

import trilat_net
from tests.analysis.rough_arms import rough_log
from tests.chains import six_joints
from trilat_net.analysis.certificate.energy_balance import (
    EnergyBalance,
    compute_energy_balance,
    compute_site_energies,
)
from trilat_net.analysis.certificate.stability_certificate import StabilityFinding, certify
from trilat_net.analysis.metrics.log_metrics import LogMetrics, compute_log_metrics
from trilat_net.scenario import parse_scenario

BAR = 5e-5
"""Largest unexplained energy as a share of the largest V."""


def unexplained(balance: EnergyBalance) -> float:
    return float(np.abs(balance.unexplained).max() / balance.V.max())


def check_six(duration_s: float) -> LogMetrics:
    """The certificate of a run of six joints, and its metrics."""
    log = trilat_net.simulate(parse_scenario(six_joints(duration_s, 200.0)))
    found, metrics = certify(log), compute_log_metrics(log)
    assert found.verdict.finding is StabilityFinding.COVERED, found.verdict.text
    assert found.balance is not None
    assert unexplained(found.balance) <= BAR
    assert np.abs(found.balance.residual).max() <= BAR * found.balance.V.max()
    for site, energy in found.energies.items():
        own = metrics.sites[site]
        learnt = own["theta_energy_last_j"].value - own["theta_energy_first_j"].value
        assert learnt == pytest.approx(np.ptp(energy.parts.parameter[[0, -1]]) * np.sign(learnt), rel=1e-6)
        assert own["unaccounted_j"].value <= 1e-6
    return metrics


def test_energy_of_six_joints_closes_with_the_base_parameters() -> None:
    metrics = check_six(2.0)
    estimates = metrics.estimates["s"].base
    assert estimates is not None
    assert len(estimates.parameter) == 36
    assert metrics.sites["s"]["unphysical_links"].value == estimates.consistent_last.count(False)


@pytest.mark.long
def test_energy_of_seven_joints_closes() -> None:
    text = six_joints(10.0, 200.0).replace("arm6", "arm7").replace("[0.2, 0.2, 0.2, 0.05, 0.05, 0.05]", "0.2")
    text = text.replace("[10, 10, 10, 2, 2, 2]", "8").replace("[2, 2, 2, 0.5, 0.5, 0.5]", "1.5")
    for pose in ("0.5, 0.2]", "0.1, 0.0]", "0.3, 0.1]"):
        text = text.replace(pose, f"{pose[:-1]}, 0.4]")
    log = trilat_net.simulate(parse_scenario(text))
    balance = compute_energy_balance(compute_site_energies(log))
    assert unexplained(balance) <= BAR


@pytest.mark.long
def test_energy_of_ten_seconds_of_six_joints_closes() -> None:
    check_six(10.0)


def test_premises_name_joints_at_limits_and_at_stops() -> None:
    found = certify(rough_log())
    premises = {premise.name: premise for premise in found.premises}
    assert premises["torque"].holds is premises["stops"].holds is premises["hands"].holds is False
    assert "s (shoulder_lift)" in premises["torque"].text
    assert "m2 (elbow)" in premises["stops"].text
    assert found.verdict.finding in (StabilityFinding.DID_NOT_RISE, StabilityFinding.ROSE), found.verdict.text


def test_every_term_of_a_rough_arm_is_needed() -> None:
    """Without its friction, its stops or its wall the energy of a site does not add up."""
    energies = compute_site_energies(rough_log())
    whole = compute_energy_balance(energies)
    assert np.abs(whole.unexplained).max() <= 2e-4 * whole.V.max()
    assert {"stops", "hands", "walls"} == set(whole.external)
    for site, name in (("s", "friction"), ("m2", "friction"), ("m2", "stops"), ("s", "walls")):
        energy = energies[site]
        kinds = {
            kind: {key: one for key, one in getattr(energy, kind).items() if key != name}
            for kind in ("dissipation", "work")
        }
        lame = dataclasses.replace(energy, **kinds)
        assert np.abs(lame.unexplained).max() > 50 * np.abs(energy.unexplained).max(), name


def test_friction_and_stops_stand_in_the_energies_of_an_arm() -> None:
    found = compute_log_metrics(rough_log())
    for own in found.sites.values():
        assert own["friction_j"].value > 1.0
        assert own["unaccounted_j"].value <= 0.02
    assert found.sites["m2"]["walls_j"].value < 0.0  # its stop
    assert not found.sites["m1"]["walls_j"].applies
    assert found.walls["s/1"]["force_peak_n"].value > 10.0
