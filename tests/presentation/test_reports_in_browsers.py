"""Reports of every kind of run in a browser: no error, no empty frame, every line of every chart drawn."""

from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from tests.analysis.builders import make_log_without_hands
from tests.live.browsers import needs_browser, wait_until_page
from tests.net.waiting import until
from tests.page.whole_pages import WatchedPage, watched_page
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.file_overview import summarise_run
from trilat_net.log.findings import CheckReport
from trilat_net.log.log_reader import Log
from trilat_net.presentation.page import render_report, write_report
from trilat_net.scenario.delay_models import DELAY_MODELS
from trilat_net.scenario.laws import LAWS

from .varied_runs import LAW_SETTINGS, VARIED

pytestmark = needs_browser

PUSHED = (
    "delay uniform",
    "planar task",
    "fault",
    "diverged",
    "one record a site",
    "single records",
)
"""Runs whose reports are opened on every push; the long tests open all."""
NAMES = [
    pytest.param(name, marks=() if name in PUSHED else pytest.mark.long) for name in VARIED
]
SCREEN: dict[str, Any] = {
    "viewport": {"width": 1440, "height": 900},
    "reduced_motion": "reduce",
}
"""A desktop on which the arms stand still until somebody plays them."""


def open_report(watched: WatchedPage, log: Log, folder: Path) -> Page:
    """Opens the report of a log."""
    path = folder / "report.html"
    path.write_text(
        render_report(log, None, CheckReport([]), summarise_run(log, None)), encoding="utf-8"
    )
    watched.page.goto(path.as_uri())
    return watched.page


def open_all_parts(page: Page) -> None:
    """Opens every folded part of the page; charts are drawn once their part is open."""
    page.evaluate(
        "document.querySelectorAll('details').forEach((part) => { part.open = true; })"
    )
    wait_until_page(page, "observed.charts() === trilat.page.charts.length")


def count_on_page(page: Page, expression: str) -> int:
    number: int = page.evaluate(expression)
    return number


def arms_drawn(page: Page) -> list[str]:
    """Returns the points of every arm in the player."""
    points: list[str] = page.evaluate(
        "[...document.querySelectorAll('#arms .arm')].map((arm) => arm.getAttribute('points'))"
    )
    return points


def test_varied_runs_cover_all_models_and_laws() -> None:
    assert {name for name in VARIED if name.startswith("delay ")} == {
        f"delay {model}" for model in DELAY_MODELS
    }
    assert set(LAW_SETTINGS) == set(LAWS)
    assert set(PUSHED) <= set(VARIED)


@pytest.mark.filterwarnings("ignore:the run diverged")
@pytest.mark.parametrize("name", NAMES)
def test_report_draws_everything(name: str, browser: Browser, tmp_path: Path) -> None:
    log = VARIED[name]()
    with watched_page(browser, **SCREEN) as watched:
        page = open_report(watched, log, tmp_path)
        watched.assert_whole()
        open_all_parts(page)
        watched.assert_whole()
        charts = count_on_page(page, "trilat.page.charts.length")
        assert (
            charts
            == count_on_page(page, "observed.charts()")
            == count_on_page(page, "document.querySelectorAll('figure').length")
        )
        assert charts > 0 or not any(len(log[site]) for site in log.sites)
        recorded = sum(len(log[site]) > 0 for site in log.sites)
        if recorded:
            page.locator("#arms input").fill("1000")
        assert [points != "" for points in arms_drawn(page)] == [True] * recorded
        strip = "document.querySelectorAll('.strip svg .arm').length"
        assert count_on_page(page, strip) >= recorded
        absent = [site for site in log.sites if not len(log[site])]
        assert not absent or f"there is no record: {', '.join(absent)}." in page.inner_text(
            "body"
        )


def test_no_line_leads_through_a_gap(browser: Browser, tmp_path: Path) -> None:
    """No line is drawn even if the chart has ticks of other sites within the gap."""
    with watched_page(browser, **SCREEN) as watched:
        page = open_report(watched, VARIED["single records"](), tmp_path)
        open_all_parts(page)
        charts = "trilat.plots().filter((plot) => plot.series[1].label === 'm1' && plot.series.length > 2)"
        t_s, values = page.evaluate(
            f"(() => {{ const [{{ data }}] = {charts}; return [data[0], data[1]]; }})()"
        )
        known = [n for n, value in enumerate(values) if value is not None]
        assert [t_s[n] for n in known] == [0.0, 0.5, 1.0, 1.5]
        bridged = f"(last) => {charts}[0].data[1].slice(0, last).filter((value) => value === undefined).length"
        assert page.evaluate(bridged, known[-1]) == 0


