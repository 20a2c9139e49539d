"""Theory on a map: conditions in closed form and lines column by column, both independent of the runs."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from study_builders import make_map_rows
from trilat_studies.run_commands import format_override_value
from trilat_studies.sweep.map_plane import PlaneAxis
from trilat_studies.sweep.stability_criteria import StabilityCriterion
from trilat_studies.sweep.stability_map import MapLine, StabilityMap
from trilat_studies.sweep.sweep_plan import plan_sweep
from trilat_studies.sweep.sweep_results import SweepResults

from trilat_net.analysis.theory.linear_edge import GrowthColumn, iterate_linear_edges
from trilat_net.errors import ScenarioError
from trilat_net.scenario import Scenario, load_scenario

OVER = ("link.delay_ms=0:400:100", "control.d=0.2:2.2:0.5")


def results(**axes: tuple[object, ...]) -> SweepResults:
    over = [
        *OVER,
        *(f"{key.replace('__', '.')}={','.join(map(str, some))}" for key, some in axes.items()),
    ]
    return SweepResults(plan_sweep("p_d_margin", over=over), list(make_map_rows(**axes)))


def test_every_panel_has_its_own_lines() -> None:
    """Play-out of 400 ms requires d = 2 whatever the delay."""
    stability_map = StabilityMap.of_sweep(
        results(link__playout_ms=(0.0, 400.0)), ("trilat sweep",), linearly=False
    )
    (direct,), (played,) = stability_map.lines
    y = stability_map.plane.y
    assert np.allclose(
        [direct.crossings(n, y) for n in range(1, 5)], [[0.5], [1.0], [1.5], [2.0]]
    )
    assert np.allclose([played.crossings(n, y) for n in range(5)], 2.0)
    assert stability_map.remarks == ()


@pytest.mark.long
def test_lines_depend_on_neither_runs_nor_processes() -> None:
    """Lines from theory stay the same if a run is missing, or if two processes compute them."""
    all_runs = results()
    one_run_less = replace(all_runs, rows=[row for row in all_runs.rows if row["cell"] != 7])
    (closed, rooted), (same_closed, same_rooted) = (
        StabilityMap.of_sweep(results_of_runs, (), jobs).lines[0]
        for results_of_runs, jobs in ((all_runs, 1), (one_run_less, 2))
    )
    assert (closed.rank, rooted.rank) == (0, 1)
    assert np.array_equal(closed.excess, same_closed.excess)
    assert np.array_equal(rooted.excess, same_rooted.excess)


def test_short_delays_have_the_condition_as_line() -> None:
    """The mode at the edge is slow against 1/T there, and the condition exact: within 2 % at 100 ms."""
    damping = PlaneAxis("control.d", (0.46, 0.48, 0.50, 0.52), "d")
    scenarios = [at(100.0, d) for d in damping.values]
    line, _ = MapLine.trace_linear_analysis(
        [GrowthColumn.compute(scenarios, "control.d", damping.values)] * 2, damping
    )
    assert line is not None
    assert line.crossings(0, damping) == [pytest.approx(0.5, rel=0.02)]


@pytest.mark.long
def test_coarse_map_has_the_exact_linear_line() -> None:
    """From 0.6 on another mode is the rightmost; a straight line between 0.2 and 0.7 would pass 0.593."""
    damping = PlaneAxis("control.d", (0.2, 0.7, 1.2), "d")
    scenarios = [at(100.0, d) for d in damping.values]
    line, _ = MapLine.trace_linear_analysis(
        [GrowthColumn.compute(scenarios, "control.d", damping.values)] * 2, damping
    )
    edge = next(iterate_linear_edges(scenarios[0], "control.d", 0.2, 1.2), None)
    assert line is not None
    assert edge is not None
    assert (
        line.crossings(0, damping)
        == [pytest.approx(edge.value, rel=1e-6)]
        == [pytest.approx(0.4957, abs=1e-4)]
    )


def test_a_strip_has_no_lines() -> None:
    plan = plan_sweep("p_d_margin", over=OVER[:1])
    rows_of_strip = [row for row in make_map_rows() if row["control.d"] == 0.7]
    assert StabilityMap.of_sweep(SweepResults(plan, rows_of_strip), ()).lines == ((),)


def test_place_of_panel_is_cell_of_plan() -> None:
    """Lines belong to the scenarios that run: every cell's scenario, with every law."""
    plan = plan_sweep("p_d_margin", over=[*OVER, "link.playout_ms=0,400"], laws=("p_d", "pd_d"))
    rows_by_panel = []
    for law, row in product(("p_d", "pd_d"), make_map_rows(link__playout_ms=(0.0, 400.0))):
        rows_by_panel.append({**row, "law": law})

    plane = StabilityMap.of_sweep(SweepResults(plan, rows_by_panel), (), linearly=False).plane
    assert [panel.title for panel in plane.panels] == [
        f"{law}, playout {ms} ms" for law in ("p_d", "pd_d") for ms in (0, 400)
    ]

    for n in range(0, plan.cells, 7):
        cell = plan.cell(n)
        playout = cell.values[2]
        (panel,) = (
            p
            for p in plane.panels
            if p.settings == (("law", cell.law), ("link.playout_ms", playout))
        )

        at = panel.make_loader(plan, plane.x.key, plane.y.key)
        delay, damping = cell.values[:2]
        assert isinstance(delay, float)
        assert isinstance(damping, float)
        assert at(delay, damping) == plan.scenario(*cell.overrides)


