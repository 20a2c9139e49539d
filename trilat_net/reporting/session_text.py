"""What was measured of a running session, and of this machine, as text."""

from collections.abc import Iterator
from typing import Any

from ..results import Result
from .result_text import Block, MarkedText
from .text_table import TextTable

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
