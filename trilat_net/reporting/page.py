"""Write the report of a log: `report.html`, `summary.json` and the figures, with sections from other modules.

Invariant: the page is one file with images, styles and scripts inside; it loads nothing from a network.
"""

import base64
import io
import json
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from ..analysis.run_summary import JsonObject, summarise_run
from ..execution.log_checks import CheckLine
from ..files import make_folder, write_whole
from ..log.log_reader import Log
from ..log.mcap_reader import Progress
from . import arm_svg, charts, page_tables, style
from .figures import joint_motion, loop_timing
from .figures.registry import write_report_figures

_PAGE_DPI = 110


class ReportSection(NamedTuple):
    """A section of the page.

    Attributes:
        key: its name in `summary.json`, and of its figure's file.
        heading: in words.
        html: its body, with everything escaped that came from outside.
        facts: its numbers, ready for JSON.
        figure: what it shows; None: nothing.
    """

    key: str
    heading: str
    html: str
    facts: dict[str, Any]
    figure: Figure | None = None


def render_sections(sections: Sequence[ReportSection]) -> str:
    """Returns the sections for the page, figures and all."""
    return "".join(
        f"<section><h2>{escape(one.heading)}</h2>{one.html}{_image(one)}</section>" for one in sections
    )


def write_section_figures(sections: Sequence[ReportSection], folder: Path) -> list[Path]:
    """Writes the sections' figures as PNG into a folder that exists, and returns the paths."""
    paths = []
    for one in sections:
        if one.figure is not None:
            paths.append(folder / f"{one.key}.png")
            one.figure.savefig(paths[-1], dpi=style.REPORT_DPI)
    return paths


def _image(section: ReportSection) -> str:
    if section.figure is None:
        return ""
    stream = io.BytesIO()
    section.figure.savefig(stream, format="png", dpi=_PAGE_DPI)
    data = base64.b64encode(stream.getvalue()).decode()
    alt = escape(section.heading)
    return f'<img src="data:image/png;base64,{data}" alt="{alt}" style="max-width:100%">'


_ASSETS = resources.files("trilat_net.reporting") / "assets"

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
    verdicts: Iterable[CheckLine] = (),
    progress: Progress | None = None,
    sections: Sequence[ReportSection] = (),
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
    make_folder(folder)
    facts = summarise_run(log, twin)
    figures = [*write_report_figures(log, folder, twin, progress), *write_section_figures(sections, folder)]
    lines = list(verdicts)
    checks = [line._asdict() for line in lines]
    page, numbers = folder / "report.html", folder / "summary.json"
    write_whole(page, render_report(log, twin, lines, facts, sections))
    more = {section.key: section.facts for section in sections}
    write_whole(numbers, _json({**facts, **more, "checks": checks}, indent=2) + "\n")
    return [page, numbers, *figures]


def render_report(
    log: Log,
    twin: Log | None,
    verdicts: Sequence[CheckLine],
    facts: JsonObject,
    sections: Sequence[ReportSection] = (),
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
    bounds = charts.workspace_box_m(log)
    data = {**charts.Charts(log, twin).data(), "bounds_m": bounds}
    return Template(_asset("report.html")).substitute(
        name=escape(scenario.name),
        title=escape(scenario.title or scenario.name),
        about=page_tables.render_description(scenario),
        verdicts=page_tables.render_check_lines(verdicts),
        facts=page_tables.render_run_facts(log, facts),
        sites=page_tables.render_sites(log, facts),
        loops=page_tables.render_loops(log, facts),
        links=_links(log, facts),
        strip=arm_svg.render_arms_svg(log, bounds),
        sections=render_sections(sections) + _sections(log, data["charts"]),
        assumed=page_tables.render_assumptions(scenario),
        again=page_tables.render_commands(log),
        versions=page_tables.render_versions(log),
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
    absent = {"torques": joint_motion.NO_OPERATOR, "timing": loop_timing.explain_missing_loop_times(log)}
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


def _links(log: Log, facts: JsonObject) -> str:
    """Returns what the links did and what happened besides, in tables, each with a sentence."""
    parts = [
        (page_tables.render_link_ages(log, facts), _EFFECTIVE),
        (page_tables.render_link_samples(log, facts), _SAMPLES),
        (page_tables.render_clocks(log, facts), _CLOCKS),
        (page_tables.render_changes(facts), "What was changed while it ran; charts have its number."),
        (page_tables.render_modes(log, facts), "What sites did about stale peers; charts are shaded then."),
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
        for palette in (style.SITE_COLOURS, style.DARK_SITE_COLOURS)
    )
    return f"{light}@media screen and (prefers-color-scheme: dark) {{\n{dark}}}"


def _json(value: Any, indent: int | None = None) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")
