"""Free motion, the box, shares, a cut: the contrasts of `free`, `paper`, `box`, `training`, `outage`.

What a wall tells apart: scenarios `contact` and `windup`.

What the shipped scenarios expect are the figures, within their last printed digit or 2 %.

That they meet what they expect is tested in `packages/trilat-studies/tests/trial_tests/test_shipped.py`.

P+d at its margin, and jitter: scenarios `p_d_margin`, `p_d_margin_two`, `jitter`.

A figure "at t" is the largest |e| of the two seconds from t on.
"""

import numpy as np
import pytest

from tests.execution.builders import run_fused, sample_records
from tests.theory.figures_of_runs import (
    Overrides,
    approximate_figure,
    find_peak,
    find_value,
    measure_run,
)
from trilat_net.analysis.theory import LinearAnalysis
from trilat_net.analysis.twins.envelope_trend import EnvelopeTrend
from trilat_net.scenario import load_scenario

NO_BOX = {"control.law": "adaptive", "control.theta_hat0": [0.0, 0.0, 0.0, 1.9, 0.95]}
EDGE = {
    "control.theta_hat0": [0.0, 0.0, 0.0, 1.8, 0.9],
    "control.theta_low": [-1e9, -1e9, -1e9, 1.6, 0.8],
    "control.theta_high": [1e9, 1e9, 1e9, 2.0, 1.0],
}


SETTLED_S = {
    0.0: 22.2,
    20.0: 23.3,
    50.0: 24.3,
    100.0: 17.8,
    200.0: 11.9,
    400.0: 5.5,
    800.0: 11.4,
}


@pytest.mark.parametrize(
    ("delay_ms", "settled_s"),
    [
        pytest.param(*case, marks=pytest.mark.long if n % 3 else ())
        for n, case in enumerate(SETTLED_S.items())
    ],
)
def test_settling_is_no_monotone_function_of_delay(delay_ms: float, settled_s: float) -> None:
    fused_run = run_fused(load_scenario("free", {"link.delay_ms": delay_ms}), 30.0)
    assert fused_run.settled_s == approximate_figure(settled_s, 0.1)


@pytest.mark.long
def test_free_motions_error_grows_with_delay() -> None:
    times_s = np.arange(0.02, 20.01, 0.02)
    runs = [
        sample_records(load_scenario("free", {"link.delay_ms": delay_ms}), times_s)
        for delay_ms in SETTLED_S
    ]
    rms = [float(np.sqrt(((run[..., :2] - run[..., 4:6]) ** 2).mean())) for run in runs]
    assert rms == sorted(rms)
    assert (rms[0], rms[-1]) == (
        approximate_figure(0.1064, 1e-4),
        approximate_figure(0.1259, 1e-4),
    )
    inertia = [run[0, -1, 12] for run in runs]  # theta_hat_1 of the first site
    assert np.ptp(inertia) > 0.1


@pytest.mark.parametrize(
    ("delay_ms", "rate_per_s"),
    [(0.0, -0.159), (200.0, -0.499), pytest.param(1600.0, -0.171, marks=pytest.mark.long)],
)
def test_about_one_rest_some_delay_damps_common_motion(
    delay_ms: float, rate_per_s: float
) -> None:
    analysis = LinearAnalysis.compute(
        "free", [f"link.delay_ms={delay_ms}"], pose=(-0.124, 0.337)
    )
    assert analysis.decisive.rightmost is not None
    assert analysis.decisive.rightmost.s.real == approximate_figure(rate_per_s, 0.001)


@pytest.mark.parametrize(
    ("name", "error", "speed"), [("paper", 6.0e-5, 3.0e-4), ("free", 1.3e-3, 1.1e-2)]
)
def test_errors_and_speeds_decay_by_the_theorem(name: str, error: float, speed: float) -> None:
    last = sample_records(load_scenario(name), (20.0,))[:, -1]
    assert np.abs(last[:, :2] - last[:, 4:6]).max() == pytest.approx(error, rel=0.15)
    assert np.abs(last[:, 2:4]).max() == pytest.approx(speed, rel=0.15)


def test_the_papers_hands_hardly_move_joint_1() -> None:
    paper = load_scenario("paper")
    pushed, alone = (
        sample_records(scenario_run, np.arange(0.01, 20.01, 0.01))[..., :2]
        for scenario_run in (paper, paper.without_hands())
    )
    assert pushed[:, -1] == pytest.approx(np.array([[-0.1729, 0.0874]] * 3), abs=1e-4)
    assert np.abs(pushed - alone)[..., 0].max() <= 0.003
    assert np.abs(pushed - alone)[:, -1].max() <= 2e-4
    assert np.abs((pushed - alone).sum(-1)).max() == pytest.approx(0.05, abs=0.01)


