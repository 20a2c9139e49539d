"""Composes the text of a recorded run, and of the checks and the recovery of its log.

`format_run_lines` lists the notable facts of a run, such as alarms, changed settings, and
messages from users' control laws.

Invariant:
    - Links with a constant delay and no loss are not listed among the notable facts.
"""

from collections.abc import Iterator

from ..analysis import Timeline, link_summary
from ..errors import count_nouns
from ..execution import LogCheckReport
from ..log import CheckReport, Log, LogCheckResult, Recovery
from .result_text import MARKS, Block, MarkedText, TextTable

MOST_LINES = 12
"""Maximum number of lines of each kind. The file summary.json contains all of them."""
MOST_LINE_CHARACTERS = 400
"""Maximum length of a message from a user law or an external arm."""
OUTSIDE_EVENT_KINDS = ("failed", "law", "arm")
"""Kinds of events about user laws and external arms."""
_MAX_LOCATIONS = 10
"""Maximum number of locations listed for a failed check. The JSON output contains all."""
_MAX_LOSSES = 10
"""Maximum number of losses listed for a recovery. The JSON output contains all."""


def compose_log(log: Log) -> Iterator[Block]:
    """Yields the text that summarises a recorded run.

    The text consists of a line about the session, a table with one row per arm, and notable
    facts about the run, such as alarms and setting changes.

    Args:
        log: Log of the run.
    """
    yield log.headline()
    keys = ("site", "rate_hz", "records", "missing", "last_s")
    rows = []
    for row in log.to_rows():
        cells = [str(row[key]) for key in keys]
        rows.append(cells)
    headers = ("site", "rate Hz", "records", "missing", "until s")
    yield TextTable(headers, rows, align="lr")
    yield from format_run_lines(log)


def format_run_lines(log: Log) -> list[str]:
    """Returns lines with notable facts about a run, such as alarms and changed delays.

    The lines cover alarms, user code, links, changes, modes and clocks. Long lists are
    truncated, see `_limit_lines`.

    Args:
        log: Log of the run.

    Raises:
        LogError: A record refers to a change that does not exist in the log.
    """
    return [
        *_limit_lines([f"*** {alarm}" for alarm in Timeline(log).alarms]),
        *_format_outside_lines(log),
        *_format_link_lines(log),
        *_format_change_lines(log),
        *_format_mode_lines(log),
        *_format_clock_lines(log),
    ]


def _format_outside_lines(log: Log) -> list[str]:
    """Returns lines with the messages that users' control laws and external arms left in a log.

    These strings come from other programs, so they are truncated, and characters that could
    control the terminal are replaced with spaces.

    Args:
        log: Log of the run.

    Returns:
        The lines. Empty if there are no such messages.
    """
    lines = []
    for event in log.events:
        if event.kind in OUTSIDE_EVENT_KINDS:
            text = event.text[:MOST_LINE_CHARACTERS]
            printable = [letter if letter.isprintable() else " " for letter in text]
            lines.append("".join(printable))
    return _limit_lines(lines)


def _format_link_lines(log: Log) -> list[str]:
    """Returns one line for each link whose delay varies or which loses samples.

    A line contains the delay specified in the scenario, the measured one-way delay, the age of
    the samples in use, and the losses.

    Args:
        log: Log of the run.

    Returns:
        The lines. Empty if all links have a constant delay and no losses.
    """
    lines = []
    for link in link_summary.LinkSummary.list_of_log(log):
        if link.plain:
            continue
        is_measured = any(model.link.measured for model in link.stated.models)
        origin = "" if is_measured else "stated "

        clauses = [f"link {link.name}: {origin}{_format_stated_models(link)}"]
        if link.one_way_us is not None and is_measured:
            clauses.append(f"one way {_format_spread(link.one_way_us, 1e-3)}")
        if link.age_ms is None:
            clauses.append("no sample in use")
        else:
            clauses.append(f"effective {_format_spread(link.age_ms)}")
        if link.counts is not None:
            clauses.append(_describe_losses(link, link.counts))
        lines.append("; ".join(clauses))
    return _limit_lines(lines)