@pytest.mark.parametrize("name", ["delay uniform", "planar task", "shipped paper"])
def test_linear_axes_have_two_labelled_values(
    name: str, browser: Browser, tmp_path: Path
) -> None:
    """The scale of a chart cannot be read from one value."""
    with watched_page(browser, **SCREEN) as watched:
        page = open_report(watched, VARIED[name](), tmp_path)
        open_all_parts(page)
        labels = page.evaluate(
            "trilat.plots().filter((plot) => plot.scales.y.distr === 1)"
            ".map((plot) => plot.axes[1]._values)"
        )
        assert len(labels) > 4
        for texts in labels:
            shown = [text for text in texts if text]
            assert len(shown) >= 2
            values = [float(text) for text in shown]
            assert sorted(set(values)) == values


USED = ("live change", "six joints", "fault", "four sites")
"""Runs whose reports are played, zoomed and switched."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name == "live change" else pytest.mark.long)
        for name in USED
    ],
)
def test_report_stays_whole_while_used(name: str, browser: Browser, tmp_path: Path) -> None:
    """Played, pointed at, zoomed, with lines hidden, narrow, in the dark and printed."""
    with watched_page(browser, **SCREEN) as watched:
        page = open_report(watched, VARIED[name](), tmp_path)
        before = arms_drawn(page)
        page.click("#arms button")
        until(lambda: arms_drawn(page)[0] != before[0])
        page.click("#arms button")
        assert page.inner_text("#arms button") == "play"
        zoom_in(page)
        toggle_lines(page)
        watched.assert_whole()
        page.set_viewport_size({"width": 500, "height": 900})
        wait_until_page(
            page, "document.querySelector('.uplot').getBoundingClientRect().width < 500"
        )
        watched.assert_whole()
        page.emulate_media(color_scheme="dark")
        watched.assert_whole()
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        watched.assert_whole()
        page.evaluate("dispatchEvent(new Event('afterprint'))")
        watched.assert_whole()


def zoom_in(page: Page) -> None:
    """Drags over the first chart, which zooms all charts; then restores them."""
    area = page.locator(".u-over").first
    area.scroll_into_view_if_needed()
    box = area.bounding_box()
    assert box is not None
    y = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.2 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.5 * box["width"], y, steps=5)
    page.mouse.up()
    limits = "trilat.plots().map((plot) => [plot.scales.x.min, plot.scales.x.max])"
    (zoomed,) = {tuple(scale) for scale in page.evaluate(limits)}
    end_s = page.evaluate("trilat.page.end_s")
    assert 0.1 * end_s < zoomed[0] < 0.3 * end_s < 0.4 * end_s < zoomed[1] < 0.6 * end_s
    assert page.inner_text("#arms output") != "0.000 s"  # the arms follow the pointer
    area.dblclick()
    assert {tuple(scale) for scale in page.evaluate(limits)} == {(0, end_s)}


def toggle_lines(page: Page) -> None:
    """Hides every line by its name below its chart, and shows it again."""
    names = ".u-series:not(:first-child) th"
    hidden_names = ".u-series.u-off"
    page.locator(names).first.click()
    assert page.locator(hidden_names).count() == 1
    page.locator(names).first.click()
    for hidden in (page.locator(names).count(), 0):
        page.evaluate(
            "(names) => document.querySelectorAll(names).forEach((name) => name.click())", names
        )
        assert page.locator(hidden_names).count() == hidden


CERTIFIED = ("live change", "diverged", "shipped paper", "shipped contact", "everything")


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:the run diverged")
@pytest.mark.parametrize("name", CERTIFIED)
def test_whole_report_with_its_certificate_is_drawn(
    name: str, browser: Browser, tmp_path: Path
) -> None:
    """The report is that of the command, with the certificate, its pictures, and the twin without operators."""
    log = VARIED[name]()
    twin = make_log_without_hands("paper") if name == "shipped paper" else None
    certificate = Certificate.of_log(log)
    path, _ = write_report(
        log,
        tmp_path,
        certificate=certificate,
        twin=twin,
        wait_for_checks=lambda: CheckReport([]),
    )
    observed = certificate.observed
    twins = certificate.twins
    sections = [certificate.balance, observed and observed.curves, twins and twins.pushes]
    with watched_page(browser, **SCREEN) as watched:
        watched.page.goto(path.as_uri())
        open_all_parts(watched.page)
        watched.assert_whole()
        assert watched.page.locator("img.picture").count() == sum(map(bool, sections))
