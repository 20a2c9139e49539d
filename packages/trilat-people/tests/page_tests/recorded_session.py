"""What a page's server would send of a session of `play`, and browsers that are sent it."""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, WebSocketRoute
from trilat_people.live_page.experiment_stage import Stage
from trilat_people.live_page.session_frames import SessionFrames, render_event
from trilat_people.live_page.session_view import SessionView

from tests.live.page_client import with_query
from tests.net.waiting import until
from tests.page.whole_pages import WatchedPage, watched_page
from tests.sites.relay import RelayClock
from tests.sites.sessions import SESSION, Session
from trilat_net.app.running_session import open_hand
from trilat_net.net.bus import Bus
from trilat_net.scenario import Scenario, load_scenario

SCREENS: dict[str, dict[str, Any]] = {
    "desktop": {"viewport": {"width": 1440, "height": 900}},
    "phone": {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True},
}
ROLES = ("experimenter", "user", "watcher")
_ABOUT_PAGES = {
    "notices": [],
    "ages": True,
    "pages": 1,
    "asks": False,
    "asked": [],
    "holds": [],
    "refused": 0,
    "results": [],
}
_PAGES = {"user": 1, "experimenter": 8, "watcher": 9}
"""Number of the page of each role."""
Json = dict[str, Any]


@dataclass
class RecordedSession:
    """Hellos and frames of every role.

    Attributes:
        user: site of the user's page.
        cut: true: pages get nothing more.
        sent: what pages have sent besides that they have drawn a frame.
        last: the frame that a page gets again and again; a test may change it.
    """

    user: str = "m1"
    hellos: dict[str, Json] = field(default_factory=dict)
    frames: dict[str, list[Json]] = field(default_factory=lambda: {role: [] for role in ROLES})
    cut: bool = False
    sent: list[Json] = field(default_factory=list)
    last: Json = field(default_factory=dict)

    @contextmanager
    def shown(
        self, browser: Browser, address: str, role: str, screen: str, scheme: str, **last: Any
    ) -> Iterator[Page]:
        """A page that has drawn all frames, and gets the last one again until the session is cut off.

        Args:
            last: what the last frame has besides.
        """
        with self.watched(browser, address, role, screen, scheme, **last) as watched:
            yield watched.page

    @contextmanager
    def watched(
        self, browser: Browser, address: str, role: str, screen: str, scheme: str, **last: Any
    ) -> Iterator[WatchedPage]:
        """The same page with the means to check it; at its end it has had no error."""
        *before, end = self.frames[role]
        self.last = {**end, **last, "points": [], "energies": [], "events": []}
        frames = chain(before, repeat(self.last))
        self.sent.clear()

        def send(route: WebSocketRoute) -> None:
            def answer(message: Any) -> None:
                if json.loads(message)["do"] != "seen":
                    self.sent.append(json.loads(message))
                elif not self.cut:
                    route.send(json.dumps(next(frames)))

            route.on_message(answer)
            route.send(json.dumps({"hello": self.hellos[role]}))

        query = {"experimenter": "", "user": f"as={self.user}", "watcher": "watch"}[role]
        with watched_page(browser, color_scheme=scheme, **SCREENS[screen]) as watched:
            page = watched.page
            page.route_web_socket("**/socket*", send)
            page.goto(with_query(address, query))
            newest = self.frames[role][-1]["n"]
            until(lambda: page.evaluate("window.trilat?.frame?.n") == newest, 60.0)
            page.evaluate(
                "new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve, 250)))"
            )
            yield watched


def record_session(folder: Path, duration_s: float = 4.0) -> RecordedSession:
    """Returns a session at 300 ms in which somebody leads m1."""
    scenario = load_scenario(
        "play", {"duration_s": duration_s, "rate_hz": 200, "link.delay_ms": 300}
    )
    return record_views(Session.whole(scenario, folder), "m1", leads=True)


def record_views(
    session: Session, user: str, *, leads: bool = False, stage: Stage | None = None
) -> RecordedSession:
    """Runs a session and returns what pages of every role would be sent of it.

    Args:
        session: the session, with its sites and its recorder.
        user: site of the user's page.
        leads: true: somebody leads that site's arm by a live hand.
        stage: of an experiment, of which the session is a trial.
    """
    found = RecordedSession(user)
    scenario = session.scenario
    session.stranger(partial(_record, found, scenario, leads=leads, stage=stage))
    session.play()
    return found


def _record(
    found: RecordedSession,
    scenario: Scenario,
    bus: Bus,
    clock: RelayClock,
    *,
    leads: bool,
    stage: Stage | None,
) -> None:
    view = SessionView(bus, clock, SESSION)
    pages = SessionFrames(view)
    hand = open_hand(bus, clock, SESSION, found.user, scenario, "Ada") if leads else None
    points = energies = events = n = 0
    while not view.ended:
        view.poll()
        frame = pages.make_frame()
        if stage is not None:
            stage.poll(view, [(site, n) for n, site in enumerate(stage.users, 1)])
        if frame is not None and 1.0 < frame["t"] < scenario.duration_s - 0.2:
            n += 1
            turn = 2.0 * frame["t"]
            if hand is not None:
                hand.move(1.0 + 0.15 * math.sin(turn), 0.6 + 0.25 * math.cos(turn))
            added = {
                "points": pages.points.since(points, 10_000),
                "energies": pages.energies.since(energies, 10_000),
                "events": [render_event(event) for event in view.events.since(events, 100)],
            }
            points, energies, events = (
                pages.points.count,
                pages.energies.count,
                view.events.count,
            )
            every = {"n": n, **_ABOUT_PAGES}
            nothing: Json = {key: [] for key in added}
            known = pages.describe_as(frame, found.user, ages=True)
            found.frames["experimenter"].append({**every, **frame, **added, "takes_part": True})
            found.frames["watcher"].append({**every, **frame, **added, "takes_part": False})
            found.frames["user"].append({**every, **known, **nothing, "takes_part": True})
            about, narrow = pages.describe(), pages.describe_session_as_user()
            for role, of in (("experimenter", about), ("watcher", about), ("user", narrow)):
                site = found.user if role == "user" else ""
                who = {"role": role, "as": site, "ends": role == "experimenter"}
                staged: Json = {}
                if stage is not None:
                    staged = {"stage": stage.describe(role, site, _PAGES[role], frame["t"])}
                found.frames[role][-1].update(staged)
                found.hellos[role] = {**of, **who, **staged, "n": 0}
        clock.sleep_until(clock.monotonic_ns() + 33_333_333)
