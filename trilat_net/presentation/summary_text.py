"""Composes the text that commands print about a run, a live session and this machine.

Each `compose_...` function turns the result of one command into lines and tables, which
`terminal_output` prints. The results are about:

- a run: its summary, its metrics, the checks and recovery of its log, and its re-execution,
- a live session: `compose_ping`,
- this machine: `compose_doctor`, `compose_benchmark`.

`format_run_lines` lists the notable facts of a run, such as alarms, changed settings, and
messages from users' control laws.

Invariant:
    - Links with a constant delay and no loss are not listed among the notable facts.
    - Missing numbers are shown as a dash. If the quantity is meaningful for the run, the reason
      why it is missing is given below the tables.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any

from ..analysis import (
    LogMetrics,
    Metric,
    Quantity,
    Timeline,
    link_summary,
)
from ..errors import count_nouns
from ..execution import LogCheckReport, Rerun
from ..log import Log, LogCheckResult, Recovery
from ..results import Result
from .plot_signals import shared_unit
from .result_text import MARKS, Block, MarkedText, TextTable
from .untrusted_text import sanitize

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
_NO_NUMBER = "–"
"""Cell content for a missing number."""
_MAX_FREQUENCIES = 16
"""Maximum number of frequencies listed for a response. The JSON output contains all."""


def compose_log(log: Log) -> Iterator[Block]:
    """Yields the text with which a command introduces a recorded run.

    The text consists of a line about the session, a table with one row per arm, and the notable
    facts of the run, such as alarms and setting changes.

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
    """Returns lines about the notable facts of a run, such as alarms and changed delays.

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


def compose_verification(report: LogCheckReport) -> Iterator[Block]:
    """Yields the results of the log checks for the user, one line per check.

    If all checks passed, the notable facts of the run follow.

    Args:
        report: Results of the checks.
    """
    for finding in report.findings:
        yield MarkedText("", f"{finding.check}: {finding.text}", failed=not finding.passed)
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

    The first line names the new file. A table lists which records were recovered, and which
    were lost or are missing.

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


def compose_rerun(rerun: Rerun) -> Iterator[Block]:
    """Yields the result of re-executing some sites of a log with changed settings.

    The text names the executed sites and the changed settings, and compares the motion of each
    site and the sample ages of each link with the log.

    Args:
        rerun: Result of the re-execution.
    """
    request = rerun.request
    recorded = f"; {', '.join(request.recorded)} as recorded" if request.recorded else ""
    yield f"{request.mode}: {', '.join(request.replaced)} executed afresh{recorded}"

    changes = request.describe_changes()
    for line in changes or ["nothing is changed: this is the experiment of the log"]:
        yield f"  {line}"

    # The table has a row for each executed site, with pairs of columns: logged and rerun.
    undelayed = _compare_undelayed_errors(rerun)
    rows = []

    # Details that do not fit into the table.
    for effect in rerun.sites.values():
        pairs: list[tuple[float, float] | None] = []
        pairs += [effect.error_rms_rad, effect.error_max_rad]

        if undelayed:
            pairs.append(undelayed.get(effect.site))
        pairs.append(effect.torque_max_nm)
        cells = []
        for pair in pairs:
            cells += ["", ""] if pair is None else [f"{value:#.3g}" for value in pair]
        rows.append([effect.site, str(effect.executed), str(effect.identical), *cells])

    headers = ["site", "ticks", "identical", "rms e rad", "rerun", "max e rad", "rerun"]
    if undelayed:
        headers += ["undelayed", "rerun"]
    headers += ["max tau N m", "rerun"]
    yield TextTable(tuple(headers), rows, align="lr")
    if undelayed:
        unit = "rad" if shared_unit(rerun.before) == "rad" else "m"
        yield (
            f"undelayed: largest distance in {unit} from where the peers are at the same time, "
            "delay included"
        )
        yield (
            "e: error from what the site had received of its peers, which a longer delay "
            "need not raise"
        )
    for site in rerun.sites:
        for line in _describe_site_effect(rerun, site):
            yield f"{site}: {line}"
    for name, link in rerun.links.items():
        if link.differs:
            yield _describe_link_effect(rerun, name)
    yield from (f"note: {note}" for note in rerun.notes)


def _compare_undelayed_errors(rerun: Rerun) -> dict[str, tuple[float, float]]:
    """Returns how far arms were from the others at the same time, in a log and in its rerun.

    The tracking error compares an arm with delayed states of the others. The undelayed error
    compares it with their states at the same time, and shows the effect of a different delay.
    The runs are compared at times for which both have a record. Sites that follow no other site
    have no such error, and are omitted.

    Returns:
        For each site, the largest undelayed error in the log and in the rerun.
    """
    sites = [site for site, effect in rerun.sites.items() if effect.compared]
    logged = LogMetrics.find_undelayed_maxima(rerun.before, sites, rerun.after)
    repeated = LogMetrics.find_undelayed_maxima(rerun.after, sites, rerun.before)
    return {site: (logged[site], repeated[site]) for site in logged if site in repeated}


_USED_FIELD = "used["
"""Prefix of record fields that contain the tick of the peer sample in use."""


def _name_sample(tick: object) -> str:
    """Returns a name for the peer sample in use, from its tick (-1 before the first sample)."""
    return "none" if tick == -1 else f"that of tick {tick}"


def _describe_site_effect(rerun: Rerun, site: str) -> list[str]:
    """Returns lines about the differences between the log of an arm and its re-execution.

    The lines state the largest deviation of the joint angles, and the first value that differs.

    Args:
        rerun: Result of the re-execution.
        site: Name of the site.
    """
    effect = rerun.sites[site]
    rate_hz = rerun.request.scenario.sites[site].rate_hz
    lines = []
    if effect.q_max_rad:
        largest_text = f"{effect.q_max_rad:.3g} rad off the log, at {effect.q_max_at_s:.3f} s"
        lines.append(f"q is up to {largest_text}; {effect.q_rms_rad:.3g} rad rms")

    first_difference = effect.first
    if first_difference is not None:
        logged_text, computed_text = _format_difference(
            first_difference.logged, first_difference.computed
        )
        time_text = f"tick {first_difference.tick} ({first_difference.tick / rate_hz:.3f} s)"
        change = f"{first_difference.field} was {logged_text}, is {computed_text}"
        if first_difference.field.startswith(_USED_FIELD):
            peer = first_difference.field.removeprefix(_USED_FIELD).removesuffix("]")
            logged_sample = _name_sample(first_difference.logged)
            computed_sample = _name_sample(first_difference.computed)
            change = f"the sample of {peer} in use was {logged_sample}, is {computed_sample}"
        lines.append(f"the first difference is at {time_text}: {change}")

    if effect.diverged_at_s is not None:
        lines.append(f"diverged at {effect.diverged_at_s:.3f} s and ends there")
    return lines


def _describe_link_effect(rerun: Rerun, name: str) -> str:
    """Returns a sentence that compares a link's sample ages in the log and in the rerun."""
    link = rerun.links[name]
    mean_ms = link.age_mean_ms
    max_ms = link.age_max_ms
    before = f"{mean_ms.before:.4g} ms old on average, {max_ms.before:.4g} ms at most"
    after = f"{mean_ms.after:.4g} ms old on average, {max_ms.after:.4g} ms at most"
    return f"link {link.link}: samples in use were {before}; are {after}"


