"""A page when arms are stopped, sites are silent and a session has ended: what each role reads and may do."""

from typing import Any

import pytest
from playwright.sync_api import Browser
from trilat_people.live_page.page_server import PageServer

from tests.live.browsers import needs_browser
from tests.live.page_client import with_query
from tests.net.local_bus import LocalNetwork
from tests.net.waiting import until
from trilat_net.core.step.ticks import LifeAlarm, LifeReason
from trilat_net.net.clock import SystemClock

from .recorded_session import ROLES, SCREENS, RecordedSession, record_session

pytestmark = [needs_browser, pytest.mark.long]

Json = dict[str, Any]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> RecordedSession:
    return record_session(tmp_path_factory.mktemp("session"), 3.0)


ALARMS = {
    "stopped": LifeReason.STOP,
    "fault": LifeReason.LIMIT_Q,
    "hold": LifeReason.PEER_SILENT,
    "waiting": LifeReason.ALIGN_LIMIT,
}
"""Modes that a page raises, each with a reason."""


def alarmed(session: RecordedSession, role: str, mode: str) -> Json:
    """The sites of the newest frame of a role, each that it knows about in a mode with its alarm."""
    alarm = LifeAlarm.find("t", "s", mode, [0.0] * 5 + [float(ALARMS[mode])], 2)
    assert alarm is not None
    advice = alarm.before if alarm.order else alarm.advice
    shown = {"word": alarm.word, "reason": alarm.reason, "advice": advice, "order": alarm.order}
    sites = session.frames[role][-1]["sites"]
    return {
        name: {**site, "mode": mode, "alarm": shown} if "mode" in site else site
        for name, site in sites.items()
    }


@pytest.mark.parametrize("screen", SCREENS)
@pytest.mark.parametrize(("mode", "order"), [("stopped", "enable"), ("fault", "reset")])
def test_experimenter_releases_arms_by_a_button(
    session: RecordedSession, address: str, browser: Browser, mode: str, order: str, screen: str
) -> None:
    sites = alarmed(session, "experimenter", mode)
    with session.shown(browser, address, "experimenter", screen, "light", sites=sites) as page:
        page.click("#alarms button")
        until(lambda: session.sent)
        assert session.sent == [{"do": "release", "order": order, "sites": ["m1", "m2", "s"]}]


def test_experimenter_who_watches_takes_part_first(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    sites = alarmed(session, "experimenter", "stopped")
    shown = session.shown(
        browser, address, "experimenter", "phone", "light", sites=sites, takes_part=False
    )
    with shown as page:
        until(lambda: page.inner_text("#alarms button") == "Take part")
        page.click("#alarms button")
        until(lambda: session.sent == [{"do": "control", "want": True}])
        session.last["takes_part"] = True
        until(lambda: page.inner_text("#alarms button") == "Enable")


@pytest.mark.parametrize("role", ["user", "watcher"])
@pytest.mark.parametrize("screen", SCREENS)
@pytest.mark.parametrize("mode", ALARMS)
def test_users_and_watchers_cannot_release(
    session: RecordedSession, address: str, browser: Browser, mode: str, screen: str, role: str
) -> None:
    sites = alarmed(session, role, mode)
    with session.shown(browser, address, role, screen, "light", sites=sites) as page:
        until(lambda: page.locator("#alarms .raised").count() == 1)
        assert page.locator("#alarms button").count() == 0
        assert "trilat " not in page.inner_text("body").replace("trilat live", "")


@pytest.mark.parametrize("role", ROLES)
def test_only_cut_off_experimenters_read_a_command(browser: Browser, role: str) -> None:
    """Their page can stop no arm any more; others tell the experimenter."""
    context = browser.new_context()
    try:
        page = context.new_page()
        with PageServer(LocalNetwork().join(), SystemClock(), "s1") as server:
            query = {"experimenter": "", "user": "as=m1", "watcher": "watch"}[role]
            page.goto(with_query(server.address, query))
            until(lambda: page.evaluate("Boolean(window.trilat?.hello)"), 30.0)
            assert "trilat " not in page.inner_text("body").replace("trilat live", "")
        until(lambda: "cut off" in page.inner_text("#todo"), 30.0)
        commands = "trilat stop --session s1" in page.inner_text("#todo")
        assert commands == (role == "experimenter")
        assert commands or "tell the experimenter" in page.inner_text("#todo")
    finally:
        context.close()


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("screen", SCREENS)
def test_silence_is_waited_for(
    session: RecordedSession, address: str, browser: Browser, screen: str, role: str
) -> None:
    with session.shown(browser, address, role, screen, "light", silent_s=17.4) as page:
        until(lambda: page.inner_text("#state") == "silent for 17 s, waiting")
        until(lambda: page.inner_text("#todo").startswith("No site has been heard for 17 s"))
        assert "ended" not in page.inner_text("body")
        assert page.is_enabled("#stop")
        session.last["silent_s"] = 0.0
        until(lambda: page.inner_text("#state") == "running")
        until(lambda: "No site" not in page.inner_text("#todo"))


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("screen", SCREENS)
def test_after_the_end_nothing_is_red(
    session: RecordedSession, address: str, browser: Browser, screen: str, role: str
) -> None:
    """Whatever the last records say: sites hold for their peers, which ended a moment before them."""
    held = alarmed(session, role, "hold")
    sites = {
        name: {**site, "ended": True, "clamped": True, "silent_s": 0.0}
        if "mode" in site
        else site
        for name, site in held.items()
    }
    with session.shown(
        browser, address, role, screen, "light", sites=sites, ended=True
    ) as page:
        until(lambda: page.inner_text("#state") == "ended")
        until(lambda: page.locator(".arm .chip").all_inner_texts() == ["ended"] * 3)
        assert page.locator(".chip.bad:visible, .arm.alarm, .raised").count() == 0
        assert "SILENT" not in page.inner_text("body")
        assert not page.is_visible("#stop")
        assert page.is_disabled("#stop")
        assert not page.is_visible("#end")
        page.keyboard.press("Escape")
        assert session.sent == []


def test_silent_sites_show_their_silences_length(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    newest = session.frames["experimenter"][-1]["sites"]
    sites = {**newest, "m2": {**newest["m2"], "silent_s": 4.2}}
    with session.shown(
        browser, address, "experimenter", "desktop", "light", sites=sites
    ) as page:
        until(lambda: page.inner_text("#state") == "m2 silent")
        assert "SILENT 4 s" in page.locator(".arm").nth(1).inner_text()


def test_orders_are_listed_as_sentences(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    text = "m2 was stopped by the experimenter at 58.2 s"
    event = {"t": 58.2, "member": "m2", "kind": "change", "text": text}
    with session.shown(browser, address, "experimenter", "desktop", "light") as page:
        session.last["events"] = [event]
        until(lambda: text in page.inner_text("#event-list"))
