"""What is found of a run, as text: its summary and its metrics, the checks of its log, a
recovery, a rerun.

The summary has links, changes, modes, clocks, and messages of user laws and arms. What was
measured of a running session, and of this machine, is here too.

Invariant: a link with one constant delay and no loss gets no line. A dash stands for a missing
number of a metric; if there could be one, its reason is given below.
"""

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any

from ..analysis import link_summary
from ..analysis.metrics.log_metrics import LogMetrics
from ..analysis.metrics.measures import Metric, Quantity, quantities
from ..analysis.timeline import StatedModel, find_mode_intervals, list_alarms, list_changes
from ..errors import count_nouns
from ..execution.log_checks import LogCheckReport
from ..execution.rerun import Rerun
from ..execution.rerun_execution import describe_rerun_changes
from ..log.log_reader import Log
from ..log.recover import Recovery
from ..log.session_check import LogCheckResult
from ..results import Result
from .result_text import MARKS, Block, MarkedText, TextTable
from .terminal_output import sanitize

MOST_LINES = 12
"""Lines of each kind; summary.json has the rest."""
MOST_LINE_CHARACTERS = 400
OUTSIDE_EVENT_KINDS = ("failed", "law", "arm")
"""Kinds of the events about user laws and external arms."""
_MAX_PLACES = 10
"""Places of a failed check that are listed; the JSON has all."""
_MAX_LOSSES = 10
"""Losses that are listed."""
_NO_NUMBER = "–"
_MAX_FREQUENCIES = 16
"""Frequencies of one response that are listed; the JSON has all."""


def compose_log(log: Log) -> Iterator[Block]:
    """Yields the session, a row per site, and what else there is to say of the run."""
    yield log.headline()
    rows = [
        [
            row["site"],
            f"{row['rate_hz']}",
            f"{row['records']}",
            f"{row['missing']}",
            f"{row['last_s']}",
        ]
        for row in log.to_rows()
    ]
    yield TextTable(("site", "rate Hz", "records", "missing", "until s"), rows, align="lr")
    yield from format_run_lines(log)


def format_run_lines(log: Log) -> list[str]:
    """Returns the lines of a run besides its numbers: user laws, links, changes, modes and
    clocks.

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
    return _first(
        ["".join(letter if letter.isprintable() else " " for letter in text) for text in texts]
    )


def format_link_lines(log: Log) -> list[str]:
    """Returns a line per link that is not stated as constant without loss, or was not so."""
    lines = []
    for use in (use for use in link_summary.summarise_links(log) if not use.plain):
        measured = any(state.link.measured for state in use.stated)
        parts = [
            f"link {use.name}: {'' if measured else 'stated '}{format_stated_models(use.stated)}"
        ]
        if use.one_way_us is not None and measured:
            parts.append(f"one way {_ms(use.one_way_us, 1e-3)}")
        parts.append(
            "no sample in use" if use.age_ms is None else f"effective {_ms(use.age_ms)}"
        )
        if use.counts is not None:
            parts.append(_losses(use, use.counts))
        lines.append("; ".join(parts))
    return _first(lines)


def format_change_lines(log: Log) -> list[str]:
    """Returns a line for each order to a site, and each change of a link or of a site's shares."""
    lines = []
    for changed in list_changes(log):
        tick = changed.taken_at_tick
        origin = "by the scenario" if tick is None else f"taken in at tick {tick}"
        lines.append(f"change: {changed.sentence} ({origin})")
    return _first(lines)


def format_mode_lines(log: Log) -> list[str]:
    """Returns a line per site that held, braked or returned."""
    lines = []
    for site in log.sites:
        if found := find_mode_intervals(log[site]):
            words = [
                f"{s.meaning.did} {s.from_s:.3f}-{s.to_s:.3f} s" for s in found[:MOST_LINES]
            ]
            more = [f"and {len(found) - MOST_LINES} more"] if len(found) > MOST_LINES else []
            lines.append(f"{site}: {', '.join([*words, *more])}")
    return lines


def format_clock_lines(log: Log) -> list[str]:
    """Returns a line per link between two clocks."""
    lines = []
    for site in log.sites:
        for peer in log[site].peers:
            use = link_summary.summarise_clock(log, peer, site)
            if use is not None and not use.shared:
                lines.append(f"clock of {peer} seen by {site}: {format_clock(use)}")
    return _first(lines)


