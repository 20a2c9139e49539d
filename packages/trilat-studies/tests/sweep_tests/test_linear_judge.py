"""A sweep that is judged by roots runs nothing, and has the edge of the linear loop."""

from pathlib import Path

import pytest
from study_builders import plan_quick_sweep, replace_judge, run_plan
from trilat_studies.sweep import plan_sweep, read_results
from trilat_studies.sweep.stability_map import ZERO_RATE, StabilityMap
from trilat_studies.sweep.sweep_cell import CellClass, CellResult

from trilat_net.analysis.theory import iterate_linear_edges
from trilat_net.scenario import load_scenario

AXES = ("link.delay_ms=100,200,300", "control.d=0.4:2.4:0.2")


def refuse_runs(_text: str, _longest_s: float) -> CellResult:
    raise AssertionError("a cell ran")


def test_linear_cells_have_the_known_edge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every column changes its class beside the edge that the linear analysis of a key finds."""
    replace_judge(monkeypatch, refuse_runs)
    plan = plan_sweep("p_d_margin", over=AXES, judge="linear")
    results = run_plan(plan, tmp_path / "o").results
    assert read_results(tmp_path / "o").rows == results.rows

    chart = StabilityMap.of_sweep(results, (), 1)
    (panel,) = chart.plane.panels
    assert chart.plane.is_linear
    assert chart.lines[0][0].text == ZERO_RATE

    edges = chart.plane.find_edges(panel)
    assert len(edges) == 3
    for delay_ms, edge in edges:
        scenario = load_scenario("p_d_margin", {"link.delay_ms": delay_ms})
        (linear_edge,) = iterate_linear_edges(scenario, "control.d", 0.4, 2.4, points=8)
        assert edge.low <= linear_edge.value <= edge.high
        assert edge.stable_below is not linear_edge.stable_above

    for row in results.rows:
        assert row["rests_on"].startswith("characteristic roots")
        assert (row["exponent_per_s"] > 0.0) == (row["verdict"] == "diverged")
        assert (row["motion"], row["ran_s"], row["peak_error_rad"]) == (None, 0.0, None)


def test_sampled_loops_have_floquet_multipliers(tmp_path: Path) -> None:
    plan = plan_sweep("p_d_margin", ["scheme=digital"], over=["control.d=2"], judge="linear")
    (row,) = run_plan(plan, tmp_path / "o").results.rows
    assert row["rests_on"].startswith("Floquet multipliers")


def test_cells_without_linear_form_say_so(tmp_path: Path) -> None:
    plan = plan_quick_sweep(
        tmp_path,
        "control.law=tdpa",
        "scheme=digital",
        over=["link.delay_ms=0,20"],
        judge="linear",
    )
    results = run_plan(plan, tmp_path / "o").results
    for row in results.rows:
        assert row["verdict"] == CellClass.UNDECIDED
        assert row["reasons"].startswith("no linear analysis: ")
