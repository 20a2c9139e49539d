"""Composes the output of `trilat log info`, which describes the contents of log files.

The text has these parts:

- The session, its arms and its links, if trilat-net wrote the log.
- The channels (series of messages) in the files.
- The number of messages, as counted by the process that wrote the log.
- One line per file.

Invariant:
    - Strings from a file are passed through `sanitize`, or are table cells, which `result_text`
      sanitizes. A file therefore cannot control the terminal.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

from ..errors import count_nouns
from ..log import describe_unknown_ends
from ..results import JsonObject, Result
from .result_text import Block, MarkedText, TextTable
from .untrusted_text import sanitize

_MAX_GAPS = 4
"""Maximum number of gaps listed per channel, and of damaged parts listed per file."""
_VIEW_PREFIX = "/viz/"
"""Prefix of the names of standard channels for other tools."""
_FAULTY_ACCOUNT = re.compile(r"(missing|duplicate|reordered|refilled|overflowed) [1-9]")
"""Matches a fault in the recorder's counts, such as "missing 3"."""
_SIZE_UNITS = {"GB": 10**9, "MB": 10**6, "kB": 10**3}


def compose_overview(overview: Result) -> Iterator[Block]:
    """Yields the text that describes the contents of log files.

    The text contains the session, the tables, the number of messages, the origin and the files.
    If trilat-net did not write the files, only the channels and the files are described.

    Args:
        overview: Contents of the files, with the keys of `trilat log info --json`.
    """
    facts = overview.to_dict()
    session: JsonObject | None = facts["session"]
    if session is not None:
        yield from _compose_session(facts, session)
        yield from _compose_sites(facts["sites"])
        yield from _compose_links(facts["links"])
    elif facts["problem"]:
        yield MarkedText("[red]cannot be opened:[/red]", sanitize(facts["problem"]))

    standard_channels: dict[str, JsonObject] = {}
    own_channels: dict[str, JsonObject] = {}
    for topic, channel in facts["channels"].items():
        # Some channels repeat the records as standard messages, for viewers of robot data.
        if topic.startswith(_VIEW_PREFIX):
            standard_channels[topic] = channel
        else:
            own_channels[topic] = channel
    yield from _compose_channels(own_channels, session)
    yield from _compose_views(standard_channels)

    if session is not None:
        yield from _compose_accounts(session)
        yield from _compose_origin(session)
    for file in facts["files"]:
        yield from _compose_file(file)


def _compose_session(facts: JsonObject, session: JsonObject) -> Iterator[Block]:
    """Yields lines about a recorded session: its name, scenario, duration and records.

    The hash of the scenario shows whether the log contains the text that was executed.
    """
    scenario: JsonObject = session["scenario"]
    name = f"{session['session']}, {session['driver']}"
    if session["began_utc"]:
        name += f", began {session['began_utc']} UTC"
    title = f": {scenario['title']}" if scenario["title"] else ""
    origin = f"seed {scenario['seed']}, sha256 {scenario['sha256'][:16]}"
    if not scenario["as_named"]:
        origin += "; NOT the text whose hash the session names"
    duration = f"{session['recorded_s']:.3f} s of {scenario['duration_s']:g} s"

    yield from _compose_line("session", name)
    yield from _compose_line("scenario", scenario["name"] + title)
    yield from _compose_line("", origin)
    for note in scenario.get("arms", ()):
        yield from _compose_line("", f"note: {note}")
    yield from _compose_line("duration", duration)
    yield from _compose_line("records", _describe_records(facts, session))


def _describe_records(facts: JsonObject, session: JsonObject) -> str:
    """Returns the numbers of recorded and missing records, and whether the files are intact.

    For example: "30000, none missing; finished".
    """
    sites: dict[str, JsonObject] = facts["sites"]
    records = sum(site["records"] for site in sites.values())
    missing = sum(site["missing"] for site in sites.values())
    text = f"{records}, {missing or 'none'} missing"
    unknown_ends: list[str] = session["unknown_ends"]
    if unknown_ends:
        text += f"; {describe_unknown_ends(unknown_ends)}"

    files = facts["files"]
    is_finished = all(file["finished"] for file in files)
    text += "; finished" if is_finished else "; not finished"
    damaged = sum(len(file["damaged"]) for file in files)
    if damaged:
        text += f"; damaged in {count_nouns(damaged, 'place')}"
    return text


