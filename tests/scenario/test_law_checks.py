"""Scenarios that meet the needs of their laws."""

from typing import Any

import pytest

from trilat_net.scenario import load_scenario, parse_scenario

OUTSIDE = {"sites.s.plant": "external", "sites.s.arm.known": False}


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"sites.s.control.law": "adaptive_box"},
        {"sites.s.control.law": "p_d", "sites.s.control.gravity": 0.0},
        {"sites.s.control.law": "pd_d", "sites.s.arm.g_m_s2": 0.0},
        {"sites.s.control.law": "tests.laws:Adaptive"},
    ],
    ids=str,
)
def test_mass_free_laws_drive_unknown_arms(
    overrides: dict[str, Any],
) -> None:
    scenario = load_scenario("two_sites", {**OUTSIDE, **overrides})
    assert not scenario.setup("s").theta_known
    assert parse_scenario(scenario.text) == scenario


def test_default_known_arms_stay_out_of_text() -> None:
    assert "known" not in load_scenario("two_sites").text
    assert (
        load_scenario("two_sites", {"arm.known": True}).sha256
        == load_scenario("two_sites").sha256
    )
    assert load_scenario("two_sites", OUTSIDE).text.count("known = false") == 1


def test_direct_force_reflection_is_for_a_pair() -> None:
    assert load_scenario("two_sites", {"control.law": "p_f"}).setup("s")
