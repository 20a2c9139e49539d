"""The page of `trilat live` in a real browser shows the session, and can end the session in order."""

import contextlib
import os
import re
import signal
from itertools import chain

import numpy as np
import pytest
from playwright.sync_api import Page, sync_playwright
from trilat_people.live_page.page_server import PageOptions, PageServer
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.live.browsers import (
    browser_page,
    chromium_pid,
    launch_browser,
    needs_browser,
    page_address,
    role_address,
    take_hold,
    tip_px,
    wait_until_page,
)
from tests.live.page_client import page_client, socket_address, with_query
from tests.live.processes import (
    PAPER,
    Process,
    Session,
    Stage,
    assert_executed_again,
    connection_options,
)
from tests.net.local_bus import LocalNetwork
from tests.net.waiting import until
from tests.page.whole_pages import watched_page
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.analysis.certificate.energy_balance import EnergyBalance, SiteEnergy
from trilat_net.log.log_reader import Log, open_log
from trilat_net.net.clock import SystemClock
from trilat_net.scenario import load_scenario

pytestmark = needs_browser


def start_live(stage: Stage, scenario: str, *options: str) -> Process:
    """Starts `trilat live` without a browser of its own."""
    return stage.start(
        "live", "live", scenario, "--no-browser", "--out", str(stage.folder / "out"), *options
    )


def assert_energies_match(log: Log, energies: list[list[float]]) -> None:
    """Asserts that the energies on the page are those of `certify` at the same times."""
    balance = EnergyBalance.of_energies(SiteEnergy.by_site(log))
    t_s, V, supplied = np.array(energies).T
    rows = np.searchsorted(balance.t_s, t_s - 1e-9)
    is_recorded = rows < len(balance.t_s)
    assert is_recorded.sum() > 40
    recorded_rows = rows[is_recorded]
    tolerance_j = 1e-9 * np.abs(balance.V).max()
    V_errors = V[is_recorded] - balance.V[recorded_rows]
    work_errors = supplied[is_recorded] - balance.external_work[recorded_rows]
    assert np.abs(V_errors).max() <= tolerance_j
    assert np.abs(work_errors).max() <= tolerance_j


def end_by_button(page: Page) -> None:
    """Ends the session by the button on the page, and confirms the dialog."""
    page.on("dialog", lambda dialog: dialog.accept())
    page.click("#end")


def list_grips(log: Log, site: str) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
    """Returns time in s, grip, and number of the message in force, with a row for every tick."""
    part = log[site]
    return np.column_stack([part.t_s, part.hand[:, 0], part.hand[:, 1]])


def test_people_see_hold_change_and_end_sessions(stage: Stage) -> None:
    # A machine of two cores can draw the page beside loops of this rate.
    running = start_live(stage, "play", "--set", "rate_hz=100")
    with browser_page(page_address(running)) as page:
        wait_until_page(page, "trilat.frame && trilat.frame.t > 1 && trilat.takesPart")
        assert page.locator(".arm").count() == 3
        page.click("#link-presets button:has-text('300 ms')")
        before = page.evaluate("trilat.frame.sites.m1.points.at(-1)")
        take_hold(page, 0, 60.0, 10.0)
        wait_until_page(page, "trilat.frame.holds.includes('m1')")
        wait_until_page(page, f"trilat.frame.sites.m1.points.at(-1)[0] > {before[0]} + 0.02")
        # The page states the hold once the frame is drawn.
        wait_until_page(
            page, "document.querySelector('.arm').innerText.includes('you hold it')"
        )
        page.mouse.up()
        page.fill("#mark-text", "felt it")
        page.click("#mark")
        wait_until_page(page, "trilat.frame.sites.m1.grip === 0 && !trilat.frame.holds.length")
        wait_until_page(
            page, "Object.values(trilat.frame.links).every((link) => link.age_ms > 290)"
        )
        wait_until_page(page, "trilat.energies.length > 60 && trilat.energies.at(-1)[0] > 2")
        energies = page.evaluate("trilat.energies")
        end_by_button(page)
        running.prints("checking the log")  # as `demo` does
    running.signal(signal.SIGINT)
    assert running.code() == 130
    log = open_log(stage.folder / "out" / "run.mcap")
    assert_executed_again(log)
    assert_energies_match(log, energies)
    assert len({event.command for event in log.events if event.kind == "change"}) == 6
    assert [event.text for event in log.events if event.kind == "mark"] == ["felt it"]
    first_hold = next(event.text for event in log.events if event.kind == "hand")
    assert first_hold.startswith("m1: page 1 takes hold")
    assert list_grips(log, "m1")[:, 1].max() == 1.0


