"""The stiffness that a hand feels at rest."""

import pytest

from trilat_net.analysis.metrics.log_metrics import compute_log_metrics

from .written import simulated

ANCHORED = {
    "control.theta_hat0": [3.0, 1.0, 1.0, 2.0, 1.0],
    "rate_hz": 50,
    "duration_s": 20.0,
    "sites.m2.hands": [],
    "sites.m1.hands": [{"kind": "recorded", "points": [[2.0, 0.0, 0.0], [3.0, 5.0, 5.0], [60.0, 5.0, 5.0]]}],
}


def test_learning_gravity_is_spring_that_ties_arms_to_pose() -> None:
    """Gamma g^2 cos^2 (1 + Lambda T) = 115.5 N m/rad a robot; the hand moves all three."""
    found = compute_log_metrics(simulated("paper", ANCHORED))
    assert [one.site for one in found.stiffness] == ["m1", "m1"]
    second = found.stiffness[1]
    assert second.joint == 2
    assert second.torque_nm == pytest.approx(5.0)
    assert second.stiffness_nm_rad == pytest.approx(3.0 * 9.81**2 * 1.2, rel=0.01)
    # equal torques act on q1 + q2 alone: what joint 1 does is too little to tell, or very stiff
    first = found.stiffness[0].stiffness_nm_rad
    assert first is None or abs(first) > 10.0 * second.stiffness_nm_rad


def test_where_something_else_moves_arm_ratio_would_be_hands_own() -> None:
    """`training`: the shares change, the hands do not; nothing is said, and surely not their 200 N m/rad."""
    found = compute_log_metrics(simulated("training", {"rate_hz": 50}))
    assert found.static_windows.value == 2.0
    assert found.stiffness == []
