"""The page's words and tables, as HTML.

Law: every text that a scenario or a log brought along is escaped here, cell by cell.
"""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

from ..log.reader import Log
from ..scenario import Scenario, load, shipped
from .summary import Facts


class VerdictLine(NamedTuple):
    """What a check of a log showed, in words.

    Attributes:
        label: what was checked.
        text: how it came out.
        passed: whether it is as it should be.
    """

    label: str
    text: str
    passed: bool


def verdicts_html(verdicts: Sequence[VerdictLine]) -> str:
    """Returns the list of verdicts; "" where nothing was checked."""
    items = ""
    for line in verdicts:
        kind, mark = ("passed", "✓ ok") if line.passed else ("failed", "✗ failed")
        items += f'<li class="{kind}"><b>{mark}</b>{escape(line.label)}: {escape(line.text)}</li>'
    return f'<ul class="verdicts">{items}</ul>' if items else ""


def about_html(scenario: Scenario) -> str:
    """Returns the scenario's description, a paragraph for every one of its own."""
    paragraphs = scenario.about.strip().split("\n\n")
    return "".join(f"<p>{escape(text)}</p>" for text in paragraphs if text)


def facts_html(log: Log, facts: Facts) -> str:
    """Returns the table of what the run was."""
    scenario = log.scenario
    rows = [
        ("scenario", f"{scenario.name}, sha256 {scenario.sha256[:16]}"),
        ("driven by", _driven(log)),
        ("length", f"{scenario.duration_s:g} s; scheme {scenario.scheme}; seed {scenario.seed}"),
        ("records", f"{facts['records']}, {facts['missing']} missing" + _torn(log)),
        ("largest error at the end", f"{number(facts['max_error_end_rad'])} rad in the last second"),
        ("settled", _settled(facts)),
        ("dominance", _dominance(scenario)),
        ("diverged", "yes" if facts["diverged"] else "no"),
    ]
    return _facts(rows)


def sites_html(log: Log, facts: Facts) -> str:
    """Returns the table of the sites: their records, and how they moved."""
    return table(_SITE_HEADS, [_site_row(log, facts, name) for name in log.sites])


def loops_html(log: Log, facts: Facts) -> str:
    """Returns the table of how the loops kept time; "" in virtual time, which keeps none."""
    if log.driver == "virtual":
        return ""
    rows = []
    for name in log.sites:
        site: Facts = facts["sites"][name]
        late, busy = site["late_us"], site["busy_us"]
        values = [*(late[key] for key in ("p50", "p99", "p99_9", "max"))]
        values += [*(busy[key] for key in ("p50", "p99", "max")), site["overruns"]]
        rows.append([_site_label(log, name), *("–" if v is None else f"{v:.0f}" for v in values)])
    return table(_LOOP_HEADS, rows)


def _site_row(log: Log, facts: Facts, name: str) -> list[str]:
    site: Facts = facts["sites"][name]
    cells = [
        str(site["records"]),
        str(site["missing"]),
        _numbers(site["q_end_rad"]),
        number(site["max_error_rad"]),
        number(site["max_error_end_rad"]),
        number(site["settle_s"]),
        number(site["peak_tau_nm"]),
        str(site["saturated_ticks"]),
        _numbers(site["hands_moved_max_rad"]),
    ]
    return [_site_label(log, name), *map(escape, cells)]


def assumed_html(scenario: Scenario) -> str:
    """Returns what the scenario assumes beyond its source."""
    if not scenario.assumed:
        return "<p>Nothing is declared as assumed.</p>"
    return f"<ul>{''.join(f'<li>{escape(text)}</li>' for text in scenario.assumed)}</ul>"


def again_html(log: Log) -> str:
    """Returns the commands that check and repeat the run, and the resolved scenario."""
    scenario = log.scenario
    source = Path(log.source).name
    file = source if source.endswith(".mcap") else "FILE"
    known = scenario.name in shipped() and load(scenario.name).sha256 == scenario.sha256
    which = scenario.name if known else f"./{scenario.name}.toml"
    commands = f"trilat verify {file}\ntrilat verify --virtual {file}\ntrilat sim {which}"
    hint = "as shipped" if known else f"to be saved as {scenario.name}.toml"
    return (
        f"<pre>{escape(commands)}</pre>"
        f"<details><summary>The resolved scenario, {escape(hint)}</summary>"
        f"<pre>{escape(scenario.text)}</pre></details>"
    )


def versions_html(log: Log) -> str:
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


def _settled(facts: Facts) -> str:
    limit = f"every |e| below {facts['settle_below_rad']:g} rad"
    return "not within the run" if facts["settle_s"] is None else f"{limit} from {facts['settle_s']:.3f} s on"


def _dominance(scenario: Scenario) -> str:
    rows = [
        f"{site} follows " + ", ".join(f"{peer} {share:g}" for peer, share in shares.items() if share)
        for site, shares in scenario.dominance.items()
    ]
    return "; ".join(rows)


def number(value: float | None) -> str:
    """Returns a number as cells show it; a dash where there is none."""
    return "–" if value is None else f"{value:.4g}"


def _numbers(values: Iterable[float] | None) -> str:
    return "–" if values is None else ", ".join(f"{value:.4f}" for value in values)


def _site_label(log: Log, name: str) -> str:
    return f"{swatch(log, name)}{escape(name)} ({escape(log.scenario.sites[name].role)})"


def swatch(log: Log, name: str) -> str:
    """Returns a little square in the colour of a site."""
    return f'<span class="swatch fill-{log.sites.index(name)}"></span>'


def _facts(rows: Iterable[tuple[str, Any]]) -> str:
    lines = "".join(f"<tr><th>{escape(key)}</th><td>{escape(str(value))}</td></tr>" for key, value in rows)
    return f'<table class="facts">{lines}</table>'


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], words: Sequence[int] = ()) -> str:
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