@pytest.mark.parametrize(
    ("value", "text"), [(100.0, "100"), (0.3, "0.3"), (5, "5"), (1e-7, "1e-07"), (-2.5, "-2.5")]
)
def test_a_numeric_override_is_that_number(value: float, text: str) -> None:
    assert format_override_value(value) == text
    assert float(format_override_value(value)) == value
    assert format_override_value("in_order") == "in_order"


DELAY = PlaneAxis("link.delay_ms", (0.0, 100.0, 200.0, 300.0, 400.0, 800.0), "delay (ms)")
DAMPING = PlaneAxis("control.d", (0.2, 0.7, 1.2, 1.7, 2.2), "d (N m s/rad)")
P_D = load_scenario("p_d_margin")


def at(x: float, y: float) -> Scenario:
    """Returns P+d with a delay of x ms and the damping y."""
    return load_scenario(P_D, {"link.delay_ms": x, "control.d": y})


def spare(excess: float) -> StabilityCriterion:
    """Returns a criterion that holds with some margin, or fails if it is negative."""
    return StabilityCriterion("", "", "", excess)


def test_the_line_is_half_stiffness_times_delay() -> None:
    """No d of the map is little enough for no delay, or enough for 800 ms."""
    line = MapLine.trace_closed_form(at, DELAY, DAMPING)
    assert line is not None
    crossings = [line.crossings(column, DAMPING) for column in range(6)]
    assert [len(some) for some in crossings] == [0, 1, 1, 1, 1, 0]
    assert np.allclose([some[0] for some in crossings[1:5]], [0.5, 1.0, 1.5, 2.0], rtol=1e-9)
    assert (line.excess > 0.0)[-1, 0]
    assert not (line.excess > 0.0)[0, -1]


def test_a_law_without_a_condition_has_no_line() -> None:
    assert (
        MapLine.trace_closed_form(
            lambda x, _: load_scenario("free", {"link.delay_ms": x}), DELAY, DAMPING
        )
        is None
    )


def test_an_unaffected_condition_has_no_line() -> None:
    assert (
        MapLine.trace_closed_form(
            lambda x, _: load_scenario(P_D, {"link.delay_ms": x, "control.d": 9.0}),
            DELAY,
            DAMPING,
        )
        is None
    )


@given(st.floats(-50.0, 50.0), st.floats(1.0, 3.0), st.sampled_from([-1.0, 1.0]))
def test_a_condition_holds_without_any_reserve(root: float, power: float, sign: float) -> None:
    """The edge is found as a zero of the margin, also where the margin's slope is zero."""

    def condition(value: float) -> StabilityCriterion:
        gap = value - root
        return spare(sign * float(np.sign(gap)) * abs(gap) ** power)

    edge = StabilityCriterion.find_edge(condition, -60.0, 60.0)
    assert edge is not None
    assert abs(condition(edge).excess) <= 1e-5 * 120.0**power


def test_whole_number_keys_have_no_points_between() -> None:
    def condition(value: float) -> StabilityCriterion:
        if value != round(value):
            raise ScenarioError("is a whole number")
        return spare(value - 2.5)

    assert StabilityCriterion.find_edge(condition, 0.0, 7.0) is None


def grows(growth_per_s: list[float], edges: dict[int, float] | None = None) -> GrowthColumn:
    """Returns the growth rates of one column of a map."""
    return GrowthColumn(growth_per_s, edges or {}, [])


def test_the_linear_line_is_where_nothing_grows() -> None:
    """Real parts vanish along y = 0.4 x: positive below, negative above."""
    side = PlaneAxis("y", (0.0, 1.0, 2.0), "y")
    columns = [grows([0.4 * x - y for y in side.values]) for x in (0.0, 1.0, 2.0, 3.0)]
    line, remarks = MapLine.trace_linear_analysis(columns, side)
    assert line is not None
    assert not remarks
    assert np.allclose([line.crossings(n, side)[0] for n in (1, 2, 3)], [0.4, 0.8, 1.2])


