"""Records the messages of a page server about a session, and replays them to browsers."""

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
from trilat_people.live_page.session_frames import SessionFrames
from trilat_people.live_page.session_view import SessionView

from tests.live.page_client import with_query
from tests.net.waiting import until
from tests.page.whole_pages import WatchedPage, watched_page
from tests.sites.relay import RelayClock
from tests.sites.sessions import SESSION, Session
from trilat_net.app.running_session import RunningSession
from trilat_net.net.bus import Bus
from trilat_net.net.connection import Connection
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
    """First messages and frames of a session for the page of every role.

    Attributes:
        user: Site of the user's page.
        hellos: First message to the page of each role.
        frames: Frames for the page of each role.
        cut: True to send no further frame to a page.
        sent: Messages of the pages, without those that acknowledge a frame.
        last: Last frame, which a page receives repeatedly. A test may change it.
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
        """Opens a page that has drawn all frames, and receives the last one until `cut` is set.

        Args:
            browser: The browser.
            address: Address of the page.
            role: Role of the page, one of `ROLES`.
            screen: Size of the screen, a key of `SCREENS`.
            scheme: Colour scheme, "light" or "dark".
            **last: Fields of the last frame that differ from the recorded ones.
        """
        with self.watched(browser, address, role, screen, scheme, **last) as watched:
            yield watched.page

    @contextmanager
    def watched(
        self, browser: Browser, address: str, role: str, screen: str, scheme: str, **last: Any
    ) -> Iterator[WatchedPage]:
        """Opens the same page as `shown`, and checks that the page reports no error until its end."""
        *first_frames, last_frame = self.frames[role]
        self.last = {**last_frame, **last, "points": [], "energies": [], "events": []}
        frames = chain(first_frames, repeat(self.last))
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
    """Runs a session with delays of 300 ms, in which an operator moves m1."""
    scenario = load_scenario(
        "play", {"duration_s": duration_s, "rate_hz": 200, "link.delay_ms": 300}
    )
    return record_views(Session.whole(scenario, folder), "m1", leads=True)


def record_views(
    session: Session, user: str, *, leads: bool = False, stage: Stage | None = None
) -> RecordedSession:
    """Runs a session, and records the messages to the pages of every role.

    Args:
        session: The session, with its sites and its recorder.
        user: Site of the user's page.
        leads: True if an operator moves the arm of that site by a live hand.
        stage: Stage of the experiment, of which the session is a trial. None for no experiment.
    """
    recorded = RecordedSession(user)
    scenario = session.scenario
    session.stranger(partial(_record, recorded, scenario, leads=leads, stage=stage))
    session.play()
    return recorded


def _record(
    recorded: RecordedSession,
    scenario: Scenario,
    bus: Bus,
    clock: RelayClock,
    *,
    leads: bool,
    stage: Stage | None,
) -> None:
    view = SessionView(bus, clock, SESSION)
    pages = SessionFrames(view)
    running = RunningSession(SESSION, Connection(), bus, clock)
    hand = running.open_hand(bus, recorded.user, scenario, "Ada") if leads else None
    point_count = 0
    energy_count = 0
    event_count = 0
    frame_number = 0
    while not view.ended:
        view.poll()
        frame = pages.make_frame()
        if stage is not None:
            stage.poll(view, [(site, number) for number, site in enumerate(stage.users, 1)])
        if frame is not None and 1.0 < frame["t"] < scenario.duration_s - 0.2:
            frame_number += 1
            angle_rad = 2.0 * frame["t"]
            if hand is not None:
                hand.move(1.0 + 0.15 * math.sin(angle_rad), 0.6 + 0.25 * math.cos(angle_rad))
            added = {
                "points": pages.points.since(point_count, 10_000),
                "energies": pages.energies.since(energy_count, 10_000),
                "events": pages.list_events(event_count, 100),
            }
            point_count = pages.points.count
            energy_count = pages.energies.count
            event_count = view.events.count
            common = {"n": frame_number, **_ABOUT_PAGES}
            nothing_added: Json = {key: [] for key in added}
            user_frame = pages.describe_as(frame, recorded.user, ages=True)
            recorded.frames["experimenter"].append(
                {**common, **frame, **added, "takes_part": True}
            )
            recorded.frames["watcher"].append({**common, **frame, **added, "takes_part": False})
            recorded.frames["user"].append(
                {**common, **user_frame, **nothing_added, "takes_part": True}
            )
            description = pages.describe()
            descriptions = {
                "experimenter": description,
                "watcher": description,
                "user": pages.describe_session_as_user(),
            }
            for role, role_description in descriptions.items():
                site = recorded.user if role == "user" else ""
                page_role = {"role": role, "as": site, "ends": role == "experimenter"}
                staged: Json = {}
                if stage is not None:
                    staged = {"stage": stage.describe(role, site, _PAGES[role], frame["t"])}
                recorded.frames[role][-1].update(staged)
                recorded.hellos[role] = {**role_description, **page_role, **staged, "n": 0}
        clock.sleep_until(clock.monotonic_ns() + 33_333_333)
