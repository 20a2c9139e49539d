"""Dominance is force sharing: at rest, with equal Kp Lambda and known gravity, sum_i beta_i tau_i = 0."""

import pytest

from tests.theory.energy import left_null_vector
from tests.theory.figures_of_runs import measured, value
from trilat_net.scenario import load_scenario

LOAD_NM = 5.0
HELD = ((13.0, 15.0, "m1"), (38.0, 40.0, "m2"), (52.0, 54.0, "m2"))
"""The expert holds; the trainee holds; the trainee, all shares 1/2."""


@pytest.mark.long
def test_hand_feels_load_times_beta_of_slave_over_its_own() -> None:
    """Of 5 N m on the slave: 4.79 at the expert, 16.4 at the trainee, 5.00 with all shares 1/2; 2 %."""
    b1, b2, bs = left_null_vector(load_scenario("force_sharing"))
    made = measured("force_sharing", {}, *HELD)
    felt = [-value(made, "push1_mean_nm", n) for n in range(len(HELD))]
    assert felt == pytest.approx([4.79, 16.4, 5.00], rel=0.02)
    assert felt == pytest.approx([LOAD_NM * bs / b1, LOAD_NM * bs / b2, LOAD_NM], rel=0.02)
    assert felt[::2] == pytest.approx([LOAD_NM * bs / b1, LOAD_NM], rel=1e-3)  # both at rest
