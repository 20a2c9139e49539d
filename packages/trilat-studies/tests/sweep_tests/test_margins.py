"""Margins: an interval encloses each edge; over a plane beside theory, as table, page and JSON."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import replace_judge
from trilat_studies.sweep import margin_search
from trilat_studies.sweep.map_plane import StabilityEdge
from trilat_studies.sweep.margin_search import (
    SCAN_POINTS,
    GridPointMargin,
    KeyMargin,
    SearchRange,
    SweepMargins,
)
from trilat_studies.sweep.sweep_cell import CellClass, CellResult
from trilat_studies.sweep.sweep_plan import SweepPlan, plan_sweep

from tests.json_outline import is_documented
from trilat_net.analysis.run_end import EndBehaviour
from trilat_net.scenario import parse_scenario

WITHIN = SearchRange("control.d", 0.2, 3.0, 0.005)


def plan_margin_sweep(*over: str, **settings: object) -> SweepPlan:
    """Returns the plan of a search along the damping, at each delay if no axis is given."""
    axes = over or ("link.delay_ms=100,200",)
    return plan_sweep("p_d_margin", over=[*axes, WITHIN.format_axis()], **settings)  # type: ignore[arg-type]


@pytest.fixture
def judge_by_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets the condition of P+d judge every cell."""

    def judge(text: str, _: float) -> CellResult:
        scenario = parse_scenario(text)
        delay_s = max(link.moments().mean_ms for link in scenario.links.values()) / 1e3
        stable = scenario.sites["s"].control.d[0] > 5.0 * delay_s  # type: ignore[union-attr]
        verdict = CellClass.CONVERGED if stable else CellClass.DIVERGED
        motion = EndBehaviour.CONVERGED if stable else EndBehaviour.DIVERGED
        return CellResult(verdict, motion, 1.0, 0, 0.0, 0.0, None, None, 0.0, None, None)

    replace_judge(monkeypatch, judge)


