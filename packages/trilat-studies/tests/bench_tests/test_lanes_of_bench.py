"""Runs of the benchmark that are computed side by side give the files of runs one by one."""

from pathlib import Path

import pytest
from trilat_studies.bench import bench_run, plan_bench, prepare_bench_folder, run_bench
from trilat_studies.bench.bench_plan import BenchPlan
from trilat_studies.bench.bench_results import encode_runs

from trilat_net.execution.lanes import run_groups
from trilat_net.execution.lanes.lane_run import LaneRun


def plan_lossy_runs() -> BenchPlan:
    """Returns a plan of four runs that differ in their seeds only."""
    return plan_bench(
        "round-trips", laws=["p_d"], tasks=["free"], links=["rtt68-loss25"], seeds=4
    )


def test_interrupted_lanes_give_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A benchmark in lanes, interrupted after two runs and resumed, has today's runs."""
    calls = []
    advance_to = LaneRun.advance_to

    def count_calls(lanes: LaneRun, until_s: float) -> None:
        calls.append(until_s)
        advance_to(lanes, until_s)

    def stop(done: int, _total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr(LaneRun, "advance_to", count_calls)
    monkeypatch.setattr(bench_run, "prepare_kinds", lambda _: {})
    alone = run_bench(prepare_bench_folder(plan_lossy_runs(), tmp_path / "alone"), jobs=1)
    assert not calls
    monkeypatch.undo()
    monkeypatch.setattr(LaneRun, "advance_to", count_calls)
    monkeypatch.setattr(run_groups, "has_lane_code", lambda _: True)
    with pytest.raises(KeyboardInterrupt):
        run_bench(
            prepare_bench_folder(plan_lossy_runs(), tmp_path / "lanes"), jobs=1, progress=stop
        )
    assert calls
    resumed = run_bench(prepare_bench_folder(plan_lossy_runs(), tmp_path / "lanes"), jobs=1)
    assert resumed.runs == alone.runs
    assert encode_runs(resumed) == encode_runs(alone)
    assert resumed.alone == {}
