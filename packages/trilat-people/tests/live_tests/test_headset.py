"""Controllers of an emulated headset move an arm of six joints, by a page over TLS in a real browser.

`iwer.min.js` is the build of IWER 2.5.0 (npm `iwer`, Meta Platforms, MIT: `iwer-LICENSE`). It stands in for
the WebXR runtime of a Quest 3: poses and buttons come from the script of the test.
"""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from tests.live.browsers import (
    browser_page,
    needs_browser,
    page_address,
    role_address,
    wait_until_page,
)
from tests.live.page_client import with_query
from tests.live.processes import Process, Stage, assert_executed_again
from trilat_net import create_keys
from trilat_net.log.log_reader import Log, open_log

pytestmark = needs_browser

INSTALLATION = """
window.headset = new IWER.XRDevice(IWER.metaQuest3);
headset.installRuntime({ forceInstall: true });
headset.stereoEnabled = false;
window.lost = false; // A headset marks poses that it cannot see as emulated, but IWER marks all of them.
Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => lost });
const { getContext } = HTMLCanvasElement.prototype; // Drawing smooth edges in software is slow.
HTMLCanvasElement.prototype.getContext = function (kind, how) {
  return getContext.call(this, kind, { ...how, antialias: false });
};
"""
VIEW: dict[str, Any] = {"viewport": {"width": 480, "height": 320}, "ignore_https_errors": True}
RUNTIME = (Path(__file__).parent / "iwer.min.js").read_text(encoding="utf-8") + INSTALLATION
MOVE = """([side, x, y, z]) => {
  headset.controllers[side].position.set(x, y, z);
  return trilat.parts.headset.frames;
}"""
HELD = (
    "trilat.parts.headset.controllers.right.card !== null && trilat.frame.holds.includes('m1')"
)
PRESS = "([side, button, value]) => headset.controllers[side].updateButtonValue(button, value)"
SCENARIO = Path(__file__).parents[4] / "examples" / "headset.toml"
SETTLING_TICKS = 20
"""Ticks from the hold of a moving arm until the target rests at the observed place of the arm."""


class Controllers:
    """Moves the controllers of a page's headset frame by frame."""

    def __init__(self, page: Page) -> None:
        self.page = page

    def place(self, side: str, x: float, y: float, z: float) -> None:
        """Places a controller, and waits until the page has processed a frame with the new pose."""
        frames = self.page.evaluate(MOVE, [side, x, y, z])
        wait_until_page(self.page, f"trilat.parts.headset.frames > {frames + 1}", 60.0)

    def press(self, side: str, button: str, value: float) -> None:
        """Presses a button of a controller with a value from 0 to 1."""
        self.page.evaluate(PRESS, [side, button, value])


def enter_vr(page: Page) -> Controllers:
    """Enters the headset view of a page, and returns the controllers of the headset."""
    wait_until_page(
        page,
        "trilat.frame && trilat.frame.t > 1 && trilat.takesPart && trilat.parts.arms.cards[0].graspable",
    )
    wait_until_page(page, "Boolean(document.querySelector('#enter-vr'))")
    page.click("#enter-vr")
    wait_until_page(
        page, "trilat.parts.headset.session && trilat.parts.headset.frames > 3", 60.0
    )
    return Controllers(page)


def start_live(stage: Stage) -> Process:
    """Starts `trilat live` with a page over TLS."""
    keys = create_keys(stage.folder / "keys", ["operator"])[0]
    options = ["--out", str(stage.folder / "out"), "--tls", str(keys), "--set", "rate_hz=100"]
    return stage.start("live", "live", str(SCENARIO), "--no-browser", *options)


def end_live(running: Process, stage: Stage) -> Log:
    """Ends the session, and returns its log after an exact re-execution."""
    running.signal(signal.SIGINT)
    running.prints("checking the log")
    running.signal(signal.SIGINT)  # The test needs no report.
    running.code()
    log = open_log(stage.folder / "out" / "run.mcap")
    assert_executed_again(log)
    return log


