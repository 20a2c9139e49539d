"""Runs of the benchmark that are computed side by side give the files of runs one by one."""

from pathlib import Path

import pytest
from study_builders import (
    StopError,
    plan_small_suite,
    record_lane_times,
    stop_after,
    use_lanes,
    use_single_runs,
)
from trilat_studies.bench import prepare_bench_folder, run_bench


def test_interrupted_lanes_give_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A benchmark in lanes that is interrupted and resumed has the runs of runs one by one."""
    lane_times_s = record_lane_times(monkeypatch)
    plan = plan_small_suite(links=["rtt68-loss25"], seeds=4)
    use_single_runs(monkeypatch)
    alone = run_bench(prepare_bench_folder(plan, tmp_path / "alone"), jobs=1)
    assert not lane_times_s

    use_lanes(monkeypatch)
    folder = prepare_bench_folder(plan, tmp_path / "lanes")
    with pytest.raises(StopError):
        run_bench(folder, jobs=1, progress=stop_after(2))
    assert lane_times_s
    resumed = run_bench(prepare_bench_folder(plan, tmp_path / "lanes"), jobs=1)
    assert resumed.runs == alone.runs
    assert resumed.encode_runs() == alone.encode_runs()
    assert resumed.alone == {}
