"""The first screen of a report: on a desktop and on a phone, by day and by night."""

from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page

from tests.analysis.builders import make_short_log
from tests.live.browsers import needs_browser
from tests.page.whole_pages import grave_findings, watched_page
from trilat_net import presentation
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.log.findings import CheckReport, Finding
from trilat_net.presentation.appearance import DARK_SITE_COLOURS, SITE_COLOURS
from trilat_net.presentation.page import write_report

from .varied_runs import VARIED

SCREENS = {"desktop": (1440, 900), "phone": (360, 740)}
FIRST_PICTURE_PX = 700
MOST_SCREENS = 3
NAMES = [
    "live change",
    pytest.param("fault", marks=pytest.mark.long),
    pytest.param("six joints", marks=pytest.mark.long),
    pytest.param("no record", marks=pytest.mark.long),
]
CHECKS = CheckReport(
    [Finding("records", "all present"), Finding("executed again", "differs", False)]
)
UNFOLD = "document.querySelectorAll('details').forEach((part) => { part.open = true; })"


def measure_page(page: Page, expression: str) -> float:
    value: float = page.evaluate(expression)
    return value


@needs_browser
@pytest.mark.parametrize("name", NAMES)
def test_report_fits_screens_and_axe_finds_nothing(
    name: str, browser: Browser, tmp_path: Path
) -> None:
    log = VARIED[name]()
    certificate = Certificate.of_log(log)
    path, _ = write_report(
        log, tmp_path, certificate=certificate, wait_for_checks=lambda: CHECKS
    )
    has_records = any(len(log[site]) for site in log.sites)
    for screen, (width, height) in SCREENS.items():
        for scheme in ("light", "dark"):
            options: dict[str, Any] = {
                "viewport": {"width": width, "height": height},
                "color_scheme": scheme,
                "reduced_motion": "reduce",
            }
            with watched_page(browser, **options) as watched:
                page = watched.page
                page.goto(path.as_uri())
                whole_px = measure_page(page, "document.documentElement.scrollHeight")
                assert screen == "phone" or whole_px <= MOST_SCREENS * height
                if has_records:
                    picture = page.locator("#arms svg").first.bounding_box()
                    assert picture is not None
                    assert picture["y"] + picture["height"] <= FIRST_PICTURE_PX
                page.evaluate(UNFOLD)
                assert measure_page(page, "document.documentElement.scrollWidth") <= width
                assert grave_findings(page) == []


@needs_browser
def test_arms_play_at_once_unless_motion_is_reduced(browser: Browser, tmp_path: Path) -> None:
    log = make_short_log("paper")
    path, _ = write_report(
        log,
        tmp_path,
        certificate=Certificate.of_log(log),
        wait_for_checks=lambda: CheckReport([]),
    )
    for motion, label in (("no-preference", "stop"), ("reduce", "play")):
        with watched_page(browser, reduced_motion=motion) as watched:
            watched.page.goto(path.as_uri())
            assert watched.page.inner_text("#arms button") == label


def test_theme_has_the_colours_of_the_figures() -> None:
    assets = Path(presentation.__file__).with_name("assets")
    light, dark = (assets / "theme.css").read_text("utf-8").split("@media")
    for css, colours in ((light, SITE_COLOURS), (dark, DARK_SITE_COLOURS)):
        for index, colour in enumerate(colours):
            assert f"--site-{index}: {colour};" in css
