"""The page in a browser, for every role, by day and by night, at a desk and on a phone: what people can use."""

import pytest
from playwright.sync_api import Browser

from tests.live.browsers import needs_browser, tip_px
from tests.page.whole_pages import grave_findings

from .recorded_session import ROLES, SCREENS, RecordedSession, record_session

pytestmark = [needs_browser, pytest.mark.long]

SCHEMES = ("light", "dark")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> RecordedSession:
    return record_session(tmp_path_factory.mktemp("session"))


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("screen", SCREENS)
def test_axe_finds_nothing_serious(
    session: RecordedSession, address: str, browser: Browser, role: str, screen: str
) -> None:
    for scheme in SCHEMES:
        with session.shown(browser, address, role, screen, scheme) as page:
            assert grave_findings(page) == []
            page.click("#scene")
            assert grave_findings(page) == []


def raise_alarm(site: str, **changed: str) -> dict[str, str]:
    """What a page is told of an arm that was stopped."""
    assert site in ("m1", "m2", "s")
    return {
        "word": "STOPPED",
        "reason": "ordered to stop",
        "advice": "",
        "order": "enable",
        **changed,
    }


@pytest.mark.parametrize("screen", SCREENS)
def test_axe_finds_nothing_serious_in_alarms(
    session: RecordedSession, address: str, browser: Browser, screen: str
) -> None:
    """Alarms, what a page is asked, and the report at the end."""
    newest = session.frames["experimenter"][-1]
    sites = {
        name: {**site, "alarm": raise_alarm(name), "mode": "stopped"}
        for name, site in newest["sites"].items()
    }
    ended = {"ended": True, "results": ["/x/report.html", "/x/run.mcap"], "asked": [2]}
    for scheme in SCHEMES:
        with session.shown(
            browser, address, "experimenter", screen, scheme, sites=sites, asked=[2]
        ) as page:
            assert "m1, m2, s STOPPED" in page.inner_text("#alarms .raised")
            assert page.inner_text("#alarms button") == "Enable"
            assert page.inner_text("#state") == "m1, m2, s STOPPED"
            assert grave_findings(page) == []
        with session.shown(browser, address, "experimenter", screen, scheme, **ended) as page:
            assert page.locator("#todo a").count() == 2
            assert grave_findings(page) == []


def test_alarms_of_one_reason_are_raised_together(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    alarms = {
        "m1": raise_alarm("m1"),
        "m2": raise_alarm(
            "m2",
            word="HOLD",
            reason="s is silent",
            advice="it goes on once it is heard",
            order="",
        ),
        "s": raise_alarm("s"),
    }
    newest = session.frames["experimenter"][-1]["sites"]
    sites = {name: {**newest[name], "alarm": alarm} for name, alarm in alarms.items()}
    with session.shown(
        browser, address, "experimenter", "desktop", "light", sites=sites
    ) as page:
        raised = [one.inner_text().split("\n") for one in page.locator("#alarms .raised").all()]
        assert raised == [
            ["m1, s STOPPED", "ordered to stop", "Enable"],
            ["m2 HOLD", "s is silent", "it goes on once it is heard"],
        ]
        assert page.inner_text("#state") == "2 alarms"


def test_arms_have_half_of_the_window(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    for role in ROLES:
        with session.shown(browser, address, role, "desktop", "light") as page:
            box = page.locator("#arms").bounding_box()
            assert box is not None
            assert box["y"] + box["height"] <= 900
            assert box["width"] * box["height"] >= 0.5 * 1440 * 900


SMALL = """[...document.querySelectorAll("button, select, input, a")]
.map((one) => [one, one.getBoundingClientRect()])
.filter(([one, box]) => box.width && one.type !== "checkbox" && Math.min(box.width, box.height) < 43.9)
.map(([one, box]) => `${one.outerHTML.slice(0, 60)} ${box.width.toFixed(0)}x${box.height.toFixed(0)}`)"""


def test_phones_show_arms_first_with_large_targets(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    for role in ROLES:
        with session.shown(browser, address, role, "phone", "light") as page:
            arms, stop = (page.locator(part).bounding_box() for part in ("#arms", "#stop"))
            assert arms is not None
            assert stop is not None
            assert arms["y"] + arms["height"] <= stop["y"] + 4.0
            assert page.evaluate("document.documentElement.scrollWidth") <= 390
            assert page.evaluate(SMALL) == []


HELD = "trilat.parts.arms.cards.filter((card) => card.hold).map((card) => card.name)"


def test_keys_lead_an_arm_anywhere(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    with session.shown(browser, address, "experimenter", "desktop", "light") as page:
        page.click("#link-presets button:has-text('100 ms')")
        page.keyboard.press("2")
        page.keyboard.press(" ")
        assert page.evaluate("trilat.parts.arms.cards.map((card) => Boolean(card.hold))") == [
            False,
            True,
            False,
        ]
        page.keyboard.press(" ")
        page.focus("#mark-text")
        page.keyboard.type("m 2 m")
        assert page.input_value("#mark-text") == "m 2 m"
        assert page.evaluate(HELD) == []


def test_cut_off_pages_are_marked(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    """It calls no arm silent for its own lag, and its buttons are off."""
    with session.shown(browser, address, "experimenter", "desktop", "light") as page:
        session.cut = True
        try:
            page.wait_for_selector("body.late")
        finally:
            session.cut = False
        assert "s behind" in page.inner_text("#state")
        assert "s behind" in page.inner_text("#todo")
        assert "silent" not in page.inner_text("body").lower()
        assert page.is_disabled("#end")
        assert page.is_disabled("#link-delay")
        assert page.is_disabled("#part")


def test_pointers_select_the_nearest_arm_in_scene(
    session: RecordedSession, address: str, browser: Browser
) -> None:
    with session.shown(browser, address, "experimenter", "desktop", "light") as page:
        page.click("#scene")
        for n, name in enumerate(("m1", "m2", "s")):
            page.evaluate("trilat.parts.arms.draw(trilat.frame)")
            x, y = tip_px(page, n)
            page.mouse.move(x, y)
            page.mouse.down()
            held = page.evaluate(
                "trilat.parts.arms.cards.filter((card) => card.hold).map((card) => card.name)"
            )
            page.mouse.up()
            assert held == [name]
