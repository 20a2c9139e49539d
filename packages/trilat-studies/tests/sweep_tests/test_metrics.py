"""Metrics of a sweep, requested by the keys of docs/reference/metrics.md, equal those of a log
of the same run.
"""

from pathlib import Path

import pytest
from trilat_studies.sweep.sweep_results import SweepResults, read_results

import trilat_net
from trilat_net.errors import UsageError
from trilat_net.log.log_reader import Log

KEYS = ["settle_s", "spread_rms_rad", "peak_tau_nm"]
AXIS = {"link.delay_ms": [20, 200]}


def run_metric_sweep(folder: Path, **more: object) -> SweepResults:
    return trilat_net.sweep(
        "two_sites", AXIS, ["duration_s=0.5"], metrics=KEYS, out=folder, jobs=1, **more
    )


def find_log_metric(log: Log, key: str) -> float | None:
    """Returns the metrics that `compare` shows of a log."""
    return trilat_net.compare(log, log).metrics.row(key).values[0]


def test_metrics_of_a_cell_equal_its_logs(tmp_path: Path) -> None:
    results = run_metric_sweep(tmp_path / "o", duration_s=0.5, longest_s=0.5)
    for row in results.rows:
        delay = row["link.delay_ms"]
        log = trilat_net.simulate("two_sites", {"duration_s": 0.5, "link.delay_ms": delay})
        assert {key: row[key] for key in KEYS} == {
            key: find_log_metric(log, key) for key in KEYS
        }


def test_every_row_holds_metrics_under_their_keys(tmp_path: Path) -> None:
    (row,) = trilat_net.sweep(
        "contact",
        ["link.delay_ms=20"],
        ["duration_s=12"],
        longest_s=12,
        out=tmp_path / "o",
        jobs=1,
    ).rows
    log = trilat_net.simulate("contact", {"duration_s": 12, "link.delay_ms": 20})
    for key in ("rms_error_rad", "walls_j", "force_peak_n"):
        assert row[key] == pytest.approx(find_log_metric(log, key), rel=1e-9)
    assert row["force_peak_n"] > 0.1


def test_a_resumed_sweep_keeps_its_metrics(tmp_path: Path) -> None:
    results = run_metric_sweep(tmp_path / "o")
    assert read_results(tmp_path / "o").to_rows() == results.to_rows()
    assert run_metric_sweep(tmp_path / "o").to_rows() == results.to_rows()
    with pytest.raises(
        UsageError, match=r"other metrics: settle_s, .* in the folder, none now"
    ):
        trilat_net.sweep("two_sites", AXIS, ["duration_s=0.5"], out=tmp_path / "o", jobs=1)


def test_seeds_give_a_metric_its_mean_and_interval(tmp_path: Path) -> None:
    trilat_net.sweep(
        "jitter",
        ["link.loss=0,0.2"],
        ["duration_s=0.3"],
        seeds=3,
        metrics=KEYS[:2],
        out=tmp_path / "o",
    )
    pandas = pytest.importorskip("pandas")
    places = pandas.read_csv(tmp_path / "o" / "places.csv")
    rows = pandas.read_csv(tmp_path / "o" / "results.csv")
    spreads_rad = rows[rows["cell"] == 1]["spread_rms_rad"]
    assert places["spread_rms_rad_mean"][1] == pytest.approx(spreads_rad.mean(), rel=1e-12)
    assert places["spread_rms_rad_half"][1] > 0.0
