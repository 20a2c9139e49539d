"""`trilat live` in a real browser: what the page shows is the session, and its button ends it in order."""

import signal
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from tests.net.waiting import until
from trilat_net.analysis.certificate.energy_balance import compute_energy_balance, compute_site_energies
from trilat_net.log.log_reader import Log, open_log

from .browsers import browser_page, needs_browser, page_address, shows
from .processes import Process, Stage

pytestmark = needs_browser


def live(stage: Stage, scenario: str, *options: str) -> Process:
    return stage.start("live", "live", scenario, "--no-browser", "--out", str(stage.folder / "out"), *options)


def assert_energies_are_those_of(log: Log, energies: list[list[float]]) -> None:
    """V on the page is that of `certify` at the same instants."""
    balance = compute_energy_balance(compute_site_energies(log))
    t_s, V, supplied = np.array(energies).T
    rows = np.searchsorted(balance.t_s, t_s - 1e-9)
    inside = rows < len(balance.t_s)
    assert inside.sum() > 40
    most = np.abs(balance.V).max()
    assert np.abs(V - balance.V[np.minimum(rows, len(balance.t_s) - 1)])[inside].max() <= 1e-9 * most
    gave = balance.external_work[np.minimum(rows, len(balance.t_s) - 1)]
    assert np.abs(supplied - gave)[inside].max() <= 1e-9 * most


def end_by_button(page: Page) -> None:
    page.on("dialog", lambda dialog: dialog.accept())
    page.click("#end")


def test_the_page_shows_the_session_changes_a_link_and_ends_it(stage: Stage) -> None:
    running = live(stage, "two_sites", "--duration", "60")
    with browser_page(page_address(running)) as page:
        shows(page, "trilat.frame && trilat.frame.t > 1 && trilat.takesPart")
        sites: dict[str, Any] = page.evaluate("trilat.frame.sites")
        assert set(sites) == {"m", "s"}
        assert page.locator(".arm").count() == 2
        page.click("#link-presets button:has-text('300 ms')")
        shows(page, "trilat.frame.links['m->s'].age_ms > 290 && trilat.frame.links['s->m'].age_ms > 290")
        shows(page, "trilat.energies.length > 60 && trilat.energies.at(-1)[0] > 2")
        energies = page.evaluate("trilat.energies")
        end_by_button(page)
        shows(page, "document.getElementById('state').textContent !== 'running'")
    assert running.code() == 0, running
    assert "ok   executed again" in running.text()
    log = open_log(stage.folder / "out" / "run.mcap")
    assert_energies_are_those_of(log, energies)
    changed = {event.text for event in log.events if event.kind == "change"}
    assert len(changed) == 2


@pytest.mark.long
@pytest.mark.parametrize("gl", [True, False], ids=["WebGL", "no WebGL"])
def test_three_arms_are_drawn_with_webgl_and_without(gl: bool, stage: Stage) -> None:
    running = live(stage, "paper", "--duration", "30")
    with browser_page(page_address(running) + "?webgl", gl=gl) as page:
        shows(page, "trilat.frame && trilat.frame.t > 2")
        until(lambda: page.inner_text("#painter").startswith("drawn with" if gl else "no WebGL"))
        for n in range(3):  # something of the arm's colour is drawn in every card
            assert (
                page.evaluate(
                    """(n) => { const c = document.querySelectorAll('.arm canvas')[n];
                const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
                let seen = 0; for (let k = 3; k < d.length; k += 4) seen += d[k] > 200; return seen; }""",
                    n,
                )
                > 500
            )
    running.signal(signal.SIGINT)
    assert running.code() == 0


@pytest.mark.long
def test_a_second_page_only_watches_until_it_asks(stage: Stage) -> None:
    running = live(stage, "two_sites", "--duration", "30")
    address = page_address(running)
    with browser_page(address) as first:
        shows(first, "trilat.frame && trilat.takesPart")
        second = first.context.new_page()
        second.goto(address)
        shows(second, "trilat.frame && trilat.frame.pages === 2")
        assert not second.evaluate("trilat.takesPart")
        assert second.is_disabled("#link-delay")
        second.click("#part")
        shows(second, "trilat.takesPart")
        shows(first, "trilat.takesPart")
    running.signal(signal.SIGINT)
    assert running.code() == 0
