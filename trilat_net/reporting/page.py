"""Write the report of a log: `report.html` and `summary.json`.

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
from typing import Any

from ..analysis.certificate.stability_certificate import Certificate, certificate_to_json
from ..analysis.json_values import JsonObject
from ..analysis.run_summary import summarise_run
from ..analysis.twin_growth import PushedTwins
from ..files import make_folder, write_whole
from ..log.findings import Finding
from ..log.log_reader import Log
from . import charts, page_tables
from .figures.arm_poses import render_arms_svg
from .figures.certificate_energy import draw_functional, draw_observed_energy
from .figures.loop_timing import explain_missing_loop_times
from .figures.registry import explain_absent_operator
from .figures.twin_differences import draw_twins
from .palette import DARK_SITE_COLOURS, SITE_COLOURS, list_site_colours

_PAGE_DPI = 110
_ASSETS = resources.files("trilat_net.reporting") / "assets"

_SECTIONS = {
    "torques": ("Operator torques", "The torque of the operators on the arms; Fig. 3 of the paper."),
    "positions": ("Positions", "Actual and desired joint angles; Fig. 4 of the paper."),
    "errors": ("Tracking errors", "e = q − q_des, Eq. (9); Fig. 5 of the paper."),
    "estimates": (
        "Parameter estimates",
        "Dashed: the true value, Eq. (24). Fig. 6 of the paper shows one site.",
    ),
    "moved": ("Motion due to the operators", "The log minus the same run without operators."),
    "control": ("Control torques", "τ of Eq. (13), the controllers' command to the joints."),
    "ages": (
        "Age of the samples in use",
        "Now minus the stamp of the sample in use: the effective delay. Dashed: the stated mean delay.",
    ),
    "delays": (
        "Distributions of delay and age",
        "The percentage of samples with at most that delay, and of ticks with at most that age.",
    ),
    "timing": ("The loops", "How late each loop woke up, and how long its ticks took."),
}
_EFFECTIVE = (
    "Effective is the delay that the controller saw: the age of the sample in use, over all ticks. Jitter "
    "makes it shorter than stated where the newest sample wins, and longer where samples stay in order."
)
_SAMPLES = (
    "Delivery of the samples. Superseded: never used, because a newer one came into use before or with it."
)
_CLOCKS = "The sender's clock against the receiver's, as estimated while the session ran."


def write_report(
    log: Log,
    folder: Path,
    *,
    twin: Log | None = None,
    certificate: Certificate | None = None,
    verdicts: Iterable[Finding] = (),
) -> list[Path]:
    """Writes report.html and summary.json, and returns their paths.

    Charts are made before the verdicts are read, which may still be in the making. Without a certificate the
    page has no section of it, and without `twin`, the same experiment without operators, no motion due to
    them.
    """
    make_folder(folder)
    facts = summarise_run(log, twin)
    section = verdict = ""
    if certificate is not None:
        facts["certificate"] = certificate_to_json(certificate)
        section = page_tables.render_certificate(certificate)
        verdict = page_tables.render_verdict(certificate)
        pictures = []
        if certificate.balance is not None:
            pictures.append(("V and energies", draw_functional(log, certificate)))
        if certificate.observed is not None and certificate.observed.curves:
            drawn = draw_observed_energy(log, certificate.observed)
            pictures.append(("energies that the laws declare", drawn))
        if certificate.twins is not None and certificate.twins.pushes:
            pictures.append(
                ("what became of small pushes", draw_twins(PushedTwins(log, 0.0, certificate.twins)))
            )
        for words, drawn in pictures:
            stream = io.BytesIO()
            drawn.savefig(stream, format="png", dpi=_PAGE_DPI)
            data = base64.b64encode(stream.getvalue()).decode()
            section += f'<img src="data:image/png;base64,{data}" alt="{words}" class="picture">'
        section = f"<section><h2>Was it stable, and why</h2>{section}</section>"
    lines = list(verdicts)
    facts["checks"] = [line.line() for line in lines]
    page, numbers = folder / "report.html", folder / "summary.json"
    write_whole(page, render_report(log, twin, lines, facts, section, verdict))
    write_whole(numbers, _json(facts, indent=2) + "\n")
    return [page, numbers]


def render_report(
    log: Log,
    twin: Log | None,
    verdicts: Sequence[Finding],
    facts: JsonObject,
    certificate: str = "",
    verdict: str = "",
) -> str:
    """Returns the page of a log, of facts from `summarise_run`; `certificate` is its section, as HTML.

    The page begins with `verdict`, as HTML too.
    """
    scenario = log.scenario
    bounds = charts.workspace_box_m(log)
    factor = charts.picture_scale(log, bounds)
    data = {
        **charts.Charts(log, twin, bounds).data(),
        "bounds_m": [factor * bound for bound in bounds],
    }
    return Template(_asset("report.html")).substitute(
        name=escape(scenario.name),
        title=escape(scenario.title or scenario.name),
        about=page_tables.render_description(scenario),
        verdicts=verdict + page_tables.render_alarms(log) + page_tables.render_check_lines(verdicts),
        facts=page_tables.render_run_facts(log, facts),
        sites=page_tables.render_sites(log, facts),
        loops=page_tables.render_loops(log, facts),
        links=_links(log, facts),
        strip=render_arms_svg(log, bounds, factor),
        sections=certificate + _sections(log, data["charts"]),
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
    """Returns a heading, a sentence and room for charts per section, and why some are not there."""
    filled = {chart["section"] for chart in drawn}
    chains = any(arm.chain for arm in log.scenario.arms.values())
    absent = {"torques": explain_absent_operator(log), "timing": explain_missing_loop_times(log)}
    html, missing = "", []
    for key, (heading, sentence) in _SECTIONS.items():
        if key in filled:
            kind = "charts small" if key == "estimates" and chains else "charts"
            if chains and key == "estimates":
                sentence = "Of every link, about the frame of its joint. Dashed: the true value."
            body = f'<p class="note">{escape(sentence)}</p><div class="{kind}" data-section="{key}"></div>'
            html += f"<section><h2>{escape(heading)}</h2>{body}</section>"
        elif absent.get(key):
            missing.append(f"{heading.lower()} ({absent[key]})")
    reasons = f'<p class="note">Not on this page: {escape("; ".join(missing))}.</p>' if missing else ""
    return html + reasons


def _links(log: Log, facts: JsonObject) -> str:
    parts = [
        (page_tables.render_link_ages(log, facts), _EFFECTIVE),
        (page_tables.render_link_samples(log, facts), _SAMPLES),
        (page_tables.render_clocks(log, facts), _CLOCKS),
        (page_tables.render_changes(facts), "Changes during the run; charts show their numbers."),
        (page_tables.render_modes(log, facts), "Reactions of sites to stale peers; charts are shaded then."),
    ]
    return "".join(
        f'<p class="note">{escape(sentence)}</p><div class="scroll">{table}</div>'
        for table, sentence in parts
        if table
    )


def _site_css(log: Log) -> str:
    light, dark = (
        "".join(
            f".site-{n} {{ stroke: {palette[n % len(palette)]}; }} "
            f".fill-{n} {{ background: {palette[n % len(palette)]}; fill: {palette[n % len(palette)]}; }}\n"
            for n in range(len(log.sites))
        )
        for palette in (list_site_colours(log.scenario, some) for some in (SITE_COLOURS, DARK_SITE_COLOURS))
    )
    return f"{light}@media screen and (prefers-color-scheme: dark) {{\n{dark}}}"


def _json(value: Any, indent: int | None = None) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")
