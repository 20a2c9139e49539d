"""`trilat stop`: ends a session in order."""

from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options


def stop_command(
    session: Annotated[str, typer.Option("--session", metavar="ID", help="Session to end.")],
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
) -> None:
    """Ends a running session in order: all sites at one time, and every recorder with all records.

    Without endpoints it asks the first site, at its loopback port, for the others.
    """
    from sites.session_stop import stop_session

    from ..net.clock import SystemClock
    from ..net.discovery import REPLY_TIMEOUT_S, connect_to_session
    from ..scenario import embedded_names_reader

    name, clock = options.check_session_name(session), SystemClock()
    connection = options.resolve_connection(None, connect, router, zenoh_config, [], None, keys)
    with connect_to_session(
        connection,
        clock,
        name,
        embedded_names_reader(name),
        stopped=lambda: False,
        timeout_s=REPLY_TIMEOUT_S,
    ) as bus:
        assert bus is not None  # nothing stops it
        for text in stop_session(bus, clock, name):
            terminal.print_text(text)
