"""Writes the report of a recorded run: a web page and a file with the numbers of the run.

A run is a session of two or more sites, each of which is a process that controls one arm. The
log of the run is an MCAP file. `write_report` computes the numbers of the run from the log,
draws the figures that explain whether the run was stable, and writes two files:

- `report.html`, a page for people. `render_report` fills the template `assets/report.html`.
  Each section of the page comes from one function of this module.
- `summary.json`, the same numbers for programs.

The interactive charts are drawn in the browser by scripts. `charts.ChartBuilder` computes their
data, which the page contains as JSON.

Invariant:
    - The page is a single file that contains its images, styles and scripts. It loads nothing
      from a network, so that it can be sent by mail and read offline.
    - Every text that comes from a scenario or from a log is escaped in this module, where the
      cell of the table is made. Such a text therefore cannot add HTML to the page.
    - Empty tables are left out.
"""

import base64
import io
import json
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

from matplotlib.figure import Figure

from ..analysis.certificate.stability_certificate import Certificate
from ..analysis.file_overview import summarise_run
from ..analysis.site_signals import shared_unit
from ..analysis.timeline import RaisedAlarm, list_alarms
from ..analysis.twin_growth import PushedTwins
from ..files import make_folder, write_whole
from ..log.accounting import describe_unknown_ends
from ..log.findings import Finding
from ..log.log_reader import Log
from ..results import JsonObject
from ..scenario import Scenario, list_shipped, load_scenario
from ..scenario.describe import list_arm_notes
from .appearance import DARK_SITE_COLOURS, SITE_COLOURS, list_site_colours
from .certificate_text import describe_certificate, list_energies
from .charts import ChartBuilder
from .figures.age_and_lateness import explain_missing_loop_times
from .figures.arm_poses import render_arms_svg
from .figures.certificate_energy import draw_functional, draw_observed_energy
from .figures.joint_motion import explain_absent_operator
from .figures.twin_differences import draw_twins
from .page_data import Chart
from .result_text import escape_text
from .style import typeset

_PAGE_DPI = 110
_ASSETS = resources.files("trilat_net.reporting") / "assets"

_PAGE_TEXTS: dict[str, dict[str, Any]] = tomllib.loads(
    (_ASSETS / "report.toml").read_text(encoding="utf-8")
)
"""Headings and notes of the page: `charts` by section, and `notes` by table."""
_CODE = re.compile(r"`([^`]+)`")
"""Text in backticks, which the page shows as code."""
_MAX_MODES = 200
"""Largest number of listed mode intervals per site. summary.json has all of them."""
_MAX_ALARMS = 8
"""Largest number of alarms at the top of the page."""
_SEVERE_ALARMS = ("FAULT", "STOPPED")
"""Words of the alarms of sites that can no longer move."""
_NO_VALUE = "the log has no value to draw"
"""Reason why a chart is left out."""
_NO_NUMBER = "–"
"""Cell of a missing number."""
_PREMISE_MARKS = {
    True: "holds",
    False: '<span style="color:var(--bad)">fails</span>',
    None: "undecided",
}


def write_report(
    log: Log,
    folder: Path,
    *,
    certificate: Certificate,
    twin: Log | None = None,
    verdicts: Iterable[Finding] = (),
) -> list[Path]:
    """Writes report.html and summary.json into a folder.

    Args:
        log: Log of the run.
        folder: Folder of both files. It is created if it does not exist.
        certificate: Judgement whether the run was stable, with its reasons.
        twin: Log of the same run, simulated without the people or programs that move the arms.
            The page shows the difference, which is the motion due to these operators. None
            leaves this section out.
        verdicts: Results of the checks of the log. They are read only after the figures of the
            certificate are drawn, because another process may still check the log until then.

    Returns:
        The paths of the page and of the summary.
    """
    make_folder(folder)
    facts = summarise_run(log, twin)
    facts["certificate"] = certificate.to_dict()
    verdict = _render_stability_verdict(certificate)
    certificate_section = _render_certificate_section(log, certificate)

    findings = list(verdicts)
    facts["checks"] = [finding.to_row() for finding in findings]
    page = render_report(
        log=log,
        twin=twin,
        verdicts=findings,
        facts=facts,
        certificate=certificate_section,
        verdict=verdict,
    )

    page_path = folder / "report.html"
    summary_path = folder / "summary.json"
    write_whole(page_path, page)
    write_whole(summary_path, _to_json(facts, indent=2) + "\n")
    return [page_path, summary_path]