def format_stated_models(states: Sequence[StatedModel]) -> str:
    """Returns the stated models of a link; of many changes the last one."""
    first, *later = states
    words = [first.link.describe()]
    if len(later) > 2:
        words.append(f"{count_nouns(len(later) - 1, 'change')}")
        later = later[-1:]
    words += [f"{link.describe()} from {from_s:g} s on" for from_s, link in later]
    return ", then ".join(words)


def format_clock(use: link_summary.ClockSummary) -> str:
    """Returns offset, bound and drift of a clock in a few words."""
    known = f"known to {use.bound_us} us (p50 {use.bound_p50_us:.0f}, max {use.bound_max_us})"
    words = [f"{use.offset_us / 1e3:+.3f} ms at the end, {known}"]
    if use.drift_ppm is not None:
        words.append(f"drift {use.drift_ppm:+.2f} ppm")
    if use.faults:
        early = "sample came before it was sent", "samples came before they were sent"
        words.append(f"{count_nouns(use.faults, *early)}: a clock has stepped")
    return ", ".join(words)


def _ms(spread: link_summary.ValueStatistics, factor: float = 1.0) -> str:
    values = (spread.mean, spread.deviation, spread.p99, spread.max)
    mean, deviation, p99, largest = (_number(factor * value) for value in values)
    return f"{mean} +- {deviation} ms (p99 {p99}, max {largest})"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _losses(use: link_summary.LinkSummary, counts: link_summary.SampleCounts) -> str:
    losses = {
        "missing on the way": counts.missing,
        "lost": counts.lost,
        "late": counts.late,
        "superseded": counts.superseded,
        "duplicates": counts.duplicate + counts.copies,
    }
    judged = max(counts.judged, 1)
    words = [
        f"{name} {count} ({100 * count / judged:.3g} %)"
        for name, count in losses.items()
        if count
    ]
    if use.burst is not None and use.burst > 1.005:
        words.append(f"{_number(use.burst)} in a row")
    return ", ".join(words) or "nothing lost"


def _first(lines: list[str]) -> list[str]:
    more = len(lines) - MOST_LINES
    return (
        lines
        if more <= 0
        else [*lines[:MOST_LINES], f"and {more} more of this kind: see summary.json"]
    )


def compose_verification(found: LogCheckReport) -> Iterator[Block]:
    """Yields a line per check, and of a log that passed those of its run."""
    for line in found.findings:
        yield MarkedText("", f"{line.check}: {line.text}", failed=not line.passed)
    if found.passed:
        yield from format_run_lines(found.log)


def compose_log_check(found: LogCheckResult) -> Iterator[Block]:
    """Yields a line per check, and the places where it failed."""
    for finding in found.findings:
        mark = MARKS["ok" if finding.passed else "FAIL"]
        yield MarkedText(mark, f"{finding.check:<9}  {finding.text}")
        if finding.wrong == 1 and str(finding.places[0]) in finding.text:
            continue
        for place in finding.places[:_MAX_PLACES]:
            where = f"{place.file}: " if len(found.files) > 1 and place.file else ""
            yield f"       {where}{place}"
        if finding.wrong > _MAX_PLACES:
            yield f"       and {finding.wrong - _MAX_PLACES} more; --json names {len(finding.places)}"


def compose_recovery(found: Recovery) -> Iterator[Block]:
    """Yields what was recovered and what was lost."""
    how = "was finished" if found.finished else "was not finished"
    yield f"{found.output}: made of {found.path}, which {how}"
    rows = []
    if there := found.coverage.judged:
        rows.append(("records", ", ".join(f"{site} {count}" for site, count in there.items())))
        rows.append(("of the run", str(found.coverage)))
        rows.append(("source", f"digest chain {found.chain}"))
    rows.append(("messages", f"{found.messages} in {found.duration_s:.3f} s"))
    lists = [("lost", found.lost)]
    if found.coverage.expected:  # else nothing tells which records there should be
        lists.append(("missing", found.missing))
    for name, lines in lists:
        rows += [
            ("" if n else name, text)
            for n, text in enumerate(lines[:_MAX_LOSSES] or ["nothing"])
        ]
        if len(lines) > _MAX_LOSSES:
            rows.append(("", f"and {len(lines) - _MAX_LOSSES} more; --json lists all"))
    yield TextTable(("", ""), [(f"  {name}", text) for name, text in rows])