PARTIAL_FIELDS = ("hello", "hello.stage", "stage", "sites.*", "links.*.stated.*")
"""Fields that a page may read although not every role receives them, or not for every link."""


@pytest.mark.long
@pytest.mark.parametrize("who", ["experimenter", "user m1", "watcher"])
def test_every_view_of_a_session_is_whole(who: str, stage: Stage) -> None:
    """With varying delays, the page has no error and no empty frame, and draws every line of its plots."""
    settings = (
        "rate_hz=250",
        "link.model=uniform",
        "link.delay_ms=120",
        "link.half_width_ms=60",
    )
    options = chain.from_iterable(("--set", setting) for setting in settings)
    running = start_live(stage, "play", *options)
    with sync_playwright() as playwright, watched_page(launch_browser(playwright)) as watched:
        watched.page.goto(role_address(running, who))
        wait_until_page(watched.page, "window.trilat?.frame?.t > 3")
        watched.assert_whole(PARTIAL_FIELDS)
    running.signal(signal.SIGINT)
    running.prints("checking the log")


@pytest.mark.long
def test_a_finger_drags_an_arm_on_a_phone(stage: Stage) -> None:
    running = start_live(stage, "play", "--set", "rate_hz=100")
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    with browser_page(page_address(running), **phone) as page:
        wait_until_page(
            page, "trilat.frame && trilat.takesPart && trilat.parts.arms.cards[0].graspable"
        )
        page.locator(".arm").first.scroll_into_view_if_needed()
        before = page.evaluate("trilat.frame.sites.m1.points.at(-1)")
        x, y = tip_px(page, 0)
        finger = page.context.new_cdp_session(page)

        def touch(kind: str, *points: dict[str, float]) -> None:
            finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

        touch("touchStart", {"x": x, "y": y})
        for n in range(1, 11):
            touch("touchMove", {"x": x + 4.0 * n, "y": y})
        wait_until_page(page, f"trilat.frame.sites.m1.points.at(-1)[0] > {before[0]} + 0.02")
        assert page.evaluate("trilat.frame.holds") == ["m1"]
        touch("touchEnd")
        wait_until_page(page, "trilat.frame.sites.m1.grip === 0 && !trilat.frame.holds.length")
        # The page does not scroll while a finger moves an arm.
        assert page.evaluate("scrollY") == 0
    running.signal(signal.SIGINT)
    running.prints("checking the log")


STORE_DRAWN_FRAMES = """
const arms = trilat.parts.arms, draw = arms.draw.bind(arms);
window.drawn = [];
arms.draw = (frame) => {
  draw(frame);
  const shown = Object.entries(frame.sites).map(([name, { tick, points }]) => [name, [tick, points]]);
  drawn.push(Object.fromEntries(shown));
};
drawn.length;
"""