def render_report(
    log: Log,
    twin: Log | None,
    verdicts: Sequence[Finding],
    facts: JsonObject,
    certificate: str = "",
    verdict: str = "",
) -> str:
    """Composes the HTML page that reports a run.

    Args:
        log: Log of the run.
        twin: Log of the same run without operators, or None, see `write_report`.
        verdicts: Results of the checks of the log.
        facts: Numbers of the run, from `summarise_run`.
        certificate: HTML of the section about stability. Empty for no such section.
        verdict: HTML of the judgement about stability, with which the page begins. Empty for
            none.

    Returns:
        The whole page.
    """
    scenario = log.scenario
    builder = ChartBuilder(log, twin)
    data, missing = builder.build()
    # A "<" in a text could end the script element that contains the data. In JSON, "\u003c"
    # means the same character.
    data_json = _to_json(data.to_builtins()).replace("<", "\\u003c")
    return Template(_read_asset("report.html")).substitute(
        name=escape(scenario.name),
        title=escape(scenario.title or scenario.name),
        about=_render_description(scenario),
        verdicts=verdict + render_alarms(log) + _render_checks(verdicts),
        facts=_render_run_facts(log, facts),
        sites=_render_sites(log, facts),
        loops=_render_loops(log, facts),
        links=_render_links(log, facts),
        arms=_render_arms(log, builder),
        sections=certificate + _render_chart_sections(log, data.charts, missing),
        assumed=_render_assumptions(scenario),
        again=_render_commands(log),
        versions=_render_versions(log),
        licence=escape(_read_asset("uPlot-LICENSE")),
        data=data_json,
        css=_read_asset("report.css"),
        site_css=_render_site_css(log),
        js=_read_asset("report.js") + _read_asset("arms.js"),
        uplot_css=_read_asset("uPlot.min.css"),
        uplot_js=_read_asset("uPlot.iife.min.js"),
    )


def _read_asset(name: str) -> str:
    """Returns the text of a file of the page, such as its template, its style or a script."""
    return (_ASSETS / name).read_text(encoding="utf-8")


def _to_json(value: Any, indent: int | None = None) -> str:
    """Returns a value as JSON text. Raises ValueError for NaN and infinity."""
    return json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)


def _render_site_css(log: Log) -> str:
    """Returns the CSS rules for the colours of the sites, for light and for dark screens."""
    light = _render_site_rules(log, SITE_COLOURS)
    dark = _render_site_rules(log, DARK_SITE_COLOURS)
    return f"{light}@media screen and (prefers-color-scheme: dark) {{\n{dark}}}"


def _render_site_rules(log: Log, colours: Sequence[str]) -> str:
    """Returns the CSS rules of one palette.

    The site with index i has the classes `site-i`, for lines in its colour, and `fill-i`, for
    areas in its colour. Colours repeat if there are more sites than colours.

    Args:
        log: Log with the sites.
        colours: Palette from which the colours of the sites are chosen.
    """
    palette = list_site_colours(log.scenario, colours)
    rules = ""
    for index in range(len(log.sites)):
        colour = palette[index % len(palette)]
        rules += f".site-{index} {{ stroke: {colour}; }} "
        rules += f".fill-{index} {{ background: {colour}; fill: {colour}; }}\n"
    return rules


def _render_stability_verdict(certificate: Certificate) -> str:
    """Returns the judgement about stability as an HTML list with one item."""
    judgement = describe_certificate(certificate)[0]
    css_class = {"ok": "passed", "FAIL": "failed"}.get(judgement.mark, "open")
    sign = {"ok": "✓", "FAIL": "✗"}.get(judgement.mark, "?")
    text = escape(judgement.text)
    item = f'<li class="{css_class}"><b>{sign} </b>stability: {text}</li>'
    return f'<ul class="verdicts">{item}</ul>'


