import math

import numpy as np
import pytest

from tests.theory.analysed_ports import POSE, section_of
from trilat_net.analysis.theory.equilibrium import find_equilibrium
from trilat_net.analysis.theory.port_analysis import PortAnalysis
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.scenario import load_scenario


@pytest.mark.parametrize("name", ["p_d_margin_two", "p_d_margin"])
@pytest.mark.parametrize("K", [5.0, 20.0])
def test_p_d_is_passive_once_stable(name: str, K: float) -> None:
    """d = abs(lambda_min(alpha)) K T, whatever the masses, and with joints that are coupled."""
    line = {"p_d_margin_two": 1.0, "p_d_margin": 0.5}[name] * K * 0.2
    beyond = section_of(name, (("control.K", K), ("control.d", 1.02 * line)))
    assert beyond.velocity.passive
    assert beyond.pole.passive
    assert not beyond.absolute.below
    assert not any(two_port.minima.below for two_port in beyond.two_ports)
    below = section_of(name, (("control.K", K), ("control.d", 0.98 * line)))
    assert not below.velocity.passive
    assert below.absolute.below
    assert all(two_port.minima.below for two_port in below.two_ports if len(below.sites) == 2)


@pytest.mark.long
def test_criteria_agree_for_single_ports() -> None:
    """A passive port is absolutely stable, and a network stable at all joints is so at each."""
    bare = (("timeline", ()), ("sites.m1.hands", ()), ("sites.m2.hands", ()))
    for name, overrides in (("p_d_margin", ()), ("training", bare), ("two_sites", ())):
        section = section_of(name, overrides)
        assert section.verdict == "stable"
        fails = [
            two_port
            for two_port in section.two_ports
            if two_port.minima.below and not two_port.clamped
        ]
        if not section.absolute.below:
            assert not fails
        if section.velocity.passive:
            assert not section.absolute.below
            assert all(joint.passive for joint in section.joints.values())
        worst = max((span.to_hz for span in section.velocity.minima.below), default=0.0)
        assert all(span.to_hz <= worst * 1.001 for span in section.absolute.below)


def test_three_sites_pair_with_the_third_free() -> None:
    three = section_of("p_d_margin")
    assert [(two_port.sites, two_port.clamped) for two_port in three.two_ports[::2]] == [
        (("m1", "m2"), ""),
        (("m1", "m2"), "s"),
        (("m1", "s"), ""),
        (("m1", "s"), "m2"),
        (("m2", "s"), ""),
        (("m2", "s"), "m1"),
    ]
    assert {two_port.joint for two_port in three.two_ports} == {1, 2}
    assert [
        (two_port.sites, two_port.clamped)
        for two_port in section_of("p_d_margin_two").two_ports
    ] == 2 * [(("m", "s"), "")]


def test_hands_feel_the_slave_by_default() -> None:
    assert [
        (transparency.operator_site, transparency.other_site, transparency.joint)
        for transparency in section_of("p_d_margin").transparency
    ] == [
        ("m1", "s", 1),
        ("m1", "s", 2),
        ("m2", "s", 1),
        ("m2", "s", 2),
    ]
    assert {
        (transparency.operator_site, transparency.other_site)
        for transparency in section_of("p_d_margin", of="m1").transparency
    } == {
        ("m2", "m1"),
        ("s", "m1"),
    }


def test_equal_masters_feel_the_same() -> None:
    first, second = section_of("p_d_margin").transparency[::2]
    np.testing.assert_allclose(first.free, second.free, rtol=1e-9)
    np.testing.assert_allclose(first.clamped, second.clamped, rtol=1e-9)


def test_only_the_paper_s_law_has_an_r() -> None:
    section = section_of("two_sites")
    assert section.proof is not None
    assert section.proof.passive
    assert section.estimates_true
    assert section_of("p_d_margin").proof is None


def test_wrong_estimates_return_stored_energy() -> None:
    """V counts the error of the estimates, which of inertia nothing excites to first order."""
    scenario = load_scenario("free")
    rest = find_equilibrium(scenario, POSE)
    learnt = np.tile([0.5, 0.45, -0.29, 2.0, 1.0], (3, 1))  # as a run of it ends
    section = PortAnalysis.of_scenario(
        scenario, rest._replace(q=np.tile([-0.124, 0.337], (3, 1)), theta_hat=learnt)
    )
    assert not section.estimates_true
    assert section.proof is not None
    assert not section.proof.passive


def test_late_reflected_force_is_unstable_when_clamped() -> None:
    """A master with k_f = 1 meets a slave that cannot move: K e^{-2 s T} about an arm with
    little damping.
    """
    bare = (("sites.m.hands", ()), ("sites.s.environment", ()))
    assert section_of("contact", bare).clamped_verdict == "unstable"
    near = (*bare, ("link.delay_ms", 1.0), ("sites.m.control.d", 30.0))
    section = section_of("contact", near)
    assert section.clamped_verdict == "stable"
    assert section.transparency[0].ratio_db > 2.0


def test_one_way_networks_lack_damping() -> None:
    section = section_of("contact", (("sites.m.hands", ()), ("sites.s.environment", ())))
    assert not section.velocity.passive
    assert 0.0 < section.velocity.lacking_nm_s_rad < math.inf


def test_impossible_questions_are_refused() -> None:
    scenario = load_scenario("p_d_margin_two")
    rest = find_equilibrium(scenario, POSE)
    with pytest.raises(UsageError, match="no site 'x' among the ports; the sites are m, s"):
        PortAnalysis.of_scenario(scenario, rest, "x")
    for band_hz in ((1.0, 1.0), (1.0, 0.1), (0.0, 0.1)):
        with pytest.raises(UsageError, match="from a frequency above 0 Hz to a higher one"):
            PortAnalysis.of_scenario(scenario, rest, band_hz=band_hz)
    measured = load_scenario("p_d_margin_two", {"link": {"model": "measured"}})
    with pytest.raises(ScenarioError, match="is not known beforehand"):
        PortAnalysis.of_scenario(measured, rest)
