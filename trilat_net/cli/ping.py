"""`trilat ping`: round trips, clock offsets and links of a session; and the benchmark of a network."""

from pathlib import Path
from typing import Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options


def _check_count(value: int) -> int:
    if not 5 <= value <= 10_000:
        raise UsageError(f"--count is a number from 5 to 10000, not {value}")
    return value


def ping_command(
    context: typer.Context,
    session: Annotated[str, options.value("--session", "ID", "Session to measure.")] = "paper",
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    count: Annotated[
        int, typer.Option("--count", metavar="N", help="Round trips to each member.", callback=_check_count)
    ] = 50,
    timeout: options.AnswerOption = 3.0,
    benchmark: Annotated[
        str | None,
        typer.Option(
            "--benchmark",
            metavar="SCENARIO",
            help="Measure the network instead, by size, rate and transport, for this scenario.",
            autocompletion=options.complete_scenarios,
        ),
    ] = None,
    overrides: options.SetOption = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds",
            metavar="S",
            help="Duration of all cases together, s; default 24. With --answer: time until it ends.",
            callback=options.check_range(1.0, 86_400.0, "a number of seconds"),
        ),
    ] = None,
    picture: Annotated[
        Path | None, options.value("--figure", "FILE", "Draw the benchmark: .png, .svg or .pdf.")
    ] = None,
    force: options.ForceOption = False,
    answer: Annotated[
        list[str] | None,
        options.value("--answer", "EP", "Answer benchmarks from elsewhere, at this endpoint; repeatable."),
    ] = None,
    insecure: options.InsecureOption = False,
    as_json: options.JsonOption = False,
    clock_offset: options.ClockOffsetOption = 0.0,
    clock_drift: options.ClockDriftOption = 0.0,
) -> None:
    """Shows round trip, clock offset and jitter between here and every member of a session.

    The session may still wait for members. If it runs, the links that its sites measure are shown too.
    Without endpoints it asks the first site, at its loopback port, for the others.

    With --benchmark it needs no session: it measures if the network is good enough for a scenario, by the
    delay margin of trilat linear. The far end is trilat ping --answer EP on another machine, given as
    --connect EP; without one it runs here, over TCP, TLS and QUIC. This takes half a minute; exit code 1 if
    the network is not good enough.
    """
    if benchmark is not None or answer:
        _refuse_others(context, "--answer" if benchmark is None else "--benchmark")
    if benchmark is not None:
        return _benchmark(benchmark, overrides, seconds, connect, keys, picture, force, as_json)
    if answer:
        return _answer(answer, keys, seconds, insecure=insecure)
    _refuse_others(context, "")
    from sites.session_ping import ping_session

    from ..net.clock import make_system_clock
    from ..process import Interrupt

    connection = options.resolve_client_connection(connect, router, zenoh_config, keys, operates=False)
    clock = make_system_clock(clock_offset, clock_drift)
    with Interrupt() as interrupt:
        found = ping_session(
            connection, clock, options.check_session_name(session), count, timeout, interrupt.requested
        )
        if found is None:
            raise typer.Exit(interrupt.exit_code)
    terminal.print_result(found, as_json=as_json)
    if not any(member["answers"] for member in found.members):
        raise typer.Exit(1)
    return None


_OF_BENCHMARK = {"--benchmark", "--set", "--seconds", "--figure", "--force", "--connect", "--keys", "--json"}
_OF_ANSWER = {"--answer", "--seconds", "--keys", "--insecure"}


def _refuse_others(context: typer.Context, way: str) -> None:
    """Refuses options that have no meaning beside --benchmark, --answer, or neither."""
    given = set(options.given_options(context))
    own = {"--benchmark": _OF_BENCHMARK, "--answer": _OF_ANSWER}.get(way)
    alone = {"--set", "--seconds", "--figure", "--force", "--insecure"}
    if other := sorted(given & alone if own is None else given - own):
        raise UsageError(f"{other[0]}: {f'not with {way}' if way else 'only with --benchmark or --answer'}")


def _benchmark(
    scenario: str,
    overrides: list[str] | None,
    seconds: float | None,
    connect: list[str] | None,
    keys: Path | None,
    picture: Path | None,
    force: bool,
    as_json: bool,
) -> None:
    if picture is not None:
        options.check_picture(picture, force=force)
    from sites.network_benchmark import DEFAULT_S, ping_benchmark

    found = ping_benchmark(
        scenario, overrides or [], duration_s=seconds or DEFAULT_S, connect=connect, keys=keys
    )
    if picture is not None:
        from ..reporting.figures.network_delays import draw_network_delays
        from ..reporting.style import REPORT_DPI, write_figure

        write_figure(draw_network_delays(found.to_dict()), picture, REPORT_DPI)
    terminal.print_result(found, as_json=as_json)
    if picture is not None and not as_json:
        terminal.print_paths([picture])
    if not found.good:
        raise typer.Exit(1)


def _answer(endpoints: list[str], keys: Path | None, seconds: float | None, *, insecure: bool) -> None:
    from math import inf

    from sites.network_benchmark import run_far_end

    from ..process import Interrupt

    with Interrupt() as interrupt:
        stopped, last_s = interrupt.requested, seconds or inf
        run_far_end(endpoints, keys, stopped, last_s, insecure=insecure, say=terminal.print_line)
    if interrupt.requested():
        raise typer.Exit(interrupt.exit_code)