def _render_certificate_section(log: Log, certificate: Certificate) -> str:
    """Returns the section that explains whether the run was stable.

    It consists of sentences, tables and figures. The figures are embedded as PNG data, because
    the page must be a single file.
    """
    html = _render_certificate(certificate)
    for title, figure in _draw_certificate(log, certificate):
        drawing = io.BytesIO()
        figure.savefig(drawing, format="png", dpi=_PAGE_DPI)
        data = base64.b64encode(drawing.getvalue()).decode()
        source = f"data:image/png;base64,{data}"
        html += f'<img src="{source}" alt="{title}" class="picture">'
    return f"<section><h2>Was it stable, and why</h2>{html}</section>"


def _draw_certificate(log: Log, certificate: Certificate) -> list[tuple[str, Figure]]:
    """Draws the figures of a certificate.

    Which figures exist depends on the evidence of the certificate: the energy function of the
    stability proof and its energies, the energies that the control laws declare, and twins,
    which are repeated runs with a small push that grows or decays.

    Returns:
        Title and figure of each.
    """
    observed = certificate.observed
    twins = certificate.twins
    figures = []
    if certificate.balance is not None:
        figures.append(("V and energies", draw_functional(log, certificate)))
    if observed is not None and observed.curves:
        title = "energies that the laws declare"
        figures.append((title, draw_observed_energy(log, observed)))
    if twins is not None and twins.pushes:
        title = "growth or decay of small pushes"
        figures.append((title, draw_twins(PushedTwins(log, 0.0, twins))))
    return figures


def _render_certificate(certificate: Certificate) -> str:
    """Returns the sentences of a certificate, and its tables of premises and energies, as HTML.

    A premise is a condition of the stability theorem. The table says whether each one held in
    the run. The table of energies exists only if the energies could be computed.
    """
    judgement, *grounds = (escape(line.text) for line in describe_certificate(certificate))
    html = f"<p><strong>{judgement}</strong></p>"
    html += "".join(f"<p>{text}</p>" for text in grounds)

    premises = ""
    for premise in certificate.premises:
        name = escape(premise.name)
        mark = _PREMISE_MARKS[premise.holds]
        text = escape(premise.text)
        premises += f"<tr><th>{name}</th><th>{mark}</th><td>{text}</td></tr>"
    html += f'<div class="scroll"><table class="facts">{premises}</table></div>'

    if certificate.balance is None:
        return html
    energies = list_energies(certificate.balance)
    rows = [(escape(name), f"{energy_j:.4g}") for name, energy_j in energies]
    html += f'<div class="scroll">{_render_table(("energy", "J"), rows)}</div>'
    return html + _render_note(_PAGE_TEXTS["notes"]["certificate"])


def render_alarms(log: Log) -> str:
    """Renders the alarms of a run as a list in large type, which begins the page.

    Faults and stops are the severe alarms. If there are any, only these are listed, because
    other alarms usually follow from them. At most `_MAX_ALARMS` alarms are listed, and the rest
    is counted.

    Args:
        log: Log of the run.

    Returns:
        HTML of the list. Empty if there were no alarms.
    """
    alarms = list_alarms(log)
    if not alarms:
        return ""
    severe = [alarm for alarm in alarms if alarm.word in _SEVERE_ALARMS]
    candidates = severe if severe else alarms
    listed = candidates[:_MAX_ALARMS]

    items = "".join(_render_alarm(alarm) for alarm in listed)
    not_listed = len(alarms) - len(listed)
    if not_listed:
        items += f"<li class='mild'>and {not_listed} more: see the table of modes</li>"
    return f'<ul class="alarms">{items}</ul>'