IN_USE = ("link.delay_ms=300",)
PICTURE = ("link.delay_ms=50", "sites.m1.view.delay_ms=300", "sites.m1.view.loss=0.2")


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "delays"),
    [(150, IN_USE), (150, PICTURE), (1000, IN_USE)],
    ids=["in use", "picture", "in use, long"],
)
def test_a_users_page_draws_what_the_log_says(
    count: int, delays: tuple[str, ...], stage: Stage
) -> None:
    """Every frame that the browser draws equals the log, with delays of 300 ms and a moving user."""
    settings = ("rate_hz=250", *delays)
    options = chain.from_iterable(("--set", setting) for setting in settings)
    running = start_live(stage, "play", *options)
    with browser_page(role_address(running, "user m1")) as page:
        wait_until_page(page, "trilat.frame && trilat.frame.t > 1 && trilat.takesPart")
        page.evaluate(STORE_DRAWN_FRAMES)
        take_hold(page, 0, 60.0, 10.0)
        wait_until_page(page, f"drawn.length >= {count}", 180.0)
        drawn_frames = page.evaluate("drawn")
        wait_until_page(page, "trilat.frame.sites.s.age_ms >= 300")
        with page_client(page_address(running)) as experimenter:
            experimenter.take()
            experimenter.send(do="ages", shown=False)
            wait_until_page(page, "!('age_ms' in trilat.frame.sites.s)")
        assert page.is_hidden("#plots")
        assert page.is_hidden("#side")
        assert page.is_hidden("#part")
        assert "as m1 knows it" in page.inner_text("#whose")
    running.signal(signal.SIGINT)
    running.prints("checking the log")
    log = open_log(stage.folder / "out" / "run.mcap")
    ages_ticks = []
    shown_ticks = log.shown("m1")
    for frame in drawn_frames:
        own_tick = frame["m1"][0]
        for name, (tick, points) in frame.items():
            expected_tick = own_tick if name == "m1" else shown_ticks[name][own_tick]
            q = np.array([log[name].states[tick].q])
            logged_points_m = build_arm_rows(log.scenario, name).joint_positions_m(q)[0]
            assert tick == expected_tick
            assert points == np.round(logged_points_m, 5).tolist()
        ages_ticks.append(own_tick - frame["s"][0])
    assert min(ages_ticks) >= 75  # 300 ms at 250 Hz


PAD = """
const buttons = Array.from({ length: 17 }, () => ({ pressed: false, value: 0 }));
const pad = { index: 0, connected: true, buttons, axes: [0, 0, 0, 0] };
navigator.getGamepads = () => [pad];
window.pad = pad;
"""


@pytest.mark.long
def test_a_gamepad_leads_the_chosen_arm(stage: Stage) -> None:
    """The gamepad interface of the browser is replaced, because test machines have no gamepad."""
    running = start_live(stage, "play", "--set", "rate_hz=250")
    with browser_page(page_address(running)) as page:
        wait_until_page(
            page, "trilat.frame && trilat.takesPart && trilat.parts.arms.cards[1].graspable"
        )
        page.evaluate(PAD)
        page.evaluate("dispatchEvent(new Event('gamepadconnected'))")
        page.keyboard.press("2")
        before = page.evaluate("trilat.frame.sites.m2.points.at(-1)")
        page.evaluate("pad.buttons[0].pressed = true")
        wait_until_page(page, "trilat.frame.holds.includes('m2')")
        page.evaluate("pad.axes[0] = 0.5")
        wait_until_page(page, f"trilat.frame.sites.m2.points.at(-1)[0] > {before[0]} + 0.02")
        page.evaluate("Object.assign(pad.axes, [0, 0]); pad.buttons[0].pressed = false")
        wait_until_page(page, "trilat.frame.sites.m2.grip === 0 && !trilat.frame.holds.length")
    running.signal(signal.SIGINT)
    running.prints("checking the log")


MOTORS = """
window.rumbles = [];
pad.vibrationActuator = { playEffect: (kind, how) => {
  const at = trilat.parts.arms.cards[2].hold.rumbled; // when the page asked for it
  rumbles.push({ kind, ...how, at, wall: Math.hypot(...trilat.frame.sites.s.wall) });
  return Promise.resolve("complete");
} };
"""


