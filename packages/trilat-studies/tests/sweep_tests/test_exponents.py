"""Sweeps judged by twins: exponents are the roots of the linear loop, and their zero line is its edge."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_hex
from study_builders import (
    MAP_KEYS,
    P_D,
    make_exponent_plane,
    make_map_rows,
    plan_quick_sweep,
    read_tables,
    run_plan,
)
from trilat_studies.sweep import prepare_sweep_folder
from trilat_studies.sweep.map_page import MapReport
from trilat_studies.sweep.map_plane import MapPlane
from trilat_studies.sweep.stability_map import StabilityMap
from trilat_studies.sweep.sweep_plan import SweepPlan, plan_sweep
from trilat_studies.sweep.sweep_results import SweepResults, read_results

from trilat_net.analysis.theory.linear_edge import GrowthColumn
from trilat_net.errors import UsageError
from trilat_net.presentation.appearance import FigureSize

DELAYS_MS = (200.0, 250.0)
DAMPINGS = (0.8, 1.0, 1.2, 1.4)
NEAR_REST = (
    "sites.m1.q0_rad=[0.101,0.2]",
    "sites.m2.q0_rad=[0.1,0.2]",
    "sites.s.q0_rad=[0.1,0.2]",
)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> SweepResults:
    """P+d near its edge; the arms start so close together that the motion is small."""
    over = {MAP_KEYS[0]: DELAYS_MS, MAP_KEYS[1]: DAMPINGS}
    plan = plan_sweep(
        "p_d_margin", [*NEAR_REST, "duration_s=40", "rate_hz=200"], over=over, judge="twins"
    )
    return read_results(run_plan(plan, tmp_path_factory.mktemp("exponents") / "o").folder.path)


@pytest.fixture(scope="module")
def chart(results: SweepResults) -> StabilityMap:
    return StabilityMap.of_sweep(results, (), 1)


def test_exponents_are_real_parts_of_rightmost_roots(results: SweepResults) -> None:
    """Within 2 % or 2e-3 /s, whichever is larger; some grow and some do not."""
    for delay_ms in DELAYS_MS:
        column = [row for row in results.rows if row[MAP_KEYS[0]] == delay_ms]
        scenarios = [
            results.plan.scenario(f"link.delay_ms={delay_ms}", f"control.d={d}")
            for d in DAMPINGS
        ]
        roots = GrowthColumn.compute(scenarios, MAP_KEYS[1], DAMPINGS).growth_per_s
        assert min(roots) < -0.01
        assert max(roots) > 0.01
        for row, root in zip(column, roots, strict=True):
            assert row["exponent_per_s"] == pytest.approx(root, rel=0.02, abs=2e-3)


def test_zero_line_is_the_linear_analysis_edge(chart: StabilityMap) -> None:
    """Within 2 %, from cells that are 0.2 apart."""
    zero, *_, linear = chart.lines[0]
    assert (zero.rank, linear.rank) == (-1, 1)
    for n in range(len(DELAYS_MS)):
        (edge,) = linear.crossings(n, chart.plane.y)
        assert zero.crossings(n, chart.plane.y) == [pytest.approx(edge, rel=0.02)]


def test_page_shows_exponents_zero_verdicts_and_theory(chart: StabilityMap) -> None:
    """The table of edges has the zero of the exponents beside the interval of the verdicts."""
    _, (heads, *rows) = read_tables(MapReport(chart).build_page("map.png"))
    assert heads[1:4] == ("edge of d (N m s/rad)", "stable is", "edge of the verdicts")
    assert [row[0] for row in rows] == ["200", "250"]
    for row, n in zip(rows, range(2), strict=True):
        (zero,) = chart.lines[0][0].crossings(n, chart.plane.y)
        assert row[1:3] == (f"{zero:.4g}", "above")
        low, high = map(float, row[3].split(" to "))
        assert low < high


def test_a_cell_without_growth_or_decay_is_white() -> None:
    """Four fifths of the exponents are paler than the ends of the bar."""
    chart = StabilityMap(make_exponent_plane(), ((),), (), (), "map")
    figure = MapReport(chart).draw(FigureSize.for_print(3.5))
    mesh: Any = next(
        collection
        for collection in figure.axes[0].collections
        if isinstance(collection, QuadMesh)
    )
    assert to_hex(mesh.to_rgba(0.0)) == "#ffffff"
    assert mesh.get_clim() == (-1.0, 1.0)
    assert figure.axes[-1].get_yticks().tolist() == [-1.0, -0.5, 0.0, 0.5, 1.0]
    blue = mesh.to_rgba(-0.5)
    red = mesh.to_rgba(0.5)
    assert blue[2] > blue[0]
    assert red[0] > red[2]


def test_place_is_its_seeds_mean_without_missing_exponents() -> None:
    seeded = [row | {"exponent_per_s": float(row["seed"])} for row in make_map_rows(seeds=3)]
    seeded[0] |= {"exponent_per_s": None}
    exponents = MapPlane.arrange_rows(seeded, MAP_KEYS, P_D).panels[0].exponents_per_s
    assert np.isnan(exponents[0, 0])
    assert np.nanmin(exponents) == np.nanmax(exponents) == 2.0
    assert not MapPlane.arrange_rows(list(make_map_rows()), MAP_KEYS, P_D).has_exponents


def test_a_folder_never_mixes_verdicts_and_exponents(tmp_path: Path) -> None:
    """A sweep with another kind of judge cannot continue in the folder."""
    verdicts, twins = (
        plan_quick_sweep(tmp_path, judge=judge) for judge in ("verdict", "twins")
    )
    assert "judge" not in verdicts.facts()
    assert SweepPlan.from_facts(verdicts.facts()).judge == "verdict"
    prepare_sweep_folder(verdicts, tmp_path / "o")
    longest = plan_quick_sweep(tmp_path, judge="twins", longest_s=verdicts.longest_s)
    with pytest.raises(UsageError, match="another judge: verdict in the folder, twins now"):
        prepare_sweep_folder(longest, tmp_path / "o")
    assert (twins.longest_s, verdicts.longest_s) == (0.5, 4.0)


def test_the_command_of_a_map_names_its_judge(tmp_path: Path) -> None:
    assert (
        plan_quick_sweep(tmp_path, judge="twins")
        .build_command("--map")
        .endswith(" --judge twins --map")
    )
    assert "--judge" not in plan_quick_sweep(tmp_path).build_command()
