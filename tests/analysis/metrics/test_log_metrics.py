"""Logs of every kind: every metric has a number or a reason.

Runs side by side. Effort and saturation in closed form. The stiffness that a hand feels at
rest. Force sharing at rest: sum_i (pi_i / K_i) tau_i = 0. Errors of the estimates.
"""

import csv
import json
import math
from pathlib import Path
from typing import Any

import pytest
from trilat_studies.log_comparison import MetricComparison

import trilat_net
from tests.analysis.builders import (
    make_busy_run,
    make_diverged_log,
    make_pair_log,
    make_run,
    make_short_log,
)
from tests.log.builders import add_clock_readings, replace_fields, replace_scenario, rewrite_log
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.metrics.measures import Quantity
from trilat_net.log.log_reader import Log

GOLDEN = sorted((Path(__file__).parents[2] / "golden").glob("v*.mcap"))


def check_facts(log: Log) -> dict[str, Any]:
    """Returns the facts of a log after checking the rules that all facts obey."""
    measured = LogMetrics.of_log(log)
    facts: dict[str, Any] = json.loads(json.dumps(measured.to_dict(), allow_nan=False))
    assert set(facts["sites"]) == set(log.sites)
    assert len(facts["links"]) == len(log.sites) * (len(log.sites) - 1)
    unknown = facts["unknown"]
    for quantity in Quantity.list_all():
        kind = "run" if quantity.of == "run" else f"{quantity.of}s"
        places = {"run": facts["run"]} if kind == "run" else facts[kind]
        for name, values in places.items():
            path = f"run.{quantity.key}" if kind == "run" else f"{kind}.{name}.{quantity.key}"
            value = values[quantity.key]
            assert (value is None) == (path in unknown)
            assert value is None or math.isfinite(value)
            assert path not in unknown or unknown[path]
        whole = measured.run_value(quantity)
        assert (whole.value is None) == bool(whole.why)
    return facts


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_every_released_version_is_measured(path: Path) -> None:
    facts = check_facts(trilat_net.open_log(path))
    assert facts["sites"]["s"]["rms_error_rad"] > 0.0
    assert facts["sites"]["s"]["unaccounted_j"] < 1e-3
    assert facts["links"]["m2->s"]["age_mean_ms"] > 0.0


def test_busy_and_uneven_sites_are_measured() -> None:
    facts = check_facts(make_busy_run().log)
    assert facts["links"]["b->a"]["burst"] > 1.0
    assert facts["links"]["b->a"]["loss"] == pytest.approx(0.2, abs=0.1)
    check_facts(make_short_log("four"))


def test_gaps_and_late_starts_are_counted() -> None:
    log = make_run("free", {"duration_s": 3.0, "rate_hz": 200}).log
    torn = rewrite_log(
        log, lambda s: not (s.site == "m1" and 200 <= s.tick < 240), finished=False
    )
    facts = check_facts(torn)
    assert facts["sites"]["m1"]["missing"] == 40.0
    assert facts["sites"]["m1"]["unaccounted_j"] < 1e-3
    assert not facts["complete"]
    late = check_facts(rewrite_log(log, lambda state: 150 < state.tick < 400))
    assert late["sites"]["m1"]["unaccounted_j"] < 1e-3
    assert late["run"]["spread_max_rad"] > 0.0


def test_a_missing_site_lacks_only_its_figures() -> None:
    log = make_run("free", {"duration_s": 1.0, "rate_hz": 100}).log
    facts = check_facts(rewrite_log(log, lambda state: state.site != "m1"))
    assert facts["sites"]["m2"]["controller_j"] is not None
    assert facts["links"]["m2->s"]["delay_j"] is not None
    assert facts["unknown"]["sites.m1.controller_j"] == "no records of m1"
    assert facts["unknown"]["links.m1->s.following_rms_rad"] == "no records of m1"
    assert facts["unknown"]["run.spread_rms_rad"] == "no records of m1"
    assert facts["unknown"]["windows_at_rest"] == "no records of m1"
    assert "m1" not in facts["parameters"]


@pytest.mark.parametrize("ticks", [0, 1, 2, 3])
def test_nearly_empty_logs_are_no_error(ticks: int) -> None:
    log = make_run("contact", {"duration_s": 1.0, "rate_hz": 100}).log
    facts = check_facts(rewrite_log(log, lambda state: state.tick < ticks))
    assert (facts["sites"]["m"]["controller_j"] is None) == (ticks < 2)
    assert (facts["walls"]["s/1"]["force_peak_n"] is None) == (ticks < 1)


