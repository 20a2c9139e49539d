"""`trilat watch`: shows a running session in a terminal."""

from functools import partial
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
    from live.terminal_watch import show_in_terminal, watch_session

    from ..net.clock import SystemClock

    name, clock = options.check_session_name(session), SystemClock()
    connection = options.resolve_client_connection(connect, router, zenoh_config, keys)
    show = partial(show_in_terminal, clock, name, terminal.out)
    raise typer.Exit(watch_session(name, connection, clock, show, terminal.print_line, timeout))