def compose_rerun(again: Rerun) -> Iterator[Block]:
    """Yields what was executed with which changes, a table of the sites, and the other effects."""
    asked = again.request
    others = f"; {', '.join(asked.recorded)} as recorded" if asked.recorded else ""
    yield f"{asked.mode}: {', '.join(asked.replaced)} executed afresh{others}"
    for line in describe_rerun_changes(asked) or [
        "nothing is changed: this is the experiment of the log"
    ]:
        yield f"  {line}"
    headers = (
        "ticks",
        "identical",
        "rms e rad",
        "here",
        "max e rad",
        "here",
        "max tau N m",
        "here",
    )
    rows = []
    for effect in again.sites.values():
        cells = []
        for pair in (effect.error_rms_rad, effect.error_max_rad, effect.torque_max_nm):
            cells += ["", ""] if pair is None else [f"{value:#.3g}" for value in pair]
        rows.append([effect.site, str(effect.executed), str(effect.identical), *cells])
    yield TextTable(("site", *headers), rows, align="lr")
    yield from _describe_effects(again)
    yield from (f"note: {note}" for note in again.notes)


def _describe_effects(again: Rerun) -> list[str]:
    lines = []
    for effect in again.sites.values():
        if effect.q_max_rad:
            most = effect.q_max_rad
            at_s = effect.q_max_at_s
            rms = effect.q_rms_rad
            lines.append(
                f"{effect.site}: q is up to {most:.3g} rad off the log, at {at_s:.3f} s; {rms:.3g} rad rms"
            )
        if effect.first is not None:
            first = effect.first
            at_s = first.tick / again.request.scenario.sites[effect.site].rate_hz
            was, now = _values(first.logged, first.computed)
            where = f"tick {first.tick} ({at_s:.3f} s)"
            lines.append(
                f"{effect.site}: the first difference is at {where}: {first.field} was {was}, is {now}"
            )
        if effect.diverged_at_s is not None:
            lines.append(
                f"{effect.site}: diverged at {effect.diverged_at_s:.3f} s and ends there"
            )
    for link in (link for link in again.links.values() if link.differs):
        before, after = (
            f"{mean:.4g} ms old on average, {most:.4g} ms at most"
            for mean, most in zip(link.age_mean_ms, link.age_max_ms, strict=True)
        )
        lines.append(f"link {link.link}: samples in use were {before}; are {after}")
    return lines


def _values(before: object, after: object) -> tuple[str, str]:
    short = tuple(
        f"{value:.6g}" if isinstance(value, float) else str(value) for value in (before, after)
    )
    return (short[0], short[1]) if short[0] != short[1] else (repr(before), repr(after))


def compose_doctor(found: Result) -> Iterator[Block]:
    """Yields a line per finding."""
    for finding in found.to_dict()["findings"]:
        yield MarkedText(MARKS[finding["state"]], f"{finding['check']:<10}  {finding['text']}")


def compose_ping(found: Result) -> Iterator[Block]:
    """Yields the members with round trips and clocks, and the links as the sites measure them."""
    facts = found.to_dict()
    members = facts["members"]
    links = facts["links"]
    state = "runs" if any(member["running"] for member in members) else "waits for its members"
    yield f"session {facts['session']} {state}; times in us; a clock is the one there minus the one here"
    rows = []
    for member in members:
        rtt = member.get("rtt_us", {})
        numbers = [*(rtt.get(name) for name in ("min", "p50", "p99")), member.get("jitter_us")]
        times = ("" if number is None else f"{number:.0f}" for number in numbers)
        rows.append(
            [member["member"], member["host"], str(member["answers"]), *times, _clock(member)]
        )
    headers = ("member", "host", "answers", "rtt min", "p50", "p99", "jitter", "clock")
    yield TextTable(headers, rows, align="llrrrrrl")
    if links:
        yield "between the sites, in the last tenth of a second of each:"
        rows = []
        for link in links:
            delays_us = [link["delay_us"], link["delay_max_us"], link["rtt_us"]]
            shown = ["none" if delay_us < 0 else str(delay_us) for delay_us in delays_us]
            offset = [f"{link['offset_us'] / 1e6:.6f}", str(link["bound_us"])]
            rows.append([link["from"], link["to"], *shown, *offset])
        heads = ("from", "to", "delay p50", "max", "rtt min", "offset s", "+- us")
        yield TextTable(heads, rows, align="llr")


_BARS = " ▁▂▃▄▅▆▇█"


