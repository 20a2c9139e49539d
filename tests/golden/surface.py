"""What people and programs hold on to: commands, options, keys of JSON."""

from collections.abc import Iterator
from typing import Any

import click
import typer.main


def options(command: click.Command, path: str = "trilat") -> dict[str, list[str]]:
    """Returns every command by its words, with the names of its options and arguments."""
    found = {
        path: sorted(
            name for param in command.params for name in (*param.opts, *param.secondary_opts)
        )
    }
    for name, below in getattr(command, "commands", {}).items():
        found |= options(below, f"{path} {name}")
    return found


def all_options() -> dict[str, list[str]]:
    """Returns what `trilat` offers."""
    from trilat_net.app.cli import app

    return options(typer.main.get_command(app))


def keys(value: Any, path: str = "") -> Iterator[str]:
    """Yields the path of every key; the places of a list count as one."""
    if isinstance(value, dict):
        for key, below in value.items():
            yield f"{path}.{key}"
            yield from keys(below, f"{path}.{key}")
    elif isinstance(value, list):
        for below in value:
            yield from keys(below, f"{path}[]")