def test_a_column_may_be_crossed_again_and_again() -> None:
    side = PlaneAxis("y", (0.0, 1.0, 2.0, 3.0), "y")
    line, _ = MapLine.trace_linear_analysis(
        [grows([-1.0, 1.0, 3.0, -1.0]), grows([-1.0, 1.0, 1.0, -1.0], {0: 0.9})], side
    )
    assert line is not None
    assert line.crossings(0, side) == [0.5, 2.75]
    assert line.crossings(1, side) == pytest.approx([0.9, 2.5])


@given(st.lists(st.floats(0.01, 0.99), min_size=1, max_size=6), st.sampled_from([-1.0, 1.0]))
def test_columns_are_crossed_at_edges_however_close(shares: list[float], sign: float) -> None:
    """A line passes through the exact edge between each two values of different sign."""
    side = PlaneAxis("y", tuple(map(float, range(len(shares) + 1))), "y")
    edges = {n: n + share for n, share in enumerate(shares)}
    column = grows([sign * (-1.0) ** n for n in range(len(shares) + 1)], edges)
    line, _ = MapLine.trace_linear_analysis([column] * 2, side)
    assert line is not None
    assert line.crossings(0, side) == pytest.approx([*edges.values()], abs=1e-6)


def test_without_motion_no_line_is_crossed() -> None:
    side = PlaneAxis("y", (0.0, 1.0, 2.0), "y")
    line, _ = MapLine.trace_linear_analysis(
        [grows([-np.inf, 1.0, -1.0]), grows([np.nan, 1.0, -1.0])], side
    )
    assert line is not None
    assert line.crossings(0, side) == line.crossings(1, side) == [1.5]


def test_without_change_there_is_no_line() -> None:
    why = ["nobody knows the delay"]
    side = PlaneAxis("y", (0.0, 1.0), "y")
    line, remarks = MapLine.trace_linear_analysis(
        [GrowthColumn([np.nan, np.nan], {}, why)] * 2, side
    )
    assert line is None
    assert remarks == why
    assert MapLine.trace_linear_analysis([grows([-1.0, -2.0]), grows([-1.0, -3.0])], side) == (
        None,
        [],
    )


GAIN = st.floats(0.1, 50.0)
DELAY_MS = st.integers(2, 5000)  # of one tick the sampling asks for more


def excess(scenario: Scenario) -> float:
    """Returns the margin by which a scenario satisfies its stability criterion."""
    criterion = StabilityCriterion.evaluate(scenario)
    assert criterion is not None
    return criterion.excess


@given(GAIN, GAIN, DELAY_MS)
def test_equal_sites_need_half_stiffness_times_delay(K: float, d: float, delay_ms: int) -> None:
    """Three sites with equal shares: the least eigenvalue of alpha is -1/2."""
    scenario = load_scenario(
        "p_d_margin", {"control.K": K, "control.d": d, "link.delay_ms": delay_ms}
    )
    assert excess(scenario) == pytest.approx(d - 0.5 * K * delay_ms / 1e3, abs=1e-9)


@given(GAIN, GAIN, GAIN, GAIN, DELAY_MS, DELAY_MS)
def test_the_general_conditions_sign_judges_two_sites(
    K1: float, K2: float, d1: float, d2: float, there_ms: int, back_ms: int
) -> None:
    """Two unlike sites satisfy 4 d1 d2 > (T12 + T21)^2 K1 K2."""
    names = load_scenario("p_d_margin_two").names
    settings: dict[str, Any] = {}
    for name, K, d in zip(names, (K1, K2), (d1, d2), strict=True):
        settings |= {
            f"sites.{name}.control.{key}": value
            for key, value in (("law", "p_d"), ("K", K), ("d", d))
        }
    settings |= {f"links.{names[0]}->{names[1]}.delay_ms": there_ms}
    settings |= {f"links.{names[1]}->{names[0]}.delay_ms": back_ms}
    margin = 4.0 * d1 * d2 - ((there_ms + back_ms) / 1e3) ** 2 * K1 * K2
    if abs(margin) > 1e-6:
        assert np.sign(excess(load_scenario("p_d_margin_two", settings))) == np.sign(margin)


def test_for_two_equal_sites_both_conditions_agree() -> None:
    """N = 2: abs(lambda_min) = 1, d = K T."""
    scenario = load_scenario(
        "p_d_margin_two", {"control.d": 2.0, "control.K": 10.0, "link.delay_ms": 200.0}
    )
    assert excess(scenario) == pytest.approx(0.0, abs=1e-12)


