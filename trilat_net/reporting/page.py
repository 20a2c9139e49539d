"""Write the report of a log: the page `report.html` and the numbers `summary.json`.

`write_report` collects the numbers of the run, draws the pictures of its certificate and writes
both files. `render_report` fills the template `assets/report.html` with sections, each of which
one function of this module renders as HTML. The interactive charts are drawn in the browser
from data of `charts`.

Invariant:
    - The page is a single file that holds its images, styles and scripts. It loads nothing from
      a network.
    - Every text of a scenario or of a log is escaped in this module, cell by cell.
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
_MAX_MODES = 200
"""Largest number of listed intervals of a site in a mode; summary.json has all."""
_MAX_ALARMS = 8
"""Largest number of alarms at the top of the page."""
_SEVERE_ALARMS = ("FAULT", "STOPPED")
_NO_VALUE = "the log has no value to draw"
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
    """Writes report.html and summary.json, and returns their paths.

    Args:
        log: the log of the run.
        folder: the folder of both files, created if it does not exist.
        certificate: the stability certificate of the log.
        twin: the log of the same run without operators. Without `twin` the page does not show
            the motion due to operators.
        verdicts: the checks of the log. They are read last, because the process that checks
            the log may still run while the pictures of the certificate are drawn.
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
    """Returns the page of a log as HTML.

    Args:
        log: the log of the run.
        twin: the log of the same run without operators, or None.
        verdicts: the checks of the log.
        facts: the numbers of the log, from `summarise_run`.
        certificate: the section on the certificate, as HTML.
        verdict: the verdict on stability, as HTML; the page begins with this verdict.
    """
    scenario = log.scenario
    builder = ChartBuilder(log, twin)
    data, missing = builder.build()
    # "<" could end the script element that holds the data; in JSON, "\u003c" means the same
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
    return (_ASSETS / name).read_text(encoding="utf-8")


def _to_json(value: Any, indent: int | None = None) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)


def _render_site_css(log: Log) -> str:
    """Returns the style rules of the sites' colours, for light and for dark screens."""
    light = _render_site_rules(log, SITE_COLOURS)
    dark = _render_site_rules(log, DARK_SITE_COLOURS)
    return f"{light}@media screen and (prefers-color-scheme: dark) {{\n{dark}}}"


def _render_site_rules(log: Log, colours: Sequence[str]) -> str:
    palette = list_site_colours(log.scenario, colours)
    rules = ""
    for index in range(len(log.sites)):
        colour = palette[index % len(palette)]
        rules += f".site-{index} {{ stroke: {colour}; }} "
        rules += f".fill-{index} {{ background: {colour}; fill: {colour}; }}\n"
    return rules


def _render_stability_verdict(certificate: Certificate) -> str:
    """Returns the judgement of the certificate as a list of one item."""
    judgement = describe_certificate(certificate)[0]
    css_class = {"ok": "passed", "FAIL": "failed"}.get(judgement.mark, "open")
    sign = {"ok": "✓", "FAIL": "✗"}.get(judgement.mark, "?")
    text = escape(judgement.text)
    item = f'<li class="{css_class}"><b>{sign} </b>stability: {text}</li>'
    return f'<ul class="verdicts">{item}</ul>'


def _render_certificate_section(log: Log, certificate: Certificate) -> str:
    """Returns the certificate as text, tables and pictures."""
    html = _render_certificate(certificate)
    for title, figure in _draw_certificate(log, certificate):
        drawing = io.BytesIO()
        figure.savefig(drawing, format="png", dpi=_PAGE_DPI)
        data = base64.b64encode(drawing.getvalue()).decode()
        source = f"data:image/png;base64,{data}"
        html += f'<img src="{source}" alt="{title}" class="picture">'
    return f"<section><h2>Was it stable, and why</h2>{html}</section>"


