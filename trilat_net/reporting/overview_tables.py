"""The contents of a log as text: session, missing records, sites, links, channels, accounts,
files.

Invariant: text from the file passes `sanitize`.
"""

import re
from collections.abc import Iterable, Iterator, Sequence

from ..analysis.file_overview import FileOverview
from ..errors import count_nouns
from ..log.accounting import describe_unknown_ends
from ..results import JsonObject
from .result_text import Block, MarkedText, TextTable
from .terminal_output import sanitize

_MOST_GAPS = 4
_VIEWS = "/viz/"
_TROUBLE = re.compile(r"(missing|duplicate|reordered|refilled|overflowed) [1-9]")


def compose_overview(found: FileOverview) -> Iterator[Block]:
    """Yields what a file holds."""
    facts = found.facts
    session: JsonObject | None = facts["session"]
    if session is not None:
        yield from _compose_session(facts, session)
        yield from _compose_sites(facts["sites"])
        yield from _compose_links(facts["links"])
    elif facts["problem"]:
        yield MarkedText("[red]cannot be opened:[/red]", sanitize(facts["problem"]))
    channels: dict[str, JsonObject] = facts["channels"]
    views = {topic: channel for topic, channel in channels.items() if topic.startswith(_VIEWS)}
    own = {topic: channel for topic, channel in channels.items() if topic not in views}
    yield from _compose_channels(own, session)
    if views:
        rows = [
            (topic, *_counts(v), v["schema"].rpartition("/")[2]) for topic, v in views.items()
        ]
        yield from _table(("view, for other tools", "messages", "rate Hz", "size", "as"), rows)
    if session is not None:
        yield from _compose_accounts(session)
        yield from _compose_origin(session)
    for file in facts["files"]:
        yield from _compose_file(file)


def _rows(*rows: tuple[str, str]) -> Iterator[Block]:
    for head, text in rows:
        if text:
            yield MarkedText(f"[bold]{head:<9}[/bold]", sanitize(text))


def _table(
    headers: Sequence[str], rows: Iterable[Sequence[object]], words: int = 1
) -> Iterator[Block]:
    """Yields an empty line and a table; its first columns hold words, the others numbers."""
    cells = [["-" if value is None else str(value) for value in row] for row in rows]
    yield ""
    yield TextTable(headers, cells, "l" * words + "r")


def _compose_session(facts: JsonObject, session: JsonObject) -> Iterator[Block]:
    scenario: JsonObject = session["scenario"]
    sites: dict[str, JsonObject] = facts["sites"]
    missing = sum(site["missing"] for site in sites.values())
    records = sum(site["records"] for site in sites.values())
    began = f", began {session['began_utc']} UTC" if session["began_utc"] else ""
    changed = "" if scenario["as_named"] else "; NOT the text whose hash the session names"
    finished = (
        "finished" if all(file["finished"] for file in facts["files"]) else "not finished"
    )
    damaged = sum(len(file["damaged"]) for file in facts["files"])
    places = f"; damaged in {damaged} place{'s' * (damaged > 1)}" if damaged else ""
    silent: list[str] = session["unknown_ends"]
    tails = f"; {describe_unknown_ends(silent)}" if silent else ""
    title = f": {scenario['title']}" if scenario["title"] else ""
    yield from _rows(
        ("session", f"{session['session']}, {session['driver']}{began}"),
        ("scenario", scenario["name"] + title),
        ("", f"seed {scenario['seed']}, sha256 {scenario['sha256'][:16]}{changed}"),
        *(("", f"note: {note}") for note in scenario.get("arms", ())),
        ("duration", f"{session['recorded_s']:.3f} s of {scenario['duration_s']:g} s"),
        ("records", f"{records}, {missing or 'none'} missing{tails}; {finished}{places}"),
    )


def _compose_sites(sites: dict[str, JsonObject]) -> Iterator[Block]:
    rows = []
    for name, site in sites.items():
        ticks = site["expected_ticks"] if site["made_ticks"] is None else site["made_ticks"]
        of = (site["records"], ticks, site["missing"], site["overruns"])
        rows.append((name, site["role"], site["rate_hz"], *of))
    yield from _table(
        ("site", "role", "rate Hz", "records", "of", "missing", "overruns"), rows, words=2
    )
    if any(site["late_us"] for site in sites.values()):
        loops = [
            (name, *_three(s["late_us"]), *_three(s["busy_us"])) for name, s in sites.items()
        ]
        yield from _table(
            ("loop", "late us p50", "p99", "max", "busy us p50", "p99", "max"), loops
        )


