"""The energy balance of sites that follow with their end effectors closes, and needs every term."""

import dataclasses

import numpy as np
import pytest

import trilat_net
from tests.task_arms import planar_task
from trilat_net.analysis.certificate.energy_balance import compute_energy_balance, compute_site_energies
from trilat_net.analysis.certificate.premises import explain_no_functional
from trilat_net.analysis.certificate.stability_certificate import Certificate, StabilityFinding, certify
from trilat_net.scenario import load_scenario, parse_scenario

BAR = 5e-5
"""Largest residual as a share of the largest V."""


def judge(rate_hz: int = 1000, elbow_rad: float = 1.7, **overrides: object) -> Certificate:
    text = planar_task(rate_hz=rate_hz, elbow_rad=elbow_rad)
    return certify(trilat_net.simulate(parse_scenario(text, overrides=overrides)))


def share(found: Certificate, name: str = "residual") -> float:
    assert found.balance is not None, found.verdict.text
    return float(np.abs(getattr(found.balance, name)).max() / found.balance.V.max())


def test_it_closes_with_order_two() -> None:
    found = {rate_hz: judge(rate_hz) for rate_hz in (500, 1000)}
    assert all(one.verdict.finding is StabilityFinding.COVERED for one in found.values())
    assert share(found[1000]) <= BAR
    assert share(found[500]) / share(found[1000]) == pytest.approx(4.0, rel=0.1)


def test_it_closes_with_links_that_jitter_box_and_torque_limit() -> None:
    jitter = judge(**{"link.model": "uniform", "link.delay_ms": 60, "link.half_width_ms": 30})
    box = judge(**{"control.law": "adaptive_box", "control.theta_low": -0.3, "control.theta_high": 1.2})
    limit = judge(**{"limits.tau_limit_nm": 25.0})
    for found in (jitter, box, limit):
        assert share(found) <= BAR
    assert box.verdict.finding is StabilityFinding.COVERED
    assert {premise.name for premise in limit.premises if not premise.holds} == {"torque"}
    assert limit.verdict.rise is not None
    assert list(limit.verdict.rise.causes) == ["the torque limit"]


def test_damping_near_a_singular_pose_fails_a_premise() -> None:
    found = judge(elbow_rad=0.15, **{"task.singular_value": 0.3})
    premise = next(one for one in found.premises if one.name == "singular poses")
    assert premise.holds is False
    assert "s from 0 s on" in premise.text
    assert found.balance is not None
    assert abs(found.balance.work["singular poses"][-1]) > 0.02 * found.balance.V.max()
    assert share(found, "unexplained") <= 2e-4


@pytest.mark.long
def test_an_axis_that_only_one_follows_dissipates() -> None:
    """The arm of seven joints begins beside the plane of its masters, which cannot leave it."""
    q0 = [0.3, -0.3, 0.0, -1.6, 0.0, 1.4, 0.0]
    log = trilat_net.simulate(load_scenario("unlike_arms", {"duration_s": 1.0, "sites.s.q0_rad": q0}))
    found = certify(log)
    assert found.verdict.finding is StabilityFinding.COVERED, found.verdict.text
    assert share(found) <= BAR
    assert found.balance is not None
    taken = found.balance.dissipation["open axes"]
    assert taken[-1] > 1e-3
    assert np.diff(taken).min() >= -1e-15
    for site, energy in compute_site_energies(log).items():
        terms = {name: one for name, one in energy.dissipation.items() if name != "open axes"}
        lame = dataclasses.replace(energy, dissipation=terms)
        if site == "s":
            assert np.abs(lame.residual).max() > 10 * np.abs(energy.residual).max()


def test_following_an_axis_that_peers_leave_free_fails() -> None:
    found = judge(**{"sites.m.task.axes": ["x"]})
    premise = next(one for one in found.premises if one.name == "axes")
    assert premise.holds is False
    assert "s follows m" in premise.text


def test_orientations_have_no_v_and_it_says_why() -> None:
    text = planar_task(duration_s=0.1).replace("position", "pose").replace("[8.0, 5.0, 1.0]", "5.0")
    assert "orientations" in explain_no_functional(parse_scenario(text))


def test_false_records_break_the_balance() -> None:
    """Every site's torque is checked against the law in task space."""
    log = trilat_net.simulate(parse_scenario(planar_task(duration_s=1.0)))
    energies = compute_site_energies(log)
    motion = energies["s"].motion
    assert np.abs(motion.records.tau - motion.law_torque(np.arange(len(motion.r)))).max() <= 1e-9
    wrong = dataclasses.replace(motion, constants=motion.constants._replace(Kd=1.01 * motion.constants.Kd))
    assert np.abs(wrong.records.tau - wrong.law_torque(np.arange(len(motion.r)))).max() > 1e-3
    assert compute_energy_balance(energies).V.max() > 1.0
