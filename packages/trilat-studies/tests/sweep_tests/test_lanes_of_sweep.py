"""A sweep whose cells run side by side has the table of a sweep whose cells run one by one."""

from pathlib import Path

import pytest
from study_builders import record_lane_times, use_single_runs
from trilat_studies.side_by_side import describe_runs_alone
from trilat_studies.sweep import plan_sweep, sweep_run
from trilat_studies.sweep.sweep_results import RESULTS_FILE

from trilat_net.core.lanes.lane_structure import RunStructure
from trilat_net.execution.fused import FusedRun


def run_in(folder: Path) -> sweep_run.FinishedSweep:
    """Runs a sweep of 16 cells, half of them with two tick rates, in this process."""
    plan = plan_sweep(
        "free",
        ["duration_s=0.5"],
        over=["sites.s.rate_hz=1000,500", "control.Kd=1:4.5:0.5"],
        longest_s=1.0,
    )
    return sweep_run.run_sweep(sweep_run.prepare_sweep_folder(plan, folder), jobs=1)


def find_slow_site(run: FusedRun) -> str:
    """Stands for `RunStructure.find_obstacle`: lanes do not support a slow site."""
    return "a slow site" if run.scenario.sites["s"].rate_hz == 500 else ""


def test_table_does_not_depend_on_lanes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lane_times_s = record_lane_times(monkeypatch)
    use_single_runs(monkeypatch)
    alone = run_in(tmp_path / "alone")
    assert not lane_times_s
    assert describe_runs_alone(alone.alone, alone.runs) == ""

    monkeypatch.setattr(sweep_run, "LANE_SITE_TICKS", 0)
    monkeypatch.setattr(RunStructure, "find_obstacle", find_slow_site)
    together = run_in(tmp_path / "together")
    assert lane_times_s
    assert together.runs == alone.runs == len(together.results.rows)
    table = (tmp_path / "together" / RESULTS_FILE).read_bytes()
    assert table == (tmp_path / "alone" / RESULTS_FILE).read_bytes()
    assert describe_runs_alone(together.alone, together.runs) == (
        "8 of 16 runs were computed one by one: a slow site (8)"
    )
