"""The rests of loops: equilibria of the equations, found from runs that settle, swing, or diverge."""

import numpy as np
import pytest

from trilat_net.analysis.theory.equilibrium import (
    MAX_EQUILIBRIUM_RESIDUAL,
    compute_equilibrium_residual,
    find_equilibrium,
    follow_equilibrium,
    predict_equilibrium,
)
from trilat_net.analysis.theory.operating_point import OperatingConditions
from trilat_net.errors import ScenarioError, UsageError
from trilat_net.scenario import load_scenario

TRIO = {"rate_hz": 200}


@pytest.mark.parametrize(
    "name", ["free", "p_d_margin_two", "contact", "windup", "force_sharing"]
)
def test_a_rest_is_an_equilibrium(name: str) -> None:
    scenario = load_scenario(name, TRIO)
    equilibrium = find_equilibrium(scenario)
    assert np.abs(
        compute_equilibrium_residual(OperatingConditions.derive(scenario), equilibrium)
    ).max() == pytest.approx(equilibrium.residual, abs=1e-14)
    assert equilibrium.residual <= MAX_EQUILIBRIUM_RESIDUAL


def test_a_settling_run_rests_where_it_ends() -> None:
    """The gravity anchor of the paper's experiment."""
    equilibrium = find_equilibrium(load_scenario("paper", TRIO))
    assert equilibrium.q == pytest.approx(np.tile([-0.1729, 0.0874], (3, 1)), abs=2e-3)
    assert equilibrium.theta_hat[:, 3:] == pytest.approx(np.tile([2.0, 1.0], (3, 1)), abs=1e-6)
    assert "the run is at rest" in equilibrium.how


@pytest.mark.long
def test_diverging_runs_rest_at_the_kept_mean() -> None:
    """Equal gains: the mean of the start poses is conserved."""
    scenario = load_scenario("p_d_margin", {**TRIO, "control.d": 0.1, "link.delay_ms": 400.0})
    equilibrium = find_equilibrium(scenario)
    starts = np.mean([site.q0_rad for site in scenario.sites.values()], axis=0)
    assert "the run diverges at" in equilibrium.how
    assert equilibrium.q == pytest.approx(np.tile(starts, (3, 1)), abs=1e-9)
    assert equilibrium.q == pytest.approx(predict_equilibrium(scenario).q)


def test_the_kept_mean_weighs_damping_and_delay() -> None:
    """The pose that the linear loop predicts is that in which a run ends."""
    scenario = load_scenario(
        "p_d_margin_two",
        {**TRIO, "sites.m.control.d": 9.0, "sites.s.control.d": 4.0, "duration_s": 60.0},
    )
    assert predict_equilibrium(scenario).q == pytest.approx(
        find_equilibrium(scenario).q, abs=5e-3
    )


def test_hammering_runs_have_a_contact_equilibrium() -> None:
    scenario = load_scenario("contact", {**TRIO, "rate_hz": 500})
    equilibrium = find_equilibrium(scenario)
    assert "still moves" in equilibrium.how
    now = OperatingConditions.derive(scenario)
    # settles at the same pose
    calm = find_equilibrium(load_scenario("contact", {"rate_hz": 500, "link.delay_ms": 20.0}))
    assert "at rest" in calm.how
    assert equilibrium.q == pytest.approx(calm.q, abs=1e-9)
    assert np.abs(compute_equilibrium_residual(now, calm)).max() <= MAX_EQUILIBRIUM_RESIDUAL


def test_a_users_pose_is_taken_unchanged() -> None:
    scenario = load_scenario("free")
    equilibrium = find_equilibrium(scenario, (0.1, 0.3))
    assert equilibrium.q.tolist() == [[0.1, 0.3]] * 3
    assert equilibrium.theta_hat == pytest.approx(np.tile([3.0, 1.0, 1.0, 2.0, 1.0], (3, 1)))
    assert equilibrium.notes == ()


def test_poses_out_of_rest_are_reported() -> None:
    (note,) = find_equilibrium(
        load_scenario("p_d_margin_two", {"control.gravity": 0.5}), (0.1, 0.3)
    ).notes
    assert "the pose is no equilibrium" in note


def test_a_torque_beyond_the_clamp_is_reported() -> None:
    notes = find_equilibrium(
        load_scenario("free", {"limits.tau_limit_nm": 5.0}), (0.1, 0.3)
    ).notes
    assert [note.split()[0] for note in notes] == ["m1", "m2", "s"]
    assert all("its clamp is 5" in note for note in notes)


def test_rests_move_with_their_key() -> None:
    scenario = load_scenario("p_d_margin_two")
    rest = find_equilibrium(scenario, (0.3, 0.0))
    assert (
        follow_equilibrium(load_scenario(scenario, {"control.d": 1.0}), rest).q.tolist()
        == rest.q.tolist()
    )
    hand = {"kind": "spring", "to_rad": [0.3, 0.0], "stiffness_nm_rad": 20.0}
    sagged = follow_equilibrium(
        load_scenario(scenario, {"sites.m.hands": [hand], "sites.s.control.gravity": 0.9}), rest
    )
    assert sagged.residual <= MAX_EQUILIBRIUM_RESIDUAL
    assert sagged.q[1, 0] < sagged.q[0, 0] < 0.3  # s hangs on m, which a hand holds


def test_a_loop_without_rest_is_refused() -> None:
    """A torque that exceeds the arms' limits everywhere."""
    push = {"kind": "recorded", "points": [[0.0, 500.0, 0.0], [1000.0, 500.0, 0.0]]}
    scenario = load_scenario(
        "p_d_margin_two", {**TRIO, "sites.m.hands": [push], "duration_s": 2.0}
    )
    with pytest.raises(ScenarioError, match="has no equilibrium near"):
        find_equilibrium(scenario)


@pytest.mark.parametrize("pose", [(float("nan"), 0.0), (float("inf"), 0.0)])
def test_an_invalid_pose_is_refused(pose: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="pose must be two angles"):
        find_equilibrium(load_scenario("free"), pose)
