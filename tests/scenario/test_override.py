"""Overrides of a resolved scenario: a key of a group applies to every member that can have it."""

import pytest

from trilat_net.scenario import load_scenario

PAPER = load_scenario("paper")


@pytest.mark.parametrize("name", ["paper", "free", "two_sites"])
@pytest.mark.parametrize(
    "overrides",
    [
        {"control.Kd": 5},
        {"limits.tau_limit_nm": 50.0},
        {"arm.m2_kg": 2.0},
        {"on_stale": {"action": "hold", "age_ms": 3000.0}},
        {"link.preset": "4g", "link.loss": 0.1},
        {"link.model": "uniform", "link.delay_ms": 50.0, "link.half_width_ms": 10.0},
        {"rate_hz": 500},
        {"seed": 9, "duration_s": 3.0},
    ],
    ids=str,
)
def test_overrides_equal_those_at_loading(name: str, overrides: dict[str, object]) -> None:
    """The sites and links of the scenarios have no keys of their own."""
    assert load_scenario(load_scenario(name), overrides) == load_scenario(name, overrides)


@pytest.mark.parametrize("order", [1, -1])
def test_single_keys_override_their_groups(order: int) -> None:
    texts = ["control.Kd=5", "sites.s.control.Kd=7", "link.loss=0.1", "links.m1->s.loss=0.2"][
        ::order
    ]
    scenario = load_scenario(PAPER, texts)
    assert [site.control.Kd[0] for site in scenario.sites.values()] == [5.0, 5.0, 7.0]
    assert {name: link.loss for name, link in scenario.links.items() if link.loss != 0.1} == {
        "m1->s": 0.2
    }


@pytest.mark.parametrize(
    ("entry", "whole"),
    [
        ("control.Kp.3=7", "control.Kp=[10, 10, 10, 7, 2, 2]"),
        ("sites.s.control.Kp.0=7", "sites.s.control.Kp=[7, 10, 10, 2, 2, 2]"),
        ("sites.s.control.Lambda.5=3", "sites.s.control.Lambda=[1, 1, 1, 1, 1, 3]"),
        ("limits.tau_limit_nm.5=9", "limits.tau_limit_nm=[150, 150, 150, 28, 28, 9]"),
        ("sites.m1.q0_rad.2=1", "sites.m1.q0_rad=[0.3, -1.0, 1.0, -0.6, 0.5, 0.2]"),
    ],
)
def test_joint_keys_are_entries_of_vectors(entry: str, whole: str) -> None:
    """A key of a joint works even if the author wrote one number for all joints, or the vector of a group."""
    scenario = load_scenario("six_joints", [whole])
    assert (
        load_scenario("six_joints", [entry])
        == scenario
        == load_scenario(load_scenario("six_joints"), [entry])
    )


def test_another_law_starts_with_own_gains() -> None:
    control = load_scenario(PAPER, ["control.law=p_d", "control.K=20"]).sites["m2"].control
    assert (control.K, control.d) == ((20.0, 20.0), (3.0, 3.0))


def test_keys_apply_where_laws_have_them() -> None:
    mixed = load_scenario(PAPER, ["sites.m1.control.law=p_d", "links.m1->s.model=measured"])
    again = load_scenario(mixed, ["control.Kd=5", "control.K=30", "link.delay_ms=50"])
    assert again.sites["m1"].control.K == (30.0, 30.0)
    assert again.sites["s"].control.Kd == (5.0, 5.0)
    assert again.links["m1->s"].measured
    assert again.links["m2->s"].delay_ms == 50.0