def _format_difference(before: object, after: object) -> tuple[str, str]:
    """Formats two different values such that the resulting strings differ.

    Numbers are written with six digits, or with all digits if the strings would otherwise be
    equal.

    Args:
        before: The value in the first log.
        after: The value in the second log.
    """
    short_before = f"{before:.6g}" if isinstance(before, float) else str(before)
    short_after = f"{after:.6g}" if isinstance(after, float) else str(after)
    if short_before == short_after:
        return repr(before), repr(after)
    return short_before, short_after


def compose_doctor(report: Result) -> Iterator[Block]:
    """Yields the results of checking whether this machine is ready for a session.

    Each finding is printed on its own line, marked as good, doubtful or bad.

    Args:
        report: Result of `trilat doctor`.
    """
    for finding in report.to_dict()["findings"]:
        yield MarkedText(MARKS[finding["state"]], f"{finding['check']:<10}  {finding['text']}")


def compose_ping(report: Result) -> Iterator[Block]:
    """Yields tables of the round trip times in a session.

    The first table contains the round trip times to the members of the session (sites and
    recorders). A second table contains the times between sites, if the sites have measured
    them.

    Args:
        report: Result of the measurement.
    """
    facts = report.to_dict()
    members = facts["members"]
    links = facts["links"]

    state = "runs" if any(member["running"] for member in members) else "waits for its members"
    clock_note = "clock: the member's minus that of this machine"
    yield f"session {facts['session']} {state}; times in us; {clock_note}"

    rows = []
    for member in members:
        round_trip_us = member.get("rtt_us", {})
        times_us = [
            round_trip_us.get("min"),
            round_trip_us.get("p50"),
            round_trip_us.get("p99"),
            member.get("jitter_us"),
        ]
        time_cells = ["" if time_us is None else f"{time_us:.0f}" for time_us in times_us]

        answers = str(member["answers"])
        rows.append(
            [member["member"], member["host"], answers, *time_cells, _describe_clock(member)]
        )
    headers = ("member", "host", "answers", "rtt min", "p50", "p99", "jitter", "clock")
    yield TextTable(headers, rows, align="llrrrrrl")

    if links:
        yield "between the sites, in the last tenth of a second of each:"
        rows = []
        for link in links:
            delays_us = [link["delay_us"], link["delay_max_us"], link["rtt_us"]]
            # A negative time stands for a delay that was not measured.
            delay_cells = ["none" if delay_us < 0 else str(delay_us) for delay_us in delays_us]
            clock_cells = [f"{link['offset_us'] / 1e6:.6f}", str(link["bound_us"])]
            rows.append([link["from"], link["to"], *delay_cells, *clock_cells])
        link_headers = ("from", "to", "delay p50", "max", "rtt min", "offset s", "+- us")
        yield TextTable(link_headers, rows, align="llr")


