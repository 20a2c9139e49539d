"""`trilat keys`: keys that authenticate the members of a session, and keys that sign logs."""

from pathlib import Path
from typing import Annotated

import typer

from ..reporting import terminal_output as terminal
from . import options


def keys_new_command(
    folder: Annotated[Path, typer.Argument(help="New folder of the keys.", metavar="DIR")],
    members: Annotated[
        list[str],
        typer.Argument(
            help="The sites; and recorder, operator, router if there are any.", metavar="MEMBER..."
        ),
    ],
    hosts: Annotated[
        list[str] | None,
        options.value("--host", "NAME", "Host name or address at which a member listens; repeatable."),
    ] = None,
    days: Annotated[int, typer.Option("--days", min=1, max=3650, help="Validity of the certificates.")] = 30,
) -> None:
    """Makes keys: a private certificate authority, and for each member a folder for its machine alone.

    Bring each folder to its machine by a channel that you trust, and give it as --keys. Members without keys,
    or with keys of another authority, cannot connect; a member can send only under its own name. Keep the
    folder `authority` where no member runs, or delete it: new keys are always made for all members at once.
    """
    from ..net.member_keys import create_keys

    made = create_keys(folder, members, hosts or (), days)
    for one in made:
        terminal.print_line(f"{one}: for {one.name}")
    terminal.print_line(
        f"they are valid for {days} days; use them as in: trilat site {made[0].name} --keys {made[0]} ..."
    )


def keys_pair_command(
    name: Annotated[Path, typer.Argument(help="Makes NAME.key and NAME.pub.", metavar="NAME")],
) -> None:
    """Makes a pair of Ed25519 keys, to sign logs and to check signatures.

    Keep NAME.key private. Give NAME.pub, by a channel that they trust, to those who check your logs.
    """
    from ..log.log_signature import create_signing_keys

    private, public = create_signing_keys(name)
    terminal.print_text(f"{private}: signs, as in: trilat log sign run.mcap --key {private}")
    terminal.print_text(f"{public}: checks, as in: trilat log check run.mcap --key {public}")


def keys_info_command(
    folder: Annotated[Path, typer.Argument(help="Folder of one member's keys.", metavar="DIR")],
    as_json: options.JsonOption = False,
) -> None:
    """Shows whose keys these are, until when they are valid, and the Zenoh settings that follow from them."""
    from ..net.member_keys import read_member_keys

    keys = read_member_keys(folder)
    if as_json:
        facts = {"member": keys.member, "members": list(keys.members), "until": keys.ends.isoformat()}
        return terminal.print_json({**facts, "zenoh": keys.settings})
    terminal.print_line(f"{keys.member} of {', '.join(keys.members)}; until {keys.ends:%Y-%m-%d %H:%M} UTC")
    return terminal.print_json(keys.settings)
