"""A map: runs from the results, lines from the plan, and neither from the other."""

from itertools import product

import numpy as np
import pytest

from trilat_net.studies.sweep.map_plane import PlaneAxis
from trilat_net.studies.sweep.stability_map import (
    PanelScenarios,
    build_stability_map,
    format_override,
    format_override_value,
    panel_scenarios,
    trace_linear_analysis,
)
from trilat_net.studies.sweep.sweep_plan import plan_sweep
from trilat_net.studies.sweep.sweep_results import SweepResults
from trilat_net.theory import compute_growth_rates

from .maps import KEYS, rows

OVER = ("link.delay_ms=0:400:100", "control.d=0.2:2.2:0.5")


def results(**axes: tuple[object, ...]) -> SweepResults:
    over = [*OVER, *(f"{key.replace('__', '.')}={','.join(map(str, some))}" for key, some in axes.items())]
    return SweepResults(plan_sweep("p_d_margin", over=over), list(rows(**axes)))


def test_every_panel_has_its_own_lines() -> None:
    """Play-out of 400 ms asks for d = 2 whatever the delay."""
    made = build_stability_map(results(link__playout_ms=(0.0, 400.0)), ("trilat sweep",), linearly=False)
    (direct,), (played,) = made.lines
    y = made.plane.y
    assert np.allclose([direct.crossings(n, y) for n in range(1, 5)], [[0.5], [1.0], [1.5], [2.0]])
    assert np.allclose([played.crossings(n, y) for n in range(5)], 2.0)
    assert made.remarks == ()


def test_lines_do_not_depend_on_what_ran_nor_on_how_many_processes_there_are() -> None:
    everything = results()
    one = everything._replace(rows=[row for row in everything.rows if row["cell"] != 7])
    (closed, rooted), (again, other) = (
        build_stability_map(some, (), jobs).lines[0] for some, jobs in ((everything, 1), (one, 2))
    )
    assert (closed.rank, rooted.rank) == (0, 1)
    assert np.array_equal(closed.spare, again.spare)
    assert np.array_equal(rooted.spare, other.spare)


def test_the_linear_line_of_p_d_is_at_its_condition_where_the_delay_is_short() -> None:
    """The mode at the edge is slow against 1/T there, and the condition exact: within 2 % at 100 ms."""
    at = PanelScenarios(plan_sweep("p_d_margin").written, (), *KEYS)
    damping = PlaneAxis("control.d", (0.46, 0.48, 0.50, 0.52), "d")
    line, _ = trace_linear_analysis(
        [compute_growth_rates([at.scenario(100.0, d) for d in damping.values])] * 2
    )
    assert line is not None
    assert line.crossings(0, damping) == [pytest.approx(0.5, rel=0.02)]


def test_a_strip_has_no_lines() -> None:
    asked = plan_sweep("p_d_margin", over=OVER[:1])
    made = [row for row in rows() if row["control.d"] == 0.7]
    assert build_stability_map(SweepResults(asked, made), ()).lines == ((),)


def test_a_place_of_a_panel_is_the_cell_of_the_plan() -> None:
    """What lines are drawn for is what runs: every cell's scenario, with every law."""
    asked = plan_sweep("p_d_margin", over=[*OVER, "link.playout_ms=0,400"], laws=("p_d", "pd_d"))
    made = []
    for law, row in product(("p_d", "pd_d"), rows(link__playout_ms=(0.0, 400.0))):
        made.append({**row, "law": law})
    drawn = build_stability_map(SweepResults(asked, made), (), linearly=False).plane
    assert [panel.title for panel in drawn.panels] == [
        f"{law}, playout {ms} ms" for law in ("p_d", "pd_d") for ms in (0, 400)
    ]
    for n in range(0, asked.cells, 7):
        cell = asked.cell(n)
        playout = cell.values[2]
        (panel,) = (
            p for p in drawn.panels if p.settings == (("law", cell.law), ("link.playout_ms", playout))
        )
        at = panel_scenarios(asked, panel, drawn.x.key, drawn.y.key)
        delay, damping = cell.values[:2]
        assert isinstance(delay, float)
        assert isinstance(damping, float)
        assert at.scenario(delay, damping) == asked.written.scenario(*cell.overrides)


@pytest.mark.parametrize(
    ("value", "text"), [(100.0, "100"), (0.3, "0.3"), (5, "5"), (1e-7, "1e-07"), (-2.5, "-2.5")]
)
def test_a_number_as_an_override_is_just_that_number(value: float, text: str) -> None:
    assert format_override_value(value) == text
    assert float(format_override_value(value)) == value
    assert format_override("a.b", value) == f"a.b={text}"
    assert format_override("link.order", "in_order") == "link.order=in_order"
