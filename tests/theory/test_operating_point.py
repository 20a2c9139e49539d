"""The operating point at the end of a run, and loops without linear form.

The age of samples in use: by the rule of the links, and by a run.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.execution.builders import make_trajectories
from trilat_net.analysis.theory.equilibrium import extend_scenario
from trilat_net.analysis.theory.operating_point import (
    OperatingConditions,
    compute_effective_delay,
)
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario


def test_shares_and_links_are_those_at_the_end() -> None:
    conditions = OperatingConditions.derive(load_scenario("training"))
    assert conditions.alpha.sum(axis=1) == pytest.approx(1.0)
    row = dict(
        zip(conditions.names, conditions.alpha[conditions.names.index("s")], strict=True)
    )
    assert row["m1"] == pytest.approx(0.1)
    assert any(
        "the dominance factors of s change during the run" in note for note in conditions.notes
    )
    half = OperatingConditions.derive(load_scenario("training", {"duration_s": 11.0}))
    assert half.alpha[half.names.index("s"), 0] == pytest.approx(0.5)


def test_only_holding_hands_enter_operating_points() -> None:
    assert not any(
        site.actors for site in OperatingConditions.derive(load_scenario("paper")).sites
    )
    pushed = OperatingConditions.derive(load_scenario("paper", {"duration_s": 3.5}))
    (pulse,) = pushed.sites[0].actors
    assert pulse.a == pytest.approx((10.0, 10.0))  # its peak, at 3.5 s
    assert any("a scripted torque acts on m1 at the end" in note for note in pushed.notes)
    assert len(OperatingConditions.derive(load_scenario("contact")).sites[0].actors) == 1
    moving = OperatingConditions.derive(load_scenario("contact", {"duration_s": 2.0}))
    assert any("still moves at the end" in note for note in moving.notes)


def test_only_constant_recorded_torques_stay() -> None:
    recorded = [
        {"kind": "recorded", "points": [[0.0, push, 0.0], [60.0, push, 0.0]]}
        for push in (1.0, 2.0)
    ]
    swings = {"kind": "multisine", "amplitude_nm": [1.0, 0.0], "frequencies_hz": [1.0]}
    scenario = load_scenario("free", {"sites.m1.hands": [*recorded, swings]})
    conditions = OperatingConditions.derive(scenario)
    assert [actor.a for actor in conditions.sites[0].actors] == [(1.0, 0.0), (2.0, 0.0)]
    assert any("still swings at the end" in note for note in conditions.notes)
    assert len(extend_scenario(scenario, 100.0).sites["m1"].hands) == 2


def test_varying_quantities_have_their_mean() -> None:
    conditions = OperatingConditions.derive(load_scenario("jitter", {"duration_s": 5.0}))
    assert conditions.age_s[0, 1] == pytest.approx(0.025, rel=0.1)
    assert any("linearised at the mean of each" in note for note in conditions.notes)


@pytest.mark.parametrize(
    ("overrides", "facts"),
    [
        ({"link.model": "measured"}, ["links.", ".model", "is not known"]),
        ({"sites.s.plant": "external"}, ["sites.s.plant", "set sites.s.plant=simulated"]),
        (
            {"control.law": "tests.plugged_laws:Line"},
            [".control.law", "sends vectors that the law defines"],
        ),
    ],
)
def test_loops_without_linear_form_are_refused(
    overrides: dict[str, object], facts: list[str]
) -> None:
    with pytest.raises(ScenarioError) as refused:
        OperatingConditions.derive(load_scenario("two_sites", overrides))
    assert all(fact in str(refused.value) for fact in ["two_sites", *facts])


def test_continuing_runs_change_nothing() -> None:
    longer = extend_scenario(load_scenario("training", {"duration_s": 5.0}), 50.0)
    assert longer.duration_s == 50.0
    assert longer.timeline == ()
    conditions = OperatingConditions.derive(longer)
    assert [len(site.actors) for site in conditions.sites] == [1, 1, 0]
    assert np.array_equal(
        conditions.alpha,
        OperatingConditions.derive(load_scenario("training", {"duration_s": 5.0})).alpha,
    )


def make_link_scenario(**link: object) -> Scenario:
    return load_scenario(
        "two_sites",
        {"duration_s": 3.0, **{f"link.{key}": value for key, value in link.items()}},
    )


@given(delay_ms=st.floats(0, 500), rate_hz=st.sampled_from([100, 300, 1000]))
def test_constant_delay_is_used_from_next_tick(delay_ms: float, rate_hz: int) -> None:
    chosen = load_scenario("two_sites", {"link.delay_ms": delay_ms, "rate_hz": rate_hz})
    age = compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
    ticks = age.mean_s * rate_hz
    assert ticks == pytest.approx(round(ticks))
    assert age.mean_s >= max(1 / rate_hz, round(1e3 * delay_ms) / 1e6 - 1e-12)
    assert age.mean_s < max(1 / rate_hz, round(1e3 * delay_ms) / 1e6) + 1 / rate_hz
    assert age.least_s == age.most_s == age.mean_s


@pytest.mark.parametrize(
    "overrides",
    [
        {"link.model": "uniform", "link.delay_ms": 60.0, "link.half_width_ms": 50.0},
        {"link.delay_ms": 40.0, "link.loss": 0.3},
        {"link.delay_ms": 40.0, "sites.m.rate_hz": 110},
        {
            "link.model": "sine",
            "link.delay_ms": 60.0,
            "link.amplitude_ms": 40.0,
            "link.period_s": 1.0,
        },
    ],
    ids=["jitter", "loss", "rates", "sine"],
)
def test_the_mean_is_that_of_a_run(overrides: dict[str, object]) -> None:
    chosen = load_scenario("two_sites", {"duration_s": 3.0, "rate_hz": 500, **overrides})
    age = compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
    run = make_trajectories(chosen).sites["s"]
    used = run.used[:, 0]
    ages_s = (run.t_s - used / chosen.sites["m"].rate_hz)[used >= 0]
    assert age.mean_s == pytest.approx(ages_s.mean(), abs=1e-5)
    assert age.most_s == pytest.approx(ages_s.max(), abs=1e-5)


def test_play_out_makes_jitter_a_constant_delay() -> None:
    chosen = make_link_scenario(
        model="uniform", delay_ms=60.0, half_width_ms=50.0, playout_ms=110.0
    )
    age = compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
    assert np.allclose(age, 0.110)


def test_a_link_that_delivers_nothing_is_refused() -> None:
    chosen = make_link_scenario(loss=1.0)
    with pytest.raises(
        ScenarioError, match=r"links\.m->s: no sample sent over this link ever arrives"
    ):
        compute_effective_delay(chosen, "m", "s", chosen.links["m->s"])
