"""A real browser on a real page: Debian's chromium, driven by Playwright."""

import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from playwright.sync_api import Page, sync_playwright

from tests.net.waiting import until

from .processes import Process

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
QUIET = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="needs chromium: apt-get install chromium")


@contextmanager
def browser_page(url: str, *, gl: bool = True, **options: Any) -> Iterator[Page]:
    """A page of a browser at an address; it fails for every error that the page reports."""
    drawing = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader") if gl else ("--disable-3d-apis",)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*QUIET, *drawing])
        try:
            page = browser.new_page(**options)
            problems: list[str] = []
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.goto(url)
            yield page
            assert problems == []
        finally:
            browser.close()


def page_address(process: Process) -> str:
    """The address that a process of `trilat live` prints."""
    process.prints("the page: ")
    found = re.search(r"the page: (\S+)", process.text())
    assert found is not None
    return found[1]


def shows(page: Page, expression: str, timeout_s: float = 30.0) -> Any:
    """The first true value of a JavaScript expression."""
    return until(lambda: page.evaluate(expression), timeout_s)