def _format_change_lines(log: Log) -> list[str]:
    """Returns one line for each setting change during the run.

    A change is a command to an arm, a new link delay, or new dominance factors.

    Args:
        log: Log of the run.
    """
    lines = []
    for change in Timeline(log).changes:
        tick = change.taken_at_tick
        origin = "by the scenario" if tick is None else f"applied at tick {tick}"
        lines.append(f"change: {change.sentence} ({origin})")
    return _limit_lines(lines)


def _format_mode_lines(log: Log) -> list[str]:
    """Returns one line for each arm that at times did not follow the others.

    The line says when the arm held its position, braked or returned, for example "m1: held
    2.100-2.600 s".

    Args:
        log: Log of the run.
    """
    timeline = Timeline(log)
    lines = []
    for site in log.sites:
        intervals = timeline.find_mode_intervals(site)
        if not intervals:
            continue
        phrases = []
        for interval in intervals[:MOST_LINES]:
            period = f"{interval.from_s:.3f}-{interval.to_s:.3f} s"
            phrases.append(f"{interval.meaning.did} {period}")
        if len(intervals) > MOST_LINES:
            phrases.append(f"and {len(intervals) - MOST_LINES} more")
        lines.append(f"{site}: {', '.join(phrases)}")
    return lines


def _format_clock_lines(log: Log) -> list[str]:
    """Returns one line for each link whose two sites have different clocks.

    The line states the difference between the clocks, on which measured delays depend.

    Args:
        log: Log of the run.
    """
    lines = []
    for site in log.sites:
        for peer in log[site].peers:
            clock = link_summary.ClockSummary.of_link(log, peer, site)
            if clock is not None and not clock.shared:
                lines.append(f"clock of {peer} seen by {site}: {_format_clock(clock)}")
    return _limit_lines(lines)


def _format_stated_models(summary: link_summary.LinkSummary) -> str:
    """Returns the delays and losses that a scenario specifies for a link during a run.

    For example: "constant 400 ms, then constant 800 ms from 5 s on".

    Args:
        summary: Summary of the link. If the link had more than three delay models, only the
            first and the last are described, with the number of changes between them.
    """
    first_model, *later_models = summary.stated.models
    phrases = [first_model.link.describe()]
    if len(later_models) > 2:
        phrases.append(f"{count_nouns(len(later_models) - 1, 'change')}")
        later_models = later_models[-1:]
    phrases += [f"{link.describe()} from {from_s:g} s on" for from_s, link in later_models]
    return ", then ".join(phrases)


def _format_clock(use: link_summary.ClockSummary) -> str:
    """Returns a text on the difference between the clocks of two machines.

    Measured one-way delays are only as accurate as the estimate of this difference.

    Args:
        use: Summary of the difference over the run.

    Returns:
        The offset, its error bound, its drift and faults, as text.
    """
    bound_text = (
        f"known to {use.bound_us} us (p50 {use.bound_p50_us:.0f}, max {use.bound_max_us})"
    )
    clauses = [f"{use.offset_us / 1e3:+.3f} ms at the end, {bound_text}"]
    if use.drift_ppm is not None:
        clauses.append(f"drift {use.drift_ppm:+.2f} ppm")
    if use.faults:
        early_text = count_nouns(
            use.faults,
            singular="sample arrived before it was sent",
            plural="samples arrived before they were sent",
        )
        clauses.append(f"{early_text}: a clock has stepped")
    return ", ".join(clauses)


def _format_spread(spread: link_summary.ValueStatistics, unit_ms: float = 1.0) -> str:
    """Formats the mean, deviation, 99th percentile and maximum of times, in ms.

    Args:
        spread: Statistics of the times.
        unit_ms: Unit of the statistics, in ms.
    """
    mean = _format_number(unit_ms * spread.mean)
    deviation = _format_number(unit_ms * spread.deviation)
    p99 = _format_number(unit_ms * spread.p99)
    largest = _format_number(unit_ms * spread.max)
    return f"{mean} +- {deviation} ms (p99 {p99}, max {largest})"


