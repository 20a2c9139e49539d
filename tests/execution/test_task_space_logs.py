"""Logs of sites that follow with their end effectors: compared, judged, or refused in a sentence."""

import numpy as np
import pytest

import trilat_net
from tests.execution.builders import run_fused
from tests.scenario.builders import planar_task_text
from trilat_net.analysis.metrics.log_metrics import LogMetrics
from trilat_net.analysis.run_end import RunEnd
from trilat_net.log.log_reader import Log
from trilat_net.presentation.figures.registry import list_drawable_figures
from trilat_net.scenario import load_scenario, parse_scenario

pytestmark = pytest.mark.long  # compiled for arms of seven joints that follow places
SHORT = {"duration_s": 1.0}


@pytest.fixture(scope="module")
def log() -> Log:
    return trilat_net.simulate("unlike_arms", SHORT)


def test_task_records_equal_the_fused_runs(log: Log) -> None:
    """Places, velocities and wrenches of arms of two and of seven joints."""
    run = run_fused(load_scenario("unlike_arms", SHORT), 1.0)
    for record, name in zip(run.records, log.sites, strict=True):
        part = log[name]
        row = np.concatenate([getattr(part, field)[-1] for field in part.layout.lengths()])
        assert record[: len(row)].tolist() == row.tolist()


def test_task_errors_are_those_of_place(log: Log) -> None:
    for part in (log[name] for name in log.sites):
        assert part.e.shape[1] == 3
        followed = [0, 2] if part.name != "s" else [0, 1, 2]
        assert np.array_equal(part.e[:, followed], (part.x - part.q_des)[:, followed])
        assert (part.e[:, 1] == 0.0).all() or part.name == "s"
    assert np.abs(log["s"].e[-1]).max() < np.abs(log["s"].e[500]).max()


def test_errors_are_measured_and_drawn_in_metres(log: Log) -> None:
    metrics = LogMetrics.of_log(log)
    for site in log.sites:
        site_metrics = metrics.sites[site]
        part = log[site]
        assert site_metrics["rms_error_m"].value == pytest.approx(
            np.sqrt((part.e**2).mean(axis=0)).max()
        )
        assert not site_metrics["rms_error_rad"].applies
        assert site_metrics["unaccounted_j"].value < 1e-6
    distance = np.ptp([log[site].x[-1, [0, 2]] for site in log.sites], axis=0).max()
    assert metrics.run["spread_max_m"].value >= metrics.run["spread_end_m"].value >= distance
    assert {"tracking_errors", "settling", "phase"} <= set(list_drawable_figures(log))


def test_a_runs_end_is_in_metres(log: Log) -> None:
    assert RunEnd.of_log(log).error_unit == "m"


TOUCH = """[[sites.m.hands]]
kind = "tip_spring"
to_m = [1.1, 1.3, 0.0]
stiffness_n_m = 300
damping_n_s_m = 20
[[sites.s.environment]]
kind = "wall"
point_m = [0.8, 0.0, 0.0]
normal = [-1.0, 0.0, 0.0]
stiffness_n_m = 2000
damping_n_s_m = 20
"""


def test_wall_forces_follow_the_shares() -> None:
    """P+d holds e by K along each axis, so that the wrenches of two sites that rest cancel."""
    text = planar_task_text(8.0)
    head, rest = text.split("[control]")
    text = head + '[control]\nlaw = "p_d"\nK = 60.0\nd = 12.0\n[task]' + rest.split("[task]")[1]
    log = trilat_net.simulate(
        parse_scenario(text.replace("[dominance]", TOUCH + "[dominance]"))
    )
    metrics = LogMetrics.of_log(log)
    pair = next(
        sharing_ratio for sharing_ratio in metrics.sharing_ratios if sharing_ratio.by_wall
    )
    assert (metrics.label(pair.joint), metrics.unit("N m", pair.joint)) == ("x", "N")
    assert pair.expected_nm.value is not None
    assert pair.felt_nm == pytest.approx(pair.expected_nm.value, rel=1e-3)
    assert pair.pushed_nm == pytest.approx(-log["s"].wrench[-500:, 0].mean(), rel=1e-2)
    assert metrics.walls["s/1"]["end_force_mean_n"].value == pytest.approx(
        -pair.pushed_nm, rel=1e-2
    )
    entry = next(ratio for ratio in metrics.to_dict()["force_sharing"] if ratio["axis"] == "x")
    assert entry["felt_n"] == pair.felt_nm
    assert "felt_nm" not in entry