def _compose_sites(sites: Mapping[str, JsonObject]) -> Iterator[Block]:
    """Yields a table of each arm's records, and a table of its control loop timing.

    The second table exists only for sessions in real time.
    """
    rows = []
    for name, site in sites.items():
        executed_ticks = site["made_ticks"]
        # An interrupted site may have executed fewer ticks than the scenario plans.
        ticks = site["expected_ticks"] if executed_ticks is None else executed_ticks
        row = [
            name,
            site["role"],
            site["rate_hz"],
            site["records"],
            ticks,
            site["missing"],
            site["overruns"],
            site["skipped"],
        ]
        rows.append(row)
    columns = "site, role, rate Hz, records, of, missing, overruns, skipped"
    yield from _tabulate(columns.split(", "), rows, text_columns=2)

    if any(site["late_us"] for site in sites.values()):
        loop_rows = []
        for name, site in sites.items():
            late = _format_percentiles(site["late_us"])
            busy = _format_percentiles(site["busy_us"])
            loop_rows.append([name, *late, *busy])
        headers = ("loop", "late us p50", "p99", "max", "busy us p50", "p99", "max")
        yield from _tabulate(headers, loop_rows)


def _compose_links(links: Mapping[str, JsonObject]) -> Iterator[Block]:
    """Yields a table of the links between the arms.

    The table contains the ages of the samples used. Further columns contain one-way delays and
    clock differences, if they were measured, and the numbers of late, lost and duplicate
    samples.
    """
    has_delays = any(link["one_way_ms"] for link in links.values())
    has_clocks = any(link["clock_bound_us"] for link in links.values())
    headers = ["link", "age ms p50", "p99", "max"]
    if has_delays:
        headers += ["one way ms p50", "p99", "max"]
    if has_clocks:
        headers += ["clock us", "+-"]
    headers += ["late", "lost", "duplicate"]

    rows = []
    for name, link in links.items():
        row = [name, *_format_percentiles(link["age_ms"])]
        if has_delays:
            row += _format_percentiles(link["one_way_ms"])
        if has_clocks:
            row += [link["clock_offset_us"], link["clock_bound_us"]]
        row += [link["late"], link["lost"], link["duplicate"]]
        rows.append(row)
    yield from _tabulate(headers, rows)


def _compose_channels(
    channels: Mapping[str, JsonObject], session: JsonObject | None
) -> Iterator[Block]:
    """Yields a table of the channels (series of messages) in the files, and the gaps in each.

    A gap is a range of message numbers that are not in the files because the messages were
    lost.

    Args:
        channels: Mapping from topic to channel.
        session: The session, whose name is omitted from the topics. `None` if the files contain
            no session.
    """
    if not channels:
        return

    prefix = f"/trilat/{session['session']}/" if session else ""

    rows = []
    for topic, channel in channels.items():
        name = topic.removeprefix(prefix) or "(none)"
        count_cells = _format_counts(channel)
        interval_cells = _format_percentiles(channel["between_ms"])
        rows.append([name, *count_cells, channel["missing"], *interval_cells])

    headers = (
        "channel",
        "messages",
        "rate Hz",
        "size",
        "missing",
        "interval ms p50",
        "p99",
        "max",
    )
    yield from _tabulate(headers, rows)

    for topic, channel in channels.items():
        gaps = channel["gaps"]
        if gaps:
            yield f"{topic.removeprefix(prefix)} lacks {_list_gaps(gaps)}"


def _list_gaps(gaps: Sequence[tuple[int, int]]) -> str:
    """Formats the numbers of missing messages as ranges, for example "12-15, 20".

    At most `_MAX_GAPS` ranges are listed.

    Args:
        gaps: First and last number of each range.
    """
    range_texts = []
    for first, last in gaps[:_MAX_GAPS]:
        range_texts.append(f"{first}-{last}" if last > first else str(first))

    text = ", ".join(range_texts)
    if len(gaps) > _MAX_GAPS:
        text += f" and {count_nouns(len(gaps) - _MAX_GAPS, 'more range')}"
    return text


def _compose_views(views: Mapping[str, JsonObject]) -> Iterator[Block]:
    """Yields a table of the channels with standard messages, intended for other tools."""
    if not views:
        return
    rows = []
    for topic, channel in views.items():
        message_type = channel["schema"].rpartition("/")[2]
        rows.append([topic, *_format_counts(channel), message_type])
    headers = ("view, for other tools", "messages", "rate Hz", "size", "as")
    yield from _tabulate(headers, rows)