@pytest.mark.long
def test_gamepads_rumble_as_arms_meet_walls(stage: Stage) -> None:
    """A held arm makes the gamepad rumble at most ten times per second, in proportion to the wall force."""
    running = start_live(stage, "play", "--set", "rate_hz=250")
    with browser_page(page_address(running)) as page:
        wait_until_page(
            page, "trilat.frame && trilat.takesPart && trilat.parts.arms.cards[2].graspable"
        )
        page.evaluate(PAD)
        page.evaluate(MOTORS)
        page.evaluate("dispatchEvent(new Event('gamepadconnected'))")
        page.keyboard.press("3")
        page.evaluate("pad.buttons[0].pressed = true")
        wait_until_page(page, "trilat.frame.holds.includes('s')")
        assert page.evaluate("rumbles") == []
        page.evaluate("pad.axes[0] = 1.0")
        wait_until_page(page, "rumbles.length > 5")
        page.evaluate("Object.assign(pad.axes, [0, 0]); pad.buttons[0].pressed = false")
        wait_until_page(page, "trilat.frame.sites.s.grip === 0 && !trilat.frame.holds.length")
        rumbles = page.evaluate("rumbles")
        wait_until_page(page, "trilat.frame.n > 30")
        assert page.evaluate("rumbles.length") == len(rumbles)
    times_ms = [rumble["at"] for rumble in rumbles]
    assert min(np.diff(times_ms)) >= 100.0
    for rumble in rumbles:
        assert rumble["kind"] == "dual-rumble"
        assert rumble["strongMagnitude"] == pytest.approx(min(1.0, rumble["wall"] / 40.0))
    running.signal(signal.SIGINT)
    running.prints("checking the log")


@pytest.mark.long
@pytest.mark.parametrize("killed", ["browser", "server"])
def test_arms_are_free_after_their_page_dies(killed: str, stage: Stage) -> None:
    """The force is zero within 320 ms of the last message, and the log states that the hand let go."""
    session = Session(stage, "play", PAPER, "--duration", "60", "--set", "rate_hz=250")
    session.all()
    options = connection_options(session.endpoints)
    page_server = stage.start("page", "live", "--session", "t", "--no-browser", *options)
    with sync_playwright() as playwright:
        browser = launch_browser(playwright)
        page = browser.new_page()
        page.goto(page_address(page_server))
        wait_until_page(page, "trilat.frame && trilat.frame.t > 1 && trilat.takesPart")
        take_hold(page, 0, 40.0, 10.0)
        wait_until_page(page, "trilat.frame.sites.m1.grip === 1")
        os.kill(page_server.pid if killed == "server" else chromium_pid(), signal.SIGKILL)
    session.ends_well()
    log = open_log(session.log)
    t_s, grip, message_number = list_grips(log, "m1").T
    last_message_tick = np.flatnonzero(np.diff(message_number) > 0)[-1] + 1
    first_free_tick = np.flatnonzero(grip > 0.0)[-1] + 1
    last_message_s = t_s[last_message_tick]
    free_s = t_s[first_free_tick]
    assert free_s - last_message_s < 0.32
    assert "hand" in {event.kind for event in log.events}
    assert all(log.missing(site) == 0 for site in log.sites)


@pytest.mark.long
def test_a_hostile_page_costs_the_loops_nothing(stage: Stage) -> None:
    """Floods, large messages, NaN and far targets are refused and counted, and no record is missing."""
    running = start_live(stage, "play", "--set", "rate_hz=250")
    address = page_address(running)
    with browser_page(address) as page:
        wait_until_page(page, "trilat.frame && trilat.frame.t > 1")
        for _ in range(3):
            with (
                connect(socket_address(address), max_size=None) as hostile,
                contextlib.suppress(ConnectionClosed),
            ):
                hostile.send('{"do":"control","want":true}')
                hostile.send('{"do":"hand","site":"m1","grip":true,"to":[1000.0,0.0]}')
                hostile.send('{"do":"hand","site":"m1","grip":true,"to":[NaN,0.0]}')
                for _ in range(100_000):
                    hostile.send('{"do":"hand","site":"m1","grip":true,"to":[1000.0,0.0]}')
            with (
                connect(socket_address(address), max_size=None) as hostile,
                contextlib.suppress(ConnectionClosed),
            ):
                hostile.send("x" * (10 << 20))
        wait_until_page(page, "trilat.frame.refused > 3000")
        assert page.evaluate("trilat.frame.sites.m1.grip") == 0
    running.signal(signal.SIGINT)
    assert running.code(180.0) == 0, running
    log = open_log(stage.folder / "out" / "run.mcap")
    assert all(log.missing(site) == 0 for site in log.sites)
    assert list_grips(log, "m1")[:, 1].max() == 0.0
    assert log.link_stats("m1")[-1].dropped["hand: out of range"] > 0