@pytest.mark.long
def test_without_a_box_the_slave_returns() -> None:
    windows = measure_run("box", NO_BOX)
    assert windows.end_pose_rad["s"] == (
        approximate_figure(-0.011, 1e-3),
        approximate_figure(0.005, 1e-3),
    )


@pytest.mark.long
def test_truth_on_edge_of_box_lets_them_sag() -> None:
    windows = measure_run("box", {**EDGE, "duration_s": 20.0})
    assert windows.end_pose_rad["s"][0] < -0.4
    assert windows.end_pose_rad["s"][1] < -0.7


@pytest.mark.long
@pytest.mark.parametrize(("share", "offset_rad"), [(0.9, 0.203), (0.5, 0.0), (0.1, -0.203)])
def test_the_slave_stands_where_its_shares_say(share: float, offset_rad: float) -> None:
    row = {"m1": share, "m2": 1.0 - share}
    overrides: Overrides = {"timeline": [], "dominance.s": row, "duration_s": 10.0}
    windows = measure_run("training", overrides, (9.9, 10.0, "s"))
    assert find_value(windows, "q1_rad") + 0.6 == approximate_figure(offset_rad, 1e-3)


HEALED = (6.0, 15.0, "s")


@pytest.mark.long
def test_healing_links_kick_slaves_that_continued() -> None:
    windows = measure_run("outage", {}, HEALED)
    assert find_value(windows, "speed_peak_rad_s") == approximate_figure(0.41, 0.01)
    assert find_value(windows, "torque_peak_nm") == approximate_figure(35.0, 1.0)
    assert windows.synchronised_at_s == approximate_figure(12.4, 0.1)
    uncut = measure_run("outage", {"link.outages_s": []}, HEALED)
    assert find_value(uncut, "torque_peak_nm") == approximate_figure(18.8, 0.1)


@pytest.mark.long
def test_ramped_returns_need_no_further_torque() -> None:
    held = measure_run("outage", {"on_stale.action": "hold"}, HEALED)
    uncut = measure_run("outage", {"link.outages_s": []}, (3.0, 15.0, "s"))
    assert find_value(held, "torque_peak_nm") <= find_value(uncut, "torque_peak_nm")
    assert find_value(held, "speed_peak_rad_s") <= find_value(uncut, "speed_peak_rad_s")


LATE = (9.0, 15.0, "s")


def test_direct_force_reflection_hammers_at_200_ms() -> None:
    windows = measure_run("contact", {}, LATE)
    assert find_value(windows, "wall_mean_n") == approximate_figure(8.0, 1.0)
    assert find_value(windows, "wall_deviation_n") == approximate_figure(14.0, 1.0)
    assert find_value(windows, "wall_peak_n") == approximate_figure(52.0, 1.0)
    assert find_value(windows, "wall_hits") == 3


def test_at_20_ms_there_is_one_hit() -> None:
    windows = measure_run(
        "contact", {"link.delay_ms": 20.0}, (0.0, 15.0, "s"), (14.0, 15.0, "s")
    )
    assert find_value(windows, "wall_hits") == 1
    assert find_value(windows, "wall_mean_n", 1) == approximate_figure(3.3, 0.1)
    assert find_value(windows, "wall_deviation_n", 1) < 0.01


def test_a_fifth_of_the_force_settles() -> None:
    windows = measure_run("contact", {"sites.m.control.k_f": 0.2}, (14.0, 15.0, "s"))
    assert find_value(windows, "wall_mean_n") == approximate_figure(8.5, 0.1)
    assert find_value(windows, "wall_deviation_n") < 0.05


def test_free_motion_is_calm_at_200_ms() -> None:
    windows = measure_run("contact", {"sites.s.environment": []}, (14.0, 15.0, "s"))
    assert find_value(windows, "speed_peak_rad_s") < 1e-6
    assert windows.end_error_rad is not None
    assert windows.end_error_rad < 1e-6


