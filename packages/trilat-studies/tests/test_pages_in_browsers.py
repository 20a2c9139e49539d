"""Pages of studies in a browser: maps and the suite; pictures have colours, tables have cells."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser
from study_builders import (
    SPARE_DAMPING,
    judge_by_condition,
    make_exponent_plane,
    make_gapped_plane,
    make_map_plane,
)
from trilat_studies.bench import plan_bench, prepare_bench_folder, run_bench
from trilat_studies.bench.bench_figures import FIGURES_OF_BENCH, write_bench
from trilat_studies.sweep.map_page import MapReport
from trilat_studies.sweep.map_plane import MapPlane
from trilat_studies.sweep.stability_map import MapLine, StabilityMap
from trilat_studies.sweep.sweep_cell import CellClass

from tests.live.browsers import needs_browser
from tests.page.study_pages import assert_markdown_is_whole

pytestmark = needs_browser

LINE = MapLine("$d$", "d = 5 T", "the condition", SPARE_DAMPING, 0)
UNEVEN = make_map_plane()
PLANES: dict[str, MapPlane] = {
    "verdicts": make_map_plane(),
    "panels": make_map_plane(link__playout_ms=(0.0, 400.0)),
    "six panels": make_map_plane(rate_hz=tuple(float(n) for n in range(1, 7))),
    "seeds": make_map_plane(lambda x, y, seed: judge_by_condition(x, y - 0.3 * seed), seeds=4),
    "no edge": make_map_plane(lambda *_, **__: CellClass.CONVERGED),
    "all diverged": make_map_plane(lambda *_, **__: CellClass.DIVERGED),
    "uneven axis": UNEVEN._replace(x=UNEVEN.x._replace(values=(8, 68, 136, 272, 1088))),
    "missing cell": make_gapped_plane(),
    "exponents": make_exponent_plane(),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "panels" else pytest.mark.long) for name in PLANES],
)
def test_page_of_a_map_is_whole(name: str, browser: Browser, tmp_path: Path) -> None:
    plane = PLANES[name]
    lines = tuple((LINE,) for _ in plane.panels)
    chart = StabilityMap(plane, lines, ("a remark",), ("trilat sweep a",), "P+d")
    MapReport(chart).write(tmp_path)
    assert_markdown_is_whole(browser, tmp_path / "map.md", pictures=1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("tasks", "links", "seeds"),
    [
        (["free"], ["rtt8", "rtt68-loss25"], 2),
        (["free", "contact"], ["rtt8"], 1),
    ],
)
def test_page_of_the_suite_is_whole(
    tasks: list[str], links: list[str], seeds: int, browser: Browser, tmp_path: Path
) -> None:
    plan = plan_bench("round-trips", laws=["p_d"], tasks=tasks, links=links, seeds=seeds)
    folder = prepare_bench_folder(plan, tmp_path / "suite")
    write_bench(run_bench(folder, jobs=1), folder.path, "trilat bench")
    without = [] if "contact" in tasks else ["stiffness"]
    page = folder.path / "bench.md"
    assert_markdown_is_whole(browser, page, len(FIGURES_OF_BENCH) - len(without), tables=3)