def _compose_accounts(session: JsonObject) -> Iterator[Block]:
    """Yields the recorder's message counts for each channel.

    The counts show whether the log is complete. Only channels with a fault, such as missing
    messages, are listed, followed by the number of remaining channels.
    """
    accounts: dict[str, str] = session["accounts"]
    prefix = f"/trilat/{session['session']}/"
    yield ""
    if not accounts:
        yield "no counts: the recording was not finished"
        return

    faulty_accounts = {
        topic: account
        for topic, account in accounts.items()
        if _FAULTY_ACCOUNT.search(account) or ":" in topic
    }

    intact_count = len(accounts) - len(faulty_accounts)
    if intact_count:
        channels_text = count_nouns(intact_count, "channel")
        yield f"the recorder accounts for {channels_text} without a fault"
    for topic, account in faulty_accounts.items():
        yield f"{topic.removeprefix(prefix)}: {sanitize(account)}"


def _compose_origin(session: JsonObject) -> Iterator[Block]:
    """Yields the software versions and the machine that recorded a log.

    A run can be repeated bit for bit only with the same versions and the same floating-point
    arithmetic.
    """
    versions: dict[str, str] = dict(session["versions"])
    version = versions.pop("trilat-net", "unknown")
    libraries = [f"{name} {library}" for name, library in versions.items()]

    commit = (session["commit"] or "unknown")[:12]
    change_notes = {"true": " with changes", "false": ""}
    changes = change_notes.get(session["commit_dirty"] or "", " (changes unknown)")
    platform = f"{session['platform']}, {session['python']}"

    yield ""
    yield from _compose_line("made by", f"trilat-net {version}, commit {commit}{changes}")
    yield from _compose_line("on", f"{platform}, arithmetic {session['fingerprint']}")
    yield from _compose_line("with", ", ".join(libraries))
    yield from _compose_line("schema", f"version {session['schema_version']}")


def _compose_file(file: JsonObject) -> Iterator[Block]:
    """Yields a line with the size and state of a log file, and a line per damaged part."""
    name = file["path"]
    if file["part"]:
        name += f", part {file['part'].get('index', '?')}"

    # Messages are stored in compressed chunks.
    chunks = []
    for compression, count in file["compression"].items():
        chunks.append(f"{count_nouns(count, 'chunk')} {compression}")
    ratio = 1.0
    if file["packed_bytes"]:
        ratio = file["unpacked_bytes"] / file["packed_bytes"]
    size = f"{_format_size(file['size_bytes'])}, {', '.join(chunks) or 'no chunks'}"

    state = "finished"
    if not file["finished"]:
        state = f"cut off at byte {file['cut_off_at_byte']}"
    yield from _compose_line("file", f"{name}: {size} ({ratio:.1f} : 1), {state}")

    for damage in file["damaged"][:_MAX_GAPS]:
        span = f"byte {damage['offset']}, {count_nouns(damage['length'], 'byte')}"
        yield from _compose_line("", f"{span}: {damage['problem']}")


def _compose_line(heading: str, text: str) -> Iterator[Block]:
    """Yields a text after a bold heading, or nothing for an empty text."""
    if text:
        yield MarkedText(f"[bold]{heading:<9}[/bold]", sanitize(text))


def _tabulate(
    headers: Sequence[str], rows: Iterable[Sequence[object]], text_columns: int = 1
) -> Iterator[Block]:
    """Yields an empty line followed by a table for the terminal.

    Args:
        headers: Header of each column.
        rows: Values of each row. `None` is printed as a dash.
        text_columns: Number of columns on the left that contain text. The others contain
            numbers.
    """
    text_rows = []
    for row in rows:
        texts = ["-" if value is None else str(value) for value in row]
        text_rows.append(texts)
    yield ""
    yield TextTable(headers, text_rows, align="l" * text_columns + "r")


def _format_counts(channel: JsonObject) -> list[object]:
    """Returns the number, rate and size of a channel's messages as three cells."""
    rate_hz = channel["rate_hz"]
    rate = None if rate_hz is None else _format_number(rate_hz)
    return [channel["messages"], rate, _format_size(channel["bytes"])]


def _format_percentiles(percentiles: JsonObject | None) -> list[str | None]:
    """Returns the median, 99th percentile and maximum as three cells, `None` if unknown."""
    if percentiles is None:
        return [None, None, None]
    return [_format_number(percentiles[key]) for key in ("p50", "p99", "max")]


def _format_number(value: float) -> str:
    """Formats a number with four digits, or as an integer if it is 1000 or larger."""
    return f"{value:.0f}" if abs(value) >= 1000.0 else f"{value:.4g}"


def _format_size(size_bytes: int) -> str:
    """Formats a size with three digits, in the largest suitable unit."""
    for unit, unit_bytes in _SIZE_UNITS.items():
        if size_bytes >= unit_bytes:
            return f"{size_bytes / unit_bytes:.3g} {unit}"
    return f"{size_bytes} B"