COUNT_OPAQUE_PIXELS = """(card) => {
  const canvas = document.querySelectorAll('.arm canvas')[card];
  const { width, height } = canvas;
  const bytes = canvas.getContext('2d').getImageData(0, 0, width, height).data;
  let count = 0;
  for (let k = 3; k < bytes.length; k += 4) count += bytes[k] > 200;
  return count;
}"""


@pytest.mark.long
@pytest.mark.parametrize("gl", [True, False], ids=["WebGL", "no WebGL"])
def test_three_arms_are_drawn_with_webgl_and_without(gl: bool, stage: Stage) -> None:
    running = start_live(stage, "paper", "--duration", "30")
    with browser_page(with_query(page_address(running), "webgl"), gl=gl) as page:
        wait_until_page(page, "trilat.frame && trilat.frame.t > 2")
        until(
            lambda: page.inner_text("#painter").startswith("drawn with" if gl else "no WebGL")
        )
        for card in range(3):
            assert page.evaluate(COUNT_OPAQUE_PIXELS, card) > 500
    running.signal(signal.SIGINT)
    assert running.code(180.0) == 0, running
    assert "ok   executed again" in running.text()


@pytest.mark.long
def test_a_second_page_only_watches_until_it_asks(stage: Stage) -> None:
    running = start_live(stage, "two_sites", "--duration", "30")
    address = page_address(running)
    with browser_page(address) as first:
        wait_until_page(first, "trilat.frame && trilat.takesPart")
        second = first.context.browser.new_page()  # type: ignore[union-attr]
        second.goto(address)
        wait_until_page(second, "trilat.frame && trilat.frame.pages === 2")
        assert not second.evaluate("trilat.takesPart")
        assert second.is_disabled("#link-delay")
        second.click("#part")
        wait_until_page(second, "trilat.takesPart")
        wait_until_page(first, "trilat.takesPart")
    running.signal(signal.SIGINT)
    assert running.code(180.0) == 0, running


LARGE = """
const card = trilat.parts.arms.cards[0], large = [-100, 100];
card.nextWords = 0;
card.numbers({ ...trilat.frame.sites[card.name], e: 100, tau: large, pull: large, hand: large });
"""