def _describe_clock(member: dict[str, Any]) -> str:
    """Returns the offset of a member's clock in s, and its error bound in us."""
    if member["same_clock"]:
        return "the same clock"
    if "offset_ns" not in member:
        return "another clock"
    return f"{member['offset_ns'] / 1e9:.6f} s +- {member['bound_us']:.0f}"


def compose_benchmark(benchmark: Result) -> Iterator[Block]:
    """Yields the delays of the transports on this machine, with a verdict on each transport.

    A transport is a way to send messages between two processes. The table has one row per
    transport, message size and rate. The verdict compares the delay with the requirements of a
    scenario.

    Args:
        benchmark: Result of the measurement.
    """
    facts = benchmark.to_dict()
    needs = facts["needs"]
    scenario_name = facts["scenario"]
    if facts["connect"]:
        yield f"the network from this machine to {', '.join(facts['connect'])}"
    else:
        yield (
            "this machine alone, without a network: name another machine with --connect, on "
            "which trilat ping --answer runs"
        )
    yield "one way is half a round trip with the handling at the far end; times in us"

    rows = []
    for row in facts["rows"]:
        percentiles_us = row["one_way_us"] or {}
        delay_cells = [
            f"{percentiles_us[key]:.0f}" if key in percentiles_us else ""
            for key in ("p50", "p99", "max")
        ]

        same_size = row["bytes"] == needs["sample_bytes"]
        same_rate = row["rate_hz"] == needs["rate_hz"]
        scenario_cell = scenario_name if same_size and same_rate else ""
        counts = [row["bytes"], f"{row['rate_hz']:g}", row["sent"], row["lost"]]
        rows.append([row["transport"], *map(str, counts), *delay_cells, scenario_cell])
    headers = ("transport", "bytes", "rate", "sent", "lost", "p50", "p99", "max", "as in")
    yield TextTable(headers, rows, align="lrrrrrrrl", units=("", "", "Hz"))

    yield f"{scenario_name}: {needs['words']}"
    for transport in facts["transports"]:
        mark = MARKS["ok" if transport["good"] else "fail"]
        judgement = _judge_transport(transport, needs)
        yield MarkedText(mark, f"{transport['transport']}: {judgement}")


def _judge_transport(transport: dict[str, Any], needs: dict[str, Any]) -> str:
    """Returns a sentence that compares the delay of a transport with a scenario's limits.

    A transport is the protocol that carries the samples between sites, such as TCP.

    Args:
        transport: Measured delays and losses of the transport. `p99_ms` is the 99th percentile
            of the delay, or `None` if no message returned. `hidden` is True if it is at most
            `held_ms`. `age_ms` is the age at which samples would be used. `spare_ms` is the
            additional age up to which the loop remains stable, or `None` if the loop is not
            stable or this is unknown. `lost_share` is the fraction of lost messages, and
            `playout_ms` is the largest delay, rounded up.
        needs: Message sizes, rates and time limits of the scenario. `held_ms` is the time for
            which its links hold each sample before it is used, so that shorter delays have no
            effect. `stable_ms` lists the ages at which the loop is stable, or is `None` if they
            are unknown.
    """
    if transport["p99_ms"] is None:
        return "no message returned"

    delay = f"p99 {transport['p99_ms']:.3g} ms"
    if needs["held_ms"]:
        relation = "hides in" if transport["hidden"] else "exceeds"
        delay += f" {relation} the {needs['held_ms']:g} ms for which links hold samples"
    clauses = [delay, f"samples are in use {transport['age_ms']:.4g} ms old"]

    is_stability_known = needs["stable_ms"] is not None
    if transport["spare_ms"] is not None:
        clauses.append(f"{transport['spare_ms']:.4g} ms to spare")
    elif is_stability_known:
        clauses.append("at which the loop is not stable")
    if transport["lost_share"]:
        clauses.append(f"{100 * transport['lost_share']:.3g} % lost")

    # A play-out buffer of the largest delay makes the delay of all samples equal.
    playout = (
        f"a play-out of {transport['playout_ms']} ms would hold every one of these samples"
    )
    return f"{', '.join(clauses)}; {playout}"


