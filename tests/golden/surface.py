"""The surface on which people and programs rely: commands, options and keys of JSON."""

from collections.abc import Iterator
from typing import Any

import click
import typer.main


def list_options(command: click.Command, path: str = "trilat") -> dict[str, list[str]]:
    """Returns every command by its words, with the names of its options and arguments."""
    options_by_command = {
        path: sorted(
            name for param in command.params for name in (*param.opts, *param.secondary_opts)
        )
    }
    for name, below in getattr(command, "commands", {}).items():
        options_by_command |= list_options(below, f"{path} {name}")
    return options_by_command


def all_options() -> dict[str, list[str]]:
    """Returns what `trilat` offers."""
    from trilat_net.app.cli import app

    return list_options(typer.main.get_command(app))


def list_keys(value: Any, path: str = "") -> Iterator[str]:
    """Yields the path of every key; the places of a list count as one."""
    if isinstance(value, dict):
        for key, below in value.items():
            yield f"{path}.{key}"
            yield from list_keys(below, f"{path}.{key}")
    elif isinstance(value, list):
        for below in value:
            yield from list_keys(below, f"{path}[]")
