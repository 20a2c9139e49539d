import base64
import json
import re
from html.parser import HTMLParser
from io import StringIO

import msgspec
import numpy as np
import pytest
from rich.console import Console

from tests.analysis.builders import (
    JITTER,
    make_busy_run,
    make_diverged_log,
    make_log_without_hands,
    make_run,
    make_short_log,
)
from tests.log.builders import add_clock_readings, rewrite_log
from trilat_net.analysis import site_signals
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.file_overview import summarise_run
from trilat_net.log.findings import CheckReport, Finding
from trilat_net.presentation.figures.registry import (
    FIGURES,
    list_drawable_figures,
    write_report_figures,
)
from trilat_net.presentation.page import render_report, write_report
from trilat_net.presentation.result_text import TextTable

VERDICTS = [
    Finding("records", "all <b>there</b>", True),
    Finding("executed again", "differs", False),
]


class Page(HTMLParser):
    """The page as a browser builds it: elements with attributes, and text by element."""

    def __init__(self, html):
        super().__init__()
        self.elements = []
        self.texts = {}
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.texts.setdefault(self.elements[-1][0] if self.elements else "", []).append(data)


def read_page(html):
    """Returns the page, and the data of its charts."""
    data = re.search(
        r'<script type="application/json" id="data">(.*?)</script>', html, re.DOTALL
    )[1]
    return html, json.loads(data)


def render_page(log, twin=None):
    return read_page(render_report(log, twin, CheckReport(VERDICTS), summarise_run(log, twin)))


def read_column(table, n):
    return np.frombuffer(base64.b64decode(table["columns"][n]), "<f4")


def test_a_report_has_numbers_and_pictures(tmp_path):
    """With a certificate: of a run in which V rose."""
    log = make_run("free", {**JITTER, "rate_hz": 100}).log
    paths = write_report(
        log,
        tmp_path / "new",
        twin=log,
        certificate=Certificate.of_log(log),
        wait_for_checks=lambda: CheckReport(VERDICTS),
    )
    assert [path.name for path in paths] == ["report.html", "summary.json"]
    assert sorted(paths) == sorted((tmp_path / "new").iterdir())
    pictures = write_report_figures(log, tmp_path, log)
    wanted = {name for name in list_drawable_figures(log) if FIGURES[name].in_report} | {
        "certificate"
    }
    assert {path.stem for path in pictures} == wanted | {"hands_moved"}
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in pictures)
    facts = json.loads(paths[1].read_text())
    assert facts["checks"] == [verdict.to_row() for verdict in VERDICTS]
    assert facts["certificate"]["verdict"] == "rose"
    html, data = read_page(paths[0].read_text(encoding="utf-8"))
    assert len(html) < 1_500_000
    body = html[html.index("</h1>") :]
    assert 0 < body.index('id="verdict"') < body.index("✗ Failed: ") < body.index('id="arms"')
    failed = "premises that fail: delays must be constant"
    assert f"</b>the theorem does not apply ({failed}): V rose by" in html
    assert "<td>V at 0 s</td>" in html
    assert 'src="data:image/png;base64,' in html
    sections = {attrs.get("data-section") for _, attrs in Page(html).elements} - {None}
    assert {chart["section"] for chart in data["charts"]} == sections


def test_the_page_asks_nothing_of_any_network():
    html, _ = render_page(add_clock_readings(make_short_log("four")))
    seen = Page(html)
    for tag, attrs in seen.elements:
        assert tag not in ("link", "img", "iframe", "object", "base", "form")
        assert not {"src", "href", "srcset", "action", "xlink:href"} & set(attrs)
    assert not re.search(r"url\s*\(|@import|fetch\(|XMLHttpRequest|WebSocket|import\(", html)
    addresses = set(re.findall(r"https?://[^\s)\"']*", html))
    # one in the licence comment of the library, one that names what SVG is
    assert addresses <= {"https://github.com/leeoniya/uPlot", "http://www.w3.org/2000/svg"}
    policy = next(
        a["content"]
        for t, a in seen.elements
        if "Content-Security-Policy" in a.get("http-equiv", "")
    )
    assert policy.startswith("default-src 'none'")


def test_pages_list_checks_and_repeating_commands():
    html, _ = render_page(make_short_log("four"))
    elements = Page(html).elements
    items = [attrs["class"] for tag, attrs in elements if tag == "li" and "class" in attrs]
    assert items[:2] == ["passed", "failed"]
    assert "trilat verify FILE" in html
    assert "trilat sim ./four.toml" in html  # not shipped: its text is on the page


