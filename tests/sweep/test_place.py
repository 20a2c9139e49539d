"""Places: every run is counted once, and a share has its interval."""

from pathlib import Path

import pytest

from trilat_net.sweep import judging, new_folder, run
from trilat_net.sweep.interval import wilson
from trilat_net.sweep.outcome import Verdict
from trilat_net.sweep.place import PLACES, Place, places

from .quick import DELAYS, Judge, asked


@pytest.fixture
def found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Place]:
    monkeypatch.setattr(judging, "judge", Judge())
    sweep = asked(tmp_path, over=["link.loss=0:0.5:0.1", DELAYS], seeds=12)
    return places(run(new_folder(sweep, tmp_path / "o"), 1).results)


def test_every_run_is_counted_once(found: list[Place]) -> None:
    assert [place.cell for place in found] == list(range(18))
    assert [sum(place.counts) for place in found] == [1] * 3 + [12] * 15
    for place in found:
        converged, bounded, diverged, undecided = place.counts
        assert (place.stable, place.decided) == (converged, converged + bounded + diverged)
        assert place.decided + undecided == sum(place.counts)
        assert place.doubtful == (0 < converged < place.decided)
        assert place.interval == wilson(converged, converged + bounded + diverged)


def test_they_stand_in_a_file_where_there_are_seeds(found: list[Place], tmp_path: Path) -> None:
    polars = pytest.importorskip("polars")
    rows = polars.read_parquet(tmp_path / "o" / PLACES).to_dicts()
    for row, place in zip(rows, found, strict=True):
        assert tuple(row[verdict.value] for verdict in Verdict) == place.counts
        assert (row["link.loss"], row["link.delay_ms"]) == place.values
        assert (row["stable_share_low"], row["stable_share_high"]) == place.interval
        if place.decided:
            assert row["stable_share_low"] <= row["stable_share"] <= row["stable_share_high"]
        else:
            assert row["stable_share"] is None


def test_without_seeds_there_is_no_such_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(judging, "judge", Judge())
    folder = run(new_folder(asked(tmp_path), tmp_path / "o"), 1).folder
    assert not (folder.path / PLACES).exists()
