"""The report of an experiment in a browser: pictures have colours, tables have cells."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser

import trilat_net
from tests.experiments import REACH, write_protocol
from tests.live.browsers import needs_browser
from tests.page.study_pages import assert_markdown_is_whole, assert_page_of_study_is_whole

pytestmark = needs_browser


@pytest.mark.long
@pytest.mark.parametrize("users", ['["m1"]', '["m1", "m2"]'], ids=["alone", "pairs"])
def test_report_of_an_experiment_is_whole(users: str, browser: Browser, tmp_path: Path) -> None:
    file = write_protocol(tmp_path, users, REACH)
    folder = trilat_net.run_experiment(file, tmp_path / "out", jobs=1).folder
    analysis = trilat_net.analyse_experiment(folder)
    pictures = sum(path.suffix == ".png" for path in analysis.paths)
    assert_markdown_is_whole(browser, folder / "analysis" / "report.md", pictures)
    assert_page_of_study_is_whole(browser, folder, analysis._repr_html_(), pictures=0, tables=1)