def test_a_diverged_run_is_measured_until_divergence() -> None:
    facts = check_facts(make_diverged_log())
    assert facts["sites"]["m1"]["unaccounted_j"] < 1e-2


@pytest.mark.parametrize("size", [1e200, 1e308])
def test_unphysical_numbers_are_missing_without_error(size: float) -> None:
    log = make_run("contact", {"duration_s": 5.0, "rate_hz": 100}).log
    grown = rewrite_log(
        log,
        change=lambda s: replace_fields(
            s,
            **{
                name: [size if s.tick % 3 else -size] * 2
                for name in ("q", "qd", "tau", "tau_x")
            },
        ),
    )
    assert check_facts(grown)["sites"]["m"]["mechanical_j"] is None


def test_loops_are_reported_if_clocks_were_read() -> None:
    """Every loop late by its tick in us, every tick 7 us of work."""
    log = add_clock_readings(make_run("free", {"duration_s": 1.0, "rate_hz": 200}).log)
    facts = check_facts(log)["sites"]["m1"]
    assert facts["late_max_us"] == 199.0
    assert facts["busy_p99_us"] == 7.0
    assert facts["overruns"] == 0.0
    assert (
        check_facts(make_run("free", {"duration_s": 1.0, "rate_hz": 200}).log)["sites"]["m1"][
            "late_max_us"
        ]
        is None
    )


def test_the_docs_have_a_line_for_every_quantity() -> None:
    table = Path(__file__).parents[3] / "docs" / "data" / "metrics.csv"
    with table.open(encoding="utf-8", newline="") as file:
        keys = [key for row in csv.DictReader(file) for key in row["keys"].split(", ")]
    assert sorted(keys) == sorted(quantity.key for quantity in Quantity.list_all())


def test_a_row_is_the_largest_or_the_sum() -> None:
    log = make_pair_log(
        lambda site, _: {
            "tau": [3.0 if site == "m" else 4.0, 0.0],
            "q": [0.1, 0.0],
            "q_des": [0.0, 0.0],
        }
    )
    comparison = MetricComparison.of_logs([log, log], ["a", "b"])
    assert comparison.columns == ("a", "b")
    assert comparison.row("peak_tau_nm").values == (4.0, 4.0)
    assert comparison.row("effort_nm2_s").values == pytest.approx((25.0 * 4.0, 25.0 * 4.0))
    assert comparison.row("max_error_rad").values == (0.1, 0.1)


def test_runs_lack_figures_missing_at_a_site() -> None:
    """A largest value of some sites is none of the run; sites that cannot have the figure do not count."""
    log = make_run("free", {"duration_s": 1.0, "rate_hz": 100}).log
    torn = rewrite_log(log, lambda state: state.site != "m2")
    row = MetricComparison.of_logs([log, torn]).row("max_error_rad")
    assert row.values[0] is not None
    assert row.values[1] is None
    assert row.entries[1].why == "m2: no records of m2"


def test_rows_without_any_value_are_left_out() -> None:
    free = make_run("free", {"duration_s": 1.0, "rate_hz": 100}).log
    wall = make_run("contact", {"duration_s": 1.0, "rate_hz": 100}).log
    keys = [row.quantity.key for row in MetricComparison.of_logs([free]).rows]
    assert "force_peak_n" not in keys
    assert "late_p99_us" not in keys
    both = MetricComparison.of_logs([free, wall]).row("force_peak_n")
    assert both.values == (None, 0.0)
    with pytest.raises(KeyError):
        MetricComparison.of_logs([free]).row("force_peak_n")


def test_json_has_value_and_reason_per_column() -> None:
    free = make_run("free", {"duration_s": 1.0, "rate_hz": 100}).log
    facts = json.loads(json.dumps(MetricComparison.of_logs([free]).to_dict(), allow_nan=False))
    assert facts["columns"] == ["log"]
    for row in facts["rows"]:
        assert (row["values"][0] is None) == (row["unknown"][0] is not None)


