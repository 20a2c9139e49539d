"""Force sharing at rest: sum_i (pi_i / K_i) tau_i = 0."""

import pytest

from trilat_net.analysis.metrics.log_metrics import compute_log_metrics

from .written import simulated

SLOW = {"rate_hz": 50}


def test_a_hand_feels_what_the_shares_say() -> None:
    """5 N m on the slave: 4.79 N m at the expert, 16.4 N m at the trainee, 5.00 with equal shares."""
    found = compute_log_metrics(simulated("force_sharing", SLOW))
    assert [pair.pushed + pair.holds for pair in found.sharing_ratios] == ["sm1", "sm2", "sm2"]
    assert [pair.felt_nm for pair in found.sharing_ratios] == pytest.approx([4.79, 16.4, 5.0], rel=0.02)
    assert [pair.pushed_nm for pair in found.sharing_ratios] == [pytest.approx(5.0)] * 3
    assert [pair.joint for pair in found.sharing_ratios] == [1, 1, 1]
    # beta = (0.444, 0.130, 0.426), Eq. (20): 1 - a23 a32, 1 - a13 a31, 1 - a12 a21
    beta = (1.0 - 0.2 * 0.2, 1.0 - 0.9 * 0.8, 1.0 - 0.1 * 0.8)
    expected = [pair.expected_nm.value for pair in found.sharing_ratios]
    assert expected == pytest.approx([5.0 * beta[2] / beta[0], 5.0 * beta[2] / beta[1], 5.0], rel=1e-6)
    assert found.run["sharing_off"].value <= 0.01


def test_three_loaded_sites_balance() -> None:
    """Stiffer sites count less: K_i enters, not the shares alone."""
    settings = {"sites.m1.control.Kp": 60.0, "duration_s": 15.0, **SLOW}
    found = compute_log_metrics(simulated("force_sharing", settings))
    assert found.sharing_ratios[0].expected_nm.value == pytest.approx(3.0 * 4.79, rel=0.02)
    assert found.sharing_ratios[0].off <= 0.01
    assert found.joint_loads[0].imbalance.value <= 0.01


def test_where_gravity_is_learnt_nothing_is_expected() -> None:
    found = compute_log_metrics(simulated("windup", {"duration_s": 40.0, "rate_hz": 50}))
    assert found.sharing_ratios
    for pair in found.sharing_ratios:
        assert pair.pushed == "s"
        assert pair.by_wall
        assert pair.holds == "m1"
        assert pair.expected_nm.value is None
        assert "gravity is learnt" in pair.expected_nm.why
        assert pair.off is None


def test_arms_that_move_share_nothing() -> None:
    found = compute_log_metrics(simulated("contact", {"duration_s": 1.0, "rate_hz": 100}))
    assert found.static_windows.value is None
    assert found.run["sharing_off"].why == "no second in which all sites rest under torques that stand"
