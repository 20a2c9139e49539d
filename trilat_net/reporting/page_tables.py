"""HTML tables and paragraphs of the report page: run, sites, loops, links, clocks, changes, versions.

Invariant: every text from a scenario or a log is escaped here, cell by cell. Empty tables are left out.
"""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any

from ..analysis.run_summary import JsonObject
from ..execution.log_checks import CheckLine
from ..log.log_reader import Log
from ..scenario import Scenario, list_shipped, load_scenario


def render_check_lines(verdicts: Sequence[CheckLine]) -> str:
    """Returns the list of verdicts; "" where nothing was checked."""
    items = ""
    for line in verdicts:
        kind, mark = ("passed", "✓ ok") if line.passed else ("failed", "✗ failed")
        items += f'<li class="{kind}"><b>{mark}</b>{escape(line.label)}: {escape(line.text)}</li>'
    return f'<ul class="verdicts">{items}</ul>' if items else ""


def render_description(scenario: Scenario) -> str:
    """Returns the scenario's description, a paragraph for every one of its own."""
    paragraphs = scenario.about.strip().split("\n\n")
    return "".join(f"<p>{escape(text)}</p>" for text in paragraphs if text)


def render_run_facts(log: Log, facts: JsonObject) -> str:
    """Returns the table of what the run was."""
    scenario = log.scenario
    rows = [
        ("scenario", f"{scenario.name}, sha256 {scenario.sha256[:16]}"),
        ("driven by", _driven(log)),
        ("length", f"{scenario.duration_s:g} s; scheme {scenario.scheme}; seed {scenario.seed}"),
        ("records", f"{facts['records']}, {facts['missing']} missing" + _torn(log)),
        ("largest error at the end", f"{format_cell(facts['max_error_end_rad'])} rad in the last second"),
        ("settled", _settled(facts)),
        ("dominance", _dominance(scenario)),
        ("diverged", "yes" if facts["diverged"] else "no"),
    ]
    return _facts(rows)


def render_sites(log: Log, facts: JsonObject) -> str:
    """Returns the table of the sites: their records, and how they moved."""
    return render_html_table(_SITE_HEADS, [_site_row(log, facts, name) for name in log.sites])


def render_loops(log: Log, facts: JsonObject) -> str:
    """Returns the table of how the loops kept time; "" in virtual time, which keeps none."""
    if log.driver == "virtual":
        return ""
    rows = []
    for name in log.sites:
        site: JsonObject = facts["sites"][name]
        late, busy = site["late_us"], site["busy_us"]
        values = [*(late[key] for key in ("p50", "p99", "p99_9", "max"))]
        values += [*(busy[key] for key in ("p50", "p99", "max")), site["overruns"]]
        rows.append([_site_label(log, name), *("–" if v is None else f"{v:.0f}" for v in values)])
    return render_html_table(_LOOP_HEADS, rows)


def _site_row(log: Log, facts: JsonObject, name: str) -> list[str]:
    site: JsonObject = facts["sites"][name]
    cells = [
        str(site["records"]),
        str(site["missing"]),
        _numbers(site["q_end_rad"]),
        format_cell(site["max_error_rad"]),
        format_cell(site["max_error_end_rad"]),
        format_cell(site["settle_s"]),
        format_cell(site["peak_tau_nm"]),
        str(site["saturated_ticks"]),
        _numbers(site["hands_moved_max_rad"]),
    ]
    return [_site_label(log, name), *map(escape, cells)]


def render_assumptions(scenario: Scenario) -> str:
    """Returns what the scenario assumes beyond its source."""
    if not scenario.assumed:
        return "<p>Nothing is declared as assumed.</p>"
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in scenario.assumed)}</ul>"


def render_commands(log: Log) -> str:
    """Returns the commands that check and repeat the run, and the resolved scenario."""
    scenario = log.scenario
    source = Path(log.source).name
    file = source if source.endswith(".mcap") else "FILE"
    known = scenario.name in list_shipped() and load_scenario(scenario.name).sha256 == scenario.sha256
    which = scenario.name if known else f"./{scenario.name}.toml"
    commands = f"trilat verify {file}\ntrilat verify --virtual {file}\ntrilat sim {which}"
    hint = "as shipped" if known else f"to be saved as {scenario.name}.toml"
    return (
        f"<pre>{escape(commands)}</pre>"
        f"<details><summary>The resolved scenario, {escape(hint)}</summary>"
        f"<pre>{escape(scenario.text)}</pre></details>"
    )