@pytest.mark.parametrize(
    "law",
    [
        {"law": "pd_d"},
        pytest.param({"law": "p_d", "K": 100.0, "d": 40.0}, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_position_laws_pass_the_same_wall(law: dict[str, object]) -> None:
    """With one law of positions at both sites in place of force reflection, the contact comes to rest."""
    windows = measure_run(
        "contact",
        {"control": law, "sites.m.control": {}, "sites.s.control": {}, "duration_s": 25.0},
        (24.0, 25.0, "s"),
    )
    assert find_value(windows, "wall_mean_n") > 1.0
    assert find_value(windows, "wall_deviation_n") < 0.05


@pytest.mark.long
def test_without_learning_gravity_nothing_winds_up() -> None:
    windows = measure_run(
        "windup",
        {"control.Gamma": [1.0, 1.0, 1.0, 0.0, 0.0], "duration_s": 20.0},
        (10.0, 10.2, "s"),
        (19.8, 20.0, "s"),
    )
    assert find_value(windows, "wall_mean_n", 1) == pytest.approx(
        find_value(windows, "wall_mean_n", 0), abs=0.02
    )


FIGURES = [
    ("contact", "wall_mean_n", (9.0, 15.0), 8.0, 1.0),
    ("contact", "wall_deviation_n", (9.0, 15.0), 14.0, 1.0),
    ("contact", "wall_peak_n", (9.0, 15.0), 52.0, 1.0),
    ("windup", "wall_mean_n", (5.8, 6.2), 1.0, 0.1),
    ("windup", "wall_mean_n", (9.9, 10.1), 4.3, 0.1),
    ("windup", "wall_mean_n", (19.9, 20.1), 8.5, 0.1),
    ("windup", "wall_mean_n", (58.9, 59.1), 10.7, 0.1),
    ("box", "q1_rad", (12.0, 60.0), 0.502, 1e-3),
    ("box", "q2_rad", (12.0, 60.0), -0.496, 1e-3),
    ("training", "q1_rad", (9.0, 10.0), -0.6 + 0.203, 1e-3),
    ("training", "q1_rad", (25.0, 30.0), -0.6 - 0.203, 1e-3),
    ("force_sharing", "push1_mean_nm", (13.0, 15.0), -4.79, 0.01),
    ("force_sharing", "push1_mean_nm", (38.0, 40.0), -16.4, 0.1),
    ("force_sharing", "push1_mean_nm", (52.0, 54.0), -5.0, 0.01),
    ("jitter", "error_peak_rad", (38.0, 40.0), 0.022, 1e-3),
    ("outage", "speed_peak_rad_s", (6.0, 15.0), 0.41, 0.01),
    ("outage", "torque_peak_nm", (6.0, 15.0), 35.0, 1.0),
]
"""Scenario, quantity, window, figure, its last printed digit.

A wall's force at a time is its mean over 0.2 or 0.4 s about it; with a force that hammers, over three hits.
"""


@pytest.mark.parametrize(("name", "key", "window", "figure", "digit"), FIGURES)
def test_window_limits_are_figures_within_bars(
    name: str, key: str, window: tuple[float, float], figure: float, digit: float
) -> None:
    limits_by_window = {
        (w.from_s, w.to_s): dict(w.limits) for w in load_scenario(name).expect.windows
    }
    least, most = limits_by_window[window][key]
    bar = max(digit, 0.02 * abs(figure))
    assert figure - bar <= least + 1e-12
    assert most <= figure + bar + 1e-12
    assert least <= figure <= most


@pytest.mark.parametrize(("name", "settled_s"), [("free", 11.9), ("outage", 12.4)])
def test_settling_times_equal_their_figures(name: str, settled_s: float) -> None:
    by_s = load_scenario(name).expect.synchronised_by_s
    assert by_s is not None
    assert settled_s <= by_s <= 1.02 * settled_s


def test_paper_ends_at_the_anchor() -> None:
    expect = load_scenario("paper").expect
    assert set(expect.end_pose_rad.values()) == {(-0.1729, 0.0874)}
    assert expect.end_pose_within_rad <= 0.02 * 0.0874


CONSTANT = {"link.model": "constant", "link.delay_ms": 200.0}


@pytest.mark.parametrize(("name", "margin"), [("p_d_margin", 1.0), ("p_d_margin_two", 2.0)])
def test_margins_follow_the_smallest_eigenvalue(name: str, margin: float) -> None:
    """d = abs(lambda_min(alpha)) K T."""
    scenario = load_scenario(name)
    (delay_ms,) = {link.delay_ms for link in scenario.links.values()}
    alpha = np.array(
        [[scenario.dominance[i].get(j, 0.0) for j in scenario.sites] for i in scenario.sites]
    )
    assert -np.linalg.eigvals(alpha).real.min() * 10.0 * delay_ms * 1e-3 == pytest.approx(
        margin
    )


@pytest.mark.long
@pytest.mark.parametrize(("name", "d"), [("p_d_margin", 0.9), ("p_d_margin_two", 1.8)])
def test_below_its_margin_p_d_grows(name: str, d: float) -> None:
    """Above it, at 1.1 and 2.1, it decays: that is what both scenarios expect as they are shipped."""
    shipped = load_scenario(name)
    assert {site.control.d[0] for site in shipped.sites.values()} <= {1.1, 2.1}  # type: ignore[union-attr]
    assert (
        measure_run(name, {"control.d": d, "duration_s": 40.0}).end.error.trend
        is EnvelopeTrend.GROWS
    )


@pytest.mark.long
def test_unequal_shares_have_their_own_margin() -> None:
    """-0.8, so 1.6: as `docs/tutorials/lab.md` asks."""
    row = {
        "m1": {"m2": 0.1, "s": 0.9},
        "m2": {"m1": 0.8, "s": 0.2},
        "s": {"m1": 0.8, "m2": 0.2},
    }
    alpha = np.array([[row[i].get(j, 0.0) for j in row] for i in row])
    assert np.linalg.eigvals(alpha).real.min() == pytest.approx(-0.8)
    changes = {"dominance": row, "duration_s": 40.0}
    assert (
        measure_run("p_d_margin", {**changes, "control.d": 1.4}).end.error.trend
        is EnvelopeTrend.GROWS
    )
    assert (
        measure_run("p_d_margin", {**changes, "control.d": 1.8}).end.error.trend
        is EnvelopeTrend.DECAYS
    )


@pytest.mark.long
def test_half_of_the_margin_grows_to_10_rad() -> None:
    faster_arms = {"limits.qd_limit_rad_s": 100.0}
    changes = {"control.d": 0.5, "duration_s": 40.0, **faster_arms}
    windows = measure_run("p_d_margin", changes, (10.0, 12.0, ""), (38.0, 40.0, ""))
    assert [find_peak(windows, 0), find_peak(windows, 1)] == [
        approximate_figure(1.6, 0.1),
        approximate_figure(10.0, 1.0),
    ]


@pytest.mark.long
def test_two_and_half_margins_decay_to_milliradians() -> None:
    windows = measure_run(
        "p_d_margin", {"control.d": 2.5, "duration_s": 21.0}, (19.0, 21.0, "")
    )
    assert find_peak(windows) == approximate_figure(3e-3, 1e-3)


@pytest.mark.long
def test_jitter_of_equal_mean_turns_the_verdict() -> None:
    jitter = measure_run("jitter", {}, (38.0, 40.0, ""))
    constant = measure_run("jitter", CONSTANT, (38.0, 40.0, ""))
    assert (jitter.end.error.trend, constant.end.error.trend) == (
        EnvelopeTrend.DECAYS,
        EnvelopeTrend.GROWS,
    )
    assert find_peak(jitter) == approximate_figure(0.022, 0.001)
    assert find_peak(constant) == approximate_figure(5.3, 0.1)
    ages = [age.mean_ms for age in jitter.ages.values()]
    assert ages == [approximate_figure(25.0, 1.0)] * len(ages)
    assert {age.mean_ms for age in constant.ages.values()} == {200.0}


@pytest.mark.long
def test_play_out_makes_the_jittered_run_diverge() -> None:
    limits = {"limits.tau_limit_nm": 1e6, "limits.qd_limit_rad_s": 10_000.0}
    free = measure_run("jitter", {"link.playout_ms": 400.0, **limits}, (38.0, 40.0, ""))
    assert find_peak(free) == approximate_figure(339.0, 1.0)
    assert {age.max_ms for age in free.ages.values()} == {400.0}
    assert free.peak_speed_rad_s is not None
    assert free.peak_speed_rad_s > load_scenario("jitter").sites["s"].limits.qd_limit_rad_s


@pytest.mark.parametrize(
    ("changes", "leaves"),
    [({"link.order": "in_order"}, True), ({"rate_hz": 100}, False)],
    ids=["order", "rate"],
)
def test_order_makes_jitter_exceed_its_limits(
    changes: dict[str, str | int], leaves: bool
) -> None:
    fused_run = run_fused(load_scenario("jitter", changes), 40.0)
    assert (fused_run.diverged_s is not None) is leaves
