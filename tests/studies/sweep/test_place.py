"""Places: every run is counted once, and a share has its interval."""

import math
from pathlib import Path

import numpy as np
import pytest

from trilat_net.studies.sweep import cell_result, prepare_sweep_folder, run_sweep
from trilat_net.studies.sweep.cell_result import CellClass
from trilat_net.studies.sweep.sweep_results import (
    GRID_POINTS_FILE,
    GridPoint,
    collect_grid_points,
    wilson_interval,
)

from .quick import DELAYS, Judge, asked


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[GridPoint]:
    monkeypatch.setattr(cell_result, "classify_cell", Judge())
    sweep = asked(tmp_path, over=["link.loss=0:0.5:0.1", DELAYS], seeds=12)
    return collect_grid_points(run_sweep(prepare_sweep_folder(sweep, tmp_path / "o"), 1).results)


def test_every_run_is_counted_once(found: list[GridPoint]) -> None:
    assert [place.cell for place in found] == list(range(18))
    assert [sum(place.counts) for place in found] == [1] * 3 + [12] * 15
    for place in found:
        converged, bounded, diverged, undecided = place.counts
        assert (place.stable, place.decided) == (converged, converged + bounded + diverged)
        assert place.decided + undecided == sum(place.counts)
        assert place.doubtful == (0 < converged < place.decided)
        assert place.interval == wilson_interval(converged, converged + bounded + diverged)


def test_they_stand_in_a_file_where_there_are_seeds(found: list[GridPoint], tmp_path: Path) -> None:
    polars = pytest.importorskip("polars")
    rows = polars.read_parquet(tmp_path / "o" / GRID_POINTS_FILE).to_dicts()
    for row, place in zip(rows, found, strict=True):
        assert tuple(row[verdict.value] for verdict in CellClass) == place.counts
        assert (row["link.loss"], row["link.delay_ms"]) == place.values
        assert (row["stable_share_low"], row["stable_share_high"]) == place.interval
        if place.decided:
            assert row["stable_share_low"] <= row["stable_share"] <= row["stable_share_high"]
        else:
            assert row["stable_share"] is None


@pytest.mark.parametrize(
    ("successes", "runs", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_intervals_are_those_of_a_published_table(successes: int, runs: int, low: float, high: float) -> None:
    """Newcombe, Statistics in Medicine 17 (1998), table I, the score method without continuity correction."""
    assert wilson_interval(successes, runs) == pytest.approx((low, high), abs=5.1e-5)


@pytest.mark.parametrize("runs", [10, 20, 100])
def test_the_truth_lies_inside_95_times_of_100_on_the_average_over_shares(runs: int) -> None:
    """Coverage by the binomial sums, over even shares: 0.95 within 0.01; nowhere below 0.83."""
    shares = np.linspace(0.0005, 0.9995, 1000)
    held = np.zeros(len(shares))
    for seen in range(runs + 1):
        weight = math.comb(runs, seen) * shares**seen * (1.0 - shares) ** (runs - seen)
        low, high = wilson_interval(seen, runs)
        held += np.where((low <= shares) & (shares <= high), weight, 0.0)
    assert held.mean() == pytest.approx(0.95, abs=0.01)
    assert held.min() > 0.83


def test_without_runs_nothing_is_known() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)
