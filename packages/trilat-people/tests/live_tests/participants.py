"""People on the pages of an experiment, by Playwright's pointers: they agree, answer, and reach."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

from tests.live.browsers import launch_browser, role_address
from tests.live.processes import Process, Stage
from trilat_net.net.clock import SystemClock

PROTOCOL = """
name = "short"
scenario = "paper"
users = ["m1", "m2"]
participants = 2
design = "fixed"
trials = {trials}
foreperiod_s = [0.4, 0.6]
feedback = ["completion_s", "error_end_mm"]
{more}
[set]
rate_hz = 250
control = {{ law = "p_d", K = 100.0, d = 40.0 }}
sites.m1.q0_rad = [-0.6, 1.2]
sites.m1.hands = [{{ kind = "live", stiffness_n_m = 1000.0, damping_n_s_m = 100.0 }}]
sites.m2.q0_rad = [-0.6, 1.2]
sites.m2.hands = [{{ kind = "live", stiffness_n_m = 1000.0, damping_n_s_m = 100.0 }}]
sites.s = {{ role = "slave", q0_rad = [-0.6, 1.2]{walls} }}
on_stale = {{ action = "glide", silence_ms = 100.0 }}
dominance.m1 = {{ m2 = 0.2, s = 0.8 }}
dominance.m2 = {{ m1 = 0.2, s = 0.8 }}
dominance.s = {{ m1 = 0.6, m2 = 0.4 }}
[conditions.near]
"link.delay_ms" = 0
{conditions}
[task]
{task}
"""
REACH = """kind = "reach"
targets = 4
distance_m = 0.3
width_m = 0.2
dwell_s = 0.2
timeout_s = 20.0
"""
WALL = """, environment = [
{ kind = "wall", point_m = [1.69, 0.0], normal = [-1.0, 0.0], stiffness_n_m = 1000.0 }]"""
FAR = '[conditions.far]\n"link.delay_ms" = 100\n'

LOOK = """([site, beyond_m]) => {
  const shown = (trilat.frame?.stage && trilat.hello.running ? trilat.frame : trilat.hello)?.stage || {};
  const arms = trilat.parts?.arms, frame = trilat.frame;
  const found = { ...shown, running: shown.left_s !== undefined };
  if (!found.running || !arms || !frame) return found;
  const own = arms.byName[site], tip = frame.sites[site].points.at(-1);
  const box = own.canvas.getBoundingClientRect();
  if (!own.project) return found;
  const aim = shown.target.at.map((x, n) => x + (n ? 0 : beyond_m));
  const ratio = own.canvas.width / box.width;
  const px = (at) => { const [x, y] = own.project(at); return [box.left + x / ratio, box.top + y / ratio]; };
  return { ...found, tip: px(tip), aim: px(aim), held: Boolean(own.hold), graspable: own.graspable };
}"""


def write_live_protocol(
    folder: Path, trials: int, more: str = "", conditions: str = "", task: str = REACH
) -> Path:
    """Writes the protocol of one pair that reaches live; `more` stands before the scenario's keys."""
    file = folder / "short.toml"
    walls = WALL if "contact" in task else ""
    text = PROTOCOL.format(
        trials=trials, more=more, conditions=conditions, task=task, walls=walls
    )
    file.write_text(text, encoding="utf-8")
    return file


class Participant:
    """One user on a page.

    Attributes:
        feedback: The texts that the page showed after each trial, in order, by measure.
        beyond_m: The distance along x by which the user passes the target, as into a wall, in m.
    """

    beyond_m = 0.0

    def __init__(self, page: Page, site: str) -> None:
        self.page = page
        self.site = site
        self.feedback: list[dict[str, str]] = []
        self.reached: set[str] = set()
        self._done: tuple[str, str] | None = None

    def look(self) -> dict[str, Any]:
        """Returns what the page shows of the stage, and where its arm and target are."""
        stage: dict[str, Any] = self.page.evaluate(LOOK, [self.site, self.beyond_m])
        return stage

    def act(self) -> dict[str, Any]:
        """Does the next thing that the page asks for, and returns what the page shows."""
        stage = self.look()
        if stage.get("running"):
            self._reach(stage)
        else:
            self._done = None
            self._read_feedback()
            if stage.get("key") and not stage.get("done") and not stage.get("second"):
                self._reply(stage)
        return stage

    def _read_feedback(self) -> None:
        feedback = self.page.evaluate(
            """() => { const said = [...document.querySelectorAll('#sheet dd[data-measure]')];
            const rows = said.map((dd) => [dd.dataset.measure, dd.textContent]);
            return rows.length ? Object.fromEntries(rows) : null; }"""
        )
        if feedback is not None and (not self.feedback or self.feedback[-1] != feedback):
            self.feedback.append(feedback)

    def _reply(self, shown: dict[str, Any]) -> None:
        self.page.evaluate(
            """() => { for (const scale of document.querySelectorAll('#sheet .choices'))
            [...scale.querySelectorAll('input')].at(-2).click();
            for (const slider of document.querySelectorAll('#sheet .unset'))
            { slider.value = 40; slider.click(); } }"""
        )
        if shown["phase"] in ("consent", "trial", "questionnaire"):
            self.page.evaluate(
                "document.querySelector('#sheet button.main:not([disabled])')?.click()"
            )

    def _reach(self, shown: dict[str, Any]) -> None:
        if "tip" not in shown or not shown.get("graspable"):
            return
        mouse = self.page.mouse
        if not shown["held"]:
            mouse.up()
            mouse.move(*shown["tip"])
            mouse.down()
        elif shown["appeared"]:
            mouse.move(*shown["aim"])


def join(browser: Browser, running: Process, site: str) -> Participant:
    """Opens the page of a user in a context of its own; small, so that drawing costs little."""
    page = browser.new_context(viewport={"width": 640, "height": 480}).new_page()
    page.goto(role_address(running, f"user {site}"))
    return Participant(page, site)


@contextmanager
def participants(
    running: Process, sites: Sequence[str] = ("m1", "m2")
) -> Iterator[list[Participant]]:
    """Opens a browser with a page for each user; no page may have an error."""
    with sync_playwright() as playwright:
        browser = launch_browser(playwright)
        try:
            people = [join(browser, running, site) for site in sites]
            problems: list[str] = []
            for person in people:
                person.page.on("pageerror", lambda error: problems.append(str(error)))
            yield people
            assert problems == []
        finally:
            browser.close()


def take_part(
    people: Sequence[Participant], until: Callable[[], object], timeout_s: float = 120.0
) -> None:
    """Lets all participants act in turn until a condition holds."""
    clock = SystemClock()
    give_up_ns = clock.monotonic_ns() + int(timeout_s * 1e9)
    while not until():
        assert clock.monotonic_ns() < give_up_ns, [person.look() for person in people]
        for person in people:
            person.act()


def begin(stage: Stage, file: Path | str, *options: str, name: str = "experiment") -> Process:
    return stage.start(name, "experiment", "run", str(file), "--live", "--no-browser", *options)