def _render_alarm(alarm: RaisedAlarm) -> str:
    """Returns an alarm as a list item: its site, kind, time and reason."""
    css_class = "" if alarm.word in _SEVERE_ALARMS else "mild"
    period = f"{alarm.from_s:.3f} s to {alarm.to_s:.3f} s"
    heading = f"<strong>{escape(alarm.site)} {alarm.word}</strong>"
    return f'<li class="{css_class}">{heading}{period}: {escape(alarm.reason)}</li>'


def _render_checks(findings: Sequence[Finding]) -> str:
    """Returns the results of the checks of the log as an HTML list.

    Args:
        findings: Results of the checks. A check that failed may also be one that could not be
            judged, for example because the code of a user's law may not run here.

    Returns:
        HTML of the list. Empty if nothing was checked.
    """
    items = ""
    for finding in findings:
        css_class = "passed" if finding.passed else "failed"
        mark = "✓ ok"
        if not finding.passed:
            mark = "✗ failed" if finding.judged else "not judged"
        text = f"{escape(finding.check)}: {escape_text(finding.text)}"
        items += f'<li class="{css_class}"><b>{mark}</b>{text}</li>'
    return f'<ul class="verdicts">{items}</ul>' if items else ""


def _render_description(scenario: Scenario) -> str:
    """Returns the description of a scenario as paragraphs, with text in backticks as code."""
    text = _CODE.sub(r"<code>\1</code>", escape(scenario.about.strip()))
    return "".join(f"<p>{paragraph}</p>" for paragraph in text.split("\n\n") if paragraph)


_ARM_PLAYER = """<div id="arms" class="screen">
<div class="row"></div>
<div class="controls"><button type="button">play</button>
<input type="range" min="0" max="1000" value="0" step="1"
aria-label="time"><output>0.000 s</output></div>
</div>
<p class="note">Solid: the arm; dashed: the reference of Eq. (6). Above, the arms follow the
slider and the pointer in any chart. Below, a few instants, with the path of the end effector
until then.</p>
"""


def _render_arms(log: Log, builder: ChartBuilder) -> str:
    """Returns the part of the page on which the arms move.

    It consists of a player with a slider, whose script draws the arms at any time, and of
    pictures of a few instants. A note names the sites that have no records and cannot be drawn.

    Args:
        log: Log of the run.
        builder: Builder of the charts, which knows the box around the motion and the scale.
    """
    html = ""
    if any(len(log[site]) for site in log.sites):
        html = _ARM_PLAYER + render_arms_svg(log, builder.bounds_m, builder.units_per_m)
    absent = [site for site in log.sites if not len(log[site])]
    if absent:
        html += _render_note(f"Not drawn, because there is no record: {', '.join(absent)}.")
    return html


def _render_chart_sections(
    log: Log, charts: Sequence[Chart], missing: Mapping[str, Sequence[str]]
) -> str:
    """Returns the sections of charts, and a note about the charts that the page lacks.

    The sections are empty containers. The scripts of the page draw the charts into them.

    Args:
        log: Log of the run.
        charts: Charts of the page.
        missing: Titles of the charts for which the log has no value, by section.
    """
    sections_with_charts = {chart.section for chart in charts}
    has_chains = any(arm.chain for arm in log.scenario.arms.values())
    absence_reasons = {
        "torques": explain_absent_operator(log),
        "timing": explain_missing_loop_times(log),
    }

    html = ""
    lacking: list[str] = []
    for section, (heading, note) in _PAGE_TEXTS["charts"].items():
        if section in sections_with_charts:
            css_class = "charts"
            text = note
            if has_chains and section == "estimates":
                # Chains have ten estimates per link, and therefore many small charts.
                css_class = "charts small"
                text = _PAGE_TEXTS["notes"]["chain_estimates"]
            container = f'<div class="{css_class}" data-section="{section}"></div>'
            body = _render_note(text) + container
            html += f"<section><h2>{escape(heading)}</h2>{body}</section>"
            lacking += [f"{title} ({_NO_VALUE})" for title in missing.get(section, ())]
        elif absence_reasons.get(section):
            lacking.append(f"{heading.lower()} ({absence_reasons[section]})")
        elif section in missing:
            lacking.append(f"{heading.lower()} ({_NO_VALUE})")

    if lacking:
        html += _render_note(f"Not on this page: {'; '.join(lacking)}.")
    return html


