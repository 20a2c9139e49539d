"""Effort and saturation in closed form."""

import math

import pytest

from trilat_net.analysis.metrics.log_metrics import compute_log_metrics

from .written import pair


def test_effort_of_a_constant_and_of_a_sinusoid() -> None:
    """int (a^2 + b^2 sin^2) dt over whole periods is (a^2 + b^2 / 2) times the time."""
    a, b = 3.0, 8.0
    log = pair(lambda _, t_s: {"tau": [a, b * math.sin(2.0 * math.pi * t_s)]})
    found = compute_log_metrics(log).sites["m"]
    assert found["effort_nm2_s"].value == pytest.approx((a**2 + b**2 / 2.0) * 4.0, rel=1e-9)
    assert found["rms_tau_nm"].value == pytest.approx(b / math.sqrt(2.0), rel=1e-9)
    assert found["peak_tau_nm"].value == pytest.approx(b, rel=1e-9)
    assert found["saturated_share"].value == 0.0


def test_the_share_of_ticks_at_the_limit() -> None:
    """200 N m is the limit of a scenario that names none; -200 is at it as well."""
    log = pair(lambda _, t_s: {"tau": [0.0, -200.0 if t_s < 1.0 else 199.9]})
    assert compute_log_metrics(log).sites["s"]["saturated_share"].value == pytest.approx(0.25)


def test_chatter_is_the_mean_step_of_the_torque() -> None:
    """A torque that changes sides every tick, and one that never does."""
    log = pair(lambda _, t_s: {"tau": [0.5 * (-1.0) ** round(1000.0 * t_s), 3.0]})
    assert compute_log_metrics(log).sites["m"]["chatter_nm"].value == pytest.approx(1.0, rel=1e-12)
    still = pair(lambda _, __: {"tau": [7.0, 3.0]})
    assert compute_log_metrics(still).sites["m"]["chatter_nm"].value == 0.0