@pytest.fixture
def without_roots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves out the linear analysis, which takes seconds."""
    monkeypatch.setattr(margin_search.GrowthColumn, "find_crossings", lambda *_, **__: ((), ""))


@pytest.mark.usefixtures("judge_by_line")
def test_a_place_has_its_edge_beside_theory() -> None:
    (point,) = SweepMargins.search(plan_margin_sweep("link.delay_ms=200"), WITHIN, 1).found
    assert point.cell.values == (200.0,)
    (span,) = point.margin.spans
    assert span.low <= 1.0 <= span.high
    assert point.closed == pytest.approx(1.0)
    assert point.linear == (pytest.approx(1.0, rel=0.04),)
    assert point.remark == ""


@pytest.mark.usefixtures("judge_by_line", "without_roots")
def test_seeds_are_places_where_links_are_random() -> None:
    lossy = SweepMargins.search(plan_margin_sweep("link.loss=0,0.1", seeds=2), WITHIN, 1).found
    assert [(point.cell.values, point.seed) for point in lossy] == [
        ((0.0,), 1),
        ((0.1,), 1),
        ((0.1,), 2),
    ]


@pytest.mark.long
def test_the_number_of_processes_changes_nothing() -> None:
    """Runs of p_d at 100 Hz for 1 s; their verdicts do not matter."""
    brief = ["duration_s=1.0", "rate_hz=100"]
    within = WITHIN._replace(tolerance=0.2)
    plan = plan_sweep(
        "p_d_margin",
        brief,
        over=["link.delay_ms=100,400", within.format_axis()],
        longest_s=1.0,
    )
    assert (
        SweepMargins.search(plan, within, 1).found == SweepMargins.search(plan, within, 2).found
    )


@pytest.mark.usefixtures("judge_by_line", "without_roots")
def test_whole_number_keys_are_searched_in_integers() -> None:
    """The judge gives 300 Hz and 50 Hz the same verdict; no value between whole numbers may be run."""
    within = SearchRange("rate_hz", 50.0, 300.0, 0.005)
    plan = plan_sweep("p_d_margin", over=["link.delay_ms=100,200", within.format_axis()])
    assert [margin.margin.stable for margin in SweepMargins.search(plan, within, 1).found] == [
        True,
        True,
    ]


def make_point_margin(*spans: StabilityEdge, stable: bool | None = None) -> GridPointMargin:
    """Returns the result of a search at 100 ms with these edges."""
    cell = plan_margin_sweep().cell(0)
    return GridPointMargin(
        cell._replace(values=(100.0,)), 1, KeyMargin(spans, stable, 0, 12), (0.5, 2.0), "", 0.51
    )


def test_table_shows_edges_islands_and_missing_edges() -> None:
    """Each edge has a row beside its linear edge, and a search without edges says why."""
    edges = (StabilityEdge(0.49, 0.492, False, True), StabilityEdge(1.8, 2.1, True, False))
    points = [
        make_point_margin(*edges),
        make_point_margin(stable=True),
        make_point_margin(stable=False),
        make_point_margin(),
    ]

    grid = SweepMargins(plan_margin_sweep(), WITHIN, points).table()
    edge = grid.headers.index("edge of d (N m s/rad)")
    assert [row[edge] for row in grid.rows] == [
        "0.49 to 0.492",
        "1.8 to 2.1 (undecided between)",
        "none: all stable",
        "none: nothing stable",
        "none: nothing decided",
    ]
    assert [row[edge + 1] for row in grid.rows] == ["above", "below", "-", "-", "-"]

    linear = grid.headers.index("linear")
    assert [row[linear] for row in grid.rows[:2]] == ["0.5", "2"]  # each beside its own
    assert grid.rows[0][linear + 1] == f"{100 * (0.5 / 0.491 - 1):+.2f} %"

    page = SweepMargins(plan_margin_sweep(), WITHIN, points[:2]).page()
    assert "not monotone at 1 of 2 grid points" in page


def test_the_facts_are_json_and_name_the_command() -> None:
    margins = SweepMargins(
        plan_margin_sweep(),
        WITHIN,
        [make_point_margin(StabilityEdge(0.49, 0.492, False, True))],
    )
    facts = json.loads(json.dumps(margins.to_dict(), allow_nan=False))
    assert facts["command"] == margins.command
    assert facts["command"].endswith(
        "--over link.delay_ms=100,200 --margin control.d=0.2:3 --tolerance 0.005"
    )
    (point,) = facts["places"]
    assert point.pop("link.delay_ms") == 100.0
    assert is_documented("sweep --margin", facts)
    assert point["edges"] == [
        {"low": 0.49, "high": 0.492, "stable_below": False, "sharp": True}
    ]


def test_a_range_is_read_as_written() -> None:
    assert SearchRange.parse("control.d=0.2:3") == WITHIN
    assert WITHIN.format_axis() == "control.d=0.2,3"


@given(st.floats(0.25, 2.95), st.booleans(), st.sampled_from([0.05, 0.005, 1e-4]))
def test_an_edge_is_enclosed_to_the_tolerance(
    edge: float, above: bool, tolerance: float
) -> None:
    """The search encloses a sharp edge, runs no value twice, and needs few runs."""
    values = []

    def stable(value: float) -> bool:
        values.append(value)
        return (value > edge) is above

    margin = KeyMargin.search(stable, 0.2, 3.0, tolerance)
    (span,) = margin.spans
    assert span.low <= edge <= span.high
    assert span.high - span.low <= tolerance * span.high
    assert span.stable_below is not above
    assert span.sharp
    assert margin.runs == len(values) == len(set(values))
    scan_step = 2.8 / (SCAN_POINTS - 1)
    most_bisections = 1 + math.log2(scan_step / (0.2 * tolerance))
    assert margin.runs <= SCAN_POINTS + most_bisections


@given(st.floats(0.35, 2.8), st.floats(0.001, 0.1), st.booleans())
def test_an_undecided_part_is_the_reported_interval(
    edge: float, width: float, above: bool
) -> None:
    """An edge is as wide as the values around it at which runs stay undecided."""

    def stable(value: float) -> bool | None:
        return None if abs(value - edge) < width else (value > edge) is above

    margin = KeyMargin.search(stable, 0.2, 3.0, 0.01)
    (span,) = margin.spans
    assert span.low <= edge - width + 1e-9
    assert edge + width - 1e-9 <= span.high
    if span.sharp:
        assert span.high - span.low <= 0.01 * span.high
    else:
        assert margin.undecided > 0
        assert (edge - width) - span.low <= 0.01 * span.high
        assert span.high - (edge + width) <= 0.01 * span.high


@pytest.mark.parametrize("side", [True, False, None])
def test_without_change_only_the_side_is_reported(side: bool | None) -> None:
    margin = KeyMargin.search(lambda _: side, 0.2, 3.0)
    assert (margin.spans, margin.stable, margin.runs) == ((), side, SCAN_POINTS)


def test_an_island_has_two_edges() -> None:
    margin = KeyMargin.search(lambda value: not 1.0 < value < 1.9, 0.0, 4.0)
    first, second = margin.spans
    assert first.low <= 1.0 <= first.high
    assert second.low <= 1.9 <= second.high
    assert (first.stable_below, second.stable_below) == (True, False)
    assert margin.stable is None


@given(st.floats(20.2, 299.8))
def test_whole_numbers_are_narrowed_to_neighbours(edge: float) -> None:
    def stable(value: float) -> bool:
        assert value == round(value)
        return value > edge

    (span,) = KeyMargin.search(stable, 20.0, 300.0, 1e-9, whole=True).spans
    assert (span.low, span.high) == (math.floor(edge), math.floor(edge) + 1) or edge == round(
        edge
    )


def test_searching_an_edge_near_zero_ends() -> None:
    """A tolerance relative to 0 is never met."""
    (span,) = KeyMargin.search(lambda value: value > 1e-300, 0.0, 1.0).spans
    assert span.low <= 1e-300 <= span.high
    (span,) = KeyMargin.search(lambda value: value > 0.0, -1.0, 1.0).spans
    assert span.low <= 0.0 <= span.high