def _render_run_facts(log: Log, facts: JsonObject) -> str:
    """Returns the table of facts about the whole run, such as its length and largest error."""
    scenario = log.scenario
    unit = shared_unit(log)
    records = f"{facts['records']}, {facts['missing']} missing"
    if not log.complete:
        records += "; the file was not finished"
    if log.unknown_ends:
        records += f"; {describe_unknown_ends(log.unknown_ends)}"

    settled = "not within the run"
    if facts["settle_s"] is not None:
        limit = f"every |e| below {facts['settle_below_rad']:g} {unit}"
        settled = f"{limit} from {facts['settle_s']:.3f} s on"

    length = f"{scenario.duration_s:g} s; scheme {scenario.scheme}; seed {scenario.seed}"
    end_error = _format_cell(facts["max_error_end_rad"])
    rows = {
        "scenario": f"{scenario.name}, sha256 {scenario.sha256[:16]}",
        "driven by": _describe_driver(log),
        "length": length,
        "records": records,
        "largest error at the end": f"{end_error} {unit} in the last second",
        "settled": settled,
        "dominance": _describe_dominance(scenario),
        "diverged": "yes" if facts["diverged"] else "no",
    }
    return _render_facts(rows.items())


def _describe_dominance(scenario: Scenario) -> str:
    """Returns which peers each site follows at the start, as in "m1 follows s 0.7, m2 0.3".

    A peer is another site whose states the site receives. The number is the dominance factor,
    the weight with which the site follows the peer. Peers with the factor 0 are left out.
    """
    sentences = []
    for site, shares in scenario.dominance.items():
        followed = [f"{peer} {share:g}" for peer, share in shares.items() if share]
        sentences.append(f"{site} follows {', '.join(followed)}")
    return "; ".join(sentences)


def _describe_driver(log: Log) -> str:
    """Returns how the run was executed: in virtual time, as a rerun, or as a live session."""
    session = log.session
    if log.driver == "virtual":
        return "virtual time"
    if log.driver == "rerun":
        source = session.get("rerun_of", "") or "a log"
        sites = session.get("rerun_executed", "").replace(" ", ", ")
        return f"rerun of {source}: {sites} executed afresh"
    epoch_s = int(session.get("epoch_unix_ns", "0")) // 10**9
    epoch = datetime.fromtimestamp(epoch_s, UTC)
    return f"live, session {session.get('session', '')}, epoch {epoch:%Y-%m-%d %H:%M:%S} UTC"


# Keys of a site in the summary, in the order of the columns of its table.
_MOTION_KEYS = (
    "max_error_rad",
    "max_error_end_rad",
    "settle_s",
    "peak_tau_nm",
    "saturated_ticks",
)


def _render_sites(log: Log, facts: JsonObject) -> str:
    """Returns the table with the records and the motion of each site.

    Args:
        log: Log of the run.
        facts: Numbers of the run, from `summarise_run`.
    """
    unit = shared_unit(log)
    headers = (
        "site",
        "records",
        "missing",
        "q at the end (rad)",
        f"max |e| ({unit})",
        f"max |e|, last 1 s ({unit})",
        "settled (s)",
        "max |τ| (N\u00a0m)",
        "ticks at the limit",
        "moved by operators, max (rad)",
    )
    joint_columns = (3, 9)  # columns whose cells list a number per joint
    rows = []
    has_many_joints = False
    for name in log.sites:
        site: JsonObject = facts["sites"][name]
        row = [_label_site(log, name), str(site["records"]), str(site["missing"])]
        row.append(_format_numbers(site["q_end_rad"]))
        row += [_format_cell(site[key]) for key in _MOTION_KEYS]
        row.append(_format_numbers(site["hands_moved_max_rad"]))
        rows.append(row)
        if len(site["q_end_rad"] or ()) > 3:
            has_many_joints = True

    # Lists of many joints are long. Their columns may wrap, as columns of texts do.
    text_columns = joint_columns if has_many_joints else ()
    return _render_table(headers, rows, text_columns)


