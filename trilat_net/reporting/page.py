"""Write the report of a log: `report.html` and `summary.json`.

Invariant: the page is one file with images, styles and scripts inside; it loads nothing from a
network. Every text from a scenario or a log is escaped here, cell by cell. Empty tables are
left out.
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

from ..analysis.certificate.stability_certificate import Certificate
from ..analysis.file_overview import summarise_run
from ..analysis.site_signals import shared_unit
from ..analysis.timeline import list_alarms
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
from .charts import Charts
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

_WORDS: dict[str, dict[str, Any]] = tomllib.loads(
    (_ASSETS / "report.toml").read_text(encoding="utf-8")
)
"""Headings and notes of the page."""
_CODE = re.compile(r"`([^`]+)`")
_MOST_MODES = 200
"""Intervals of a site that are listed."""
_MOST_ALARMS = 8
"""Alarms that are shown in large."""
_WORST = ("FAULT", "STOPPED")
_NO_VALUE = "the log has no value to draw"
_PREMISE_MARKS = {
    True: "holds",
    False: '<span style="color:var(--bad)">fails</span>',
    None: "not told",
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

    The certificate's pictures are made before the verdicts are read, which may still be in the
    making. Without `twin`, the same experiment without operators, the page has no motion due to
    them.
    """
    make_folder(folder)
    facts = summarise_run(log, twin)
    facts["certificate"] = certificate.to_dict()
    section = _render_certificate(certificate)
    mark, text = describe_certificate(certificate)[0]
    kind, shown = {"ok": ("passed", "✓ "), "FAIL": ("failed", "✗ ")}.get(mark, ("open", "? "))
    found = f'<li class="{kind}"><b>{shown}</b>stability: {escape(text)}</li>'
    verdict = f'<ul class="verdicts">{found}</ul>'
    pictures = []
    if certificate.balance is not None:
        pictures.append(("V and energies", draw_functional(log, certificate)))
    if certificate.observed is not None and certificate.observed.curves:
        drawn = draw_observed_energy(log, certificate.observed)
        pictures.append(("energies that the laws declare", drawn))
    if certificate.twins is not None and certificate.twins.pushes:
        pictures.append(
            (
                "what became of small pushes",
                draw_twins(PushedTwins(log, 0.0, certificate.twins)),
            )
        )
    for words, drawn in pictures:
        stream = io.BytesIO()
        drawn.savefig(stream, format="png", dpi=_PAGE_DPI)
        data = base64.b64encode(stream.getvalue()).decode()
        section += f'<img src="data:image/png;base64,{data}" alt="{words}" class="picture">'
    section = f"<section><h2>Was it stable, and why</h2>{section}</section>"
    lines = list(verdicts)
    facts["checks"] = [line.to_row() for line in lines]
    page = folder / "report.html"
    numbers = folder / "summary.json"
    write_whole(
        page,
        render_report(
            log=log,
            twin=twin,
            verdicts=lines,
            facts=facts,
            certificate=section,
            verdict=verdict,
        ),
    )
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
    """Returns the page of a log, of facts from `summarise_run`; `certificate` is its section,
    as HTML.

    The page begins with `verdict`, as HTML too.
    """
    scenario = log.scenario
    drawn = Charts(log, twin)
    data, missing = drawn.data()
    return Template(_asset("report.html")).substitute(
        name=escape(scenario.name),
        title=escape(scenario.title or scenario.name),
        about=_render_description(scenario),
        verdicts=verdict + render_alarms(log) + _render_check_lines(verdicts),
        facts=_render_run_facts(log, facts),
        sites=_render_sites(log, facts),
        loops=_render_loops(log, facts),
        links=_links(log, facts),
        arms=_render_arms(log, drawn),
        sections=certificate + _sections(log, data.charts, missing),
        assumed=_render_assumptions(scenario),
        again=_render_commands(log),
        versions=_render_versions(log),
        licence=escape(_asset("uPlot-LICENSE")),
        # what ends a script element early cannot stand in JSON with this escape, which means the same
        data=_json(data.to_builtins()).replace("<", "\\u003c"),
        css=_asset("report.css"),
        site_css=_site_css(log),
        js=_asset("report.js") + _asset("arms.js"),
        uplot_css=_asset("uPlot.min.css"),
        uplot_js=_asset("uPlot.iife.min.js"),
    )