def move_arm(page: Page, controllers: Controllers) -> bool:
    """Moves the arm with a controller, which jumps away and back. Returns False if the hold was lost.

    A slow machine may lose the hold.
    """
    controllers.press("right", "trigger", 0.0)
    controllers.place("right", 0.2, 1.2, -0.3)
    wait_until_page(page, "!trilat.frame.holds.length")
    dropped = page.evaluate("trilat.parts.headset.dropped")
    controllers.press("right", "trigger", 1.0)
    wait_until_page(page, "trilat.frame.holds.includes('m1')")
    # The target rests at the place of the arm before the controller moves.
    held_s = page.evaluate("trilat.frame.t")
    wait_until_page(page, f"trilat.frame.t > {held_s + 0.3}")
    path_m = [(0.2 - 0.004 * n, 1.2 + 0.006 * n, -0.3 - 0.01 * n) for n in range(1, 11)]
    jump_m = [(0.76, 1.26, -0.4), (0.16, 1.26, -0.4)]
    for position_m in path_m + jump_m:
        controllers.place("right", *position_m)
        if not page.evaluate(HELD):
            return False
    assert page.evaluate("trilat.parts.headset.dropped") == dropped + 2
    # The target follows with a limited speed and acceleration.
    arrived_s = page.evaluate("trilat.frame.t")
    wait_until_page(page, f"trilat.frame.t > {arrived_s + 0.5}")
    return bool(page.evaluate(HELD))


@pytest.mark.long
def test_a_controller_leads_an_arm_of_six_joints(stage: Stage) -> None:
    """The log has half the motion, with x ahead, y left and z up, and ignores a jump of 0.6 m."""
    running = start_live(stage)
    with browser_page(
        with_query(page_address(running), "flat"), script=RUNTIME, gl=True, **VIEW
    ) as page:
        assert page.evaluate("isSecureContext && location.protocol === 'https:'")
        controllers = enter_vr(page)
        assert any(move_arm(page, controllers) for _ in range(5))
        controllers.press("right", "trigger", 0.0)
        wait_until_page(page, "!trilat.frame.holds.length")
        assert page.evaluate("trilat.parts.headset.scenes.length") == 3
        page.evaluate("trilat.parts.headset.session.end()")
        wait_until_page(page, "trilat.parts.headset.session === null")
    log = end_live(running, stage)
    part = log["m1"]
    free_ticks = np.flatnonzero(~(part.hand[:, 2] > 0.0))
    last_hold = np.flatnonzero(np.diff(free_ticks) > 1)[-1]
    begin_tick, end_tick = free_ticks[last_hold : last_hold + 2]
    target = part.hand[begin_tick + 1 : end_tick, 3:6]
    assert log.scenario.arms["m1"].counts.joints == 6
    moved_m = target[-1] - target[SETTLING_TICKS]
    assert moved_m == pytest.approx([0.5 * 0.1, 0.5 * 0.04, 0.5 * 0.06], abs=1e-4)
    assert np.ptp(target, axis=0).max() < 0.15
    tip = np.array([log.scenario.arms["m1"].end_effector(q) for q in part.q])
    assert np.linalg.norm(tip - tip[0], axis=1).max() > 0.02
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert (texts[0], texts[-1]) == ("m1: page 1 takes hold", "m1: page 1 lets go")


@pytest.mark.long
def test_lost_controllers_let_go_and_buttons_stop(stage: Stage) -> None:
    """On the page of a user, both controllers move the user's own arm."""
    running = start_live(stage)
    link = role_address(running, "user m1")
    with browser_page(f"{link}&flat", script=RUNTIME, gl=True, **VIEW) as page:
        controllers = enter_vr(page)
        controllers.place("left", -0.2, 1.2, -0.3)
        controllers.press("left", "squeeze", 1.0)
        wait_until_page(page, "trilat.frame.holds.includes('m1')")
        page.evaluate("lost = true")
        wait_until_page(page, "!trilat.frame.holds.length")
        page.evaluate("lost = false")
        controllers.place("left", -0.2, 1.2, -0.3)
        assert page.evaluate("trilat.frame.holds") == []
        controllers.press("right", "b-button", 1.0)
        wait_until_page(page, "trilat.frame.sites.m1.mode === 'stopped'")
    end_live(running, stage)
