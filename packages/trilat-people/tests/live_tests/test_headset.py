"""A headset that is none, in a real browser: its controllers lead an arm of six joints, by the page over TLS.

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

INSTALLED = """
window.headset = new IWER.XRDevice(IWER.metaQuest3);
headset.installRuntime({ forceInstall: true });
headset.stereoEnabled = false;
window.lost = false; // IWER calls all its poses emulated; a headset those that it does not see
Object.defineProperty(XRPose.prototype, "emulatedPosition", { get: () => lost });
const { getContext } = HTMLCanvasElement.prototype; // smooth edges take most of what software draws with
HTMLCanvasElement.prototype.getContext = function (kind, how) {
  return getContext.call(this, kind, { ...how, antialias: false });
};
"""
VIEW: dict[str, Any] = {"viewport": {"width": 480, "height": 320}, "ignore_https_errors": True}
RUNTIME = (Path(__file__).parent / "iwer.min.js").read_text(encoding="utf-8") + INSTALLED
MOVE = """([side, x, y, z]) => {
  headset.controllers[side].position.set(x, y, z);
  return trilat.parts.headset.frames;
}"""
HELD = (
    "trilat.parts.headset.controllers.right.card !== null && trilat.frame.holds.includes('m1')"
)
PRESS = "([side, button, value]) => headset.controllers[side].updateButtonValue(button, value)"
SCENARIO = Path(__file__).parents[4] / "examples" / "headset.toml"
SETTLED = 20
"""Ticks from taking hold of an arm, which moves, until its target rests where the arm was seen."""


class Controllers:
    """The controllers of the headset of a page, which are moved frame by frame."""

    def __init__(self, page: Page) -> None:
        self.page = page

    def place(self, side: str, x: float, y: float, z: float) -> None:
        """Places a controller, and waits until the page has seen it there."""
        frames = self.page.evaluate(MOVE, [side, x, y, z])
        wait_until_page(self.page, f"trilat.parts.headset.frames > {frames + 1}", 60.0)

    def press(self, side: str, button: str, value: float) -> None:
        self.page.evaluate(PRESS, [side, button, value])


def enter(page: Page) -> Controllers:
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


def served(stage: Stage) -> Process:
    keys = create_keys(stage.folder / "keys", ["operator"])[0]
    served_by = "--out", str(stage.folder / "out"), "--tls", str(keys), "--set", "rate_hz=100"
    return stage.start("live", "live", str(SCENARIO), "--no-browser", *served_by)


def ended(running: Process, stage: Stage) -> Log:
    running.signal(signal.SIGINT)
    running.prints("checking the log")
    running.signal(signal.SIGINT)  # nobody reads its report
    running.code()
    log = open_log(stage.folder / "out" / "run.mcap")
    assert_executed_again(log)
    return log


def leads(page: Page, hands: Controllers) -> bool:
    """Takes hold and leads the arm, with a jump there and back; False if a late page had to let go."""
    hands.press("right", "trigger", 0.0)
    hands.place("right", 0.2, 1.2, -0.3)
    wait_until_page(page, "!trilat.frame.holds.length")
    dropped = page.evaluate("trilat.parts.headset.dropped")
    hands.press("right", "trigger", 1.0)
    wait_until_page(page, "trilat.frame.holds.includes('m1')")
    way = [(0.2 - 0.004 * n, 1.2 + 0.006 * n, -0.3 - 0.01 * n) for n in range(1, 11)]
    for at in (*way, (0.76, 1.26, -0.4), (0.16, 1.26, -0.4)):
        hands.place("right", *at)
        if not page.evaluate(HELD):
            return False
    assert page.evaluate("trilat.parts.headset.dropped") == dropped + 2
    arrived_s = page.evaluate(
        "trilat.frame.t"
    )  # the target follows with a limited speed and acceleration
    wait_until_page(page, f"trilat.frame.t > {arrived_s + 0.5}")
    return bool(page.evaluate(HELD))


@pytest.mark.long
def test_a_controller_leads_an_arm_of_six_joints(stage: Stage) -> None:
    """By the log: half as far, ahead as x, left as y, up as z; what jumps by 0.6 m moves nothing."""
    running = served(stage)
    with browser_page(
        with_query(page_address(running), "flat"), script=RUNTIME, gl=True, **VIEW
    ) as page:
        assert page.evaluate("isSecureContext && location.protocol === 'https:'")
        hands = enter(page)
        assert any(leads(page, hands) for _ in range(5))
        hands.press("right", "trigger", 0.0)
        wait_until_page(page, "!trilat.frame.holds.length")
        assert page.evaluate("trilat.parts.headset.scenes.length") == 3
        page.evaluate("trilat.parts.headset.session.end()")
        wait_until_page(page, "trilat.parts.headset.session === null")
    log = ended(running, stage)
    part = log["m1"]
    free = np.flatnonzero(~(part.hand[:, 2] > 0.0))
    begins, ends = free[np.flatnonzero(np.diff(free) > 1)[-1] :][:2]
    target = part.hand[begins + 1 : ends, 3:6]  # of the last hold, which led all the way
    assert log.scenario.arms["m1"].counts.joints == 6
    led = target[-1] - target[SETTLED]
    assert led == pytest.approx([0.5 * 0.1, 0.5 * 0.04, 0.5 * 0.06], abs=1e-4)
    assert np.ptp(target, axis=0).max() < 0.15
    tip = np.array([log.scenario.arms["m1"].end_effector(q) for q in part.q])
    assert np.linalg.norm(tip - tip[0], axis=1).max() > 0.02
    texts = [event.text.partition(" at t")[0] for event in log.events if event.kind == "hand"]
    assert (texts[0], texts[-1]) == ("m1: page 1 takes hold", "m1: page 1 lets go")


@pytest.mark.long
def test_lost_controllers_let_go_and_buttons_stop(stage: Stage) -> None:
    """On the page of a user, whose controllers both lead its own arm."""
    running = served(stage)
    link = role_address(running, "user m1")
    with browser_page(f"{link}&flat", script=RUNTIME, gl=True, **VIEW) as page:
        hands = enter(page)
        hands.place("left", -0.2, 1.2, -0.3)
        hands.press("left", "squeeze", 1.0)
        wait_until_page(page, "trilat.frame.holds.includes('m1')")
        page.evaluate("lost = true")
        wait_until_page(page, "!trilat.frame.holds.length")
        page.evaluate("lost = false")
        hands.place("left", -0.2, 1.2, -0.3)
        assert page.evaluate("trilat.frame.holds") == []
        hands.press("right", "b-button", 1.0)
        wait_until_page(page, "trilat.frame.sites.m1.mode === 'stopped'")
    ended(running, stage)