@pytest.mark.long
def test_stopped_arms_and_lost_peers_are_shown(stage: Stage) -> None:
    settings = ("rate_hz=250", "on_stale.action=glide", "on_stale.align_limit_rad=3")
    options = chain.from_iterable(("--set", setting) for setting in settings)
    running = start_live(stage, "two_sites", "--duration", "60", *options)
    with browser_page(page_address(running)) as page:
        wait_until_page(page, "trilat.frame && trilat.frame.sites.s.mode === 'run'")
        assert page.locator("#alarms .raised").count() == 0
        arm_box = page.locator(".arm").first.bounding_box()
        endpoints = re.findall(r"tcp/127\.0\.0\.1:\d+", running.text())[:2]
        connection = connection_options(endpoints)
        name = page.evaluate("trilat.hello.session")
        stop = stage.start("stop", "stop", "--session", name, "s", *connection)
        assert stop.code() == 0, stop
        page.wait_for_selector("#alarms .raised")
        assert "s STOPPED" in page.inner_text("#alarms .raised")
        wait_until_page(
            page,
            "document.querySelector('#alarms .raised').innerText.includes('ordered by the operator')",
        )
        assert page.inner_text("#alarms button") == "Enable"
        assert "trilat enable" not in page.inner_text("body")
        box = page.locator("#alarms .raised").bounding_box()
        assert box is not None
        assert box["height"] > 50.0
        assert 0.0 < box["y"] < page.evaluate("innerHeight") - box["height"]
        # A held arm stays under the pointer.
        assert page.locator(".arm").first.bounding_box() == arm_box
        wait_until_page(page, "document.querySelector('#state').textContent === 's STOPPED'")
        page.evaluate(
            "document.querySelector('#state').textContent = 's STOPPED, m STOPPED, and more'"
        )
        assert page.locator(".arm").first.bounding_box() == arm_box
        canvas_box = page.locator(".arm canvas").first.bounding_box()
        page.evaluate(LARGE)
        assert page.locator(".arm canvas").first.bounding_box() == canvas_box
        if "TRILAT_PICTURES" in os.environ:
            page.screenshot(path=f"{os.environ['TRILAT_PICTURES']}/stopped.png")
        page.click("#alarms button")
        wait_until_page(
            page,
            "trilat.frame.sites.s.mode === 'run' && !document.querySelector('#alarms .raised')",
        )
        for sentence in (
            "s was stopped by the operator at",
            "s was enabled by the experimenter at",
        ):
            wait_until_page(
                page, f"document.querySelector('#event-list').innerText.includes('{sentence}')"
            )
        assert "{" not in page.inner_text("#event-list")
    running.signal(signal.SIGINT)
    assert running.code(180.0) == 0, running
    assert "*** s STOPPED" in running.text()


@pytest.mark.long
@pytest.mark.parametrize(
    ("who", "way"),
    [
        ("user m1", "key"),
        ("user m2", "pad"),
        ("watcher", "finger"),
        ("watcher", "key"),
        ("experimenter", "pad"),
    ],
)
def test_every_role_stops_every_arm(who: str, way: str, stage: Stage) -> None:
    running = start_live(stage, "play", "--set", "rate_hz=250")
    phone = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
    link = role_address(running, who)
    with browser_page(link, **(phone if way == "finger" else {})) as page:
        wait_until_page(page, "trilat.frame && trilat.frame.t > 1")
        if way == "key":
            page.keyboard.press("Escape")
        elif way == "pad":
            page.evaluate(PAD)
            page.evaluate(
                "dispatchEvent(new Event('gamepadconnected')); pad.buttons[8].pressed = true"
            )
        else:
            box = page.locator("#stop").bounding_box()
            assert box is not None
            assert min(box["height"], box["width"]) >= 44.0
            assert 844.0 - 20.0 <= box["y"] + box["height"] <= 844.0
            page.tap("#stop")
        with page_client(page_address(running)) as watching:
            watching.shows("stopped")
    running.signal(signal.SIGINT)
    running.prints("checking the log")


def test_browsers_get_in_by_their_links_token() -> None:
    """The token is in the fragment of the link. The page shows an error for a wrong token."""
    said: list[str] = []
    options = PageOptions(host="0.0.0.0", insecure=True)
    with PageServer(
        LocalNetwork().join(), SystemClock(), "s1", options, say=said.append
    ) as server:
        server.view.scenario = load_scenario("paper")
        until(lambda: any(line.startswith("user m1: ") for line in said))
        (line,) = (line for line in said if line.startswith("user m1: "))
        link = line.removeprefix("user m1: ").replace("0.0.0.0", "127.0.0.1")
        with browser_page(link) as page:
            wait_until_page(page, "trilat.hello?.role === 'user' && trilat.hello.as === 'm1'")
            page.goto(link.replace("as=m1", "as=m2"))
            wait_until_page(
                page, "document.querySelector('#notice').textContent.includes('no token')"
            )
            assert page.evaluate("trilat.hello") is None
