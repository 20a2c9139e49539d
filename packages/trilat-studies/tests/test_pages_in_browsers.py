"""Pages of studies in a browser: maps, the suite, experiments; pictures have colours, tables have cells."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from markdown_it import MarkdownIt
from playwright.sync_api import Browser
from sweep_tests.maps import (
    DAMPINGS,
    DELAYS_MS,
    KEYS,
    P_D,
    judge_by_condition,
    make_plane,
    rows,
)
from trilat_studies.bench import plan_bench, prepare_bench_folder, run_bench
from trilat_studies.bench.bench_figures import FIGURES_OF_BENCH, write_bench
from trilat_studies.sweep.map_page import write_map
from trilat_studies.sweep.stability_map import MapLine, MapPlane, StabilityMap, build_plane
from trilat_studies.sweep.sweep_cell import CellClass

import trilat_net
from tests.live.browsers import needs_browser
from tests.page.whole_pages import WatchedPage, watched_page
from tests.studies.experiment.experiments import REACH, write_protocol

pytestmark = needs_browser

ADDRESS = "http://page.test/"
COLOURED = """(image) => {
  const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
  const painter = canvas.getContext("2d");
  painter.drawImage(image, 0, 0);
  const data = painter.getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let n = 0; n < data.length; n += 4) {
    const channels = data.subarray(n, n + 3);
    count += Math.max(...channels) - Math.min(...channels) > 20;
  }
  return count;
}"""
"""Number of the pixels of a picture that are neither white, black nor grey, as axes and letters are."""


def open_folder(watched: WatchedPage, folder: Path, html: str) -> None:
    """Opens a page whose pictures lie in a folder."""

    def answer(route: Any) -> None:
        file = folder / route.request.url.removeprefix(ADDRESS)
        if route.request.url == ADDRESS:
            route.fulfill(
                body=f"<!DOCTYPE html><meta charset=utf-8><link rel=icon href=data:,>{html}",
                content_type="text/html",
            )
        elif file.is_file():
            route.fulfill(path=file)
        else:
            route.fulfill(status=404)

    watched.page.route(f"{ADDRESS}**", answer)
    watched.page.goto(ADDRESS)


def assert_page_of_study_is_whole(
    browser: Browser, folder: Path, html: str, pictures: int, tables: int
) -> None:
    """Asserts that a page has `pictures` pictures and at least `tables` tables, all with content."""
    with watched_page(browser) as watched:
        open_folder(watched, folder, html)
        watched.assert_whole()
        assert watched.page.locator("table").count() >= tables
        assert watched.page.locator("img").count() == pictures
        for image in watched.page.locator("img").all():
            assert image.evaluate(COLOURED) > 100, image.get_attribute("src")


def assert_markdown_is_whole(
    browser: Browser, page: Path, pictures: int, tables: int = 1
) -> None:
    """Asserts the same of a Markdown page, as viewers of Markdown show it."""
    html = MarkdownIt("commonmark").enable("table").render(page.read_text(encoding="utf-8"))
    assert_page_of_study_is_whole(browser, page.parent, html, pictures, tables)


SPARE = np.array(DAMPINGS)[:, np.newaxis] - 5e-3 * np.array(DELAYS_MS)
LINE = MapLine("$d$", "d = 5 T", "the condition", SPARE, 0)
UNEVEN = make_plane()
PLANES: dict[str, MapPlane] = {
    "verdicts": make_plane(),
    "panels": make_plane(link__playout_ms=(0.0, 400.0)),
    "six panels": make_plane(rate_hz=tuple(float(n) for n in range(1, 7))),
    "seeds": make_plane(lambda x, y, seed: judge_by_condition(x, y - 0.3 * seed), seeds=4),
    "no edge": make_plane(lambda *_, **__: CellClass.CONVERGED),
    "all diverged": make_plane(lambda *_, **__: CellClass.DIVERGED),
    "uneven axis": UNEVEN._replace(x=UNEVEN.x._replace(values=(8, 68, 136, 272, 1088))),
    "missing cell": build_plane([row for row in rows() if row["cell"] != 12], KEYS, P_D),
    "exponents": build_plane(
        [row | {"exponent_per_s": row[KEYS[1]] - 1.2} for row in rows()], KEYS, P_D
    ),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "panels" else pytest.mark.long) for name in PLANES],
)
def test_page_of_a_map_is_whole(name: str, browser: Browser, tmp_path: Path) -> None:
    plane = PLANES[name]
    lines = tuple((LINE,) for _ in plane.panels)
    write_map(StabilityMap(plane, lines, ("a remark",), ("trilat sweep a",), "P+d"), tmp_path)
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


@pytest.mark.long
@pytest.mark.parametrize("users", ['["m1"]', '["m1", "m2"]'], ids=["alone", "pairs"])
def test_report_of_an_experiment_is_whole(users: str, browser: Browser, tmp_path: Path) -> None:
    file = write_protocol(tmp_path, users, REACH)
    folder = trilat_net.run_experiment(file, tmp_path / "out", jobs=1).folder
    analysis = trilat_net.analyse_experiment(folder)
    pictures = sum(path.suffix == ".png" for path in analysis.paths)
    assert_markdown_is_whole(browser, folder / "analysis" / "report.md", pictures)
    assert_page_of_study_is_whole(browser, folder, analysis._repr_html_(), pictures=0, tables=1)
