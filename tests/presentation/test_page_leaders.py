"""The leaders of the slave on the first screen of a report."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser

from tests.analysis.builders import make_busy_run, make_run, make_short_log
from tests.live.browsers import needs_browser
from tests.page.whole_pages import watched_page
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.dominance_history import DominanceHistory
from trilat_net.log.findings import CheckReport
from trilat_net.log.log_reader import Log
from trilat_net.presentation.charts import ChartBuilder
from trilat_net.presentation.page import write_report
from trilat_net.presentation.page_charts import render_overview
from trilat_net.presentation.page_leaders import SlaveLead

SHORT = {"rate_hz": 100, "duration_s": 14.0, "expect": {}}


def simulate_training(**settings: Any) -> Log:
    """The shipped scenario in which the lead passes from m1 to m2, from 10 to 12 s."""
    return make_run("training", {**SHORT, **settings}).log


def test_the_bar_is_the_dominance_at_every_tick() -> None:
    log = simulate_training()
    (lead,) = SlaveLead.list_of_log(log)
    t_s = log["s"].t_s
    alpha = DominanceHistory.of_log(log, "s", t_s).alpha
    for column, peer in enumerate(lead.peers):
        drawn = np.interp(t_s, lead.t_s, lead.shares[:, column])
        recorded = alpha[:, log.scenario.peers("s").index(peer)]
        assert drawn == pytest.approx(recorded, abs=1e-9)
    assert lead.describe_phases() == "0 to 10 s: m1 90 %, m2 10 %; from 12 s: m1 10 %, m2 90 %"


def test_a_sudden_change_is_a_step() -> None:
    step = {"at_s": 5.0, "dominance": "s", "to": {"m1": 0.2, "m2": 0.8}}
    (lead,) = SlaveLead.list_of_log(simulate_training(timeline=[step]))
    for at_s, share in ((4.999, 0.9), (5.0, 0.2), (9.0, 0.2)):
        assert np.interp(at_s, lead.t_s, lead.shares[:, 0]) == pytest.approx(share)


def test_constant_dominance_is_a_sentence() -> None:
    log = simulate_training(timeline=[])
    (lead,) = SlaveLead.list_of_log(log)
    sentence = "m1 leads the slave with 90 % and m2 with 10 %, during the whole run."
    assert lead.describe_constant(log.scenario) == sentence
    builder = ChartBuilder(log, None)
    data = builder.build().data
    assert data.leads == []
    overview = render_overview(log, builder, data.charts)
    assert sentence in overview
    assert 'class="lead"' not in overview


def test_one_master_leads_alone() -> None:
    log = make_run("two_sites", {"rate_hz": 100, "duration_s": 1.0, "expect": {}}).log
    (lead,) = SlaveLead.list_of_log(log)
    sentence = "m alone leads the slave, during the whole run."
    assert lead.describe_constant(log.scenario) == sentence


@pytest.mark.parametrize("name", ["four", "busy"])
def test_every_following_slave_is_shown(name: str) -> None:
    log = make_busy_run().log if name == "busy" else make_short_log(name)
    followers = {
        site
        for site, spec in log.scenario.sites.items()
        if spec.role == "slave" and any(log.scenario.dominance[site].values())
    }
    assert {lead.slave for lead in SlaveLead.list_of_log(log)} == followers
    for lead in SlaveLead.list_of_log(log):
        assert lead.shares.sum(axis=1) == pytest.approx(1.0)


def test_page_data_has_the_captions_and_the_bars() -> None:
    data = json.loads(
        json.dumps(ChartBuilder(simulate_training(), None).build().data.to_builtins())
    )
    captions = [arm["caption"] for arm in data["arms"]]
    assert captions == ["m1, master 1", "m2, master 2", "s, slave"]
    (bar,) = data["leads"]
    assert bar["peers"] == ["m1", "m2"]
    assert bar["t"][-1] == pytest.approx(14.0)


@needs_browser
@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
def test_the_bar_stands_below_the_slider(
    size: tuple[int, int], browser: Browser, tmp_path: Path
) -> None:
    log = simulate_training()
    path, _ = write_report(
        log,
        tmp_path,
        certificate=Certificate.of_log(log),
        wait_for_checks=lambda: CheckReport([]),
    )
    options: dict[str, Any] = {
        "viewport": {"width": size[0], "height": size[1]},
        "reduced_motion": "reduce",
    }
    with watched_page(browser, **options) as watched:
        page = watched.page
        page.goto(path.as_uri())
        slider = page.locator("#arms input").bounding_box()
        bar = page.locator(".lead svg").bounding_box()
        assert slider is not None
        assert bar is not None
        assert bar["y"] + bar["height"] <= size[1]
        assert bar["x"] == pytest.approx(slider["x"] + 8.0, abs=1.0)
        assert bar["width"] == pytest.approx(slider["width"] - 16.0, abs=1.0)
        for share, bar_text in ((0, "m1 90 %, m2 10 %"), (1000, "m1 10 %, m2 90 %")):
            page.locator("#arms input").fill(str(share))
            assert page.inner_text(".lead output") == bar_text
        page.locator("#arms input").fill(str(round(1000 * 11.0 / 14.0)))
        matches = re.findall(r"(\d+) %", page.inner_text(".lead output"))
        assert [int(number) for number in matches] == [50, 50]
        watched.assert_whole()
