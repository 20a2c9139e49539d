"""Writes the report of a recorded run: a web page, and a file with the key numbers of the run.

`write_report` computes the key numbers of the run from its log, draws the figures that explain
whether the run was stable, and writes two files:

- `report.html`, a page for readers. `render_report` fills the template `templates/report.html`.
  Each section of the page comes from one of the modules `page_...`. Interactive charts are
  drawn in the browser by scripts, from data that `charts.ChartBuilder` computes.
- `summary.json`, the same numbers for programs.

Invariant:
    - The page is a single file that contains its images, styles and scripts. It loads nothing
      from a network, and can therefore be sent by mail and read offline.
    - Every text that comes from a scenario or from a log is escaped by the template in which it
      stands. Such a text therefore cannot add HTML to the page.
    - The page has the same colours and type as the live page, because both read `theme.css`.
    - Empty tables are left out.
"""

import json
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path

from markupsafe import Markup

from ..analysis import Certificate, summarise_run
from ..files import make_folder, write_whole
from ..log import Finding, Log
from ..results import JsonObject
from ..scenario import Scenario
from .appearance import SITE_COLOURS
from .charts import ChartBuilder
from .html_templates import render_template
from .page_certificate import render_certificate
from .page_charts import render_chart_groups, render_overview
from .page_html import render_section
from .page_links import render_links
from .page_origin import describe_changes, render_origin, summarise_origin
from .page_sites import render_loops, render_sites
from .page_summary import render_alarms, render_checks, render_key_numbers, render_verdict
from .page_timeline import render_timeline

_ASSETS = resources.files("trilat_net.presentation") / "assets"


def write_report(
    log: Log,
    folder: Path,
    *,
    certificate: Certificate,
    twin: Log | None = None,
    verdicts: Iterable[Finding] = (),
) -> list[Path]:
    """Writes the report of a run, report.html and summary.json, into a folder.

    The page shows the results of a run to readers, and the JSON file contains the same numbers
    for programs.

    Args:
        log: Log of the run.
        folder: Folder of both files. It is created if it does not exist.
        certificate: Judgement whether the run was stable, with its reasons.
        twin: Log of the same run, simulated without the people or programs that move the arms.
            The page shows the difference, which is the motion due to these operators. If
            `None`, this section is left out.
        verdicts: Results of the checks of the log. They are read only after the figures of the
            certificate are drawn, because another process may still check the log until then.

    Returns:
        The paths of the page and of the summary.
    """
    make_folder(folder)
    facts = summarise_run(log, twin)
    facts["certificate"] = certificate.to_dict()
    reasons = render_certificate(log, certificate)

    findings = list(verdicts)
    facts["checks"] = [finding.to_row() for finding in findings]
    page = render_report(
        log=log,
        twin=twin,
        verdicts=findings,
        facts=facts,
        verdict=render_verdict(log, certificate, findings),
        reasons=reasons,
    )

    page_path = folder / "report.html"
    summary = json.dumps(facts, allow_nan=False, ensure_ascii=False, indent=2)
    summary_path = folder / "summary.json"
    write_whole(page_path, page)
    write_whole(summary_path, summary + "\n")
    return [page_path, summary_path]


def render_report(
    log: Log,
    twin: Log | None,
    verdicts: Sequence[Finding],
    facts: JsonObject,
    verdict: Markup = Markup(),  # noqa: B008
    reasons: Markup = Markup(),  # noqa: B008
) -> Markup:
    """Composes the web page (HTML) that reports a run: judgement, charts and tables.

    Args:
        log: Log of the run.
        twin: Log of the same run without operators, or `None`, see `write_report`.
        verdicts: Results of the checks of the log.
        facts: Key numbers of the run, from `summarise_run`.
        verdict: HTML of the judgement about stability, with which the page begins. Empty for
            none.
        reasons: HTML of the section that explains the judgement. Empty for no such section.

    Returns:
        The whole page.
    """
    scenario = log.scenario
    builder = ChartBuilder(log, twin)
    data, missing = builder.build()
    chart_groups = {}
    for place in ("motion", "links", "loops"):
        chart_groups[place] = render_chart_groups(log, place, data.charts, missing)

    return render_template(
        "report.html",
        name=scenario.name,
        title=scenario.title or scenario.name,
        origin_line=summarise_origin(log),
        changes=describe_changes(scenario),
        verdict=verdict,
        alarms=render_alarms(log),
        checks=render_checks(verdicts, facts),
        numbers=render_key_numbers(log, facts),
        overview=render_overview(log, builder, data.charts),
        motion=_render_motion(chart_groups["motion"]),
        timeline=render_timeline(log, facts),
        links=render_links(log, facts, chart_groups["links"]),
        sites=render_sites(log, facts),
        reasons=reasons,
        loops=render_loops(log, facts, chart_groups["loops"]),
        origin=render_origin(log, facts, _read_asset("uPlot-LICENSE")),
        data=data.to_builtins(),
        css=_read_asset("theme.css") + _read_asset("report.css"),
        site_css=_render_site_css(scenario),
        js=_read_asset("report.js") + _read_asset("arms.js"),
        uplot_css=_read_asset("uPlot.min.css"),
        uplot_js=_read_asset("uPlot.iife.min.js"),
    )


def _read_asset(name: str) -> Markup:
    """Returns the text of a file of the page, such as a style or a script."""
    return Markup((_ASSETS / name).read_text(encoding="utf-8"))


def _render_motion(charts: Markup) -> Markup:
    """Returns the section with positions, torques and estimates. Empty if it has no charts."""
    if not charts:
        return Markup()
    intro = (
        "Drag over a chart to zoom all, double-click to see the whole run, click a name to "
        "hide its line. Fig. 3 to 6 correspond to the paper's figures of the same numbers."
    )
    heading = "Positions, torques and estimates over time"
    return render_section(heading, intro, charts, "figures")


def _render_site_css(scenario: Scenario) -> Markup:
    """Returns the CSS rules for the colours of the sites (arms), which `theme.css` defines.

    The site with index i has the classes `site-i`, for lines in its colour, and `fill-i`, for
    areas in its colour. Colours repeat if there are more sites than colours.
    """
    colour_numbers = scenario.assign_colours(len(SITE_COLOURS))
    rules = ""
    for index in range(len(scenario.sites)):
        css_colour = f"var(--site-{colour_numbers[index % len(colour_numbers)]})"
        rules += f".site-{index} {{ stroke: {css_colour}; }} "
        rules += f".fill-{index} {{ background: {css_colour}; fill: {css_colour}; }}\n"
    return Markup(rules)
