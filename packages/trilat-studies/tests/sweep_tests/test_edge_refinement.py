"""A refined sweep finds the edge of the full grid with few of its cells."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from study_builders import StopError, make_cell_result, replace_judge, run_plan, stop_after
from trilat_studies.sweep import prepare_sweep_folder, run_sweep
from trilat_studies.sweep.edge_refinement import (
    NOT_KNOWN,
    STABLE,
    UNDECIDED,
    UNSTABLE,
    EdgeRefinement,
)
from trilat_studies.sweep.stability_map import StabilityMap
from trilat_studies.sweep.sweep_axis import SweepAxis
from trilat_studies.sweep.sweep_cell import CellClass, CellResult
from trilat_studies.sweep.sweep_plan import SweepPlan, plan_sweep
from trilat_studies.sweep.sweep_results import RESULTS_FILE
from trilat_studies.sweep.sweep_run import open_sweep_folder

from trilat_net.scenario import parse_scenario

Side = Callable[[float, float], int]
AXES = ("link.delay_ms=0:160:10", "control.d=0.2:3.4:0.2")


@cache
def small_plan() -> SweepPlan:
    """Returns the plan of a sweep of 17 delays and 17 dampings."""
    return plan_sweep("p_d_margin", ["duration_s=2"], over=AXES)


def grid(x: int, y: int, refine: int) -> SweepPlan:
    """Returns a plan with so many values on its axes."""
    axes = (f"link.delay_ms=0:{x - 1}:1", f"control.d=0.001:{y / 1000}:0.001")
    return small_plan()._replace(axes=tuple(map(SweepAxis.parse, axes)), refine=refine)


def refine_all(plan: SweepPlan, side_at: Side) -> tuple[np.ndarray, np.ndarray]:
    """Runs a refinement on a grid with known sides.

    Returns:
        The known sides, and those of the cells that the refinement chose.
    """
    _, columns, rows = plan.shape
    full = np.array([[side_at(i, j) for j in range(rows)] for i in range(columns)])
    refinement = EdgeRefinement(plan)
    refined_sides = np.full(full.shape, NOT_KNOWN)
    sides: dict[int, int] = {}
    while cells := refinement.find_next_cells(sides):
        assert (refined_sides.reshape(-1)[cells] == NOT_KNOWN).all()
        sides = {cell: int(full.reshape(-1)[cell]) for cell in cells}
        refined_sides.reshape(-1)[cells] = full.reshape(-1)[cells]
    return full, refined_sides


@settings(max_examples=25, deadline=None)
@given(
    st.integers(1, 5),
    st.integers(2, 70),
    st.integers(2, 70),
    st.floats(-40.0, 110.0),
    st.floats(0.0, 3.0),
    st.floats(0.2, 4.0),
    st.booleans(),
)
def test_both_sides_of_a_rising_edge_run(
    refine: int, x: int, y: int, first: float, slope: float, bend: float, stable_below: bool
) -> None:
    """Neighbours on different sides of a monotone edge are among the refined cells."""

    def side_at(i: float, j: float) -> int:
        return int((j < first + slope * x * (i / x) ** bend) == stable_below)

    full, refined_sides = refine_all(grid(x, y, refine), side_at)
    ran = refined_sides != NOT_KNOWN
    for axis in (0, 1):
        differs = np.diff(full, axis=axis) != 0
        both_ran = np.delete(ran, -1, axis) & np.delete(ran, 0, axis)
        assert not (differs & ~both_ran).any()


def test_a_fine_grid_needs_few_of_its_cells() -> None:
    def side_at(i: float, j: float) -> int:
        return STABLE if j > 30 + 120 * (i / 200) ** 0.5 else UNSTABLE

    full, refined_sides = refine_all(grid(201, 201, 5), side_at)
    assert np.count_nonzero(refined_sides != NOT_KNOWN) <= full.size / 20


def test_cells_without_a_side_draw_no_edge() -> None:
    """A part of the grid is not valid; its border is not refined."""
    full, refined_sides = refine_all(
        grid(65, 65, 4), lambda i, _: NOT_KNOWN if i > 30 else STABLE
    )
    coarse = EdgeRefinement(grid(65, 65, 4)).list_coarse_cells()
    assert np.count_nonzero(refined_sides == STABLE) == np.count_nonzero(
        full.reshape(-1)[coarse] == STABLE
    )


def test_a_cell_has_the_side_of_most_runs() -> None:
    assert EdgeRefinement.choose_side(stable=0, decided=0) == UNDECIDED
    assert EdgeRefinement.choose_side(stable=1, decided=2) == UNDECIDED
    assert EdgeRefinement.choose_side(stable=2, decided=3) == STABLE
    assert EdgeRefinement.choose_side(stable=1, decided=3) == UNSTABLE


def judge_by_line(text: str, longest_s: float) -> CellResult:
    """Stands for the judge: stable above a straight edge."""
    scenario = parse_scenario(text)
    delay_ms = scenario.links["m1->s"].delay_ms  # type: ignore[attr-defined]
    d = scenario.sites["s"].control.d[0]  # type: ignore[attr-defined]
    verdict = CellClass.CONVERGED if d > 0.7 + 0.013 * delay_ms else CellClass.BOUNDED
    result = make_cell_result(text, longest_s)
    return msgspec.structs.replace(result, verdict=verdict, diverged_s=None)


def test_an_interrupted_refinement_ends_as_any_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its rows are those of the full sweep, and so are its edges."""
    replace_judge(monkeypatch, judge_by_line)
    plan = small_plan()._replace(refine=2)
    whole = run_plan(small_plan(), tmp_path / "whole")
    refined = run_plan(plan, tmp_path / "refined")

    rows_of_whole = {row["cell"]: row for row in whole.results.rows}
    runs = len(refined.results.rows)
    assert 25 < runs < 0.5 * len(rows_of_whole)
    assert all(rows_of_whole[row["cell"]] == row for row in refined.results.rows)

    folder = prepare_sweep_folder(plan, tmp_path / "parts")
    for count in (3, 26, runs - 1):
        with pytest.raises(StopError):
            run_sweep(folder, 1, stop_after(count))
        folder = open_sweep_folder(folder.path)
        assert len(folder.read_done()) == count
    assert run_sweep(folder, 1).runs == 1
    table = (tmp_path / "refined" / RESULTS_FILE).read_bytes()
    assert (folder.path / RESULTS_FILE).read_bytes() == table

    planes = [
        StabilityMap.of_sweep(swept.results, (), linearly=False).plane
        for swept in (whole, refined)
    ]
    edges = [plane.find_edges(plane.panels[0]) for plane in planes]
    assert edges[0] == edges[1]
    assert len(edges[0]) >= len(planes[0].x.values) - 1