def _draw_certificate(log: Log, certificate: Certificate) -> list[tuple[str, Figure]]:
    """Returns the figures of a certificate with their titles."""
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
    """Returns the sentences of a certificate, and its tables of premises and energies."""
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
    """Returns the alarms of the sites in large type; "" if there were none.

    Faults and stops are shown first. Other alarms are shown only if no site was in fault or
    stopped.
    """
    alarms = list_alarms(log)
    severe = [alarm for alarm in alarms if alarm.word in _SEVERE_ALARMS]
    listed = (severe or alarms)[:_MAX_ALARMS]
    if not listed:
        return ""
    items = "".join(_render_alarm(alarm) for alarm in listed)
    more = len(alarms) - len(listed)
    if more:
        items += f"<li class='mild'>and {more} more: see the table of modes</li>"
    return f'<ul class="alarms">{items}</ul>'


def _render_alarm(alarm: RaisedAlarm) -> str:
    css_class = "" if alarm.word in _SEVERE_ALARMS else "mild"
    period = f"{alarm.from_s:.3f} s to {alarm.to_s:.3f} s"
    heading = f"<strong>{escape(alarm.site)} {alarm.word}</strong>"
    return f'<li class="{css_class}">{heading}{period}: {escape(alarm.reason)}</li>'


def _render_checks(findings: Sequence[Finding]) -> str:
    """Returns the list of checks; "" if nothing was checked."""
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
    """Returns the scenario's description as paragraphs, with text in backticks as code."""
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
    """Returns the player and pictures of the arms, and the names of sites without records."""
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
    """Returns the sections of charts, and a note on the charts that the page lacks.

    Args:
        log: the log.
        charts: the charts of the page.
        missing: by section, the titles of charts for which the log has no value.
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
            # chains have ten estimates per link, hence many small charts
            is_small = has_chains and section == "estimates"
            css_class = "charts small" if is_small else "charts"
            text = _PAGE_TEXTS["notes"]["chain_estimates"] if is_small else note
            body = f'<div class="{css_class}" data-section="{section}"></div>'
            html += f"<section><h2>{escape(heading)}</h2>{_render_note(text)}{body}</section>"
            lacking += [f"{title} ({_NO_VALUE})" for title in missing.get(section, ())]
        elif absence_reasons.get(section):
            lacking.append(f"{heading.lower()} ({absence_reasons[section]})")
        elif section in missing:
            lacking.append(f"{heading.lower()} ({_NO_VALUE})")
    if lacking:
        html += _render_note(f"Not on this page: {'; '.join(lacking)}.")
    return html


def _render_run_facts(log: Log, facts: JsonObject) -> str:
    """Returns the table of facts about the whole run."""
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
    """Returns by site the peers that the site follows, with their shares at the start."""
    sentences = []
    for site, shares in scenario.dominance.items():
        followed = [f"{peer} {share:g}" for peer, share in shares.items() if share]
        sentences.append(f"{site} follows {', '.join(followed)}")
    return "; ".join(sentences)


def _describe_driver(log: Log) -> str:
    """Returns the driver of the session: virtual time, a rerun, or a live session."""
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


_MOTION_KEYS = (
    "max_error_rad",
    "max_error_end_rad",
    "settle_s",
    "peak_tau_nm",
    "saturated_ticks",
)


def _render_sites(log: Log, facts: JsonObject) -> str:
    """Returns the table of the sites' records and motion."""
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
    joint_columns = (3, 9)
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
    # columns of texts may wrap
    return _render_table(headers, rows, joint_columns if has_many_joints else ())


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
    """Returns the table of the loops' timing; "" for virtual time, which has no timing."""
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
    """Returns the tables of links, clocks, changes and modes, each below its note."""
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
    """Returns the table of stated delays, and of the ages of the samples in use."""
    rows = []
    for name, link in facts["links"].items():
        first, *later = link["stated"]
        models = [first["link"]]
        models += [f"from {state['from_s']:g} s: {state['link']}" for state in later]
        stated = "<br>".join(escape(typeset(model)) for model in models)
        values = [link["age_ms"][key] for key in _AGE_KEYS]
        values += [_to_percent(link["ticks_without_new"]), link["silence_ms"]]
        rows.append([_label_link(log, name), stated, *map(_format_cell, values)])
    return _render_table(_AGE_HEADERS, rows, text_columns=[1])


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
    """Returns the table of the delivery of samples, with one-way delays if measured."""
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
    """Returns the table of the senders' clocks; "" if all sites read the same clock."""
    rows = []
    for name, link in facts["links"].items():
        clock: JsonObject = link["clock"] or {}
        if clock and (clock["bound_max_us"] or clock["offset_us"]):
            cells = [_format_cell(clock[key]) for key in _CLOCK_COLUMNS]
            rows.append([_label_link(log, name), *cells])
    if not rows:
        return ""
    return _render_table(("clock of the sender", *_CLOCK_COLUMNS.values()), rows)


