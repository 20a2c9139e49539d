"""Measures stops of a session: the cost of `trilat stop`, and the delay from a press on a page to stopped arms.

Chromium stamps a press when it reaches the page (`timeOrigin` + `timeStamp`). The time of a
tick is computed from its nominal time, its lateness, and the Unix time of the epoch in the log.
All clocks belong to one kernel. Before every press, the clock of the page is compared with this
program's clock, and the largest possible difference is reported.
"""

import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

import trilat_net
from tests.cli.running import PLAIN
from tests.live.browsers import launch_browser
from tests.live.page_client import page_client, with_query
from tests.live.processes import PAPER, Session, Stage
from tests.net.waiting import until
from trilat_net.log.log_reader import Log

from .page import live_session

STOPS, CPU_S = 20, 0.25
PRESSES, P50_MS, P95_MS = 20, 60.0, 150.0
RATE = ("--set", "rate_hz=250")
"""Settings of the session: a low tick rate, because drawing takes most of a machine with two cores."""
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
WAYS: dict[str, tuple[dict[str, Any], Callable[[Page], None]]] = {
    "button on a user's page": (
        {"viewport": {"width": 1440, "height": 900}},
        lambda page: _press(page),
    ),
    "touch on a phone": (PHONE, lambda page: page.touchscreen.tap(*_middle(page))),
    "Esc": (
        {"viewport": {"width": 1440, "height": 900}},
        lambda page: page.keyboard.press("Escape"),
    ),
}
_STAMP = """for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, (event) => {
trilat.pressed = performance.timeOrigin + event.timeStamp; }, true)"""


def run() -> list[str]:
    """Returns the results of stops of sessions of `play`, three sites and a recorder."""
    with tempfile.TemporaryDirectory() as folder, mock.patch.dict(PLAIN, XDG_STATE_HOME=folder):
        stage = Stage(Path(folder))
        try:
            session = Session(stage, "play", PAPER, "--duration", "600")
            session.all()
            session.begun()
            cpu_s, took_s = np.array([_stop_once() for _ in range(STOPS)]).T
        finally:
            stage.clear()
    return [
        *_describe_presses(),
        f"trilat stop of three arms, {STOPS} times: processor time p50 {np.median(cpu_s):.3f} s, "
        f"most {cpu_s.max():.3f} s (at most {CPU_S:g})",
        f"  from its start to its end: p50 {np.median(took_s):.3f} s, most {took_s.max():.3f} s",
    ]


def _stop_once() -> tuple[float, float]:
    """Returns the processor time of a stop with all of its threads, and its duration, in s."""
    began_s = time.monotonic()
    command = [sys.executable, "-m", "trilat_net", "stop", "--session", "t"]
    stop = subprocess.Popen(command, env=PLAIN, stdout=subprocess.PIPE)
    assert stop.stdout is not None
    answers = stop.stdout.read().decode()
    _, status, used = os.wait4(stop.pid, 0)
    stop.returncode = os.waitstatus_to_exitcode(status)
    assert (stop.returncode, answers.count(": stop at tick")) == (0, len(PAPER)), answers
    return used.ru_utime + used.ru_stime, time.monotonic() - began_s


def _middle(page: Page) -> tuple[float, float]:
    box = page.locator("#stop").bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def _press(page: Page) -> None:
    page.mouse.move(*_middle(page))
    page.mouse.down()
    page.mouse.up()


def _describe_presses() -> list[str]:
    """Returns, for each kind of press, a line about the delay until the last arm stopped."""
    presses: dict[str, list[float]] = {}
    apart_ms: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        with live_session(folder, *RATE) as (address, _), sync_playwright() as playwright:
            browser = launch_browser(playwright, gl=False)
            for way in WAYS:
                presses[way] = _press_often(browser, address, way, apart_ms)
            browser.close()
        log = trilat_net.open_log(str(folder / "run.mcap"))
        took = {
            way: [_find_stop_ms(log, at_ms) for at_ms in pressed]
            for way, pressed in presses.items()
        }
    lines = []
    for way, rows in took.items():
        last = np.max(rows, axis=1)
        p50, p95 = np.percentile(last, (50, 95))
        lines.append(
            f"{way}, {len(rows)} presses, to the first stopped tick of the last of {len(log.sites)} arms: "
            f"p50 {p50:.1f} ms (at most {P50_MS:g}), p95 {p95:.1f} ms (at most {P95_MS:g}), "
            f"most {last.max():.1f} ms"
        )
    return [
        *lines,
        f"  the page's clock and this program's were at most {max(apart_ms):.2f} ms apart",
    ]


def _press_often(
    browser: Browser, address: str, way: str, apart_ms: list[float]
) -> list[float]:
    """Presses and lets the arms follow again, repeatedly; returns the Unix times of the presses, in ms."""
    options, press = WAYS[way]
    page = browser.new_page(**options)
    page.goto(with_query(address, "as=m1"))
    until(lambda: page.evaluate("window.trilat?.frame?.t > 2"), 120.0)
    page.evaluate(_STAMP)
    pressed = []
    with page_client(address) as onlooker:
        for _ in range(PRESSES):
            onlooker.shows("run")
            page.wait_for_timeout(1000.0 * random.uniform(0.1, 0.6))
            apart_ms.append(_find_offset_ms(page))
            press(page)
            onlooker.shows("stopped")
            pressed.append(float(page.evaluate("trilat.pressed")))
            trilat_net.session("play").enable()
    page.close()
    return pressed


def _find_offset_ms(page: Page) -> float:
    """Returns the largest possible difference between the clocks of page and program, from several readings, in ms."""
    bounds = []
    for _ in range(10):
        before_s = time.time()
        there_ms = float(page.evaluate("performance.timeOrigin + performance.now()"))
        after_s = time.time()
        middle_ms, half_ms = 500.0 * (before_s + after_s), 500.0 * (after_s - before_s)
        bounds.append(abs(there_ms - middle_ms) + half_ms)
    return min(bounds)


def _find_stop_ms(log: Log, pressed_ms: float) -> list[float]:
    """Returns the delay from a press to the first stopped tick of each arm, in ms."""
    epoch_ms = int(log.session["epoch_unix_ns"]) / 1e6
    found = []
    for site in log.sites:
        part = log[site]
        made_ms = epoch_ms + part.t_ns / 1e6 + part.late_us / 1e3
        stopped = np.array([mode == "stopped" for mode in part.mode])
        begins = np.flatnonzero(stopped & ~np.roll(stopped, 1))
        after = begins[made_ms[begins] > pressed_ms]
        found.append(float(made_ms[after[0]] - pressed_ms))
    return found