_ARM_PLAYER = """<div id="arms" class="screen">
<div class="row"></div>
<div class="controls"><button type="button">play</button>
<input type="range" min="0" max="1000" value="0" step="1" aria-label="time"><output>0.000 s</output></div>
</div>
<p class="note">Solid: the arm; dashed: the reference of Eq. (6). Above, the arms follow the slider and the
pointer in any chart. Below, a few instants, with the path of the end effector until then.</p>
"""


def _render_arms(log: Log, drawn: Charts) -> str:
    """Returns the player of the arms and their pictures, and which sites have no record to
    draw.
    """
    html = ""
    if any(len(log[site]) for site in log.sites):
        html = _ARM_PLAYER + render_arms_svg(log, drawn.bounds_m, drawn.factor)
    absent = [site for site in log.sites if not len(log[site])]
    if absent:
        html += f'<p class="note">Not drawn, because there is no record: {escape(", ".join(absent))}.</p>'
    return html


def _sections(log: Log, drawn: Sequence[Chart], missing: Mapping[str, Sequence[str]]) -> str:
    """Returns the sections of charts, and which charts the page lacks and why.

    Args:
        log: the log.
        drawn: the charts of the page.
        missing: by section, the titles of charts for which the log has no value.
    """
    filled = {chart.section for chart in drawn}
    chains = any(arm.chain for arm in log.scenario.arms.values())
    absent = {
        "torques": explain_absent_operator(log),
        "timing": explain_missing_loop_times(log),
    }
    html = ""
    reasons: list[str] = []
    for key, (heading, sentence) in _WORDS["charts"].items():
        if key in filled:
            kind = "charts small" if key == "estimates" and chains else "charts"
            if chains and key == "estimates":
                sentence = _WORDS["notes"]["chain_estimates"]
            body = f'<p class="note">{escape(sentence)}</p><div class="{kind}" data-section="{key}"></div>'
            html += f"<section><h2>{escape(heading)}</h2>{body}</section>"
            reasons += [f"{title} ({_NO_VALUE})" for title in missing.get(key, ())]
        elif absent.get(key):
            reasons.append(f"{heading.lower()} ({absent[key]})")
        elif key in missing:
            reasons.append(f"{heading.lower()} ({_NO_VALUE})")
    return html + (
        f'<p class="note">Not on this page: {escape("; ".join(reasons))}.</p>'
        if reasons
        else ""
    )


def _links(log: Log, facts: JsonObject) -> str:
    tables = {
        "ages": _render_link_ages(log, facts),
        "samples": _render_link_samples(log, facts),
        "clocks": _render_clocks(log, facts),
        "changes": _render_changes(facts),
        "modes": _render_modes(log, facts),
    }
    return "".join(
        f'<p class="note">{escape(_WORDS["notes"][name])}</p><div class="scroll">{table}</div>'
        for name, table in tables.items()
        if table
    )


def _site_css(log: Log) -> str:
    light, dark = (
        "".join(
            f".site-{n} {{ stroke: {palette[n % len(palette)]}; }} "
            f".fill-{n} {{ background: {palette[n % len(palette)]}; fill: {palette[n % len(palette)]}; }}\n"
            for n in range(len(log.sites))
        )
        for palette in (
            list_site_colours(log.scenario, some) for some in (SITE_COLOURS, DARK_SITE_COLOURS)
        )
    )
    return f"{light}@media screen and (prefers-color-scheme: dark) {{\n{dark}}}"


def _json(value: Any, indent: int | None = None) -> str:
    return json.dumps(value, allow_nan=False, ensure_ascii=False, indent=indent)


def _asset(name: str) -> str:
    return (_ASSETS / name).read_text(encoding="utf-8")


def _render_check_lines(verdicts: Sequence[Finding]) -> str:
    """Returns the list of verdicts; "" if nothing was checked."""
    items = ""
    for line in verdicts:
        bad = "✗ failed" if line.judged else "not judged"
        kind, mark = ("passed", "✓ ok") if line.passed else ("failed", bad)
        items += f'<li class="{kind}"><b>{mark}</b>{escape(line.check)}: {escape_text(line.text)}</li>'
    return f'<ul class="verdicts">{items}</ul>' if items else ""


