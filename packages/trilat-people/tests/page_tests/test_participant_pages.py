"""The pages of an experiment's users in a browser, at a desk and on a phone: task, questionnaire, words."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from people_builders import NO_SESSION, PAIR, replace_text
from playwright.sync_api import Browser, Page, WebSocketRoute
from trilat_people.experiment.experiment_run import Experiment
from trilat_people.live_page.experiment_stage import Stage

from tests.experiments import write_protocol
from tests.live.browsers import needs_browser
from tests.live.page_client import with_query
from tests.net.manual_clock import ManualClock
from tests.net.waiting import until

from .recorded_session import SCREENS, RecordedSession, record_session

pytestmark = [needs_browser, pytest.mark.long]

FORMS = """
questionnaires = [
  { name = "tlx" },
  { name = "trust", items = { it = "I trusted it.", me = "It trusted me." } },
]
"""
Json = dict[str, Any]


@pytest.fixture(scope="module")
def forms(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Json]:
    """By the name of a questionnaire, the stage that a user's page shows for its form."""
    folder = tmp_path_factory.mktemp("forms")
    file = replace_text(write_protocol(folder, PAIR), "trials = 2\n", f"trials = 2\n{FORMS}")
    experiment = Experiment.begin(file, folder / "out")
    stage = Stage(experiment.plan, ManualClock(1))
    stages = {}
    for step in experiment.plan.list_steps():
        if step.form is not None and step.form.name not in stages:
            stage.request_step(step)
            stage.poll(NO_SESSION, [("m1", 1), ("m2", 2)])
            stages[step.form.name] = stage.describe("user", "m1", 1, None)
    return stages


@contextmanager
def form_page(
    browser: Browser, address: str, stage: Json, screen: str
) -> Iterator[tuple[Page, list[Json]]]:
    """Opens a user's page with a form; yields the page, and its messages besides `seen`."""
    sent: list[Json] = []
    hello = {
        "running": False,
        "session": "t",
        "here": [],
        "missing": [],
        "role": "user",
        "as": "m1",
    }

    def attend(route: WebSocketRoute) -> None:
        def answer(message: Any) -> None:
            if json.loads(message)["do"] != "seen":
                sent.append(json.loads(message))

        route.on_message(answer)
        route.send(json.dumps({"hello": {**hello, "ends": False, "n": 0, "stage": stage}}))

    context = browser.new_context(**SCREENS[screen])
    try:
        page = context.new_page()
        problems: list[str] = []
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.route_web_socket("**/socket*", attend)
        page.goto(with_query(address, "as=m1"))
        page.wait_for_selector("#sheet form")
        yield page, sent
        assert problems == []
    finally:
        context.close()


@pytest.mark.parametrize("screen", SCREENS)
def test_untouched_sliders_are_empty_and_sent_as_missing(
    address: str, browser: Browser, forms: dict[str, Json], screen: str
) -> None:
    with form_page(browser, address, forms["tlx"], screen) as (page, sent):
        sliders = page.locator("#sheet input[type=range]")
        assert sliders.count() == page.locator("#sheet input.unset").count() == 6
        sliders.nth(0).click()  # in the middle, where the value is already
        sliders.nth(3).focus()
        page.keyboard.press("ArrowRight")
        assert page.locator("#sheet input.unset").count() == 4
        page.click("#sheet button.main")
        assert sent == []  # it says first what is missing
        assert page.inner_text("#sheet .left-out").startswith("4 items have no answer")
        assert page.locator("#sheet fieldset.missing").count() == 4
        page.click("#sheet button.main")
        until(lambda: sent)
        assert sent[0]["answers"] == [50, None, None, 55, None, None]


@pytest.mark.parametrize("screen", SCREENS)
def test_touched_sliders_are_placed_where_pressed(
    address: str, browser: Browser, forms: dict[str, Json], screen: str
) -> None:
    with form_page(browser, address, forms["tlx"], screen) as (page, _):
        slider = page.locator("#sheet input[type=range]").nth(1)
        box = slider.bounding_box()
        assert box is not None
        slider.click(position={"x": 0.25 * box["width"], "y": 0.5 * box["height"]})
        assert abs(float(slider.input_value()) - 25.0) <= 5.0
        assert page.locator("#sheet .slider:has(.unset)").count() == 5


@pytest.mark.parametrize("screen", SCREENS)
def test_unmade_choices_are_missing(
    address: str, browser: Browser, forms: dict[str, Json], screen: str
) -> None:
    with form_page(browser, address, forms["trust"], screen) as (page, sent):
        page.locator("#sheet .choices").nth(1).locator("input").nth(6).click()
        page.click("#sheet button.main")
        page.click("#sheet button.main")
        until(lambda: sent)
        assert sent[0]["answers"] == [None, 7]


def test_a_forced_choice_waits_for_its_answer(
    address: str, browser: Browser, forms: dict[str, Json]
) -> None:
    stage = {**forms["trust"], "form": {**forms["trust"]["form"], "forced": True}}
    with form_page(browser, address, stage, "desktop") as (page, sent):
        assert page.is_disabled("#sheet button.main")
        for choices in page.locator("#sheet .choices").all():
            choices.locator("input").first.click()
        page.click("#sheet button.main")
        until(lambda: sent)
        assert sent[0]["answers"] == [1, 1]


@pytest.fixture(scope="module")
def trial(tmp_path_factory: pytest.TempPathFactory) -> RecordedSession:
    """A session as a user's page is shown it in a trial."""
    session = record_session(tmp_path_factory.mktemp("trial"), 3.0)
    users = [
        {"site": site, "who": who, "state": "done"}
        for site, who in (("m1", "P1"), ("m2", "P2"))
    ]
    shown = {"phase": "trial", "title": "A trial", "told": {}, "key": "trial 1", "users": users}
    place = {"trial": 1, "trials": 2, "block": 1, "blocks": 1, "practice": False}
    at = session.frames["user"][-1]["sites"]["s"]["points"][-1]
    target = {"site": "s", "at": [at[0] - 0.2, at[1]], "width_m": 0.1}
    task = {"task": "Bring the end effector of s into the circle.", "target": target}
    stage = {**shown, **place, **task, "left_s": 9.0, "appeared": True, "who": "P1"}
    for role in ("user", "experimenter"):
        own = {"done": True, "second": False} if role == "user" else {"condition": "far"}
        session.hellos[role]["stage"] = {**stage, **own}
        for frame in session.frames[role]:
            frame["stage"] = {**stage, **own}
    return session


AREAS = """Object.fromEntries(trilat.parts.arms.cards.map(({ name, card }) => {
const { width, height, bottom } = card.getBoundingClientRect();
return [name, [width * height, bottom]]; }))"""


@pytest.mark.parametrize("role", ["user", "experimenter"])
@pytest.mark.parametrize("screen", SCREENS)
def test_the_task_has_the_largest_panel(
    trial: RecordedSession, address: str, browser: Browser, screen: str, role: str
) -> None:
    with trial.shown(browser, address, role, screen, "light") as page:
        panels = page.evaluate(AREAS)
        task, _ = panels.pop("s")
        assert task >= 1.5 * max(area for area, _ in panels.values())
        if role == "user":  # the own arm is within reach, above STOP
            stop = page.locator("#stop").bounding_box()
            assert stop is not None
            assert screen == "desktop" or panels["m1"][1] <= stop["y"] + 4.0
