"""A real browser on a real page: Debian's chromium, driven by Playwright."""

import contextlib
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, Playwright, sync_playwright

from tests.net.waiting import until

from .processes import Process

CHROMIUM = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
)
QUIET = (
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
PAINTED_BY_SOFTWARE = (
    "--disable-gpu-rasterization",
    "--disable-accelerated-2d-canvas",
    "--disable-gpu-compositing",
)
needs_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="needs chromium: apt-get install chromium"
)


def launch_browser(playwright: Playwright, *, gl: bool = False) -> Browser:
    """Starts a browser, with WebGL on request only, because drawing it by software leaves a page no time."""
    drawing = (
        ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", *PAINTED_BY_SOFTWARE)
        if gl
        else ("--disable-3d-apis",)
    )
    program = Path(__file__).with_name("chromium.sh")
    env = {**os.environ, "CHROMIUM": str(CHROMIUM)}
    return playwright.chromium.launch(executable_path=program, env=env, args=[*QUIET, *drawing])


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Provides a headless Chromium; each folder that uses the fixture imports it in its `conftest.py`."""
    with sync_playwright() as playwright:
        launched = launch_browser(playwright)
        yield launched
        launched.close()


def chromium_pid() -> int:
    pids = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            line = (folder / "cmdline").read_bytes()
            if (
                b"--type=" not in line
                and b"--remote-debugging-pipe" in line
                and _descends(int(folder.name))
            ):
                pids.append(int(folder.name))
    return min(pids)


def _descends(pid: int) -> bool:
    while pid > 1:
        if pid == os.getpid():
            return True
        pid = int(
            Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[1]
        )
    return False


@contextmanager
def browser_page(
    url: str, *, gl: bool = False, script: str = "", **options: Any
) -> Iterator[Page]:
    with sync_playwright() as playwright:
        browser = launch_browser(playwright, gl=gl)
        try:
            page = browser.new_page(**options)
            problems: list[str] = []
            page.on("pageerror", lambda error: problems.append(str(error)))
            page.add_init_script(script or "0")
            page.goto(url)
            yield page
            assert problems == []
        finally:
            browser.close()


def page_address(process: Process) -> str:
    return role_address(process, "experimenter")


def role_address(process: Process, role: str) -> str:
    process.prints(f"{role}: ")
    match = re.search(rf"{role}: (\S+)", process.text())
    assert match is not None
    return match[1]


def wait_until_page(page: Page, expression: str, timeout_s: float = 30.0) -> Any:
    return until(lambda: page.evaluate(expression), timeout_s)


def tip_px(page: Page, arm: int) -> tuple[float, float]:
    x, y = page.evaluate(
        """(n) => { const card = trilat.parts.arms.cards[n], box = card.canvas.getBoundingClientRect();
        const tip = card.project(trilat.frame.sites[card.name].points.at(-1));
        const ratio = card.canvas.width / box.width;
        return [box.left + tip[0] / ratio, box.top + tip[1] / ratio]; }""",
        arm,
    )
    return x, y


def take_hold(page: Page, arm: int, dx: float, dy: float) -> tuple[float, float]:
    """Presses the pointer on an end effector and drags it by so many pixels; returns where it was."""
    wait_until_page(page, f"trilat.parts.arms.cards[{arm}].graspable")
    x, y = tip_px(page, arm)
    page.mouse.move(x, y)
    page.mouse.down()
    for n in range(1, 11):
        page.mouse.move(x + dx * n / 10, y + dy * n / 10)
    return x, y