def render_alarms(log: Log) -> str:
    """Returns the times in which sites were in fault, stopped or held, in large; "" if none
    was.
    """
    found = list_alarms(log)
    worst = [one for one in found if one.word in _WORST] or found
    more = len(found) - len(worst[:_MOST_ALARMS])
    items = "".join(
        f'<li class="{"" if one.word in _WORST else "mild"}"><strong>{escape(one.site)} {one.word}</strong>'
        f"{one.from_s:.3f} s to {one.to_s:.3f} s: {escape(one.reason)}</li>"
        for one in worst[:_MOST_ALARMS]
    )
    rest = f"<li class='mild'>and {more} more: see the table of modes</li>" if more else ""
    return f'<ul class="alarms">{items}{rest}</ul>' if items else ""


def _render_description(scenario: Scenario) -> str:
    text = _CODE.sub(r"<code>\1</code>", escape(scenario.about.strip()))
    return "".join(f"<p>{paragraph}</p>" for paragraph in text.split("\n\n") if paragraph)


def _render_run_facts(log: Log, facts: JsonObject) -> str:
    scenario = log.scenario
    torn = "" if log.complete else "; the file was not finished"
    if log.unknown_ends:
        torn += f"; {describe_unknown_ends(log.unknown_ends)}"
    unit = shared_unit(log)
    settled = "not within the run"
    if facts["settle_s"] is not None:
        settled = f"every |e| below {facts['settle_below_rad']:g} {unit} from {facts['settle_s']:.3f} s on"
    dominance = "; ".join(
        f"{site} follows "
        + ", ".join(f"{peer} {share:g}" for peer, share in shares.items() if share)
        for site, shares in scenario.dominance.items()
    )
    return _render_facts(
        ("scenario", f"{scenario.name}, sha256 {scenario.sha256[:16]}"),
        ("driven by", _describe_driver(log)),
        (
            "length",
            f"{scenario.duration_s:g} s; scheme {scenario.scheme}; seed {scenario.seed}",
        ),
        ("records", f"{facts['records']}, {facts['missing']} missing{torn}"),
        (
            "largest error at the end",
            f"{_format_cell(facts['max_error_end_rad'])} {unit} in the last second",
        ),
        ("settled", settled),
        ("dominance", dominance),
        ("diverged", "yes" if facts["diverged"] else "no"),
    )


def _render_sites(log: Log, facts: JsonObject) -> str:
    error = [f"max |e| ({shared_unit(log)})", f"max |e|, last 1 s ({shared_unit(log)})"]
    headers = ["site", "records", "missing", "q at the end (rad)", *error]
    headers += [
        "settled (s)",
        "max |τ| (N\u00a0m)",
        "ticks at the limit",
        "moved by operators, max (rad)",
    ]
    motion = (
        "max_error_rad",
        "max_error_end_rad",
        "settle_s",
        "peak_tau_nm",
        "saturated_ticks",
    )
    rows = []
    for name in log.sites:
        site: JsonObject = facts["sites"][name]
        counts = [
            str(site["records"]),
            str(site["missing"]),
            _format_numbers(site["q_end_rad"]),
        ]
        cells = [*counts, *(_format_cell(site[key]) for key in motion)]
        rows.append(
            [_label_site(log, name), *cells, _format_numbers(site["hands_moved_max_rad"])]
        )
    many = any(len(facts["sites"][name]["q_end_rad"] or ()) > 3 for name in log.sites)
    return _render_table(headers, rows, words=[3, 9] if many else [])


def _render_loops(log: Log, facts: JsonObject) -> str:
    """Returns the table of the loops' timing; "" in virtual time, which has none."""
    if log.driver == "virtual":
        return ""
    headers = ["loop", "late p50 (µs)", "late p99 (µs)", "late p99.9 (µs)", "late max (µs)"]
    headers += ["busy p50 (µs)", "busy p99 (µs)", "busy max (µs)", "overruns"]
    rows = []
    for name in log.sites:
        site: JsonObject = facts["sites"][name]
        values = [*(site["late_us"][key] for key in ("p50", "p99", "p99_9", "max"))]
        values += [*(site["busy_us"][key] for key in ("p50", "p99", "max")), site["overruns"]]
        rows.append(
            [_label_site(log, name), *("–" if v is None else f"{v:.0f}" for v in values)]
        )
    return _render_table(headers, rows)