def _render_changes(facts: JsonObject) -> str:
    """Returns the table of the changes during the run; "" if there were none."""
    rows = []
    for number, change in enumerate(facts["changes"], 1):
        tick = change["taken_at_tick"]
        origin = "scenario"
        if tick is not None:
            origin = f"command, applied at tick {tick} of {change['site']}"
        sentence = escape(typeset(change["sentence"]))
        rows.append([str(number), _format_cell(change["at_s"]), sentence, escape(origin)])
    if not rows:
        return ""
    headers = ("no.", "from (s)", "what happened", "origin")
    return _render_table(headers, rows, text_columns=[2, 3])


def _render_modes(log: Log, facts: JsonObject) -> str:
    """Returns the table of the times in which sites held, braked or returned; or ""."""
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
    """Returns the commands that check and repeat the run, and the resolved scenario."""
    scenario = log.scenario
    file_name = Path(log.source).name
    if not file_name.endswith(".mcap"):
        file_name = "FILE"
    is_shipped = (
        scenario.name in list_shipped()
        and load_scenario(scenario.name).sha256 == scenario.sha256
    )
    argument = scenario.name if is_shipped else f"./{scenario.name}.toml"
    hint = "as shipped" if is_shipped else f"to be saved as {scenario.name}.toml"
    commands = (
        f"trilat verify {file_name}\ntrilat verify --virtual {file_name}\ntrilat sim {argument}"
    )
    return (
        f"<pre>{escape(commands)}</pre>"
        f"<details><summary>The resolved scenario, {escape(hint)}</summary>"
        f"<pre>{escape(scenario.text)}</pre></details>"
    )


def _render_versions(log: Log) -> str:
    """Returns the table of the software and the platform that produced the log."""
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
    """Returns a number as text, integers with all digits; a dash for None."""
    if value is None:
        return _NO_NUMBER
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def _format_numbers(values: Iterable[float] | None) -> str:
    """Returns numbers with four decimals as one text; a dash for None."""
    if values is None:
        return _NO_NUMBER
    return ", ".join(f"{value:.4f}" for value in values)


def _to_percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _label_site(log: Log, name: str) -> str:
    role = log.scenario.sites[name].role
    return f"{_render_swatch(log, name)}{escape(name)} ({escape(role)})"


def _label_link(log: Log, link: str) -> str:
    peer, site = link.split("->")
    return f"{_render_swatch(log, peer)}{escape(peer)} → {escape(site)}"


def _render_swatch(log: Log, site: str) -> str:
    """Returns a small square in the colour of a site."""
    return f'<span class="swatch fill-{log.sites.index(site)}"></span>'


def _render_note(text: str) -> str:
    return f'<p class="note">{escape(text)}</p>'


def _render_facts(facts: Iterable[tuple[str, str]]) -> str:
    """Returns a table with a row per fact: its name and its text."""
    rows = ""
    for name, text in facts:
        rows += f"<tr><th>{escape(name)}</th><td>{escape_text(text)}</td></tr>"
    return f'<table class="facts">{rows}</table>'


def _render_table(
    headers: Sequence[str], rows: Iterable[Sequence[str]], text_columns: Sequence[int] = ()
) -> str:
    """Returns a table of HTML cells.

    Args:
        headers: the header of each column, as plain text.
        rows: rows of cells as HTML, a cell per column.
        text_columns: indices of the columns, other than the first, that hold no numbers.
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
