"""Figures of the lab sheet's answers that no other test has, each within its last printed digit or 2 %."""

import numpy as np
import pytest

from tests.analysis.certificate import runs
from tests.theory.figures_of_runs import Overrides, measured, printed, value
from trilat_net.analysis.certificate.energy_balance import compute_energy_balance


@pytest.mark.parametrize(
    ("changes", "age_ms", "leaves"),
    [({"link.order": "in_order"}, 376.0, True), ({"rate_hz": 100}, 76.0, False)],
    ids=["in order", "100 Hz"],
)
def test_exercise_2_the_age_in_use_decides(changes: Overrides, age_ms: float, leaves: bool) -> None:
    made = measured("jitter", changes)
    assert [age.mean_ms for age in made.ages.values()] == [printed(age_ms, 1.0)] * len(made.ages)
    assert (made.end_error_rad is None or made.end_error_rad > 1.0) is leaves


def test_exercise_3_the_anchor_of_a_longer_delay() -> None:
    """Predicted -0.146, found -0.149."""
    assert np.arcsin(-2.0 / (9.81 * 1.4)) == printed(-0.146, 1e-3)
    made = measured("paper", {"link.delay_ms": 400.0, "duration_s": 40.0})
    assert made.end_pose_rad["s"][0] == printed(-0.149, 1e-3)


def test_exercise_4_what_v_does_with_either_weights() -> None:
    right = compute_energy_balance(runs.run("lyapunov").energies)
    assert (right.V[0], right.V[-1]) == (printed(25.0, 0.1), printed(6.6, 0.1))
    assert right.beta[-1] / right.beta[-1, 2] * 1.42 == pytest.approx([0.0444, 0.0432, 1.42], rel=0.005)
    equal = {"sites.m1.control.Kd": 3.0, "sites.s.control.Kd": 3.0}
    ones = compute_energy_balance(runs.run("lyapunov", equal).energies, ones=True).V
    assert (ones - np.minimum.accumulate(ones)).max() == printed(0.013, 1e-3)


def test_exercise_5_a_wall_that_known_gravity_holds_against() -> None:
    made = measured("windup", {"control.Gamma": [1.0, 1.0, 1.0, 0.0, 0.0]}, (58.9, 59.1, "s"))
    assert value(made, "wall_mean_n") == printed(0.1, 0.05)


def test_exercise_7_a_return_that_is_held_back_and_the_energy_of_a_link_that_heals() -> None:
    held = measured("outage", {"on_stale.action": "hold"}, (6.0, 15.0, "s"))
    assert value(held, "torque_peak_nm") == printed(20.3, 0.1)
    balance = runs.run("outage").balance
    healed = np.searchsorted(balance.t_s, 6.19), np.searchsorted(balance.t_s, 6.21)
    given = sorted(float(np.ptp(balance.work[f"{peer}->s"][slice(*healed)])) for peer in ("m1", "m2"))
    assert given == [printed(0.43, 0.01), printed(0.78, 0.01)]
