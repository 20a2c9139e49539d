"""How near estimates came to the truth."""

import math

import pytest

from trilat_net.analysis.metrics.log_metrics import compute_log_metrics

from .written import pair, simulated, under

LEARNS = 'control = { law = "adaptive", Gamma = [1.0, 1.0, 2.0, 0.0, 0.0] }'
THETA = [3.0, 1.0, 1.0, 2.0, 1.0]


def test_distance_energy_and_slope_of_estimates_that_move_straight() -> None:
    """Learnt are the first three; off by (3, 4, 12) at t = 0, and by that less rate times time later."""
    rate = [0.1, 0.2, -0.2]

    def motion(_: str, t_s: float) -> dict[str, list[float]]:
        off = [3.0, 4.0, 12.0]
        learnt = [THETA[n] + off[n] + rate[n] * t_s for n in range(3)]
        return {"theta_hat": [*learnt, 7.0, 8.0]}

    measured = compute_log_metrics(pair(motion, seconds=6.0, more=LEARNS))
    found, learnt = measured.sites["s"], measured.estimates["s"]
    assert found["theta_error_first"].value == pytest.approx(13.0)
    assert found["theta_energy_first_j"].value == pytest.approx(0.5 * (9.0 + 16.0 + 144.0 / 2.0))
    end_s = 6.0 - 1.0 / 200
    last = [3.0 + 0.1 * end_s, 4.0 + 0.2 * end_s, 12.0 - 0.2 * end_s]
    assert found["theta_error_last"].value == pytest.approx(math.hypot(*last))
    assert found["theta_slope_per_s"].value == pytest.approx(0.3)
    assert learnt.slope_per_s == pytest.approx([*rate, 0.0, 0.0], abs=1e-9)
    assert learnt.learnt == [True, True, True, False, False]
    assert learnt.theta == THETA


def test_a_law_that_learns_nothing_says_so() -> None:
    found = compute_log_metrics(pair(lambda _, __: {})).sites["m"]["theta_error_last"]
    assert found.value is None
    assert found.why == "nothing is learnt"
    assert not found.applies


def test_without_a_truth_estimates_are_given_and_not_judged() -> None:
    log = simulated("free", {"duration_s": 1.0, "rate_hz": 100})
    changes = {"sites.s.plant": "external", "sites.s.arm.known": False, "sites.s.control.theta_hat0": THETA}
    measured = compute_log_metrics(under(log, changes))
    assert measured.estimates["s"].theta is None
    assert measured.estimates["s"].last == log["s"].theta_hat[-1].tolist()
    assert measured.sites["s"]["theta_error_last"].why == "theta of the arm is not known"
    assert measured.sites["s"]["theta_slope_per_s"].value > 0.0
    assert measured.sites["m1"]["theta_error_last"].value > 0.0
