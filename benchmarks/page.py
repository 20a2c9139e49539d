"""Measures the page of `trilat live`: delay from pointer to arm, effect on the loops, and load of the server.

Chromium draws on the measured machine, which is most of the load without a graphics card.
Therefore, the loops are measured alternately with two socket clients that receive every frame
but draw nothing, and without any client.
"""

import json
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from playwright.sync_api import Page, sync_playwright
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import trilat_net
from tests.live.browsers import launch_browser
from trilat_net.net.arm_client import Hand

from .stopwatch import cpu_s

RUN_S, PAIRS, MOVES = 10.0, 5, 60
POINTER_P50_MS, POINTER_P95_MS, LATENESS_RATIO, SERVER_PERCENT = 60.0, 120.0, 1.3, 30.0
_TIP = """(() => { const card = trilat.parts.arms.cards[0], box = card.canvas.getBoundingClientRect();
const tip = card.project(trilat.frame.sites[card.name].points.at(-1)), ratio = card.canvas.width / box.width;
return [box.left + tip[0] / ratio, box.top + tip[1] / ratio]; })()"""
_STAMP = """trilat.parts.arms.cards[0].canvas.addEventListener("pointerrawupdate",
(event) => { trilat.moved = performance.timeOrigin + event.timeStamp; })"""
_READY = (
    "Boolean(trilat.frame?.t > 2 && trilat.takesPart && trilat.parts.arms.cards[0].project)"
)


def run() -> list[str]:
    took_ms, asked_ms = measure_pointer()
    p50, p95 = np.percentile(took_ms, (50, 95))
    whole = np.percentile(asked_ms, (50, 95))
    late_us, alone_us, server = measure_load()
    ratio = late_us / alone_us
    return [
        f"pointer to arm, {len(took_ms)} moves: p50 {p50:.1f} ms (at most {POINTER_P50_MS:g}), "
        f"p95 {p95:.1f} ms (at most {POINTER_P95_MS:g})",
        f"the same from Playwright's order on: p50 {whole[0]:.1f} ms, p95 {whole[1]:.1f} ms",
        f"lateness p99: {late_us:.0f} us with two pages, {alone_us:.0f} us with none, "
        f"{ratio:.2f} of it (at most {LATENESS_RATIO:g})",
        f"the page's server: {server:.1f} % of a core (at most {SERVER_PERCENT:g})",
    ]


@contextmanager
def live_session(folder: Path, *options: str) -> Iterator[tuple[str, int]]:
    """Runs a session of `play` with a page; yields the page's address and the process, and checks the log at the end."""
    options = ("--no-browser", "--force", "--out", str(folder), *options)
    command = [sys.executable, "-m", "trilat_net", "live", "play", *options]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    lines = iter(process.stdout)
    address = next(
        found[1] for line in lines if (found := re.search(r"experimenter: (\S+)", line))
    )
    try:
        yield address, process.pid
    finally:
        process.send_signal(signal.SIGINT)
        for line in lines:
            if line.startswith("checking the log"):  # no report is needed
                process.kill()
        process.wait()


class SocketClient(threading.Thread):
    """A page that draws nothing: it receives every frame and confirms it."""

    def __init__(self, address: str) -> None:
        super().__init__(daemon=True)
        self.socket = connect(f"ws://{urlsplit(address).netloc}/socket", max_size=None)
        self.t_s = 0.0
        self.start()

    def run(self) -> None:
        """Receives frames until the session or the test closes the connection."""
        with suppress(ConnectionClosed):
            for text in self.socket:
                message = json.loads(text)
                self.t_s = message.get("t", 0.0)
                n = message["hello"]["n"] if "hello" in message else message["n"]
                self.socket.send(json.dumps({"do": "seen", "n": n}))


def measure_once(pages: int) -> tuple[float, float]:
    """Returns the p99 of the loops' lateness, in us, and the server's share of a core, in per cent."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        with live_session(folder) as (address, pid):
            clients = [SocketClient(address) for _ in range(2)]
            while clients[0].t_s < 2.0:
                time.sleep(0.05)
            for client in clients[pages:]:
                client.socket.close()
            began_s, before_s = time.monotonic(), cpu_s(pid)
            time.sleep(RUN_S)
            share = 100.0 * (cpu_s(pid) - before_s) / (time.monotonic() - began_s)
        log = trilat_net.open_log(str(folder / "run.mcap"))
        assert not any(log.missing(site) for site in log.sites)
        late_us = [
            log[site].late_us[(log[site].t_s > 2.5) & (log[site].t_s < RUN_S)]
            for site in log.sites
        ]
        return float(np.percentile(np.concatenate(late_us), 99)), share


def measure_load() -> tuple[float, float, float]:
    """Returns medians: lateness with two pages and without pages, in us, and the server's share with two pages, in per cent."""
    pairs = [(measure_once(2), measure_once(0)) for _ in range(PAIRS)]
    print(
        "p99 with two pages and with none, us:",
        [(f"{a[0]:.0f}", f"{b[0]:.0f}") for a, b in pairs],
    )
    ratio = float(np.median([two[0] / none[0] for two, none in pairs]))
    none_us = float(np.median([none[0] for _, none in pairs]))
    return ratio * none_us, none_us, float(np.median([two[1] for two, _ in pairs]))


class TargetWatch(threading.Thread):
    """Records the time at which an arm's hand gets a new target, because chromium answers after the arm has moved."""

    def __init__(self, onlooker: Hand) -> None:
        super().__init__(daemon=True)
        self._onlooker, self.ended = onlooker, threading.Event()
        self.changed_s: list[float] = []

    def run(self) -> None:
        """Reads the newest record repeatedly until the watch ends."""
        last = None
        while not self.ended.wait(0.0005):
            hand = self._onlooker.in_force
            if hand is not None and hand.source and hand.target != last:
                last = hand.target
                self.changed_s.append(time.time())


def measure_pointer() -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    """Returns the delays from a pointer's move, and from Playwright's order, to a record with a new target, in ms.

    Chromium stamps a move when the move reaches it. The delay of Playwright and its pipe does
    not exist for a user.
    """
    with (
        tempfile.TemporaryDirectory() as name,
        live_session(Path(name) / "run") as (address, _),
        sync_playwright() as playwright,
    ):
        browser = launch_browser(playwright)
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.goto(address)
        while not page.evaluate(_READY):
            time.sleep(0.1)
        x, y = page.evaluate(_TIP)
        page.evaluate(_STAMP)
        with trilat_net.hand("play", "m1", source="onlooker") as onlooker:
            watch = TargetWatch(onlooker)
            watch.start()
            page.mouse.move(x, y)
            page.mouse.down()
            took_ms = [
                move_once(page, watch, x + 4 * (n % 2), y - 4 * (n % 2)) for n in range(MOVES)
            ]
            page.mouse.up()
            watch.ended.set()
            watch.join()
        browser.close()
        return np.array(took_ms).T


def move_once(page: Page, watch: TargetWatch, x: float, y: float) -> tuple[float, float]:
    """Moves the pointer slightly, and waits at most 2 s until the arm's hand has followed; see `measure_pointer`."""
    time.sleep(0.3)
    seen, began_s = len(watch.changed_s), time.time()
    page.mouse.move(x, y)
    while len(watch.changed_s) == seen and time.time() - began_s < 2.0:
        time.sleep(0.001)
    moved_s = page.evaluate("trilat.moved") / 1e3
    followed_s = watch.changed_s[seen] if len(watch.changed_s) > seen else began_s + 2.0
    return (followed_s - moved_s) * 1e3, (followed_s - began_s) * 1e3
