"""Every view of the live page with data of every kind: no error, no empty frame, every line drawn."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
from people_builders import PAIR, make_experiment_trial, replace_text
from playwright.sync_api import Browser, Page
from trilat_people.experiment.experiment_run import Experiment
from trilat_people.experiment.trial_run import SyntheticTrial
from trilat_people.live_page.experiment_stage import Stage, TrialWatch
from trilat_people.live_page.page_server import PageServer

from tests.analysis.builders import BUSY, FOUR
from tests.experiments import APART, REACH, write_protocol
from tests.live.browsers import needs_browser, wait_until_page
from tests.live.page_client import with_query
from tests.net.local_bus import LocalNetwork
from tests.net.manual_clock import ManualClock
from tests.page.whole_pages import watched_page
from tests.scenario.builders import planar_task_text, posed_task_text, six_joint_text
from tests.sites.sessions import Session, make_gliding_scenario, reach_session
from trilat_net.net.bus import Bus
from trilat_net.net.clock import Clock, SystemClock
from trilat_net.scenario import Scenario, load_scenario, parse_scenario
from trilat_net.scenario.delay_models import DELAY_MODELS

from .recorded_session import ROLES, RecordedSession, record_session, record_views

pytestmark = needs_browser

Json = dict[str, Any]
Views = Callable[[Path], RecordedSession]
OF_A_HAND = ("grip", "source", "target", "hand_limited")
"""Fields of a site whose scenario has a live hand."""
OF_LINKS = {name for model in DELAY_MODELS.values() for name in model.__struct_fields__}


def list_optional_fields(session: RecordedSession, role: str) -> list[str]:
    """Returns patterns of the fields that a page may read although its frames lack them.

    A message is a hello or a frame. A stage belongs to an experiment. A link has the fields of its
    model. A user's page gets all fields of its own site, and of the other sites what the user is
    shown of them.
    """
    user_fields = {"age_ms", *OF_A_HAND, *session.frames[role][-1]["sites"][session.user]}
    links = [f"links.*.stated.{name}" for name in OF_LINKS]
    return [
        "hello",
        "hello.stage",
        "stage",
        *(f"sites.*.{name}" for name in user_fields),
        *links,
    ]


def give_orders(orders: Mapping[float, str], bus: Bus, clock: Clock) -> None:
    """Sends orders to the slave of a running session, at times after its start, in s."""
    begun_ns = clock.monotonic_ns()
    for at_s, order in orders.items():
        clock.sleep_until(begun_ns + int(at_s * 1e9))
        reach_session(bus, clock).send_order(["s"], order)


def record(scenario: Scenario, user: str, orders: Mapping[float, str] = {}) -> Views:
    """Returns what records the views of a session, in which the slave may be given orders."""

    def run(folder: Path) -> RecordedSession:
        session = Session.whole(scenario, folder, ends={})
        if orders:
            session.stranger(lambda bus, clock: give_orders(orders, bus, clock))
        return record_views(session, user)

    return run


def parse_at_200_hz(text: str, **overrides: Any) -> Scenario:
    """Returns the scenario of a text at 200 Hz."""
    return parse_scenario(text, overrides={"rate_hz": 200, **overrides})


CAROUSEL = {"class": "tests.own_code:Carousel", "bodies": {"box": [0.2, 0.2, 0.1]}}
MIXED = {
    "model": "gamma",
    "delay_ms": 120.0,
    "deviation_ms": 40.0,
    "loss": 0.2,
    "loss_burst": 4.0,
}
SESSIONS: dict[str, Views] = {
    "one leads": record_session,
    "two sites": record(load_scenario("two_sites", {"duration_s": 3.0, "link": MIXED}), "m"),
    "four sites": record(parse_scenario(FOUR, overrides={"duration_s": 3.0}), "a"),
    "links of many kinds": record(parse_scenario(BUSY, overrides={"duration_s": 5.0}), "b"),
    "no injected delay": record(
        load_scenario(
            "two_sites", {"duration_s": 3.0, "rate_hz": 200, "link": {"model": "measured"}}
        ),
        "m",
    ),
    "six joints": record(parse_at_200_hz(six_joint_text(3.0)), "m1"),
    "planar task": record(parse_at_200_hz(planar_task_text(3.0)), "m"),
    "posed task": record(parse_at_200_hz(posed_task_text(3.0)), "m2"),
    "carried bodies": record(
        load_scenario("paper", {"duration_s": 3.0, "rate_hz": 200, "sites.s.plant": CAROUSEL}),
        "m1",
    ),
    "wall": record(load_scenario("contact", {"duration_s": 3.0, "rate_hz": 200}), "m"),
    "stopped": record(make_gliding_scenario(5.0), "m", {2.5: "stop"}),
    "stopped and enabled": record(
        make_gliding_scenario(6.0), "m", {2.0: "stop", 3.5: "enable"}
    ),
    "fault": record(make_gliding_scenario(4.0, **{"sites.s.limits.qd_limit_rad_s": 0.1}), "m"),
    "diverged": record(
        load_scenario(
            "free", {"duration_s": 4.0, "rate_hz": 200, "limits.qd_limit_rad_s": 4.5}
        ),
        "m1",
    ),
}
PUSHED = ("one leads", "links of many kinds")
NAMES = [
    pytest.param(name, marks=() if name in PUSHED else pytest.mark.long) for name in SESSIONS
]


@pytest.fixture(scope="module")
def sessions(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], RecordedSession]:
    """Sessions by their name, each recorded once."""
    known: dict[str, RecordedSession] = {}

    def find(name: str) -> RecordedSession:
        if name not in known:
            known[name] = SESSIONS[name](tmp_path_factory.mktemp("session"))
        return known[name]

    return find


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("name", NAMES)
def test_view_draws_everything(
    name: str,
    role: str,
    sessions: Callable[[str], RecordedSession],
    browser: Browser,
    address: str,
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
    page.evaluate(
        "new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve, 250)))"
    )


def test_view_of_waiting_session_has_no_empty_frame(address: str, browser: Browser) -> None:
    for query in ("", "as=m1", "watch"):
        with watched_page(browser) as watched:
            watched.page.goto(with_query(address, query))
            wait_until_page(watched.page, "window.trilat?.hello?.running === false")
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
OF_A_STAGE = (
    "key", "users", "appeared", "second", "done", "left_s", "rest_s", "who", "number", "way",
    "told.succeeded", "form.ends.*",
)  # fmt: skip
"""Fields of a stage that depend on the phase, on the role and on what the protocol asks for."""
OF_STAGED_PAGES = [
    "hello",
    *(f"{place}.{name}" for place in ("stage", "hello.stage") for name in OF_A_STAGE),
]
PHASES = ("no step", "consent", "invitation", "rest", "success", "failure", "repetition", "starting",
          "checking", "sliders", "buttons", "over")  # fmt: skip


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Experiment:
    """An experiment of a pair with every kind of step."""
    folder = tmp_path_factory.mktemp("experiment")
    file = replace_text(write_protocol(folder, PAIR), "trials = 2\n", ASKS)
    return Experiment.begin(file, folder / "out")


def set_phase(
    stage: Stage, experiment: Experiment, phase: str, clock: Clock, folder: Path
) -> None:
    """Brings a stage to a phase."""
    plan = experiment.plan
    steps = {
        (step.kind, step.form.name if step.form else ""): step
        for step in reversed(list(plan.list_steps()))
    }
    trial = steps["trial", ""]
    if phase in ("success", "failure"):
        trial_of_models = SyntheticTrial(
            plan.protocol, plan.scenarios["near"], plan.trials[0], plan.digest
        )
        entry = trial_of_models.write(folder / "log.mcap")
        stage.show_feedback(msgspec.structs.replace(entry, succeeded=phase == "success"))
    if phase == "repetition":
        stage.show_feedback(None, "an arm was stopped")
    if phase == "starting":
        stage.request_step(trial)
        stage.show_trial(TrialWatch(make_experiment_trial(experiment, plan.trials[0]), clock))
    elif phase == "checking":
        stage.request_step(trial)
        stage.show_checking()
    elif phase == "over":
        stage.show_end()
    elif phase != "no step":
        step = {
            "consent": ("consent", ""),
            "sliders": ("questionnaire", "tlx"),
            "buttons": ("questionnaire", "trust"),
        }
        stage.request_step(
            steps[step.get(phase, ("trial", ""))], rest_s=30.0 if phase == "rest" else 0.0
        )


STAGED_VIEWS = {"participant": "as=m1", "experimenter": "", "watcher": "watch"}


@pytest.mark.parametrize(
    "phase",
    [
        pytest.param(phase, marks=() if phase == "sliders" else pytest.mark.long)
        for phase in PHASES
    ],
)
def test_stage_between_trials_has_no_empty_frame(
    phase: str, experiment: Experiment, browser: Browser, tmp_path: Path
) -> None:
    clock = SystemClock()
    stage = Stage(experiment.plan, clock)
    set_phase(stage, experiment, phase, clock, tmp_path)
    with PageServer(LocalNetwork().join(), clock, "idle", stage=stage) as server:
        for view, query in STAGED_VIEWS.items():
            with watched_page(browser) as watched:
                page = watched.page
                page.goto(with_query(server.address, query))
                wait_until_page(page, "Boolean(window.trilat?.hello?.stage)")
                watched.assert_whole(OF_STAGED_PAGES)
                assert page.is_visible("#sheet") == (view == "participant")
                if page.locator("#sheet button.main:enabled").count():
                    page.click("#sheet button.main")
                    watched.assert_whole(OF_STAGED_PAGES)


@pytest.mark.parametrize(
    "task",
    [
        "reach",
        pytest.param("apart", marks=pytest.mark.long),
        pytest.param("corridor", marks=pytest.mark.long),
    ],
)
def test_stage_in_a_trial_draws_everything(
    task: str, browser: Browser, address: str, tmp_path: Path
) -> None:
    text = {"reach": REACH, "apart": APART, "corridor": f"{REACH}\ncorridor_m = 0.03"}[task]
    experiment = Experiment.begin(write_protocol(tmp_path, PAIR, text), tmp_path / "out")
    clock = ManualClock(1)
    stage = Stage(experiment.plan, clock)
    stage.request_step(
        next(step for step in experiment.plan.list_steps() if step.kind == "trial")
    )
    trial = make_experiment_trial(experiment, experiment.plan.trials[0])
    stage.show_trial(TrialWatch(trial, clock))
    (tmp_path / "log").mkdir()
    session = record_views(
        Session.whole(trial.scenario, tmp_path / "log", ends={}), "m1", stage=stage
    )
    for role in ROLES:
        with session.watched(browser, address, role, "desktop", "light") as watched:
            optional = [*list_optional_fields(session, role), *OF_STAGED_PAGES]
            watched.assert_whole(optional)
            assert watched.page.is_visible("#stage")
            assert not watched.page.is_visible("#sheet")
