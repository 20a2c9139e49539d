"""`trilat stop`, `enable`, `reset`: stops arms while their session goes on, and lets them follow again."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import RunFailed, UsageError
from ..reporting import terminal_output as terminal
from . import options

if TYPE_CHECKING:
    from ..net.bus import Bus
    from ..net.clock import Clock
    from ..net.connection import Connection
    from ..net.requests import OrderName

SessionOption = Annotated[str, typer.Option("--session", metavar="ID", help="The session.")]
SitesArgument = Annotated[list[str] | None, typer.Argument(metavar="SITE...", help="Default: all.")]


def _with_session(session: str, connection: "Connection", act: "Callable[[Bus, Clock, str], None]") -> None:
    """Connects to a session and acts on it."""
    from ..net.clock import SystemClock
    from ..net.discovery import REPLY_TIMEOUT_S, connect_to_session
    from ..scenario import embedded_names_reader

    name, clock = options.check_session_name(session), SystemClock()
    reader = embedded_names_reader(name)
    with connect_to_session(
        connection, clock, name, reader, stopped=lambda: False, timeout_s=REPLY_TIMEOUT_S
    ) as bus:
        assert bus is not None  # nothing stops it
        act(bus, clock, name)


def _order(session: str, connection: "Connection", sites: list[str] | None, order: "OrderName") -> None:
    """Gives sites an order and prints their answers.

    Raises:
        RunFailed: a site refused it.
    """
    from sites.session_stop import order_sites

    def act(bus: "Bus", clock: "Clock", name: str) -> None:
        replies = order_sites(bus, clock, name, sites or (), order)
        for reply in replies:
            terminal.print_text(reply.text)
        if refused := [reply.member for reply in replies if not reply.accepted]:
            raise RunFailed(f"{', '.join(refused)} did not {order}")

    _with_session(session, connection, act)


def stop_command(
    session: SessionOption,
    sites: SitesArgument = None,
    end: Annotated[
        bool,
        typer.Option("--end", help="End the whole session instead; recorders get every record."),
    ] = False,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
) -> None:
    """Stops arms at once while the session goes on: their torque blends into damping and gravity in 100 ms.

    They stay stopped until `trilat enable`. With --end all sites end their run at the same time instead.
    Without endpoints it asks the first site, at its loopback port, for the others.
    """
    connection = options.resolve_client_connection(connect, router, zenoh_config, keys, operates=end)
    if not end:
        _order(session, connection, sites, "stop")
        return
    if sites:
        raise UsageError("--end ends the whole session: name no site")
    from sites.session_stop import stop_session

    def act(bus: "Bus", clock: "Clock", name: str) -> None:
        for text in stop_session(bus, clock, name):
            terminal.print_text(text)

    _with_session(session, connection, act)


def enable_command(
    session: SessionOption,
    sites: SitesArgument = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
) -> None:
    """Lets stopped arms follow again: they wait for their peers and align with them."""
    connection = options.resolve_client_connection(connect, router, zenoh_config, keys)
    _order(session, connection, sites, "enable")


def reset_command(
    session: SessionOption,
    sites: Annotated[list[str], typer.Argument(metavar="SITE...", help="The sites in fault.")],
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
) -> None:
    """Ends the fault of sites unless its cause persists: they wait for their peers and align with them."""
    connection = options.resolve_client_connection(connect, router, zenoh_config, keys)
    _order(session, connection, sites, "reset")