def compose_metrics(metrics: LogMetrics) -> Iterator[Block]:
    """Yields the tables with the metrics of a run.

    There is one table per group of quantities, with one column per subject: the run, an arm, a
    link, or a wall. Further tables describe what operators feel: forces, stiffness and
    impedance. The reasons for missing numbers come last.

    Args:
        metrics: The metrics of the run.
    """
    reasons: dict[str, list[str]] = {}
    tables = groupby(Quantity.list_all(), key=lambda quantity: (quantity.group, quantity.of))
    for (group, _), group_quantities in tables:
        yield from _compose_group(group, list(group_quantities), metrics, reasons)
    yield from _compose_sharing(metrics)
    yield from _compose_stiffness(metrics)
    yield from _compose_impedance(metrics)
    for reason, missing_names in reasons.items():
        yield _explain_missing(sanitize(", ".join(missing_names)), reason)


def _explain_missing(subject: str, reason: str) -> MarkedText:
    """Returns a dash, which stands for missing numbers, with the reason."""
    return MarkedText(f"[bold]{_NO_NUMBER}[/bold]", f"{subject}: {sanitize(reason)}")


def _compose_group(
    group: str, members: Sequence[Quantity], metrics: LogMetrics, reasons: dict[str, list[str]]
) -> Iterator[Block]:
    """Yields a table of metrics with one row per quantity and one column per arm, link or wall.

    Rows and columns without any applicable numbers are omitted.

    Args:
        group: Heading of the table.
        members: Quantities of the group, all for the same kind of subject.
        metrics: Metrics of the run.
        reasons: Mapping from reason to the names of missing numbers, which is extended in
            place.
    """
    values = {quantity: metrics.values_of(quantity) for quantity in members}
    applicable = {
        quantity: by_subject
        for quantity, by_subject in values.items()
        if _apply_any(by_subject.values())
    }

    # All quantities of a group have the same subjects.
    all_subjects = next(iter(values.values()))
    subjects = [
        subject
        for subject in all_subjects
        if _apply_any(by_subject[subject] for by_subject in applicable.values())
    ]
    if not subjects:
        return

    rows = []
    for quantity, by_subject in applicable.items():
        numbers = [_format_metric(by_subject[subject]) for subject in subjects]
        rows.append([quantity.name, quantity.unit, *numbers])
    yield from _tabulate([group, "", *subjects], rows, text_columns=2)

    for quantity, by_subject in applicable.items():
        for subject in subjects:
            metric = by_subject[subject]
            if metric.value is None and metric.applies:
                name = f"{quantity.name} of {subject}" if subject else quantity.name
                reasons.setdefault(metric.why, []).append(name)


def _compose_sharing(metrics: LogMetrics) -> Iterator[Block]:
    """Yields a table of the forces that an arm at rest feels while another arm is pushed.

    The expected force follows from the dominance factors. Yields nothing if no arm was at rest
    while another one was pushed.
    """
    if not metrics.sharing_ratios:
        return

    joint_header = "joint"
    unit = "N m"
    if metrics.axes:
        joint_header = "axis"
        unit = metrics.unit("N m", 1)

    rows = []

    for pair in metrics.sharing_ratios:
        wall_note = " (wall)" if pair.by_wall else ""
        deviation = _NO_NUMBER if pair.off is None else f"{100.0 * pair.off:.3g} %"
        row = [
            f"{pair.from_s:.1f} - {pair.to_s:.1f} s",
            metrics.label(pair.joint),
            f"{pair.pushed}{wall_note}",
            _format_value(pair.pushed_nm),
            pair.holds,
            _format_value(pair.felt_nm),
            _format_metric(pair.expected_nm),
            deviation,
        ]
        rows.append(row)

    headers = (
        "at rest",
        joint_header,
        "ON the arm of",
        unit,
        "felt at",
        unit,
        "expected",
        "deviation",
    )
    yield from _tabulate(headers, rows, text_columns=1)
    # Each reason is written once, in the order of the rows.
    reasons = dict.fromkeys(pair.expected_nm.why for pair in metrics.sharing_ratios)
    for reason in reasons:
        if reason:
            yield _explain_missing("nothing is expected", reason)


