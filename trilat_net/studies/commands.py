"""The commands that studies show, so that a person can repeat a run."""

from collections.abc import Iterable, Mapping
from typing import Any

import tomli_w

from ..errors import ScenarioError
from ..process import join_words
from ..scenario.imported_law import name_law_classes


def format_command(*words: str) -> str:
    """Returns a command of the program."""
    return join_words(["trilat", *words])


def set_options(overrides: Iterable[str]) -> list[str]:
    """Returns overrides, as texts KEY=VALUE, as options of a command."""
    return [word for text in overrides for word in ("--set", text)]


def format_toml_value(value: Any) -> str:
    """Returns a value as TOML on one line; numbers as short as they can be."""
    value = name_law_classes(value)
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key} = {format_toml_value(entry)}' for key, entry in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(format_toml_value, value))}]"
    if isinstance(value, float) and float(f"{value:g}") == value:
        return f"{value:g}"
    try:
        return tomli_w.dumps({"v": value}).removeprefix("v = ").removesuffix("\n")
    except TypeError:
        raise ScenarioError(f"{value!r:.80} is no value of a scenario: those are of TOML") from None
