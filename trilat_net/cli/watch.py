"""`trilat watch`: shows a running session in a terminal."""

from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options


def watch_command(
    session: Annotated[str, options.value("--session", "ID", "Session to watch.")],
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    timeout: options.AnswerOption = 10.0,
) -> None:
    """Shows a running session in a terminal, with a line per site, until the session ends or Ctrl-C.

    Each line has angles, |e|, torque, mode, the age of each peer's sample and who holds the arm. The line
    above has V. Without endpoints it asks the first site, at its loopback port, for the others.
    """
    from live.terminal_watch import watch_session

    from ..net.clock import SystemClock
    from ..net.discovery import connect_to_session
    from ..process import Interrupt
    from ..scenario import embedded_names_reader

    name, clock = options.check_session_name(session), SystemClock()
    connection = options.resolve_client_connection(connect, router, zenoh_config, keys)
    with Interrupt() as interrupt:
        names, stopped = embedded_names_reader(name), interrupt.requested
        reached = connect_to_session(connection, clock, name, names, stopped=stopped, timeout_s=timeout)
        with reached as bus:
            if bus is not None:
                watch_session(bus, clock, name, terminal.out, interrupt, timeout)
        if interrupt.requested():
            raise typer.Exit(interrupt.exit_code)
    terminal.print_text(f"session {name} has ended")