def test_effort_of_a_constant_and_of_a_sinusoid() -> None:
    """int (a^2 + b^2 sin^2) dt over whole periods is (a^2 + b^2 / 2) times the time."""
    a = 3.0
    b = 8.0
    log = make_pair_log(lambda _, t_s: {"tau": [a, b * math.sin(2.0 * math.pi * t_s)]})
    figures = LogMetrics.of_log(log).sites["m"]
    assert figures["effort_nm2_s"].value == pytest.approx((a**2 + b**2 / 2.0) * 4.0, rel=1e-9)
    assert figures["rms_tau_nm"].value == pytest.approx(b / math.sqrt(2.0), rel=1e-9)
    assert figures["peak_tau_nm"].value == pytest.approx(b, rel=1e-9)
    assert figures["saturated_share"].value == 0.0


def test_saturation_is_the_share_of_limited_ticks() -> None:
    """200 N m is the limit of a scenario that names none; -200 counts as well."""
    log = make_pair_log(lambda _, t_s: {"tau": [0.0, -200.0 if t_s < 1.0 else 199.9]})
    assert LogMetrics.of_log(log).sites["s"]["saturated_share"].value == pytest.approx(0.25)


def test_chatter_is_the_mean_step_of_the_torque() -> None:
    """A torque that changes sides every tick, and one that never does."""
    log = make_pair_log(lambda _, t_s: {"tau": [0.5 * (-1.0) ** round(1000.0 * t_s), 3.0]})
    assert LogMetrics.of_log(log).sites["m"]["chatter_nm"].value == pytest.approx(
        1.0, rel=1e-12
    )
    still = make_pair_log(lambda _, __: {"tau": [7.0, 3.0]})
    assert LogMetrics.of_log(still).sites["m"]["chatter_nm"].value == 0.0


ANCHORED = {
    "control.theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0],
    "rate_hz": 50,
    "duration_s": 20.0,
    "sites.m2.hands": [],
    "sites.m1.hands": [
        {"kind": "recorded", "points": [[2.0, 0.0, 0.0], [3.0, 5.0, 5.0], [60.0, 5.0, 5.0]]}
    ],
}


def test_learnt_gravity_is_a_spring_to_pose() -> None:
    """Gamma g^2 cos^2 (1 + Lambda T) = 115.5 N m/rad a robot; the hand moves all three."""
    metrics = LogMetrics.of_log(make_run("paper", ANCHORED).log)
    assert [stiffness.site for stiffness in metrics.stiffness] == ["m1", "m1"]
    second = metrics.stiffness[1]
    assert second.joint == 2
    assert second.torque_nm == pytest.approx(5.0)
    assert second.stiffness_nm_rad == pytest.approx(3.0 * 9.81**2 * 1.2, rel=0.01)
    # equal torques act on q1 + q2 alone: what joint 1 does is too little to tell, or very stiff
    first = metrics.stiffness[0].stiffness_nm_rad
    assert first is None or abs(first) > 10.0 * second.stiffness_nm_rad


def test_no_stiffness_is_given_under_changing_shares() -> None:
    """In `training` the shares change and the hands do not: no stiffness is stated, in
    particular not their 200 N m/rad.
    """
    metrics = LogMetrics.of_log(make_run("training", {"rate_hz": 50}).log)
    assert metrics.static_windows.value == 2.0
    assert metrics.stiffness == []


SLOW = {"rate_hz": 50}


def test_the_felt_stiffness_follows_the_shares() -> None:
    """5 N m on the slave: 4.79 N m at the expert, 16.4 N m at the trainee, 5.00 with equal shares."""
    metrics = LogMetrics.of_log(make_run("force_sharing", SLOW).log)
    assert [pair.pushed + pair.holds for pair in metrics.sharing_ratios] == [
        "sm1",
        "sm2",
        "sm2",
    ]
    assert [pair.felt_nm for pair in metrics.sharing_ratios] == pytest.approx(
        [4.79, 16.4, 5.0], rel=0.02
    )
    assert [pair.pushed_nm for pair in metrics.sharing_ratios] == [pytest.approx(5.0)] * 3
    assert [pair.joint for pair in metrics.sharing_ratios] == [1, 1, 1]
    # beta = (0.444, 0.130, 0.426), Eq. (20): 1 - a23 a32, 1 - a13 a31, 1 - a12 a21
    beta = (1.0 - 0.2 * 0.2, 1.0 - 0.9 * 0.8, 1.0 - 0.1 * 0.8)
    expected = [pair.expected_nm.value for pair in metrics.sharing_ratios]
    assert expected == pytest.approx(
        [5.0 * beta[2] / beta[0], 5.0 * beta[2] / beta[1], 5.0], rel=1e-6
    )
    assert metrics.run["sharing_off"].value <= 0.01