def compose_topic_delays(found: Result) -> Iterator[Block]:
    """Yields a row per publisher, and how its delays are spread from the least to the largest."""
    facts = found.to_dict()
    yield f"/{facts['topic']}, {facts['lasted_s']:.3g} s; times in us, from sending to arrival here"
    rows = []
    least = 0.0
    for one in facts["publishers"]:
        times = one["delay_us"]
        counts = one["histogram"]["counts"]
        bars = "".join(_BARS[-(-8 * count // max(counts))] for count in counts)
        numbers = [str(one["messages"]), str(one["lost"]), f"{one['rate_hz']:.1f}"]
        rows.append(
            [
                one["gid"][:8],
                one["type"],
                *numbers,
                *(f"{times[name]:.0f}" for name in times),
                bars,
            ]
        )
        least = min(least, times["min"])
    headers = (
        "publisher",
        "type",
        "messages",
        "lost",
        "Hz",
        "min",
        "p50",
        "p99",
        "max",
        "min to max",
    )
    yield TextTable(headers, rows, align="llrrrrrrrl")
    if least < 0.0:
        yield "delays below 0: the clock there is ahead of the one here"
    yield "between two machines these contain the offset of their clocks"


def _clock(member: dict[str, Any]) -> str:
    if member["same_clock"]:
        return "the same clock"
    if "offset_ns" not in member:
        return "another clock"
    return f"{member['offset_ns'] / 1e9:.6f} s +- {member['bound_us']:.0f}"


def compose_benchmark(found: Result) -> Iterator[Block]:
    """Yields a row per size, rate and transport, and per transport whether that is good enough."""
    facts = found.to_dict()
    needs = facts["needs"]
    name = facts["scenario"]
    yield "one way is half a round trip, the far end's handling with it; times in us"
    rows = []
    for row in facts["rows"]:
        times = row["one_way_us"] or {}
        shown = [f"{times[key]:.0f}" if key in times else "" for key in ("p50", "p99", "max")]
        own = (row["bytes"], row["rate_hz"]) == (needs["sample_bytes"], needs["rate_hz"])
        counts = [row["bytes"], f"{row['rate_hz']:g}", row["sent"], row["lost"]]
        rows.append([row["transport"], *map(str, counts), *shown, name if own else ""])
    headers = ("transport", "bytes", "rate", "sent", "lost", "p50", "p99", "max", "is that of")
    yield TextTable(headers, rows, align="lrrrrrrrl", units=("", "", "Hz"))
    yield f"{name}: {needs['words']}"
    for one in facts["transports"]:
        yield MarkedText(
            MARKS["ok" if one["good"] else "fail"],
            f"{one['transport']}: {_judgement(one, needs)}",
        )


def _judgement(one: dict[str, Any], needs: dict[str, Any]) -> str:
    if one["p99_ms"] is None:
        return "nothing came back"
    parts = [f"p99 {one['p99_ms']:.3g} ms"]
    if needs["held_ms"]:
        held = f"the {needs['held_ms']:g} ms for which links hold samples"
        parts[0] += f" {'hides in' if one['hidden'] else 'exceeds'} {held}"
    parts.append(f"samples are in use {one['age_ms']:.4g} ms old")
    if one["spare_ms"] is not None:
        parts.append(f"{one['spare_ms']:.4g} ms to spare")
    elif needs["stable_ms"] is not None:
        parts.append("at which the loop is not stable")
    if one["lost_share"]:
        parts.append(f"{100 * one['lost_share']:.3g} % lost")
    parts.append(f"a play-out of {one['playout_ms']} ms would hold every one of these samples")
    return ", ".join(parts[:-1]) + "; " + parts[-1]


def compose_metrics(found: LogMetrics) -> Iterator[Block]:
    """Yields a table per group and kind of place, statics, impedances, and reasons of missing
    numbers.
    """
    reasons: dict[str, list[str]] = {}
    for (group, _), members in groupby(quantities(), key=lambda one: (one.group, one.of)):
        yield from _compose_group(group, list(members), found, reasons)
    yield from _compose_statics(found)
    yield from _compose_impedance(found)
    for why, where in reasons.items():
        yield _explain_missing(sanitize(", ".join(where)), why)


def _explain_missing(what: str, why: str) -> MarkedText:
    return MarkedText(f"[bold]{_NO_NUMBER}[/bold]", f"{what}: {sanitize(why)}")


def _compose_group(
    group: str, members: Sequence[Quantity], found: LogMetrics, reasons: dict[str, list[str]]
) -> Iterator[Block]:
    """Yields a row per quantity and a column per place that apply; collects reasons of missing
    numbers.
    """
    rows = {quantity: found.values_of(quantity) for quantity in members}
    could = {
        q: places for q, places in rows.items() if any(one.applies for one in places.values())
    }
    names = [
        name
        for name in next(iter(rows.values()))
        if any(places[name].applies for places in could.values())
    ]
    if not names:
        return
    cells = [
        [q.name, q.unit, *(_write_metric(places[name]) for name in names)]
        for q, places in could.items()
    ]
    yield from _tabulate([group, "", *names], cells, words=2)
    for quantity, places in could.items():
        for name in names:
            if places[name].value is None and places[name].applies:
                where = f"{quantity.name} of {name}" if name else quantity.name
                reasons.setdefault(places[name].why, []).append(where)


def _compose_statics(found: LogMetrics) -> Iterator[Block]:
    if found.sharing_ratios:
        joint, nm = ("axis", found.unit("N m", 1)) if found.axes else ("joint", "N m")
        heads = ("at rest", joint, "ON the arm of", nm, "felt at", nm, "expected", "off")
        rows = []
        for pair in found.sharing_ratios:
            pushed = f"{pair.pushed}{' (wall)' if pair.by_wall else ''}"
            off = _NO_NUMBER if pair.off is None else f"{100.0 * pair.off:.3g} %"
            when = f"{pair.from_s:.1f} - {pair.to_s:.1f} s"
            which = found.label(pair.joint)
            row = [when, which, pushed, _write_value(pair.pushed_nm)]
            rows.append(
                [
                    *row,
                    pair.holds,
                    _write_value(pair.felt_nm),
                    _write_metric(pair.expected_nm),
                    off,
                ]
            )
        yield from _tabulate(heads, rows, words=1)
        for why in dict.fromkeys(pair.expected_nm.why for pair in found.sharing_ratios):
            if why:
                yield _explain_missing("nothing is expected", why)
    if found.stiffness:
        rows = []
        for one in found.stiffness:
            stiffness = (
                _NO_NUMBER
                if one.stiffness_nm_rad is None
                else _write_value(one.stiffness_nm_rad)
            )
            row = [f"{one.from_s:.1f} to {one.to_s:.1f} s", found.label(one.joint), one.site]
            rows.append(
                [*row, _write_value(one.torque_nm), _write_value(one.angle_rad), stiffness]
            )
        nm, rad, ratio = (found.unit(unit, 1) for unit in ("N m", "rad", "N m/rad"))
        joint = "axis" if found.axes else "joint"
        yield from _tabulate(
            ("stiffness felt", joint, "by", f"{nm} more", f"{rad} further", ratio),
            rows,
            words=1,
        )


def _compose_impedance(found: LogMetrics) -> Iterator[Block]:
    if not found.responses:
        return
    rows = []
    for one in found.responses:
        where = f"{'along' if found.axes else 'joint'} {found.label(one.joint)}"
        what = f"{one.kind}{f' of {one.of}' if one.of else ''} at {one.at}, {where}"
        step = -(-len(one.spectrum) // _MAX_FREQUENCIES) or 1
        for n, ratio in enumerate(
            one.spectrum[::step] if len(one.spectrum) > 1 else [one.ratio]
        ):
            head = ["" if n else what, found.unit(one.unit, one.joint)]
            if ratio.gain is None:
                rows.append([*head, "", "", "", "", ratio.why])
                continue
            numbers = (ratio.frequency_hz, ratio.gain, ratio.phase_rad, ratio.coherence)
            error = _NO_NUMBER if ratio.error is None else f"{100.0 * ratio.error:.1g} %"
            rows.append(
                [*head, *(_write_value(value or 0.0) for value in numbers), f"+- {error}"]
            )
    yield from _tabulate(
        ["felt over frequency", "", "Hz", "gain", "phase rad", "coherence", ""], rows, words=2
    )


def _write_metric(one: Metric) -> str:
    return _NO_NUMBER if one.value is None else _write_value(one.value)


def _write_value(value: float) -> str:
    return f"{value:.0f}" if value == int(value) and abs(value) < 1e6 else f"{value:.4g}"


def _tabulate(
    heads: Sequence[str], rows: Iterable[Sequence[str]], words: int
) -> Iterator[Block]:
    """Yields a table and an empty line; its first columns hold words, the others numbers."""
    align = "l" * words + "r" * (len(heads) - words - 1) + ("r" if heads[-1] else "l")
    yield TextTable(heads, list(rows), align)
    yield ""
