"""`trilat stop`, `enable`, `reset`: stops arms while their session goes on, and lets them follow again."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options

if TYPE_CHECKING:
    from sites.running_session import RunningSession

SessionOption = Annotated[str, options.value("--session", "ID", "The session.")]
SitesArgument = Annotated[list[str] | None, typer.Argument(metavar="SITE...", help="Default: all.")]


def _find(
    session: str,
    connect: list[str] | None,
    router: list[str] | None,
    zenoh_config: Path | None,
    keys: Path | None,
) -> "RunningSession":
    from sites.running_session import RunningSession

    connection = options.resolve_client_connection(connect, router, zenoh_config, keys, operates=False)
    return RunningSession(options.check_session_name(session), connection)


def _print_answers(answers: list[str]) -> None:
    for text in answers:
        terminal.print_text(text)


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
    """Stops arms at once while the session goes on: they come to rest where they are.

    They stay stopped until `trilat enable`. With --end all sites end their run at the same time instead.
    Without endpoints it asks sites on this machine at once where their files say that they are, else the
    first site, at its loopback port, for the others.
    """
    if end and sites:
        raise UsageError("--end ends the whole session: name no site")
    running = _find(session, connect, router, zenoh_config, keys)
    _print_answers(running.end() if end else running.stop(*(sites or ())))


def enable_command(
    session: SessionOption,
    sites: SitesArgument = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
) -> None:
    """Lets stopped arms follow again: they wait for their peers and align with them."""
    _print_answers(_find(session, connect, router, zenoh_config, keys).enable(*(sites or ())))


def reset_command(
    session: SessionOption,
    sites: Annotated[list[str], typer.Argument(metavar="SITE...", help="The sites in fault.")],
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
) -> None:
    """Ends the fault of sites unless its cause persists: they wait for their peers and align with them."""
    _print_answers(_find(session, connect, router, zenoh_config, keys).reset(*sites))