def test_three_loaded_sites_balance() -> None:
    """Stiffer sites count less: K_i enters, not the shares alone."""
    settings = {"sites.m1.control.Kp": 60.0, "duration_s": 15.0, **SLOW}
    metrics = LogMetrics.of_log(make_run("force_sharing", settings).log)
    assert metrics.sharing_ratios[0].expected_nm.value == pytest.approx(3.0 * 4.79, rel=0.02)
    assert metrics.sharing_ratios[0].off <= 0.01
    assert metrics.joint_loads[0].imbalance.value <= 0.01


def test_with_learnt_gravity_no_sharing_is_expected() -> None:
    metrics = LogMetrics.of_log(make_run("windup", {"duration_s": 40.0, "rate_hz": 50}).log)
    assert metrics.sharing_ratios
    for ratio in metrics.sharing_ratios:
        assert ratio.pushed == "s"
        assert ratio.by_wall
        assert ratio.holds == "m1"
        assert ratio.expected_nm.value is None
        assert "gravity is learnt" in ratio.expected_nm.why
        assert ratio.off is None


def test_moving_arms_have_no_force_sharing() -> None:
    metrics = LogMetrics.of_log(make_run("contact", {"duration_s": 1.0, "rate_hz": 100}).log)
    assert metrics.static_windows.value is None
    assert (
        metrics.run["sharing_off"].why
        == "no second in which all sites rest under constant torques"
    )


LEARNS = 'control = { law = "adaptive", Gamma = [1.0, 1.0, 2.0, 0.0, 0.0] }'
THETA = [3.0, 1.0, 1.0, 2.0, 1.0]


def test_straight_estimates_have_distance_energy_and_slope() -> None:
    """The first three are learnt; off by (3, 4, 12) at t = 0, and later by that less rate times time."""
    rate = [0.1, 0.2, -0.2]

    def motion(_: str, t_s: float) -> dict[str, list[float]]:
        off = [3.0, 4.0, 12.0]
        learnt = [THETA[n] + off[n] + rate[n] * t_s for n in range(3)]
        return {"theta_hat": [*learnt, 7.0, 8.0]}

    measured = LogMetrics.of_log(make_pair_log(motion, seconds=6.0, more=LEARNS))
    figures_of_slave = measured.sites["s"]
    learnt = measured.estimates["s"]
    assert figures_of_slave["theta_error_first"].value == pytest.approx(13.0)
    assert figures_of_slave["theta_energy_first_j"].value == pytest.approx(
        0.5 * (9.0 + 16.0 + 144.0 / 2.0)
    )
    end_s = 6.0 - 1.0 / 200
    last = [3.0 + 0.1 * end_s, 4.0 + 0.2 * end_s, 12.0 - 0.2 * end_s]
    assert figures_of_slave["theta_error_last"].value == pytest.approx(math.hypot(*last))
    assert figures_of_slave["theta_slope_per_s"].value == pytest.approx(0.3)
    assert learnt.slope_per_s == pytest.approx([*rate, 0.0, 0.0], abs=1e-9)
    assert learnt.learnt == [True, True, True, False, False]
    assert learnt.theta == THETA


def test_a_law_without_estimates_is_reported() -> None:
    figure = LogMetrics.of_log(make_pair_log(lambda _, __: {})).sites["m"]["theta_error_last"]
    assert figure.value is None
    assert figure.why == "nothing is learnt"
    assert not figure.applies


def test_without_truth_estimates_have_no_error() -> None:
    log = make_run("free", {"duration_s": 1.0, "rate_hz": 100}).log
    changes = {
        "sites.s.plant": "external",
        "sites.s.arm.known": False,
        "sites.s.control.theta_hat0": THETA,
    }
    measured = LogMetrics.of_log(replace_scenario(log, changes))
    assert measured.estimates["s"].theta is None
    assert measured.estimates["s"].last == log["s"].theta_hat[-1].tolist()
    assert measured.sites["s"]["theta_error_last"].why == "theta of the arm is not known"
    assert measured.sites["s"]["theta_slope_per_s"].value > 0.0
    assert measured.sites["m1"]["theta_error_last"].value > 0.0