def test_a_page_holds_one_tick_spikes():
    def spike(state):
        return (
            msgspec.structs.replace(state, q=[9.5, 0.0])
            if (state.site, state.tick) == ("s", 123)
            else state
        )

    log = rewrite_log(make_short_log("paper"), change=spike)
    _, data = render_page(log)
    chart = next(c for c in data["charts"] if c["title"] == "s, joint 1")
    series = chart["series"][0]
    table = data["tables"][series["table"]]
    values = read_column(table, series["column"])
    ticks = np.frombuffer(base64.b64decode(table["tick"]), "<i4")
    assert values.max() == 9.5
    assert ticks[values.argmax()] == 123
    chart = next(c for c in data["charts"] if c["title"] == "tracking error, joint 2")
    for site, series in zip(log.sites, chart["series"], strict=True):
        values = read_column(data["tables"][series["table"]], series["column"])
        assert values == pytest.approx(
            site_signals.joint_errors(log[site])[:, 1], rel=1e-6, abs=1e-12
        )


def test_the_page_describes_links_and_events():
    html, data = render_page(make_busy_run().log)
    assert (
        "uniform 20 to 100 ms, duplicates 20 %, in order<br>from 3 s: uniform 0 to 60 ms"
        in html
    )
    assert "command, applied at tick 500 of a" in html
    assert "b braked until 3.053 s." in html
    assert [change["n"] for change in data["changes"]] == [1, 2, 3]
    assert {span[1] for spans in data["spans"].values() for span in spans} == {
        "hold",
        "brake",
        "return",
    }
    (chart,) = (c for c in data["charts"] if c["section"] == "ages" and c["sites"] == ["c"])
    # a at 50 and then 90 ms, b at its mean throughout
    drawn = [(line["colour"], line["from"], round(line["to"], 9)) for line in chart["lines"]]
    assert drawn == [(0, 0.0, 1.0), (0, 1.0, 6.0), (1, 0.0, 6.0)]
    curves = [
        series for c in data["charts"] if c["section"] == "delays" for series in c["series"]
    ]
    assert len(curves) == 2 * 6
    for curve in curves:
        percent = np.frombuffer(base64.b64decode(curve["values"]), "<f4")
        assert len(percent) == 400
        assert (np.diff(percent) >= 0.0).all()


def test_pages_of_plain_logs_have_nothing_superfluous():
    html, data = render_page(make_short_log("paper"))
    assert data["changes"] == []
    assert set(map(len, data["spans"].values())) == {0}
    assert not [c for c in data["charts"] if c["section"] == "delays"]
    assert "Charts mark changes" not in html
    assert "clock of the sender" not in html
    ages = [c for c in data["charts"] if c["section"] == "ages"]
    line = {"value": 200.0, "colour": "limit", "from": 0.0, "to": data["end_s"]}
    assert [chart["lines"] for chart in ages] == [[line]] * 3


@pytest.mark.long
@pytest.mark.parametrize("sites", [(), ("m2", "s")])
def test_nearly_empty_logs_have_reports(sites, tmp_path):
    """No record at all, and one of two sites and none of the third."""
    some = add_clock_readings(make_short_log("paper"))
    log = rewrite_log(
        some, lambda r: r.tick < 1 and r.site in sites, finished=False, driver="live"
    )
    twin = make_log_without_hands("paper")
    paths = write_report(
        log,
        tmp_path,
        certificate=Certificate.of_log(log),
        twin=twin,
        wait_for_checks=lambda: CheckReport(VERDICTS),
    )
    assert [path.name for path in paths] == ["report.html", "summary.json"]
    pictures = write_report_figures(log, tmp_path, twin)
    assert {"positions.png", "arms.png"} <= {path.name for path in pictures}
    assert "the file was not finished" in paths[0].read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["paper", "four"])
def test_error_chart_names_its_floor(name):
    log = make_short_log(name)
    _, data = render_page(log)
    errors = [site_signals.largest_magnitude(log[site].e).min() for site in log.sites]
    chart = next(c for c in data["charts"] if c["section"] == "overview")
    assert chart["title"] == "Largest error |e| by site"
    assert chart["note"].startswith("Dashed: 0.01 rad.")
    floor = "Errors below 1e-06 rad are drawn at this value."
    assert (floor in chart["note"]) == (min(errors) < 1e-6)


def test_a_diverged_run_has_a_page():
    log = make_diverged_log()
    html, _ = render_page(log)
    assert '<th scope="row">diverged</th><td>yes</td>' in html
    assert f"m1 diverged: {log.describe_divergence('m1')}." in html


def test_no_line_breaks_within_a_hash() -> None:
    digits = "0123456789abcdef" * 4
    table = TextTable(
        ("name", "sha256"), [("a law with a name of many words", digits), ("b", "decade")]
    )
    assert f'<span style="white-space:nowrap">{digits}</span>' in table.html()
    assert "<td style" in table.html()
    assert ">decade</td>" in table.html()  # a word of letters is no hash
    for width in (70, 80, 120):
        console = Console(width=width, file=StringIO())
        console.print(table.rich())
        printed = console.file.getvalue()  # type: ignore[attr-defined]
        assert any(digits in line for line in printed.splitlines())
