"""Summary of a run in lines for the terminal.

Links, changes, modes, clocks, and messages of user laws and arms.

Invariant: a link with one constant delay and no loss gets no line.
"""

from collections.abc import Iterator, Sequence

from ..analysis.health import ClockSummary, summarise_clock
from ..analysis.link_summary import LinkSummary, SampleCounts, ValueStatistics, summarise_links
from ..analysis.timeline import StatedModel, find_mode_intervals, list_alarms, list_changes
from ..log.log_reader import Log
from .result_text import Block
from .text_table import TextTable

MOST_LINES = 12
"""Lines of each kind; summary.json has the rest."""
MOST_LINE_CHARACTERS = 400
OUTSIDE_EVENT_KINDS = ("failed", "law", "arm")
"""Kinds of the events about user laws and external arms."""


def compose_log(log: Log) -> Iterator[Block]:
    """Yields the session, a row per site, and what else there is to say of the run."""
    yield log.headline()
    rows = [
        [row["site"], f"{row['rate_hz']}", f"{row['records']}", f"{row['missing']}", f"{row['last_s']}"]
        for row in log.to_rows()
    ]
    yield TextTable(("site", "rate Hz", "records", "missing", "until s"), rows, align="lr")
    yield from format_run_lines(log)


def format_run_lines(log: Log) -> list[str]:
    """Returns the lines of a run besides its numbers: user laws, links, changes, modes and clocks.

    Raises:
        LogError: a record names a change that is none.
    """
    return [
        *_first([f"*** {alarm}" for alarm in list_alarms(log)]),
        *format_outside_lines(log),
        *format_link_lines(log),
        *format_change_lines(log),
        *format_mode_lines(log),
        *format_clock_lines(log),
    ]


def format_outside_lines(log: Log) -> list[str]:
    """Returns the messages about user laws and external arms, as lines of bounded length."""
    texts = (e.text[:MOST_LINE_CHARACTERS] for e in log.events if e.kind in OUTSIDE_EVENT_KINDS)
    return _first(["".join(letter if letter.isprintable() else " " for letter in text) for text in texts])


def format_link_lines(log: Log) -> list[str]:
    """Returns a line per link that is not stated as constant without loss, or was not so."""
    return _first([format_link_line(use) for use in summarise_links(log) if not use.plain])


def format_change_lines(log: Log) -> list[str]:
    """Returns a line per change of a link or of a site's shares."""
    lines = []
    for changed in list_changes(log):
        tick = changed.taken_at_tick
        how = "" if tick is None else f", ordered at tick {tick}"
        lines.append(f"change at {changed.change.at_s:g} s{how}: {changed.about}: {changed.text}")
    return _first(lines)


def format_mode_lines(log: Log) -> list[str]:
    """Returns a line per site that held, braked or returned."""
    lines = []
    doing = {
        "hold": "held",
        "brake": "braked",
        "return": "returned",
        "waiting": "waited",
        "fault": "in fault",
    }
    for site in log.sites:
        if found := find_mode_intervals(log[site]):
            words = [f"{doing.get(s.mode, s.mode)} {s.from_s:.3f}-{s.to_s:.3f} s" for s in found[:MOST_LINES]]
            more = [f"and {len(found) - MOST_LINES} more"] if len(found) > MOST_LINES else []
            lines.append(f"{site}: {', '.join([*words, *more])}")
    return lines


def format_clock_lines(log: Log) -> list[str]:
    """Returns a line per link between two clocks."""
    lines = []
    for site in log.sites:
        for peer in log[site].peers:
            use = summarise_clock(log, peer, site)
            if use is not None and not use.shared:
                lines.append(f"clock of {peer} seen by {site}: {format_clock(use)}")
    return _first(lines)


def format_link_line(use: LinkSummary) -> str:
    """Returns the summary of a link in a line."""
    measured = any(state.link.measured for state in use.stated)
    parts = [f"link {use.name}: {'' if measured else 'stated '}{format_stated_models(use.stated)}"]
    if use.one_way_us is not None and measured:
        parts.append(f"one way {_ms(use.one_way_us, 1e-3)}")
    parts.append("no sample in use" if use.age_ms is None else f"effective {_ms(use.age_ms)}")
    if use.counts is not None:
        parts.append(_losses(use, use.counts))
    return "; ".join(parts)


def format_stated_models(states: Sequence[StatedModel]) -> str:
    """Returns the stated models of a link; of many changes the last one."""
    first, *later = states
    words = [first.link.describe()]
    if len(later) > 2:
        words.append(f"{len(later) - 1} changes")
        later = later[-1:]
    words += [f"{link.describe()} from {from_s:g} s on" for from_s, link in later]
    return ", then ".join(words)


def format_clock(use: ClockSummary) -> str:
    """Returns offset, bound and drift of a clock in a few words."""
    known = f"known to {use.bound_us} us (p50 {use.bound_p50_us:.0f}, max {use.bound_max_us})"
    words = [f"{use.offset_us / 1e3:+.3f} ms at the end, {known}"]
    if use.drift_ppm is not None:
        words.append(f"drift {use.drift_ppm:+.2f} ppm")
    if use.faults:
        words.append(f"{use.faults} samples came before they were sent: a clock has stepped")
    return ", ".join(words)


def _ms(spread: ValueStatistics, factor: float = 1.0) -> str:
    values = (spread.mean, spread.deviation, spread.p99, spread.max)
    mean, deviation, p99, largest = (_number(factor * value) for value in values)
    return f"{mean} +- {deviation} ms (p99 {p99}, max {largest})"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _losses(use: LinkSummary, counts: SampleCounts) -> str:
    losses = {
        "missing on the way": counts.missing,
        "lost": counts.lost,
        "late": counts.late,
        "superseded": counts.superseded,
        "duplicates": counts.duplicate + counts.copies,
    }
    judged = max(counts.judged, 1)
    words = [f"{name} {count} ({100 * count / judged:.2g} %)" for name, count in losses.items() if count]
    if use.burst is not None and use.burst > 1.005:
        words.append(f"{_number(use.burst)} in a row")
    return ", ".join(words) or "nothing lost"


def _first(lines: list[str]) -> list[str]:
    more = len(lines) - MOST_LINES
    return lines if more <= 0 else [*lines[:MOST_LINES], f"and {more} more of this kind: see summary.json"]
