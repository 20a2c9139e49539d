"""What holds at the end of a run, and what has no linear loop."""

import numpy as np
import pytest

from trilat_net.errors import ScenarioError
from trilat_net.scenario import load_scenario
from trilat_net.theory.equilibrium import prolong_scenario
from trilat_net.theory.operating_point import derive_operating_conditions


def test_shares_and_links_are_those_at_the_end() -> None:
    found = derive_operating_conditions(load_scenario("training"))
    assert found.alpha.sum(axis=1) == pytest.approx(1.0)
    row = dict(zip(found.names, found.alpha[found.names.index("s")], strict=True))
    assert row["m1"] == pytest.approx(0.1)
    assert any("the dominance factors of s change during the run" in note for note in found.notes)
    half = derive_operating_conditions(load_scenario("training", {"duration_s": 11.0}))
    assert half.alpha[half.names.index("s"), 0] == pytest.approx(0.5)


def test_only_hands_that_hold_are_in_the_operating_point() -> None:
    assert not any(site.actors for site in derive_operating_conditions(load_scenario("paper")).sites)
    pushed = derive_operating_conditions(load_scenario("paper", {"duration_s": 3.5}))
    (pulse,) = pushed.sites[0].actors
    assert pulse.a == pytest.approx((10.0, 10.0))  # its peak, at 3.5 s
    assert any("a scripted torque acts on m1 at the end" in note for note in pushed.notes)
    assert len(derive_operating_conditions(load_scenario("contact")).sites[0].actors) == 1
    moving = derive_operating_conditions(load_scenario("contact", {"duration_s": 2.0}))
    assert any("still moves at the end" in note for note in moving.notes)


def test_two_recorded_torques_stay_and_a_swinging_one_is_omitted() -> None:
    recorded = [{"kind": "recorded", "points": [[0.0, push, 0.0], [60.0, push, 0.0]]} for push in (1.0, 2.0)]
    swings = {"kind": "multisine", "amplitude_nm": [1.0, 0.0], "frequencies_hz": [1.0]}
    scenario = load_scenario("free", {"sites.m1.hands": [*recorded, swings]})
    found = derive_operating_conditions(scenario)
    assert [actor.a for actor in found.sites[0].actors] == [(1.0, 0.0), (2.0, 0.0)]
    assert any("still swings at the end" in note for note in found.notes)
    assert len(prolong_scenario(scenario, 100.0).sites["m1"].hands) == 2


def test_what_varies_is_said_with_its_mean() -> None:
    found = derive_operating_conditions(load_scenario("jitter", {"duration_s": 5.0}))
    assert found.age_s[0, 1] == pytest.approx(0.025, rel=0.1)
    assert any("linearised at the mean of each" in note for note in found.notes)


@pytest.mark.parametrize(
    ("overrides", "facts"),
    [
        ({"link.model": "measured"}, ["links.", ".model", "its delay is not known"]),
        ({"sites.s.plant": "external"}, ["sites.s.plant", "plant = 'simulated'"]),
        ({"control.law": "tests.plugged_laws:Line"}, [".control.law", "sends vectors of its own"]),
    ],
)
def test_what_has_no_linear_loop_is_refused(overrides: dict[str, object], facts: list[str]) -> None:
    with pytest.raises(ScenarioError) as refused:
        derive_operating_conditions(load_scenario("two_sites", overrides))
    assert all(fact in str(refused.value) for fact in ["two_sites", *facts])


def test_a_run_that_goes_on_has_nothing_new_in_it() -> None:
    longer = prolong_scenario(load_scenario("training", {"duration_s": 5.0}), 50.0)
    assert longer.duration_s == 50.0
    assert longer.timeline == ()
    held = derive_operating_conditions(longer)
    assert [len(site.actors) for site in held.sites] == [1, 1, 0]
    assert np.array_equal(
        held.alpha, derive_operating_conditions(load_scenario("training", {"duration_s": 5.0})).alpha
    )
