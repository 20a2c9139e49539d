"""Prints the contents of a log: session, missing records, sites, links, channels, accounts, files.

Invariant: text from the file passes `sanitize` before it reaches a terminal.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Any

from rich.markup import escape

from .terminal_output import out, print_table, sanitize
from .text_table import TextTable

JsonObject = dict[str, Any]

_MOST_GAPS = 4
_VIEWS = "/viz/"
_TROUBLE = re.compile(r"(missing|duplicate|reordered|refilled|overflowed) [1-9]")


def print_overview(facts: JsonObject) -> None:
    """Prints what `analysis.overview` tells."""
    session: JsonObject | None = facts["session"]
    if session is not None:
        _show_session(facts, session)
        _show_sites(facts["sites"])
        _show_links(facts["links"])
    elif facts["problem"]:
        out.print(f"[red]cannot be opened:[/red] {escape(sanitize(facts['problem']))}", soft_wrap=True)
    channels: dict[str, JsonObject] = facts["channels"]
    views = {topic: channel for topic, channel in channels.items() if topic.startswith(_VIEWS)}
    own = {topic: channel for topic, channel in channels.items() if topic not in views}
    _show_channels(own, session)
    _show_views(views)
    if session is not None:
        _show_accounts(session)
        _show_origin(session)
    _show_files(facts["files"])


def _lines(rows: Iterable[tuple[str, str]]) -> None:
    for head, text in rows:
        if text:
            out.print(f"[bold]{head:<9}[/bold] {escape(sanitize(text))}", soft_wrap=True)


def _show_session(facts: JsonObject, session: JsonObject) -> None:
    scenario: JsonObject = session["scenario"]
    sites: dict[str, JsonObject] = facts["sites"]
    missing = sum(site["missing"] for site in sites.values())
    records = sum(site["records"] for site in sites.values())
    began = f", began {session['began_utc']} UTC" if session["began_utc"] else ""
    changed = "" if scenario["as_named"] else "; NOT the text whose hash the session names"
    finished = all(file["finished"] for file in facts["files"])
    damaged = sum(len(file["damaged"]) for file in facts["files"])
    whole = "finished" if finished else "not finished"
    _lines(
        [
            ("session", f"{session['session']}, {session['driver']}{began}"),
            (
                "scenario",
                f"{scenario['name']}: {scenario['title']}" if scenario["title"] else scenario["name"],
            ),
            ("", f"seed {scenario['seed']}, sha256 {scenario['sha256'][:16]}{changed}"),
            ("duration", f"{session['recorded_s']:.3f} s of {scenario['duration_s']:g} s"),
            (
                "records",
                f"{records}, {missing or 'none'} missing; {whole}"
                + (f"; damaged in {damaged} place{'s' * (damaged > 1)}" if damaged else ""),
            ),
        ]
    )


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]], words: int = 1) -> None:
    """Prints a table; its first columns hold words, the others numbers."""
    out.print()
    cells = [["-" if value is None else str(value) for value in row] for row in rows]
    print_table(TextTable(heads, cells, "l" * words + "r"))


def _show_sites(sites: dict[str, JsonObject]) -> None:
    rows: list[list[object]] = []
    for name, site in sites.items():
        of = site["expected_ticks"] if site["made_ticks"] is None else site["made_ticks"]
        row = [name, site["role"], site["rate_hz"], site["records"], of, site["missing"]]
        rows.append([*row, site["overruns"]])
    _table(("site", "role", "rate Hz", "records", "of", "missing", "overruns"), rows, words=2)
    if any(site["late_us"] for site in sites.values()):
        heads = ("loop", "late us p50", "p99", "max", "busy us p50", "p99", "max")
        loops = [(name, *_three(s["late_us"]), *_three(s["busy_us"])) for name, s in sites.items()]
        _table(heads, loops)


def _show_links(links: dict[str, JsonObject]) -> None:
    measured = any(link["one_way_ms"] for link in links.values())
    clocks = any(link["clock_bound_us"] for link in links.values())
    heads = ["link", "age ms p50", "p99", "max"]
    heads += ["one way ms p50", "p99", "max"] if measured else []
    heads += ["clock us", "+-"] if clocks else []
    rows: list[list[object]] = []
    for name, link in links.items():
        row = [name, *_three(link["age_ms"])]
        row += _three(link["one_way_ms"]) if measured else []
        row += [link["clock_offset_us"], link["clock_bound_us"]] if clocks else []
        rows.append([*row, link["late"], link["lost"], link["duplicate"]])
    _table([*heads, "late", "lost", "twice"], rows)


def _show_views(views: dict[str, JsonObject]) -> None:
    """Prints the channels that show to viewers what others hold."""
    if views:
        heads = ("view, for other tools", "messages", "rate Hz", "size", "as")
        facts = [
            (topic, v["messages"], _number(v["rate_hz"]), _size(v["bytes"]), v["schema"].rpartition("/")[2])
            for topic, v in views.items()
        ]
        _table(heads, facts)


def _show_channels(channels: dict[str, JsonObject], session: JsonObject | None) -> None:
    if not channels:
        return
    prefix = f"/trilat/{session['session']}/" if session else ""
    rows = [
        (
            topic.removeprefix(prefix) or "(none)",
            channel["messages"],
            _number(channel["rate_hz"]),
            _size(channel["bytes"]),
            channel["missing"],
            *_three(channel["between_ms"]),
        )
        for topic, channel in channels.items()
    ]
    _table(("channel", "messages", "rate Hz", "size", "missing", "apart ms p50", "p99", "max"), rows)
    for topic, channel in channels.items():
        if channel["gaps"]:
            words = [f"{a}-{b}" if b > a else str(a) for a, b in channel["gaps"][:_MOST_GAPS]]
            more = len(channel["gaps"]) - _MOST_GAPS
            text = f"{topic.removeprefix(prefix)} lacks {', '.join(words)}"
            out.print(
                escape(sanitize(text + (f" and {more} more ranges" if more > 0 else ""))), soft_wrap=True
            )


def _show_accounts(session: JsonObject) -> None:
    """Prints what the recorder wrote of each channel of which something is to be said."""
    accounts: dict[str, str] = session["accounts"]
    prefix = f"/trilat/{session['session']}/"
    out.print()
    if not accounts:
        out.print("no accounts: the recording did not come to its end")
        return
    telling = {topic: text for topic, text in accounts.items() if _TROUBLE.search(text) or ":" in topic}
    plain = len(accounts) - len(telling)
    if plain:
        out.print(f"the recorder accounts for {plain} channels without a fault")
    for topic, text in telling.items():
        out.print(f"{escape(sanitize(topic.removeprefix(prefix)))}: {escape(sanitize(text))}", soft_wrap=True)


def _show_origin(session: JsonObject) -> None:
    versions: dict[str, str] = session["versions"]
    dirty = {"true": " with changes", "false": ""}.get(session["commit_dirty"] or "", " (changes unknown)")
    ours = versions.get("trilat-net", "unknown")
    others = ", ".join(f"{name} {version}" for name, version in versions.items() if name != "trilat-net")
    out.print()
    _lines(
        [
            ("made by", f"trilat-net {ours}, commit {(session['commit'] or 'unknown')[:12]}{dirty}"),
            ("on", f"{session['platform']}, {session['python']}, arithmetic {session['fingerprint']}"),
            ("with", others),
            ("schema", f"version {session['schema_version']}"),
        ]
    )


def _show_files(files: list[JsonObject]) -> None:
    for file in files:
        kinds = (
            ", ".join(f"{count} chunks {name}" for name, count in file["compression"].items()) or "no chunks"
        )
        ratio = file["unpacked_bytes"] / file["packed_bytes"] if file["packed_bytes"] else 1.0
        end = "finished" if file["finished"] else f"cut off at byte {file['cut_off_at_byte']}"
        part = f", part {file['part'].get('index', '?')}" if file["part"] else ""
        text = f"{file['path']}{part}: {_size(file['size_bytes'])}, {kinds} ({ratio:.1f} : 1), {end}"
        _lines([("file", text)])
        for damage in file["damaged"][:_MOST_GAPS]:
            _lines([("", f"byte {damage['offset']}, {damage['length']} bytes: {damage['problem']}")])


def _three(spread: JsonObject | None) -> list[str | None]:
    return [None if spread is None else _number(spread[key]) for key in ("p50", "p99", "max")]


def _number(value: float | None) -> str | None:
    """Returns a number with four digits, or all that it has before the point."""
    if value is None:
        return None
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def _size(count: int) -> str:
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} B"
