"""Arms of a session that runs are stopped by command, from its page and by a key of `trilat watch`."""

import fcntl
import os
import pty
import re
import signal
import subprocess
import termios
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Page

from tests.cli.running import COMMAND, PLAIN
from tests.live.browsers import wait_until_page
from tests.live.processes import assert_executed_again
from tests.net.waiting import until
from trilat_net.log.log_reader import open_log
from trilat_net.scenario import list_shipped, load_scenario

from .browsers import browser_page, needs_browser, page_address, take_hold
from .page_client import PageClient, page_client
from .processes import Process, Stage

HELD = [
    name
    for name in list_shipped()
    if any(site.find_live_hand() is not None for site in load_scenario(name).sites.values())
]
"""Shipped scenarios whose arms people hold."""


@contextmanager
def watch_session(stage: Stage, session: str) -> Iterator[int]:
    """`trilat watch` with a terminal, whose keys are pressed at the other end, once it shows the session."""
    keys, terminal = pty.openpty()
    printed = stage.folder / "watch.printed"
    command = [*COMMAND, "watch", "--session", session]
    with printed.open("wb") as sink:
        owns = {"stdin": terminal, "start_new_session": True, "preexec_fn": own_terminal}
        watch = subprocess.Popen(command, cwd=stage.folder, env=PLAIN, stdout=sink, **owns)
    try:
        until(
            lambda: "m1" in printed.read_text(encoding="utf-8") or watch.poll() is not None,
            60.0,
        )
        yield keys
        watch.send_signal(signal.SIGINT)
        assert watch.wait(30.0) == 128 + signal.SIGINT
        assert "S or space: stop every arm" in printed.read_text(encoding="utf-8")
    finally:
        watch.kill()
        watch.wait()
        os.close(keys)
        os.close(terminal)


def own_terminal() -> None:
    """Makes standard input the terminal of the process, as a shell's is."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def start_live(stage: Stage, scenario: str, *options: str) -> Process:
    """A session with a page, at a rate that leaves time to its page on a machine that others use too."""
    rate = ("--set", "rate_hz=100")
    out = str(stage.folder / "out")
    return stage.start("live", "live", scenario, "--no-browser", "--out", out, *rate, *options)


def run_command(stage: Stage, *words: str) -> Process:
    done = stage.start(f"{words[0]}-{len(list(stage.folder.iterdir()))}", *words)
    assert done.code() == 0, done
    return done


def enable_sites(stage: Stage, page: PageClient) -> None:
    page.shows("stopped")
    run_command(stage, "enable", "--session", page.hello["session"])
    page.shows("run")


@pytest.mark.parametrize("scenario", HELD)
def test_every_arm_stops_from_everywhere_and_returns(scenario: str, stage: Stage) -> None:
    running = start_live(stage, scenario)
    with page_client(page_address(running)) as page:
        page.shows("run")
        session = page.hello["session"]
        stop = run_command(stage, "stop", "--session", session).text()
        assert stop.startswith(f"stopping every arm of session {session} ...\n")
        assert len(re.findall(r"^\w+ executes stop at tick \d+$", stop, re.MULTILINE)) == len(
            page.frame["sites"]
        )
        enable_sites(stage, page)
        page.send(do="stop")
        enable_sites(stage, page)
        with watch_session(stage, session) as keys:
            os.write(keys, b"s")
            enable_sites(stage, page)
        page.send(do="end")
        running.prints("checking the log")  # as `demo` does
    running.signal(signal.SIGINT)
    # A compilation is ended by the signal itself, which a shell reports as 130 too.
    assert running.code() in (130, -signal.SIGINT)
    assert_executed_again(open_log(stage.folder / "out" / "run.mcap"))


def is_asked(first: Page, second: Page) -> bool:
    """Lets a page ask whether it may take part while the other holds an arm; false if that lost it before."""
    if not first.evaluate("trilat.frame.holds.includes('m1')"):
        first.mouse.up()
        take_hold(first, 0, 20.0, 5.0)
        wait_until_page(first, "trilat.frame.holds.includes('m1')")
    second.evaluate("document.getElementById('part').click()")
    until(lambda: second.evaluate("trilat.takesPart || trilat.frame.asks"))
    # the first was too slow for a moment, so nobody was in its way
    if second.evaluate("trilat.takesPart"):
        second.evaluate("document.getElementById('part').click()")
        wait_until_page(second, "!trilat.takesPart")
        return False
    wait_until_page(
        first, "trilat.frame.asked.length === 1 && !document.getElementById('ask').hidden"
    )
    return True


@needs_browser
@pytest.mark.long
def test_holders_are_asked_before_others_take_part(stage: Stage) -> None:
    running = start_live(stage, "play", "--set", "rate_hz=250")
    address = page_address(running)
    with browser_page(address) as first:
        wait_until_page(
            first, "trilat.frame && trilat.takesPart && trilat.parts.arms.cards[0].graspable"
        )
        second = first.context.browser.new_page()  # type: ignore[union-attr]
        second.goto(address)
        wait_until_page(second, "trilat.frame && trilat.frame.pages === 2")
        first.bring_to_front()
        for answer in ("no", "yes"):
            assert any(is_asked(first, second) for _ in range(5))
            assert not second.evaluate("trilat.takesPart")
            first.evaluate(f"document.getElementById('ask-{answer}').click()")
            wait_until_page(second, "!trilat.frame.asks")
            wait_until_page(second, f"trilat.takesPart === {str(answer == 'yes').lower()}")
        first.mouse.up()
    running.signal(signal.SIGINT)
    running.prints("checking the log")