def _format_number(value: float) -> str:
    """Formats a number with three digits, or more if it is 100 or larger."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _describe_losses(use: link_summary.LinkSummary, counts: link_summary.SampleCounts) -> str:
    """Returns the number and percentage of a link's samples that were not used, by reason.

    Args:
        use: Summary of the link.
        counts: Counts of its samples.
    """
    losses = {
        "missing on the way": counts.missing,
        "lost": counts.lost,
        "late": counts.late,
        "superseded": counts.superseded,
        "duplicates": counts.duplicate + counts.copies,
    }
    judged_count = max(counts.judged, 1)
    clauses = []
    for name, count in losses.items():
        if count:
            clauses.append(f"{name} {count} ({100 * count / judged_count:.3g} %)")
    # Shorter bursts would be printed as "1 in a row", which says nothing.
    if use.burst is not None and use.burst > 1.005:
        clauses.append(f"{_format_number(use.burst)} in a row")
    return ", ".join(clauses) or "nothing lost"


def _limit_lines(lines: list[str]) -> list[str]:
    """Returns at most `MOST_LINES` lines, plus one with the number of remaining lines."""
    more = len(lines) - MOST_LINES
    if more <= 0:
        return lines
    return [*lines[:MOST_LINES], f"and {more} more of this kind: see summary.json"]


def compose_checks(report: CheckReport) -> Iterator[Block]:
    """Yields the results of the log checks for the user, one line per check.

    Args:
        report: Results of the checks.
    """
    for finding in report.findings:
        yield MarkedText("", f"{finding.check}: {finding.text}", failed=not finding.passed)


def compose_verification(report: LogCheckReport) -> Iterator[Block]:
    """Yields the results of the log checks and, if the log passed, notable facts about the run.

    Args:
        report: Results of the checks.
    """
    yield from compose_checks(report)
    if report.passed:
        yield from format_run_lines(report.log)


def compose_log_check(report: LogCheckResult) -> Iterator[Block]:
    """Yields the results of checking a log file, one line per check.

    Each failed check is followed by lines that give the places in the file at which it failed.

    Args:
        report: Results of the checks.
    """
    for finding in report.findings:
        mark = MARKS["ok" if finding.passed else "FAIL"]
        yield MarkedText(mark, f"{finding.check:<9}  {finding.text}")
        # The text of the check may name a single location already.
        is_named_already = finding.wrong == 1 and str(finding.places[0]) in finding.text
        if is_named_already:
            continue
        for location in finding.places[:_MAX_LOCATIONS]:
            names_file = len(report.files) > 1 and location.file
            file_text = f"{location.file}: " if names_file else ""
            yield f"       {file_text}{location}"
        if finding.wrong > _MAX_LOCATIONS:
            unlisted_count = finding.wrong - _MAX_LOCATIONS
            yield f"       and {unlisted_count} more; --json names {len(finding.places)}"


def compose_recovery(recovery: Recovery) -> Iterator[Block]:
    """Yields the outcome of recovering a truncated log.

    The first line names the new file. A table states how many records were recovered, and lists
    what was lost and what is missing.

    Args:
        recovery: Result of the recovery.
    """
    state = "was finished" if recovery.finished else "was not finished"
    yield f"{recovery.output}: recovered from {recovery.path}, which {state}"
    rows = []
    # Each row of the table is a heading and a text.
    record_counts = recovery.coverage.judged
    if record_counts:
        counts = ", ".join(f"{site} {count}" for site, count in record_counts.items())
        rows.append(("records", counts))
        rows.append(("of the run", str(recovery.coverage)))
        rows.append(("source", f"digest chain {recovery.chain}"))
    rows.append(("messages", f"{recovery.messages} in {recovery.duration_s:.3f} s"))

    loss_lists = [("lost", recovery.lost)]
    # Without a number of expected records, no record can be called missing.
    if recovery.coverage.expected:
        loss_lists.append(("missing", recovery.missing))
    for name, lines in loss_lists:
        first_loss, *other_losses = lines[:_MAX_LOSSES] or ["nothing"]
        rows.append((name, first_loss))
        rows += [("", text) for text in other_losses]
        if len(lines) > _MAX_LOSSES:
            rows.append(("", f"and {len(lines) - _MAX_LOSSES} more; --json lists all"))

    yield TextTable(("", ""), [(f"  {name}", text) for name, text in rows])