def _render_link_ages(log: Log, facts: JsonObject) -> str:
    headers = [
        "link",
        "stated delay",
        "effective, mean (ms)",
        "deviation",
        "p50",
        "p99",
        "min",
        "max",
    ]
    headers += ["nothing new (% of ticks)", "longest silence (ms)"]
    rows = []
    for name, link in facts["links"].items():
        first, *later = link["stated"]
        stated = [
            first["link"],
            *(f"from {state['from_s']:g} s: {state['link']}" for state in later),
        ]
        ages = [
            link["age_ms"][key] for key in ("mean", "deviation", "p50", "p99", "min", "max")
        ]
        cells = [*ages, _percent(link["ticks_without_new"]), link["silence_ms"]]
        text = "<br>".join(escape(typeset(words)) for words in stated)
        rows.append([_label_link(log, name), text, *map(_format_cell, cells)])
    return _render_table(headers, rows, words=[1])


def _render_link_samples(log: Log, facts: JsonObject) -> str:
    """Returns the table of the delivery of samples, with measured delays if there are any."""
    headers = [
        "link",
        "samples sent",
        "missing on the way",
        "lost by the model",
        "late",
        "superseded",
    ]
    headers += ["duplicates", "of the model", "lost in all (%)", "in a row"]
    keys = ("sent", "missing", "lost", "late", "superseded", "duplicate", "copies")
    links: dict[str, JsonObject] = facts["links"]
    measured = any(link["one_way_us"] for link in links.values())
    if measured:
        headers += ["one way, min (µs)", "p50", "p99", "max", "known to, p50 (µs)"]
    rows = []
    for name, link in links.items():
        counts: JsonObject = link["samples"] or {}
        cells = [*map(counts.get, keys), _percent(link["loss"]), link["burst"]]
        if measured:
            way = link["one_way_us"] or {}
            clock = link["clock"] or {}
            cells += [*map(way.get, ("min", "p50", "p99", "max")), clock.get("bound_p50_us")]
        rows.append([_label_link(log, name), *map(_format_cell, cells)])
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
    """Returns the table of the clocks as sites saw them; "" if all read the same one."""
    rows = []
    for name, link in facts["links"].items():
        clock: JsonObject = link["clock"] or {}
        if clock and (clock["bound_max_us"] or clock["offset_us"]):
            rows.append(
                [_label_link(log, name), *(_format_cell(clock[key]) for key in _CLOCK_COLUMNS)]
            )
    return (
        _render_table(("clock of the sender", *_CLOCK_COLUMNS.values()), rows) if rows else ""
    )


def _render_changes(facts: JsonObject) -> str:
    """Returns the table of the changes during the run; "" without any."""
    rows = []
    for n, changed in enumerate(facts["changes"], 1):
        tick = changed["taken_at_tick"]
        origin = (
            "scenario"
            if tick is None
            else f"order, taken in at tick {tick} of {changed['site']}"
        )
        sentence = escape(typeset(changed["sentence"]))
        rows.append([str(n), _format_cell(changed["at_s"]), sentence, escape(origin)])
    headers = ("no.", "from (s)", "what happened", "origin")
    return _render_table(headers, rows, words=[2, 3]) if rows else ""


def _render_modes(log: Log, facts: JsonObject) -> str:
    """Returns the table of the times in which sites held, braked or returned; "" if none did."""
    rows = [
        [
            _swatch(log, name) + escape(name),
            span["mode"],
            f"{span['from_s']:.3f}",
            f"{span['to_s']:.3f}",
        ]
        for name, site in facts["sites"].items()
        for span in site["modes"][:_MOST_MODES]
    ]
    return (
        _render_table(("site", "mode", "from (s)", "to (s)"), rows, words=[1]) if rows else ""
    )


def _render_certificate(certificate: Certificate) -> str:
    cells = (
        (escape(p.name), _PREMISE_MARKS[p.holds], escape(p.text)) for p in certificate.premises
    )
    premises = "".join(
        f"<tr><th>{name}</th><th>{mark}</th><td>{text}</td></tr>" for name, mark, text in cells
    )
    first, *others = (escape(line.text) for line in describe_certificate(certificate))
    html = f"<p><strong>{first}</strong></p>" + "".join(f"<p>{text}</p>" for text in others)
    html += f'<div class="scroll"><table class="facts">{premises}</table></div>'
    if certificate.balance is None:
        return html
    rows = [
        (escape(name), f"{value:.4g}") for name, value in list_energies(certificate.balance)
    ]
    table = f'<div class="scroll">{_render_table(("energy", "J"), rows)}</div>'
    return f'{html}{table}<p class="note">{escape(_WORDS["notes"]["certificate"])}</p>'