_LOOP_HEADERS = (
    "loop",
    "late p50 (µs)",
    "late p99 (µs)",
    "late p99.9 (µs)",
    "late max (µs)",
    "busy p50 (µs)",
    "busy p99 (µs)",
    "busy max (µs)",
    "overruns",
)


def _render_loops(log: Log, facts: JsonObject) -> str:
    """Returns the table with the timing of each site's control loop.

    Late is the time between the moment at which a tick was due and its start. Busy is the
    computing time of a tick.

    Args:
        log: Log of the run.
        facts: Numbers of the run, from `summarise_run`.

    Returns:
        HTML of the table. Empty for a run in virtual time, which has no timing.
    """
    if log.driver == "virtual":
        return ""
    rows = []
    for name in log.sites:
        site: JsonObject = facts["sites"][name]
        values = [site["late_us"][key] for key in ("p50", "p99", "p99_9", "max")]
        values += [site["busy_us"][key] for key in ("p50", "p99", "max")]
        values.append(site["overruns"])
        cells = [_NO_NUMBER if value is None else f"{value:.0f}" for value in values]
        rows.append([_label_site(log, name), *cells])
    return _render_table(_LOOP_HEADERS, rows)


def _render_links(log: Log, facts: JsonObject) -> str:
    """Returns the tables about communication, each below a note that explains it.

    The tables are about the age and the number of samples on each link, the clocks, the changes
    during the run, and the times in which sites did not follow their peers. Empty tables are
    left out.
    """
    tables = {
        "ages": _render_link_ages(log, facts),
        "samples": _render_link_samples(log, facts),
        "clocks": _render_clocks(log, facts),
        "changes": _render_changes(facts),
        "modes": _render_modes(log, facts),
    }
    html = ""
    for name, table in tables.items():
        if table:
            html += _render_note(_PAGE_TEXTS["notes"][name])
            html += f'<div class="scroll">{table}</div>'
    return html


_AGE_HEADERS = (
    "link",
    "stated delay",
    "effective, mean (ms)",
    "deviation",
    "p50",
    "p99",
    "min",
    "max",
    "nothing new (% of ticks)",
    "longest silence (ms)",
)
_AGE_KEYS = ("mean", "deviation", "p50", "p99", "min", "max")


def _render_link_ages(log: Log, facts: JsonObject) -> str:
    """Returns the table of each link's stated delay and of the actual ages of its samples.

    The age is the time since the sample that a site uses in a tick was sent. The scenario may
    change the delay of a link during the run. Then the cell lists all stated delays, each with
    the time from which it applied.
    """
    rows = []
    for name, link in facts["links"].items():
        first, *later = link["stated"]
        models = [first["link"]]
        models += [f"from {change['from_s']:g} s: {change['link']}" for change in later]
        stated = "<br>".join(escape(typeset(model)) for model in models)

        values = [link["age_ms"][key] for key in _AGE_KEYS]
        values += [_to_percent(link["ticks_without_new"]), link["silence_ms"]]
        rows.append([_label_link(log, name), stated, *map(_format_cell, values)])
    return _render_table(_AGE_HEADERS, rows, text_columns=[1])


# Keys of a link's counts in the summary, and the headers of their columns.
_SAMPLE_COLUMNS = {
    "sent": "samples sent",
    "missing": "missing on the way",
    "lost": "lost by the model",
    "late": "late",
    "superseded": "superseded",
    "duplicate": "duplicates",
    "copies": "of the model",
}
_ONE_WAY_HEADERS = ("one way, min (µs)", "p50", "p99", "max", "known to, p50 (µs)")


