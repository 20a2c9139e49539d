"""Free motion, the box, shares, a cut: the contrasts of `free`, `paper`, `box`, `training`, `outage`."""

import numpy as np
import pytest

from tests.theory.figures_of_runs import Overrides, measured, printed, value
from tests.virtual_runs import sampled
from trilat_net.execution.fused import FusedRun
from trilat_net.scenario import load_scenario
from trilat_net.theory import analyse_linear_loop

NO_BOX = {"control.law": "adaptive", "control.theta_hat0": [0.0, 0.0, 0.0, 1.9, 0.95]}
EDGE = {
    "control.theta_hat0": [0.0, 0.0, 0.0, 1.8, 0.9],
    "control.theta_low": [-1e9, -1e9, -1e9, 1.6, 0.8],
    "control.theta_high": [1e9, 1e9, 1e9, 2.0, 1.0],
}


SETTLED_S = {0.0: 22.2, 20.0: 23.3, 50.0: 24.3, 100.0: 17.8, 200.0: 11.9, 400.0: 5.5, 800.0: 11.4}


@pytest.mark.parametrize(
    ("delay_ms", "settled_s"),
    [pytest.param(*one, marks=pytest.mark.long if n % 3 else ()) for n, one in enumerate(SETTLED_S.items())],
)
def test_settling_of_free_motion_is_no_monotone_function_of_delay(delay_ms: float, settled_s: float) -> None:
    made = FusedRun(load_scenario("free", {"link.delay_ms": delay_ms}))
    made.advance(30.0)
    assert made.settled_s == printed(settled_s, 0.1)


@pytest.mark.long
def test_the_error_of_free_motion_grows_with_every_delay() -> None:
    times_s = np.arange(0.02, 20.01, 0.02)
    runs = [sampled(load_scenario("free", {"link.delay_ms": delay_ms}), times_s) for delay_ms in SETTLED_S]
    rms = [float(np.sqrt(((run[..., :2] - run[..., 4:6]) ** 2).mean())) for run in runs]
    assert rms == sorted(rms)
    assert (rms[0], rms[-1]) == (printed(0.1064, 1e-4), printed(0.1259, 1e-4))
    inertia = [run[0, -1, 12] for run in runs]  # theta_hat_1 of the first site
    assert np.ptp(inertia) > 0.1


@pytest.mark.parametrize(
    ("delay_ms", "rate_per_s"),
    [(0.0, -0.159), (200.0, -0.499), pytest.param(1600.0, -0.171, marks=pytest.mark.long)],
)
def test_about_one_rest_some_delay_damps_common_motion(delay_ms: float, rate_per_s: float) -> None:
    found = analyse_linear_loop("free", [f"link.delay_ms={delay_ms}"], pose=(-0.124, 0.337))
    assert found.decisive.rightmost is not None
    assert found.decisive.rightmost.s.real == printed(rate_per_s, 0.001)


@pytest.mark.parametrize(("name", "error", "speed"), [("paper", 6.0e-5, 3.0e-4), ("free", 1.3e-3, 1.1e-2)])
def test_errors_and_speeds_decay_as_the_theorem_says(name: str, error: float, speed: float) -> None:
    last = sampled(load_scenario(name), (20.0,))[:, -1]
    assert np.abs(last[:, :2] - last[:, 4:6]).max() == pytest.approx(error, rel=0.15)
    assert np.abs(last[:, 2:4]).max() == pytest.approx(speed, rel=0.15)


def test_the_papers_hands_hardly_move_joint_1() -> None:
    paper = load_scenario("paper")
    pushed, alone = (
        sampled(made, np.arange(0.01, 20.01, 0.01))[..., :2] for made in (paper, paper.without_hands())
    )
    assert pushed[:, -1] == pytest.approx(np.array([[-0.1729, 0.0874]] * 3), abs=1e-4)
    assert np.abs(pushed - alone)[..., 0].max() <= 0.003
    assert np.abs(pushed - alone)[:, -1].max() <= 2e-4
    assert np.abs((pushed - alone).sum(-1)).max() == pytest.approx(0.05, abs=0.01)


@pytest.mark.long
def test_without_a_box_the_slave_returns() -> None:
    made = measured("box", NO_BOX)
    assert made.end_pose_rad["s"] == (printed(-0.011, 1e-3), printed(0.005, 1e-3))


@pytest.mark.long
def test_truth_on_edge_of_box_lets_them_sag() -> None:
    made = measured("box", {**EDGE, "duration_s": 20.0})
    assert made.end_pose_rad["s"][0] < -0.4
    assert made.end_pose_rad["s"][1] < -0.7


@pytest.mark.long
@pytest.mark.parametrize(("share", "offset_rad"), [(0.9, 0.203), (0.5, 0.0), (0.1, -0.203)])
def test_the_slave_stands_where_its_shares_say(share: float, offset_rad: float) -> None:
    row = {"m1": share, "m2": 1.0 - share}
    overrides: Overrides = {"timeline": [], "dominance.s": row, "duration_s": 10.0}
    made = measured("training", overrides, (9.9, 10.0, "s"))
    assert value(made, "q1_rad") + 0.6 == printed(offset_rad, 1e-3)


HEALED = (6.0, 15.0, "s")


@pytest.mark.long
def test_a_link_that_heals_kicks_a_slave_that_went_on() -> None:
    made = measured("outage", {}, HEALED)
    assert value(made, "speed_peak_rad_s") == printed(0.41, 0.01)
    assert value(made, "torque_peak_nm") == printed(35.0, 1.0)
    assert made.synchronised_at_s == printed(12.4, 0.1)
    uncut = measured("outage", {"link.outages_s": []}, HEALED)
    assert value(uncut, "torque_peak_nm") == printed(18.8, 0.1)


@pytest.mark.long
def test_a_ramped_return_needs_no_more_than_uncut_links() -> None:
    held = measured("outage", {"on_stale.action": "hold"}, HEALED)
    uncut = measured("outage", {"link.outages_s": []}, (3.0, 15.0, "s"))
    assert value(held, "torque_peak_nm") <= value(uncut, "torque_peak_nm")
    assert value(held, "speed_peak_rad_s") <= value(uncut, "speed_peak_rad_s")