def _render_assumptions(scenario: Scenario) -> str:
    texts = [*scenario.assumed, *list_arm_notes(scenario)]
    items = "".join(f"<li>{escape(text)}</li>" for text in texts)
    return f"<ul>{items}</ul>" if items else "<p>Nothing is declared as assumed.</p>"


def _render_commands(log: Log) -> str:
    scenario = log.scenario
    source = Path(log.source).name
    file = source if source.endswith(".mcap") else "FILE"
    known = (
        scenario.name in list_shipped()
        and load_scenario(scenario.name).sha256 == scenario.sha256
    )
    which = scenario.name if known else f"./{scenario.name}.toml"
    commands = f"trilat verify {file}\ntrilat verify --virtual {file}\ntrilat sim {which}"
    hint = "as shipped" if known else f"to be saved as {scenario.name}.toml"
    return (
        f"<pre>{escape(commands)}</pre>"
        f"<details><summary>The resolved scenario, {escape(hint)}</summary>"
        f"<pre>{escape(scenario.text)}</pre></details>"
    )


def _render_versions(log: Log) -> str:
    session = log.session
    changed = " with changes" if session.get("commit_dirty") == "true" else ""
    return _render_facts(
        ("commit", session.get("commit", "unknown") + changed),
        ("fingerprint of arithmetic", session.get("fingerprint", "unknown")),
        (
            "platform",
            f"{session.get('platform', 'unknown')}, {session.get('python', 'unknown')}",
        ),
        *(
            (k.removeprefix("version_"), v)
            for k, v in session.items()
            if k.startswith("version_")
        ),
    )


def _describe_driver(log: Log) -> str:
    if log.driver == "virtual":
        return "virtual time"
    if log.driver == "rerun":
        sites, source = (log.session.get(f"rerun_{key}", "") for key in ("executed", "of"))
        return f"rerun of {source or 'a log'}: {sites.replace(' ', ', ')} executed afresh"
    epoch_ns = int(log.session.get("epoch_unix_ns", "0"))
    began = datetime.fromtimestamp(epoch_ns // 10**9, UTC)
    return (
        f"live, session {log.session.get('session', '')}, epoch {began:%Y-%m-%d %H:%M:%S} UTC"
    )


def _format_cell(value: float | None) -> str:
    """Returns a number as cells show it, integers in full; a dash for None."""
    return "–" if value is None else str(value) if isinstance(value, int) else f"{value:.4g}"


def _format_numbers(values: Iterable[float] | None) -> str:
    return "–" if values is None else ", ".join(f"{value:.4f}" for value in values)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100.0 * share


def _label_site(log: Log, name: str) -> str:
    return f"{_swatch(log, name)}{escape(name)} ({escape(log.scenario.sites[name].role)})"


def _label_link(log: Log, link: str) -> str:
    peer, site = link.split("->")
    return f"{_swatch(log, peer)}{escape(peer)} → {escape(site)}"


def _swatch(log: Log, name: str) -> str:
    return f'<span class="swatch fill-{log.sites.index(name)}"></span>'


def _render_facts(*rows: tuple[str, str]) -> str:
    lines = "".join(
        f"<tr><th>{escape(key)}</th><td>{escape_text(value)}</td></tr>" for key, value in rows
    )
    return f'<table class="facts">{lines}</table>'


def _render_table(
    headers: Sequence[str], rows: Iterable[Sequence[str]], words: Sequence[int] = ()
) -> str:
    """Returns a table of rows in HTML; `words` are the columns besides the first that hold no
    numbers.
    """
    kinds = [' class="words"' if n in words else "" for n in range(len(headers))]
    head = "".join(
        f"<th{kind}>{escape(text)}</th>" for kind, text in zip(kinds, headers, strict=True)
    )
    body = "".join(
        f"<tr>{''.join(f'<td{kind}>{cell}</td>' for kind, cell in zip(kinds, row, strict=True))}</tr>"
        for row in rows
    )
    return f'<table class="sites"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'
