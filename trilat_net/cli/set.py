"""`trilat set`: changes a link or a row of the dominance matrix while a session runs."""

import re
import tomllib
from typing import Annotated, Any

import typer

from ..errors import UsageError
from ..reporting import terminal_output as terminal
from . import options

_UNITS = {"us": 1e-3, "ms": 1.0, "s": 1e3}


def parse_milliseconds(text: str) -> float:
    """Returns a time with its unit, as in 350ms or 0.35s, in ms."""
    match = re.fullmatch(r"([-+.\deE]+?)\s*(us|ms|s)", text.strip())
    try:
        if match:
            return float(match[1]) * _UNITS[match[2]]
    except ValueError:
        pass
    raise UsageError(f"a time is a number and its unit, as in 350ms or 0.35s, not {text!r}")


def parse_share(text: str) -> float:
    """Returns a share, as in 5% or 0.05."""
    number = text.strip().removesuffix("%")
    try:
        return float(number) / (100.0 if number != text.strip() else 1.0)
    except ValueError:
        raise UsageError(f"a share is a number or a percentage, as in 0.05 or 5%, not {text!r}") from None


def parse_pairs(texts: list[str], example: str) -> dict[str, Any]:
    """Returns KEY=VALUE texts as a table; a value is TOML or a bare word."""
    table: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"a change reads KEY=VALUE, as in {example}, not {text!r}")
        try:
            table[key.strip()] = tomllib.loads(f"value = {value}")["value"]
        except ValueError:  # TOMLDecodeError is one; a number of 5000 digits is another
            table[key.strip()] = value.strip()
    return table


def set_command(
    context: typer.Context,
    session: Annotated[str | None, options.value("--session", "ID", "Session to change; required.")] = None,
    connect: options.ConnectOption = None,
    router: options.RouterOption = None,
    zenoh_config: options.ZenohConfigOption = None,
    keys: options.KeysOption = None,
) -> None:
    """Changes a link, or a row of the dominance matrix, while a session runs.

    Without endpoints it asks the first site, at its loopback port, for the others.
    """
    name = None if session is None else options.check_session_name(session)
    context.obj = name, options.resolve_client_connection(connect, router, zenoh_config, keys)


def set_link_command(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="The link, as in m1->s.", metavar="FROM->TO")],
    delay: Annotated[str | None, typer.Option("--delay", help="New delay, as in 350ms.")] = None,
    loss: Annotated[str | None, typer.Option("--loss", help="New loss, as in 5%.")] = None,
    preset: Annotated[str | None, typer.Option("--preset", help="A named link, as in 4g.")] = None,
    to: Annotated[
        list[str] | None,
        options.value("--to", "KEY=VALUE", "Any key of a link, as in model=gamma; repeatable."),
    ] = None,
) -> None:
    """Changes the given keys of a directed link; a model or a preset replaces all of them."""
    table = parse_pairs(to or [], "deviation_ms=20")
    if preset is not None:
        table["preset"] = preset
    if delay is not None:
        table["delay_ms"] = parse_milliseconds(delay)
    if loss is not None:
        table["loss"] = parse_share(loss)
    if not table:
        raise UsageError("nothing to change: give --delay, --loss, --preset or --to KEY=VALUE")
    _, arrow, receiver = name.partition("->")
    if not arrow:
        raise UsageError(f"a link is FROM->TO in quotes, as in 'm1->s', not {name!r}")
    _send_change(context, receiver, {"link": name, "to": table})


def set_dominance_command(
    context: typer.Context,
    site: Annotated[str, typer.Argument(help="Site whose dominance row changes.")],
    shares: Annotated[
        list[str], typer.Argument(metavar="PEER=SHARE...", help="New shares of its peers, which sum to 1.")
    ],
    ramp: Annotated[str, typer.Option("--ramp", help="Duration of the change, as in 2s.")] = "1s",
) -> None:
    """Changes one row of the dominance matrix along a linear ramp; it sums to 1 throughout."""
    table = {peer: parse_share(str(value)) for peer, value in parse_pairs(shares, "m1=0.9").items()}
    _send_change(context, site, {"dominance": site, "to": table, "ramp_s": parse_milliseconds(ramp) / 1e3})


def _send_change(context: typer.Context, site: str, order: dict[str, Any]) -> None:
    from sites.running_session import RunningSession

    from ..net.requests import ChangeRequest
    from ..scenario.fields import check_finite

    session, connection = context.obj
    check_finite(order, "")  # a message holds no others
    if session is None:
        raise UsageError("the session is missing: trilat set --session ID ...")
    reply = RunningSession(session, connection).change(site, ChangeRequest(**order))
    if not reply.accepted:
        raise UsageError(f"refused: {reply.text}")
    terminal.print_text(reply.text)