def _render_link_samples(log: Log, facts: JsonObject) -> str:
    """Returns the table that counts the delivered and the lost samples of each link.

    The columns with measured one-way delays are added only if at least one link has them.
    """
    links: dict[str, JsonObject] = facts["links"]
    is_measured = any(link["one_way_us"] for link in links.values())
    headers = ["link", *_SAMPLE_COLUMNS.values(), "lost in all (%)", "in a row"]
    if is_measured:
        headers += _ONE_WAY_HEADERS
    rows = []
    for name, link in links.items():
        counts: JsonObject = link["samples"] or {}
        values = [counts.get(key) for key in _SAMPLE_COLUMNS]
        values += [_to_percent(link["loss"]), link["burst"]]
        if is_measured:
            one_way_us = link["one_way_us"] or {}
            clock = link["clock"] or {}
            values += [one_way_us.get(key) for key in ("min", "p50", "p99", "max")]
            values.append(clock.get("bound_p50_us"))
        rows.append([_label_link(log, name), *map(_format_cell, values)])
    return _render_table(headers, rows)


# Keys of a sender's clock in the summary, and the headers of their columns.
_CLOCK_COLUMNS = {
    "offset_us": "ahead at the end (µs)",
    "offset_first_us": "at the start",
    "drift_ppm": "drift (ppm)",
    "drift_bound_ppm": "known to (ppm)",
    "bound_us": "offset known to, end (µs)",
    "bound_p50_us": "p50",
    "bound_max_us": "max",
    "rtt_min_us": "round trip, min (µs)",
    "faults": "faults",
}


def _render_clocks(log: Log, facts: JsonObject) -> str:
    """Returns the table that compares the clock of each sender with that of the receiver.

    Returns:
        HTML of the table. Empty if all sites read the same clock.
    """
    rows = []
    for name, link in facts["links"].items():
        clock: JsonObject = link["clock"] or {}
        # Two sites that read the same clock know its offset exactly: it is zero.
        is_other_clock = clock and (clock["bound_max_us"] or clock["offset_us"])
        if is_other_clock:
            cells = [_format_cell(clock[key]) for key in _CLOCK_COLUMNS]
            rows.append([_label_link(log, name), *cells])
    if not rows:
        return ""
    return _render_table(("clock of the sender", *_CLOCK_COLUMNS.values()), rows)


def _render_changes(facts: JsonObject) -> str:
    """Returns the table of the changes during the run, such as another delay of a link.

    Returns:
        HTML of the table. Empty if there were no changes.
    """
    rows = []
    for number, change in enumerate(facts["changes"], 1):
        tick = change["taken_at_tick"]
        origin = "scenario"
        # Changes of the scenario have a time only. Commands are applied at a tick.
        if tick is not None:
            origin = f"command, applied at tick {tick} of {change['site']}"
        sentence = escape(typeset(change["sentence"]))
        rows.append([str(number), _format_cell(change["at_s"]), sentence, escape(origin)])
    if not rows:
        return ""
    headers = ("no.", "from (s)", "what happened", "origin")
    return _render_table(headers, rows, text_columns=[2, 3])


def _render_modes(log: Log, facts: JsonObject) -> str:
    """Returns the table of the times in which sites held, braked or returned to their peers.

    Returns:
        HTML of the table. Empty if all sites followed their peers all the time.
    """
    rows = []
    for name, site in facts["sites"].items():
        label = _render_swatch(log, name) + escape(name)
        for interval in site["modes"][:_MAX_MODES]:
            times = [f"{interval['from_s']:.3f}", f"{interval['to_s']:.3f}"]
            rows.append([label, interval["mode"], *times])
    if not rows:
        return ""
    return _render_table(("site", "mode", "from (s)", "to (s)"), rows, text_columns=[1])


def _render_assumptions(scenario: Scenario) -> str:
    """Returns the list of assumptions that the scenario declares, and the notes on its arms."""
    texts = [*scenario.assumed, *list_arm_notes(scenario)]
    if not texts:
        return "<p>Nothing is declared as assumed.</p>"
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<ul>{items}</ul>"


