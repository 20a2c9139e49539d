"""Texts of a log never become HTML: in the whole page, and in each macro of each template."""

import dataclasses
import json
import re
import sys
from collections.abc import Mapping
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from markupsafe import Markup
from trilat_people.live_page.page_opening import BrowserOpening

import trilat_net
from tests.analysis.builders import FOUR, make_busy_run, make_short_log
from tests.log.builders import add_clock_readings, rewrite_log
from tests.presentation.varied_runs import make_fault_log
from trilat_net.analysis.certificate.stability_certificate import Certificate
from trilat_net.analysis.file_overview import summarise_run
from trilat_net.log.findings import CheckReport, Finding
from trilat_net.log.log_reader import Log
from trilat_net.net.messages import Event
from trilat_net.presentation import html_templates, page_summary
from trilat_net.presentation.appearance import REPORT_SIZE
from trilat_net.presentation.html_templates import render_macro, render_template
from trilat_net.presentation.page import render_report
from trilat_net.presentation.page_certificate import render_certificate
from trilat_net.presentation.page_summary import render_verdict
from trilat_net.presentation.style import styled_figure
from trilat_net.scenario import parse_scenario

HOSTILE = "</script><img onerror=alert(1) src='x'>\"`<b>`"
HARMLESS = "text `code`"
TEMPLATES = Path(html_templates.__file__).parent / "templates"
INNER = {"draw", "table_row", "swatch"}
"""Macros that only other macros of their template call."""
Call = tuple[str, str, dict[str, Any]]
"""File name of a template, its macro ("" for the whole template), and the values."""


class Elements(HTMLParser):
    """The elements of a page with the names of their attributes, and the texts of the page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.found: list[tuple[str, ...]] = []
        self.text = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, *(name for name, _ in attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data


def make_log_of_text(text: str) -> Log:
    """Returns a log that has a given text wherever a log has free text."""
    source = FOUR
    for key in ("title", "about", "assumed"):
        quoted = json.dumps([text] if key == "assumed" else text)
        source, count = re.subn(rf"(?m)^{key} = .*$", lambda _: f"{key} = {quoted}", source)  # noqa: B023
        assert count == 1
    events = [
        Event(v=3, member="a", boot=1, kind=kind, text=text, t_ns=10**9, about="b", n=n)
        for n, kind in enumerate(("mark", "lost", "failed", "clock fault", "refused"))
    ]
    log = rewrite_log(trilat_net.simulate(parse_scenario(source)), others=events)
    for key in ("commit", "platform", "python", "fingerprint", "version_numba"):
        log.session[key] = text
    return log


def render_everything(log: Log, text: str) -> str:
    """Returns the report of a log, and the HTML in a notebook."""
    certificate = Certificate.of_log(log)
    findings = [Finding(text, text, False), Finding("executed again", text, True)]
    checks = CheckReport(findings)
    page = render_report(
        log,
        None,
        checks,
        summarise_run(log),
        verdict=render_verdict(log, certificate, checks),
        reasons=render_certificate(log, certificate),
    )
    results = [log, certificate, log[log.sites[0]]]
    return str(page) + "".join(result._repr_html_() for result in results)


def test_hostile_log_adds_no_element() -> None:
    hostile = Elements(render_everything(make_log_of_text(HOSTILE), HOSTILE))
    harmless = Elements(render_everything(make_log_of_text(HARMLESS), HARMLESS))
    assert hostile.found == harmless.found
    assert hostile.text.count("<img onerror=alert(1)") >= 5


@cache
def record_calls() -> list[Call]:
    """Returns every use of a template while reports and results are rendered."""
    calls: list[Call] = []

    def macro(template: str, name: str, /, **values: Any) -> Markup:
        calls.append((template, name, values))
        return render_macro(template, name, **values)

    def whole(template: str, /, **values: Any) -> Markup:
        calls.append((template, "", values))
        return render_template(template, **values)

    with pytest.MonkeyPatch.context() as patch:
        for module in list(sys.modules.values()):
            if getattr(module, "__name__", "").startswith("trilat_net.presentation"):
                if hasattr(module, "render_macro"):
                    patch.setattr(module, "render_macro", macro)
                if hasattr(module, "render_template"):
                    patch.setattr(module, "render_template", whole)
        for log in (add_clock_readings(make_short_log("four")), make_busy_run().log):
            render_everything(log, "text")
        page_summary.render_alarms(make_fault_log())
        with styled_figure(REPORT_SIZE, 1.0) as figure:
            figure._repr_html_()  # type: ignore[attr-defined]
    return calls


def fill_texts(value: Any, text: str) -> Any:
    """Returns the value with a text in place of each plain string that it contains."""
    if isinstance(value, Markup) or value is None:
        return value
    if isinstance(value, str):
        return text
    if isinstance(value, Mapping):
        # keys stay apart, so that a table keeps its columns
        filled = {fill_texts(key, text): fill_texts(item, text) for key, item in value.items()}
        names = all(isinstance(key, str) and key.isidentifier() for key in value)
        return {key: fill_texts(item, text) for key, item in value.items()} if names else filled
    if hasattr(value, "_fields"):
        return value._replace(
            **{name: fill_texts(getattr(value, name), text) for name in value._fields}
        )
    if isinstance(value, list | tuple):
        return type(value)(fill_texts(item, text) for item in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {
            data_field.name: fill_texts(getattr(value, data_field.name), text)
            for data_field in dataclasses.fields(value)
        }
        return dataclasses.replace(value, **fields)
    return value


@pytest.mark.parametrize("template", sorted(path.name for path in TEMPLATES.iterdir()))
def test_template_escapes_every_text(template: str) -> None:
    used = set()
    for name, macro, values in record_calls():
        if name == template and macro not in used:
            used.add(macro)
            hostile, harmless = (
                Elements(
                    render_macro(name, macro, **filled)
                    if macro
                    else render_template(name, **filled)
                )
                for filled in (fill_texts(values, HOSTILE), fill_texts(values, HARMLESS))
            )
            assert hostile.found == harmless.found, macro
    if used != {""}:  # the page itself has no macros
        macros = html_templates._make_environment().get_template(template).module
        public = {name for name in vars(macros) if not name.startswith("_")}
        assert used == public - INNER - {"parts"}


def test_redirect_to_the_live_page_escapes_its_link(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    hostile = Elements(BrowserOpening(HOSTILE).write().read_text("utf-8"))
    assert hostile.found == Elements(BrowserOpening("link").write().read_text("utf-8")).found
