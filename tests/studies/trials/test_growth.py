"""`stable` against theory: P+d loses stability at d = |lambda_min(alpha)| K T, in theory and in the verdict.

K T = 2 N m s/rad; lambda_min(alpha) is -1/2 for three equal sites and -1 for two.
"""

import pytest

from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.studies.trials.expectations import evaluate_expectations
from trilat_net.studies.trials.measure_run import measure_virtual_run

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


def held(three: bool, d: float, stable: bool, **link: object) -> bool:
    """Whether `stable` holds of 40 s of free motion at 200 Hz, links of 200 ms unless said."""
    changes = {
        "rate_hz": 200,
        "duration_s": 40.0,
        "arm": RODS,
        "control": {"law": "p_d", "K": 10.0, "d": d},
        "link": link or {"delay_ms": 200.0},
        "expect": {"stable": stable},
    }
    scenario: Scenario = load_scenario("free", changes) if three else parse_scenario(TWO, "two", changes)
    (outcome,) = evaluate_expectations(scenario.expect, measure_virtual_run(scenario))
    return outcome.held


@pytest.mark.parametrize(("three", "below", "above"), [(True, 0.9, 1.1), (False, 1.8, 2.1)])
def test_the_verdict_changes_at_the_margin_of_theory(three: bool, below: float, above: float) -> None:
    assert held(three, below, stable=False)
    assert not held(three, below, stable=True)
    assert held(three, above, stable=True)
    assert not held(three, above, stable=False)


def test_jitter_of_the_same_mean_decays_where_the_constant_delay_grows_and_play_out_diverges() -> None:
    jitter = {"model": "uniform", "delay_ms": 200.0, "half_width_ms": 200.0}
    assert held(True, 0.6, stable=True, **jitter)
    assert held(True, 0.6, stable=False, delay_ms=200.0)
    assert held(True, 0.6, stable=False, **jitter, playout_ms=400.0)
