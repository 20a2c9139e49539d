"""Expectations: both directions, every key, quantities without metric; and `stable` against theory."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import CALM, make_run_metrics
from trilat_studies.expectations import ExpectationResult
from trilat_studies.measure_run import RunMetrics
from trilat_studies.run_statistics import Range

from trilat_net.analysis.run_end import EndBehaviour, EndDoubt, Stability
from trilat_net.scenario import Expect, Scenario, load_scenario, parse_scenario
from trilat_net.scenario.expect import ExpectWindow

READINGS: dict[str, float] = {
    "synchronised_by_s": 11.0,
    "peak_error_max_rad": 0.9,
    "peak_error_min_rad": 0.9,
    "rms_error_max_rad": 0.1,
    "end_error_max_rad": 0.003,
    "end_error_min_rad": 0.003,
    "end_spread_max_rad": 0.002,
    "peak_torque_max_nm": 50.0,
    "peak_speed_max_rad_s": 1.5,
    "age_max_ms": 210.0,
    "mean_age_max_ms": 200.0,
    "mean_age_min_ms": 100.0,
    "late_samples_max": 3,
}
"""What the calm run measured, by the key that asks for it."""

OTHERS: dict[str, Any] = {"stable": True, "end_pose_rad": {"s": (0.1, 0.2)}, "no_gaps": True}
TOLERANCES = {"synchronised_rad", "end_pose_within_rad"}


def evaluate_single(expect: Expect, **changes: Any) -> ExpectationResult:
    """Returns the single outcome for the calm run with some metrics replaced."""
    outcomes = ExpectationResult.list_of_run(make_run_metrics(**changes), expect)
    assert len(outcomes) == 1
    return outcomes[0]


def test_every_asked_key_is_answered_and_no_other() -> None:
    tables = {"windows", "metrics"}
    assert READINGS.keys() | OTHERS.keys() | TOLERANCES | tables == set(
        Expect.__struct_fields__
    )
    assert ExpectationResult.list_of_run(CALM, Expect()) == []
    for key, value in {**READINGS, **OTHERS}.items():
        assert evaluate_single(Expect(**{key: value})).key.split(".")[0] == key


@pytest.mark.parametrize("key", READINGS)
@given(limit=st.floats(1e-4, 1e4))
def test_a_limit_holds_exactly_within_the_figure(key: str, limit: float) -> None:
    if key == "late_samples_max":
        limit = int(limit)
    outcome = evaluate_single(Expect(**{key: limit}))
    measured = READINGS[key]
    assert outcome.held == (measured >= limit if "_min_" in key else measured <= limit)
    if limit:
        assert outcome.margin is not None
        assert outcome.margin == pytest.approx(
            abs(measured - limit) / limit * (1 if outcome.held else -1)
        )


@pytest.mark.parametrize("key", READINGS)
def test_a_limit_itself_still_holds(key: str) -> None:
    outcome = evaluate_single(Expect(**{key: READINGS[key]}))
    assert outcome.held
    assert outcome.margin == 0.0


@pytest.mark.parametrize(
    ("key", "field"),
    [("synchronised_by_s", "synchronised_at_s"), ("end_spread_max_rad", "end_spread_rad")],
)
def test_unmeasured_quantities_do_not_hold(key: str, field: str) -> None:
    outcome = evaluate_single(Expect(**{key: 1e9}), **{field: None})
    assert not outcome.held
    assert outcome.measured == "never"


def test_links_without_samples_meet_no_age_limit() -> None:
    ages = {**CALM.ages, "m1->m2": type(CALM.ages["m1->s"])(None, None)}
    for key in ("age_max_ms", "mean_age_max_ms"):
        assert not evaluate_single(Expect(**{key: 1e9}), ages=ages).held
    assert not evaluate_single(Expect(mean_age_min_ms=0.0), ages=ages).held


@pytest.mark.parametrize("stable", [True, False])
@pytest.mark.parametrize(
    ("behaviour", "stability"),
    [
        (EndBehaviour.DECAYS, Stability.SETTLED),
        (EndBehaviour.HARDLY, Stability.OPEN),
        (EndBehaviour.BOUNDED, Stability.NOT_STABLE),
    ],
)
def test_stable_needs_the_judgement_and_open_fails(
    behaviour: EndBehaviour, stability: Stability, stable: bool
) -> None:
    end = CALM.end._replace(behaviour=behaviour)
    outcome = evaluate_single(Expect(stable=stable), end=end)
    wanted = Stability.SETTLED if stable else Stability.NOT_STABLE
    assert outcome.held is (stability is wanted)
    assert outcome.measured == f"{stability}: {end.text}"
    assert evaluate_single(
        Expect(stable=True), end=CALM.end._replace(doubts=(EndDoubt("operator acts"),))
    ).measured.startswith("open: ")


@pytest.mark.parametrize("stable", [None, True, False])
def test_diverged_runs_fail_unless_divergence_was_expected(stable: bool | None) -> None:
    end = CALM.end._replace(behaviour=EndBehaviour.DIVERGED, diverged_at_s=3.25)
    outcome = evaluate_single(Expect(stable=stable), end=end)
    assert outcome.held == (stable is False)
    assert "3.25 s" in outcome.measured


@given(off=st.floats(-0.1, 0.1), within=st.floats(1e-3, 0.05))
def test_pose_must_match_each_joint_within_tolerance(off: float, within: float) -> None:
    """An expectation of a pose holds if no joint is farther away than the tolerance."""
    for wanted in ((0.1 + off, 0.2), (0.1, 0.2 - off)):
        outcome = evaluate_single(
            Expect(end_pose_rad={"s": wanted}, end_pose_within_rad=within)
        )
        assert outcome.margin is not None
        assert outcome.held == (outcome.margin >= 0.0)
        if abs(abs(off) - within) > 1e-9:
            assert outcome.held == (abs(off) < within)


def test_sites_with_poses_have_outcomes_of_their_own() -> None:
    outcomes = ExpectationResult.list_of_run(
        CALM, Expect(end_pose_rad={"m1": (0.1, 0.2), "s": (0.5, 0.2)})
    )
    assert [(o.key, o.held) for o in outcomes] == [
        ("end_pose_rad.m1", True),
        ("end_pose_rad.s", False),
    ]
    assert not evaluate_single(Expect(end_pose_rad={"s": (0.1, 0.2)}), end_pose_rad={}).held


def test_gaps_are_counted() -> None:
    assert not evaluate_single(Expect(no_gaps=True)).held
    assert evaluate_single(Expect(no_gaps=True), missing=0).held
    assert ExpectationResult.list_of_run(CALM, Expect(no_gaps=False)) == []


SPANS = {
    "error_peak_rad": Range(0.5, 0.5),
    "speed_peak_rad_s": Range(2.0, 2.0),
    "q1_rad": Range(-0.2, 0.4),
}


def expect_window(**limits: Any) -> Expect:
    """Returns an expectation on the slave from 9 to 15.5 s."""
    return Expect(windows=(ExpectWindow(from_s=9.0, to_s=15.5, site="s", **limits),))


@given(least=st.floats(-1.0, 1.0), width=st.one_of(st.just(0.0), st.floats(1e-6, 1.0)))
def test_window_quantities_must_hold_throughout(least: float, width: float) -> None:
    """An expectation of a window holds if the whole range is within the limits."""
    most = least + width
    for key, low, high in (("error_peak_rad", 0.5, 0.5), ("q1_rad", -0.2, 0.4)):
        outcome = evaluate_single(expect_window(**{key: (least, most)}), windows=(SPANS,))
        assert outcome.key == f"{key} s 9-15.5 s"
        assert outcome.held == (least <= low and high <= most)
        if most > least:
            assert outcome.margin is not None
            assert outcome.held == (outcome.margin >= 0.0)


def test_an_unreached_window_does_not_hold() -> None:
    outcome = evaluate_single(expect_window(error_peak_rad=(0.0, 1e9)), windows=({},))
    assert not outcome.held
    assert outcome.measured == "never"
    assert outcome.limit == "0 to 1e+09 rad"


def test_a_window_names_units_and_all_sites() -> None:
    window = ExpectWindow(
        from_s=0.0, to_s=1.0, error_peak_rad=(0.0, 1.0), speed_peak_rad_s=(0.0, 1.0)
    )
    outcomes = ExpectationResult.list_of_run(
        make_run_metrics(windows=(SPANS,)), Expect(windows=(window,))
    )
    assert [o.key for o in outcomes] == ["error_peak_rad 0-1 s", "speed_peak_rad_s 0-1 s"]
    assert [o.limit for o in outcomes] == ["0 to 1 rad", "0 to 1 rad/s"]


RODS = {"lc1_m": 0.5, "I1_kg_m2": 1.0 / 12.0, "lc2_m": 0.5, "I2_kg_m2": 1.0 / 12.0}

TWO = """
name = "two"
[sites.m]
role = "master"
q0_rad = [0.6, -0.4]
[sites.s]
role = "slave"
q0_rad = [-0.5, 0.8]
[dominance]
m = { s = 1.0 }
s = { m = 1.0 }
"""


def meets_stable(three: bool, d: float, stable: bool, **link: object) -> bool:
    """Returns True if `stable` holds for 40 s of free motion at 200 Hz, over links of 200 ms unless given."""
    changes = {
        "rate_hz": 200,
        "duration_s": 40.0,
        "arm": RODS,
        "limits.qd_limit_rad_s": 10.0,  # that of the rods, as in `jitter`
        "control": {"law": "p_d", "K": 10.0, "d": d},
        "link": link or {"delay_ms": 200.0},
        "expect": {"stable": stable},
    }
    scenario: Scenario = (
        load_scenario("free", changes) if three else parse_scenario(TWO, "two", changes)
    )
    (outcome,) = ExpectationResult.list_of_run(
        RunMetrics.of_virtual_run(scenario), scenario.expect
    )
    return outcome.held


@pytest.mark.parametrize(
    ("three", "below", "above"),
    [pytest.param(True, 0.9, 1.3, marks=pytest.mark.long), (False, 1.8, 2.5)],
)
def test_the_verdict_changes_at_the_margin_of_theory(
    three: bool, below: float, above: float
) -> None:
    """Below the margin `stable = false` holds, above it `stable = true`, and never both."""
    assert meets_stable(three, below, stable=False)
    assert not meets_stable(three, below, stable=True)
    assert meets_stable(three, above, stable=True)
    assert not meets_stable(three, above, stable=False)


@pytest.mark.long
def test_jitter_decays_where_constant_delay_grows() -> None:
    jitter = {"model": "uniform", "delay_ms": 200.0, "half_width_ms": 200.0}
    assert meets_stable(True, 0.6, stable=True, **jitter)
    assert meets_stable(True, 0.6, stable=False, delay_ms=200.0)
    assert meets_stable(True, 0.6, stable=False, **jitter, playout_ms=400.0)