def _compose_links(links: dict[str, JsonObject]) -> Iterator[Block]:
    measured = any(link["one_way_ms"] for link in links.values())
    clocks = any(link["clock_bound_us"] for link in links.values())
    headers = ["link", "age ms p50", "p99", "max"]
    headers += ["one way ms p50", "p99", "max"] if measured else []
    headers += ["clock us", "+-"] if clocks else []
    rows = []
    for name, link in links.items():
        row = [name, *_three(link["age_ms"])]
        row += _three(link["one_way_ms"]) if measured else []
        row += [link["clock_offset_us"], link["clock_bound_us"]] if clocks else []
        rows.append([*row, link["late"], link["lost"], link["duplicate"]])
    yield from _table([*headers, "late", "lost", "twice"], rows)


def _compose_channels(
    channels: dict[str, JsonObject], session: JsonObject | None
) -> Iterator[Block]:
    if not channels:
        return
    prefix = f"/trilat/{session['session']}/" if session else ""
    rows = []
    for topic, channel in channels.items():
        name = topic.removeprefix(prefix) or "(none)"
        rows.append(
            (name, *_counts(channel), channel["missing"], *_three(channel["between_ms"]))
        )
    yield from _table(
        ("channel", "messages", "rate Hz", "size", "missing", "apart ms p50", "p99", "max"),
        rows,
    )
    for topic, channel in channels.items():
        if gaps := channel["gaps"]:
            words = ", ".join(f"{a}-{b}" if b > a else str(a) for a, b in gaps[:_MOST_GAPS])
            more = (
                f" and {count_nouns(len(gaps) - _MOST_GAPS, 'more range')}"
                if len(gaps) > _MOST_GAPS
                else ""
            )
            yield f"{topic.removeprefix(prefix)} lacks {words}{more}"


def _compose_accounts(session: JsonObject) -> Iterator[Block]:
    accounts: dict[str, str] = session["accounts"]
    prefix = f"/trilat/{session['session']}/"
    yield ""
    if not accounts:
        yield "no accounts: the recording did not come to its end"
        return
    faulty = {
        topic: text for topic, text in accounts.items() if _TROUBLE.search(text) or ":" in topic
    }
    if len(accounts) > len(faulty):
        yield (
            f"the recorder accounts for {count_nouns(len(accounts) - len(faulty), 'channel')} without a fault"
        )
    for topic, text in faulty.items():
        yield f"{topic.removeprefix(prefix)}: {sanitize(text)}"


def _compose_origin(session: JsonObject) -> Iterator[Block]:
    versions: dict[str, str] = session["versions"]
    dirty = {"true": " with changes", "false": ""}.get(
        session["commit_dirty"] or "", " (changes unknown)"
    )
    version = versions.get("trilat-net", "unknown")
    others = ", ".join(
        f"{name} {version}" for name, version in versions.items() if name != "trilat-net"
    )
    yield ""
    yield from _rows(
        (
            "made by",
            f"trilat-net {version}, commit {(session['commit'] or 'unknown')[:12]}{dirty}",
        ),
        (
            "on",
            f"{session['platform']}, {session['python']}, arithmetic {session['fingerprint']}",
        ),
        ("with", others),
        ("schema", f"version {session['schema_version']}"),
    )


def _compose_file(file: JsonObject) -> Iterator[Block]:
    chunks = (
        ", ".join(
            f"{count_nouns(count, 'chunk')} {name}"
            for name, count in file["compression"].items()
        )
        or "no chunks"
    )
    ratio = file["unpacked_bytes"] / file["packed_bytes"] if file["packed_bytes"] else 1.0
    end = "finished" if file["finished"] else f"cut off at byte {file['cut_off_at_byte']}"
    part = f", part {file['part'].get('index', '?')}" if file["part"] else ""
    size = _size(file["size_bytes"])
    yield from _rows(
        ("file", f"{file['path']}{part}: {size}, {chunks} ({ratio:.1f} : 1), {end}")
    )
    for damage in file["damaged"][:_MOST_GAPS]:
        yield from _rows(
            (
                "",
                f"byte {damage['offset']}, {count_nouns(damage['length'], 'byte')}: {damage['problem']}",
            )
        )


def _counts(channel: JsonObject) -> tuple[int, str | None, str]:
    return channel["messages"], _number(channel["rate_hz"]), _size(channel["bytes"])


def _three(spread: JsonObject | None) -> list[str | None]:
    return [None if spread is None else _number(spread[key]) for key in ("p50", "p99", "max")]


def _number(value: float | None) -> str | None:
    if value is None:
        return None
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def _size(count: int) -> str:
    for unit, size in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} B"
