"""What is said of a sweep: every run under one verdict, and what can be done next."""

from pathlib import Path

import pytest

from trilat_net.studies.sweep import cell_result, prepare_sweep_folder, run_sweep
from trilat_net.studies.sweep.cell_result import CellClass
from trilat_net.studies.sweep.sweep_report import (
    describe_sweep_plan,
    summarize_sweep,
)

from .quick import DELAYS, Judge, asked


def test_the_opening_names_axes_laws_and_seeds(tmp_path: Path) -> None:
    sweep = asked(
        tmp_path, over=["control.Kd=0.2:3:0.1", DELAYS], laws=["pd_d", "adaptive"], seeds=10, longest_s=1.0
    )
    assert describe_sweep_plan(sweep) == [
        "trio: 174 cells (29 x 3 x laws pd_d, adaptive), 10 seeds each where anything is random",
        "  over control.Kd=0.2:3:0.1: 0.2, 0.3, ..., 3.0",
        "  over link.delay_ms=0:40:20: 0, 20, 40",
        "  0.5 s each, one that is not plain by then up to 1 s",
    ]


def test_a_summary_counts_every_run_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cell_result, "classify_cell", Judge())
    sweep = asked(tmp_path, over=["link.loss=0:0.9:0.05"], seeds=8)
    results = run_sweep(prepare_sweep_folder(sweep, tmp_path / "o"), 1).results
    first, *others = summarize_sweep(results)
    assert first.startswith(f"{1 + 18 * 8} runs of 19 cells: ")
    counts = [int(part.split()[0]) for part in first.partition(": ")[2].split(", ")]
    assert counts == [sum(row["verdict"] == verdict for row in results.rows) for verdict in CellClass]
    assert sum(counts) == len(results.rows)
    text = "\n".join(others)
    assert "not plain after 0.5 s and went on, the longest to 4 s" in text
    assert "in 1 cell nothing is random: one seed was run there" in text
    assert "stable with some seeds and not with others" in text
    assert "95 % interval" in text
    assert "all in places.parquet" in text
