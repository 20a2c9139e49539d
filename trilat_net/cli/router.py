"""`trilat router`: connects sites that cannot reach each other directly."""

from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options

LOOPBACK, ANY_ADDRESS = "tcp/127.0.0.1:7447", "tls/0.0.0.0:7447"


def router_command(
    listen: Annotated[
        list[str] | None,
        options.value(
            "--listen",
            "EP",
            f"Endpoint to listen at; repeatable; default: with --keys {ANY_ADDRESS}, else {LOOPBACK}.",
        ),
    ] = None,
    connect: options.ConnectOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
    insecure: options.InsecureOption = False,
    until_idle: Annotated[
        float | None,
        options.seconds(
            "--until-idle", "End once all members have been gone for this long, s; default: never."
        ),
    ] = None,
) -> None:
    """Connects sites that cannot reach each other directly, for example behind NAT.

    Sites and the recorder name it with --router and start in any order. It runs until Ctrl-C; a session
    continues when the router is restarted. Routers that --connect to each other act as one.
    """
    from ..net.access_rules import ROUTER
    from ..net.clock import SystemClock
    from ..net.connection import open_bus, resolve_member_connection, run_router, secure_connection
    from ..net.zenoh_bus import read_zenoh_file
    from ..process import Interrupt

    file = None if zenoh_config is None else read_zenoh_file(zenoh_config)
    places = [LOOPBACK if keys is None else ANY_ADDRESS]
    named = resolve_member_connection(listen, connect, None, file, places, (), routes=True)
    connection = secure_connection(named, keys, insecure=insecure).require(ROUTER)
    clock = SystemClock()
    with Interrupt() as interrupt:
        bus = open_bus(connection, clock, interrupt.requested, None, terminal.print_line)
        if bus is None:
            raise typer.Exit(interrupt.exit_code)
        try:
            _say(f"listening at {', '.join(map(str, connection.listen))}; Ctrl-C ends it")
            run_router(bus, clock, interrupt.requested, _say, until_idle)
        finally:
            bus.close()
        raise typer.Exit(interrupt.exit_code if interrupt.requested() else 0)


def _say(text: str) -> None:
    terminal.print_line(f"router: {text}")
