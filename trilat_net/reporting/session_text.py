"""What was measured of a running session, and of this machine, as text."""

from collections.abc import Iterator
from typing import Any

from ..results import Result
from .result_text import Block, MarkedText, TextTable

MARKS = {"ok": "[green]ok[/green]  ", "warn": "[yellow]warn[/yellow]", "fail": "[red]fail[/red]"}


def compose_doctor(found: Result) -> Iterator[Block]:
    """Yields a line per finding."""
    for finding in found.to_dict()["findings"]:
        yield MarkedText(MARKS[finding["state"]], f"{finding['check']:<10}  {finding['text']}")


def compose_ping(found: Result) -> Iterator[Block]:
    """Yields the members with round trips and clocks, and the links as the sites measure them."""
    facts = found.to_dict()
    members, links = facts["members"], facts["links"]
    state = "runs" if any(member["running"] for member in members) else "waits for its members"
    yield f"session {facts['session']} {state}; times in us; a clock is the one there minus the one here"
    rows = []
    for member in members:
        rtt = member.get("rtt_us", {})
        numbers = [*(rtt.get(name) for name in ("min", "p50", "p99")), member.get("jitter_us")]
        times = ("" if number is None else f"{number:.0f}" for number in numbers)
        rows.append([member["member"], member["host"], str(member["answers"]), *times, _clock(member)])
    headers = ("member", "host", "answers", "rtt min", "p50", "p99", "jitter", "clock")
    yield TextTable(headers, rows, align="llrrrrrl")
    if links:
        yield "between the sites, in the last tenth of a second of each:"
        yield _tabulate_links(links)


_BARS = " ▁▂▃▄▅▆▇█"


def compose_topic_delays(found: Result) -> Iterator[Block]:
    """Yields a row per publisher, and how its delays are spread from the least to the largest."""
    facts = found.to_dict()
    yield f"/{facts['topic']}, {facts['lasted_s']:.3g} s; times in us, from sending to arrival here"
    rows, least = [], 0.0
    for one in facts["publishers"]:
        times, counts = one["delay_us"], one["histogram"]["counts"]
        bars = "".join(_BARS[-(-8 * count // max(counts))] for count in counts)
        numbers = [str(one["messages"]), str(one["lost"]), f"{one['rate_hz']:.1f}"]
        rows.append([one["gid"][:8], one["type"], *numbers, *(f"{times[name]:.0f}" for name in times), bars])
        least = min(least, times["min"])
    headers = ("publisher", "type", "messages", "lost", "Hz", "min", "p50", "p99", "max", "min to max")
    yield TextTable(headers, rows, align="llrrrrrrrl")
    if least < 0.0:
        yield "delays below 0: the clock there is ahead of the one here"
    yield "between two machines these contain the offset of their clocks"


def _tabulate_links(links: list[dict[str, Any]]) -> TextTable:
    rows = []
    for link in links:
        times = [link["delay_us"], link["delay_max_us"], link["rtt_us"]]
        numbers = ["none" if time < 0 else str(time) for time in times]
        offset = [f"{link['offset_us'] / 1e6:.6f}", str(link["bound_us"])]
        rows.append([link["from"], link["to"], *numbers, *offset])
    return TextTable(("from", "to", "delay p50", "max", "rtt min", "offset s", "+- us"), rows, align="llr")


def _clock(member: dict[str, Any]) -> str:
    if member["same_clock"]:
        return "the same clock"
    if "offset_ns" not in member:
        return "another clock"
    return f"{member['offset_ns'] / 1e9:.6f} s +- {member['bound_us']:.0f}"


def compose_benchmark(found: Result) -> Iterator[Block]:
    """Yields a row per size, rate and transport, and per transport whether that is good enough."""
    facts = found.to_dict()
    needs, name = facts["needs"], facts["scenario"]
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
            MARKS["ok" if one["good"] else "fail"], f"{one['transport']}: {_judgement(one, needs)}"
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
        parts.append(f"{100 * one['lost_share']:.2g} % lost")
    parts.append(f"a play-out of {one['playout_ms']} ms would hold every one of these samples")
    return ", ".join(parts[:-1]) + "; " + parts[-1]
