"""`trilat ping`: round trips, clock offsets and links of a session."""

from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from ..reporting.text_table import TextTable
from . import options

if TYPE_CHECKING:
    from sites.session_ping import PingResult, SessionPing


def _check_count(value: int) -> int:
    if not 5 <= value <= 10_000:
        raise UsageError(f"--count is a number from 5 to 10000, not {value}")
    return value


def ping_command(
    session: Annotated[str, typer.Option("--session", metavar="ID", help="Session to measure.")] = "paper",
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    count: Annotated[
        int, typer.Option("--count", metavar="N", help="Round trips to each member.", callback=_check_count)
    ] = 50,
    timeout: options.AnswerOption = 3.0,
    as_json: options.JsonOption = False,
    clock_offset: options.ClockOffsetOption = 0.0,
    clock_drift: options.ClockDriftOption = 0.0,
) -> None:
    """Shows round trip, clock offset and jitter between here and every member of a session.

    The session may be waiting for members or running; then the links that its sites measure are shown too.
    Without endpoints it asks the first site, at its loopback port, for the others.
    """
    from sites.session_ping import ping_session

    from ..net.clock import make_system_clock
    from ..process import Interrupt

    connection = options.resolve_client_connection(connect, router, zenoh_config, keys)
    clock = make_system_clock(clock_offset, clock_drift)
    with Interrupt() as interrupt:
        probe = ping_session(
            connection, clock, options.check_session_name(session), count, timeout, interrupt.requested
        )
        if probe is None:
            raise typer.Exit(interrupt.exit_code)
    members, links = [_member(reach) for reach in probe.reached()], _links(probe)
    if as_json:
        terminal.print_json({"session": session, "members": members, "links": links})
    else:
        _show(session, members, links)
    if not any(member["answers"] for member in members):
        raise typer.Exit(1)


def _member(reach: "PingResult") -> dict[str, Any]:
    info, rtts = reach.info, sorted(reach.rtts_ns)
    facts: dict[str, Any] = {
        "member": info.member,
        "host": info.host,
        "running": info.running,
        "ticks": info.ticks,
        "answers": len(rtts),
        "same_clock": reach.shared,
    }
    if rtts:
        steps = [abs(b - a) for a, b in zip(reach.rtts_ns, reach.rtts_ns[1:], strict=False)]
        facts["rtt_us"] = {
            "min": rtts[0] / 1000,
            "p50": rtts[len(rtts) // 2] / 1000,
            "p99": rtts[min(len(rtts) - 1, len(rtts) * 99 // 100)] / 1000,
        }
        facts["jitter_us"] = sum(steps) / max(1, len(steps)) / 1000
    if reach.estimate is not None:
        estimate = reach.estimate
        facts["offset_ns"] = estimate.offset_ns
        facts["bound_us"] = estimate.bound_at(estimate.at_ns, estimate.offset_ns) / 1000
    return facts


def _links(probe: "SessionPing") -> list[dict[str, Any]]:
    """Returns the links as running sites measure them; times in us."""
    return [
        {
            "from": peer,
            "to": site,
            "delay_us": stats.delay_us[peer],
            "delay_max_us": stats.delay_max_us.get(peer, -1),
            "rtt_us": stats.rtt_us.get(peer, -1),
            "offset_us": stats.offset_us.get(peer, 0),
            "bound_us": stats.bound_us.get(peer, 0),
        }
        for site, stats in sorted(probe.links.items())
        for peer in stats.delay_us
    ]


def _show(session: str, members: list[dict[str, Any]], links: list[dict[str, Any]]) -> None:
    state = "runs" if any(member["running"] for member in members) else "waits for its members"
    terminal.print_text(
        f"session {session} {state}; times in us; a clock is the one there minus the one here"
    )
    rows = []
    for member in members:
        rtt = member.get("rtt_us", {})
        numbers = [*(rtt.get(name) for name in ("min", "p50", "p99")), member.get("jitter_us")]
        times = ("" if number is None else f"{number:.0f}" for number in numbers)
        rows.append([member["member"], member["host"], str(member["answers"]), *times, _clock(member)])
    headers = ("member", "host", "answers", "rtt min", "p50", "p99", "jitter", "clock")
    terminal.print_table(TextTable(headers, rows, align="llrrrrrl"))
    if links:
        terminal.out.print("between the sites, in the last tenth of a second of each:")
        terminal.print_table(_tabulate_links(links))


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