def _compose_stiffness(metrics: LogMetrics) -> Iterator[Block]:
    """Yields a table of the stiffness that operators felt at the arms.

    The stiffness is the change in an operator's torque over the change in joint angle, for
    example against a wall that another arm touches. Yields nothing if no stiffness was
    measured.
    """
    if not metrics.stiffness:
        return

    rows = []
    for measurement in metrics.stiffness:
        stiffness = _NO_NUMBER
        if measurement.stiffness_nm_rad is not None:
            stiffness = _format_value(measurement.stiffness_nm_rad)
        row = [
            f"{measurement.from_s:.1f} to {measurement.to_s:.1f} s",
            metrics.label(measurement.joint),
            measurement.site,
            _format_value(measurement.torque_nm),
            _format_value(measurement.angle_rad),
            stiffness,
        ]
        rows.append(row)

    headers = (
        "stiffness felt",
        "axis" if metrics.axes else "joint",
        "by",
        f"{metrics.unit('N m', 1)} more",
        f"{metrics.unit('rad', 1)} further",
        metrics.unit("N m/rad", 1),
    )
    yield from _tabulate(headers, rows, text_columns=1)


def _compose_impedance(metrics: LogMetrics) -> Iterator[Block]:
    """Yields a table of the impedance felt at the sites, with one row per frequency.

    The impedance is the ratio of force to motion as a function of frequency. At most about
    `_MAX_FREQUENCIES` frequencies are listed. Yields nothing if no impedance was measured.
    """
    if not metrics.responses:
        return

    rows = []
    for response in metrics.responses:
        direction = "along" if metrics.axes else "joint"
        source_text = f" of {response.of}" if response.of else ""
        axis = f"{direction} {metrics.label(response.joint)}"
        title = f"{response.kind}{source_text} at {response.at}, {axis}"
        unit = metrics.unit(response.unit, response.joint)
        listed_ratios = response.spectrum if len(response.spectrum) > 1 else [response.ratio]
        # Every step-th ratio is listed. The step is rounded up, so that at most
        # _MAX_FREQUENCIES ratios are listed.
        step = math.ceil(len(listed_ratios) / _MAX_FREQUENCIES)
        for index, ratio in enumerate(listed_ratios[::step]):
            shown_title = title if index == 0 else ""
            # If the ratio could not be estimated, the last cell has the reason.
            cells = ["", "", "", "", ratio.why]
            if ratio.gain is not None:
                numbers = (ratio.frequency_hz, ratio.gain, ratio.phase_rad, ratio.coherence)
                cells = [_format_value(number or 0.0) for number in numbers]
                error = _NO_NUMBER if ratio.error is None else f"{100.0 * ratio.error:.1g} %"
                cells.append(f"+- {error}")
            rows.append([shown_title, unit, *cells])
    headers = ["felt over frequency", "", "Hz", "gain", "phase rad", "coherence", ""]
    yield from _tabulate(headers, rows, text_columns=2)


def _apply_any(metrics: Iterable[Metric]) -> bool:
    """Returns True if at least one of the metrics is meaningful for the run."""
    return any(metric.applies for metric in metrics)


def _format_metric(metric: Metric) -> str:
    """Formats the value of a metric with four digits, or as a dash if there is no value."""
    return _NO_NUMBER if metric.value is None else _format_value(metric.value)


def _format_value(value: float) -> str:
    """Formats a number with four digits, or with all digits if it is an integer."""
    is_whole = value == int(value) and abs(value) < 1e6
    return f"{value:.0f}" if is_whole else f"{value:.4g}"


def _tabulate(
    heads: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int
) -> Iterator[Block]:
    """Yields a table followed by an empty line for the terminal.

    Args:
        heads: Header of each column. If the last header is empty, the last column contains
            text.
        rows: Cells of each row.
        text_columns: Number of columns on the left that contain text and are left-aligned. The
            other columns contain numbers and are right-aligned.
    """
    last_letter = "r" if heads[-1] else "l"
    alignment = "l" * text_columns + "r" * (len(heads) - text_columns - 1) + last_letter
    yield TextTable(heads, list(rows), alignment)
    yield ""
