"""The commands that studies show, so that a person can repeat a run."""

import shlex
from collections.abc import Iterable, Mapping
from typing import Any

import tomli_w

from ..scenario.imported_law import name_law_class


def format_command(*words: str) -> str:
    """Returns a command of the program, quoted for a shell."""
    return shlex.join(["trilat", *words])


def set_options(overrides: Iterable[str]) -> list[str]:
    """Returns overrides, as texts KEY=VALUE, as options of a command."""
    return [word for text in overrides for word in ("--set", text)]


def format_toml_value(value: Any) -> str:
    """Returns a value as TOML on one line; numbers as short as they can be."""
    if isinstance(value, type):
        value = name_law_class(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key} = {format_toml_value(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_toml_value, value))}]"
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    return tomli_w.dumps({"v": value}).removeprefix("v = ").removesuffix("\n")