def test_digital_scheme_needs_gravity_learnt_slowly_enough() -> None:
    settings = {"scheme": "digital", "link.delay_ms": 0.0, "rate_hz": 100, "control.Gamma": 1.0}
    assert excess(load_scenario("paper", settings)) == pytest.approx(1.0 - 9.81**2 / 100)
    gravity = {**settings, "control.Gamma": [9.0, 9.0, 9.0, 1.0, 1.0]}
    assert excess(load_scenario("paper", gravity)) == pytest.approx(
        excess(load_scenario("paper", settings))
    )


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("free", {}),  # the theorem: stable for every constant delay, no line
        ("free", {"scheme": "digital"}),  # with a delay of many ticks the rule says nothing
        ("p_d_margin", {"control.gravity": 0.9}),
        ("p_d_margin", {"control.K": [10.0, 5.0]}),
        ("p_d_margin", {"sites.s.control.law": "p_d", "sites.s.control.K": 5.0}),
        ("p_d_margin", {"links.m1->s.delay_ms": 100.0}),
        (
            "p_d_margin",
            {"link.model": "uniform", "link.delay_ms": 200.0, "link.half_width_ms": 50.0},
        ),
        ("p_d_margin", {"link.loss": 0.5}),
        ("p_d_margin", {"on_stale.action": "hold"}),
        ("p_d_margin", {"control.law": "pd_d"}),
        ("jitter", {}),
        ("contact", {}),
    ],
)
def test_without_its_premises_a_condition_says_nothing(
    name: str, settings: dict[str, Any]
) -> None:
    assert StabilityCriterion.evaluate(load_scenario(name, settings)) is None


def test_play_out_counts_as_delay() -> None:
    assert excess(load_scenario("p_d_margin", {"link.playout_ms": 400.0})) == pytest.approx(
        1.1 - 2.0
    )


@pytest.mark.parametrize(
    "changes",
    [{"scheme": "digital"}, {"sites.s.rate_hz": 500}, {"control.d": 70.0}],
    ids=["another scheme", "two rates", "d h above the least inertia"],
)
def test_a_condition_is_silent_at_other_tick_rates(changes: dict[str, Any]) -> None:
    assert StabilityCriterion.evaluate(load_scenario("p_d_margin", changes)) is None


def test_shares_in_a_circle_have_no_line() -> None:
    circle = {f"dominance.{a}": {b: 1.0} for a, b in (("m1", "m2"), ("m2", "s"), ("s", "m1"))}
    assert StabilityCriterion.evaluate(load_scenario("p_d_margin", circle)) is None


def test_line_between_few_columns_is_that_of_theory() -> None:
    """Along each row the drawn line of P+d, d = K T / 2, crosses where theory does, for K = 10."""
    over = ("link.delay_ms=0:800:400", "control.d=0.4:3.6:0.4")
    plan = plan_sweep("p_d_margin", over=over)
    first = next(make_map_rows())
    cells = [
        {**first, "link.delay_ms": delay, "control.d": damping}
        for delay, damping in product(
            (0.0, 400.0, 800.0), [round(0.4 * n, 1) for n in range(1, 10)]
        )
    ]

    drawn = StabilityMap.of_sweep(SweepResults(plan, cells), (), linearly=False)
    ((line,),) = drawn.lines
    step_ms = np.diff(line.fine_positions).max()
    assert step_ms <= 800.0 / 24 + 1e-9
    assert line.excess.shape == (9, 3)

    for row, damping in zip(line.drawn_excess, drawn.plane.y.values, strict=True):
        (n,) = np.flatnonzero(np.diff(row > 0.0))
        crossing_ms = np.interp(0.0, -row[n : n + 2], line.fine_positions[n : n + 2])
        assert crossing_ms == pytest.approx(200.0 * damping, abs=0.5 * step_ms)


def test_columns_of_a_fine_map_are_not_divided() -> None:
    axis = PlaneAxis("link.delay_ms", tuple(np.arange(0.0, 500.0, 10.0).tolist()), "")
    columns = axis.refine_columns()
    assert columns.values == axis.values
    assert columns.on_grid == tuple(range(50))


def test_fine_columns_contain_those_of_the_map() -> None:
    axis = PlaneAxis("link.delay_ms", (1.0, 10.0, 100.0), "")
    columns = axis.refine_columns()
    assert [columns.values[n] for n in columns.on_grid] == [1.0, 10.0, 100.0]
    assert [columns.positions[n] for n in columns.on_grid] == [0.0, 1.0, 2.0]