def render_versions(log: Log) -> str:
    """Returns the table of what made the log."""
    session = log.session
    names = [key for key in session if key.startswith("version_")]
    commit = session.get("commit", "unknown")
    changed = " with changes" if session.get("commit_dirty") == "true" else ""
    rows = [
        ("commit", commit + changed),
        ("fingerprint of arithmetic", session.get("fingerprint", "unknown")),
        ("platform", f"{session.get('platform', 'unknown')}, {session.get('python', 'unknown')}"),
        *((name.removeprefix("version_"), session[name]) for name in names),
    ]
    return _facts(rows)


def _driven(log: Log) -> str:
    if log.driver == "virtual":
        return "virtual time"
    if log.driver == "rerun":
        sites, source = (log.session.get(f"rerun_{key}", "") for key in ("executed", "of"))
        return f"rerun of {source or 'a log'}: {sites.replace(' ', ', ')} executed afresh"
    epoch_ns = int(log.session.get("epoch_unix_ns", "0"))
    began = datetime.fromtimestamp(epoch_ns // 10**9, UTC)
    return f"live, session {log.session.get('session', '')}, epoch {began:%Y-%m-%d %H:%M:%S} UTC"


def _torn(log: Log) -> str:
    return "" if log.complete else "; the file was not finished"


def _settled(facts: JsonObject) -> str:
    limit = f"every |e| below {facts['settle_below_rad']:g} rad"
    return "not within the run" if facts["settle_s"] is None else f"{limit} from {facts['settle_s']:.3f} s on"


def _dominance(scenario: Scenario) -> str:
    rows = [
        f"{site} follows " + ", ".join(f"{peer} {share:g}" for peer, share in shares.items() if share)
        for site, shares in scenario.dominance.items()
    ]
    return "; ".join(rows)


def format_cell(value: float | None) -> str:
    """Returns a number as cells show it; a dash where there is none."""
    return "–" if value is None else f"{value:.4g}"


def _numbers(values: Iterable[float] | None) -> str:
    return "–" if values is None else ", ".join(f"{value:.4f}" for value in values)


def _site_label(log: Log, name: str) -> str:
    return f"{colour_swatch(log, name)}{escape(name)} ({escape(log.scenario.sites[name].role)})"


def colour_swatch(log: Log, name: str) -> str:
    """Returns a little square in the colour of a site."""
    return f'<span class="swatch fill-{log.sites.index(name)}"></span>'


def _facts(rows: Iterable[tuple[str, Any]]) -> str:
    lines = "".join(f"<tr><th>{escape(key)}</th><td>{escape(str(value))}</td></tr>" for key, value in rows)
    return f'<table class="facts">{lines}</table>'


def render_html_table(heads: Sequence[str], rows: Iterable[Sequence[str]], words: Sequence[int] = ()) -> str:
    """Returns a table.

    Args:
        heads: of its columns; ours, plain text.
        rows: their cells, HTML already.
        words: the columns besides the first that hold words instead of numbers.
    """
    kinds = [' class="words"' if n in words else "" for n in range(len(heads))]
    head = "".join(f"<th{kind}>{escape(text)}</th>" for kind, text in zip(kinds, heads, strict=True))
    body = "".join(
        f"<tr>{''.join(f'<td{kind}>{cell}</td>' for kind, cell in zip(kinds, row, strict=True))}</tr>"
        for row in rows
    )
    return f'<table class="sites"><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>'


_SITE_HEADS = (
    "site",
    "records",
    "missing",
    "q at the end (rad)",
    "max |e| (rad)",
    "max |e|, last 1 s (rad)",
    "settled (s)",
    "max |τ| (N\u00a0m)",
    "ticks at the limit",
    "moved by hands, max (rad)",
)
_LOOP_HEADS = (
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


def render_link_ages(log: Log, facts: JsonObject) -> str:
    """Returns the table of the links: what was stated, and what the controller saw."""
    rows = []
    for name, link in facts["links"].items():
        age: JsonObject = link["age_ms"]
        cells = [age["mean"], age["deviation"], *(age[key] for key in ("p50", "p99", "min", "max"))]
        share = link["ticks_without_new"]
        cells += [None if share is None else 100.0 * share, link["silence_ms"]]
        rows.append([_label(log, name), _stated(link), *map(_cell, cells)])
    return render_html_table(_AGE_HEADS, rows, words=[1])


def render_link_samples(log: Log, facts: JsonObject) -> str:
    """Returns the table of what became of the samples, with measured delays where there are any."""
    links: dict[str, JsonObject] = facts["links"]
    measured = any(link["one_way_us"] for link in links.values())
    rows = []
    for name, link in links.items():
        counts: JsonObject = link["samples"] or {}
        cells = [counts.get(key) for key in _COUNTS]
        loss = link["loss"]
        cells += [None if loss is None else 100.0 * loss, link["burst"]]
        if measured:
            way: JsonObject = link["one_way_us"] or {}
            clock: JsonObject = link["clock"] or {}
            cells += [*(way.get(key) for key in ("min", "p50", "p99", "max")), clock.get("bound_p50_us")]
        rows.append([_label(log, name), *map(_cell, cells)])
    return render_html_table([*_SAMPLE_HEADS, *(_WAY_HEADS if measured else ())], rows)


def render_clocks(log: Log, facts: JsonObject) -> str:
    """Returns the table of the clocks as sites saw them; "" where all read the same one."""
    rows = []
    for name, link in facts["links"].items():
        clock: JsonObject = link["clock"] or {}
        if clock and (clock["bound_max_us"] or clock["offset_us"]):
            rows.append([_label(log, name), *(_cell(clock[key]) for key in _CLOCK_KEYS)])
    return render_html_table(_CLOCK_HEADS, rows) if rows else ""


def render_changes(facts: JsonObject) -> str:
    """Returns the table of what was changed while it ran; "" where nothing was."""
    rows = []
    for n, changed in enumerate(facts["changes"], 1):
        tick = changed["taken_at_tick"]
        by = "scenario" if tick is None else f"ordered, taken in at tick {tick} of {changed['site']}"
        at_s = format_cell(changed["at_s"])
        rows.append([str(n), _typeset(changed["about"]), at_s, _typeset(changed["to"]), escape(by)])
    return render_html_table(_CHANGE_HEADS, rows, words=[1, 3, 4]) if rows else ""


def render_modes(log: Log, facts: JsonObject) -> str:
    """Returns the table of when sites held, braked or returned; "" where none did."""
    rows = [
        [
            f"{colour_swatch(log, name)}{escape(name)}",
            span["mode"],
            f"{span['from_s']:.3f}",
            f"{span['to_s']:.3f}",
        ]
        for name, site in facts["sites"].items()
        for span in site["modes"][:_MOST]
    ]
    return render_html_table(("site", "mode", "from (s)", "to (s)"), rows, words=[1]) if rows else ""


def _label(log: Log, link: str) -> str:
    peer, site = link.split("->")
    return f"{colour_swatch(log, peer)}{escape(peer)} → {escape(site)}"


def _stated(link: JsonObject) -> str:
    first, *later = link["stated"]
    words = [first["link"], *(f"from {state['from_s']:g} s: {state['link']}" for state in later)]
    return "<br>".join(map(_typeset, words))


def _typeset(text: str) -> str:
    return escape(text.replace("+-", "±").replace("->", " → "))


def _cell(value: float | None) -> str:
    if isinstance(value, int):
        return str(value)
    return format_cell(value)


_MOST = 200
_COUNTS = ("sent", "missing", "lost", "late", "superseded", "duplicate", "copies")
_CLOCK_KEYS = (
    "offset_us",
    "offset_first_us",
    "drift_ppm",
    "drift_bound_ppm",
    "bound_us",
    "bound_p50_us",
    "bound_max_us",
    "rtt_min_us",
    "faults",
)
_AGE_HEADS = (
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
_SAMPLE_HEADS = (
    "link",
    "samples sent",
    "missing on the way",
    "lost by the model",
    "late",
    "superseded",
    "duplicates",
    "of the model",
    "lost in all (%)",
    "in a row",
)
_WAY_HEADS = ("one way, min (µs)", "p50", "p99", "max", "known to, p50 (µs)")
_CLOCK_HEADS = (
    "clock of the sender",
    "ahead at the end (µs)",
    "at the start",
    "drift (ppm)",
    "known to (ppm)",
    "offset known to, end (µs)",
    "p50",
    "max",
    "round trip, min (µs)",
    "faults",
)
_CHANGE_HEADS = ("no.", "what", "from (s)", "becomes", "by")