def _render_commands(log: Log) -> str:
    """Returns the commands that verify and repeat the run, and the text of the scenario.

    If the scenario is one that is shipped with this program, the command names it. Otherwise
    the reader must save the scenario text as a file first.
    """
    scenario = log.scenario
    file_name = Path(log.source).name
    if not file_name.endswith(".mcap"):
        file_name = "FILE"  # the log was not read from a file

    argument = f"./{scenario.name}.toml"
    hint = f"to be saved as {scenario.name}.toml"
    has_shipped_name = scenario.name in list_shipped()
    if has_shipped_name and load_scenario(scenario.name).sha256 == scenario.sha256:
        argument = scenario.name
        hint = "as shipped"

    commands = (
        f"trilat verify {file_name}\ntrilat verify --virtual {file_name}\ntrilat sim {argument}"
    )
    return (
        f"<pre>{escape(commands)}</pre>"
        f"<details><summary>The resolved scenario, {escape(hint)}</summary>"
        f"<pre>{escape(scenario.text)}</pre></details>"
    )


def _render_versions(log: Log) -> str:
    """Returns the table of the software and the machine that recorded the log."""
    session = log.session
    commit = session.get("commit", "unknown")
    if session.get("commit_dirty") == "true":
        commit += " with changes"
    platform = session.get("platform", "unknown")
    python = session.get("python", "unknown")
    facts = [
        ("commit", commit),
        ("fingerprint of arithmetic", session.get("fingerprint", "unknown")),
        ("platform", f"{platform}, {python}"),
    ]
    prefix = "version_"
    for key, version in session.items():
        if key.startswith(prefix):
            facts.append((key.removeprefix(prefix), version))
    return _render_facts(facts)


def _format_cell(value: float | None) -> str:
    """Returns a number as text: an integer with all digits, or four digits of another number.

    Returns a dash for None.
    """
    if value is None:
        return _NO_NUMBER
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def _format_numbers(values: Iterable[float] | None) -> str:
    """Returns numbers with four decimals, separated by commas. Returns a dash for None."""
    if values is None:
        return _NO_NUMBER
    return ", ".join(f"{value:.4f}" for value in values)


def _to_percent(share: float | None) -> float | None:
    """Returns a share between 0 and 1 in percent. Returns None for None."""
    return None if share is None else 100.0 * share


def _label_site(log: Log, name: str) -> str:
    """Returns the name and the role of a site, behind a square in the colour of the site."""
    role = log.scenario.sites[name].role
    return f"{_render_swatch(log, name)}{escape(name)} ({escape(role)})"


def _label_link(log: Log, link: str) -> str:
    """Returns the name of a link, as in "m1 → s", behind a square in its sender's colour."""
    peer, site = link.split("->")
    return f"{_render_swatch(log, peer)}{escape(peer)} → {escape(site)}"


def _render_swatch(log: Log, site: str) -> str:
    """Returns a small square in the colour of a site."""
    return f'<span class="swatch fill-{log.sites.index(site)}"></span>'


def _render_note(text: str) -> str:
    """Returns a string as a paragraph in small type."""
    return f'<p class="note">{escape(text)}</p>'


def _render_facts(facts: Iterable[tuple[str, str]]) -> str:
    """Returns a table with two columns: the name and the text of each fact."""
    rows = ""
    for name, text in facts:
        rows += f"<tr><th>{escape(name)}</th><td>{escape_text(text)}</td></tr>"
    return f'<table class="facts">{rows}</table>'


def _render_table(
    headers: Sequence[str], rows: Iterable[Sequence[str]], text_columns: Sequence[int] = ()
) -> str:
    """Returns an HTML table.

    Args:
        headers: Header of each column, as plain text.
        rows: Rows of cells, one cell per column. The cells are HTML already, so that they can
            contain coloured squares and line breaks.
        text_columns: Indices of the columns that hold texts, which may wrap. The first column
            is always a text.
    """
    attributes = [
        ' class="words"' if column in text_columns else "" for column in range(len(headers))
    ]

    head = ""
    for attribute, header in zip(attributes, headers, strict=True):
        head += f"<th{attribute}>{escape(header)}</th>"

    body = ""
    for row in rows:
        cells = ""
        for attribute, cell in zip(attributes, row, strict=True):
            cells += f"<td{attribute}>{cell}</td>"
        body += f"<tr>{cells}</tr>"
    return f'<table class="sites"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
