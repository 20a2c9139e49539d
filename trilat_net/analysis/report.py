"""Writes what a person reads of a log: one page, the figures, and the numbers for programs.

Law: the page is one file that asks nothing of any network; a browser opens it from the disk in ten years.
"""

import json
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from ..log.chunks import Progress
from ..log.reader import Log
from . import charts, link_tables, motion, strip, style, tables, timing
from .figures import write_figures
from .section import Section, sections_html, write_sections
from .summary import Facts, summarise
from .tables import VerdictLine

__all__ = ["VerdictLine", "report_html", "write_report"]

_ASSETS = resources.files("trilat_net.analysis") / "assets"

_SECTIONS = {
    "torques": ("What the hands did", "The torque of the operators' hands on the arms; Fig. 3 of the paper."),
    "positions": ("Positions", "Actual and desired joint angles; Fig. 4 of the paper."),
    "errors": ("Tracking errors", "e = q − q_des, Eq. (9); Fig. 5 of the paper."),
    "estimates": (
        "Parameter estimates",
        "Dashed: the true value, Eq. (24). Fig. 6 of the paper shows one site.",
    ),
    "moved": ("How far the hands moved the arms", "The log minus the same run with nobody at the arms."),
    "control": ("Control torques", "τ of Eq. (13), what the controllers ask of the joints."),
    "ages": (
        "Age of the samples in use",
        "Now minus the stamp of the sample in use: the effective delay. Dashed: the mean delay as stated.",
    ),
    "delays": (
        "Delay and age, how often",
        "Which share of samples has no more delay, and which share of ticks no more age, than so much.",
    ),
    "timing": ("The loops", "How late each loop woke up, and how long its ticks took."),
}
_EFFECTIVE = (
    "Effective is the delay that the controller saw: the age of the sample in use, over all ticks. Jitter "
    "makes it shorter than stated where the newest sample wins, and longer where samples stay in order."
)
_SAMPLES = (
    "What became of the samples. Superseded: never used, because a newer one came into use before or with it."
)
_CLOCKS = "The sender's clock against the receiver's, as it was estimated while the session ran."


def write_report(
    log: Log,
    folder: Path,
    *,
    twin: Log | None = None,
    verdicts: Iterable[VerdictLine] = (),
    progress: Progress | None = None,
    sections: Sequence[Section] = (),
) -> list[Path]:
    """Writes report.html, summary.json and a PNG per figure, and returns their paths in that order.

    Figures are drawn first: verdicts may still be in the making.

    Args:
        log: the log.
        folder: where to; made if it does not exist.
        twin: the same experiment with nobody at the arms, or None.
        verdicts: what was checked and how it came out.
        progress: told how many figures are drawn, and how many there are.
        sections: what is shown besides, from elsewhere.
    """
    folder.mkdir(parents=True, exist_ok=True)
    facts = summarise(log, twin)
    figures = [*write_figures(log, folder, twin, progress), *write_sections(sections, folder)]
    lines = list(verdicts)
    checks = [line._asdict() for line in lines]
    page, numbers = folder / "report.html", folder / "summary.json"
    page.write_text(report_html(log, twin, lines, facts, sections), encoding="utf-8")
    more = {section.key: section.facts for section in sections}
    numbers.write_text(_json({**facts, **more, "checks": checks}, indent=2) + "\n", encoding="utf-8")
    return [page, numbers, *figures]


def report_html(
    log: Log,
    twin: Log | None,
    verdicts: Sequence[VerdictLine],
    facts: Facts,
    sections: Sequence[Section] = (),
) -> str:
    """Returns the page of a log.

    Args:
        log: the log.
        twin: the same experiment with nobody at the arms, or None.
        verdicts: what was checked and how it came out.
        facts: as from `summarise`.
        sections: what is shown besides, from elsewhere.
    """
    scenario = log.scenario
    bounds = charts.bounds_m(log)
    data = {**charts.Charts(log, twin).data(), "bounds_m": bounds}
    return Template(_asset("report.html")).substitute(
        name=escape(scenario.name),
        title=escape(scenario.title or scenario.name),
        about=tables.about_html(scenario),
        verdicts=tables.verdicts_html(verdicts),
        facts=tables.facts_html(log, facts),
        sites=tables.sites_html(log, facts),
        loops=tables.loops_html(log, facts),
        links=_links(log, facts),
        strip=strip.arms_svg(log, bounds),
        sections=sections_html(sections) + _sections(log, data["charts"]),
        assumed=tables.assumed_html(scenario),
        again=tables.again_html(log),
        versions=tables.versions_html(log),
        licence=escape(_asset("uPlot-LICENSE")),
        # what ends a script element early cannot stand in JSON with this escape, which means the same
        data=_json(data).replace("<", "\\u003c"),
        css=_asset("report.css"),
        site_css=_site_css(log),
        js=_asset("report.js") + _asset("arms.js"),
        uplot_css=_asset("uPlot.min.css"),
        uplot_js=_asset("uPlot.iife.min.js"),
    )


def _sections(log: Log, drawn: Sequence[dict[str, Any]]) -> str:
    """Returns a heading, a sentence and room for charts per section, or why there are none."""
    filled = {chart["section"] for chart in drawn}
    absent = {"torques": motion.NO_HANDS, "timing": timing.no_clock_text(log)}
    html = ""
    for key, (heading, sentence) in _SECTIONS.items():
        if key in filled:
            body = f'<p class="note">{escape(sentence)}</p><div class="charts" data-section="{key}"></div>'
        elif key in absent:
            body = f'<p class="note">{escape(absent[key])}.</p>'
        else:
            continue
        html += f"<section><h2>{escape(heading)}</h2>{body}</section>"
    return html


def _links(log: Log, facts: Facts) -> str:
    """Returns what the links did and what happened besides, in tables, each with a sentence."""
    parts = [
        (link_tables.ages_html(log, facts), _EFFECTIVE),
        (link_tables.samples_html(log, facts), _SAMPLES),
        (link_tables.clocks_html(log, facts), _CLOCKS),
        (link_tables.changes_html(facts), "What was changed while it ran; charts have its number."),
        (link_tables.modes_html(log, facts), "What sites did about stale peers; charts are shaded then."),
    ]
    return "".join(
        f'<p class="note">{escape(sentence)}</p><div class="scroll">{table}</div>'
        for table, sentence in parts
        if table
    )


def _site_css(log: Log) -> str:
    """Returns the colours of the sites for the page's pictures and tables."""
    light, dark = (
        "".join(
            f".site-{n} {{ stroke: {palette[n % len(palette)]}; }} "
            f".fill-{n} {{ background: {palette[n % len(palette)]}; fill: {palette[n % len(palette)]}; }}\n"
            for n in range(len(log.sites))
        )
        for palette in (style.COLOURS, style.DARK_COLOURS)
    )
    return f"{light}@media screen and (prefers-color-scheme: dark) {{\n{dark}}}"


def _json(value: Any, indent: int | None = None) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")
