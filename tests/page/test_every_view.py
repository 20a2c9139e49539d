"""Every view of the live page with data of every kind: no error, no empty frame, every line of every plot drawn."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from live.experiment_stage import Stage, TrialWatch
from live.page_server import PageServer
from tests.analysis.logs import BUSY, FOUR
from tests.chains import six_joints
from tests.live.browsers import launch, needs_browser
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.sites.sessions import Session, gliding, reached
from tests.studies.experiment.experiments import APART, REACH, write_protocol
from tests.task_arms import planar_task, posed_arms
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.scenario.delay_models import DELAY_MODELS
from trilat_net.studies.experiment.experiment_run import Experiment, begin_experiment
from trilat_net.studies.experiment.trial_run import ExperimentTrial

from .people import NO_SESSION
from .recorded_session import ROLES, RecordedSession, record_session, record_views
from .whole_pages import watched_page

pytestmark = needs_browser

Json = dict[str, Any]
Views = Callable[[Path], RecordedSession]
OF_A_HAND = ("grip", "source", "target", "hand_limited")
"""Fields of a site whose scenario has a live hand."""
OF_LINKS = {name for model in DELAY_MODELS.values() for name in model.__struct_fields__}


def list_optional_fields(session: RecordedSession, role: str) -> list[str]:
    """Patterns of the fields that a page of a role may read although its frames lack them.

    A message is a hello or a frame. A stage belongs to an experiment. A link has the fields of its model. A user's page
    gets all fields of its own site, and of the other sites what the user is shown of them.
    """
    own = {"age_ms", *OF_A_HAND, *session.frames[role][-1]["sites"][session.user]}
    links = [f"links.*.stated.{name}" for name in OF_LINKS]
    changes = [f"events[[]].change.to.{name}" for name in OF_LINKS]
    kinds = [f"events[[]].change.{name}" for name in ("link", "dominance")]
    return ["hello", "hello.stage", "stage", *(f"sites.*.{name}" for name in own), *links, *changes, *kinds]


def give_orders(orders: dict[float, str], bus: Bus, clock: Clock) -> None:
    """Orders sites of a running session, at times after its start, s."""
    begun_ns = clock.monotonic_ns()
    for at_s, order in orders.items():
        clock.sleep_until(begun_ns + int(at_s * 1e9))
        reached(bus, clock).order(["s"], order)


def record(scenario: Scenario, user: str, orders: dict[float, str] = {}) -> Views:
    """Returns what records the views of a session, in which the slave may be given orders."""

    def run(folder: Path) -> RecordedSession:
        session = Session.whole(scenario, folder, ends={})
        if orders:
            session.stranger(lambda bus, clock: give_orders(orders, bus, clock))
        return record_views(session, user)

    return run


def parse(text: str, **overrides: Any) -> Scenario:
    return parse_scenario(text, overrides={"rate_hz": 200, **overrides})


CAROUSEL = {"class": "tests.own_code:Carousel", "bodies": {"box": [0.2, 0.2, 0.1]}}
MIXED = {"model": "gamma", "delay_ms": 120.0, "deviation_ms": 40.0, "loss": 0.2, "loss_burst": 4.0}
SESSIONS: dict[str, Views] = {
    "one leads": record_session,
    "two sites": record(load_scenario("two_sites", {"duration_s": 3.0, "link": MIXED}), "m"),
    "four sites": record(parse_scenario(FOUR, overrides={"duration_s": 3.0}), "a"),
    "links of many kinds": record(parse_scenario(BUSY, overrides={"duration_s": 5.0}), "b"),
    "no injected delay": record(
        load_scenario("two_sites", {"duration_s": 3.0, "rate_hz": 200, "link": {"model": "measured"}}), "m"
    ),
    "six joints": record(parse(six_joints(3.0)), "m1"),
    "planar task": record(parse(planar_task(3.0)), "m"),
    "posed task": record(parse(posed_arms(3.0)), "m2"),
    "carried bodies": record(
        load_scenario("paper", {"duration_s": 3.0, "rate_hz": 200, "sites.s.plant": CAROUSEL}), "m1"
    ),
    "wall": record(load_scenario("contact", {"duration_s": 3.0, "rate_hz": 200}), "m"),
    "stopped": record(gliding(5.0), "m", {2.5: "stop"}),
    "stopped and enabled": record(gliding(6.0), "m", {2.0: "stop", 3.5: "enable"}),
    "fault": record(gliding(4.0, **{"sites.s.limits.qd_limit_rad_s": 0.1}), "m"),
    "diverged": record(
        load_scenario("free", {"duration_s": 4.0, "rate_hz": 200, "limits.qd_limit_rad_s": 4.5}), "m1"
    ),
}
PUSHED = ("one leads", "links of many kinds")
NAMES = [pytest.param(name, marks=() if name in PUSHED else pytest.mark.long) for name in SESSIONS]


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], RecordedSession]:
    """Sessions by their name, each recorded once."""
    known: dict[str, RecordedSession] = {}

    def find(name: str) -> RecordedSession:
        if name not in known:
            known[name] = SESSIONS[name](tmp_path_factory.mktemp("session"))
        return known[name]

    return find


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with PageServer(LocalNetwork().join(), SystemClock(), "s1") as server:
        yield server.address


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = launch(playwright)
        yield browser
        browser.close()


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("name", NAMES)
def test_view_draws_everything(
    name: str, role: str, sessions: Callable[[str], RecordedSession], browser: Browser, address: str
) -> None:
    session = sessions(name)
    with session.watched(browser, address, role, "desktop", "light") as watched:
        optional = list_optional_fields(session, role)
        watched.assert_whole(optional)
        page = watched.page
        assert page.locator(".arm canvas").count() == len(session.frames[role][-1]["sites"])
        assert page.evaluate("observed.charts()") == (0 if role == "user" else 5)
        use(page)
        watched.assert_whole(optional)


def use(page: Page) -> None:
    """Presses what changes the picture: one scene, full screen, dark, a phone's width."""
    page.click("#scene")
    page.keyboard.press("f")
    page.keyboard.press("f")
    page.hover("#arms")
    page.emulate_media(color_scheme="dark")
    page.set_viewport_size({"width": 600, "height": 900})
    page.click("#apart")
    page.evaluate("new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve, 250)))")


def test_view_of_waiting_session_has_no_empty_frame(address: str, browser: Browser) -> None:
    for query in ("", "?as=m1", "?watch"):
        with watched_page(browser) as watched:
            watched.page.goto(address + query)
            watched.page.wait_for_function("window.trilat?.hello?.running === false")
            watched.assert_whole(["hello", "hello.stage"])


ASKS = """
trials = 1
consent = "We record how the arms move."
questionnaires = [
  { name = "tlx" },
  { name = "trust", items = { it = "I trusted it." }, most = 7 },
]
rest_s = 30
feedback = ["completion_s", "movement_s", "reaction_s", "error_end_mm", "error_rms_mm", "path_m"]
"""
