"""The command that lets sites meet that cannot reach each other: router."""

from typing import Annotated

import typer

from .options import ConnectOption, ZenohConfigOption, finite_seconds, say

app = typer.Typer()

EVERYWHERE = "tcp/0.0.0.0:7447"


@app.command(epilog=f"Example: trilat router --listen {EVERYWHERE}")
def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(
            "--listen", metavar="EP", help=f"Endpoint to listen at; repeatable; default: {EVERYWHERE}."
        ),
    ] = None,
    connect: ConnectOption = None,
    zenoh_config: ZenohConfigOption = None,
    until_idle: Annotated[
        float | None,
        typer.Option(
            "--until-idle",
            metavar="S",
            help="End once all members have left for so long, s; default: stay.",
            callback=finite_seconds,
        ),
    ] = None,
) -> None:
    """Lets sites meet that cannot reach each other directly, as behind NAT.

    Sites and recorder name it with --router, in any order of starts. It runs until Ctrl-C; a session goes on
    when it is started again. Several routers that --connect to each other are one.
    """
    from ..interrupt import Interrupt
    from ..net.clock import SystemClock
    from ..net.connection import open_bus, router_connection
    from ..net.router import run_router
    from ..net.zenoh_bus import read_zenoh_file

    file = None if zenoh_config is None else read_zenoh_file(zenoh_config)
    connection = router_connection(listen, connect, file, [EVERYWHERE])
    clock = SystemClock()
    with Interrupt() as interrupt:
        bus = open_bus(connection, clock, interrupt.requested, None, say)
        if bus is None:
            raise typer.Exit(interrupt.exit_code)
        try:
            say(f"router: listening at {', '.join(map(str, connection.listen))}; Ctrl-C ends it")
            run_router(bus, clock, interrupt.requested, lambda text: say(f"router: {text}"), until_idle)
        finally:
            bus.close()
        raise typer.Exit(interrupt.exit_code if interrupt.requested() else 0)
