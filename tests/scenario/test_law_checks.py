"""A scenario that lacks the needs of a law is refused, with the reason."""

from typing import Any

import pytest

from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario, parse_scenario

OUTSIDE = {"sites.s.plant": "external", "sites.s.arm.known": False}


@pytest.mark.parametrize(
    ("name", "overrides", "path", "fact"),
    [
        (
            "paper",
            {"sites.s.arm.known": False},
            "sites.s.arm.known",
            "sites.s.plant to 'external'",
        ),
        ("paper", {"control.law": "p_f"}, "sites.m1.control.law", "the scenario has 3 sites"),
        (
            "two_sites",
            {**OUTSIDE, "sites.s.control.law": "p_d"},
            "sites.s.control.gravity",
            "p_d computes gravity",
        ),
        (
            "two_sites",
            {**OUTSIDE, "sites.s.control.law": "pd_d"},
            "sites.s.control.gravity",
            "pd_d computes gravity",
        ),
        (
            "two_sites",
            {**OUTSIDE, "sites.s.control.law": "p_f"},
            "sites.s.control.gravity",
            "p_f computes gravity",
        ),
        (
            "two_sites",
            {"sites.m.plant": "external"},
            "sites.m.hands",
            "applies only to a simulated arm",
        ),
    ],
)
def test_laws_without_their_needs_are_refused(
    name: str, overrides: dict[str, Any], path: str, fact: str
) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(name, overrides)
    assert caught.value.path == path
    assert fact in caught.value.problem


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
