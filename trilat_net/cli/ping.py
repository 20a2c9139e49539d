"""`trilat ping`: round trips, clock offsets and links of a session."""

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
    from sites.session_ping import describe_ping, ping_session

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
    found = describe_ping(session, probe)
    terminal.print_result(found, as_json=as_json)
    if not any(member["answers"] for member in found.members):
        raise typer.Exit(1)
