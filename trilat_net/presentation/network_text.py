"""Composes the text on this machine, the members of a session, and the network between them."""

from collections.abc import Iterator
from typing import Any

from ..results import Result
from .result_text import MARKS, Block, MarkedText, TextTable


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
